"""The filters that the firmware knows, by lib/upright/filters.py."""

import runpy

from upright_host import paths


def filters() -> dict[str, tuple[str, str]]:
    """name: (module, class) of lib/upright."""
    return _read()["FILTERS"]


def hardware() -> tuple[str, ...]:
    """The names of those that a sensor computes by itself."""
    return _read()["HARDWARE"]


def check(name: str) -> None:
    """Raises ValueError for a name that no filter has, and for a filter that cannot be given samples."""
    _read()["check"](name)
    if name in hardware():
        raise ValueError(f"{name} is computed in the sensor: no samples can be handed to it")


def _read():
    return runpy.run_path(str(paths.PACKAGE / "filters.py"))
