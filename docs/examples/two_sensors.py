# Two MPU6050 on one bus, AD0 of the second high: one tick serves both. For the angle of a joint, say.

import time

import upright
from machine import I2C, Pin
from upright.mpu6050 import MPU6050

i2c = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=3000)
# each has a file of its own for its calibration
thigh = upright.AHRS(MPU6050(i2c, 0x68), calibration="thigh.json")
shin = upright.AHRS(MPU6050(i2c, 0x69), calibration="shin.json")
with thigh, shin:
    while True:
        print("joint", thigh.angles()[1] - shin.angles()[1])
        time.sleep_ms(100)
