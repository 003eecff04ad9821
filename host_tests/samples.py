"""Samples for a filter, one by one, and what a filter asks a driver for."""

from array import array

from upright import filters

SOFTWARE = [name for name in filters.FILTERS if name not in filters.HARDWARE]


class Scales:
    """A driver, as far as a filter asks it."""

    sample_rate = (200, 1)
    gyro_scale = (82, 5)
    accel_lsb_per_g = 4096


def counts(ax=0, ay=0, az=4096, gx=0, gy=0, gz=0, mx=66, my=0, mz=-150, flags=1):
    """A sample: level, north and at rest, if nothing else is said."""
    return array("h", [ax, ay, az, gx, gy, gz, mx, my, mz, 0, flags])


def run(filter, row, n):
    for _ in range(n):
        filter.update(row)
