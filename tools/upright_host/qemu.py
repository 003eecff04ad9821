"""The runtimes m3 and rv32: MicroPython's qemu port on a Cortex-M3 (mps2-an385) and on RISC-V (virt, RV32IMAC).

The firmware is built from Debian's packages (build_root.py). qemu-system comes from PATH or from Debian's packages. A
board runs a file as the unix port does: tools/simulator/qemu/run.py starts it and hands the host's files through.
"""

import sys
from pathlib import Path

from upright_host import build_root, paths
from upright_host.console import Unavailable

_RUN = paths.SIMULATOR / "qemu" / "run.py"
PACKAGES = ("qemu-system-arm", "qemu-system-riscv")

# The port freezes something in any case: one small module of its own.
_MANIFEST = """freeze("$(PORT_DIR)/test-frzmpy", "frozen_const.py")
"""
_COMMON = "-j {jobs} MPY_LIB_DIR=/build/micropython-lib FROZEN_MANIFEST=/build/qemu-manifest.py"
_BUILD_M3 = f"""set -e
cd /build/micropython
make -C mpy-cross -j {{jobs}}
make -C ports/qemu BOARD=MPS2_AN385 MICROPY_HEAP_SIZE=3600000 {_COMMON}
"""
# The compiler looks for picolibc.specs beside its own libraries. A heap of 2 MB is too small for the simulator.
_BUILD_RV32 = f"""set -e
cd /build/micropython
make -C mpy-cross -j {{jobs}}
libraries=$(dirname $(riscv64-unknown-elf-gcc -print-libgcc-file-name))
ln -sf /usr/lib/picolibc/riscv64-unknown-elf/picolibc.specs $libraries
sed 's/LENGTH = 2M/LENGTH = 32M/' ports/qemu/mcu/rv32/virt.ld > /build/virt.ld
make -C ports/qemu BOARD=VIRT_RV32 LDSCRIPT=/build/virt.ld MICROPY_HEAP_SIZE=24000000 {_COMMON}
"""


def at_hand(name: str) -> bool:
    """Is there an image that need not be built?"""
    return build_root.cached(RECIPES[name]) is not None


def _version(path: Path) -> str:
    try:
        return build_root.version_in(path.read_bytes(), path)
    except OSError as why:
        raise Unavailable(f"{path}: {why.strerror}") from None


def _prepare(build: Path, step) -> None:
    (build / "qemu-manifest.py").write_text(_MANIFEST)


RECIPES = {
    "m3": build_root.Recipe(
        name="m3",
        number=1,
        tools=("gcc-arm-none-eabi", "libnewlib-arm-none-eabi"),
        prepare=_prepare,
        script=_BUILD_M3,
        product="micropython/ports/qemu/build-MPS2_AN385/firmware.elf",
        kept="firmware.elf",
        version=_version,
    ),
    "rv32": build_root.Recipe(
        name="rv32",
        number=1,
        tools=("gcc-riscv64-unknown-elf", "picolibc-riscv64-unknown-elf"),
        prepare=_prepare,
        script=_BUILD_RV32,
        product="micropython/ports/qemu/build-VIRT_RV32/firmware.elf",
        kept="firmware.elf",
        version=_version,
    ),
}
WHAT = {
    "m3": "MicroPython's qemu port on an emulated Cortex-M3",
    "rv32": "MicroPython's qemu port on an emulated RISC-V (RV32IMC)",
}
PROGRAM = {"m3": "qemu-system-arm", "rv32": "qemu-system-riscv32"}
_MACHINE = {
    "m3": ("-machine", "mps2-an385"),
    "rv32": ("-bios", "none", "-machine", "virt", "-m", "128M"),
}
_ALWAYS = ("-nographic", "-monitor", "null", "-semihosting", "-serial", "stdio")


def command(name: str, image: Path, emulator: list[str]) -> list[str]:
    """What takes a script and its arguments as `micropython` does."""
    return [sys.executable, str(_RUN), str(image), *emulator, *_MACHINE[name], *_ALWAYS, "--"]
