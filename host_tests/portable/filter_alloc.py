# 10,000 updates and conversions of every filter of the registry, in turn, with the heap locked, then again with the
# allocated bytes counted. Arguments: [float | list]: also do something in every step that allocates, to show that it
# is caught.

import sys
from array import array

import allocation
from upright import filters
from upright.kalman import KalmanFilter

waste = sys.argv[1] if len(sys.argv) > 1 else ""


class Sensor:
    """What a filter wants to know of a sensor."""

    def __init__(self, gyro_scale, accel_lsb_per_g):
        self.gyro_scale = gyro_scale
        self.accel_lsb_per_g = accel_lsb_per_g


def row(*values):
    return array("h", values)


# level, tilted and turning, upside down, free fall, everything at full scale, at the pole, beyond it, stale; the
# magnetometer as usual, none, weak, strong, at full scale
ROWS = (
    row(0, 0, 4096, 10, -10, 5, 66, 10, -150, 0, 3),
    row(2000, -3000, 1500, 3000, -2000, 500, 66, 10, -150, 0, 1),
    row(-900, 100, -4000, -300, 20, 32767, 0, 0, 0, 0, 11),
    row(0, 0, 0, 0, 0, 0, -16, 0, 0, 0, 3),
    row(32767, -32768, 32767, -32768, 32767, -32768, 32766, 32766, -32767, 0, 7),
    row(32767, -32768, 32767, 32767, 32767, 32767, 32767, 0, 0, 0, 3),
    row(-4096, 0, 0, 100, 32767, 100, 0, 0, 0, 0, 1),
    row(-4090, -3, -200, 100, 32767, 100, 0, 0, 0, 0, 1),
    row(100, 200, 4000, 1000, -1000, 1000, -10, -70, 140, 0, 2),
)
FINE, COARSE = Sensor((131, 1), 16384), Sensor((82, 5), 4096)
MADE = (
    ("mahony6", 200, COARSE, {"kp": 1, "ki": 0.1}),
    ("mahony9", 1000, COARSE, {"kp": 1, "ki": 0.1}),
    ("euler6", 200, COARSE, {}),
    ("kalman6", 1000, FINE, {}),
    ("inertial6", 200, COARSE, {}),
    ("inertial9", 1000, COARSE, {"bias_limit_dps": 25}),
    ("inertial9", 100, FINE, {}),
    ("inertial9", (2000, 7), Sensor((82, 5), 2048), {}),
    ("quaternion-kalman6", 200, COARSE, {}),
    ("quaternion-kalman9", 1000, COARSE, {"bias_start": 10}),
    ("quaternion-kalman9", 100, FINE, {}),
)
made = tuple([filters.make(*what) for what in MADE])
for f in made:
    f.set_bias(100, -200, 300)
    f.seed(ROWS[0])
made[10].set_quaternion(0, 1, 1, 0)  # a wrong start
asked = (
    ("resting", made[4:]),
    ("mag_accepted", made[5:8] + made[9:]),
    ("tilt_confidence", made[4:8]),
    ("heading_uncertainty_mdeg", made[4:8]),
)
angle = KalmanFilter(-179990, 0.001, 1)
number = KalmanFilter(-(1 << 29), 10, 0.05, None)
quaternion = array("i", [0, 0, 0, 0])
angles = array("i", [0, 0, 0])


def tick(k):
    # each filter in turn: a while of rest, then everything at once
    i = k // 11
    counts = ROWS[i % 9 if i % 200 > 120 else 0]
    f = made[k % 11]
    f.update(counts)
    f.quaternion(quaternion)
    f.angles(angles)
    f.angles(angles, "zxy")
    if k % 11 == 0:
        for name, of in asked:
            for f in of:
                getattr(f, name)
    angle.update(angles[2])
    number.update((1 << 29) if k & 1 else -(1 << 29))
    angle.gain + angle.x
    if waste == "float":
        abs(k * 0.5)
    elif waste == "list":
        len([k])


for i in range(99):
    tick(i)
steps = 10000 if waste else 110000
print("locked:", "MemoryError" if allocation.locked(tick, steps) else "nothing allocated")
print("bytes allocated:", allocation.grown(tick, 1000))
