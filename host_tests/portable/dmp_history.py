# 800 packets of both layouts through the tick, with and without a turned board: a checksum of all words after
# each, and some of them in full. Needs only lib/; prints the same on every runtime.

import sys
from binascii import crc32

# CPython and a compiled main program leave their folder out of the path.
sys.path.append(__file__.rsplit("/", 1)[0] if "/" in __file__ else ".")

from array import array

from dmp_bus import make

for version in (0, 1):
    for axes in (("x", "y", "z"), ("y", "-x", "z"), ("z", "x", "y"), ("-y", "-x", "-z")):
        bus, dmp = make(version, axes)
        q30, q29, angles = array("i", [0] * 4), array("i", [0] * 4), array("i", [0] * 3)
        check = 0
        for i in range(800):
            bus.level = (1 + i % 5) * len(bus.packet) + (i % 7 == 3)
            flags = dmp.read()
            dmp.q30(q30)
            dmp.quaternion(q29)
            dmp.angles(angles)
            for words in (q30, q29, angles, dmp.counts):
                check = crc32(bytes(words), check)
            if i % 200 == 199:
                print(version, axes, flags, list(q30), list(q29), list(angles), list(dmp.counts))
        print(
            "%08x" % (check & 0xFFFFFFFF), dmp.skipped, dmp.misaligned, dmp.stale, list(dmp.state)
        )
