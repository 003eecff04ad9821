# ESP32 (DevKitC and alike): its timers call back in the main program's time only; see README.md for the wiring.
# What can be set besides is in lib/upright/settings.py.

from machine import I2C, Pin
from upright import ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "ESP32"
PLATFORM = "esp32"  # sys.platform there
SENSOR_RATE_HZ = 1000

# A stuck bus costs a tick at most this long (us).
_TIMEOUT_US = 3000

_i2c = I2C(0, scl=Pin(22), sda=Pin(21), freq=400000, timeout=_TIMEOUT_US)


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(19, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback, 0)
