# The tick: sample, filter, published state, a bounded piece of the display. Runs in a hard interrupt.
# Needs a driver of lib/ (read, health, counts) and a filter of lib/ (update, quaternion). Every port.

from array import array
from time import ticks_add, ticks_diff, ticks_us

import micropython

_Q = 0  # published: quaternion Q29, then flags of the last sample and the number of steps
_FLAGS = 4
_STEPS = 5
_WORDS = 6

# The timer's clock is the one that ticks_us shows, give or take make_tick's rounding (100 ppm: 0.1 of a period behind).
FOLLOW_TIMER = 10
# The chip's clock on the data-ready line may be off by some percent (2 %: 0.64 of a period behind).
FOLLOW_CHIP = 5

_FRESH = 1
_WRAP = 0x3FFFFFFF  # counters stay small ints
_HEALTH_EVERY = 8  # ticks between two looks at a configuration register while samples come in
_MOST_COASTS = (
    16  # steps made up for at once: bounds the tick, and past it the last rate says nothing
)


# The callbacks are native code for their frames' sake: a bytecode frame over 11 words, which a `try` soon makes, is
# taken from the heap where it is not locked. The small methods below them stay under that.


class Tick:
    """One step a sample: read -> update -> publish, then at most `chunk` bytes of the display's new content.

    `on_sample` and `on_fifo` are the callbacks (made once here, since fetching a bound method allocates): on_sample
    for a timer or the chip's data-ready line, on_fifo for a timer that drains the FIFO. They never raise: what
    goes wrong is counted in `missed` (ticks that never came, made up for by coasting), `crashes` (with the last one
    in `error`), and in the driver's and display's own counters.

    period_us  the sample period, to notice ticks that never came; 0 with the FIFO, whose packets say it
    follow     how readily the expected time follows the ticks' own clock: by late / 2**follow a tick
    display    given only where the tick owns the display's bus
    """

    def __init__(self, imu, filter, period_us, display=None, chunk=32, follow=FOLLOW_TIMER):
        self._imu = imu
        self._filter = filter
        self._counts = imu.counts
        self._display = display
        self._chunk = chunk
        self._period = period_us
        self._follow = follow
        self._due = ticks_us()
        self._started = False
        self._made_up = 0
        self._inside = False
        self._since_health = 0
        self._seen = -1
        self._state = array("i", [0] * _WORDS)
        self._q = array("i", [0] * 4)
        self._sequence = 0
        self.steps = 0
        self.fresh = 0
        self.missed = 0
        self.crashes = 0
        self.error = None
        self.on_sample = self._on_sample
        self.on_fifo = self._on_fifo
        self.on_guard = self._on_guard

    @micropython.native
    def _on_sample(self, source):
        if self._inside:  # another source of the same tick, at a higher priority
            return
        self._inside = True
        try:
            if self._on_time():
                self._imu.read()
                self._step()
                if self._display is not None:
                    self._display.flush_step(self._chunk)
        except (
            Exception
        ) as error:  # it must not stop the timer: counted, and shown by the main program
            self._crashed(error)
        self._inside = False

    @micropython.native
    def _on_fifo(self, source):
        if self._inside:
            return
        self._inside = True
        try:
            imu = self._imu
            n = imu.fifo_poll()
            if n == 0:
                imu.health()
            while n > 0:
                imu.fifo_next()  # a packet that is withheld after a reset is a step all the same: it coasts
                self._step()
                n -= 1
            if self._display is not None:
                self._display.flush_step(self._chunk)
        except Exception as error:
            self._crashed(error)
        self._inside = False

    @micropython.native
    def _on_guard(self, source):
        """Slow timer beside the data-ready line: a chip that has reset itself raises it no more, and has to be
        found and put right all the same."""
        if self._inside:
            return
        self._inside = True
        try:
            if self.steps == self._seen:
                self._imu.read()
                self._imu.health()
                if self._display is not None:  # which is to show that the sensor is lost
                    self._display.flush_step(self._chunk)
            self._seen = self.steps
        except Exception as error:
            self._crashed(error)
        self._inside = False

    def _crashed(self, error):
        self.crashes = (self.crashes + 1) & _WRAP
        self.error = error

    def _on_time(self):
        """Coast through ticks that never came. False: this tick is one that was made up for and came late.

        Ticks are held against where the next one is due, not against the last one: a tick that always takes a
        little longer than its period loses some, and every gap alone would look fit.
        """
        period = self._period
        if period == 0:
            return True
        late = ticks_diff(ticks_us(), self._due)
        if not self._started:
            self._started = True
            self._due = ticks_add(self._due, late + period)
            return True
        if late >= period:
            self._coast(late // period)
        elif late < -(period >> 1) and self._made_up:
            self._made_up -= 1
            return False
        elif late < period >> 1:
            self._made_up = 0
        self._due = ticks_add(self._due, period + (late >> self._follow))
        return True

    def _coast(self, lost):
        self.missed = (self.missed + lost) & _WRAP
        self._due = ticks_add(self._due, lost * self._period)
        if lost > _MOST_COASTS:
            lost = _MOST_COASTS
        self._made_up = lost
        self._counts[10] &= ~_FRESH
        while lost > 0:
            self._filter.update(self._counts)
            lost -= 1

    def _step(self):
        self._filter.update(self._counts)
        self.steps = (self.steps + 1) & _WRAP
        if self._counts[10] & _FRESH:
            self.fresh = (self.fresh + 1) & _WRAP
            self._since_health += 1
            if self._since_health >= _HEALTH_EVERY:
                self._since_health = 0
                self._imu.health()
        else:
            self._imu.health()
        self._publish()

    def _publish(self):
        # Odd while it is being written: whoever reads meanwhile, from another core or a nested interrupt, sees that.
        self._sequence = (self._sequence + 1) & _WRAP
        state = self._state
        q = self._q
        self._filter.quaternion(q)
        state[_Q] = q[0]
        state[_Q + 1] = q[1]
        state[_Q + 2] = q[2]
        state[_Q + 3] = q[3]
        state[_FLAGS] = self._counts[10]
        state[_STEPS] = self.steps
        self._sequence = (self._sequence + 1) & _WRAP

    def snapshot(self, out):
        """Copy the published state (quaternion Q29 x4, flags, steps) into out, an array('i') of 6: all of one step.

        -> False when the tick never left it alone for long enough (then out is not to be used).
        """
        state = self._state
        for _ in range(100):
            before = self._sequence
            for i in range(_WORDS):
                out[i] = state[i]
            if before == self._sequence and not before & 1:
                return True
        return False
