# Driver of the InvenSense MPU6050 on I2C, and of the parts that are sold under its name.
# Needs an I2C object (machine.I2C or alike), mpu.py, mpu_monitor.py, mpu_parts.py and registers.py. Runs on
# MicroPython >= 1.22 and under CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2.

import time

from micropython import const

from upright import mpu_parts
from upright.mpu import Mpu
from upright.mpu_monitor import (  # noqa: F401  the health states are part of this module's face
    HEALTH_BUS_ERROR,
    HEALTH_MISMATCH,
    HEALTH_OK,
    HEALTH_REPAIRING,
)
from upright.registers import I2CRegisters

_WHO_AM_I = const(0x75)
_ADDRESSES = (0x68, 0x69)  # with AD0 low, high
_TIMED_OUT = (110, 116)  # ETIMEDOUT: MicroPython's, and newlib's on esp32
_CLOCK = "A DS1307 or DS3231 clock has the address 0x68, too"


class MPU6050Error(OSError):
    """The chip is absent, another one, or does not keep what is written to it; at set-up only."""


class I2CPort:
    """How a chip of the family is found on an I2C bus; see mpu.Mpu."""

    interface = 0
    after_reset = ()

    def __init__(self, i2c, address, accept_unknown, error_class, name, only_6500):
        self.registers = I2CRegisters(
            i2c, _ADDRESSES[0] if address is None else address, error_class, mpu_parts.name
        )
        self._error_class = error_class
        self.searches = address is None
        self._accept_unknown = accept_unknown
        self._name = name
        self._only_6500 = only_6500
        self._timed_out = False

    @property
    def where(self):
        return f"at 0x{self.registers.address:02x}"

    def prepare(self):
        pass

    def find(self):
        answers = {}
        for _ in range(11):
            answers = self._ask(_ADDRESSES if self.searches else (self.registers.address,))
            if any(self._is_wanted(who) for who in answers.values()):
                break
            if answers and not self.searches:
                break
            time.sleep_ms(10)  # just powered up, the chip may take 100 ms to answer
        if not answers:
            raise self._error_class(self._absent())
        wanted = [address for address in sorted(answers) if self._is_wanted(answers[address])]
        if len(wanted) > 1:
            raise self._error_class(
                f"0x68 answers WHO_AM_I (0x75) with 0x{answers[0x68]:02x} and 0x69 with "
                f"0x{answers[0x69]:02x}: say which one is meant, address=0x68 or address=0x69"
            )
        self.registers.address = address = (wanted or sorted(answers))[0]
        return answers[address], self._part(answers[address])

    def _is_wanted(self, who):
        if mpu_parts.answers_nothing(who):
            return False
        return who in mpu_parts.PARTS or self._accept_unknown

    def _part(self, who):
        where = f"0x{self.registers.address:02x}"
        part = mpu_parts.PARTS.get(who)
        if part is None:
            if not self._is_wanted(who):
                raise self._error_class(
                    mpu_parts.stranger(who, self.where, f"an {self._name}", _CLOCK)
                )
            return mpu_parts.unknown(who, True if self._only_6500 else None)
        if self._only_6500 and part[1] is False:
            raise self._error_class(
                f"{where} is an {part[0]} (0x{who:02x}), not of the MPU6500 family: "
                "use MPU6050, which drives both"
            )
        return part

    def _ask(self, addresses):
        """{address: WHO_AM_I} of those that answer."""
        answers = {}
        there = self.registers.address
        byte = bytearray(1)
        for address in addresses:
            self.registers.address = address
            try:
                self.registers.read_into(_WHO_AM_I, byte)
                answers[address] = byte[0]
            except OSError as why:
                self._timed_out = why.args[0] in _TIMED_OUT
        self.registers.address = there
        return answers

    def _absent(self):
        tried = "(WHO_AM_I: no answer to 11 reads in 0.1 s)"
        check = "Check supply, SDA, SCL and their pull-ups"
        if self._timed_out:
            return (
                "the I2C bus timed out (ETIMEDOUT), so it does not tell whether an "
                f"{self._name} is there: SDA or SCL is held low or has no pull-up, or the bus has a timeout= shorter "
                "than a transfer. Switch the sensor off and on, and check the wires; i2c_bus.free() frees a bus whose "
                "chip was cut off in a read"
            )
        if self.searches:
            return f"no {self._name} at 0x68 or 0x69. {check} {tried}"
        address = self.registers.address
        other = 0x69 if address == 0x68 else 0x68
        answers = self._ask((other,))
        if answers:
            hint = (
                f"the chip at 0x{other:02x} answers with 0x{answers[other]:02x}. "
                "AD0 sets the address: low 0x68, high 0x69"
            )
        else:
            hint = f"none at 0x{other:02x} either. {check}"
        return f"no {self._name} at 0x{address:02x}; {hint} {tried}"


class MPU6050(Mpu):
    """An MPU6050 on an I2C bus; mpu.Mpu describes what it can do.

    i2c             has readfrom_mem_into and writeto; give machine.I2C a short timeout: a stuck
                    bus blocks the tick that long
    address         0x68 with AD0 low, 0x69 with AD0 high; None: whichever answers
    accept_unknown  use a part whose identity is not in the table as an MPU6050 with a FIFO of 512 bytes
    """

    def __init__(self, i2c, address=None, accept_unknown=False):
        Mpu.__init__(self, I2CPort(i2c, address, accept_unknown, MPU6050Error, "MPU6050", False))
