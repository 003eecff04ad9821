"""`upright dmp check`: is this file an image for the MPU's Digital Motion Processor, and which one?

The images are InvenSense's, and not part of this project: the user brings one. Most people have it as an array in a C
header; --out makes of that the binary file that a board reads.
"""

import re
from pathlib import Path

import typer

from upright_host import console, library, options
from upright_host.console import Wrong

# Whole files that are known, by SHA-256; mpu_dmp_image.KNOWN has the same keys
KNOWN = {
    "ae42d0be801847e53e77a96ca74961d3063a21f1c0006c556b13d0e305a3c1ec": "i2cdevlib, MotionApps 6.12",
    "e3ed21163e3933b523caeeac08ebc7fffe3101a7d40ce4273e4c12e9fa5d61e3": "MotionApps 2.0, dmpConfig 0x01",
    "9d24f84aad5bb3eb52b768fa0ad5e43a76da43a4aba1140084462976e8904e21": "MotionApps 2.0, dmpConfig 0x01, dmpUpdates",
    "205e36b31bbc864a39d4961d59318182f485cee5704c9c11264bf31314c27cb7": "MotionApps 2.0, dmpConfig 0x04",
    "e67e0b259586d38e2a2b5e5a9a79e80e377761d366c719977c105329164b327c": "MotionApps 2.0, dmpConfig 0x04, dmpUpdates",
    "15a4222864928954aff8f569eb1adc6f8f74f582c34467e0346deafb273e5064": "MotionApps 2.0, dmpConfig 0x09",
    "0478b3f4fca6fca39a4fe8b8e98b3917408bb4f0345f21177f9db40aff87cc84": "MotionApps 2.0, dmpConfig 0x09, dmpUpdates",
}
# An image that does not run without the list that belongs to it
BARE = {
    "9cdc90f7667237e320eda0fa117d821df2d4a9d3d87b45548d7192baa15e32c7": "MotionApps 2.0",
}

_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*|#[^\n]*", re.S)
_DEFINE = re.compile(r"^[ \t]*#[ \t]*define[ \t]+(\w+)[ \t]+(0[xX][0-9a-fA-F]+|\d+)", re.M)
# name[SIZE] PROGMEM = { ... } of C, name = [ ... ] or bytes([ ... ]) of Python
_ARRAY = re.compile(
    r"(\w+)\s*\[[^\]]*\][^=;{}\[\]]*=\s*\{([^{}]*)\}"
    r"|(\w+)\s*=\s*(?:bytes|bytearray)?[\[(]+([^\[\]()]*)[\])]"
)
_TEXT_TO_LOOK_AT = 4096
_LARGEST = 1 << 20  # bytes: an image as the text of a program has 20 kB


class ImageError(Wrong):
    """What is wrong with a file, in one line."""


def _image_module():
    """lib/upright/dmp_image.py, which knows the layouts."""
    return library.upright("dmp_image")


def read(files: list[Path]) -> tuple[bytes, list[str]]:
    """The bytes of an image and what follows it, in one or several files -> (bytes, names of the arrays).

    There are names where the file is text. Raises ImageError.
    """
    parts, names = [], []
    for path in files:
        try:
            data = console.contents(path, _LARGEST)
        except OSError as why:
            raise ImageError(f"{path}: {why.strerror or why}") from why
        except Wrong as why:
            raise ImageError(str(why)) from why
        if not data:
            raise ImageError(f"{path} is empty")
        if is_text(data):
            data, found = from_text(data.decode("utf-8", "replace"), str(path))
            names += found
        parts.append(data)
    return b"".join(parts), names


def is_text(data: bytes) -> bool:
    """No image is: each has bytes that no text has, zeros above all, within its first hundred."""
    return not set(data[:_TEXT_TO_LOOK_AT]) & {*range(9), *range(14, 27), *range(28, 32)}


def from_text(text: str, what: str = "the text") -> tuple[bytes, list[str]]:
    """The arrays of a C header, or of a Python file, that make an image with its lists; or all of the bytes in a text
    that is but numbers. -> (bytes, "name (bytes)" of each array used). Raises ImageError.
    """
    constants = dict(_DEFINE.findall(text))
    text = _COMMENT.sub(" ", text)
    arrays = []
    for name, body, other_name, other_body in _ARRAY.findall(text):
        name, body = name or other_name, body or other_body
        try:
            arrays.append((name, _bytes(body, constants)))
        except ImageError:
            if "0x" in body and len(body) > 500:
                raise
    if not arrays:
        try:
            arrays = [("bytes", _bytes(text, constants))]
        except ImageError:
            raise ImageError(f"{what} is text, with no array of bytes in it") from None
    module = _image_module()
    at = next((i for i, (_, data) in enumerate(arrays) if len(data) in module.LAYOUTS), None)
    if at is None:
        found = ", ".join(f"{name} of {len(data)}" for name, data in arrays[:5])
        raise ImageError(
            f"{what} is text, and has no array of 3062 or 1929 bytes{': ' + found if found else ''}"
        )
    used = [arrays[at]]
    for name, data in arrays[at + 1 :]:
        try:
            found = module.DmpImage(used[0][1] + data, accept_unknown=True)
        except module.MpuDmpError:
            continue
        if list(found.patches()):
            used.append((name, data))
    return b"".join(data for _, data in used), [f"{name} ({len(data)})" for name, data in used]


def _bytes(body: str, constants: dict) -> bytes:
    values = []
    for word in body.replace(",", " ").split():
        word = constants.get(word, word).strip("();")
        if not word:
            continue
        try:
            value = int(word, 0)
        except ValueError:
            raise ImageError(f"{word!r} is no byte") from None
        if not 0 <= value <= 255:
            raise ImageError(f"{word} is no byte")
        values.append(value)
    return bytes(values)


def describe(data: bytes, expected: str | None = None) -> list[str]:
    """What a file is, in lines. Raises ImageError unless its size, its list and its SHA-256 are in order.

    expected: the SHA-256 that it is to have; None: any of KNOWN.
    """
    module = _image_module()
    try:
        image = module.DmpImage(data, accept_unknown=True)
    except module.MpuDmpError as why:
        raise ImageError(str(why)) from None
    if expected is not None and image.sha256 != expected.lower():
        raise ImageError(f"its SHA-256 is {image.sha256}, not {expected}")
    if expected is None and image.sha256 in BARE:
        raise ImageError(
            f"this is the bare image of {BARE[image.sha256]}: it needs its configuration list behind it "
            "(name both files, or take the header that has both)"
        )
    if expected is None and image.sha256 not in KNOWN:
        raise ImageError(
            f"{image.size} bytes, as {image.version} has, but the SHA-256 {image.sha256} is not known; "
            "if you trust the file, say --sha256 with it here, and DMP_SHA256 in board.py"
        )
    last = image.image_size - 1
    patches = sum(len(piece) for _, piece in image.patches())
    return [
        f"version        {image.version}, by its size: {image.image_size} bytes",
        f"list behind it {image.size - image.image_size} bytes, {patches} of them for the memory",
        f"SHA-256        {image.sha256}",
        f"known as       {KNOWN.get(image.sha256, 'the one that you named')}",
        f"program start  0x{image.program_start:04x}",
        f"packets        {image.packet} bytes, 10 to 200 per second, "
        f"{image.accel_lsb_per_g} LSB per g",
        f"memory         banks 0 to {last >> 8} of {module.BANKS}, up to 0x{last:04x}",
    ]


def register(app: typer.Typer) -> None:
    """Give an app the commands `dmp ...`."""
    dmp = typer.Typer(
        no_args_is_help=True, help="The MPU's Digital Motion Processor and its images."
    )
    app.add_typer(dmp, name="dmp")

    @dmp.callback()
    def _group():
        """The MPU's Digital Motion Processor and its images."""

    @dmp.command("check")
    def check(
        files: list[Path] = typer.Argument(
            ..., metavar="FILE...", help="The image; behind it, if need be, the files of its lists."
        ),
        out: Path = options.output(
            "Write the image and its lists to this file, as a board reads it."
        ),
        sha256: str = typer.Option(None, help="The SHA-256 that it is to have."),
    ):
        """Say which image of the DMP a file is, whether it is known, and what it needs; exit code 2 when it is none.

        A C header (or Python file) with the image as an array is understood as well, with --out.
        """
        named = ", ".join(str(path) for path in files)
        try:
            data, arrays = read(files)
            if arrays and not out:
                raise ImageError(
                    f"text, with the arrays {', '.join(arrays)}: --out dmp.bin makes a binary file of them"
                )
            lines = describe(data, sha256)
        except ImageError as why:
            text = str(why)
            raise Wrong(text if text.startswith(named) else f"{named}: {text}") from None
        if out:
            with console.writing(out):
                out.write_bytes(data)
            lines.append(f"written to     {out}, {len(data)} bytes")
        for line in lines:
            console.say(line)
