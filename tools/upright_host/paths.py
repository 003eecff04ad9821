"""Where things are: the project's rooms, the cache, and the search path that stands in for a board's file system."""

import contextlib
import difflib
import os
from pathlib import Path

from upright_host import lock
from upright_host.console import Unavailable, Wrong

ROOT = Path(__file__).resolve().parents[2]
LIB = ROOT / "lib"
PACKAGE = LIB / "upright"
FIRMWARE = ROOT / "firmware"
APPLICATION = FIRMWARE / "upright_app"
BOARDS = ROOT / "boards"
SIMULATOR = ROOT / "tools" / "simulator"
SHIM = SIMULATOR / "shim"


def cache() -> Path:
    """The cache folder: UPRIGHT_CACHE, else XDG_CACHE_HOME/upright, else ~/.cache/upright. It is made when missing.

    Raises Unavailable where that cannot be.
    """
    folder = os.environ.get("UPRIGHT_CACHE")
    if not folder:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(base) / "upright"
    folder = Path(folder).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as why:
        raise Unavailable(
            f"the cache {folder} cannot be made ({why.strerror}); UPRIGHT_CACHE may name another folder"
        ) from None
    return folder


@contextlib.contextmanager
def locked(name: str):
    """One process at a time fills a place of the cache."""
    with lock.held(cache() / f".{name}.lock"):
        yield


def boards() -> list[str]:
    """The folders of boards/."""
    return sorted(folder.name for folder in BOARDS.iterdir() if folder.is_dir())


def known_board(name: str) -> str:
    """-> the name. Raises Wrong where boards/ has no folder of it."""
    if name not in boards():
        near = nearest_board(name)
        guess = f". Did you mean {near}? There" if near else "; there"
        raise Wrong(
            f"unknown board {name!r}{guess} are {', '.join(boards())}. `upright board new NAME` makes another"
        )
    return name


def nearest_board(name: str) -> str | None:
    """The folder of boards/ that a name most likely means: "picow", "ESP32-C3"."""

    def plain(text):
        return "".join(c for c in text.lower() if c.isalnum())

    known = {plain(board): board for board in boards()}
    near = difflib.get_close_matches(plain(name), known, 1, 0.7)
    return known[near[0]] if near else None


def has_module(name: str) -> bool:
    """Whether the library has a module of this name, which may be any text: Path.exists() raises for a long one."""
    return os.path.exists(PACKAGE / f"{name}.py")


def board_path(board: str = "sim", simulated: bool = True) -> list[Path]:
    """The folders that together hold what a board's root and lib folders would."""
    folders = [SIMULATOR] if simulated else []
    return [*folders, LIB, FIRMWARE, BOARDS / board]


def board_modules() -> dict[str, Path]:
    """Every module that an installation may hold: {name on a board, without suffix: source}.

    Without two of the application that flash.py puts onto a board in its own way.
    """
    return {
        f"lib/{path.parent.name}/{path.stem}": path
        for room in (PACKAGE, APPLICATION)
        for path in sorted(room.glob("*.py"))
        if path.stem not in ("installation", "packed")
    }
