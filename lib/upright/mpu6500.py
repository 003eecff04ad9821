# Driver of the InvenSense MPU6500 on SPI, and of its family (MPU9250, ICM-20689 ...); on I2C as well.
# Needs an SPI object and a chip select pin, mpu.py, mpu6050.py, mpu_monitor.py, mpu_parts.py and registers.py. Runs on
# MicroPython >= 1.22 and under CPython with a `micropython` shim. PS is PS-MPU-6500A rev 1.3, RM RM-MPU-6500A rev 2.1.

import time

from micropython import const

from upright import mpu_parts
from upright.mpu import Mpu
from upright.mpu6050 import I2CPort
from upright.mpu_monitor import (  # noqa: F401  the health states are part of this module's face
    HEALTH_BUS_ERROR,
    HEALTH_MISMATCH,
    HEALTH_OK,
    HEALTH_REPAIRING,
)
from upright.registers import SPIRegisters

_INT_STATUS = const(0x3A)
_EXT_SENS_DATA_23 = const(0x60)
_SIGNAL_PATH_RESET = const(0x68)
_USER_CTRL = const(0x6A)
_WHO_AM_I = const(0x75)

_I2C_IF_DIS = const(0x10)
_REGISTER_HZ = const(1_000_000)  # PS 6.5: every register
_SENSOR_HZ = const(20_000_000)  # PS 6.5: reading sensor and interrupt registers


class MPU6500Error(OSError):
    """The chip is absent, another one, or does not keep what is written to it; at set-up only."""


class SPIPort:
    """How a chip of the family is found on an SPI bus; see mpu.Mpu."""

    where = "on SPI"
    interface = _I2C_IF_DIS  # without it a glitch on CS makes the chip an I2C slave
    # RM 4.28: over SPI both H_RESET and SIGNAL_PATH_RESET, each followed by 100 ms
    after_reset = ((_USER_CTRL, _I2C_IF_DIS), (_SIGNAL_PATH_RESET, 0x07))

    def __init__(self, registers, accept_unknown):
        self.registers = registers
        self._accept_unknown = accept_unknown

    def prepare(self):
        self.registers.find_clocks()

    def find(self):
        who = 0
        byte = bytearray(1)
        for _ in range(11):
            try:
                self.registers.read_into(_WHO_AM_I, byte)
                who = byte[0]
            except OSError:
                pass
            if who not in (0x00, 0xFF):
                break
            time.sleep_ms(10)  # just powered up, the chip may take 100 ms to answer (PS 6.3)
        else:
            raise MPU6500Error(
                f"no MPU6500 on SPI: WHO_AM_I (0x75) reads 0x{who:02x}, a floating bus (11 reads "
                "in 0.1 s). Check supply, the pin of CS, MISO (AD0/SDO of the chip), SCK, and that "
                "the bus is in mode 0 or 3"
            )
        part = mpu_parts.PARTS.get(who)
        if who == 0x68:
            return who, mpu_parts.MPU6000
        if part is None:
            if not self._accept_unknown:
                garbled = "A bus in mode 1 or 2 or over 1 MHz garbles it too"
                raise MPU6500Error(mpu_parts.stranger(who, self.where, "an MPU6500", garbled))
            part = mpu_parts.unknown(who, True)
        return who, part


class MPU6500(Mpu):
    """An MPU6500 on an SPI bus of its own, in mode 0 or 3; mpu.Mpu describes what it can do.

    spi             has write, readinto and, for two clocks, init(baudrate=); a machine.SPI
    cs              chip select, an output pin, called with 0 and 1
    accept_unknown  use a part whose identity is not in the table as an MPU6500
    fast_hz         clock for sensor bursts, at most 20 MHz (PS 6.5)
    slow_hz         clock for everything else, at most 1 MHz (PS 6.5)

    Everything runs at slow_hz if a change of clock allocates memory or takes longer than it saves. If the clock cannot
    be changed at all, the bus keeps its first clock, which must then be 1 MHz or less. burst_hz is the clock of bursts
    (0: the bus's first clock).

        imu = MPU6500(machine.SPI(5, 1_000_000), machine.Pin("PF6", machine.Pin.OUT, value=1))
        imu.configure(accel_range_g=8, gyro_range_dps=2000, sample_rate_hz=1000)
    """

    def __init__(self, spi, cs, accept_unknown=False, fast_hz=10_000_000, slow_hz=_REGISTER_HZ):
        if not 0 < slow_hz <= _REGISTER_HZ:
            raise ValueError(f"slow_hz {slow_hz!r} is not 1 to {_REGISTER_HZ}")
        if not slow_hz <= fast_hz <= _SENSOR_HZ:
            raise ValueError(f"fast_hz {fast_hz!r} is not {slow_hz} to {_SENSOR_HZ}")
        sensor = (_INT_STATUS, _EXT_SENS_DATA_23)  # FIFO_R_W is no sensor register
        registers = SPIRegisters(spi, cs, fast_hz, slow_hz, sensor, MPU6500Error, mpu_parts.name)
        Mpu.__init__(self, SPIPort(registers, accept_unknown))

    @property
    def burst_hz(self):
        return self.registers.burst_hz


class MPU6500_I2C(Mpu):
    """An MPU6500, or another part of its family, on an I2C bus: MPU6050 that takes nothing else.

    i2c, address, accept_unknown  as for MPU6050; an unknown part is taken for an MPU6500
    """

    def __init__(self, i2c, address=None, accept_unknown=False):
        Mpu.__init__(self, I2CPort(i2c, address, accept_unknown, MPU6500Error, "MPU6500", True))
