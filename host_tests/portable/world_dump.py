# Prints what the world reads out of the .imu file named in the first argument: header, times, rows
# and checksums. Needs world.py on the path. The text is the same on every runtime.

import sys

import micropython
from world import WORDS, StillWorld, World

world = World(sys.argv[1])
print("name", world.name, "clocked", world.clocked)
print("rate", world.rate, "rows", world.n)
print("accel", world.accel_lsb_per_g, "gyro", world.gyro_scale)

# in order, as a run reads them; every step stays below 2**30
total = 0
for k in range(world.n):
    row = world.row(k)
    for i in range(WORDS):
        total = ((total * 31) ^ (row[i] & 0xFFFF)) & 0xFFFFFF
print("rows in order", hex(total))

# reading must go on where nothing can be allocated
micropython.heap_lock()
for k in range(min(world.n, 1000)):
    world.row(k)
micropython.heap_unlock()

# scattered, with a stride that is prime to the number of rows or nearly so
total = 0
k = 0
for _ in range(300):
    k = (k + 7919) % world.n
    row = world.row(k)
    for i in range(WORDS):
        total = ((total * 31) ^ (row[i] & 0xFFFF)) & 0xFFFFFF
print("rows scattered", hex(total))

for k in (0, 1, world.n // 2, world.n - 1, world.n + 5):
    print(k, world.time_us(k), " ".join(str(v) for v in world.row(k)))

bad = 0
for k in range(0, world.n, 37):
    us = world.time_us(k)
    if world.index(us) != k or (k and world.index(us - 1) != k - 1):
        bad += 1
print("times that do not lead back", bad)

print("before start", world.start_us, world.index_at(10**9), world.ended(10**9))
world.start(5000000)
last = 5000000 + world.time_us(world.n - 1)
end = 5000000 + world.time_us(world.n)
print("clamped", world.index_at(0), world.index_at(last), world.index_at(end + 10**9))
print("ended", world.ended(last), world.ended(end - 1), world.ended(end))
world.close()

still = StillWorld((1, 2, 3, -4))
print("still", " ".join(str(v) for v in still.row(99)), still.index(10**6), still.ended(10**9))
