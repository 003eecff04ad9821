# Runs a filter of the registry straight over the rows of an .imu file and writes for every row little-endian int32: the
# attitude (4, Q29), the gyro's bias (3, 1/256 count), and the words of the state that are asked for; then prints the
# rows and all words of the state. The same bytes on every runtime.
# Arguments: WORLD.imu OUT NAME OPTIONS, a file of JSON: gains {}, bias [x, y, z] in 1/256 count, start [w, x, y, z]
# (default: seed), mag_every: every so many of the rows whose flags are 0 has a fresh magnetometer (0: none); words
# [place ...]; only [place, value]: no row is written but where that word has that value.

import json
import sys
from array import array

from upright import filters
from world import WORDS, World

path, out, name, options = sys.argv[1:5]
world = World(path)
with open(options) as file:
    options = json.load(file)
filter = filters.make(name, world.rate, world, options.get("gains", {}))
if options.get("bias"):
    filter.set_bias(*options["bias"])
start = options.get("start")
mag_every = options.get("mag_every", 1)
words = options.get("words", [])
only = options.get("only")

ROWS = 256  # written at once
counts = array("h", bytes(2 * WORDS))
bias = array("i", [0, 0, 0])
width = 7 + len(words)
block = array("i", bytes(4 * width * ROWS))
view = memoryview(block)
state = filter.state
filled = 0
with open(out, "wb") as file:
    for k in range(world.n):
        world.load(k, counts)
        if counts[10] == 0:
            counts[10] = 3 if mag_every and k % mag_every == 0 else 1
        # full scale is judged here, as a driver does
        for i in range(3):
            if counts[i] == -32768 or counts[i] == 32767:
                counts[10] |= 4
        if k == 0:
            if start:
                filter.set_quaternion(*start)
            else:
                filter.seed(counts)
        filter.update(counts)
        if only and (state[only[0]] != only[1] or not counts[10] & 1):
            continue
        filter.bias(bias)
        for i in range(4):
            block[filled + i] = state[1 + i]
        for i in range(3):
            block[filled + 4 + i] = bias[i]
        i = filled + 7
        for word in words:
            block[i] = state[word]
            i += 1
        filled += width
        if filled == width * ROWS:
            file.write(block)
            filled = 0
    file.write(view[:filled])
print(world.n, *list(state))
