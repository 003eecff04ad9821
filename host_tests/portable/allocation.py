# How the scripts beside this one find out whether a piece of a tick allocates. Needs a MicroPython.

import gc
import sys

import micropython
import utime

if not hasattr(gc, "mem_alloc"):
    raise SystemExit("CPython has no heap to lock")

# The simulator's clock allocates, outside of everybody's count; what is imported after this gets the port's own.
sys.modules["time"] = utime


def locked(tick, n):
    """Run tick(0) to tick(n - 1) with the heap locked: None, or what was raised."""
    raised = None
    micropython.heap_lock()
    try:
        for i in range(n):
            tick(i)
    except MemoryError as e:
        raised = e
    micropython.heap_unlock()
    return raised


def grown(tick, n):
    """Bytes that n ticks take from an open heap and do not give back."""
    gc.collect()
    gc.disable()
    before = gc.mem_alloc()
    for i in range(n):
        tick(i)
    after = gc.mem_alloc()
    gc.enable()
    return after - before


def borrowed(bus, tick, n, first):
    """Bytes taken at any time inside n ticks: a frame over 11 words comes from the heap if it can.

    bus: while bus.watch is set its methods keep the most that they have seen taken in bus.peak.
    """
    gc.collect()
    gc.disable()
    bus.watch = True
    bus.peak = 0
    before = gc.mem_alloc()
    for i in range(first, first + n):
        tick(i)
    bus.watch = False
    gc.enable()
    return bus.peak - before


def judge(ticks, tick, n, many=30, first=45):
    """(None or what was raised, bytes taken) of n ticks: locked with ticks.faults, open and counted without."""
    if ticks.faults:  # raising takes memory where there is some
        return locked(tick, n), 0
    return None, grown(tick, n) + borrowed(ticks.bus, tick, many, first)


class Verdict:
    """Prints a line each, and ends with 1 if one failed."""

    bad = 0

    def say(self, what, ok, *more):
        print(what, "ok" if ok else "FAILED", *more)
        self.bad += not ok

    def ticks(self, name, ticks, judged, busy, *more):
        raised, taken = judged
        faults = "with faults:" if ticks.faults else "without:"
        self.say("%s %s" % (name, faults), raised is None and taken == 0 and busy, taken, *more)

    def twin(self, what, found):
        print("twin with %s:" % what, "found" if found else "MISSED")
        self.bad += not found

    def end(self):
        sys.exit(1 if self.bad else 0)
