"""The emulated board's flash: the littlefs in it."""

from littlefs import LittleFS

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
