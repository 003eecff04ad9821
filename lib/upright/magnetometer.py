# What the drivers of magnetometers share: one chip behind an IMU's auxiliary bus or on a bus of its own, its rate, and
# the check of its registers. Needs registers.py, and auxiliary_bus.py for a chip behind an IMU. Runs on
# MicroPython >= 1.22 and under CPython with a `micropython` shim. A driver is a subclass that says what differs, as in
# ist8310.py.

import time
from array import array

import micropython
from micropython import const

from upright.registers import I2CRegisters, eight_bits

_MAG_FRESH = const(2)
_COUNT_MASK = const(0x3FFFFFFF)
_READY = const(1)  # in the status of every chip
_DATA = const(6)  # bytes, behind the status
_NEVER_AT = const(6)  # in the table of a layout: NEVER, then OVERFLOW
_MAG = const(6)  # of counts

_BUSY = const(-1)  # what transact() returns, as in auxiliary_bus.py
_NACK = const(-2)

# -- words of the state: written by tools/upright_host/words.py
_FRESH = const(0)  # measurements that were delivered
_STALE = const(1)  # times that a measurement was overdue
_SATURATED = const(2)  # measurements that were withheld, an axis being beyond its range
_UNFLAGGED = const(3)  # measurements that were recognised by their data
_STEP = const(4)  # what the look at a register is for
_LEFT = const(5)  # samples until the next measurement is overdue
_LIMIT = const(6)  # LEFT after a measurement
_N = const(7)  # samples from one measurement to the next
_WAS_READY = const(8)  # the status said so with the sample before
_X = const(9)  # 3: the newest measurement
_NEXT = const(12)  # 3: the one that is being unpacked
_DUE = const(15)  # calls of read() after which a measurement may be through; 0 behind an IMU
_AGE = const(16)  # calls of read() since the last one was started
_WAITING = const(17)  # 1: it has not come yet
_LATE = const(18)  # calls of read() after which it is overdue
_WORDS = const(19)
# -- end of the words

# _STEP: what the next access to a register is for. Measurements are delivered in _WATCH only.
_ABSENT = const(0)  # does it answer?
_CHECK = const(1)  # it has answered: are its registers still correct?
_REPAIR = const(2)  # a register was wrong: read all again
_WRITE = const(3)  # this register is being written
_WATCH = const(4)  # all registers are correct

_MARGIN_PERCENT = const(2)  # both chips' clocks


class OwnBus:
    """A magnetometer's registers on a bus of the microcontroller, with the methods of AuxiliaryDevice that a
    Magnetometer uses."""

    own_bus = True
    where = ""
    sample_rate = 1000

    def __init__(self, registers):
        self._registers = registers
        self._byte = bytearray(1)
        self.errors = 0

    def begin(self):
        pass

    def attach(self, *what):
        pass

    # The tick

    @micropython.native
    def transact(self, register, data):
        if data < 0:
            return self._byte[0] if self.fetch(register, self._byte) else _NACK
        try:
            self._registers.write(register, data)
            return 0
        except OSError:
            self._fault()
            return _NACK

    @micropython.native
    def fetch(self, register, buffer):
        """1, or 0 when the bus failed."""
        try:
            self._registers.read_into(register, buffer)
            return 1
        except OSError:
            self._fault()
            return 0

    def _fault(self):
        self.errors = (self.errors + 1) & _COUNT_MASK


class Magnetometer:
    """What the drivers of all magnetometer chips share.

    bus      AuxiliaryBus of a configured IMU, whose slots are all used then; or an I2C bus (has
             readfrom_mem_into and writeto), or the chip's I2CRegisters
    address  on that bus

    own_bus False: imu.read() or imu.fifo_next() fills counts[6..8] and sets bit 1 of the flags with each new
    measurement, and imu.health() checks the chip. own_bus True: read() does both; call it once a sample. The frame is
    the chip's own.

    Counters, wrapping at 2**30: fresh, stale, saturated, unflagged, errors (behind an IMU: checks that found a missing
    acknowledge; else faults of the bus), resets (how often its registers had to be written). present: it answered the
    last access.

    A subclass defines

        chip, error_class   the name, and the class of its exceptions, an OSError
        lsb_per_uT          (num, den)
        ADDRESSES           that it can have
        IDENTITY            (register, its bytes)
        AVERAGES            {readings to a measurement: least us from one measurement to the next}
        AVERAGE             the default; None: the largest
        STATUS              the register of the status (ready: bit 0), read before the data; None: it is the first byte
                            of SAMPLE
        SAMPLE              (register, length) of the six data bytes, perhaps with the status before and more behind
        LAYOUT              places in the sample, whose byte 0 is the status: low and high byte of x, y, z
        NEVER               bits that are never set in the status
        OVERFLOW            (place, bit) of the flag for a field that is too strong, (0, 0): none
        MOST                what x, y, z are at most
        START               (register, value) that starts a measurement; None: it measures by itself, at one of RATES
        RATES               {Hz: bits of a register}, where START is None
        RESET               (register, bit) of the soft reset; the bit clears itself; None: it has none
        RESET_MS            the longest time until it answers after that, or after power-on
        HINT                what to check when nothing answers
        registers_for(average)   rows (register, value, mask) of its configuration behind the identity; self.rate is
                                 one of RATES
        adjust()            after the reset: what the chip says about its sensitivity goes into self.gains
    """

    def __init__(self, bus, address):
        if isinstance(address, int) and address >> 1 in self.ADDRESSES:
            raise eight_bits(address)
        if hasattr(bus, "device"):
            self._registers = self._link = bus.device(address)
        else:
            if hasattr(bus, "readfrom_mem_into"):
                bus = I2CRegisters(bus, address)
            elif not hasattr(bus, "read_into"):
                raise TypeError(f"{bus!r} is neither an AuxiliaryBus nor an I2C bus")
            self._registers = bus
            self._link = OwnBus(bus)
        self.own_bus = self._link.own_bus
        self._transact = self._link.transact  # fetching a bound method allocates
        if self.own_bus:
            self._fetch = self._link.fetch
        self._registers.error_class = self.error_class
        self._registers.name = self._name
        self._state = array("i", [0] * _WORDS)
        self.gains = array("i", (256, 256, 256))  # of x, y, z; 256: as it is
        self.rate = max(self.RATES) if self.RATES else 0
        place, bit = self.OVERFLOW
        self._layout = bytes(self.LAYOUT + (self.NEVER, place, bit))
        self._most = array("i", self.MOST)
        # for take(): the data that were used last, and the data of the sample before
        self._kept = bytearray(12)
        self._set_rows(self.AVERAGE or max(self.AVERAGES))
        self._start, self._start_value = self.START or (0, 0)
        self._free = self.START is None
        self._sample, length = self.SAMPLE
        self._status = -1
        self._ready = bytearray(1)
        self._raw = self._data = bytearray(length)
        if self.STATUS is not None:
            self._status = self.STATUS
            self._raw = bytearray(1 + length)
            self._data = memoryview(self._raw)[1:]
        self.resets = 0
        self.sample_rate = None
        self._row = 0
        self._unseen = 0  # rows that have not been read as correct yet
        self._misses = 0

    AVERAGE = STATUS = START = RESET = None
    OVERFLOW = (0, 0)
    RATES = {}

    # Set-up: may wait, allocate and raise

    def configure(self, rate_hz=100, average=None, sample_rate=None):
        """Find the magnetometer, reset and configure it, and start it.

        rate_hz      measurements per second at most, int or (num, den)
        average      readings to a measurement, one of AVERAGES; None: the default, mostly the largest
        sample_rate  how often it is read, int Hz or (num, den); None: the IMU's sample rate (without an
                     IMU 1000 Hz)

        There is a measurement with every n-th sample, n = 2 to 32; a chip that measures by itself has the next lower of
        its RATES. Afterwards sample_rate is the resulting rate, (num, den) Hz.

        Raises ValueError for a rate that is not possible, and error_class when the chip is absent or does not keep
        what is written to it. Call attach() also then: the tick finds and configures a magnetometer that answers later.
        """
        self._plan(rate_hz, average, sample_rate)
        self.begin()
        self.attach()
        self._state[_STEP] = _WATCH

    def begin(self):
        """Find the chip, reset it, write its registers and read them back."""
        self._state[_STEP] = _ABSENT
        self._link.begin()
        right = self.IDENTITY[1]
        who = self._identify()
        if who != right and self.RESET:
            # the identity is writable: noise or a short loss of supply can change it, and a soft reset restores it
            # (seen by ArduPilot)
            try:
                self._reset()
            except OSError:
                pass  # of another chip
            who = self._identify()
        stuck = who == right and self._reset()
        if stuck:  # or is it another chip, which showed this by chance?
            who = self._identify()
        if who != right:
            raise self.error_class(
                f"0x{self._registers.address:02x}{self._link.where} answers register 0x{self.IDENTITY[0]:02x} with "
                f"{hexadecimal(who)}, and the identity of the {self.chip} is {hexadecimal(right)}: it is another chip"
            )
        if stuck:
            raise self.error_class(
                f"the {self.chip} did not come out of reset in {self.RESET_MS} ms"
            )
        self.adjust()
        for register, value, mask in self._rows[1:]:
            self._registers.write_register(register, value)
            self._registers.verify_register(register, value, mask)

    def adjust(self):
        pass

    def attach(self):
        """Let the tick read the chip, and search for it if configure() did not find it."""
        if self.sample_rate is None:
            self._plan(100, None, None)
        state = self._state
        state[_STEP] = _ABSENT
        state[_WAS_READY] = 0
        state[_LEFT] = state[_LIMIT]
        for i in range(len(self._kept)):
            self._kept[i] = 0
        self._row = self._misses = 0
        state[_WAITING] = 0
        state[_AGE] = state[_N]
        reads = (self.SAMPLE,) if self.STATUS is None else ((self.STATUS, 1), self.SAMPLE)
        self._link.attach(self, reads, self.START, state[_N])

    def _plan(self, rate_hz, average, sample_rate):
        if average is None:
            average = self.AVERAGE or max(self.AVERAGES)
        if average not in self.AVERAGES:
            choice = ", ".join(str(a) for a in sorted(self.AVERAGES))
            raise ValueError(f"average {average!r} is not one of {choice}")
        if sample_rate is None:
            sample_rate = self._link.sample_rate
        num, den = _ratio("sample_rate", sample_rate)
        rate_num, rate_den = _ratio("rate_hz", rate_hz)
        if self._free:
            return self._plan_free(average, (num, den), rate_hz, (rate_num, rate_den))
        # At least 2: DRDY must go away between two measurements
        n = max(2, -(-num * rate_den // (den * rate_num)))
        least = self.AVERAGES[average] * (100 + _MARGIN_PERCENT)  # us, times 100
        if n * den * 100_000_000 < least * num:
            n = -(-least * num // (den * 100_000_000))
            most = f"at most {num}/{den * n} Hz" if n <= 32 else "no rate at all"
            raise ValueError(
                f"rate_hz {rate_hz!r}: with an average of {average} and {num}/{den} samples per second the "
                f"{self.chip} can do {most}"
            )
        if n > 32:
            raise ValueError(
                f"rate_hz {rate_hz!r}: the least is a 32nd of {num}/{den} samples per second"
            )
        self._expect(average, n, n + 2, min(n, max(1, least * num // (100_000_000 * den))))
        self.sample_rate = _ratio("", (num, den * n))

    def _plan_free(self, average, sample, rate_hz, rate):
        """The chip has a clock of its own: the fastest of its rates that is asked for, at most every second sample."""
        num, den = sample
        rates = [r for r in self.RATES if r * rate[1] <= rate[0] and 2 * r * den <= num]
        if not rates:
            raise ValueError(
                f"rate_hz {rate_hz!r}: with {num}/{den} samples per second the {self.chip} has none of its rates "
                f"({', '.join(str(r) for r in sorted(self.RATES))} Hz)"
            )
        self.rate = max(rates)
        n = num // (den * self.rate)
        # its clock and the IMU's may differ by an eighth
        self._expect(average, n, n + 2 + n // 8, max(1, n * 7 // 8 - 1))
        self.sample_rate = (self.rate, 1)

    def _expect(self, average, n, late, due):
        self._set_rows(average)
        state = self._state
        state[_N] = n
        state[_LATE] = late
        state[_LIMIT] = late + 1
        state[_DUE] = 0
        if self.own_bus:
            state[_LIMIT] = _COUNT_MASK  # read() itself knows when one is overdue
            state[_DUE] = due

    def _set_rows(self, average):
        register, identity = self.IDENTITY
        rows = self._rows = ((register, identity[0], 0xFF),) + self.registers_for(average)
        self._numbers = bytes(row[0] for row in rows)
        self._values = bytes(row[1] for row in rows)
        self._masks = bytes(row[2] for row in rows)
        # what is written to correct a row; the identity needs a reset, or nothing helps
        register, value = self.RESET or rows[1][:2]
        self._mend_numbers = bytes((register,)) + self._numbers[1:]
        self._mend_values = bytes((value,)) + self._values[1:]

    def _reset(self):
        """Soft reset, if it has one; waits until its bit clears, and returns the bit."""
        if self.RESET is None:
            return 0
        register, bit = self.RESET
        self._registers.write_register(register, bit)
        return self._await(register, bit) & bit

    def _identify(self):
        register, right = self.IDENTITY
        found = [self._await(register)]
        for i in range(1, len(right)):
            found.append(self._registers.read_register(register + i))
        return bytes(found)

    def _await(self, register, busy=0):
        """Read a register until it answers and its busy bits are clear, RESET_MS at most."""
        byte = bytearray(1)
        start = time.ticks_ms()
        while True:
            late = time.ticks_diff(time.ticks_ms(), start) > self.RESET_MS
            try:
                self._registers.read_into(register, byte)
                if not byte[0] & busy or late:
                    return byte[0]
            except OSError as e:
                why = e
                if late:
                    break
            time.sleep_ms(1)
        raise self.error_class(
            f"no {self.chip} at 0x{self._registers.address:02x}{self._link.where} ({why}). {self.HINT}"
        )

    def _name(self, register):
        return f"register 0x{register:02x} of the {self.chip}"

    # For programs

    def field(self):
        """The newest measurement in uT: (x, y, z), in the chip's frame; None before the first."""
        num, den = self.lsb_per_uT
        state = self._state
        before = None
        while before != state[_FRESH]:  # a tick may cut in
            before = state[_FRESH]
            x, y, z = state[_X], state[_X + 1], state[_X + 2]
        return (x * den / num, y * den / num, z * den / num) if before else None

    @property
    def present(self):
        """Whether it answered the last access."""
        return self._state[_STEP] != _ABSENT

    @property
    def errors(self):
        """Behind an IMU: checks that found a missing acknowledge. On a bus of its own: faults of the bus."""
        return self._link.errors

    @property
    def fresh(self):
        """Number of delivered measurements."""
        return self._state[_FRESH]

    @property
    def stale(self):
        """Number of overdue measurements: more than two samples late, then once for each further one."""
        return self._state[_STALE]

    @property
    def saturated(self):
        """Number of withheld measurements: an axis was out of range."""
        return self._state[_SATURATED]

    @property
    def unflagged(self):
        """Number of measurements recognised by their data, because the chip's flag was lost."""
        return self._state[_UNFLAGGED]

    # The tick: nothing below allocates, waits, raises or uses a float.

    @micropython.native
    def read(self, counts):
        """On a bus of its own, call this once a sample: it fills counts[6..8] and sets bit 1 of counts[10] with each
        new measurement, and returns counts[10]. Behind an IMU it does nothing: the IMU's samples bring the
        measurements.

        At most three transfers a call: status and data when the measurement may be ready, the start of the next one;
        between them one register of the configuration.
        """
        flags = counts[10]
        state = self._state
        due = state[_DUE]
        if not due:
            return flags
        flags &= ~_MAG_FRESH
        age = state[_AGE] + 1
        state[_AGE] = age
        waiting = state[_WAITING]
        if waiting and age >= due and state[_STEP] and self._fetched():
            flags |= self.take(self._raw, 0, counts)
            waiting = 1 - state[_WAS_READY]
            if self._free and not waiting:
                state[_WAS_READY] = 0
                age = state[_AGE] = 0
                waiting = 1
            state[_WAITING] = waiting
        if age >= state[_N] and (not waiting or age > state[_LATE]):
            if waiting:
                state[_STALE] = (state[_STALE] + 1) & _COUNT_MASK
            state[_LEFT] = _COUNT_MASK
            state[_WAS_READY] = 0
            state[_WAITING] = 1
            state[_AGE] = 0
            if state[_STEP] and not self._free:
                self._transact(self._start, self._start_value)
        elif age == 1:
            self.health()
        counts[10] = flags
        return flags

    @micropython.native
    def _fetched(self):
        """Fetch the sample, if the status says that there is one or lies in the sample."""
        status = self._status
        if status < 0:
            return self._fetch(self._sample, self._raw)
        ready = self._ready
        if not self._fetch(status, ready) or not ready[0] & _READY:
            return 0
        self._raw[0] = ready[0]
        return self._fetch(self._sample, self._data)

    @micropython.viper
    def take(self, raw: ptr8, at: int, counts: ptr16) -> int:
        """Unpack the status at raw[at] and the data behind it: a new measurement goes to counts[6..8].

        Returns 2 then, else 0. A measurement is new if it is ready (reading the data clears that), unless the
        bytes equal those of the sample before: a master that gets no answer keeps them. A measurement that ends during
        a read may lose its flag. It is recognised by data that differ from the last ones and stay for two samples.
        """
        state = ptr32(self._state)
        kept = ptr8(self._kept)
        layout = ptr8(self._layout)
        left = state[_LEFT] - 1
        drdy = raw[at] & _READY
        same = 1  # as what was used last
        still = 1  # as with the sample before
        some = 0
        i = 0
        while i < _DATA:
            byte = raw[at + 1 + i]
            some |= byte
            if byte != kept[i]:
                same = 0
            if byte != kept[_DATA + i]:
                still = 0
                kept[_DATA + i] = byte
            i += 1
        new = 0
        if not raw[at] & layout[_NEVER_AT]:  # else it is a floating bus
            if drdy:
                if not state[_WAS_READY] or not same:
                    new = 1
            elif still and some and not same:
                new = 2
        state[_WAS_READY] = drdy
        if not new or state[_STEP] != _WATCH:
            if left <= 0:
                state[_STALE] = (state[_STALE] + 1) & _COUNT_MASK
                left = state[_N]
            state[_LEFT] = left
            return 0
        state[_LEFT] = state[_LIMIT]
        i = 0
        while i < _DATA:
            kept[i] = raw[at + 1 + i]
            i += 1
        if new == 2:
            state[_UNFLAGGED] = (state[_UNFLAGGED] + 1) & _COUNT_MASK
        if raw[at + layout[_NEVER_AT + 1]] & layout[_NEVER_AT + 2]:
            new = 0
        gains = ptr32(self.gains)
        most = ptr32(self._most)
        i = 0
        while i < 3:
            # signed by arithmetic, as CPython's array wants the number
            value = raw[at + layout[2 * i]] | raw[at + layout[2 * i + 1]] << 8
            value = (((value ^ 0x8000) - 0x8000) * gains[i] + 128) >> 8
            if value > most[i] or value < 0 - most[i]:
                new = 0
            state[_NEXT + i] = value
            i += 1
        if not new:
            state[_SATURATED] = (state[_SATURATED] + 1) & _COUNT_MASK
            return 0
        i = 0
        while i < 3:
            state[_X + i] = state[_NEXT + i]
            # ptr32 loads are unsigned on x86-64: signed again
            counts[_MAG + i] = ((state[_NEXT + i] & 0xFFFF) ^ 0x8000) - 0x8000
            i += 1
        state[_FRESH] = (state[_FRESH] + 1) & _COUNT_MASK
        return _MAG_FRESH

    @micropython.native
    def health(self):
        """Check the chip's registers; returns present.

        Each register is read in turn. A wrong one is written and read again, and no measurement is delivered until all
        have been read as correct. Behind an IMU a call accesses at most two of the IMU's registers.
        """
        state = self._state
        row = self._row
        writing = state[_STEP] == _WRITE
        if writing:
            outcome = self._transact(self._mend_numbers[row], self._mend_values[row])
        else:
            outcome = self._transact(self._numbers[row], -1)
        if outcome >= 0:
            self._misses = 0
            if writing:
                state[_STEP] = _REPAIR
            else:
                self._judge(outcome)
        elif outcome != _BUSY:
            self._missed()
        return state[_STEP] != _ABSENT

    @micropython.native
    def _judge(self, value):
        """The register of this row was read: go on to the next row, or write it."""
        state = self._state
        step = state[_STEP]
        row = self._row
        rows = len(self._numbers)
        wrong = (value ^ self._values[row]) & self._masks[row]
        if step == _ABSENT or step == _WATCH or (wrong and not row):
            self._unseen = rows
        if wrong:
            if step != _REPAIR:
                self.resets = (self.resets + 1) & _COUNT_MASK
            state[_STEP] = _WRITE
            return
        self._row = row + 1 if row + 1 < rows else 0
        self._unseen -= 1
        if step == _ABSENT:
            state[_STEP] = _CHECK
        elif not self._unseen:
            state[_STEP] = _WATCH

    @micropython.native
    def _missed(self):
        """No answer: try again. Two in a row mean that the chip is gone: search for it from the beginning."""
        self._misses += 1
        if self._misses > 1:
            self._misses = self._row = 0
            self._state[_STEP] = _ABSENT


def hexadecimal(values):
    return " ".join([f"0x{value:02x}" for value in values])


def _ratio(name, rate):
    """(num, den) of an int or (num, den), reduced."""
    num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
    if not isinstance(num, int) or not isinstance(den, int) or num <= 0 or den <= 0:
        raise ValueError(f"{name} {rate!r} is neither a positive int nor (num, den)")
    a, b = num, den
    while b:
        a, b = b, a % b
    return num // a, den // a
