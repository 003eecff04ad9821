# The machine mock's facts that matter most, on whatever runtime this is.

import time

import kernel
import machine


class Echo:
    address = 0x50

    def __init__(self):
        self.pointer = 0

    def i2c_start(self, read, now):
        self.first = not read
        return True

    def i2c_write(self, byte, now):
        if self.first:
            self.pointer = byte
        return True

    def i2c_read(self, now):
        self.pointer += 1
        return self.pointer - 1

    def i2c_stop(self, now):
        pass


bus = machine.wire_i2c(0, Echo())
i2c = machine.I2C(0, freq=400000)
print("read", i2c.readfrom_mem(0x50, 0x10, 2), "at", kernel.now())

buf = bytearray(14)
count = 0


def sample(timer):
    global count
    i2c.readfrom_mem_into(0x50, 0, buf)
    count += 1


timer = machine.Timer(freq=200, callback=sample, hard=True)
time.sleep_ms(1000)
print("ticks", count, "cuts", bus.cuts)

big = bytearray(400)  # 9 ms on the bus: a tick falls into it
spoilt = False
try:
    i2c.readfrom_mem_into(0x50, 0, big)
except OSError:
    spoilt = True
print("cut", spoilt, bus.cuts, len(kernel.uncaught))
timer.deinit()

half = 0.5
outcome = "none"


def use_float(timer):
    global outcome, half
    try:
        half = half * 0.5
        outcome = "allowed"
    except MemoryError:
        outcome = "refused"


machine.Timer(freq=200, callback=use_float, hard=True)
time.sleep_ms(7)
print("float in a hard callback", outcome)
