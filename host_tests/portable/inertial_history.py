# Runs InertialMahony straight over the rows of an .imu file and writes for every row 8 little-endian int32: the
# attitude (Q29), the gyro's bias (1/256 count), and the filter's yes/no decisions. Arguments: WORLD.imu OUT AXES LITE
# MAG_EVERY, then any of q=W,X,Y,Z (start there; default: seed), bias=X,Y,Z, NAME=VALUE. Rows whose flags are 0 are
# taken as fresh, every MAG_EVERY-th with a fresh magnetometer. The same bytes on every runtime.

import sys
from array import array

from upright.inertial import InertialMahony
from world import WORDS, World

path, out, axes, lite, mag_every = sys.argv[1:6]
world = World(path)
start = bias = None
parameters = {}
for argument in sys.argv[6:]:
    name, value = argument.split("=")
    if name == "q":
        start = [int(v) for v in value.split(",")]
    elif name == "bias":
        bias = [int(v) for v in value.split(",")]
    else:
        parameters[name] = float(value)
filter = InertialMahony(
    world.rate, world.gyro_scale, world.accel_lsb_per_g, int(axes), lite == "1", **parameters
)
DECIDED = 55  # inertial_kernels._DECIDED
ROWS = 256  # written at once
counts = array("h", bytes(2 * WORDS))
block = array("i", bytes(4 * 8 * ROWS))
view = memoryview(block)
learnt = array("i", [0, 0, 0])
state = filter.state
filled = 0
mag_every = int(mag_every)
if bias:
    filter.set_bias(*bias)
with open(out, "wb") as file:
    for k in range(world.n):
        world.load(k, counts)
        if counts[10] == 0:
            counts[10] = 3 if k % mag_every == 0 else 1
        if k == 0:
            if start:
                filter.set_quaternion(*start)
            else:
                filter.seed(counts)
        filter.update(counts)
        filter.bias(learnt)
        for i in range(4):
            block[filled + i] = state[1 + i]
        for i in range(3):
            block[filled + 4 + i] = learnt[i]
        block[filled + 7] = state[DECIDED]
        filled += 8
        if filled == 8 * ROWS:
            file.write(block)
            filled = 0
    file.write(view[:filled])
print(world.n)
