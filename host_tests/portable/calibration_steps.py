# Calibration on every runtime. Arguments:
#   same                what apply() gives over awkward rows, the files it writes, and what it refuses: the same text
#                       everywhere
#   alloc [float]       10,000 calls with the heap locked, then with the allocated bytes counted; float: in a twin that
#                       allocates
#   record WORLD OUT S  firmware/upright_app/record.py on the simulated board, S seconds

import gc
import sys
from array import array
from binascii import crc32

import micropython
from upright import calibration
from upright.calibration import Calibration, CalibrationError

AXES = (("x", "y", "z"), ("y", "-x", "z"), ("-z", "-y", "-x"), ("+z", "x", "y"))
MIRROR = ("x", "y", "-z")
UNEVEN = [990001, 1, -2, 3, 1009999, 4, 5, -6, 1000000]
SOFT = [1050000, -1234, 77, -1234, 930001, 40, 77, 40, 1020202]
FULL = [1000000, -500000, 500000, 0, 2000000, 0, 1, -1, 1999998]
WIDE = [700000, 650000, -650000, 0, 1400000, 600000, 0, 0, 2000000]
PARTS = (
    {"mag": {"offset_mlsb": [12345, -6789, 1], "matrix_ppm": SOFT}},
    {
        "gyro_bias_udps": [1234567, -59999999, 1],
        "accel": {"offset_ug": [-500000, 499999, 33333], "matrix_ppm": UNEVEN},
    },
    {
        "accel": {"offset_ug": [-500000, 500000, -500000], "matrix_ppm": FULL},
        "mag": {"offset_mlsb": [20000000, -20000000, 20000000], "matrix_ppm": WIDE},
    },
)


def rows(n):
    """n rows of words all over int16, corners among them."""
    seed = 12345
    out = []
    for k in range(n):
        row = array("h", [0] * 11)
        for i in range(10):
            seed = (seed * 75 + 74) % 65537
            row[i] = 32767 if seed < 8000 else -32768 if seed > 60000 else seed - 32768
        row[10] = (0, 1, 2, 3, 7, 11)[k % 6]
        out.append(row)
    return out


def same():
    for axes in AXES:
        for part in PARTS:
            for lsb, scale in ((16384, (131, 1)), (2048, (82, 5)), (32767, (164, 5))):
                c = Calibration(axes, MIRROR, lsb, scale)
                c.set(part)
                crc = 0
                for row in rows(60):
                    c.apply(row)
                    crc = crc32(bytes(c.counts), crc)
                print("%08x" % crc, c.gyro_bias())
    name = "calibration_steps.json" if len(sys.argv) < 3 else sys.argv[2]
    c.save(name, "MPU6050", "Pl\u00e4ttchen 1")
    with open(name, "rb") as file:
        print(file.read())
    c = Calibration(AXES[1])
    c.load(name, "MPU6050", "Pl\u00e4ttchen 1")
    c.save_gyro_bias(name, 256, -512, 1000)
    c.load(name, "MPU6050")
    print(calibration._text(c.fields), c.gyro_bias())
    with open(name, "rb") as file:
        whole = file.read()
    for spoilt in (whole[:-9], b"", b"[" * 1500, whole.replace(b"1", b"2"), b"\xff" * 9, b"{}"):
        with open(name, "wb") as file:
            file.write(spoilt)
        try:
            c.load(name)
            print("accepted")
        except CalibrationError as why:
            print(why.kind, why.title, str(why).replace(name, "FILE"), c.identity)
    try:
        c.load(name + ".absent")
    except ValueError as why:
        print(why.kind, why.title, c.gyro_bias(), isinstance(why, CalibrationError))


class FloatTwin(Calibration):
    """What must be found out."""

    half = 0.5

    def apply(self, raw):
        Calibration.apply(self, raw)
        FloatTwin.half = FloatTwin.half * 0.99


def alloc():
    c = (FloatTwin if len(sys.argv) > 2 else Calibration)(AXES[1], MIRROR)
    c.set(PARTS[2])
    samples = rows(6)

    def run(n):
        while n:
            c.apply(samples[n % 6])
            n -= 1

    run(10)
    refused = 0
    micropython.heap_lock()
    try:
        run(10000)
    except MemoryError:
        refused = 1
    finally:
        micropython.heap_unlock()
    gc.collect()
    gc.disable()
    before = gc.mem_alloc()
    run(1000)
    print("refused", refused, "grown", gc.mem_alloc() - before)


def record():
    import kernel
    import machine
    from chips.mpu6050 import MPU6050Chip
    from world import World

    machine.power_on()
    world = World(sys.argv[2])
    world.start(kernel.now())
    machine.wire_i2c(0, MPU6050Chip(world))
    from upright_app import record

    print(record.run(sys.argv[3], int(sys.argv[4])))


assert calibration.VERSION == 1
{"same": same, "alloc": alloc, "record": record}[sys.argv[1]]()
