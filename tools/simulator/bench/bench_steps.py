# One step of everything that a tick does, many times over: for `upright bench` and its test. Runs on every runtime.
# The bus takes no time and gives the same sample each time, so that what is measured is this project's code; the calls
# of the bus are counted and measured by themselves. Arguments: MODE N [filters: only those two]
#
#   check N   N steps of each; prints what came of them, the same text on every runtime
#   calls N   prints the bus calls that N steps make: part, reads, writes
#   alloc N   prints the bytes that N steps allocate
#   time N    prints N lines a part: microseconds that BATCHES * STEPS steps took, by the real clock
#   trace N   says where a part's N steps begin and end, for whoever counts the instructions in between

import gc
import sys
from array import array

try:
    from utime import (
        ticks_diff,
        ticks_us,
    )  # the real clock, also where a file `time` is on the path
except ImportError:
    from time import ticks_diff, ticks_us

# CPython and a compiled main program leave their folder out of the path.
sys.path.append(__file__.rsplit("/", 1)[0] if "/" in __file__ else ".")

from float_mahony import FloatMahony
from upright.mahony import Mahony6, Mahony9

FILTERS_ONLY = sys.argv[3:] == ["filters"]  # a trace is slow, its start too
if not FILTERS_ONLY:
    from upright.calibration import Calibration
    from upright.mpu6050 import MPU6050
    from upright.ssd1306 import SSD1306
    from upright.tick import Tick

RATE = 200
GYRO_SCALE = (82, 5)  # +-2000 deg/s
ACCEL_LSB_PER_G = 4096  # +-8 g
KP = 0.5
KI = 0.01
STEPS = 32  # a frame of 128 x 64 in pieces of 32 bytes
LONGER = 8  # times N: long enough for a collection or two
BATCHES = 8  # frames a line of `time`


def samples():
    """16 samples of a slow wobble with noise, at +-8 g and +-2000 deg/s: the counts as a driver gives them."""
    seed = 1
    rows = []
    for k in range(16):
        lean = 600 * (k if k < 8 else 16 - k) - 2400
        row = [lean, lean // 2, 4096 - lean * lean // 8192, 900 - 8 * lean // 25, lean // 9, 160]
        for i in range(6):
            seed = (seed * 75 + 74) % 65537
            row[i] += seed % 41 - 20
        rows.append(array("h", row + [0, 0, 0, -521, 1]))
    return tuple(rows)


ROWS = samples()
# with a magnetometer that has a new measurement in every 8th sample
ROWS_9 = tuple(
    [
        array("h", list(ROWS[k][:6]) + [82, 5 * k, -141, -521, 1 if k & 7 else 3])
        for k in range(len(ROWS))
    ]
)


# ------------------------------------------------------------------------------------------ the bus
REGISTERS = bytearray(256)
REGISTERS[0x75] = 0x68  # WHO_AM_I
REGISTERS[0x3A] = 1  # INT_STATUS: a new sample
made = [0, 0]  # reads, writes
sample = bytearray(8)


class Bus:
    """The registers behind I2C, without a chip: enough for the set-up."""

    def readfrom_mem_into(self, address, register, buffer):
        for i in range(len(buffer)):
            buffer[i] = REGISTERS[register + i]

    def writeto(self, address, buffer):
        if buffer[0] != 0x6B or not buffer[1] & 0x80:  # DEVICE_RESET clears itself
            REGISTERS[buffer[0]] = buffer[1]


# What takes the place of its methods in the steps. Only the first byte changes between reads, and a bit of the sample:
# one that stayed the same for ever would be a chip that hangs.
def quick_read(address, register, buffer):
    sample[7] ^= 1
    buffer[0] = REGISTERS[register]


def quick_write(address, buffer):
    pass


def counted_read(address, register, buffer):
    made[0] += 1
    sample[7] ^= 1
    buffer[0] = REGISTERS[register]


def counted_write(address, buffer):
    made[1] += 1


# ------------------------------------------------------------------------------------------ what is measured
def put_word(at, value):
    REGISTERS[at] = value >> 8 & 255
    REGISTERS[at + 1] = value & 255


for _i in range(3):
    put_word(0x3B + 2 * _i, ROWS[3][_i])
    put_word(0x43 + 2 * _i, ROWS[3][3 + _i])
put_word(0x41, ROWS[3][9])

filter = Mahony6(RATE, GYRO_SCALE, ACCEL_LSB_PER_G, KP, KI)
filter_9 = Mahony9(RATE, GYRO_SCALE, ACCEL_LSB_PER_G, KP, KI)
tick_filter = Mahony6(RATE, GYRO_SCALE, ACCEL_LSB_PER_G, KP, KI)
floats = FloatMahony(RATE, GYRO_SCALE[0] / GYRO_SCALE[1], KP, KI)
angles = array("i", [0, 0, 0])
one = bytearray(1)
bus = Bus()
display_bus = Bus()
tick = None
colour = 0
if not FILTERS_ONLY:
    imu = MPU6050(bus, 0x68)
    imu.configure(8, 2000, sample_rate_hz=RATE, settle=False)
    imu.read()
    sample = imu._raw
    turned = Calibration(("y", "-x", "z"), ("x", "y", "-z"), ACCEL_LSB_PER_G, GYRO_SCALE)
    display_bus.writeto = quick_write
    display = SSD1306(display_bus, refresh=False)
    display.begin()


def use(read, write):
    bus.readfrom_mem_into = read
    bus.writeto = write
    if not FILTERS_ONLY:
        imu.registers.bind(bus)
    display_bus.writeto = write


def start():
    """The same first state for every mode."""
    for f in (filter, tick_filter):
        f.set_quaternion(1, 0, 0, 0)
        f.seed(ROWS[0])
    filter_9.set_quaternion(1, 0, 0, 0)
    filter_9.seed(ROWS_9[0])
    floats.q0, floats.q1, floats.q2, floats.q3 = filter.quaternion_floats()


def new_frame():
    """Every byte of the display is another: STEPS pieces to send. And a tick that has missed nothing."""
    global tick, colour
    if FILTERS_ONLY:
        return
    # with a period (4 s) that no step is late for, whatever slows this program down
    tick = Tick(imu, tick_filter, 1 << 22, display)
    display.flush()
    colour = 1 - colour
    display.fill(colour)
    display.show()


# Loops of one shape, so that the empty one is what the others cost beside their step.
def loop_empty(n):
    i = 0
    while i < n:
        ROWS[i & 15]
        i += 1


def loop_read(n):
    i = 0
    while i < n:
        ROWS[i & 15]
        imu.read()
        i += 1


def loop_filter(n):
    i = 0
    while i < n:
        filter.update(ROWS[i & 15])
        i += 1


def loop_filter_9(n):
    i = 0
    while i < n:
        filter_9.update(ROWS_9[i & 15])
        i += 1


def loop_calibration(n):
    i = 0
    while i < n:
        turned.apply(ROWS_9[i & 15])
        i += 1


def loop_float(n):
    i = 0
    while i < n:
        floats.update(ROWS[i & 15])
        i += 1


def loop_euler(n):
    i = 0
    while i < n:
        ROWS[i & 15]
        filter.angles(angles)
        i += 1


def loop_display(n):
    i = 0
    while i < n:
        ROWS[i & 15]
        display.flush_step(32)
        i += 1


def loop_tick(n):
    i = 0
    while i < n:
        tick.on_sample(ROWS[i & 15])
        i += 1


def loop_bus_read(n):
    i = 0
    while i < n:
        ROWS[i & 15]
        bus.readfrom_mem_into(0x68, 0x3A, one)
        i += 1


def loop_bus_write(n):
    i = 0
    while i < n:
        ROWS[i & 15]
        bus.writeto(0x3C, one)
        i += 1


PARTS = (
    ("empty", loop_empty),
    ("bus_read", loop_bus_read),
    ("bus_write", loop_bus_write),
    ("read", loop_read),
    ("filter", loop_filter),
    ("filter9", loop_filter_9),
    ("calibration", loop_calibration),
    ("float", loop_float),
    ("display", loop_display),
    ("euler", loop_euler),
    ("tick", loop_tick),
)
if FILTERS_ONLY:
    PARTS = (("empty", loop_empty), ("filter", loop_filter), ("float", loop_float))


# ------------------------------------------------------------------------------------------ modes
def check(n):
    for _, loop in PARTS:
        new_frame()
        loop(n)
    q = array("i", [0, 0, 0, 0])
    filter.quaternion(q)
    print("filter", *q)
    filter_9.quaternion(q)
    print("filter9", *q)
    print("calibration", *turned.counts)
    print("euler", *angles)
    print("read", *imu.counts)
    tick_filter.quaternion(q)
    print("tick", *q, tick.steps, tick.fresh, tick.missed, tick.crashes)
    print("faults", imu.errors, imu.resets, imu.stale, display.errors, display.dropped)
    print("float", round(floats.q0 * 1000), round(floats.q1 * 1000), round(floats.q2 * 1000))


def calls(n):
    use(counted_read, counted_write)
    for name, loop in PARTS:
        new_frame()
        made[0] = made[1] = 0
        loop(n)
        print(name, made[0], made[1])


def alloc(n):
    if not hasattr(gc, "mem_alloc"):
        return
    for name, loop in PARTS:
        new_frame()
        gc.collect()
        gc.disable()
        before = gc.mem_alloc()
        loop(n)
        used = gc.mem_alloc() - before
        gc.enable()
        print(name, used)


def time(n):
    for _ in range(n):
        # by turns, so that whatever else the machine does meets all of them
        for name, loop in PARTS:
            spent = 0
            for _ in range(BATCHES):
                new_frame()
                before = ticks_us()
                loop(STEPS)
                spent += ticks_diff(ticks_us(), before)
            print(name, spent)


def trace(n):
    gc.collect()
    gc.disable()
    new_frame()
    for _, loop in PARTS:
        loop(1)
    for name, loop in PARTS:
        if name in ("display", "tick"):
            new_frame()
        section(name, loop, n)
        if name == "float" and not FILTERS_ONLY:
            # and again in the way of a program that runs: the heap fills and is collected
            gc.collect()
            gc.enable()
            section("collected", loop, LONGER * n)
            gc.disable()


def section(name, loop, n):
    for steps in (0, n):
        # each in one write: between two there would be lines of the trace
        print("@begin %s %d\n" % (name, steps), end="")
        loop(steps)
        print("@end %s %d\n" % (name, steps), end="")


MODES = {"check": check, "calls": calls, "alloc": alloc, "time": time, "trace": trace}


def main():
    start()
    use(quick_read, quick_write)
    MODES[sys.argv[1]](int(sys.argv[2]))


main()
