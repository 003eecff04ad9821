# Packets of an MPU6050 or MPU6500: how a sample is unpacked, and the chip's FIFO, drained in whole packets.
# Needs mpu_monitor.py; registers and table are passed in. Runs on MicroPython >= 1.22 and under CPython with
# a `micropython` shim. RM is RM-MPU-6000A rev 4.2.

from time import ticks_diff, ticks_us

import micropython
from micropython import const

from upright.mpu_monitor import RESTORE

_INT_STATUS = const(0x3A)
_USER_CTRL = const(0x6A)
_FIFO_COUNTH = const(0x72)
_FIFO_R_W = const(0x74)

_DATA_RDY = const(0x01)  # INT_STATUS and INT_ENABLE
_FIFO_OFLOW = const(0x10)
_NO_STATUS = const(0xA4)  # bits of INT_STATUS that no part of the family ever sets (RM 4.16)
_FIFO_ENABLE = const(0x40)  # USER_CTRL
_I2C_IF_DIS = const(0x10)
_FIFO_RESET = const(0x04)

_PACKET = const(14)  # accel x y z, temperature, gyro x y z
_FLAGS = const(10)  # of counts
_COUNT_MASK = const(0x3FFFFFFF)
_MOST_LOST_US = const(2_000_000)  # an outage is counted in packets: what is older means nothing
_LEAST_GAP = const(4)  # so many packets that did not come are no difference of clocks
_SAME_PARTS = const(3)  # polls in a row that find the same part of a packet

# The head of a buffer of samples: _HEAD bytes, then the first packet. In order: not 0 since a poll found nothing new,
# see mpu_monitor.py; samples that differed from the one before, up to _VARIED; what is odd about the newest (ODD_...);
# and three registers: INT_ENABLE, one that is not used, INT_STATUS.
_HEAD = const(6)
_QUIET = const(0)
_CHANGES = const(1)
_ODD = const(2)
_ENABLED = const(3)
_STATUS = const(5)
_VARIED = const(64)
_ODD_SAME = const(1)  # all words are as before
_ODD_ZERO = const(2)  # a word has fallen to 0 at once
_ODD_END = const(3)  # words have jumped, and the last byte is that of a bus that nobody drives
_ODD_TAKEN = const(4)  # nothing: it is to be taken as it is
# From one sample to the next no more is noise; and a sensor's filter that lets more through does not damp its noise,
# so that its words do not stay at 0.
_JUMP = const(255)


def make_buffer(length):
    """A buffer for samples of `length` bytes in all."""
    buffer = bytearray(_HEAD + length)
    buffer[_ENABLED] = _DATA_RDY
    buffer[_STATUS] = 0xFF
    return buffer


@micropython.viper
def unpack(buffer: ptr8, at: int, counts: ptr16) -> int:
    """Big-endian accel, temperature, gyro at buffer[at..at+13] into counts; returns the flags.

    0: the sample is not an ordinary one, and counts are as they were. Either INT_STATUS before the first packet is
    not exactly DATA_RDY, or INT_ENABLE lacks it. Or buffer[_ODD] says what is odd about the words; with _ODD_TAKEN
    there the sample is taken all the same. Afterwards INT_STATUS is 0xff, which is not a status: so a transfer that
    does not fill the buffer gives no sample.
    """
    if at == _HEAD:
        if buffer[_STATUS] != 1 or buffer[_ENABLED] & 1 == 0:
            return 0
    odd = _ODD_SAME
    i = 0  # of counts: 0 1 2, 9 (the temperature), 3 4 5
    j = at
    while i != 6:
        # signed by arithmetic: viper stores the low 16 bits, CPython's array wants the number
        word = ((buffer[j] << 8 | buffer[j + 1]) ^ 0x8000) - 0x8000
        step = word - (((counts[i] & 0xFFFF) ^ 0x8000) - 0x8000)
        if step:
            if odd == _ODD_SAME:
                odd = 0
            if step > _JUMP or step < 0 - _JUMP:
                if word == 0:
                    odd = _ODD_ZERO
                elif odd == 0:
                    odd = _ODD_END
        j += 2
        i += 1
        if i == 3:
            i = 9
        elif i == 10:
            i = 3
    if odd == _ODD_END and buffer[j - 1] != 0xFF:
        odd = 0
    if odd:
        if buffer[_ODD] != _ODD_TAKEN:
            buffer[_ODD] = odd
            return 0
    if odd != _ODD_SAME:
        buffer[_QUIET] = 0
        if buffer[_CHANGES] < _VARIED:
            buffer[_CHANGES] += 1
    flags = 1
    i = 0
    j = at
    while i != 6:
        word = ((buffer[j] << 8 | buffer[j + 1]) ^ 0x8000) - 0x8000
        counts[i] = word
        if word == 0x7FFF or word == -0x8000:
            if i < 3:
                flags |= 4
            elif i < 6:
                flags |= 8
        j += 2
        i += 1
        if i == 3:
            i = 9
        elif i == 10:
            i = 3
    buffer[_ODD] = 0
    buffer[_STATUS] = 0xFF
    counts[10] = flags
    return flags


@micropython.viper
def _blank(buffer: ptr8, write: int) -> int:
    """Write what no packet can be, -1 in every word, where the first one will be; or look whether it is there."""
    i = _HEAD
    while i < _HEAD + _PACKET:
        if write:
            buffer[i] = 0xFF
        elif buffer[i] != 0xFF:
            return 0
        i += 1
    return 1


class Fifo:
    """The FIFO of a chip, read in batches of whole packets.

    size, packet  bytes of the FIFO and of a packet
    on            True while the chip queues its samples
    level         packets left in the chip at the last poll
    device        takes the bytes behind each sample, or None

    overflows, resets (restarts of the FIFO) and lost (packets, as far as they could be counted) are counters.
    """

    def __init__(self, registers, table, monitor, counts):
        self.size = 512
        self.packet = _PACKET
        self.on = False
        self.level = 0
        self.overflows = 0
        self.resets = 0
        self.lost = 0
        self.batch = 0  # packets that one poll fetches at most
        self.device = None
        self.buffer = make_buffer(0)  # the packets of the batch, from _HEAD on
        self._views = ()
        self._full = 0  # packets from which on the FIFO counts as full
        self._pending = 0  # packets of the batch not yet delivered
        self._at = 0  # where the next one begins
        self._part = self._parts = 0  # of a packet that the last polls left, and how many of them
        self.period_us = 1  # of the samples
        # The last poll that found packets: its time, the packets that it left in the chip, and how old the newest one
        # was, at least and at most; and the time of the present poll.
        self._counted_us = self._now_us = 0
        self._left = 0
        self._age_least = self._age_most = 0
        self._least_lost = _LEAST_GAP  # no fewer have been lost since: 1 after a restart
        self._table = table
        self._monitor = monitor
        self._counts = counts
        self._byte = bytearray(1)
        self._pair = bytearray(2)
        self._status = bytearray(1)
        self.proof = (
            _DATA_RDY  # the bit of INT_STATUS that proves INT_ENABLE to be set; 0: none does
        )
        self._read_into = registers.read_into
        self._write = registers.write
        self.next = self.next  # for a quick look-up, see mpu_monitor.Monitor

    # Set-up

    def prepare(self, batch):
        """Make buffers for batches of so many packets. Raises ValueError for more than the FIFO holds."""
        size = self.packet
        if not isinstance(batch, int) or not 1 <= batch <= self.size // size:
            raise ValueError(f"batch {batch!r} is not 1 to {self.size // size}")
        self._full = self.size // size - 1
        if len(self.buffer) != _HEAD + batch * size or batch != self.batch:
            self.buffer = make_buffer(batch * size)
            whole = memoryview(self.buffer)
            self._views = [whole[_HEAD : _HEAD + n * size] for n in range(batch + 1)]
            self.batch = batch
        self.stop()

    def stop(self):
        """Switch the FIFO off; its contents are dropped."""
        self.on = False
        self._pending = self.level = 0

    def drop(self):
        """Drop the contents of the FIFO: it is restarted before the next packet."""
        self._pending = self.level = 0
        self._count_from(ticks_us())  # set-up takes time that no filter has to make up for
        self._monitor.fifo_misaligned = 1

    def _count_from(self, now):
        self._counted_us = now
        self._left = self._age_least = 0
        self._age_most = self.period_us
        self._least_lost = _LEAST_GAP

    # The tick: nothing below allocates, waits, raises or uses a float. The functions are small for the reason
    # given in mpu_monitor.py.

    def poll(self):
        """Fetch up to `batch` packets; returns how many next() has: 0 = none, or a fault.

        INT_STATUS is read after the burst, before any packet is delivered. If the FIFO has overflowed, the chip has
        reset itself or the bus has failed, the packet boundary is uncertain. Then the whole batch is dropped and the
        FIFO restarted.
        """
        if self._pending or not self.on or self._monitor.state >= RESTORE:
            return self._pending
        if self._monitor.fifo_misaligned:
            self.restart()
            return 0
        level = self.bytes_waiting()
        if level < 0:
            return 0
        packets = level // self.packet
        self.level = packets
        self._now_us = ticks_us()
        if not packets:
            self._monitor.no_sample(self.buffer)
            return 0
        # The last packet is complete. So if a part of a packet is left, either the chip is writing one, or the
        # first one has lost its beginning: wait, if necessary until the FIFO is full, and drop all.
        level -= packets * self.packet
        if level and packets < self._full and not self._stands(level):
            return 0
        return self.drain(packets if packets < self.batch else self.batch, level)

    def _stands(self, level):
        """Was it as full as this, with a part of a packet, at the last polls? Then it is smaller than believed."""
        level += self.level * self.packet
        self._parts = self._parts + 1 if level == self._part else 0
        self._part = level
        return self._parts >= _SAME_PARTS

    @micropython.native
    def next(self):
        """Put the next packet of the batch into counts, as read() does; returns its flags, 0 when there is none."""
        if not self._pending:
            self._monitor.not_fresh()
            return 0
        at = self._at
        self._at = at + self.packet
        self._pending -= 1
        if self._monitor.state:
            return self._monitor.withhold(1)
        counts = self._counts
        flags = unpack(self.buffer, at, counts)
        if not flags:
            flags = self._again(at)
            if not flags:
                return counts[_FLAGS]
        device = self.device
        if device is not None:
            flags |= device.take(self.buffer, at + _PACKET, counts)
            counts[_FLAGS] = flags
        return flags

    def _again(self, at):
        """The packet is an odd one."""
        if self.buffer[_ODD] == _ODD_END:  # the poll has read INT_STATUS behind it
            self.buffer[_ODD] = _ODD_TAKEN
        elif not self._monitor.accept(self.buffer):
            return 0
        return unpack(self.buffer, at, self._counts)

    def bytes_waiting(self):
        """FIFO_COUNT; -1 when the bus fails."""
        self._pair[0] = 0xFF  # more than any FIFO holds, should the transfer not fill it
        try:
            # high byte first: it latches the low (RM 4.30)
            self._read_into(_FIFO_COUNTH, self._pair)
        except OSError:
            self._monitor.fault()
            return -1
        level = self._pair[0] << 8 | self._pair[1]
        if level <= self.size:
            return level
        self._monitor.fifo_misaligned = 1  # a chip that fails here leaves the bus high: 0xffff
        self._monitor.fault()
        return -1

    def drain(self, n, fraction):
        """Read n packets, or none if they may be incomplete."""
        # until the burst is complete: an interrupted one has taken part of a packet
        self._monitor.fifo_misaligned = 1
        if self._fetch(n) and not fraction:
            self._monitor.fifo_misaligned = 0
            if self.on:
                self._count()
            self.level -= n
            self._left = self.level
            self._at = _HEAD
            self.buffer[_STATUS] = _DATA_RDY  # for unpack()
            self._pending = n
            return n
        if self._status[0] & _FIFO_OFLOW:
            self.overflows = (self.overflows + 1) & _COUNT_MASK
        self.restart()
        return 0

    def _count(self):
        """Compare the packets in the chip with the time since the last count: the others are lost.

        The chip's clock goes on in an outage. So packets are counted exactly if the age of the newest one is known: it
        is at least 0 and less than a period, and each count narrows that down until it tells nothing new. A restart
        happens somewhere between two samples; only what is there afterwards tells how many it has cost.
        """
        passed = ticks_diff(self._now_us, self._counted_us)
        period = self.period_us
        came = self.level - self._left
        if not 0 <= passed <= _MOST_LOST_US:
            passed = _MOST_LOST_US
        n = (passed + (self._age_least + self._age_most >> 1)) // period - came
        if n >= self._least_lost:
            self.lose(n)
            came += n
        self._least_lost = _LEAST_GAP
        self._counted_us = self._now_us
        slack = passed >> 6  # what the clocks may differ by
        passed -= came * period
        self._age_least = max(0, min(period, self._age_least + passed - slack))
        self._age_most = min(period, max(self._age_least, self._age_most + passed + slack))

    def take_all(self):
        """The caller unpacks the batch itself."""
        self._pending = 0

    def lose(self, n):
        """Count lost packets."""
        self.lost = (self.lost + n) & _COUNT_MASK

    def _fetch(self, n):
        """Read n packets in one burst; 1 if nothing has shifted or replaced them by its end."""
        # A transfer may leave its buffer as it was and raise nothing, see mpu_monitor.py
        self._status[0] = 0xFF
        _blank(self.buffer, 1)
        try:
            self._read_into(_FIFO_R_W, self._views[n])
            self._read_into(_INT_STATUS, self._status)
        except OSError:
            self._status[0] = 0xFF
        if self._status[0] & _NO_STATUS or _blank(self.buffer, 0):
            self._status[0] = 0
            self._monitor.fault()
            return 0
        if self._status[0] & _FIFO_OFLOW:
            return 0
        # DATA_RDY since the last read proves that INT_ENABLE is still set, so there was no reset.
        # Without it, check: a FIFO that a reset has emptied repeats its last byte.
        return self._status[0] & self.proof or self._runs()

    def _runs(self):
        """Is USER_CTRL as it was written?"""
        self._byte[0] = 0xFF
        try:
            self._read_into(_USER_CTRL, self._byte)
        except OSError:
            self._monitor.fault()
            return 0
        # the whole register: a chip that fails now leaves the bus high, 0xff
        if (self._byte[0] ^ self._table.last()) & ~_I2C_IF_DIS == 0:
            return 1
        self._monitor.doubt()
        return 0

    def restart(self):
        """Empty the FIFO; True if that worked. On the MPU6050 FIFO_RESET works only while FIFO_EN is 0 (RM 4.27)."""
        n = self._table.last() & ~_FIFO_ENABLE
        try:
            self._write(_USER_CTRL, n)
            self._write(_USER_CTRL, n | _FIFO_RESET)
            self._read_into(_INT_STATUS, self._byte)  # an overflow of the past
            # a port may swallow that the chip has refused the write: see mpu_monitor.py
            if self.bytes_waiting() != 0:
                return False
            self._write(_USER_CTRL, n | _FIFO_ENABLE)
        except OSError:
            self._monitor.fault()
            return False
        self._monitor.fifo_misaligned = 0
        self.resets = (self.resets + 1) & _COUNT_MASK
        if self.on:  # _count() finds out how many packets that has cost
            self._least_lost = 1
        else:
            self.lose(self.level)
            self._count_from(ticks_us())
        self.level = 0
        return True


class Counters:
    """The counters of an object's monitor and FIFO, by the names that programs use."""

    @property
    def errors(self):
        return self.monitor.errors

    @property
    def resets(self):
        return self.monitor.resets

    @property
    def full_resets(self):
        return self.monitor.full_resets

    @property
    def fifo_size(self):
        return self.fifo.size

    @property
    def fifo_level(self):
        return self.fifo.level

    @property
    def fifo_overflows(self):
        return self.fifo.overflows

    @property
    def fifo_resets(self):
        return self.fifo.resets

    @property
    def fifo_lost(self):
        return self.fifo.lost
