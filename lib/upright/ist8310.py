# Driver of the iSentek IST8310 magnetometer: behind an MPU's auxiliary master, or on an I2C bus.
# Needs auxiliary_bus.py with the driver of the MPU, or an I2C object. Runs on MicroPython >= 1.22 and
# under CPython with a `micropython` shim. DS is iSentek's datasheet, IST8310 version 1.2. One file, and
# so long, because both ways to the chip share all but the transfers.

import time
from array import array

import micropython
from micropython import const

from upright.auxiliary_bus import AUX_BUSY, AUX_DONE, AUX_IDLE

_WAI = const(0x00)
_STAT1 = const(0x02)  # then DATAXL..DATAZH, 0x03..0x08
_CNTL1 = const(0x0A)
_CNTL2 = const(0x0B)
_AVGCNTL = const(0x41)
_PDCNTL = const(0x42)

_IDENTITY = const(0x10)
_SINGLE = const(0x01)  # CNTL1: measure once, then back to standby
_SRST = const(0x01)  # CNTL2: soft reset, clears itself
_DREN_DRP = const(0x0C)  # CNTL2: without DREN the DRDY bit stays 0 as well as the pin (DS 6.4)
_PULSE_NORMAL = const(0xC0)  # PDCNTL: what DS 3.1.1 asks for
_DRDY = const(0x01)
_STAT1_RESERVED = const(0xFC)

_LENGTH = const(7)  # STAT1 and data
_START_MS = const(60)  # power-on and reset: 50 ms at most (DS 4.5)
_PROBES = const(20)

# average: AVGCNTL (y in bits 5:3, x and z in bits 2:0), least us between two measurements. DS 3.1 says
# 5 ms for its default, an average of 4, and 6 ms for 16; for 8 the longer one.
_AVERAGES = {1: (0x00, 5000), 2: (0x09, 5000), 4: (0x12, 5000), 8: (0x1B, 6000), 16: (0x24, 6000)}
_MARGIN_PERCENT = const(2)  # both chips' clocks

# Full scale 1600 uT for x and y, 2500 uT for z (DS 4.4), times 3.3 LSB/uT
_MOST_XY = const(5280)
_MOST_Z = const(8250)

_MAG_FRESH = const(2)
_COUNT_MASK = const(0x3FFFFFFF)
_ALL_ROWS = const(0x0F)

# words of the state that take() keeps
_FRESH = const(0)
_STALE = const(1)
_SATURATED = const(2)
_UNFLAGGED = const(3)
_READY = const(4)  # 1: identified and configured
_LEFT = const(5)  # samples until the next measurement is overdue
_LIMIT = const(6)
_N = const(7)
_WAS_DRDY = const(8)
_STATE_WORDS = const(9)


class IST8310Error(OSError):
    """The magnetometer is absent, another chip, or does not keep what is written to it; at set-up only."""


class _IST8310:
    """What does not depend on the bus. A subclass brings _read(register) and _write(register, value),
    which raise OSError, _where, and attach()."""

    chip = "IST8310"
    lsb_per_uT = (33, 10)  # DS 4.4, 14 bits

    def __init__(self, address):
        self._address = address
        self._state = array("i", [0] * _STATE_WORDS)
        self._kept = bytearray(12)  # the data that were used last, and those of the sample before
        self.errors = 0
        self.resets = 0
        self.present = False
        self.sample_rate = None
        self._row = 0
        self._known = 0  # a bit for each row that is as it should be
        self._unproven = 0  # and for each that was written and has not been read since
        self._mending = 0  # 1: this reset is counted already
        self._fixing = 0  # 1: the register of this row is to be written
        self._misses = 0
        self._set_rows(16)

    # Set-up: may wait, allocate and raise

    def configure(self, rate_hz=100, average=16, sample_rate=None):
        """Find the magnetometer, reset and configure it, and let it measure.

        rate_hz      measurements per second at the most, int or (num, den)
        average      1, 2, 4, 8 or 16 readings to a measurement
        sample_rate  how often it is read, int Hz or (num, den); None: the IMU's sample rate (without an
                     IMU 1000 Hz)

        One measurement takes 5 ms (6 ms from an average of 8 on) and falls on every n-th sample, n being 2
        to 32; afterwards sample_rate is what this gives, (num, den) Hz.

        Raises ValueError for a rate that the chip, or n, cannot do, and IST8310Error when the chip is
        absent or does not keep what is written to it. After that attach() is worth while all the same:
        a magnetometer that turns up later is found and configured in the tick.
        """
        self._plan(rate_hz, average, sample_rate)
        self.begin()
        self.attach()
        self._state[_READY] = 1
        self._known = _ALL_ROWS
        self.present = True

    def begin(self):
        """Find the chip, reset it (up to 50 ms), write its registers and read them back."""
        self.present = False
        self._stop()
        who = self._await(_WAI, 0)
        if who != _IDENTITY:
            # WAI can be written, and so be spoilt by noise, even across a short loss of supply; a soft
            # reset mends it (seen by ArduPilot)
            self._reset()
            who = self._await(_WAI, 0)
        if who != _IDENTITY:
            raise IST8310Error(
                f"0x{self._address:02x} {self._where}answers WAI (0x00) with 0x{who:02x}, an IST8310 with "
                f"0x{_IDENTITY:02x}"
            )
        self._reset()
        for register, value, mask in self._rows:
            if register == _WAI:
                continue
            self._safely(self._write, register, value)
            there = self._safely(self._read, register)
            if (there ^ value) & mask:
                raise IST8310Error(
                    f"register 0x{register:02x} of the IST8310: wrote 0x{value:02x}, read 0x{there:02x}"
                )

    def _plan(self, rate_hz, average, sample_rate):
        if average not in _AVERAGES:
            choice = ", ".join(str(a) for a in sorted(_AVERAGES))
            raise ValueError(f"average {average!r} is not one of {choice}")
        num, den = _ratio("sample_rate", sample_rate)
        rate_num, rate_den = _ratio("rate_hz", rate_hz)
        # At least 2, for DRDY shows a new measurement by going away in between
        n = max(2, -(-num * rate_den // (den * rate_num)))
        least = _AVERAGES[average][1] * (100 + _MARGIN_PERCENT)  # us, times 100
        if n * den * 100_000_000 < least * num:
            n = -(-least * num // (den * 100_000_000))
            most = f"at most {num}/{den * n} Hz" if n <= 32 else "no rate at all"
            raise ValueError(
                f"rate_hz {rate_hz!r}: with an average of {average} and {num}/{den} samples per second the "
                f"IST8310 can do {most}"
            )
        if n > 32:
            raise ValueError(
                f"rate_hz {rate_hz!r}: the least is a 32nd of {num}/{den} samples per second"
            )
        self._set_rows(average)
        self._state[_N] = n
        self._state[_LIMIT] = n + 3
        self.sample_rate = _reduced(num, den * n)
        self._step_us = 1_000_000 * den // num
        self._measure_us = least // 100

    def _set_rows(self, average):
        self._rows = (
            (_WAI, _IDENTITY, 0xFF),
            (_CNTL2, _DREN_DRP, _DREN_DRP | _SRST),
            (_AVGCNTL, _AVERAGES[average][0], 0x3F),
            (_PDCNTL, _PULSE_NORMAL, 0xC0),
        )
        self._registers = bytes(row[0] for row in self._rows)
        self._values = bytes(row[1] for row in self._rows)
        self._masks = bytes(row[2] for row in self._rows)

    def _restart(self):
        """Nothing measured yet, nothing known of the chip."""
        state = self._state
        state[_READY] = 0
        state[_WAS_DRDY] = 0
        state[_LEFT] = state[_LIMIT]
        for i in range(len(self._kept)):
            self._kept[i] = 0
        self._row = self._known = self._mending = self._unproven = 0
        self._fixing = self._misses = 0
        self.present = False

    def _reset(self):
        """Soft reset, waited for by its own bit."""
        self._safely(self._write, _CNTL2, _SRST)
        if self._await(_CNTL2, _SRST) & _SRST:
            raise IST8310Error(f"the IST8310 did not come out of reset in {_START_MS} ms")

    def _await(self, register, busy):
        """Read a register until it answers and its busy bits are clear, 60 ms at the most."""
        start = time.ticks_ms()
        while True:
            late = time.ticks_diff(time.ticks_ms(), start) > _START_MS
            try:
                value = self._read(register)
                if not value & busy or late:
                    return value
            except OSError as e:
                why = e
                if late:
                    break
            time.sleep_ms(1)
        raise IST8310Error(
            f"no IST8310 at 0x{self._address:02x} {self._where}({why}). Check its supply, its reset pin and "
            "the pull-ups; CAD0 and CAD1 set the address, 0x0c to 0x0f"
        )

    def _safely(self, function, *what):
        try:
            return function(*what)
        except OSError as e:
            why = e
        raise IST8310Error(f"IST8310: {why}")

    # Counters, wrapping at 2**30

    @property
    def fresh(self):
        """Measurements that were delivered."""
        return self._state[_FRESH]

    @property
    def stale(self):
        """Times that a measurement was overdue: more than two samples late, then once for each missing."""
        return self._state[_STALE]

    @property
    def saturated(self):
        """Measurements that were withheld, an axis being beyond its range."""
        return self._state[_SATURATED]

    @property
    def unflagged(self):
        """Measurements that were recognised by their data, DRDY having gone by unseen."""
        return self._state[_UNFLAGGED]

    # The tick: nothing below allocates, waits, raises or uses a float.

    @micropython.viper
    def take(self, raw: ptr8, at: int, counts: ptr16) -> int:
        """Unpack STAT1 and data at raw[at..at+6]: a new measurement goes to counts[6..8].

        Returns 2 then, else 0. New is what carries DRDY (reading the data clears it, DS 6.4), unless
        the bytes were there with the sample before already: a master that gets no answer leaves them.
        A measurement that ends while it is being read may lose its DRDY; then it is known by data that
        are other than the last ones and have stayed for two samples.
        """
        state = ptr32(self._state)
        kept = ptr8(self._kept)
        left = state[_LEFT] - 1
        drdy = raw[at] & _DRDY
        same = 1  # as what was used last
        still = 1  # as with the sample before
        some = 0
        i = 0
        while i < 6:
            byte = raw[at + 1 + i]
            some |= byte
            if byte != kept[i]:
                same = 0
            if byte != kept[6 + i]:
                still = 0
                kept[6 + i] = byte
            i += 1
        new = 0
        if not raw[at] & _STAT1_RESERVED:  # else nobody drove the bus
            if drdy:
                if not state[_WAS_DRDY] or not same:
                    new = 1
            elif still and some and not same:
                new = 2
        state[_WAS_DRDY] = drdy
        if not new or not state[_READY]:
            if left <= 0:
                state[_STALE] = (state[_STALE] + 1) & _COUNT_MASK
                left = state[_N]
            state[_LEFT] = left
            return 0
        state[_LEFT] = state[_LIMIT]
        i = 0
        while i < 6:
            kept[i] = raw[at + 1 + i]
            i += 1
        if new == 2:
            state[_UNFLAGGED] = (state[_UNFLAGGED] + 1) & _COUNT_MASK
        # little endian, DS 6.4; signed by arithmetic, as CPython's array wants the number
        x = ((raw[at + 1] | raw[at + 2] << 8) ^ 0x8000) - 0x8000
        y = ((raw[at + 3] | raw[at + 4] << 8) ^ 0x8000) - 0x8000
        z = ((raw[at + 5] | raw[at + 6] << 8) ^ 0x8000) - 0x8000
        if x > _MOST_XY or x < -_MOST_XY or y > _MOST_XY or y < -_MOST_XY:
            new = 0
        if z > _MOST_Z or z < -_MOST_Z:
            new = 0
        if not new:
            state[_SATURATED] = (state[_SATURATED] + 1) & _COUNT_MASK
            return 0
        counts[6] = x
        counts[7] = y
        counts[8] = z
        state[_FRESH] = (state[_FRESH] + 1) & _COUNT_MASK
        return _MAG_FRESH

    # The chip's registers, one after the other: as they should be, or to be written. A magnetometer that
    # was absent, that vanished, or that has reset itself goes the same way.

    @micropython.native
    def _was_read(self, value):
        """Judge the register of this row: go on to the next, or have it written."""
        row = self._row
        self._misses = 0
        if row == 0:
            self.present = True
        if not (value ^ self._values[row]) & self._masks[row]:
            self._unproven &= ~(1 << row)
            self._agreed()
            return
        self._fixing = 1
        if not self._mending:
            self._mending = 1
            self.resets = (self.resets + 1) & _COUNT_MASK
        if self._state[_READY]:
            self._state[_READY] = 0
            self._known = 1 if row else 0

    @micropython.native
    def _agreed(self):
        known = self._known | 1 << self._row
        self._known = known
        self._row = (self._row + 1) & 3
        if known == _ALL_ROWS:
            self._mending = 0
            self._state[_READY] = 1

    @micropython.native
    def _was_written(self):
        """The register of this row was written, and acknowledged: taken for granted once, so that the
        magnetometer is soon back; the second time it is read again first, as WAI is after a reset."""
        self._fixing = self._misses = 0
        bit = 1 << self._row
        if self._row and not self._unproven & bit:
            self._unproven |= bit
            self._agreed()

    @micropython.native
    def _fix_register(self):
        """What is written to mend this row; WAI by a soft reset."""
        row = self._row
        return self._registers[row] if row else _CNTL2

    @micropython.native
    def _fix_value(self):
        row = self._row
        return self._values[row] if row else _SRST

    @micropython.native
    def _missed(self):
        """No answer: tried again, but two in a row mean that it is gone, to be looked for from the beginning."""
        self._misses += 1
        if self._misses > 1 or not self.present:
            self._misses = self._fixing = 0
            self.present = False
            self._state[_READY] = 0
            self._row = self._known = self._mending = 0

    def _count_error(self):
        self.errors = (self.errors + 1) & _COUNT_MASK


class IST8310(_IST8310):
    """An IST8310 on the auxiliary bus of an MPU6050 or MPU6500.

    aux      AuxiliaryBus of the configured IMU; attach() takes all of its slots
    address  0x0C to 0x0F by the pins CAD0 and CAD1; 0x0E when they are open

        imu.configure()
        mag = IST8310(AuxiliaryBus(imu))
        mag.configure(rate_hz=100)

    From then on imu.read() or imu.fifo_next() fills counts[6..8] as well and sets bit 1 of the flags with each
    new measurement, and imu.health() looks after the magnetometer. The frame is the chip's own, which is
    left-handed. To be done again after imu.configure().

    Slot 0 reads STAT1 and data with every sample, slot 1 starts a measurement with every n-th.

    Counters, wrapping at 2**30: fresh, stale, saturated, unflagged, errors (looks that found a missing
    acknowledge), resets (times that its registers had to be written). present: it answered when last asked.
    """

    def __init__(self, aux, address=0x0E):
        self._aux = aux
        _IST8310.__init__(self, address)

    @property
    def _where(self):
        return f"behind the {self._aux._imu.chip} "

    def _plan(self, rate_hz, average, sample_rate):
        if sample_rate is None:
            sample_rate = self._aux._imu.sample_rate
        _IST8310._plan(self, rate_hz, average, sample_rate)

    def attach(self):
        """Set the slots up and hand the IMU's samples on to take(), whether the magnetometer answers or not."""
        aux = self._aux
        imu = aux._imu
        if self.sample_rate is None:
            self._plan(100, 16, None)
        imu.attach(None, 0)
        self._stop()
        self._restart()
        aux.periodic_read(self._address, _STAT1, _LENGTH)  # at 0: nothing else is there
        aux.periodic_write(self._address, _CNTL1, _SINGLE, self._state[_N])
        aux.start()
        aux.faults = 0
        imu.attach(self, _LENGTH)

    def _stop(self):
        if self._aux.running:
            self._aux.stop()
        else:
            self._aux.begin()

    def _read(self, register):
        return self._aux.read_register(self._address, register)

    def _write(self, register, value):
        self._aux.write_register(self._address, register, value)

    # The tick

    @micropython.native
    def health(self):
        """Look after the magnetometer's registers, at most two registers of the IMU a call; returns
        present.

        Each of WAI, CNTL2, AVGCNTL and PDCNTL is read in turn and written when it is not as it should be.
        """
        aux = self._aux
        state = aux.poll()
        if state == AUX_BUSY:
            return self.present
        if aux.faults:
            aux.faults = 0
            self._count_error()
        if state == AUX_DONE:
            if self._fixing:
                self._was_written()
            else:
                self._was_read(aux.value)
        elif state != AUX_IDLE:
            self._missed()
        if self._fixing:
            aux.post_write(self._address, self._fix_register(), self._fix_value())
        else:
            aux.post_read(self._address, self._registers[self._row])
        return self.present


class IST8310_I2C(_IST8310):
    """An IST8310 on an I2C bus of the microcontroller.

    i2c      has readfrom_mem_into and writeto, as for MPU6050
    address  0x0C to 0x0F by the pins CAD0 and CAD1; 0x0E when they are open

        mag = IST8310_I2C(i2c)
        mag.configure(rate_hz=100, sample_rate=200)

        def tick(timer):
            imu.read()
            mag.read(imu.counts)

    The counters are those of IST8310; errors are faults of the bus.
    """

    _where = ""

    def __init__(self, i2c, address=0x0E):
        self._i2c = i2c
        self._raw = bytearray(_LENGTH)
        self._one = bytearray(1)
        self._out = bytearray(2)
        self._age = 0  # calls of read() since the measurement was started
        self._due = 1  # calls after which it may be through
        self._n = 2  # calls after which the next is started
        self._got = 1
        _IST8310.__init__(self, address)

    def _plan(self, rate_hz, average, sample_rate):
        _IST8310._plan(self, rate_hz, average, 1000 if sample_rate is None else sample_rate)
        self._n = self._state[_N]
        self._due = min(self._n, self._measure_us // self._step_us)

    def attach(self):
        """Let read() work, and have it look for a magnetometer that configure() did not find."""
        if self.sample_rate is None:
            self._plan(100, 16, None)
        self._restart()
        self._state[_LIMIT] = _COUNT_MASK  # read() knows better when one is overdue
        self._got = 1
        self._age = self._n

    def _stop(self):
        pass

    def _read(self, register):
        self._i2c.readfrom_mem_into(self._address, register, self._one)
        return self._one[0]

    def _write(self, register, value):
        out = self._out
        out[0] = register
        out[1] = value
        self._i2c.writeto(self._address, out)

    # The tick

    @micropython.native
    def read(self, counts):
        """To be called once a sample: fills counts[6..8] and sets bit 1 of counts[10] with each new
        measurement; returns counts[10].

        At most two transfers a call: status and data (7 bytes) once the measurement may be through, the
        start of the next, and in between one register of the configuration.
        """
        age = self._age + 1
        self._age = age
        flags = counts[10] & ~_MAG_FRESH
        if age >= self._due and not self._got and self.present:
            flags |= self._fetch(counts)
        if age >= self._n and (self._got or age > self._n + 2):
            self._start()
        elif age == 1:
            self._look_after()
        counts[10] = flags
        return flags

    @micropython.native
    def _fetch(self, counts):
        if not self._try(0, _STAT1, self._raw):
            return 0
        self._got = self._raw[0] & _DRDY
        return self.take(self._raw, 0, counts)

    @micropython.native
    def _start(self):
        state = self._state
        if not self._got:
            state[_STALE] = (state[_STALE] + 1) & _COUNT_MASK
        state[_LEFT] = _COUNT_MASK
        state[_WAS_DRDY] = 0
        self._got = 0
        self._age = 0
        if self.present:
            self._out[0] = _CNTL1
            self._out[1] = _SINGLE
            self._try(1, _CNTL1, self._out)

    @micropython.native
    def _look_after(self):
        if self._fixing:
            self._out[0] = self._fix_register()
            self._out[1] = self._fix_value()
            if self._try(1, _CNTL2, self._out):
                self._was_written()
                return
        elif self._try(0, self._registers[self._row], self._one):
            self._was_read(self._one[0])
            return
        self._missed()

    @micropython.native
    def _try(self, writing, register, buffer):
        try:
            if writing:
                self._i2c.writeto(self._address, buffer)
            else:
                self._i2c.readfrom_mem_into(self._address, register, buffer)
            return 1
        except OSError:
            self._count_error()
            return 0


def _ratio(name, rate):
    num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
    if not isinstance(num, int) or not isinstance(den, int) or num <= 0 or den <= 0:
        raise ValueError(f"{name} {rate!r} is neither a positive int nor (num, den)")
    return num, den


def _reduced(num, den):
    a, b = num, den
    while b:
        a, b = b, a % b
    return num // a, den // a
