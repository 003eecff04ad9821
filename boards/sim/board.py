# The simulated board that `upright demo` and the tests boot: wired like the Pico of boards/pico.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "simulated board"
SENSOR_RATE_HZ = 1000
DISPLAY_SHARES_BUS = True

_i2c = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=3000)


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    own = None if DISPLAY_SHARES_BUS else I2C(1, scl=Pin(19), sda=Pin(18), freq=400000)
    return ssd1306.SSD1306(own or _i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
