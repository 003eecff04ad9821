"""The three IMU drivers, each on the bus of the simulated machine with the chip that it is for."""

import kernel
import machine
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from upright.mpu6050 import MPU6050, MPU6050Error
from upright.mpu6500 import MPU6500, MPU6500_I2C, MPU6500Error
from world import StillWorld

COUNTS = (10, -20, 4096, 5, 6, -7, 0, 0, 0, -521)
FRESH, MAG, ACCEL_FULL, GYRO_FULL = 1, 2, 4, 8
CS = "PF6"


def tick(imu, us=1000):
    kernel.advance(us)
    return imu.read()


class Rig:
    """wired() puts the chip on its bus, driver() makes the driver, running() both, with a sample every millisecond."""

    def __init__(self, cls, chip, spi=False):
        self.cls, self.chip, self.spi = cls, chip, spi
        self.error = MPU6050Error if cls is MPU6050 else MPU6500Error

    def wired(self, world=COUNTS, **options):
        """world: one, or the counts of one that stands still."""
        world = world if isinstance(world, StillWorld) else StillWorld(world)
        chip = self.chip(world, **options)
        if self.spi:
            machine.wire_spi(5, chip, cs=CS)
        else:
            machine.wire_i2c(0, chip)
        return chip

    def driver(self, bus=None, **options):
        if self.spi:
            options["cs"] = machine.Pin(CS, machine.Pin.OUT, value=1)
        else:
            options = {"address": 0x68} | options
        return self.cls(bus or self.bus(), **options)

    def running(self, world=COUNTS, rate=1000, configure=None, bus=None, **options):
        """(chip, driver)."""
        chip = self.wired(world, **options)
        imu = self.driver(bus)
        imu.configure(sample_rate_hz=rate, **(configure or {}))
        return chip, imu

    def bus(self):
        return machine.SPI(5, 1_000_000) if self.spi else machine.I2C(0, freq=400_000)


RIGS = {
    "MPU6050": Rig(MPU6050, MPU6050Chip),
    "MPU6500": Rig(MPU6500, MPU6500Chip, spi=True),
    "MPU6500_I2C": Rig(MPU6500_I2C, MPU6500Chip),
}
