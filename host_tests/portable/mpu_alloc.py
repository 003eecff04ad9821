# Does the tick of an IMU's driver allocate? Ticks of read, FIFO drain, health and repair, with the heap locked and with
# it open. Arguments: mpu6050 (on I2C), or mpu6500 (on SPI, with bytes of an auxiliary bus behind each sample; and which
# clocks does it choose?). Needs only lib/; runs on every MicroPython. Exits with 1 if one failed.

import sys

import allocation
from memory_chip import Chip, SPIChip
from upright.mpu6050 import HEALTH_MISMATCH, HEALTH_REPAIRING, MPU6050
from upright.mpu6500 import MPU6500

ON_SPI = sys.argv[1] == "mpu6500"
TICKS = 4_000 if ON_SPI else 10_000
AUX = 7 if ON_SPI else 0
PACKET = 14 + AUX


class AllocatesInit(SPIChip):
    """A port whose init() takes memory."""

    def init(self, baudrate):
        self.kept = [baudrate]
        SPIChip.init(self, baudrate)


class FixedClock(SPIChip):
    """A bus that cannot be clocked anew."""

    def init(self, baudrate):
        raise NotImplementedError


class Behind:
    """What stands behind each sample."""

    def __init__(self):
        self.taken = 0
        self.looks = 0

    def take(self, raw, at, counts):
        self.taken = (self.taken + 1) & 0xFFFF
        counts[6] = raw[at]
        return 2 if raw[at] & 1 else 0

    def health(self):
        self.looks += 1
        return 0


class Ticks:
    def __init__(self, faults):
        self.faults = faults
        self.behind = Behind()
        if ON_SPI:
            self.bus = SPIChip(PACKET)  # what the driver finds when it measures one
            self.imu = MPU6500(self.bus, self.bus)
        else:
            self.bus = Chip()
            self.imu = MPU6050(self.bus, 0x68)
        self.imu.configure(sample_rate_hz=1000, settle=False)
        self.imu.monitor.settle_ms = 0  # the ticks come as fast as they can
        if ON_SPI:
            self.imu.attach(self.behind, AUX)
            self.imu.set_rows([(0x25, 0x8E, 0xFF), (0x34, 9, 0x1F)])
            self.imu.set_user_ctrl(0x20, 0x20)
        self.fresh = 0
        self.mismatches = 0
        self.repairs = 0

    def break_bus(self, i):
        self.bus.fail = self.faults and i % 10 == 7
        if ON_SPI:
            self.bus.dead = self.faults and i % 10 == 9

    def read(self, i):
        self.bus.status = 0 if i % 10 == 3 else 1
        self.break_bus(i)
        self.fresh += self.imu.read() & 1
        self.imu.temperature_cdeg()

    def fifo(self, i):
        self.bus.status = 0x11 if i % 10 == 3 else i % 10 != 5
        self.break_bus(i)
        self.bus.level = (i & 7) * PACKET + (1 if i % 5 == 4 else 0)
        for _ in range(self.imu.fifo_poll()):
            self.fresh += self.imu.fifo_next() & 1

    def health(self, i):
        self.break_bus(i)
        if i % (250 if ON_SPI else 100) == 50:
            self.bus.memory[0x1B] = 0
        self.read(i)
        state = self.imu.health()
        self.mismatches += state == HEALTH_MISMATCH
        self.repairs += state == HEALTH_REPAIRING

    # Twins that must be found out

    def keeps_a_bound_method(self, i):
        method = self.imu.temperature_cdeg
        method()

    def has_a_large_frame(self, i):
        a = b = c = d = e = f = g = h = k = m = n = o = p = i
        self.fresh = (a + b + c + d + e + f + g + h + k + m + n + o + p) & 1
        self.imu.read()


verdict = allocation.Verdict()
for name in ("read", "fifo", "health"):
    for faults in (True, False):
        ticks = Ticks(faults)
        if name == "fifo":
            ticks.imu.fifo_enable()
        judged = allocation.judge(ticks, getattr(ticks, name), TICKS)
        bus, imu = ticks.bus, ticks.imu
        ok = ticks.fresh > TICKS // 10
        if name == "health":
            ok = ok and ticks.repairs > TICKS // (20 if ON_SPI else 10)
        if ON_SPI:
            ok = ok and ticks.behind.taken > TICKS // 10 and not bus.too_fast and not bus.selected
            ok = ok and (name != "health" or ticks.behind.looks > TICKS // 10)
        said = "fresh", ticks.fresh, "errors", imu.errors, "overflows", imu.fifo_overflows
        said += "repairs", ticks.mismatches, "looks", ticks.behind.looks
        verdict.ticks(name, ticks, judged, ok, *said)
ticks = Ticks(False)
verdict.twin("a bound method", allocation.locked(ticks.keeps_a_bound_method, 1) is not None)
verdict.twin("a large frame", allocation.borrowed(ticks.bus, ticks.has_a_large_frame, 1, 45) > 0)
KINDS = ((SPIChip, 10_000_000), (AllocatesInit, 1_000_000), (FixedClock, 0))
for kind, hz in KINDS if ON_SPI else ():
    bus = kind(PACKET)
    imu = MPU6500(bus, bus)
    imu.configure(settle=False)
    ok = imu.burst_hz == hz and imu.read() & 1 and not bus.too_fast
    before = bus.inits
    imu.read()
    imu.health()
    ok = ok and bus.inits - before == (1 if hz > 1_000_000 else 0)
    verdict.say("bursts on %s at %d Hz:" % (kind.__name__, imu.burst_hz), ok)
verdict.end()
