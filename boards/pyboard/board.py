# Pyboard 1.0 and 1.1 (STM32F405); see README.md for the wiring.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "Pyboard"
PLATFORM = "pyboard"  # sys.platform there
SENSOR_RATE_HZ = 1000
# The default, inertial6, is 6 kB too large for this file system. Frozen into the firmware (README.md) it fits: take
# this line out then.
FILTER = "mahony6"

_HZ = 400000
# A stuck bus blocks a tick for this long at most (us; this port rounds up to ms). The longest transfer, 120 bytes of
# the FIFO, has to fit in.
_TIMEOUT_US = 1000 + 9 * 120 * 1000000 // _HZ

_i2c = I2C(1, freq=_HZ, timeout=_TIMEOUT_US)  # X9, X10


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin("X1", Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback, 4)
