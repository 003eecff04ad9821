# A simulated IST8310 magnetometer: single measurements that take their time, DRDY, soft reset.
# Needs a world to measure (world.py) and a bus that calls it byte by byte: a board's, or the
# auxiliary bus of an MPU (aux_master.py). Portable: CPython and the MicroPython unix port.
# DS is the IST8310 datasheet, version 1.2; where it says nothing the comment says so.

from micropython import const

from chips.common import Faults

_WAI = const(0x00)
_STAT1 = const(0x02)
_DATAXL = const(0x03)
_DATAZH = const(0x08)
_STAT2 = const(0x09)
_CNTL1 = const(0x0A)
_CNTL2 = const(0x0B)
_STR = const(0x0C)
_CNTL3 = const(0x0D)
_TEMPL = const(0x1C)
_TEMPH = const(0x1D)
_AVGCNTL = const(0x41)
_PDCNTL = const(0x42)

_DRDY = const(0x01)
_DOR = const(0x02)
_SINGLE = const(1)
_DREN = const(0x08)
_DRP = const(0x04)
_SRST = const(0x01)
_PULSE_NORMAL = const(0xC0)
_FIELD_LIMIT = const(5280)  # 1600 uT at 3.3 LSB/uT


class IST8310Chip(Faults):
    """One chip on an I2C bus.

    world     what it measures: words 6..8 of a row are its counts at 14 bits (3.3 LSB/uT), in the
              board's body frame
    address   7 bits: 0x0C..0x0F by CAD1 and CAD0, 0x0E when they float (DS 6.1.1)
    axes      the board's map of the magnetometer: body x, y, z as "x", "-y", ... of the chip. Undone
              here, so that a board with the same map gets the world's words back
    restarts  a trigger during a measurement begins it anew. DS does not say; by default it is lost,
              since boards of the vendor's are triggered every 4 ms and still deliver

    Data registers change one by one as a measurement ends, in the middle of a burst too: DS
    promises nothing else.

    Its int_level is the DRDY pin. Not simulated: noise, cross-axis registers, temperature.
    """

    # DS 4.5: up to 50 ms; these are less, to be changed at will
    reset_us = 20_000  # after a soft reset: no answer

    def __init__(self, world, address=0x0E, axes=("x", "y", "z"), restarts=False, now=0):
        self._init_faults(now)
        self.world = world
        self.address = address
        self.restarts = restarts
        self.measure_us = None  # a number here is the time of every measurement
        self.disturbance = (0, 0, 0)  # counts that a magnet beside it adds, body frame
        self.measurements = 0  # done since the start of the simulation
        self.int_level = 0
        self.hung = False  # in the middle of a byte that nobody clocks out
        self.clocks_free = True  # False: only a reset ends that (RM-MPU-6000A 4.27)
        self._from_body = _inverse(axes)
        self._held = False  # by its reset pin
        self._pointer = 0
        self._pointing = False
        self._power_on_reset()

    def _power_on_reset(self):
        self._registers = bytearray(256)
        self._registers[_WAI] = 0x10
        self._registers[_CNTL2] = _DREN | _DRP
        # averages 4 times, 5 ms; DS names this default and prints a reset value of 0 beside it
        self._registers[_AVGCNTL] = 0x12
        self._done_us = None  # when the measurement under way ends
        self._plain = False
        self.hung = False
        self._drive_pin()

    # Faults, see Faults also

    def reset_pin(self, level, now):
        """RSTN, active low."""
        self.poll(now)
        if not level:
            self._power_on_reset()
        elif self._held:
            self._dead_until = self._now + self.power_up_us
        self._held = not level

    def bus_cut(self, now):
        """The master stopped in the middle of a transaction: this chip waits for the next clock."""
        self.poll(now)
        self.hung = True

    def bus_clocked(self, now):
        """A master tries a transaction while the chip hangs."""
        self.hung = self.hung and not self.clocks_free

    # Measuring

    def poll(self, now):
        """Catch up with time."""
        if now > self._now:
            self._now = now
        if self._done_us is not None and self._now >= self._done_us:
            self._finish()

    def begin_anew(self):
        """A recorded trial begins: no measurement of the time before it is left, or under way."""
        self._done_us = None
        self._registers[_STAT1] = self._registers[_CNTL1] = 0
        self._drive_pin()

    def next_event(self):
        """Absolute time in us of the next change of the DRDY pin by itself, or None."""
        return self._done_us if self._registers[_CNTL2] & _DREN else None

    def measurement_us(self):
        """How long one takes. DS 3.1.1: 5 ms averaging 4 times, 6 ms averaging 16 times; in between
        as if every conversion took as long (the channels follow one another)."""
        if self.measure_us is not None:
            return self.measure_us
        control = self._registers[_AVGCNTL]
        times = 2 * _averages(control) + _averages(control >> 3)
        return (168_000 + times * 1000) // 36

    def _trigger(self):
        if self._done_us is not None and not self.restarts:
            return
        if self._registers[_PDCNTL] & _PULSE_NORMAL != _PULSE_NORMAL:
            self._misused("measured without PDCNTL = 0xC0")  # DS 3.1.1: must be written once
        took = self.measurement_us()
        self._done_us = self._now + took
        self._middle_us = self._now + took // 2

    def _finish(self):
        r = self._registers
        row = self.world.row(self.world.index_at(self._middle_us))
        total = 0
        for axis in range(3):
            word, sign = self._from_body[axis]
            value = sign * (row[6 + word] + self.disturbance[word])
            if r[_STR] & 0x40:
                value = -value  # DS 6.4, STR: self-test turns the polarity round
            total += abs(value)
            if r[_CNTL3] & (0x10 << axis):
                value = _clipped(4 * value, 32768)  # 16 bits: 13.2 LSB/uT
            else:
                value = _clipped(value, 8192)
            r[_DATAXL + 2 * axis] = value & 0xFF
            r[_DATAXL + 2 * axis + 1] = value >> 8 & 0xFF
        # DS 6.4, STAT2: INT while the axes' absolute values together exceed 1600 uT
        r[_STAT2] = 0x08 if total > _FIELD_LIMIT else 0
        # DS 6.4, STAT1: DRDY follows the pin, so it stays 0 without DREN; DOR: data were skipped
        if r[_CNTL2] & _DREN:
            r[_STAT1] = r[_STAT1] | _DOR if r[_STAT1] & _DRDY else _DRDY
        r[_CNTL1] = 0  # DS 6.4, CNTL1: stand-by again
        self._done_us = None
        self.measurements += 1
        self._drive_pin()

    def _drive_pin(self):
        control = self._registers[_CNTL2]
        ready = self._registers[_STAT1] & _DRDY
        self.int_level = 1 if bool(ready) == bool(control & _DRP) else 0

    # Registers

    def _get(self, register):
        r = self._registers
        value = r[register]
        if _DATAXL <= register <= _STAT2 and r[_STAT1]:
            # DS 6.4, STAT1: reading any data register clears both, reading STAT2 clears DRDY;
            # reading STAT1 itself does not
            r[_STAT1] = r[_STAT1] & _DOR if register == _STAT2 else 0
            self._drive_pin()
        return self._stuck.get(register, value)

    def _set(self, register, value):
        r = self._registers
        if register <= _STAT2 or register in (_TEMPL, _TEMPH):
            return  # read only
        if register == _CNTL2 and value & _SRST:
            self._power_on_reset()  # DS 6.4, CNTL2: the same as power-on
            self._dead_until = self._now + self.reset_us
            return
        if register == _CNTL1:
            value &= 0x0F
            r[_CNTL1] = value
            if value == _SINGLE:
                self._trigger()
            elif value:
                self._misused("CNTL1 mode %d is reserved" % value)  # DS 6.4
            else:
                self._done_us = None
            return
        r[register] = value
        if register == _CNTL2:
            if not value & _DREN:
                r[_STAT1] = 0
            self._drive_pin()

    # I2C

    def i2c_start(self, read, now):
        self.poll(now)
        if self.hung:
            self.bus_clocked(now)
            return False
        if self._held or not self._acknowledge():
            return False
        self._pointing = not read
        self._plain = not self._stuck
        return True

    def i2c_write(self, byte, now):
        self.poll(now)
        if self._held or not self._acknowledge():
            return False
        if self._pointing:
            self._pointer = byte
            self._pointing = False
            return True
        if self.log is not None:
            self.log.append((self._now, self._pointer, byte))
        self._set(self._pointer, byte)
        self._pointer = (self._pointer + 1) & 0xFF
        return True

    def i2c_read(self, now):
        if now > self._now:
            self._now = now
        if self._done_us is not None and now >= self._done_us:
            self._finish()
        at = self._pointer
        self._pointer = (at + 1) & 0xFF
        if self._plain and not self._registers[_STAT1]:
            return self._registers[at]  # most bytes: nothing to clear, and no fault
        if self._gone or self._held or self._now < self._dead_until:
            return 0xFF
        return self._get(at)

    def i2c_stop(self, now):
        self.poll(now)


def _inverse(axes):
    """For chip x, y, z: (which word of the body frame, its sign)."""
    inverse = [None, None, None]
    for body in range(3):
        axis = axes[body]
        sign = -1 if axis[0] == "-" else 1
        inverse["xyz".index(axis[-1])] = (body, sign)
    if None in inverse:
        raise ValueError("axes must name x, y and z once each")
    return inverse


def _averages(code):
    """DS 6.4, AVGCNTL: 0 none, 1..4 two to sixteen, all others none."""
    code &= 7
    return 1 << code if code <= 4 else 1


def _clipped(value, limit):
    return -limit if value < -limit else limit - 1 if value >= limit else value
