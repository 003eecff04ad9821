# ESP32-C3 (DevKitM-1, SuperMini, XIAO), MicroPython 1.24 or newer; see README.md for the
# wiring. Its timer callbacks are soft.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "ESP32-C3"
PLATFORM = "esp32"  # sys.platform there

_HZ = 400000
# A stuck bus blocks a tick for this long at most (us). This port counts in ticks of 10 ms: below 20 ms every transfer
# may fail (ESP-IDF 5.5.2 and newer).
_TIMEOUT_US = 20000

_i2c = I2C(0, scl=Pin(7), sda=Pin(6), freq=_HZ, timeout=_TIMEOUT_US)


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(10, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback, 0)
