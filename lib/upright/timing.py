# The tick's clock: picks the best timer that the port has, and says which one it got.
# Needs machine or pyb; runs on every board. Used by each board.py's make_tick.

import sys

import machine
import micropython

try:
    import pyb
except ImportError:
    pyb = None

# A timer may be off by as much as a crystal is; more would be a scale error of every angle.
TOLERANCE_PPM = 100


class Ticker:
    """A running periodic callback.

    period_us  the period that the timer keeps, rounded to microseconds
    hard       True: the callback runs in the interrupt itself, with the heap locked
    what       which timer it is, for people
    """

    def __init__(self, timer, period_us, hard, what):
        self.timer = timer
        self.period_us = period_us
        self.hard = hard
        self.what = what

    def stop(self):
        self.timer.deinit()


def make_tick(rate, callback, pyb_timer=None, timer_id=-1, microseconds=None):
    """Call `callback(timer)` at `rate` (Hz, or a tuple (num, den) Hz) -> Ticker.

    pyb_timer     number of a pyb.Timer to use (stm32: its callbacks are hard; machine.Timer's are soft there)
    timer_id      of machine.Timer where there is no pyb.Timer
    microseconds  True where machine.Timer resolves microseconds (rp2); otherwise it resolves milliseconds.
                  None: judged by the port's name
    Raises ValueError for a rate that the timer cannot keep within TOLERANCE_PPM.
    """
    if hasattr(micropython, "alloc_emergency_exception_buf"):  # built in on most boards
        micropython.alloc_emergency_exception_buf(
            100
        )  # an exception in a hard callback has no heap
    num, den = rate if isinstance(rate, tuple) else (rate, 1)
    if num <= 0 or den <= 0:
        raise ValueError("tick rate must be positive, got %d/%d Hz" % (num, den))
    if pyb_timer is not None and pyb is not None and hasattr(pyb, "Timer"):
        return _pyb_tick(num, den, callback, pyb_timer)
    if microseconds is None:
        microseconds = sys.platform == "rp2"
    tick_hz = 1000000 if microseconds else 1000
    period = (2 * tick_hz * den + num) // (2 * num)
    _check(num, den, tick_hz, period, "machine.Timer")
    options = {"period": period, "mode": machine.Timer.PERIODIC, "callback": callback}
    if microseconds:
        options["tick_hz"] = tick_hz
    period_us = period * (1000000 // tick_hz)
    try:
        timer = machine.Timer(timer_id, hard=True, **options)
        return Ticker(timer, period_us, True, "machine.Timer, hard")
    except (TypeError, ValueError):
        pass  # this port or version has no hard callbacks (see docs/conventions.md)
    timer = machine.Timer(timer_id, **options)
    return Ticker(timer, period_us, False, "machine.Timer, soft: ticks wait for the main program")


def _pyb_tick(num, den, callback, number):
    timer = pyb.Timer(number)
    timer.init(freq=1)  # only to read the clock that feeds it
    source = timer.source_freq()
    prescaler = source * den // num // 0xFFFF + 1
    period = (2 * source * den + num * prescaler) // (2 * num * prescaler)
    _check(num, den, source, period * prescaler, "pyb.Timer(%d)" % number)
    timer.init(prescaler=prescaler - 1, period=period - 1)
    timer.callback(callback)
    period_us = (2000000 * period * prescaler + source) // (2 * source)
    return Ticker(timer, period_us, True, "pyb.Timer(%d), hard" % number)


def _check(num, den, clock_hz, counts, what):
    """Refuse a period of `counts` clock periods that is too far from den/num seconds."""
    exact = clock_hz * den  # in 1/num clock periods
    error = abs(counts * num - exact)
    if not counts or error * 1000000 > exact * TOLERANCE_PPM:
        raise ValueError(
            "%s cannot tick at %d/%d Hz (nearest: %d/%d Hz); choose another rate, or the data-ready or FIFO drive"
            % (what, num, den, clock_hz, counts or 1)
        )
