# The tick's clock: the best timer of the port, or a chip's data-ready line. Each names itself in `what`.
# Needs machine or pyb; no other module of the library imports them. Runs on the ports of PORTS.

import sys

import machine
import micropython

try:
    import pyb
except ImportError:
    pyb = None

# A timer may be as inaccurate as a crystal; more would be a scale error of every angle.
TOLERANCE_PPM = 100

# Resolution of machine.Timer on each port, by sys.platform, in 1/s. linux, qemu, darwin, win32: the simulated machine.
PORTS = {
    "rp2": 1000000,
    "pyboard": 1000,
    "esp32": 1000,
    "esp8266": 1000,
    "samd": 1000,
    "mimxrt": 1000,
    "renesas-ra": 1000,
    "zephyr": 1000,
    "linux": 1000000,
    "qemu": 1000000,
    "darwin": 1000000,
    "win32": 1000000,
}
# Order in which pyb.Timers are tried: 7 has no outputs, the others few; 5 is for servos, 6 for ADC and DAC.
_PYB_TIMERS = (7, 4, 10, 11, 13, 14, 12)
_ESP32_TIMERS = (0, 1, 2, 3)

_taken = []  # numbers of the hardware timers that run


class Ticker:
    """A running periodic callback.

    period_us  the period that the timer keeps, rounded to microseconds
    hard       True: the callback runs in the interrupt itself, with the heap locked
    what       the timer's name, for messages
    """

    def __init__(self, timer, period_us, hard, what, number=None):
        self.timer = timer
        self.period_us = period_us
        self.hard = hard
        self.what = what
        self._number = number
        if number is not None:
            _taken.append(number)

    def stop(self):
        self.timer.deinit()
        if self._number in _taken:
            _taken.remove(self._number)


class DataReady:
    """A chip's data-ready line as a tick: hard where the port has hard pin interrupts."""

    def __init__(self, pin, callback, period_us):
        self.period_us = period_us
        try:
            pin.irq(callback, trigger=machine.Pin.IRQ_RISING, hard=True)
            self.hard = True
            self.what = "data-ready pin, hard"
        except (TypeError, ValueError):
            pin.irq(callback, trigger=machine.Pin.IRQ_RISING)
            self.hard = False
            self.what = "data-ready pin, soft: ticks wait for the main program"
        self._pin = pin

    def stop(self):
        self._pin.irq(handler=None)


def make_tick(rate, callback, timer=None):
    """Call `callback(timer)` at `rate` (Hz, or a tuple (num, den) Hz) -> Ticker.

    timer  the number of the hardware timer: of pyb.Timer on stm32 (its callbacks are hard, machine.Timer's are soft
           there), of machine.Timer on esp32; None: a free one

    Raises ValueError for a rate that the timer cannot keep within TOLERANCE_PPM, for a timer that another tick uses,
    and for a port that is not in PORTS.
    """
    if hasattr(micropython, "alloc_emergency_exception_buf"):  # built in on most boards
        # an exception in a hard callback has no heap
        micropython.alloc_emergency_exception_buf(100)
    num, den = rate if isinstance(rate, tuple) else (rate, 1)
    if num <= 0 or den <= 0:
        raise ValueError("tick rate must be positive, got %d/%d Hz" % (num, den))
    if sys.platform not in PORTS or not hasattr(machine, "Timer"):
        raise ValueError(
            "no timer is known on the port %r: hand over a make_tick(rate, callback) as `timer`, or choose the "
            "data-ready or the manual drive" % sys.platform
        )
    if timer is not None and timer in _taken:
        raise ValueError("timer %d drives another tick: choose another one" % timer)
    if pyb is not None and hasattr(pyb, "Timer"):
        return _pyb_tick(num, den, callback, timer)
    if sys.platform != "esp32":
        timer = None  # any number of them
    elif timer is None:
        timer = _free(_ESP32_TIMERS)
    tick_hz = PORTS[sys.platform]
    period = (2 * tick_hz * den + num) // (2 * num)
    _check(num, den, tick_hz, period, "machine.Timer")
    options = {"period": period, "mode": machine.Timer.PERIODIC, "callback": callback}
    if tick_hz != 1000:
        options["tick_hz"] = tick_hz
    period_us = period * (1000000 // tick_hz)
    number = -1 if timer is None else timer
    try:
        found = machine.Timer(number, hard=True, **options)
        return Ticker(found, period_us, True, "machine.Timer, hard", timer)
    except (TypeError, ValueError):
        pass  # this port or version has no hard callbacks (see docs/conventions.md)
    found = machine.Timer(number, **options)
    return Ticker(
        found, period_us, False, "machine.Timer, soft: ticks wait for the main program", timer
    )


def _pyb_tick(num, den, callback, number):
    timer = None
    if number is not None:
        timer = pyb.Timer(number)
    else:
        for number in _PYB_TIMERS:
            try:
                timer = None if number in _taken else pyb.Timer(number)
            except ValueError:
                continue  # this chip does not have it
            if timer is not None:
                break
    if timer is None:
        raise ValueError("every timer drives a tick already")
    timer.init(freq=1)  # only to read the clock that feeds it
    source = timer.source_freq()
    prescaler = source * den // num // 0xFFFF + 1
    period = (2 * source * den + num * prescaler) // (2 * num * prescaler)
    _check(num, den, source, period * prescaler, "pyb.Timer(%d)" % number)
    timer.init(prescaler=prescaler - 1, period=period - 1)
    timer.callback(callback)
    period_us = (2000000 * period * prescaler + source) // (2 * source)
    return Ticker(timer, period_us, True, "pyb.Timer(%d), hard" % number, number)


def _free(numbers):
    for number in numbers:
        if number not in _taken:
            return number
    raise ValueError("every timer drives a tick already")


def _check(num, den, clock_hz, counts, what):
    """Refuse a period of `counts` clock periods that is too far from den/num seconds."""
    exact = clock_hz * den  # in 1/num clock periods
    error = abs(counts * num - exact)
    if not counts or error * 1000000 > exact * TOLERANCE_PPM:
        raise ValueError(
            "%s cannot tick at %d/%d Hz (nearest: %d/%d Hz); choose another rate, or the data-ready or FIFO drive"
            % (what, num, den, clock_hz, counts or 1)
        )
