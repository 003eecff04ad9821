# Checks the registers of an MPU6050 or MPU6500 in the tick and restores them after a reset of the chip.
# Needs the registers and the table that are passed in. Runs on MicroPython >= 1.22 and under CPython with a
# `micropython` shim. RM is RM-MPU-6000A rev 4.2.

import time

import micropython
from micropython import const

# What health() returns
HEALTH_OK = const(0)  # the register has the value of the table
# it has another value: the chip has reset itself; the next call begins the repair
HEALTH_MISMATCH = const(1)
HEALTH_REPAIRING = const(2)  # the repair goes on
HEALTH_BUS_ERROR = const(3)  # the bus failed; the same step is taken again next time

# The state. Samples are delivered in WATCH only.
WATCH = const(0)  # one row of the table is compared a call, in turn
SETTLE = const(1)  # the same, while the gyro settles
VERIFY = const(2)  # the rows have been written back; one a call is compared
RESTORE = const(3)  # one row a call is written back
RESET = const(4)  # a full reset of the chip, one step a call

_USER_CTRL = const(0x6A)
_PWR_MGMT_1 = const(0x6B)
_WHO_AM_I = const(0x75)
_FIFO_ENABLE = const(0x40)  # USER_CTRL.FIFO_EN
_I2C_MST_EN = const(0x20)
_DEVICE_RESET = const(0x80)
_SLEEP = const(0x40)
_SLV_CTRL = (0x27, 0x2A, 0x2D, 0x30, 0x34)  # I2C_SLV0_CTRL to I2C_SLV4_CTRL

# Steps of a full reset are pairs of register and value; in place of a register:
_WAIT = const(0)  # the value is a time in ms since the last write
_RESET_MS = const(100)  # what the register maps ask for after DEVICE_RESET and SIGNAL_PATH_RESET
# the master finishes a transaction in it: 24 bytes, five addresses at the slowest clock
_MASTER_MS = const(5)

# Bits of _doubt
_DOUBT = const(1)  # a reset would explain the fault: compare PWR_MGMT_1 out of turn
_LOOKED = const(2)  # the last call did

# The head of a buffer, see mpu_fifo.py, and values of its first byte
_QUIET = const(0)
_CHANGES = const(1)
_ODD = const(2)
_VARIED = const(64)
_ODD_SAME = const(1)
_ODD_END = const(3)
_ODD_TAKEN = const(4)
_NOTHING_NEW = const(1)
_FROZEN = const(2)

_FLAGS = const(10)  # of counts
_FULL_SCALE_FLAGS = const(0x0C)
_COUNT_MASK = const(0x3FFFFFFF)  # counters wrap within a small int of 32-bit ports
_TRIES = const(3)  # failed repairs in a row before a full reset
_PATIENCE_MS = const(250)  # and ten samples: after so long without a sample the chip is reset
_STILL_MS = const(
    50
)  # and ten samples: the same sample for longer is none (to leave it out harms little)


class Monitor:
    """One register a call is compared with the table; a difference means that the chip has reset itself.

    Then RESTORE writes the table, VERIFY reads it back, and SETTLE lasts until the gyro has settled. If the registers
    are correct but no samples come, or if three repairs in a row fail, the chip gets a full RESET first. The first row
    of the table is PWR_MGMT_1, the last USER_CTRL.

    errors, impossible (samples that were the same for too long, or in which a word fell to 0), resets (of the chip by
    itself) and full_resets (by this) are counters.

    A transfer may leave its buffer as it was and raise nothing: the rp2 port does so when the chip refuses the number
    of the register (machine_i2c.c: a short write in readfrom_mem_into is no error there). So a buffer first gets what
    the register cannot hold, or should not.
    """

    def __init__(self, registers, table, counts):
        self.errors = 0
        self.impossible = 0
        self.resets = 0
        self.full_resets = 0
        self.fifo_misaligned = (
            0  # 1: the FIFO's packet boundary is uncertain, so it must be restarted
        )
        self.device = None  # what is attached behind the chip; its health() has every second turn
        self.who_am_i = None
        # True: the samples of this chip do not vary, as those of a simulator: that they stay the same says nothing
        self.constant = False
        self._read_into = registers.read_into
        self._write = registers.write
        self._table = table
        self._counts = counts
        self._byte = bytearray(1)
        self.start(b"", 0, 0, (1000, 1))
        # MicroPython looks for a method among the attributes of the instance first. A table of attributes that is
        # (nearly) full is searched from end to end: 1500 instructions a call. So the methods that every tick calls
        # are stored as attributes.
        self.health = self.health
        self._compare = self._compare

    def start(self, after_reset, interface, settle_ms, rate):
        """Start to check a chip that has just been configured.

        after_reset  pairs (register, value) that a full reset ends with
        interface    the bits of USER_CTRL that the bus needs
        settle_ms    how long to withhold samples after a repair
        rate         of the samples, (num, den) Hz
        """
        num, den = rate
        period_ms = 1000 * den // num
        steps = [(register, 0) for register in _SLV_CTRL] + [(_WAIT, _MASTER_MS)]
        self._without_master = 2 * len(steps)
        steps += [(_USER_CTRL, interface), (_PWR_MGMT_1, _DEVICE_RESET), (_WAIT, _RESET_MS)]
        if after_reset:
            steps += list(after_reset)
            steps.append((_WAIT, _RESET_MS))
        self._reset_steps = bytes([byte for step in steps for byte in step])
        self._interface = interface
        self.settle_ms = (
            settle_ms + period_ms
        )  # after a repair; the newest sample may be a period old
        self._settle_samples = 1 + settle_ms * num // (1000 * den)
        self._patience_ms = _PATIENCE_MS + 10 * period_ms
        self._still_ms = _STILL_MS + 10 * period_ms
        self.state = WATCH
        self._at = 0  # the row, or the step of the reset, that is next; -1 in RESTORE: the FIFO is switched off
        self._left = 0  # samples still to be withheld, if they come through the FIFO
        self._restored = 0  # when the registers were written back
        self._tries = 0
        self._doubt = 0
        self._silent = 0  # 1: no sample for longer than the time limit
        self._device_next = 0
        self._stepped = 0  # when the last step of a full reset was written
        self.heard()

    def attach(self, device):
        """Give every second turn to device.health(); None ends it."""
        self.device = device
        self._device_next = 0

    def repair_calls(self):
        """Calls of health() that a repair takes at most, if the bus works, from the first stale sample on."""
        return 2 * len(self._table.numbers) + 3

    # The tick: nothing below allocates, waits, raises or uses a float. A bytecode frame over 11 words comes from the
    # heap, and a `try` takes three of them. So the functions are small, with few names beside a `try`.

    @micropython.native
    def health(self):
        """Take the next step; returns a HEALTH_ state.

        In WATCH it compares the rows of the table in turn, and PWR_MGMT_1 out of turn after a stale or failed sample
        (at most every second call). Every second turn goes to the attached device.
        """
        state = self.state
        if state >= RESTORE:
            return self._restore() if state == RESTORE else self._reset()
        if state == VERIFY:
            return self._take_row()
        doubt = self._doubt
        if doubt == _DOUBT:
            return self._look()
        self._doubt = doubt & _DOUBT
        if self._device_next:
            self._device_next = 0
            self.device.health()
            return HEALTH_OK
        return self._take_row()

    def _look(self):
        """Compare PWR_MGMT_1 out of turn."""
        self._doubt = _LOOKED
        found = self._compare(0)
        if found == HEALTH_MISMATCH:
            self._repair()
        elif self._silent and found == HEALTH_OK:
            return self._begin_reset()
        return found

    @micropython.native
    def _take_row(self):
        row = self._at
        last = len(self._table.numbers) - 1
        found = self._compare(row)
        # while the FIFO waits for its restart, USER_CTRL may have any value
        if found == HEALTH_MISMATCH and not (row == last and self.fifo_misaligned):
            return self._repair()
        if found == HEALTH_BUS_ERROR:
            return found
        self._at = row + 1 if row < last else 0
        if self.state != VERIFY:
            if self.device is not None:
                self._device_next = 1
            return HEALTH_OK
        if row == last:
            self._tries = 0
            self.state = SETTLE if self._left else WATCH
        return HEALTH_REPAIRING

    @micropython.native
    def _compare(self, row):
        """Does a register still have the value of the table?"""
        table = self._table
        byte = self._byte
        byte[0] = table.values[row] ^ 0xFF
        try:
            self._read_into(table.numbers[row], byte)
            if not (byte[0] ^ table.values[row]) & table.masks[row]:
                return HEALTH_OK
        except OSError:
            self.fault()
            return HEALTH_BUS_ERROR
        return self._differs(row)

    def _differs(self, row):
        """The register has another value: has the chip been reset, or did the bus fail?"""
        self._byte[0] = self._table.values[row]  # the second time the other way round
        if self._ask(self._table.numbers[row]) and self._wrong(row):
            # does the chip answer, or is the bus floating?
            self._byte[0] = ~self.who_am_i & 0xFF
            if self._ask(_WHO_AM_I) and self._byte[0] == self.who_am_i:
                return HEALTH_MISMATCH
        self.fault()
        return HEALTH_BUS_ERROR

    def _ask(self, register):
        try:
            self._read_into(register, self._byte)
            return 1
        except OSError:
            return 0

    def _wrong(self, row):
        return (self._byte[0] ^ self._table.values[row]) & self._table.masks[row]

    def _repair(self):
        """The chip has reset itself."""
        self.resets = (self.resets + 1) & _COUNT_MASK
        if self._tries == _TRIES:
            self._begin_reset()
        else:
            self._tries += 1
            self.state = RESTORE
            self._at = -1
        self._left = 0
        return HEALTH_MISMATCH

    def _restore(self):
        """Write one row; before the first one switch the FIFO off."""
        row = self._at
        try:
            if row >= 0:
                self._write(self._table.numbers[row], self._table.values[row])
            else:
                # a master that still runs may be in a transaction
                self._byte[0] = self._table.last()
                self._read_into(_USER_CTRL, self._byte)
                self._write(_USER_CTRL, self._interface | self._byte[0] & _I2C_MST_EN)
        except OSError:
            self.fault()
            return HEALTH_BUS_ERROR
        row += 1
        self._at = row
        if row == len(self._table.numbers):
            self._at = 0
            self.state = VERIFY
            self._left = self._settle_samples
            self._restored = time.ticks_ms()
            if self._table.last() & _FIFO_ENABLE:
                self.fifo_misaligned = 1
            self.heard()
        return HEALTH_REPAIRING

    def _begin_reset(self):
        self.full_resets = (self.full_resets + 1) & _COUNT_MASK
        self.state = RESET
        self._silent = self._tries = self._left = 0
        # an interrupted transaction can hang the device on the master's bus
        self._at = 0 if self._table.last() & _I2C_MST_EN else self._without_master
        return HEALTH_REPAIRING

    def _reset(self):
        """One step of a full reset, which ends in RESTORE."""
        at = self._at
        steps = self._reset_steps
        if steps[at] == _WAIT:
            if time.ticks_diff(time.ticks_ms(), self._stepped) <= steps[at + 1]:
                return HEALTH_REPAIRING
        elif not self._step(at):
            return HEALTH_BUS_ERROR
        at += 2
        self._at = at
        if at == len(steps):
            self.state = RESTORE
            self._at = -1
        return HEALTH_REPAIRING

    def _step(self, at):
        self._stepped = time.ticks_ms()
        try:
            self._write(self._reset_steps[at], self._reset_steps[at + 1])
            return 1
        except OSError:
            self.fault()
            return 0

    # Reports of read() and the FIFO

    def fault(self):
        """The bus has failed: count it, have health() check the chip, return the flags without "fresh"."""
        self.errors = (self.errors + 1) & _COUNT_MASK
        self._doubt |= _DOUBT
        self.heard()
        return self.not_fresh()

    def doubt(self):
        """A reset of the chip would explain a fault: have health() check it."""
        self._doubt |= _DOUBT

    def no_sample(self, quiet):
        """There is no new sample. quiet: the head of a buffer, see mpu_fifo.py; returns the flags as fault() does."""
        self._doubt |= _DOUBT
        if not quiet[_QUIET]:
            quiet[_QUIET] = _NOTHING_NEW
            self.heard()
        elif time.ticks_diff(time.ticks_ms(), self._since) > self._patience_ms:
            # has sleep() put it to sleep?
            self._silent = 0 if self._table.values[0] & _SLEEP else 1
        return self.not_fresh()

    def accept(self, quiet):
        """A new sample is odd: may it be used? quiet: the head of its buffer.

        The same words twice are a rare chance. A chip that hangs gives them for ever, and is reset. A word that falls
        from far off to exactly 0 is a rare chance, too; one that then stays there measures nothing. A simulator may do
        both: what has never varied is not expected to. If the last byte is that of a bus which nobody drives, the chip
        is asked whether it is still there.
        """
        odd = quiet[_ODD]
        quiet[_ODD] = 0
        if odd == _ODD_END:
            self._byte[0] = ~self.who_am_i & 0xFF
            if not self._ask(_WHO_AM_I) or self._byte[0] != self.who_am_i:
                self.fault()
                return False
        elif self.constant or quiet[_CHANGES] < _VARIED:
            quiet[_QUIET] = 0
        elif odd != _ODD_SAME or self._frozen(quiet):
            self.impossible = (self.impossible + 1) & _COUNT_MASK
            self.no_sample(quiet)
            return False
        quiet[_ODD] = _ODD_TAKEN
        return True

    def _frozen(self, quiet):
        """Has the sample been the same for too long?"""
        if not quiet[_QUIET]:
            quiet[_QUIET] = _NOTHING_NEW
            self.heard()
        elif time.ticks_diff(time.ticks_ms(), self._since) > self._still_ms:
            quiet[_QUIET] = _FROZEN
        return quiet[_QUIET] == _FROZEN

    def heard(self):
        """Restart the time limit for the next sample."""
        self._silent = 0
        self._since = time.ticks_ms()

    def withhold(self, queued):
        """A sample that may be from before the gyro has settled: clear its fresh bits.

        queued: it comes from the FIFO. Such samples are counted, for they may be read late; but of those that the chip
        takes between two reads only one is seen.
        """
        self.heard()
        if self._left:
            if queued:
                self._left -= 1
            elif time.ticks_diff(time.ticks_ms(), self._restored) >= self.settle_ms:
                self._left = 0
            if not self._left and self.state == SETTLE:
                self.state = WATCH
        return self.not_fresh()

    def not_fresh(self):
        """Clear the fresh bits of the flags in counts; returns the flags."""
        counts = self._counts
        flags = counts[_FLAGS] & _FULL_SCALE_FLAGS
        counts[_FLAGS] = flags
        return flags
