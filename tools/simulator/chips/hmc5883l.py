# A simulated HMC5883L magnetometer: single and continuous measurements, gains, overflow, the lock of its data.
# Needs compass.py. Portable: CPython and the MicroPython unix port. DS is Honeywell's datasheet 900405 rev E.

from micropython import const

from chips.compass import Compass

_CRA = const(0x00)
_CRB = const(0x01)
_MODE = const(0x02)
_DATA = const(0x03)
_LAST = const(0x08)
_STATUS = const(0x09)
_ID = const(0x0A)
_END = const(0x0D)

_RDY = const(0x01)
_LOCK = const(0x02)
_CONTINUOUS = const(0)
_SINGLE = const(1)
_IDLE = const(3)
_OVERFLOW = const(-4096)
_LSB_PER_GA = (1370, 1090, 820, 660, 440, 390, 330, 230)  # DS table 9
_MILLIHERTZ = (750, 1500, 3000, 7500, 15_000, 30_000, 75_000, 75_000)  # DS table 5
_PLACES = (0, 4, 2)  # of x, y, z in the data: z comes before y, DS table 2


class HMC5883LChip(Compass):
    """One chip on an I2C bus; see Compass.

    ready_stays  RDY is cleared by the next measurement only, as table 17 says; else also by reading data, as the
                 description of the single measurement mode says

    Not simulated: the bias of the self-test, high speed mode, the DRDY pin.
    """

    def __init__(self, world, address=0x1E, axes=("x", "y", "z"), ready_stays=False, now=0):
        self.ready_stays = ready_stays
        Compass.__init__(self, world, address, axes, now)

    def _power_on_reset(self):
        self._registers = bytearray(_END)
        self._registers[_CRA] = 0x10
        self._registers[_CRB] = 0x20
        self._registers[_MODE] = _SINGLE
        self._registers[_ID:_END] = b"H43"
        self._gain = 1
        self._unread = 0  # data registers that lock the others, a bit for each
        self._done_us = None

    def _took(self):
        # DS: 6 ms. It does not say how long an average takes; at 75 Hz eight samples fit into 13.3 ms
        return self.measure_us or 6000 + 1000 * ((1 << (self._registers[_CRA] >> 5 & 3)) - 1)

    def _finish(self, at):
        r = self._registers
        mode = r[_MODE] & 3
        if mode == _CONTINUOUS:
            self._done_us = at + 1_000_000_000 // _MILLIHERTZ[r[_CRA] >> 2 & 7]
        else:
            r[_MODE] = r[_MODE] & 0x80 | _IDLE
        gain = self._gain
        self._gain = r[_CRB] >> 5  # DS table 8: a new gain counts from the second measurement on
        if self._unread:
            return  # DS table 17, LOCK
        for axis, value in enumerate(self._field(at - 3000, _LSB_PER_GA[gain], 100)):
            value = value if -2048 <= value <= 2047 else _OVERFLOW
            self._put(_DATA + _PLACES[axis], value, True)
        r[_STATUS] |= _RDY

    def _get(self, register):
        r = self._registers
        value = r[register]
        if _DATA <= register <= _LAST:
            if not self._unread:
                self._unread = 0x3F
            self._unread &= ~(1 << (register - _DATA))
            if not self.ready_stays:
                r[_STATUS] &= ~_RDY
            r[_STATUS] = r[_STATUS] | _LOCK if self._unread else r[_STATUS] & ~_LOCK
        return value

    def _set(self, register, value):
        r = self._registers
        if register > _MODE:
            return  # read only
        if register == _CRA and value & 0x83:
            self._misused("CRA 0x%02x: self-test is not simulated" % value)
        r[register] = value
        if register <= _MODE:
            self._unread = 0  # DS table 17: a change of the mode or of CRA ends the lock
            r[_STATUS] &= ~_LOCK
        if register == _MODE:
            mode = value & 3
            if self._done_us is not None and mode == _SINGLE:
                self._misused("a measurement was started during another one")
            self._done_us = None if mode >= 2 else self._now + self._took()
            if mode < 2:
                r[_STATUS] &= ~_RDY

    def _next(self, register):
        # DS: from 0x08 the pointer goes back to 0x03, from 0x0C to 0x00
        return _DATA if register == _LAST else 0 if register == _END - 1 else register + 1
