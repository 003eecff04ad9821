"""For the tests of magnetometers: one behind an IMU, in bypass, or on a bus of the board, and the firmware's tick."""

from itertools import pairwise

import kernel
import machine
from chips.ak8963 import AK8963Chip
from chips.hmc5883l import HMC5883LChip
from chips.ist8310 import IST8310Chip
from chips.qmc5883l import QMC5883LChip
from imus import RIGS
from upright.ak8963 import AK8963, AK8963Error
from upright.auxiliary_bus import AuxiliaryBus
from upright.hmc5883l import HMC5883L, HMC5883LError
from upright.ist8310 import IST8310, IST8310Error
from upright.qmc5883l import QMC5883L, QMC5883LError
from world import StillWorld

FRESH, MAG_FRESH = 1, 2
# driver, model, error, a configuration register, what it holds, and what a fault puts there
KINDS = {
    "AK8963": (AK8963, AK8963Chip, AK8963Error, 0x0C, 0x00, 0x40),
    "HMC5883L": (HMC5883L, HMC5883LChip, HMC5883LError, 0x00, 0x18, 0x38),
    "IST8310": (IST8310, IST8310Chip, IST8310Error, 0x41, 0x24, 0x00),
    "QMC5883L": (QMC5883L, QMC5883LChip, QMC5883LError, 0x0B, 0x01, 0x00),
}
BEHIND = {"spi": "MPU6500", "behind": "MPU6050", "6500 on i2c": "MPU6500_I2C"}
PLACES = (*BEHIND, "bypass", "main bus", "own bus")


class Rig:
    """An IMU, a magnetometer at one of the PLACES, and the tick of the firmware: read, and health now and then."""

    def __init__(self, name, place, world, rate=1000, **options):
        self.driver, model, self.error, *self.row = KINDS[name]
        self.world = world
        self.rate = rate
        self.period = 1_000_000 // rate
        self.chip, self.imu = RIGS[BEHIND.get(place, "MPU6050")].running(world, rate)
        self.mag_chip = model(world, **options)
        number = 1 if place == "own bus" else 0
        if place in ("main bus", "own bus"):
            self.bus = machine.wire_i2c(number, self.mag_chip)
        else:
            self.chip.aux.append(self.mag_chip)
        if place == "bypass":
            self.imu.set_bypass()
        self.i2c = machine.I2C(number, freq=400_000)
        self.where = f" behind the {self.imu.chip}" if place in BEHIND else ""
        self.mag = self.driver(AuxiliaryBus(self.imu) if place in BEHIND else self.i2c)
        # ticks from one measurement to the next: a chip with a clock of its own is now and then early or late
        self.gaps = {10} if self.driver.START else {9, 10, 11}
        self.steps = 0

    def configure(self, **arguments):
        self.mag.configure(sample_rate=self.rate if self.mag.own_bus else None, **arguments)

    def start(self, **arguments):
        self.configure(**arguments)
        self.until(MAG_FRESH)

    def tick(self, health=True):
        kernel.advance(self.period - kernel.now() % self.period)
        self.imu.read()
        if self.mag.own_bus:
            self.mag.read(self.imu.counts)
        flags = self.imu.counts[10]
        self.steps += 1
        if health and (not flags & FRESH or not self.steps % 8):
            self.imu.health()
        return flags

    def run(self, n):
        """The ticks (0..n-1) that had a fresh measurement."""
        return [i for i in range(n) if self.tick() & MAG_FRESH]

    def until(self, bit, most=2000):
        """Microseconds until a sample has this bit."""
        start = kernel.now()
        for _ in range(most):
            if self.tick() & bit:
                return kernel.now() - start
        raise AssertionError(f"no bit {bit} in {most} ticks")


def still(field):
    return StillWorld((10, -20, 4096, 5, 6, -7, *field, -521))


def gaps(ticks):
    return {b - a for a, b in pairwise(ticks)}
