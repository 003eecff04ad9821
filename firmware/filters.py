# The filters that the firmware and the host tools can choose from, by name.

import mahony

FILTERS = {"mahony6": mahony.Mahony6, "mahony9": mahony.Mahony9}


def make(name, rate, imu, gains):
    """Build a filter by its name for samples of `imu` (its scales) at `rate` (Hz, or (num, den) Hz).

    gains: dict of the filter's own keyword arguments. Raises ValueError for an unknown name.
    """
    if name not in FILTERS:
        raise ValueError("unknown filter %r; there are %s" % (name, ", ".join(sorted(FILTERS))))
    return FILTERS[name](rate, imu.gyro_scale, imu.accel_lsb_per_g, **gains)
