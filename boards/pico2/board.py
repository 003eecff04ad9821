# Raspberry Pi Pico 2 (RP2350), MicroPython 1.26 or newer for hard timer interrupts; see README.md for the wiring.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "Raspberry Pi Pico 2"
PLATFORM = "rp2"  # sys.platform there
SENSOR_RATE_HZ = 1000

_HZ = 400000
# A stuck bus blocks a tick for this long at most (us). The longest transfer, 120 bytes of the FIFO, has to fit in.
_TIMEOUT_US = 1000 + 9 * 120 * 1000000 // _HZ

_i2c = I2C(0, scl=Pin(5), sda=Pin(4), freq=_HZ, timeout=_TIMEOUT_US)


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
