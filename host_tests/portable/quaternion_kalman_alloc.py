# 10,000 updates and conversions of the quaternion Kalman filter, six and nine axes, with the heap locked, then again
# with the allocated bytes counted. Arguments: [float | list]: also do something in every step that allocates, to show
# that it is caught.

import gc
import sys
from array import array

import micropython
from upright.quaternion_kalman import QuaternionKalman6, QuaternionKalman9

UPDATES = 10000
waste = sys.argv[1] if len(sys.argv) > 1 else ""


def row(*values):
    return array("h", values)


# level, turning, upside down, free fall, full scale, stale; the magnetometer as usual, none, another, at full scale
ROWS = (
    row(0, 0, 4096, 10, -10, 5, 66, 10, -150, 0, 3),
    row(2000, -3000, 1500, 3000, -2000, 500, 66, 10, -150, 0, 1),
    row(-900, 100, -4000, -300, 20, 32767, 0, 0, 0, 0, 11),
    row(0, 0, 0, 0, 0, 0, -16, 0, 0, 0, 3),
    row(32767, -32768, 32767, -32768, 32767, -32768, 32766, 32766, -32767, 0, 7),
    row(32767, -32768, 32767, 32767, 32767, 32767, 32767, 0, 0, 0, 3),
    row(100, 200, 4000, 1000, -1000, 1000, -10, -70, 140, 0, 2),
)
filters = (
    QuaternionKalman9(1000, (82, 5), 4096, bias_start=10),
    QuaternionKalman9(100, (131, 1), 16384),
    QuaternionKalman6(200, (82, 5), 4096),
    QuaternionKalman9((2000, 7), (82, 5), 2048, rest_noise=0.01),
)
for f in filters:
    f.set_bias(100, -200, 300)
    f.seed(ROWS[0])
filters[1].set_quaternion(0, 1, 1, 0)  # a wrong start
quaternion = array("i", [0, 0, 0, 0])
angles = array("i", [0, 0, 0])


def run(n):
    i = 0
    k = 0
    while n:
        filter = filters[n & 3]
        filter.update(ROWS[i])
        filter.quaternion(quaternion)
        filter.angles(angles)
        if filter.resting and filter.mag_accepted:
            angles[0] = 1
        if waste == "float":
            abs(n * 0.5)
        elif waste == "list":
            len([n])
        # a while of rest, then everything at once
        k += 1
        if k == 2000:
            k = 0
        if k > 800:
            i += 1
            if i == 7:
                i = 0
        else:
            i = 0
        n -= 1


run(50)
micropython.heap_lock()
try:
    run(UPDATES)
    print("locked: nothing allocated")
except MemoryError:
    print("locked: MemoryError")
finally:
    micropython.heap_unlock()

if hasattr(gc, "mem_alloc"):
    before = 0  # a new name could make the table of names grow, and that would be counted
    gc.collect()
    gc.disable()
    before = gc.mem_alloc()
    run(1000)
    print("bytes allocated:", gc.mem_alloc() - before)
