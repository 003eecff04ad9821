# What drivers of the InvenSense MPU6050 family share in the tick: samples, FIFO, and repair of the registers.
# Needs mpu_setup.py, mpu_parts.py and a subclass that moves bytes over its bus. Runs on MicroPython >= 1.22 and
# under CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2, RM-6500 RM-MPU-6500A rev 2.1.

import micropython
from micropython import const

from upright.mpu_setup import MpuSetup

# What health() answers
HEALTH_OK = const(0)  # the register read back as written
HEALTH_MISMATCH = const(1)  # it did not: the chip has reset itself; the next call begins the repair
HEALTH_REPAIRING = const(2)  # the register table is being written back and read back
HEALTH_BUS_ERROR = const(3)  # the bus failed; the same register is taken again next time

_INT_STATUS = const(0x3A)
_USER_CTRL = const(0x6A)
_FIFO_COUNTH = const(0x72)
_FIFO_R_W = const(0x74)
_WHO_AM_I = const(0x75)

_DATA_RDY = const(0x01)  # INT_STATUS and INT_ENABLE
_FIFO_OFLOW = const(0x10)
_NO_STATUS = const(0xA4)  # bits of INT_STATUS that no part of the family ever sets (RM 4.16)
_FIFO_ENABLE = const(0x40)  # USER_CTRL.FIFO_EN
_I2C_MST_EN = const(0x20)
_I2C_IF_DIS = const(0x10)  # USER_CTRL; clears itself on the 6500 (RM-6500 4.27)
_FIFO_RESET = const(0x04)
_PACKET = const(14)  # accel x y z, temperature, gyro x y z
_FLAGS = const(10)
_FULL_SCALE_FLAGS = const(0x0C)
_COUNT_MASK = const(0x3FFFFFFF)  # counters wrap within a small int of 32-bit ports


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


class MpuBase(MpuSetup):
    """Everything that does not depend on the bus. A subclass brings:

    registers    I2CRegisters or SPIRegisters, handed to __init__
    _begin()     finds, identifies and resets the chip: sets chip, who_am_i, family_6500, fifo_size and
                 _temperature
    _INTERFACE   the bits of USER_CTRL that its bus wants: I2C_IF_DIS or none

    What set-up and the tick share is not guarded: no method of the set-up while a tick is running.
    """

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
        counts = self.counts
        flags = unpack(raw, 1, counts)
        ext = self._ext
        if ext is not None:
            flags |= ext.take(raw, 1 + _PACKET, counts)
            counts[_FLAGS] = flags
        return flags

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
        level = self._fifo_bytes()
        packets = level // self._packet
        self.fifo_level = packets
        if not packets:
            self._suspect = 1
            return 0
        # What came last is a whole packet, so where a fraction is left either the chip is writing one
        # or the first has lost its beginning: wait, if need be until the FIFO is full, and drop all.
        level -= packets * self._packet
        if level and packets < self._full:
            return 0
        return self._fifo_drain(packets if packets < self._batch_max else self._batch_max, level)

    @micropython.native
    def fifo_next(self):
        """Put the next packet of the batch into counts, as read() does; returns its flags, 0 when
        there is none."""
        if not self._pending:
            self._not_fresh()
            return 0
        at = self._at
        self._at = at + self._packet
        self._pending -= 1
        if self._hold:
            return self._withhold()
        counts = self.counts
        flags = unpack(self._batch, at, counts)
        ext = self._ext
        if ext is not None:
            flags |= ext.take(self._batch, at + _PACKET, counts)
            counts[_FLAGS] = flags
        return flags

    @micropython.native
    def health(self):
        """Compare one configuration register with what was written to it; returns a HEALTH_ state.

        One register a call, in turn; PWR_MGMT_1 out of turn (at most every second call) after a
        stale or failed sample. A difference means that the chip has reset itself (a supply dip): it
        is counted in resets, and the following calls switch the FIFO off, write the table back, one
        register each, then read it back, one register each. Until that is through and the gyro has
        settled (30 ms or 35 and the filter's delay, in samples of the chip) no sample is fresh. From the
        first stale sample on this takes at most repair_calls calls, if the bus works. What attach()
        has attached gets every second turn, as long as the chip is in order.
        """
        row = self._writing
        if row >= 0:
            return self._restore(row)
        if self._ext_turn and not self._verifying and (self._looked or not self._suspect):
            self._ext_turn = 0
            self._looked = 0
            self._ext.health()
            return HEALTH_OK
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
            if self._ext is not None:
                self._ext_turn = 1
        if not self._verifying:
            return HEALTH_OK
        self._verifying -= 1
        if not self._verifying:
            left = self._hold_samples - self._settled
            self._hold = left if left > 0 else 0
        return HEALTH_REPAIRING

    # Its parts. A bytecode frame over 11 words comes from the heap, and a `try` takes three of them:
    # hence so many small functions, and hardly a name beside a `try`.

    @micropython.native
    def _compare(self, row):
        """Does a register still hold what the table says?"""
        try:
            self._read_into(self._registers[row], self._one)
            if not (self._one[0] ^ self._values[row]) & self._masks[row]:
                return HEALTH_OK
            # is it the chip that says so, or a bus that nobody drives?
            self._read_into(_WHO_AM_I, self._one)
            if self._one[0] == self.who_am_i:
                return HEALTH_MISMATCH
        except OSError:
            pass
        self._fault()
        return HEALTH_BUS_ERROR

    def _restore(self, step):
        """Write one row back, number step - 1; as step 0 switch the FIFO off."""
        try:
            if step:
                self._write(self._registers[step - 1], self._values[step - 1])
            else:
                # a master that the reset has spared may be within a transaction
                self._read_into(_USER_CTRL, self._one)
                self._write(_USER_CTRL, self._INTERFACE | self._one[0] & _I2C_MST_EN)
        except OSError:
            self._fault()
            return HEALTH_BUS_ERROR
        if step < len(self._registers):
            self._writing = step + 1
        else:
            self._writing = -1
            self._verifying = step
            self._settled = 0
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

    def _fifo_drain(self, n, fraction):
        """Take n packets out, or none if they may not be whole ones."""
        self._dirty = 1  # until shown otherwise: an interrupted burst has taken part of a packet
        if self._fifo_fetch(n) and not fraction:
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
            if self._status[0] & _NO_STATUS:
                self._status[0] = 0
                self._fault()
                return 0
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
        elif self._verifying:
            self._settled = (self._settled + 1) & _COUNT_MASK
        return self._not_fresh()

    def bus_fault(self):
        """Count a fault of the bus that somebody else has met at this chip, and have health() look at it."""
        self._fault()

    def _fault(self):
        self.errors = (self.errors + 1) & _COUNT_MASK
        self._suspect = 1
        return self._not_fresh()

    def _not_fresh(self):
        counts = self.counts
        flags = counts[_FLAGS] & _FULL_SCALE_FLAGS
        counts[_FLAGS] = flags
        return flags
