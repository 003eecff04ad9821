# 10,000 updates and conversions of the six- and the nine-axis filter with the heap locked, then again
# with the allocated bytes counted.
# Arguments: [float | list]: also do something in every step that allocates, to show that it is
# caught.

import gc
import sys
from array import array

import micropython
from upright import fixmath
from upright.mahony import Mahony6, Mahony9

UPDATES = 10000
waste = sys.argv[1] if len(sys.argv) > 1 else ""


def row(*values):
    return array("h", values)


# level, tilted, upside down, free fall, accelerometer and gyro at full scale, stale; the magnetometer
# fresh, not fresh, none, weak, strong, at full scale
ROWS = (
    row(0, 0, 4096, 10, -10, 5, 66, 10, -150, 0, 3),
    row(2000, -3000, 1500, 3000, -2000, 500, 66, 10, -150, 0, 1),
    row(-900, 100, -4000, -300, 20, 32767, 0, 0, 0, 0, 11),
    row(0, 0, 0, 0, 0, 0, -16, 0, 0, 0, 3),
    row(32767, -32768, 32767, -32768, 32767, -32768, 32766, 32766, -32767, 0, 7),
    row(32767, -32768, 32767, 32767, 32767, 32767, 32767, 0, 0, 0, 3),
    row(100, 200, 4000, 1000, -1000, 1000, -10, -70, 140, 0, 2),
)
filter = Mahony6(200, (82, 5), 4096, 1, 0.1)
nine = Mahony9(1000, (82, 5), 4096, 1, 0.1)
for f in (filter, nine):
    f.set_bias(100, -200, 300)
    f.seed(ROWS[0])
quaternion = array("i", [0, 0, 0, 0])
angles = array("i", [0, 0, 0])


def run(n):
    i = 0
    while n:
        filter.update(ROWS[i])
        nine.update(ROWS[i])
        nine.quaternion(quaternion)
        filter.quaternion(quaternion)
        filter.angles(angles)
        fixmath.euler(quaternion, angles, "zxy")
        if waste == "float":
            abs(n * 0.5)
        elif waste == "list":
            len([n])
        i += 1
        if i == 7:
            i = 0
        n -= 1


run(7)
micropython.heap_lock()
try:
    run(UPDATES)
    print("locked: nothing allocated")
except MemoryError:
    print("locked: MemoryError")
finally:
    micropython.heap_unlock()

if hasattr(gc, "mem_alloc"):
    gc.collect()
    gc.disable()
    before = gc.mem_alloc()
    run(1000)
    print("bytes allocated:", gc.mem_alloc() - before)
