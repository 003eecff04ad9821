# What an AHRS gives while its simulated chip is moved, trimmed and zeroed: numbers, for every runtime to agree on.

from array import array

import kernel
import machine
import upright
from chips.mpu6050 import MPU6050Chip
from upright.mpu6050 import MPU6050
from world import StillWorld

machine.power_on()
world = StillWorld((500, 850, 3970, 20, -10, 8))
world.start(0)
machine.wire_i2c(0, MPU6050Chip(world), 5, 4)
kernel.advance(200000)

commands = array("i", [0] * 3)
rates = array("i", [0] * 3)


def control(imu):
    imu.angles_into(commands)
    imu.rates_into(rates)


i2c = machine.I2C(0, scl=machine.Pin(5), sda=machine.Pin(4), freq=400000)
imu = upright.AHRS(MPU6050(i2c), measure_bias=False, calibration=None, log=None, on_step=control)


def tell(what):
    words = array("i", [0] * 15)
    assert imu.snapshot(words)
    print(what, "words", *words)
    print(what, "tick", *(list(commands) + list(rates)))
    for name in ("angles", "quaternion", "rates", "acceleration", "linear_acceleration"):
        print(what, name, *getattr(imu, name)())
    print(what, "turns", imu.turns(), imu.temperature())


with imu:
    tell("start")
    kernel.advance(3000000)
    tell("rest")
    imu.level()
    kernel.advance(1000000)
    tell("level")
    world.set((500, 850, 3970, 700, -900, 1640))
    kernel.advance(4000000)
    tell("turned")
    imu.zero_yaw()
    kernel.advance(100000)
    tell("zeroed")
    status = imu.status()
    print("status", status["steps"], status["fresh"], status["faults"], status["step_errors"])
    reading = imu.wait()
    print("waited", reading.step, reading.flags)
