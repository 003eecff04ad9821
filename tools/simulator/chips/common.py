# What the simulated chips share: the faults that a test injects, and the FIFO of the MPU family.
# Portable: CPython and the MicroPython unix port; needs nothing.


class Faults:
    """A chip's broken sides, and what a test may see of it.

    misuse   list of str: what a driver did that the datasheet forbids
    log      a list put here receives (now, register, value) of every write
    """

    power_up_us = 20_000  # after power-up: no answer

    def _init_faults(self, now):
        self.misuse = []
        self.log = None
        self._stuck = {}
        self._nack_skip = 0
        self._nacks = 0
        self._gone = False
        self._dead_until = 0
        self._now = now
        self._plain = False  # True: nothing stands in the way of a shortcut on the bus

    def nack_next(self, n=1, after=0):
        """Let `after` acknowledges (of address and written bytes) pass, then refuse n."""
        self._nack_skip = after
        self._nacks = n
        self._plain = False

    def vanish(self):
        """A broken wire: nothing is acknowledged and the clock runs on unseen."""
        self._gone = True
        self._plain = False

    def come_back(self):
        self._gone = False

    def brown_out(self, now=None):
        """The supply dips: power-on reset in flight, then silence for power_up_us."""
        self.poll(self._now if now is None else now)
        self._power_on_reset()
        self._dead_until = self._now + self.power_up_us
        self._plain = False

    def stick(self, register, value=None):
        """Reading the register always gives value; None mends it."""
        self._plain = False
        if value is None:
            self._stuck.pop(register, None)
        else:
            self._stuck[register] = value

    def register(self, register):
        """What is in a register, without the side effects of reading it over the bus."""
        return self._registers[register]

    def poke(self, register, value):
        """Change a register behind the driver's back."""
        self.poll(self._now)
        self._set(register, value)

    def _misused(self, what):
        """Note it, once in a row."""
        if not self.misuse or self.misuse[-1] != what:
            self.misuse.append(what)

    def _refused(self):
        """Is it this one's turn to be refused?"""
        if self._nacks:
            if self._nack_skip:
                self._nack_skip -= 1
            else:
                self._nacks -= 1
                return True
        return False

    def _acknowledge(self):
        if self._gone or self._now < self._dead_until:
            return False
        return not self._refused()


class PacketFifo:
    """A ring of bytes that packets go into whole, or byte by byte (byte_us between two of them)."""

    def __init__(self, size, byte_us=0):
        self.size = size
        self.byte_us = byte_us
        self._bytes = bytearray(size)
        self._last = 0
        self.clear()

    def clear(self):
        self._head = 0
        self.count = 0
        self.shadow = 0  # of the count, for FIFO_COUNTL
        self.packet = None  # (start, bytes, how many are in) while one is on its way

    def start(self, at, packet):
        self.packet = (at, packet, 0)

    def fill(self, now, stops):
        """Write as much of the packet as time allows -> True when that was too much.

        stops: a full FIFO refuses new bytes; else the oldest are lost, so that the first packet
        left has lost its beginning (RM 4.31).
        """
        start, packet, written = self.packet
        there = len(packet)
        if self.byte_us:
            there = min(there, (now - start) // self.byte_us + 1)
        overflow = False
        while written < there:
            overflow = self.push(packet[written], stops) or overflow
            written += 1
        self.packet = (start, packet, written) if written < len(packet) else None
        return overflow

    def push(self, byte, stops):
        """-> True when there was no room for it."""
        size = self.size
        full = self.count == size
        if full:
            if stops:
                return True
            self._head = (self._head + 1) % size
            self.count -= 1
        self._bytes[(self._head + self.count) % size] = byte
        self.count += 1
        return full

    def skip(self, n):
        """n bytes went in that later ones push out again."""
        self._head = (self._head + n) % self.size

    def pop(self):
        if self.count:
            self._last = self._bytes[self._head]
            self._head = (self._head + 1) % self.size
            self.count -= 1
        return self._last  # RM 4.31: empty, it returns the last byte again
