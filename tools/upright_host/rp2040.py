"""The runtime rp2040: MicroPython's firmware for the Raspberry Pi Pico, as it goes onto a board. The board itself is
emulated by tools/simulator/rp2040.

It is built from Debian's packages (build_root.py). UPRIGHT_RP2040_IMAGE names a finished image (.uf2) to take instead.
"""

import os
import shutil
import struct
from pathlib import Path

from upright_host import build_root, debian
from upright_host.console import Unavailable

WHAT = "MicroPython's firmware for the Raspberry Pi Pico on an emulated RP2040"
VARIABLE = "UPRIGHT_RP2040_IMAGE"
# What a machine that cannot build it can do
_GIVEN = (
    "To take a finished one: download RPI_PICO's .uf2 (1.26 or newer) from micropython.org/download/RPI_PICO, then run"
    " `upright runtimes --image FILE.uf2`"
)

# MicroPython's own CMake files do the work; its libraries that Debian packages by themselves are links, and modules out
# of micropython-lib (which is no package) are not frozen in.
_BUILD = """set -e
cd /build
make -C micropython/mpy-cross -j {jobs}
cmake -S micropython/ports/rp2 -B out -DPICO_SDK_PATH_OVERRIDE=/usr/src/pico-sdk -DPICO_BUILD_DOCS=0 \\
  -DMICROPY_BOARD=RPI_PICO -DMICROPY_BOARD_DIR=/build/micropython/ports/rp2/boards/RPI_PICO \\
  -DMICROPY_LIB_DIR=/build/micropython-lib -DMICROPY_FROZEN_MANIFEST=/build/manifest.py \\
  -DCMAKE_CXX_STANDARD_LIBRARIES=-lm
make -C out -j {jobs}
"""
_MANIFEST = """freeze("$(PORT_DIR)/modules")
include("$(MPY_DIR)/extmod/asyncio")
"""


def image() -> Path:
    """-> the firmware as a UF2 file: the one that UPRIGHT_RP2040_IMAGE names, else the cache's, else it is built.

    Raises Unavailable with the reason, in one line, where this machine cannot have it.
    """
    named = os.environ.get(VARIABLE)
    if named:
        version(Path(named))
        return Path(named)
    try:
        return build_root.image(RECIPE)
    except Unavailable as why:
        raise Unavailable(unavailable(why)) from None


def unavailable(why) -> str:
    """Why it cannot be built, and what a user can do."""
    return f"{why}. {_GIVEN}"


def at_hand() -> bool:
    """Is there an image that need not be built?"""
    return bool(os.environ.get(VARIABLE) or build_root.cached(RECIPE))


def version(path: Path) -> str:
    """-> the version of MicroPython in an image. Unavailable when it is no image for this board, or too old."""
    try:
        data = path.read_bytes()
    except OSError as why:
        raise Unavailable(f"{path}: {why.strerror}") from None
    # UF2: blocks of 512 bytes, payload in front; the family is the RP2040's
    head = struct.unpack_from("<8I", data.ljust(512, b"\0"))
    if head[:2] != (0x0A324655, 0x9E5D5157) or head[7] != 0xE48BFF56 or len(data) % 512:
        raise Unavailable(f"{path} is not a UF2 image for the RP2040")
    payload = b"".join(data[at + 32 : at + 288] for at in range(0, len(data), 512))
    return build_root.version_in(payload, path)


def take(path: Path) -> str:
    """Put a finished image into the cache, where it is used from now on -> its version. Raises Unavailable."""
    return build_root.take(RECIPE, path)


def _prepare(build: Path, step) -> None:
    debian.source("mbedtls", debian.SUITE, build / "mbedtls", step)
    for name, place in (("tinyusb", "/usr/src/tinyusb"), ("mbedtls", "/build/mbedtls")):
        library = build / "micropython/lib" / name
        shutil.rmtree(library, ignore_errors=True)
        library.symlink_to(place)
    (build / "manifest.py").write_text(_MANIFEST)


RECIPE = build_root.Recipe(
    name="rp2040",
    number=1,
    tools=(
        *("gcc-arm-none-eabi", "libnewlib-arm-none-eabi", "libstdc++-arm-none-eabi-dev"),
        *("cmake", "pioasm", "picotool"),
    ),
    # what they ask for besides (438 MB of C++ library) is not needed
    alone=("pico-sdk-source:all", "tinyusb-source:all"),
    prepare=_prepare,
    script=_BUILD,
    product="out/firmware.uf2",
    kept="firmware.uf2",
    version=version,
    # pico-sdk brings what it uses of the C++ library; -lm, which went with it, is in _BUILD
    environment={"CXXFLAGS": "-nostdlib++"},
)
