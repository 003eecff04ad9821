# MPU9250 or MPU9255 module (GY-9250, GY-91) on a Raspberry Pi Pico; see README.md for the wiring.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import magnetometers, ssd1306, timing
from upright.mpu6500 import MPU6500_I2C

NAME = "MPU9250 on a Raspberry Pi Pico"
PLATFORM = "rp2"  # sys.platform there
SENSOR_RATE_HZ = 1000
MAGNETOMETER = "AK8963"

# In the frame of the accelerometer and the gyro, which is printed on the module: PS-MPU-9250A-01 rev 1.1, 9.1 draws the
# AK8963's x along their y, its y along their x, and its z downwards.
IMU_AXES = ("x", "y", "z")
MAG_AXES = ("y", "x", "-z")

_HZ = 400000
# A stuck bus blocks a tick for this long at most (us). The longest transfer, 120 bytes of the FIFO, has to fit in.
_TIMEOUT_US = 1000 + 9 * 120 * 1000000 // _HZ

_i2c = I2C(0, scl=Pin(5), sda=Pin(4), freq=_HZ, timeout=_TIMEOUT_US)


def sensor():
    return MPU6500_I2C(_i2c)


def magnetometer(imu):
    # in bypass: it answers on the bus of the MPU9250. AK8963(AuxiliaryBus(imu)) would have the MPU9250 read it.
    return magnetometers.find(imu, MAGNETOMETER)


def display(chunk):
    # the panel by name; README.md lists them ("SH1106 128x64" is the usual 1.3 inch one)
    return ssd1306.SSD1306(_i2c, "SSD1306 128x64", chunk=chunk)


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
