# Does the tick of the DMP's driver allocate? Ticks of reading, converting and health, 10,000 of them with faults, with
# the heap locked and with it open. Needs only lib/; runs on every MicroPython. Exits with 1 if one failed.

import gc
import sys

# CPython and a compiled main program leave their folder out of the path.
sys.path.append(__file__.rsplit("/", 1)[0] if "/" in __file__ else ".")

from allocation import borrowed, grown, locked
from dmp_bus import OUT, make

TICKS = 10_000


class Ticks:
    def __init__(self, version, axes, faults):
        self.bus, self.dmp = make(version, axes)
        self.bus.look = self.look
        self.size = len(self.bus.packet)
        self.faults = faults
        self.looks = bytearray(128)
        self.fresh = 0

    def look(self, register):
        # twice for every register: asking takes long, as it counts the whole heap
        if self.looks[register] > 1:
            return
        self.looks[register] += 1
        taken = gc.mem_alloc()
        if taken > self.bus.peak:
            self.bus.peak = taken

    def tick(self, i):
        bus = self.bus
        dmp = self.dmp
        bus.level = (i & 3) * self.size + (5 if i % 11 < 9 and i & 64 else 0)
        bus.status = 0x11 if i % 10 == 3 else 1
        if self.faults:
            bus.fail = i % 10 == 7
            if i % 500 == 250:
                bus.memory[0x1B] = 0  # as a reset would
        self.fresh += dmp.read() & 1
        dmp.health()
        dmp.update(dmp.counts)
        dmp.quaternion(OUT)
        dmp.q30(OUT)
        dmp.angles(OUT, "zxy")
        if dmp.needs_reload:
            # what reload() ends with: the loading itself is not for a tick
            dmp.needs_reload = False
            dmp._off = 0

    # Twins that must be found out

    def keeps_a_bound_method(self, i):
        method = self.dmp.read
        method()

    def reads_one_in_q30(self, i):
        OUT[0] = OUT[1]
        word = self.dmp.state[5] * 0 + 0x7FFFFFFF - i
        OUT[0] = word


def main():
    bad = 0
    for version in (0, 1):
        for axes in (("x", "y", "z"), ("z", "-y", "x")):
            for faults in (True, False):
                ticks = Ticks(version, axes, faults)
                tick = ticks.tick
                n = TICKS if faults and axes[0] == "x" and not version else TICKS // 10
                raised = locked(tick, n) if faults else None
                taken = 0
                if not faults:  # raising takes memory where there is some
                    taken = grown(tick, n) + borrowed(ticks.bus, tick, 30, 45)
                ok = raised is None and taken == 0 and ticks.fresh > n // 4
                bad += not ok
                print(
                    ticks.dmp.version,
                    axes,
                    "with faults:" if faults else "without:",
                    "ok" if ok else "ALLOCATES",
                    taken,
                    "fresh",
                    ticks.fresh,
                    "misaligned",
                    ticks.dmp.misaligned,
                    "overflows",
                    ticks.dmp.fifo_overflows,
                    "resets",
                    ticks.dmp.resets,
                )
    ticks = Ticks(0, ("x", "y", "z"), False)
    found = locked(ticks.keeps_a_bound_method, 1) is not None
    print("twin with a bound method:", "found" if found else "MISSED")
    bad += not found
    found = sys.maxsize > 1 << 32 or locked(ticks.reads_one_in_q30, 1) is not None
    print("twin with a large int:", "found" if found else "MISSED")
    bad += not found
    sys.exit(1 if bad else 0)


main()
