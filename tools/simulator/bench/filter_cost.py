# What one filter of the registry costs, and how soon it finds up: for `upright compare`. Runs on every runtime.
# The time it takes is no matter here. Arguments: MODE FILTER, then
#
#   warm   FILE               writes the state after WARM updates, when its start is over
#   trace  N FILE             goes on from there: says where N updates begin and end, for whoever counts instructions
#   alloc  N                  prints the bytes that N updates allocate; nothing where the port does not tell
#   settle NUM/DEN NUM/DEN G  rate in Hz, LSB per deg/s, LSB per g: prints how many updates pass until the tilt stays
#                             within 2 deg of the truth, "never" when it does not do so in 60 s

import gc
import sys
from array import array

from upright import filters

RATE = (200, 1)
WARM = 2000  # updates before anything is counted: 10 s
WRONG = (70711, 50000, 50000, 0)  # 90 deg about the horizontal axis between x and y
SECONDS = 60
NEAR = 3.0458649e-4  # sin(2 deg / 2)**2


class Scales:
    """What a filter wants to know of a sensor."""

    def __init__(self, gyro_scale, accel_lsb_per_g):
        self.gyro_scale = gyro_scale
        self.accel_lsb_per_g = accel_lsb_per_g


def wobble():
    """16 samples of a slow wobble with noise, at +-8 g and +-2000 deg/s; the magnetometer is fresh in every 8th."""
    seed = 1
    rows = []
    for k in range(16):
        lean = 600 * (k if k < 8 else 16 - k) - 2400
        row = [lean, lean // 2, 4096 - lean * lean // 8192, 900 - 8 * lean // 25, lean // 9, 160]
        for i in range(6):
            seed = (seed * 75 + 74) % 65537
            row[i] += seed % 41 - 20
        rows.append(array("h", row + [82, 5 * k, -141, -521, 1 if k & 7 else 3]))
    return tuple(rows)


ROWS = wobble()


def loop_empty(filter, n):
    i = 0
    while i < n:
        ROWS[i & 15]
        i += 1


def loop_update(filter, n):
    i = 0
    while i < n:
        filter.update(ROWS[i & 15])
        i += 1


def made(name):
    return filters.make(name, RATE, Scales((82, 5), 4096), {})


def warmed(name):
    filter = made(name)
    filter.seed(ROWS[0])
    loop_update(filter, WARM)
    return filter


def warm(name, file):
    with open(file, "wb") as f:
        f.write(warmed(name).state)


def trace(name, n, file):
    filter = made(name)
    with open(file, "rb") as f:
        f.readinto(filter.state)
    gc.collect()
    gc.disable()
    for part, loop in (("empty", loop_empty), ("update", loop_update)):
        for steps in (0, int(n)):
            # each in one write: between two there would be lines of the trace
            print("@begin %s %d\n" % (part, steps), end="")
            loop(filter, steps)
            print("@end %s %d\n" % (part, steps), end="")


def alloc(name, n):
    if not hasattr(gc, "mem_alloc"):
        return
    filter = warmed(name)
    gc.collect()
    gc.disable()
    before = gc.mem_alloc()
    loop_update(filter, int(n))
    print(gc.mem_alloc() - before)


def settle(name, rate, gyro_scale, accel_lsb_per_g):
    rate, gyro_scale = [tuple([int(v) for v in text.split("/")]) for text in (rate, gyro_scale)]
    g = int(accel_lsb_per_g)
    filter = filters.make(name, rate, Scales(gyro_scale, g), {})
    filter.set_quaternion(*WRONG)
    # at rest, level, x to the north, in the field of central Europe
    level = array("h", [0, 0, g, 0, 0, 0, 66, 0, -150, -3920, 3])
    n = SECONDS * rate[0] // rate[1]
    far = -1  # the newest update that left it wrong
    for k in range(n):
        filter.update(level)
        _, x, y, _ = filter.quaternion_floats()
        if x * x + y * y > NEAR:
            far = k
    print(far + 1 if far < n - 1 else "never")


MODES = {"warm": warm, "trace": trace, "alloc": alloc, "settle": settle}
MODES[sys.argv[1]](*sys.argv[2:])
