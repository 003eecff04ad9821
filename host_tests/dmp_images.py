"""Stand-ins for the DMP's images, random bytes of the right size, and a driver with a chip that runs them."""

import random

import kernel
import machine
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from upright.dmp import MpuDmp
from upright.mpu6050 import MPU6050
from upright.mpu6500 import MPU6500
from world import StillWorld

V612 = random.Random(612).randbytes(3062)
V20 = random.Random(20).randbytes(1929)
# bank, offset, length, bytes; the length 0 has one byte more and is skipped
LIST = bytes((3, 0x7B, 3, 1, 2, 3, 0, 0, 0, 1, 7, 0x86, 1, 0xFE, 2, 0x16, 2, 0, 9))
IMAGES = {"v6.12": V612, "v2.0": V20}


def wired(image=V612, spi=False, world=None, **options):
    """(chip, driver): an MPU6050 on I2C, or an MPU6500 on SPI, whose DMP runs `image`."""
    world = world or StillWorld((1000, 2000, 3000, 10, -20, 30), rate=(200, 1))
    if spi:
        chip = MPU6500Chip(world, **options)
        machine.wire_spi(5, chip, cs="PF6")
        imu = MPU6500(machine.SPI(5, 1_000_000), machine.Pin("PF6", machine.Pin.OUT, value=1))
    else:
        chip = MPU6050Chip(world, **options)
        machine.wire_i2c(0, chip)
        imu = MPU6050(machine.I2C(0, freq=400_000))
    chip.dmp.images.append(image)
    return chip, imu


def running(image=V612, spi=False, world=None, chip=None, **options):
    """(chip, dmp) after configure(), which has started the world as well. chip: the model's own arguments."""
    chip, imu = wired(image, spi, world, **(chip or {}))
    dmp = MpuDmp(imu, image, accept_unknown=True, **options)
    if world is not None:
        world.start(kernel.now())
    dmp.configure()
    return chip, dmp


def ticks(dmp, n, us=5000):
    """read() and health() n times, every `us` -> the flags."""
    flags = []
    for _ in range(n):
        kernel.advance(us)
        flags.append(dmp.read())
        dmp.health()
    return flags
