# Runs QuaternionKalman straight over the rows of an .imu file and writes for every row 8 little-endian int32: the
# attitude (Q29), the learnt bias (as in the state), and the filter's yes/no decisions; with cov=1 instead 46 words at
# each block's end: the attitude, the covariance's 36 words, bias, velocity, decisions. Arguments: WORLD.imu OUT AXES
# MAG_EVERY, then any of q=W,X,Y,Z (start there; default: seed), bias=X,Y,Z, NAME=VALUE. Rows whose flags are 0 are
# taken as fresh, every MAG_EVERY-th with a fresh magnetometer. The same bytes on every runtime.

import sys
from array import array

from upright.quaternion_kalman import QuaternionKalman
from world import WORDS, World

path, out, axes, mag_every = sys.argv[1:5]
world = World(path)
start = bias = None
cov = False
parameters = {}
for argument in sys.argv[5:]:
    name, value = argument.split("=")
    if name == "q":
        start = [int(v) for v in value.split(",")]
    elif name == "bias":
        bias = [int(v) for v in value.split(",")]
    elif name == "cov":
        cov = value == "1"
    else:
        parameters[name] = float(value)
filter = QuaternionKalman(
    world.rate, world.gyro_scale, world.accel_lsb_per_g, int(axes), **parameters
)
# words of the state: quaternion_kernels.py
PHASE, DECIDED, VELOCITY, BIAS, COVARIANCE = 48, 52, 85, 87, 90
ROWS = 256  # written at once
counts = array("h", bytes(2 * WORDS))
width = 46 if cov else 8
block = array("i", bytes(4 * width * ROWS))
view = memoryview(block)
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
        if cov and (state[PHASE] or not counts[10] & 1):
            continue
        for i in range(4):
            block[filled + i] = state[1 + i]
        if cov:
            for i in range(36):
                block[filled + 4 + i] = state[COVARIANCE + i]
            for i in range(3):
                block[filled + 40 + i] = state[BIAS + i]
            for i in range(2):
                block[filled + 43 + i] = state[VELOCITY + i]
            block[filled + 45] = state[DECIDED]
        else:
            for i in range(3):
                block[filled + 4 + i] = state[BIAS + i]
            block[filled + 7] = state[DECIDED]
        filled += width
        if filled == width * ROWS:
            file.write(block)
            filled = 0
    file.write(view[:filled])
print(world.n)
