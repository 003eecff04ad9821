# MPU9250 or MPU9255 module (GY-9250, GY-91) on a Raspberry Pi Pico; see README.md for the wiring.
# lib/upright/settings.py lists every setting.

from machine import I2C, Pin
from upright import i2c_bus, magnetometers, ssd1306, timing
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
_scl, _sda = Pin(5), Pin(4)

# a chip that a reset of the board has cut off in a read holds SDA low
i2c_bus.free(_scl, _sda)
# a stuck bus blocks a tick for the time-out
_i2c = I2C(0, scl=_scl, sda=_sda, freq=_HZ, timeout=i2c_bus.timeout_us(_HZ, PLATFORM))


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
