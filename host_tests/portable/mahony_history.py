# Runs a filter straight over the rows of an .imu file and writes every attitude, 4 little-endian
# int32 (Q29) a row; then prints all words of its state. The same on every runtime.
# Arguments: WORLD.imu OUT KP KI [BIAS_X BIAS_Y BIAS_Z in 1/256 count [EVERY]]. With EVERY it is
# Mahony9, and every EVERY-th row is a fresh magnetometer sample; without, Mahony6.

import sys
from array import array

from upright.mahony import Mahony6, Mahony9
from world import WORDS, World

path, out, kp, ki = sys.argv[1:5]
world = World(path)
every = int(sys.argv[8]) if len(sys.argv) > 8 else 0
kind = Mahony9 if every else Mahony6
mahony = kind(world.rate, world.gyro_scale, world.accel_lsb_per_g, float(kp), float(ki))
if len(sys.argv) > 5:
    mahony.set_bias(int(sys.argv[5]), int(sys.argv[6]), int(sys.argv[7]))

ROWS = 256  # written at once
counts = array("h", bytes(2 * WORDS))
quaternion = array("i", bytes(16))
block = array("i", bytes(16 * ROWS))
view = memoryview(block)
filled = 0
with open(out, "wb") as file:
    for k in range(world.n):
        world.load(k, counts)
        # a file's rows are fresh; full scale is judged here, as a driver does
        full = False
        for i in range(3):
            full = full or counts[i] == -32768 or counts[i] == 32767
        counts[10] |= 5 if full else 1
        if every and k % every == 0:
            counts[10] |= 2
        if k == 0:
            mahony.seed(counts)
        mahony.update(counts)
        mahony.quaternion(quaternion)
        for i in range(4):
            block[filled + i] = quaternion[i]
        filled += 4
        if filled == 4 * ROWS:
            file.write(block)
            filled = 0
    file.write(view[:filled])
print(world.n, *list(mahony.state))
