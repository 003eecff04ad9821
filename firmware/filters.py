# The filters that the firmware and the host tools can choose from, by name. Every port.

# name: (module, class) of lib/; a module is imported when one of its filters is made, so that the others take no memory
FILTERS = {
    "mahony6": ("mahony", "Mahony6"),
    "mahony9": ("mahony", "Mahony9"),
    "inertial6": ("inertial_mahony", "Inertial6"),
    "inertial9": ("inertial_mahony", "Inertial9"),
    "inertial9-lite": ("inertial_mahony", "Inertial9Lite"),
}


def make(name, rate, imu, gains):
    """Build a filter by its name for samples of `imu` (its scales) at `rate` (Hz, or (num, den) Hz).

    gains: dict of the filter's own keyword arguments, {} for its defaults. Raises ValueError for an unknown name, and
    for what the filter does not take.
    """
    if name not in FILTERS:
        raise ValueError("unknown filter %r; there are %s" % (name, ", ".join(sorted(FILTERS))))
    module, kind = FILTERS[name]
    kind = getattr(__import__(module), kind)
    try:
        return kind(rate, imu.gyro_scale, imu.accel_lsb_per_g, **gains)
    except TypeError as why:
        raise ValueError("%s with %r: %s" % (name, gains, why))
