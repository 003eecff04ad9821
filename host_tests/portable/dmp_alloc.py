# Does the tick of the DMP's driver allocate? Ticks of reading, converting and health, 10,000 of them with faults, with
# the heap locked and with it open. Needs only lib/; runs on every MicroPython. Exits with 1 if one failed.

import sys

import allocation
from dmp_bus import OUT, make

TICKS = 10_000


class Ticks:
    def __init__(self, version, axes, faults):
        self.bus, self.dmp = make(version, axes)
        self.size = len(self.bus.packet)
        self.faults = faults
        self.fresh = 0

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
            dmp._imu.table.change_last(0xC0, 0xC0)  # USER_CTRL: DMP_EN, FIFO_EN
            bus.memory[0x6A] |= 0xC0

    # Twins that must be found out

    def keeps_a_bound_method(self, i):
        method = self.dmp.read
        method()

    def reads_one_in_q30(self, i):
        OUT[0] = OUT[1]
        word = self.dmp.state[5] * 0 + 0x7FFFFFFF - i
        OUT[0] = word


verdict = allocation.Verdict()
for version in (0, 1):
    for axes in (("x", "y", "z"), ("z", "-y", "x")):
        for faults in (True, False):
            ticks = Ticks(version, axes, faults)
            n = TICKS if faults and axes[0] == "x" and not version else TICKS // 10
            judged = allocation.judge(ticks, ticks.tick, n)
            dmp = ticks.dmp
            said = "fresh", ticks.fresh, "misaligned", dmp.misaligned
            said += "overflows", dmp.fifo_overflows, "resets", dmp.resets
            verdict.ticks("%s %s" % (dmp.version, axes), ticks, judged, ticks.fresh > n // 4, *said)
ticks = Ticks(0, ("x", "y", "z"), False)
verdict.twin("a bound method", allocation.locked(ticks.keeps_a_bound_method, 1) is not None)
large = sys.maxsize > 1 << 32 or allocation.locked(ticks.reads_one_in_q30, 1) is not None
verdict.twin("a large int", large)
verdict.end()
