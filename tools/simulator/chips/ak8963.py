# A simulated AK8963 magnetometer: single and continuous measurements, fuse ROM, overflow, data protection.
# Needs compass.py. Portable: CPython and the MicroPython unix port. DS is AKM's datasheet MS1356-E-02.

from micropython import const

from chips.compass import Compass, clipped

_WIA = const(0x00)
_INFO = const(0x01)
_ST1 = const(0x02)
_HXL = const(0x03)
_HZH = const(0x08)
_ST2 = const(0x09)
_CNTL1 = const(0x0A)
_CNTL2 = const(0x0B)
_ASTC = const(0x0C)
_I2CDIS = const(0x0F)
_ASAX = const(0x10)
_ASAZ = const(0x12)

_DRDY = const(0x01)
_DOR = const(0x02)
_HOFL = const(0x08)
_BIT = const(0x10)  # CNTL1, mirrored in ST2 as BITM
_POWER_DOWN = const(0x00)
_SINGLE = const(0x01)
_FUSE_ROM = const(0x0F)
_PERIOD_US = {0x02: 125_000, 0x06: 10_000}  # continuous measurement 1 and 2, DS 6.4.3
_MODE_US = const(100)  # in power-down before another mode, DS, Operation Modes


class AK8963Chip(Compass):
    """One chip on an I2C bus; see Compass.

    asa  the fuse ROM: sensitivity adjustment of x, y, z. What it delivers is the world divided by that

    Not simulated: external trigger and self-test modes, SPI, the DRDY pin, I2CDIS.
    """

    def __init__(self, world, address=0x0C, axes=("x", "y", "z"), asa=(176, 178, 165), now=0):
        self.asa = asa
        Compass.__init__(self, world, address, axes, now)

    def _power_on_reset(self):
        # DS 8.2: everything 0 but the identity; the fuse ROM shows in its mode only
        self._registers = bytearray(0x13)
        self._registers[_WIA] = 0x48
        self._registers[_INFO] = 0x9A
        self._done_us = None
        self._protected = False
        self._down_since = self._now - _MODE_US

    def _took(self):
        return self.measure_us or 7200  # DS, Analog Circuit Characteristics: typical; 9000 at most

    def _finish(self, at):
        r = self._registers
        mode = r[_CNTL1] & 0x0F
        if mode in _PERIOD_US:
            self._done_us = at + _PERIOD_US[mode]
        if self._protected:
            # DS 6.4.3: from the first byte of data that is read until ST2 is, the data are not replaced
            r[_ST1] |= _DOR
            return
        sixteen = r[_CNTL1] & _BIT
        lsb, per = (20, 3) if sixteen else (5, 3)
        limit = 32760 if sixteen else 8190
        total = 0
        for axis, value in enumerate(self._field(at - self._took() // 2, lsb, per)):
            total += abs(value)
            value = (2 * value * 256 + self.asa[axis] + 128) // (2 * (self.asa[axis] + 128))
            self._put(_HXL + 2 * axis, clipped(value, limit), False)
        # DS, Magnetic Sensor Overflow: |x| + |y| + |z| >= 4912 uT
        r[_ST2] = sixteen | (_HOFL if total * per >= 4912 * lsb else 0)
        if mode in _PERIOD_US and r[_ST1] & _DRDY:
            r[_ST1] |= _DOR
        r[_ST1] |= _DRDY
        if mode == _SINGLE:
            r[_CNTL1] &= _BIT  # DS 6.4.2: power-down by itself
            self._down_since = at - _MODE_US

    def _get(self, register):
        r = self._registers
        value = r[register]
        if _HXL <= register <= _ST2:
            # DS 8.3.3: DRDY and DOR return to 0 as ST2 or data are read
            r[_ST1] = 0
            self._protected = register != _ST2 and r[_CNTL1] & 0x0F in _PERIOD_US
        elif _ASAX <= register <= _ASAZ:
            # DS, ASAX to ASAZ: to be read in fuse ROM mode
            value = self.asa[register - _ASAX] if r[_CNTL1] & 0x0F == _FUSE_ROM else 0
        return value

    def _set(self, register, value):
        r = self._registers
        if register == _CNTL2 and value & 0x01:
            self._power_on_reset()
            self._dead_until = self._now + self.reset_us
        elif register == _CNTL1:
            self._change_mode(value & 0x1F)
        elif register == _ASTC:
            r[register] = value & 0x40

    def _change_mode(self, value):
        r = self._registers
        before, mode = r[_CNTL1] & 0x0F, value & 0x0F
        r[_CNTL1] = value
        self._done_us = None
        self._protected = False
        if mode == _POWER_DOWN:
            self._down_since = self._now
            return
        if before not in (_POWER_DOWN, mode):
            self._misused("mode 0x%x straight from mode 0x%x, not by power-down" % (mode, before))
        if before == _POWER_DOWN and self._now - self._down_since < _MODE_US:
            self._misused("a mode within 100 us of power-down")
        if mode == _SINGLE or mode in _PERIOD_US:
            self._done_us = self._now + self._took()
        elif mode != _FUSE_ROM:
            self._misused("mode 0x%x is reserved or not simulated" % mode)
