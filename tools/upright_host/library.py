"""Modules of lib/upright and of the simulator for the host's own use: the very files that run on a board."""

import importlib
import sys

from upright_host import paths


def upright(module: str):
    """A module of lib/upright."""
    return _import(f"upright.{module}")


def simulator(module: str):
    """A module of tools/simulator."""
    return _import(module)


def _import(name):
    for folder in (paths.SIMULATOR, paths.LIB, paths.SHIM):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))  # last: nothing of the host may be hidden by it
    importlib.import_module("micropython")  # the stand-in: it prepares what the others import
    return importlib.import_module(name)
