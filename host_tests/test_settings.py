"""The settings of a board.py: whatever a setting is set to, it is taken or refused in one line, at the start."""

import pytest
from upright.settings import DEFAULTS, Settings

ANYTHING = [
    *(None, True, False, 0, -1, 1, 2, 3, 7, 8, 100, -200, 10**9, 10**30),
    *(2.5, -0.5, 200.0, float("nan"), float("inf"), "", "200", "x", "auto", "timer", "zyx", "xyz", b"x", "\0"),
    *("mahony6", "kalman", "dmp6", "IST8310", "a" * 64, "z" * 64, "-y", "ü", "/"),
    *((), [], (1,), (200, 1), [200, 1], (200, 0), (-1, 1), (True, True), (1, 2, 3), ("200", "1"), (200.0, 1)),
    *(("x", "y", "z"), ("y", "-x", "z"), ("x", "x", "z"), ("x", "y"), ("X", "Y", "Z"), ("-x", "y", "z"), [["x"]]),
    *({}, {"kp": 1}, {"tau_slow": "x"}, {1: 2}, set(), range(3), object(), int, lambda: 1),
]  # fmt: skip
NAMES = [value for value in ANYTHING if isinstance(value, str) and value not in ("", "\0")]
TAKEN = {
    "RATE": [100, (200, 1), [200, 1]],
    "DRIVE": [None, "timer"],
    "SENSOR_RATE_HZ": [None, 10**9],  # the chip refuses it
    "FIFO_HZ": [1, 2, 3, 7, 8, 100],
    "EXTERNAL_CLOCK": [True, False],
    "ACCEL_RANGE_G": [2, 8],
    "GYRO_RANGE_DPS": [],
    "DLPF": [None, 0, 1, 2, 3, 7],
    "IMU_AXES": [("x", "y", "z"), ("y", "-x", "z")],
    "MAG_AXES": [("x", "y", "z"), ("y", "-x", "z"), ("-x", "y", "z")],
    "MAGNETOMETER": ["auto", "IST8310"],
    "MAG_RATE_HZ": [1, 2, 3, 7, 8, 100, 10**9],
    "CALIBRATION": [None, *NAMES],
    "FILTER": [None, "mahony6", "dmp6"],
    "GAINS": [{}],
    "EULER": ["zyx"],
    "DECLINATION": [0, -1, 1, 2, 3, 7, 8, 100, 2.5, -0.5],
    "DMP_IMAGE": [b"x", *NAMES],
    "DMP_SHA256": [None, "a" * 64],
    "MEASURE_BIAS": [True, False],
    "KEEP_BIAS": [True, False],
    "DISPLAY_SHARES_BUS": [True, False],
    "DISPLAY_CHUNK": [8],
    "PAGE_SECONDS": [0, 1, 2, 3, 7, 8, 100, 2.5, 200.0],
    "WATCHDOG_MS": [0],
}


@pytest.mark.parametrize("name", DEFAULTS)
def test_a_setting_is_taken_or_refused_in_one_line_whatever_it_is(name):
    takes = [repr(value) for value in TAKEN[name]]
    for value in ANYTHING:
        taken = repr(value) in takes
        for axes in (6, 9):
            try:
                Settings({name: value}).check(axes, "timer")
            except ValueError as why:
                assert not taken, why
                assert str(why) and "\n" not in str(why)
            else:
                assert taken, f"{name} = {value!r} was taken"
