# Driver of the InvenSense MPU6050 on I2C, and of the parts that are sold under its name.
# Needs an I2C object (machine.I2C or alike) and mpu_common.py. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A rev 3.4.

import time

from micropython import const

from upright import mpu_parts
from upright.mpu_common import (  # noqa: F401  the health states are part of this module's face
    HEALTH_BUS_ERROR,
    HEALTH_MISMATCH,
    HEALTH_OK,
    HEALTH_REPAIRING,
    MpuBase,
)
from upright.registers import I2CRegisters

_WHO_AM_I = const(0x75)


class MPU6050Error(OSError):
    """The chip is absent, another one, or does not keep what is written to it; at set-up only."""


class MPU6050(MpuBase):
    """An MPU6050 on an I2C bus.

    i2c             has readfrom_mem_into and writeto; give machine.I2C a short timeout, for a stuck
                    bus blocks the tick as long
    address         0x68 with AD0 low, 0x69 with AD0 high
    accept_unknown  take a part whose identity is not in the table for an MPU6050

    Constructing touches no bus. configure() finds, resets and starts the chip; then, in a timer's
    or a pin's interrupt, read() fills counts (ax ay az gx gy gz mx my mz temp flags), health() looks
    after the configuration, and fifo_poll() with fifo_next() take the place of read() in FIFO mode:

        imu = MPU6050(i2c)
        imu.configure(accel_range_g=8, gyro_range_dps=2000, sample_rate_hz=200)

        def tick(timer):
            if imu.read() & 1:
                ...  # a new sample in imu.counts
            imu.health()

    Counters, wrapping at 2**30: errors (bus faults), stale (read() found nothing new), resets (of
    the chip by itself), fifo_overflows, fifo_resets, fifo_lost (packets, as far as they could be
    counted). chip is the part's name, who_am_i its identity.
    """

    error_class = MPU6050Error
    _NAME = "MPU6050"
    _ONLY_6500 = False

    def __init__(self, i2c, address=0x68, accept_unknown=False):
        MpuBase.__init__(self, I2CRegisters(i2c, address, self.error_class, mpu_parts.name))
        self._i2c = i2c
        self._accept_unknown = accept_unknown

    # Set-up

    def _begin(self):
        self._identify()
        self._reset(f"at 0x{self.registers.address:02x}")
        self._identify()

    def _identify(self):
        who = None
        for _ in range(11):
            who = self._who_is_at(self.registers.address)
            if who is not None:
                break
            time.sleep_ms(10)  # just powered up, the chip may take 100 ms to answer
        if who is None:
            raise self.error_class(self._absent())
        part = mpu_parts.PARTS.get(who)
        if part is None:
            if not self._accept_unknown:
                known = ", ".join(f"0x{k:02x}" for k in sorted(mpu_parts.PARTS))
                raise self.error_class(
                    f"0x{self.registers.address:02x} answers WHO_AM_I (0x75) with 0x{who:02x}; known are "
                    f"{known}. A DS1307 or DS3231 clock has the same address. "
                    f"accept_unknown=True uses it as an {self._NAME}"
                )
            as_if = mpu_parts.PARTS[0x70 if self._ONLY_6500 else 0x68]
            part = (f"unknown (0x{who:02x})",) + as_if[1:]
        elif self._ONLY_6500 and not part[1]:
            raise self.error_class(
                f"0x{self.registers.address:02x} is an {part[0]} (0x{who:02x}), not of the MPU6500 family: "
                "use MPU6050, which drives both"
            )
        self._adopt(who, part)

    def _who_is_at(self, address):
        registers = I2CRegisters(self._i2c, address)
        try:
            registers.read_into(_WHO_AM_I, self._one)
        except OSError:
            return None
        return self._one[0]

    def _absent(self):
        other = 0x69 if self.registers.address == 0x68 else 0x68
        who = self._who_is_at(other)
        if who is None:
            hint = f"none at 0x{other:02x} either. Check supply, SDA, SCL and their pull-ups"
        else:
            hint = f"0x{other:02x} answers, with 0x{who:02x}. AD0 sets the address: low 0x68, high 0x69"
        return f"no {self._NAME} at 0x{self.registers.address:02x}; {hint} (WHO_AM_I: no answer to 11 reads in 0.1 s)"
