"""Where things are: the project's rooms, the cache, and the search path that stands in for a board's file system."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIB = ROOT / "lib"
PACKAGE = LIB / "upright"
FIRMWARE = ROOT / "firmware"
APPLICATION = FIRMWARE / "upright_app"
BOARDS = ROOT / "boards"
SIMULATOR = ROOT / "tools" / "simulator"
SHIM = SIMULATOR / "shim"


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
    folders = [SIMULATOR] if simulated else []
    return [*folders, LIB, FIRMWARE, BOARDS / board]


def board_modules() -> dict[str, Path]:
    """Every module that an installation may hold: {name on a board, without suffix: source}."""
    return {
        f"lib/{path.parent.name}/{path.stem}": path
        for room in (PACKAGE, APPLICATION)
        for path in sorted(room.glob("*.py"))
    }
