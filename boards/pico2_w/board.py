# Raspberry Pi Pico 2 W (RP2350), MicroPython 1.26 or newer for hard timer interrupts; see README.md for the wiring.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import i2c_bus, ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "Raspberry Pi Pico 2 W"
PLATFORM = "rp2"  # sys.platform there
SENSOR_RATE_HZ = 1000

_HZ = 400000
_scl, _sda = Pin(5), Pin(4)

# a chip that a reset of the board has cut off in a read holds SDA low
i2c_bus.free(_scl, _sda)
# a stuck bus blocks a tick for the time-out
_i2c = I2C(0, scl=_scl, sda=_sda, freq=_HZ, timeout=i2c_bus.timeout_us(_HZ, PLATFORM))


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
