# What drivers of the InvenSense MPU6050 family share: samples, FIFO, register table and its repair.
# Needs a subclass that moves bytes over its bus. Runs on MicroPython >= 1.22 and under CPython with
# a `micropython` shim. RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A rev 3.4, RM-6500 RM-MPU-6500A
# rev 2.1. One class, and so long, because samples, FIFO and repair hang on the same state.

import time
from array import array

import micropython
from micropython import const

# What health() answers
HEALTH_OK = const(0)  # the register read back as written
HEALTH_MISMATCH = const(1)  # it did not: the chip has reset itself; the next call begins the repair
HEALTH_REPAIRING = const(2)  # the register table is being written back and read back
HEALTH_BUS_ERROR = const(3)  # the bus failed; the same register is taken again next time

_SMPLRT_DIV = const(0x19)
_CONFIG = const(0x1A)
_GYRO_CONFIG = const(0x1B)
_ACCEL_CONFIG = const(0x1C)
_ACCEL_CONFIG2 = const(0x1D)
_FIFO_EN = const(0x23)
_INT_PIN_CFG = const(0x37)
_INT_ENABLE = const(0x38)
_INT_STATUS = const(0x3A)
_USER_CTRL = const(0x6A)
_PWR_MGMT_1 = const(0x6B)
_PWR_MGMT_2 = const(0x6C)
_FIFO_COUNTH = const(0x72)
_FIFO_R_W = const(0x74)

_NAMES = {
    _SMPLRT_DIV: "SMPLRT_DIV",
    _CONFIG: "CONFIG",
    _GYRO_CONFIG: "GYRO_CONFIG",
    _ACCEL_CONFIG: "ACCEL_CONFIG",
    _ACCEL_CONFIG2: "ACCEL_CONFIG2",
    _FIFO_EN: "FIFO_EN",
    _INT_PIN_CFG: "INT_PIN_CFG",
    _INT_ENABLE: "INT_ENABLE",
    _USER_CTRL: "USER_CTRL",
    _PWR_MGMT_1: "PWR_MGMT_1",
    _PWR_MGMT_2: "PWR_MGMT_2",
}

_DATA_RDY = const(0x01)  # INT_STATUS and INT_ENABLE
_FIFO_OFLOW = const(0x10)
_NO_STATUS = const(0xA4)  # bits of INT_STATUS that no part of the family ever sets (RM 4.16)
_FIFO_ENABLE = const(0x40)  # USER_CTRL.FIFO_EN
_I2C_IF_DIS = const(0x10)  # USER_CTRL; clears itself on the 6500 (RM-6500 4.27)
_FIFO_RESET = const(0x04)
_FIFO_ALL = const(0xF8)  # FIFO_EN: TEMP, XG, YG, ZG, ACCEL
_SLEEP = const(0x40)
_CLK_PLL = const(0x01)  # CLKSEL 1, PLL on the X gyro: RM 4.28 prefers it to the internal oscillator

_PACKET = const(14)  # accel x y z, temperature, gyro x y z
_FLAGS = const(10)
_FULL_SCALE_FLAGS = const(0x0C)
_COUNT_MASK = const(0x3FFFFFFF)  # counters wrap within a small int of 32-bit ports

_ACCEL_RANGES = (2, 4, 8, 16)  # g; RM 4.5, LSB per g RM 4.17
_GYRO_RANGES = (250, 500, 1000, 2000)  # deg/s; RM 4.4
_GYRO_SCALES = ((131, 1), (131, 2), (164, 5), (82, 5))  # LSB per deg/s, RM 4.19
# Gyro bandwidth by DLPF_CFG 0..6, Hz, RM 4.3; RM-6500 4.5 gives 250, 184, 92, 41, 20, 10, 5
_BANDWIDTHS = (256, 188, 98, 42, 20, 10, 5)
_BANDWIDTHS_6500 = (250, 184, 92, 41, 20, 10, 5)
_DELAYS_MS = (1, 3, 4, 6, 10, 18, 34)  # filter delay rounded up, the longer of the two parts
_GYRO_START_MS = const(30)  # PS 6.1: zero-rate output settled


@micropython.viper
def unpack(raw: ptr8, at: int, counts: ptr16) -> int:
    """Big-endian accel, temperature, gyro at raw[at..at+13] into counts; returns the flags."""
    flags = 1
    i = 0
    while i < 6:
        j = at + i + i
        if i > 2:
            j += 2  # past the temperature
        # signed by arithmetic: viper stores the low 16 bits, CPython's array wants the number
        word = ((raw[j] << 8 | raw[j + 1]) ^ 0x8000) - 0x8000
        counts[i] = word
        if word == 0x7FFF or word == -0x8000:
            flags |= 4 if i < 3 else 8
        i += 1
    counts[9] = ((raw[at + 6] << 8 | raw[at + 7]) ^ 0x8000) - 0x8000
    counts[10] = flags
    return flags


def ratio(rate):
    """(num, den) of a rate given as int Hz or as (num, den), reduced. Raises ValueError."""
    num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
    if not isinstance(num, int) or not isinstance(den, int) or num <= 0 or den <= 0:
        raise ValueError(f"sample_rate_hz {rate!r} is neither a positive int nor (num, den)")
    a, b = num, den
    while b:
        a, b = b, a % b
    return num // a, den // a


def divider(base_hz, rate):
    """The whole divider of base_hz that comes nearest to rate, (num, den) Hz.

    Raises ValueError when none of 1..256 comes within 0.5 %. The chip's own clock is good to 1 %
    (PS 7.15), so a smaller difference drowns in it, while a larger one would turn every angle by as
    much.
    """
    num, den = rate
    n = (2 * base_hz * den + num) // (2 * num)
    n = 1 if n < 1 else 256 if n > 256 else n
    if abs(base_hz * den - num * n) * 200 > num * n:
        n = base_hz * den // num
        lower = min(max(n + 1, 1), 256)
        upper = min(max(n, 1), 256)
        raise ValueError(
            f"sample_rate_hz {num}/{den} is not {base_hz} divided by 1 to 256; "
            f"next to it are {base_hz}/{lower} and {base_hz}/{upper}"
        )
    return n


def _index(name, value, allowed):
    for i in range(len(allowed)):
        if allowed[i] == value:
            return i
    choice = ", ".join(str(a) for a in allowed)
    raise ValueError(f"{name} {value!r} is not one of {choice}")


class MpuBase:
    """Everything that does not depend on the bus. A subclass brings:

    _read_into(register, buffer)  fills the buffer from the register on; may raise OSError
    _write(register, value)       one register; may raise OSError; like the other it allocates nothing
    _begin()                      finds, identifies and resets the chip: sets chip, who_am_i,
                                  family_6500, fifo_size and _temperature
    _error                        the exception class for faults at set-up

    What set-up and the tick share is not guarded: no method of the set-up while a tick is running.
    """

    def __init__(self):
        self.counts = array("h", bytes(22))  # ax ay az gx gy gz mx my mz temp flags
        self.errors = 0
        self.stale = 0
        self.resets = 0
        self.fifo_overflows = 0
        self.fifo_resets = 0
        self.fifo_lost = 0
        self.fifo_level = 0
        self.chip = None
        self.who_am_i = None
        self.family_6500 = False
        self.fifo_size = 1024
        self.repair_calls = 0
        self._user_ctrl = 0  # USER_CTRL without FIFO_EN
        self._temperature = (5, 17, 3653)
        self._raw = bytearray(1 + _PACKET)
        self._one = bytearray(1)
        self._status = bytearray(1)
        self._two = bytearray(2)
        self._registers = bytearray(0)  # the table of rows: register, value
        self._values = bytearray(0)
        self._begun = False
        self._configured = False
        self._fifo_on = False
        self._batch = bytearray(0)
        self._views = ()
        self._batch_max = 0
        self._pending = 0  # packets of the batch not yet delivered
        self._at = 0  # where the next one begins
        self._dirty = 0  # 1: the FIFO's packet boundary is not certain, restart it first
        self._hold = 0  # samples still to be withheld; -1: until the repair is through
        self._hold_samples = 0
        self._row = 0  # the row that health() takes next
        self._suspect = 0  # 1: a reset would explain what was seen
        self._looked = 0  # 1: the last health() went out of turn
        self._writing = -1  # row to write back, -1 when there is nothing to repair
        self._verifying = 0  # rows to read back before the repair counts as done

    # Set-up: may wait, allocate and raise

    def configure(
        self, accel_range_g=8, gyro_range_dps=2000, dlpf=None, sample_rate_hz=1000, settle=True
    ):
        """Set the chip up and start it; finds and resets it first unless begin() has.

        accel_range_g   2, 4, 8 or 16
        gyro_range_dps  250, 500, 1000 or 2000
        dlpf            DLPF_CFG 0..6: gyro bandwidth 256, 188, 98, 42, 20, 10, 5 Hz (RM 4.3); None
                        picks the widest that stays within half the sample rate
        sample_rate_hz  int or (num, den): 1000 Hz (with dlpf 0 8000 Hz) divided by 1 to 256. The
                        nearest of these is taken when it lies within 0.5 %
        settle          wait for the gyro's start-up and the filter (from 34 ms on)

        Afterwards accel_lsb_per_g is an int, gyro_scale the exact LSB per deg/s as (num, den),
        sample_rate the exact rate as (num, den) Hz; bandwidth_hz, dlpf, accel_range_g and
        gyro_range_dps say what was set; FIFO mode is off, the INT pin gives pulses, active high.

        Raises ValueError for a setting that the part does not have, and the driver's own error for
        a chip that is absent, is another one, or does not keep what was written to it.
        """
        self._configured = False
        afs = _index("accel_range_g", accel_range_g, _ACCEL_RANGES)
        fs = _index("gyro_range_dps", gyro_range_dps, _GYRO_RANGES)
        rate = ratio(sample_rate_hz)
        if dlpf is not None:
            dlpf = _index("dlpf", dlpf, (0, 1, 2, 3, 4, 5, 6))
        if not self._begun:
            self.begin()
        bandwidths = _BANDWIDTHS_6500 if self.family_6500 else _BANDWIDTHS
        if dlpf is None:
            dlpf = 0
            if rate[0] <= 1000 * rate[1]:
                dlpf = 1
                while dlpf < 6 and 2 * bandwidths[dlpf] * rate[1] > rate[0]:
                    dlpf += 1
        base = 1000 if dlpf else 8000
        if self.family_6500 and not dlpf and rate != (8000, 1):
            # RM-6500 4.4: SMPLRT_DIV works with 0 < DLPF_CFG < 7 only
            raise ValueError(f"dlpf 0 of this {self.chip} runs at 8000 Hz only")
        n = divider(base, rate)

        rows = [
            # awake first: the other registers keep what is written either way
            (_PWR_MGMT_1, _CLK_PLL),
            (_PWR_MGMT_2, 0),
            (_SMPLRT_DIV, n - 1),
            (_CONFIG, dlpf),
            (_GYRO_CONFIG, fs << 3),
            (_ACCEL_CONFIG, afs << 3),
        ]
        if self.family_6500:
            # RM-6500 4.8: the accelerometer has a filter of its own
            rows.append((_ACCEL_CONFIG2, dlpf))
        rows += [
            # never INT_RD_CLEAR: any read would then wipe the FIFO overflow flag (RM 4.14)
            (_INT_PIN_CFG, 0),
            (_FIFO_EN, 0),
            (_INT_ENABLE, _DATA_RDY),
            (_USER_CTRL, self._user_ctrl),  # last: this is what starts the FIFO
        ]
        self._registers = bytes(row[0] for row in rows)
        self._values = bytearray(row[1] for row in rows)
        self.repair_calls = 2 * len(rows) + 2
        self._row = self._suspect = self._looked = self._verifying = 0
        self._writing = -1
        self._fifo_on = False
        self._pending = self._dirty = self.fifo_level = 0

        self.accel_range_g = _ACCEL_RANGES[afs]
        self.gyro_range_dps = _GYRO_RANGES[fs]
        self.dlpf = dlpf
        self.bandwidth_hz = bandwidths[dlpf]
        self.accel_lsb_per_g = 16384 >> afs
        self.gyro_scale = _GYRO_SCALES[fs]
        self.sample_rate = ratio((base, n))
        self._settle_ms = _GYRO_START_MS + 4 * _DELAYS_MS[dlpf]
        self._hold_samples = 1 + self._settle_ms * self.sample_rate[0] // (
            1000 * self.sample_rate[1]
        )
        self._apply()
        self._configured = True
        self._hold = 0
        if settle:
            self._settle()

    def begin(self):
        """Find the chip, check its identity, reset it (0.1 s). Raises the driver's own error."""
        self._begin()
        self._begun = True

    def configure_interrupt(self, active_low=False, open_drain=False, latch=False):
        """How the INT pin tells of a sample: a pulse of 50 us, or with latch a level until read()."""
        self._need_configured()
        value = (0x80 if active_low else 0) | (0x40 if open_drain else 0) | (0x20 if latch else 0)
        self._set_row(_INT_PIN_CFG, value)

    def fifo_enable(self, batch=8):
        """Let the chip queue its samples; from now on drive it with fifo_poll() and fifo_next().

        batch: packets of 14 bytes that one fifo_poll() fetches at most, in one burst; 1 to what the
        FIFO holds.
        """
        self._need_configured()
        if not 1 <= batch <= self.fifo_size // _PACKET:
            raise ValueError(f"batch {batch!r} is not 1 to {self.fifo_size // _PACKET}")
        if batch != self._batch_max:
            self._batch = bytearray(batch * _PACKET)
            whole = memoryview(self._batch)
            self._views = [whole[: n * _PACKET] for n in range(batch + 1)]
            self._batch_max = batch
        self._pending = self.fifo_level = 0
        self._dirty = 1
        self._set_row(_FIFO_EN, _FIFO_ALL)
        self._set_row(_INT_ENABLE, _DATA_RDY | _FIFO_OFLOW)
        self._values[len(self._values) - 1] = self._user_ctrl | _FIFO_ENABLE
        self._fifo_on = True
        self._fifo_restart()
        if self._dirty:
            raise self._error("the bus failed while the FIFO was started")

    def fifo_disable(self):
        """Back to read(). What the FIFO still holds is dropped."""
        self._need_configured()
        self._fifo_on = False
        self._pending = self._dirty = self.fifo_level = 0
        self._set_row(_USER_CTRL, self._user_ctrl)
        self._set_row(_FIFO_EN, 0)
        self._set_row(_INT_ENABLE, _DATA_RDY)

    def sleep(self):
        """Stop sampling (about 5 uA, PS 6.3) until wake(); the configuration stays."""
        self._need_configured()
        self._set_row(_PWR_MGMT_1, _CLK_PLL | _SLEEP)

    def wake(self):
        """Sample again, after the gyro's start-up time."""
        self._need_configured()
        self._set_row(_PWR_MGMT_1, _CLK_PLL)
        self._settle()
        self._pending = 0
        if self._fifo_on:
            self._dirty = 1  # what came in while the gyro settled is not wanted

    def registers(self):
        """The configuration as a list of (register, value), in the order in which it is written."""
        return [(self._registers[i], self._values[i]) for i in range(len(self._registers))]

    def _settle(self):
        # the gyro's start-up (PS 6.1) and four times the filter's delay, so that its step response
        # has died away
        time.sleep_ms(self._settle_ms)
        self._set_up_read(_INT_STATUS, self._raw)  # what was ready meanwhile is not a fresh sample

    def _need_configured(self):
        if not self._configured:
            raise self._error("configure() first")

    def _apply(self):
        """Write the whole table, then read it back."""
        for register, value in self.registers():
            self._set_up_write(register, value)
        for register, value in self.registers():
            self._verify(register, value)

    def _set_row(self, register, value):
        """Change one row of the table, on the chip as well."""
        self._values[self._registers.find(bytes((register,)))] = value
        self._set_up_write(register, value)
        self._verify(register, value)

    def _verify(self, register, value):
        self._set_up_read(register, self._one)
        if self._one[0] != value:
            name = _NAMES.get(register, "register")
            raise self._error(
                f"{name} (0x{register:02x}): wrote 0x{value:02x}, read 0x{self._one[0]:02x}"
            )

    def _set_up_read(self, register, buffer):
        try:
            self._read_into(register, buffer)
            return
        except OSError as e:
            fault = e
        self._bus_error(fault, "reading", register)

    def _set_up_write(self, register, value):
        try:
            self._write(register, value)
            return
        except OSError as e:
            fault = e
        self._bus_error(fault, "writing", register)

    def _bus_error(self, fault, verb, register):
        name = _NAMES.get(register, "register")
        raise self._error(f"bus error ({fault}) while {verb} {name} (0x{register:02x})")

    # The tick: nothing below allocates, waits, raises or uses a float. Native where it is on the way of every
    # sample: half the time of bytecode.

    @micropython.native
    def read(self):
        """Fetch the newest sample into counts; returns its flags (bit 0: fresh).

        One burst from INT_STATUS on, so that DATA_RDY tells a new sample from one already read.
        When there is none, or the bus fails, or the gyro has not settled after a repair, bit 0 is
        clear and the words keep what they held.
        """
        raw = self._raw
        try:
            self._read_into(_INT_STATUS, raw)
        except OSError:
            return self._fault()
        status = raw[0]
        if status & _NO_STATUS:  # nobody drove the bus
            return self._fault()
        if status & _FIFO_OFLOW:
            self._dirty = 1  # reading the flag has cleared it
        if not status & _DATA_RDY:
            self.stale = (self.stale + 1) & _COUNT_MASK
            self._suspect = 1
            return self._not_fresh()
        if self._hold:
            return self._withhold()
        return unpack(raw, 1, self.counts)

    def temperature_cdeg(self):
        """Temperature of the newest sample in hundredths of a degC, by the formula of the part."""
        mul, div, offset = self._temperature
        return (self.counts[9] * mul + (div >> 1)) // div + offset

    def fifo_poll(self):
        """Fetch up to `batch` packets; returns how many fifo_next() has: 0 = none, or a fault.

        The packets are given out only after a look at INT_STATUS that follows the burst: if the
        FIFO overflowed at any time up to there, or the chip reset itself, or the bus failed, packet
        boundaries are not certain any more; then the whole batch is dropped and the FIFO restarted.
        fifo_level is what is left in the chip.
        """
        if self._pending or not self._fifo_on or self._writing >= 0:
            return self._pending
        if self._dirty:
            self._fifo_restart()
            return 0
        # whole packets only: the chip may be in the middle of writing one
        level = self._fifo_bytes() // _PACKET
        self.fifo_level = level
        if not level:
            self._suspect = 1
            return 0
        return self._fifo_drain(level if level < self._batch_max else self._batch_max)

    @micropython.native
    def fifo_next(self):
        """Put the next packet of the batch into counts, as read() does; returns its flags, 0 when
        there is none."""
        if not self._pending:
            self._not_fresh()
            return 0
        at = self._at
        self._at = at + _PACKET
        self._pending -= 1
        if self._hold:
            return self._withhold()
        return unpack(self._batch, at, self.counts)

    @micropython.native
    def health(self):
        """Compare one configuration register with what was written to it; returns a HEALTH_ state.

        One register a call, in turn; PWR_MGMT_1 out of turn (at most every second call) after a
        stale or failed sample. A difference means that the chip has reset itself (a supply dip): it
        is counted in resets, and the following calls write the table back, one register each, then
        read it back, one register each. Until that is through and the gyro has settled (30 ms and
        the filter's delay, in samples of the chip) no sample is fresh. From the first stale sample
        on this takes at most repair_calls calls, if the bus works.
        """
        row = self._writing
        if row >= 0:
            return self._restore(row)
        row = self._row
        if self._verifying:
            self._looked = 0
        elif self._suspect and not self._looked:
            self._suspect = 0
            self._looked = 1
            row = 0
        else:
            self._looked = 0
        state = self._compare(row)
        if state == HEALTH_BUS_ERROR:
            return state
        # while the FIFO waits for its restart, USER_CTRL may be anything
        if state == HEALTH_MISMATCH and not (self._dirty and self._registers[row] == _USER_CTRL):
            self.resets = (self.resets + 1) & _COUNT_MASK
            self._hold = -1
            self._writing = 0
            self._verifying = 0
            return HEALTH_MISMATCH
        if not self._looked:
            row += 1
            self._row = row if row < len(self._registers) else 0
        if not self._verifying:
            return HEALTH_OK
        self._verifying -= 1
        if not self._verifying:
            self._hold = self._hold_samples
        return HEALTH_REPAIRING

    # Its parts. A bytecode frame over 11 words comes from the heap, and a `try` takes three of them:
    # hence so many small functions, and hardly a name beside a `try`.

    @micropython.native
    def _compare(self, row):
        """Does a register still hold what the table says?"""
        try:
            self._read_into(self._registers[row], self._one)
        except OSError:
            self._fault()
            return HEALTH_BUS_ERROR
        return HEALTH_OK if self._one[0] == self._values[row] else HEALTH_MISMATCH

    def _restore(self, row):
        """Write one row back."""
        try:
            self._write(self._registers[row], self._values[row])
        except OSError:
            self._fault()
            return HEALTH_BUS_ERROR
        row += 1
        if row < len(self._registers):
            self._writing = row
        else:
            self._writing = -1
            self._verifying = row
            self._row = 0
            if self._fifo_on:
                self._dirty = 1
        return HEALTH_REPAIRING

    def _fifo_bytes(self):
        try:
            # high byte first: it latches the low (RM 4.30)
            self._read_into(_FIFO_COUNTH, self._two)
        except OSError:
            self._fault()
            return 0
        level = self._two[0] << 8 | self._two[1]
        if level <= self.fifo_size:
            return level
        self._dirty = 1  # a chip that dies in the middle leaves the bus high: 0xffff
        self._fault()
        return 0

    def _fifo_drain(self, n):
        """Take n packets out, or none if they may not be whole ones."""
        self._dirty = 1  # until shown otherwise: an interrupted burst has taken part of a packet
        if self._fifo_fetch(n):
            self._dirty = 0
            self.fifo_level -= n
            self._at = 0
            self._pending = n
            return n
        if self._status[0] & _FIFO_OFLOW:
            self.fifo_overflows = (self.fifo_overflows + 1) & _COUNT_MASK
        self.fifo_lost = (self.fifo_lost + self.fifo_level) & _COUNT_MASK
        self.fifo_level = 0
        self._fifo_restart()
        return 0

    def _fifo_fetch(self, n):
        """Read n packets in one burst; 1 if nothing has shifted or replaced them up to its end."""
        self._status[0] = 0
        try:
            self._read_into(_FIFO_R_W, self._views[n])
            self._read_into(_INT_STATUS, self._status)
            if self._status[0] & _FIFO_OFLOW:
                return 0
            # DATA_RDY since the last look proves that INT_ENABLE still holds, so that there was no
            # reset. Without it ask: a FIFO that a reset has emptied repeats its last byte for ever.
            if self._status[0] & _DATA_RDY:
                return 1
            self._read_into(_USER_CTRL, self._one)
        except OSError:
            self._fault()
            return 0
        # the whole register: a chip that dies now leaves the bus high, 0xff
        if (self._one[0] ^ (self._user_ctrl | _FIFO_ENABLE)) & ~_I2C_IF_DIS == 0:
            return 1
        self._suspect = 1
        return 0

    def _fifo_restart(self):
        """Empty the FIFO. On the MPU6050 FIFO_RESET works only while FIFO_EN is 0 (RM 4.27)."""
        try:
            self._write(_USER_CTRL, self._user_ctrl)
            self._write(_USER_CTRL, self._user_ctrl | _FIFO_RESET)
            self._read_into(_INT_STATUS, self._one)  # an overflow of the past
            self._write(_USER_CTRL, self._user_ctrl | _FIFO_ENABLE)
        except OSError:
            self._fault()
            return
        self._dirty = 0
        self.fifo_resets = (self.fifo_resets + 1) & _COUNT_MASK

    def _withhold(self):
        """A sample that came before the gyro had settled: counted down, and not fresh."""
        if self._hold > 0:
            self._hold -= 1
        return self._not_fresh()

    def _fault(self):
        self.errors = (self.errors + 1) & _COUNT_MASK
        self._suspect = 1
        return self._not_fresh()

    def _not_fresh(self):
        counts = self.counts
        flags = counts[_FLAGS] & _FULL_SCALE_FLAGS
        counts[_FLAGS] = flags
        return flags
