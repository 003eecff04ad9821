"""Where things are: the project's rooms, the cache, and the search path that stands in for a board's file system."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIB = ROOT / "lib"
FIRMWARE = ROOT / "firmware"
BOARDS = ROOT / "boards"
HOST_TESTS = ROOT / "host_tests"
SIM = HOST_TESTS / "sim"
SHIM = HOST_TESTS / "shim"


def cache() -> Path:
    """The cache folder: UPRIGHT_CACHE, else XDG_CACHE_HOME/upright, else ~/.cache/upright. It is made when missing."""
    folder = os.environ.get("UPRIGHT_CACHE")
    if not folder:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(base) / "upright"
    folder = Path(folder).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def board_path(board: str = "sim", simulated: bool = True) -> list[Path]:
    """The folders that together hold what a board's root and lib folders would."""
    folders = [SIM] if simulated else []
    return [*folders, LIB, FIRMWARE, BOARDS / board]
