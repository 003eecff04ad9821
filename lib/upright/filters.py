# The registry of filters, by name. Needs the modules of those that are made, and no others. Every port.

import gc

# name: (module, class); a module is imported when one of its filters is made, so the others take no memory
FILTERS = {
    # the default: the answer for a user
    "inertial6": ("inertial", "Inertial6"),
    "inertial9": ("inertial", "Inertial9"),
    # the classic, small and quick
    "mahony6": ("mahony", "Mahony6"),
    "mahony9": ("mahony", "Mahony9"),
    # to study and compare
    "euler6": ("complementary", "Euler6"),
    "kalman6": ("kalman", "Kalman6"),
    "quaternion-kalman6": ("quaternion_kalman", "QuaternionKalman6"),
    "quaternion-kalman9": ("quaternion_kalman", "QuaternionKalman9"),
    # in the sensor
    "dmp6": ("dmp", "MpuDmp"),
}

# The sensor itself computes these: driver and filter are one object, and samples cannot be passed to them.
HARDWARE = ("dmp6",)


def default(magnetometer):
    """The name of the default filter."""
    return "inertial9" if magnetometer else "inertial6"


def check(name):
    """Raise ValueError for an unknown name."""
    if not isinstance(name, str) or name not in FILTERS:
        raise ValueError("unknown filter %r; there are %s" % (name, ", ".join(sorted(FILTERS))))


def make(name, rate, imu, gains):
    """Build a filter by its name for samples of `imu` (its scales) at `rate` (Hz, or (num, den) Hz).

    gains: dict of the filter's own keyword arguments, {} for its defaults. Raises ValueError for an unknown name and
    for arguments that the filter does not accept.
    """
    check(name)
    if name in HARDWARE:
        raise ValueError("%s runs in the sensor: it cannot take samples" % name)
    kind = _class(name)
    try:
        return kind(rate, imu.gyro_scale, imu.accel_lsb_per_g, **gains)
    except TypeError as why:
        raise ValueError("%s with %r: %s" % (name, gains, why))


def make_hardware(name, imu, config):
    """Build a filter of HARDWARE on the driver `imu`, by config's RATE, DMP_IMAGE, DMP_SHA256 and IMU_AXES.

    It takes the place of the driver, and it is the filter; RATE is a whole number. Raises OSError for an image that is
    absent or not the one that is known, ValueError for settings that it cannot keep.
    """
    num, den = config.RATE
    more = {"known": (config.DMP_SHA256,)} if config.DMP_SHA256 else {}
    return _class(name)(imu, config.DMP_IMAGE, num // den, axes=config.IMU_AXES, **more)


def _class(name):
    module, kind = FILTERS[name]
    gc.collect()  # so that modules, which stay, do not lie scattered over a small heap
    try:
        return getattr(__import__("upright." + module, None, None, (kind,)), kind)
    except ImportError:
        raise ValueError(
            "%s.py is not on this board: install the firmware again with FILTER = %r"
            % (module, name)
        )
