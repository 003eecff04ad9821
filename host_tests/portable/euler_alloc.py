# 10,000 updates and conversions of the Euler-angle filters with the heap locked, then again with the
# allocated bytes counted.
# Arguments: [float | list]: also do something in every step that allocates, to show that it is
# caught.

import sys
from array import array

import allocation
from upright.complementary import Euler6
from upright.kalman import Kalman6, KalmanFilter

waste = sys.argv[1] if len(sys.argv) > 1 else ""


def row(*values):
    return array("h", values)


# level, tilted, upside down, free fall, everything at full scale, at the pole, beyond it, stale
ROWS = (
    row(0, 0, 4096, 10, -10, 5, 0, 0, 0, 0, 1),
    row(2000, -3000, 1500, 3000, -2000, 500, 0, 0, 0, 0, 1),
    row(-900, 100, -4000, -300, 20, 32767, 0, 0, 0, 0, 9),
    row(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1),
    row(32767, -32768, 32767, -32768, 32767, -32768, 0, 0, 0, 0, 5),
    row(-4096, 0, 0, 100, 32767, 100, 0, 0, 0, 0, 1),
    row(-4090, -3, -200, 100, 32767, 100, 0, 0, 0, 0, 1),
    row(100, 200, 4000, 1000, -1000, 1000, 0, 0, 0, 0, 0),
)
filters = (Euler6(200, (82, 5), 4096), Kalman6(1000, (131, 1), 16384))
for f in filters:
    f.set_bias(100, -200, 300)
    f.seed(ROWS[1])
angle = KalmanFilter(-179990, 0.001, 1)
number = KalmanFilter(-(1 << 29), 10, 0.05, None)
quaternion = array("i", [0, 0, 0, 0])
angles = array("i", [0, 0, 0])


def tick(i):
    counts = ROWS[i & 7]
    for f in filters:
        f.update(counts)
        f.quaternion(quaternion)
    f.angles(angles)
    filters[0].angles(angles, "zxy")
    angle.update(angles[2])
    number.update((1 << 29) if i & 1 else -(1 << 29))
    angle.gain + angle.x
    if waste == "float":
        abs(i * 0.5)
    elif waste == "list":
        len([i])


for i in range(8):
    tick(i)
print("locked:", "MemoryError" if allocation.locked(tick, 10000) else "nothing allocated")
print("bytes allocated:", allocation.grown(tick, 1000))
