# Runs a filter of complementary.py or kalman.py straight over the rows of an .imu file and writes every attitude, 4
# little-endian int32 (Q29) a row; then prints all words of its state. The same on every runtime.
# Arguments: WORLD.imu OUT MODULE CLASS GAINS (JSON, the filter's own) [BIAS_X BIAS_Y BIAS_Z in 1/256 count]

import json
import sys
from array import array

from world import WORDS, World

path, out, module, kind, gains = sys.argv[1:6]
world = World(path)
kind = getattr(__import__("upright." + module, None, None, (kind,)), kind)
filter = kind(world.rate, world.gyro_scale, world.accel_lsb_per_g, **json.loads(gains))
if len(sys.argv) > 6:
    filter.set_bias(int(sys.argv[6]), int(sys.argv[7]), int(sys.argv[8]))

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
        if k == 0:
            filter.seed(counts)
        filter.update(counts)
        filter.quaternion(quaternion)
        for i in range(4):
            block[filled + i] = quaternion[i]
        filled += 4
        if filled == 4 * ROWS:
            file.write(block)
            filled = 0
    file.write(view[:filled])
print(world.n, *list(filter.state))
