# GY-87 or GY-86 (MPU6050 and HMC5883L or QMC5883L) on a Raspberry Pi Pico; see README.md for the wiring.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import i2c_bus, magnetometers, ssd1306, timing
from upright.mpu6050 import MPU6050

NAME = "GY-87 on a Raspberry Pi Pico"
PLATFORM = "rp2"  # sys.platform there
SENSOR_RATE_HZ = 1000
# A GY-87 has either of two. Named, "HMC5883L" or "QMC5883L", it may also answer late.
MAGNETOMETER = "auto"

# UNVERIFIED on a real board: the axis check of README.md has not been run yet. MultiWii's def.h for GY_86 and GY_87
# maps the HMC5883L's axes as the MPU6050's, but for the sign of the field. A QMC5883L lies as an HMC5883L (ArduPilot,
# pull request 31874).
IMU_AXES = ("x", "y", "z")
MAG_AXES = ("x", "y", "z")

_HZ = 400000
_scl, _sda = Pin(5), Pin(4)

# a chip that a reset of the board has cut off in a read holds SDA low
i2c_bus.free(_scl, _sda)
# a stuck bus blocks a tick for the time-out
_i2c = I2C(0, scl=_scl, sda=_sda, freq=_HZ, timeout=i2c_bus.timeout_us(_HZ, PLATFORM))


def sensor():
    return MPU6050(_i2c)


def magnetometer(imu):
    # in bypass: it answers on the bus of the MPU6050. QMC5883L(AuxiliaryBus(imu)) would have the MPU6050 read it.
    return magnetometers.find(imu, MAGNETOMETER)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
