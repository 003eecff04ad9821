# The simulated board that `upright demo` and the tests boot: wired like the Pico of boards/pico.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import i2c_bus, ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "simulated board"
SENSOR_RATE_HZ = 1000
DISPLAY_SHARES_BUS = True

_HZ = 400000
_scl, _sda = Pin(5), Pin(4)

# a chip that a reset of the board has cut off in a read holds SDA low
i2c_bus.free(_scl, _sda)
# a stuck bus blocks a tick for the time-out
_i2c = I2C(0, scl=_scl, sda=_sda, freq=_HZ, timeout=i2c_bus.timeout_us(_HZ))


def sensor():
    return MPU6050(_i2c)


def display(chunk):
    own = None if DISPLAY_SHARES_BUS else I2C(1, scl=Pin(19), sda=Pin(18), freq=400000)
    return ssd1306.SSD1306(own or _i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
