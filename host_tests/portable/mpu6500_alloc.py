# Does the MPU6500 driver's tick allocate on SPI? 4,000 ticks each of read, FIFO drain and health, with bytes of an
# auxiliary bus behind each sample, with the heap locked and with it open; and which clocks does it choose? Needs only
# lib/; runs on every MicroPython. Prints a line each, and exits with 1 if one failed.

import gc
import sys

# CPython and a compiled main program leave their folder out of the path.
sys.path.append(__file__.rsplit("/", 1)[0] if "/" in __file__ else ".")

from allocation import borrowed, grown, locked
from upright.mpu6500 import HEALTH_MISMATCH, HEALTH_REPAIRING, MPU6500

TICKS = 4_000
EXT = 7
PACKET = 14 + EXT

if not hasattr(gc, "mem_alloc"):
    raise SystemExit("CPython has no heap to lock")


class Registers:
    """An SPI bus with one chip on it that is nothing but memory, and its chip select. No call allocates, if it raises
    nothing."""

    def __init__(self):
        self.memory = bytearray(128)
        self.memory[0x75] = 0x70
        self.status = 1
        self.level = PACKET  # what the driver finds when it measures one
        self.fail = 0
        self.dead = 0  # 1: nobody drives MISO
        self.word = 0
        self.register = 0
        self.hz = 0
        self.inits = 0
        self.too_fast = 0
        self.selected = 0
        self.watch = False
        self.peak = 0
        self.looks = bytearray(256)

    def __call__(self, level):
        self.selected = not level

    def init(self, baudrate):
        self.hz = baudrate
        self.inits = (self.inits + 1) & 0xFFFF

    def write(self, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(buffer[0])
        self.register = buffer[0] & 0x7F
        if len(buffer) > 1:
            self.too_fast += self.hz > 1_000_000
            value = buffer[1]
            if buffer[0] == 0x6B:
                value &= 0x7F
            elif buffer[0] == 0x6A:
                value &= 0xE8
            self.memory[buffer[0]] = value

    def readinto(self, buffer, write=0):
        register = self.register
        self.too_fast += self.hz > 1_000_000 and not 0x3A <= register < 0x61
        if self.dead:
            for i in range(len(buffer)):
                buffer[i] = 0xFF
        elif register == 0x72:
            buffer[0] = self.level >> 8
            buffer[1] = self.level & 0xFF
        elif register == 0x74 or len(buffer) > 2:
            buffer[0] = self.status
            buffer[1] = self.word = (self.word + 37) & 0xFF
            buffer[8] = self.word
        elif register == 0x3A:
            buffer[0] = self.status
        else:
            for i in range(len(buffer)):
                buffer[i] = self.memory[register + i]

    def look(self, register):
        # twice for every register: asking takes long, as it counts the whole heap
        if self.looks[register] > 1:
            return
        self.looks[register] += 1
        taken = gc.mem_alloc()
        if taken > self.peak:
            self.peak = taken


class Allocates(Registers):
    """A port whose init() takes memory."""

    def init(self, baudrate):
        self.kept = [baudrate]
        Registers.init(self, baudrate)


class Fixed(Registers):
    """A bus that cannot be clocked anew."""

    def init(self, baudrate):
        raise NotImplementedError


class Ext:
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
        self.bus = Registers()
        self.imu = MPU6500(self.bus, self.bus)
        self.imu.configure(sample_rate_hz=1000, settle=False)
        self.ext = Ext()
        self.imu.attach(self.ext, EXT)
        self.imu.set_rows([(0x25, 0x8E, 0xFF), (0x34, 9, 0x1F)])
        self.imu.set_user_ctrl(0x20, 0x20)
        self.faults = faults
        self.fresh = 0
        self.mismatches = 0
        self.repairs = 0

    def break_bus(self, i):
        self.bus.fail = self.faults and i % 10 == 7
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
        if i % 250 == 50:
            self.bus.memory[0x1B] = 0
        self.read(i)
        state = self.imu.health()
        self.mismatches += state == HEALTH_MISMATCH
        self.repairs += state == HEALTH_REPAIRING

    # A twin that must be found out

    def keeps_a_bound_method(self, i):
        method = self.imu.temperature_cdeg
        method()


def main():
    bad = 0
    for name in ("read", "fifo", "health"):
        for faults in (True, False):
            ticks = Ticks(faults)
            if name == "fifo":
                ticks.imu.fifo_enable()
            tick = getattr(ticks, name)
            raised = locked(tick, TICKS) if faults else None
            taken = 0
            if not faults:  # raising takes memory where there is some
                taken = grown(tick, TICKS) + borrowed(ticks.bus, tick, 30, 45)
            busy = ticks.fresh > TICKS // 10 and ticks.ext.taken > TICKS // 10
            if name == "health":
                busy = busy and ticks.repairs > TICKS // 20 and ticks.ext.looks > TICKS // 10
            ok = raised is None and taken == 0 and busy
            ok = ok and not ticks.bus.too_fast and not ticks.bus.selected
            bad += not ok
            print(
                name,
                "with faults:" if faults else "without:",
                "ok" if ok else "ALLOCATES",
                taken,
                "fresh",
                ticks.fresh,
                "errors",
                ticks.imu.errors,
                "overflows",
                ticks.imu.fifo_overflows,
                "repairs",
                ticks.mismatches,
                "ext",
                ticks.ext.looks,
            )
    ticks = Ticks(False)
    found = locked(ticks.keeps_a_bound_method, 1) is not None
    print("twin with a bound method:", "found" if found else "MISSED")
    bad += not found
    for bus, expected in ((Registers(), 10_000_000), (Allocates(), 1_000_000), (Fixed(), 0)):
        imu = MPU6500(bus, bus)
        imu.configure(settle=False)
        ok = imu.burst_hz == expected and imu.read() & 1 and not bus.too_fast
        before = bus.inits
        imu.read()
        imu.health()
        ok = ok and bus.inits - before == (1 if expected > 1_000_000 else 0)
        bad += not ok
        print("bursts on", type(bus).__name__, "at", imu.burst_hz, "Hz:", "ok" if ok else "WRONG")
    sys.exit(1 if bad else 0)


main()
