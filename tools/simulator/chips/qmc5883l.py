# A simulated QMC5883L magnetometer: continuous measurements by its own clock, DRDY, OVL, DOR, pointer roll-over.
# Needs compass.py. Portable: CPython and the MicroPython unix port. DS is QST's datasheet 13-52-04 rev A.

from micropython import const

from chips.compass import Compass, clipped

_DATA = const(0x00)
_STATUS = const(0x06)
_CONTROL_1 = const(0x09)
_CONTROL_2 = const(0x0A)
_SET_RESET_PERIOD = const(0x0B)
_CHIP_ID = const(0x0D)

_DRDY = const(0x01)
_OVL = const(0x02)
_DOR = const(0x04)
_CONTINUOUS = const(0x01)
_ROL_PNT = const(0x40)
_SOFT_RST = const(0x80)
_RATES = (10, 50, 100, 200)  # ODR, DS 9.2.4


class QMC5883LChip(Compass):
    """One chip on an I2C bus; see Compass.

    clock_ppm  how much faster than the nominal rate it measures; DS gives no tolerance

    Not simulated: noise by over-sample ratio, the temperature, the DRDY pin.
    """

    def __init__(self, world, address=0x0D, axes=("x", "y", "z"), clock_ppm=0, now=0):
        self.clock_ppm = clock_ppm
        Compass.__init__(self, world, address, axes, now)

    def _power_on_reset(self):
        self._registers = bytearray(0x0E)
        self._registers[_CHIP_ID] = 0xFF
        self._done_us = None

    def _period_us(self):
        rate = _RATES[self._registers[_CONTROL_1] >> 2 & 3]
        return self.measure_us or 1_000_000_000_000 // (rate * (1_000_000 + self.clock_ppm))

    def _finish(self, at):
        r = self._registers
        self._done_us = at + self._period_us()
        lsb = 3000 if r[_CONTROL_1] & 0x10 else 12000
        status = _DRDY
        for axis, value in enumerate(self._field(at - 2000, lsb, 100)):
            if not -32768 <= value <= 32767:
                status |= _OVL  # DS 9.2.2; cleared by the next measurement in range
            self._put(_DATA + 2 * axis, clipped(value, 32767), False)
        if r[_STATUS] & _DRDY:
            status |= _DOR  # DS 9.2.2: data were skipped
        r[_STATUS] = status

    def _get(self, register):
        value = self._registers[register]
        if register < _STATUS:
            self._registers[_STATUS] &= (
                _OVL  # DS 9.2.2: reading any of the data clears DRDY and DOR
            )
        return value

    def _set(self, register, value):
        r = self._registers
        if not _CONTROL_1 <= register <= _SET_RESET_PERIOD:
            return  # read only
        if register == _CONTROL_2 and value & _SOFT_RST:
            self._power_on_reset()
            self._dead_until = self._now + self.reset_us
            return
        was = r[_CONTROL_1]
        r[register] = value
        if register == _CONTROL_1 and value != was:
            if value & _CONTINUOUS and r[_SET_RESET_PERIOD] != 0x01:
                self._misused("measures with a SET/RESET period other than 0x01")  # DS 9.2.5
            self._done_us = self._now + self._period_us() if value & _CONTINUOUS else None

    def _next(self, register):
        # DS 9.2.4, ROL_PNT: the pointer rolls over within 0x00..0x06
        if register == _STATUS and self._registers[_CONTROL_2] & _ROL_PNT:
            return _DATA
        return register + 1
