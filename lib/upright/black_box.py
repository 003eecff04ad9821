# The last faults of an AHRS with their times, in a fixed array: the tick writes it when something has gone wrong.
# Needs objects that count their faults. Every port. look() is for the tick; what reads it may allocate.

from array import array
from time import ticks_diff, ticks_ms

import micropython
from micropython import const

ENTRIES = const(32)
_KIND = const(0)
_COUNT = const(1)
_FIRST = const(2)  # ticks_ms
_LAST = const(3)
_WORDS = const(4)
_MASK = const(0x3FFFFFFF)  # of counters and of ticks_ms
# A fault of the same kind within this time belongs to the entry before: a dead bus is one entry, not the last 32
_SAME_MS = const(1000)


class BlackBox:
    """Compares the counters `names` of faults with what they were, and notes those that have grown.

    total  entries so far, also those that newer ones have replaced
    """

    def __init__(self, names):
        self.names = names
        self.total = 0
        self._log = array("i", [0] * (ENTRIES * _WORDS))
        self._newest = array("i", [-1] * len(names))  # the number of each kind's newest entry
        self._seen = array("i", [0] * len(names))
        self._parts = [None] * len(names)
        self._attributes = [""] * len(names)
        self._busy = False

    def watch(self, sources):
        """Compare these from now on: {name: (object, attribute)}."""
        for i in range(len(self.names)):
            part, attribute = sources.get(self.names[i], (None, ""))
            self._parts[i], self._attributes[i] = part, attribute
            self._seen[i] = 0 if part is None else getattr(part, attribute)

    @micropython.native
    def look(self):
        """Note what has grown. A call that interrupts another one does nothing: the next one finds it."""
        if self._busy:
            return
        self._busy = True
        seen = self._seen
        for i in range(len(seen)):
            part = self._parts[i]
            if part is not None:
                value = getattr(part, self._attributes[i])
                if value != seen[i]:
                    self._note(i, (value - seen[i]) & _MASK)
                    seen[i] = value
        self._busy = False

    @micropython.native
    def _note(self, kind, count):
        log = self._log
        now = ticks_ms()
        number = self._newest[kind]
        at = number % ENTRIES * _WORDS
        if (
            number < 0
            or number <= self.total - ENTRIES
            or ticks_diff(now, log[at + _LAST]) > _SAME_MS
        ):
            number = self.total
            self.total = (number + 1) & _MASK
            self._newest[kind] = number
            at = number % ENTRIES * _WORDS
            log[at + _KIND] = kind
            log[at + _COUNT] = 0
            log[at + _FIRST] = now
        log[at + _COUNT] = (log[at + _COUNT] + count) & _MASK
        log[at + _LAST] = now

    def entries(self):
        """The faults, oldest first: a list of (name, count, seconds since the first, seconds since the last)."""
        now = ticks_ms()
        found = []
        for number in range(max(0, self.total - ENTRIES), self.total):
            at = number % ENTRIES * _WORDS
            log = self._log
            first, last = [ticks_diff(now, log[at + word]) / 1000 for word in (_FIRST, _LAST)]
            found.append((self.names[log[at + _KIND]], log[at + _COUNT], first, last))
        return found
