"""The filters that the firmware knows, as lib/upright/filters.py lists them: names, axes, the default."""

import inspect

from upright_host import library
from upright_host.console import Wrong

# for the help texts of the commands that take a filter's name
CHOICE = (
    "For use: inertial6, inertial9. The classic: mahony6, mahony9. To study and compare: euler6, "
    "kalman6, quaternion-kalman6, quaternion-kalman9."
)


def filters() -> dict[str, tuple[str, str]]:
    """name: (module, class) of lib/upright."""
    return library.upright("filters").FILTERS


def hardware() -> tuple[str, ...]:
    """The names of those that a sensor computes by itself."""
    return library.upright("filters").HARDWARE


def axes(name: str) -> int:
    """6, or 9 for a filter that uses a magnetometer."""
    module, kind = filters()[known(name)]
    return getattr(library.upright(module), kind).AXES


def default(magnetometer: bool) -> str:
    """The filter that a board without FILTER runs."""
    return library.upright("filters").default(magnetometer)


def known(name: str, others=()) -> str:
    """-> the name. Raises Wrong where it is neither a filter's nor one of the others."""
    names = [*filters(), *others]
    if name not in names:
        raise Wrong(f"unknown filter {name!r}; there are {', '.join(names)}")
    return name


def listed(text: str, others=()) -> list[str]:
    """The names in "a,b,...", each once. Raises Wrong for one that is unknown, and when there is none."""
    names = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise Wrong("no filter is named")
    return [known(name, others) for name in names]


class Scales:
    """What a filter wants to know of a sensor."""

    def __init__(self, gyro_scale=(82, 5), accel_lsb_per_g=4096):
        self.gyro_scale = gyro_scale
        self.accel_lsb_per_g = accel_lsb_per_g


def check(
    name: str, gains: dict | None = None, rate=(200, 1), scales: Scales | None = None
) -> None:
    """Raises Wrong for an unknown name, a filter that cannot be given samples, and gains that it does not take."""
    module, kind = filters()[known(name)]
    if name in hardware():
        raise Wrong(f"{name} is computed in the sensor: no samples can be handed to it")
    if not gains:
        return
    takes = inspect.signature(getattr(library.upright(module), kind)).parameters.values()
    if all(one.kind != one.VAR_KEYWORD for one in takes):
        own = [one.name for one in takes][3:]
        for gain in gains:
            if gain not in own:
                raise Wrong(f"{name} has no {gain}; its gains are {', '.join(own) or 'none'}")
    try:
        library.upright("filters").make(name, rate, scales or Scales(), gains)
    except ValueError as why:
        raise Wrong(str(why) if str(why).startswith(name) else f"{name}: {why}") from None
