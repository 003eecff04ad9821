# Does the MPU6050 driver's tick allocate? 10,000 ticks each of read, FIFO drain, health and repair,
# with the heap locked and with it open. Needs only lib/; runs on every MicroPython. Prints a line
# each, and exits with 1 if one failed.

import gc
import sys

# CPython and a compiled main program leave their folder out of the path.
sys.path.append(__file__.rsplit("/", 1)[0] if "/" in __file__ else ".")

from allocation import borrowed, grown, locked
from upright.mpu6050 import HEALTH_MISMATCH, HEALTH_REPAIRING, MPU6050

TICKS = 10_000

if not hasattr(gc, "mem_alloc"):
    raise SystemExit("CPython has no heap to lock")


class Registers:
    """A bus with one chip on it that is nothing but memory: no call here allocates, if it raises
    nothing."""

    def __init__(self):
        self.memory = bytearray(128)
        self.memory[0x75] = 0x68
        self.status = 1
        self.level = 3 * 14
        self.fail = 0
        self.word = 0
        self.watch = False
        self.peak = 0
        self.looks = bytearray(128)

    def readfrom_mem_into(self, address, register, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(register)
        if register == 0x72:
            buffer[0] = self.level >> 8
            buffer[1] = self.level & 0xFF
        elif register == 0x74 or len(buffer) == 15:
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

    def writeto(self, address, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(buffer[0])
        value = buffer[1]
        if buffer[0] == 0x6B:
            value &= 0x7F
        elif buffer[0] == 0x6A:
            value &= 0xF8
        self.memory[buffer[0]] = value


class Ticks:
    def __init__(self, faults):
        self.bus = Registers()
        self.imu = MPU6050(self.bus, 0x68)
        self.imu.configure(sample_rate_hz=1000, settle=False)
        self.faults = faults
        self.fresh = 0
        self.mismatches = 0
        self.repairs = 0

    def read(self, i):
        self.bus.status = 0 if i % 10 == 3 else 1
        self.bus.fail = self.faults and i % 10 == 7
        self.fresh += self.imu.read() & 1
        self.imu.temperature_cdeg()

    def fifo(self, i):
        self.bus.status = 0x11 if i % 10 == 3 else i % 10 != 5
        self.bus.fail = self.faults and i % 10 == 7
        self.bus.level = (i & 7) * 14 + (1 if i % 5 == 4 else 0)
        for _ in range(self.imu.fifo_poll()):
            self.fresh += self.imu.fifo_next() & 1

    def health(self, i):
        self.bus.fail = self.faults and i % 10 == 7
        if i % 100 == 50:
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
            busy = ticks.fresh > TICKS // 10 and (name != "health" or ticks.repairs > TICKS // 10)
            ok = raised is None and taken == 0 and busy
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
            )
    ticks = Ticks(False)
    found = locked(ticks.keeps_a_bound_method, 1) is not None
    print("twin with a bound method:", "found" if found else "MISSED")
    bad += not found
    found = borrowed(ticks.bus, ticks.has_a_large_frame, 1, 45) > 0
    print("twin with a large frame:", "found" if found else "MISSED")
    bad += not found
    sys.exit(1 if bad else 0)


main()
