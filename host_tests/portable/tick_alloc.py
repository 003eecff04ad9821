# Does the firmware's tick allocate? 10,000 ticks of every drive, whole: driver, filter, published state, display.
# With the heap locked, and with it open on a bus that itself allocates nothing; also what a tick borrows and gives
# back (a bytecode frame over 11 words). Runs on every MicroPython; exits with 1 if one failed.

import gc
import sys
from array import array

import micropython
import utime

sys.modules["time"] = utime  # the built-in one, also where the simulator's is on the path

from upright import tick as ticks  # noqa: E402
from upright.auxiliary_bus import AuxiliaryBus  # noqa: E402
from upright.calibration import Calibration  # noqa: E402
from upright.ist8310 import IST8310  # noqa: E402
from upright.mahony import Mahony6, Mahony9  # noqa: E402
from upright.mpu6050 import MPU6050  # noqa: E402
from upright.mpu6500 import MPU6500  # noqa: E402
from upright.ssd1306 import SSD1306  # noqa: E402

TICKS = 10000


class Bus:
    """An MPU6050 that is nothing but memory, and a display that takes all. No call here allocates."""

    def __init__(self):
        self.memory = bytearray(128)
        self.memory[0x75] = 0x68
        self.word = 0
        self.watching = False
        self.base = 0
        self.peak = 0

    def readfrom_mem_into(self, address, register, buffer):
        if register == 0x72:
            buffer[0] = 0
            buffer[1] = 42 if self.memory[0x6A] & 0x40 else 0
        elif register == 0x3A or register == 0x74:
            self.word = (self.word + 37) & 0xFF
            for i in range(len(buffer)):
                buffer[i] = 0
            buffer[0] = 1 if register == 0x3A else 0
            if len(buffer) > 2:
                buffer[1] = buffer[8] = self.word
        else:
            for i in range(len(buffer)):
                buffer[i] = self.memory[register + i]
        if self.watching:
            self.look()

    def writeto(self, address, buffer):
        if address == 0x68:
            self.memory[buffer[0]] = buffer[1] & 0x7F if buffer[0] == 0x6B else buffer[1]
        if self.watching:
            self.look()

    def look(self):
        taken = gc.mem_alloc() - self.base
        if taken > self.peak:
            self.peak = taken


class Spi(Bus):
    """The same for an MPU6500 on SPI, with an IST8310 behind its auxiliary master."""

    def __init__(self):
        Bus.__init__(self)
        self.memory[0x75] = 0x70
        self.mag = bytearray(128)
        self.mag[0x00] = 0x10
        self.at = 0

    def init(self, baudrate=0):
        pass

    def write(self, buffer):
        register = buffer[0] & 0x7F
        self.at = register
        if buffer[0] & 0x80:
            return
        if register == 0x34 and buffer[1] & 0x80:
            self.transact()
        elif register == 0x6B or register == 0x6A:
            self.memory[register] = buffer[1] & 0x78
            if register == 0x6B:
                self.memory[register] = buffer[1] & 0x7F
        elif register != 0x68:
            self.memory[register] = buffer[1]
        if self.watching:
            self.look()

    def transact(self):
        """SLV4, at once."""
        register = self.memory[0x32]
        self.memory[0x36] = 0x40
        if self.memory[0x31] & 0x80:
            self.memory[0x35] = self.mag[register]
        elif register == 0x0B and self.memory[0x33] & 1:
            self.mag[0x0B] = 0x0C
        else:
            self.mag[register] = self.memory[0x33]

    def readinto(self, buffer, out):
        self.readfrom_mem_into(0x68, self.at, buffer)
        if len(buffer) > 15:
            buffer[15] = 1 if self.word % 10 == 3 else 0  # DRDY
            buffer[16] = self.word


class FloatFilter(Mahony6):
    """The twin that must be found out: one float in the tick."""

    half = 0.5

    def update(self, counts):
        Mahony6.update(self, counts)
        FloatFilter.half = FloatFilter.half * 0.99


def build(kind):
    bus = Bus()
    imu = MPU6050(bus, 0x68)
    imu.configure(settle=False)
    filter = kind(1000, imu.gyro_scale, imu.accel_lsb_per_g, 0.5, 0.01)
    display = SSD1306(bus)
    display.begin()
    # ticks_us runs on: whether ticks were missed does not matter, coasting may not allocate either
    return bus, imu, display, ticks.Tick(imu, filter, 1000, display, 32)


out = array("i", [0] * ticks.SNAPSHOT_WORDS)
readings = []


def control(_):
    """All that a control loop may read in the tick."""
    tick = readings[0]
    tick.snapshot(out)
    tick.angles_into(out)
    tick.rates_into(out)


def build_nine():
    bus = Spi()
    imu = MPU6500(bus, no_select)
    imu.configure(settle=False)
    mag = IST8310(AuxiliaryBus(imu))
    mag.configure()
    filter = Mahony9(1000, imu.gyro_scale, imu.accel_lsb_per_g, 0.5, 0.01)
    calibration = Calibration(
        ("x", "y", "z"), ("y", "-x", "-z"), imu.accel_lsb_per_g, imu.gyro_scale
    )
    display = SSD1306(Bus())
    display.begin()
    calibration.set_level((100000, -200000, 974679))
    tick = ticks.Tick(imu, filter, 1000, display, 32, calibration=calibration, on_step=control)
    readings.append(tick)
    return bus, imu, display, tick, mag


def no_select(level):
    pass


def run(callback, display, n):
    for i in range(n):
        if not display.busy:
            display.fill(i & 1)  # drawing is the main program's, and may not allocate either
            display.show()
        callback(None)


def check(drive, nine=False):
    bus, imu, display, tick = build_nine()[:4] if nine else build(Mahony6)
    if drive == "on_fifo":
        imu.fifo_enable()
    callback = getattr(tick, drive)
    run(callback, display, 100)
    refused = 0
    micropython.heap_lock()
    try:
        run(callback, display, TICKS)
    except MemoryError:
        refused = 1
    micropython.heap_unlock()
    gc.collect()
    gc.disable()
    before = gc.mem_alloc()
    run(callback, display, TICKS // 5)
    grown = gc.mem_alloc() - before
    bus.base = gc.mem_alloc()
    bus.watching = True
    run(callback, display, 40)
    gc.enable()
    crashes = tick.crashes + tick.step_errors + refused
    steps = 0 if drive == "on_guard" else TICKS  # the guard makes none
    ok = not crashes and not grown and not bus.peak and tick.steps >= steps
    if nine:
        ok = ok and tick._filter.mag_age < 1000  # the magnetometer was used
    print(
        "nine_axes" if nine else drive,
        "ok" if ok else "ALLOCATES",
        "refused",
        crashes,
        "grown",
        grown,
        "borrowed",
        bus.peak,
    )
    return ok


def twin():
    _, _, display, tick = build(FloatFilter)
    run(tick.on_sample, display, 10)
    before = tick.crashes
    micropython.heap_lock()
    tick.on_sample(None)
    micropython.heap_unlock()
    found = tick.crashes > before
    print("a float in the tick:", "found" if found else "MISSED")
    return found


results = [check(drive) for drive in ("on_sample", "on_fifo", "on_guard")]
results += [check("on_sample", True), twin()]
sys.exit(0 if all(results) else 1)
