"""The options that several commands have, each with its check, so that a wrong one is refused before anything runs."""

import os
from pathlib import Path

import typer

from upright_host import library, paths, runtimes
from upright_host.console import Wrong


def seconds(help: str = "Only the first so many seconds."):
    return typer.Option(None, help=help, callback=_positive)


def runtime(default: str | None = None, board: bool = False, help: str = ""):
    """board: the emulated one may be asked for."""
    names = runtimes.LISTED if board else runtimes.NAMES
    said = ", ".join(names[:-1]) + f" or {names[-1]}"
    if default is None:
        said += "; default: unix where it can be had"

    def known(name: str | None):
        if name is not None and name not in names:
            raise Wrong(f"unknown runtime {name!r}; there are {', '.join(names)}")
        return name

    return typer.Option(default, "--runtime", callback=known, help=f"{help}{said}.")


def simulated_board(name: str | None):
    """-> the name. Raises Wrong where boards/ has no folder of it, or the simulator no chips."""
    if name is not None and paths.known_board(name) not in library.simulator("boards").BOARDS:
        raise Wrong(
            f"boards/{name} has no simulated chips: add a line to tools/simulator/boards.py"
        )
    return name


def jobs(what: str):
    return typer.Option(None, min=1, help=f"{what} at a time (default: one a processor).")


def output(help: str):
    """A file to write: that it can be is looked at before the work, not after it."""
    return typer.Option(None, callback=writable, help=help)


def writable(path: Path | None):
    if path is not None:
        folder = path.absolute().parent
        if not folder.is_dir():
            raise Wrong(f"{path} cannot be written: there is no folder {folder}")
        if path.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
            raise Wrong(f"{path} cannot be written")
    return path


def _positive(value: float | None):
    if value is not None and not 0 < value < 1e8:  # three years
        raise Wrong(f"{value} is not a positive number of seconds")
    return value
