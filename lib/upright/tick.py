# The tick: sample, filter, published state, a bounded piece of the display. Runs in a hard interrupt.
# Needs a driver of lib/ (read, health, counts), a filter of lib/ (update, state) and viper; where the board has them, a
# calibration (apply, counts) and a magnetometer on a bus of the tick (read). Every port.

from array import array
from time import ticks_add, ticks_diff, ticks_us

import micropython
from micropython import const

# The published state, array('i'): a sequence number that is odd while the rest is being written, quaternion Q29
# (w x y z), flags of the last sample, number of steps, number of those with a fresh sample.
_SEQUENCE = const(0)
_Q = const(1)
_FLAGS = const(5)
_STEPS = const(6)
_FRESH_STEPS = const(7)
_WORDS = const(8)
SNAPSHOT_WORDS = const(7)  # what snapshot() gives: the state from _Q on

# The timer's clock is the one that ticks_us shows, give or take make_tick's rounding (100 ppm: 0.1 of a period behind).
FOLLOW_TIMER = const(10)
# The chip's clock on the data-ready line may be off by some percent (2 %: 0.64 of a period behind).
FOLLOW_CHIP = const(5)

_FRESH = const(1)  # bit 0 of the flags: accelerometer and gyro
_ANY_FRESH = const(3)  # bit 1: magnetometer
_WRAP = const(0x3FFFFFFF)  # counters stay small ints
# Steps between two looks at a configuration register while samples come in: a power of 2
_HEALTH_EVERY = const(8)
# What health() answers while it writes a chip's registers back; and how many of them a slow tick does at once
_REPAIRING = const(2)
_REPAIRS = const(8)
# Steps made up for at once: bounds the tick; past it the last rate says nothing
_MOST_COASTS = const(16)


@micropython.viper
def _publish(state: ptr32, q: ptr32, counts: ptr16) -> int:
    """Write the state of this step; 1 when the chip's health is due: now and then, and after every sample that failed.

    The sequence is odd meanwhile: whoever reads then, from another core or a nested interrupt, sees that.
    """
    sequence = state[_SEQUENCE] + 1
    state[_SEQUENCE] = sequence & _WRAP
    i = 0
    while i < 4:
        state[_Q + i] = q[i]
        i += 1
    flags = counts[10]
    state[_FLAGS] = flags
    steps = (state[_STEPS] + 1) & _WRAP
    state[_STEPS] = steps
    state[_FRESH_STEPS] = (state[_FRESH_STEPS] + (flags & _FRESH)) & _WRAP
    state[_SEQUENCE] = (sequence + 1) & _WRAP
    if flags & _FRESH and steps & (_HEALTH_EVERY - 1):
        return 0
    return 1


# The methods of the tick are native code: it takes half the time, and a bytecode frame over 11 words, which a `try`
# soon makes, would come from the heap where that is not locked.


class Tick:
    """One step a sample: read -> calibrate -> update -> publish, then at most `chunk` bytes of the new display.

    `on_sample` and `on_fifo` are the callbacks (made once here, since fetching a bound method allocates): on_sample
    for a timer or the chip's data-ready line, on_fifo for a timer that drains the FIFO. They never raise: what
    goes wrong is counted in `missed` (ticks that never came, made up for by coasting), `crashes` (with the last one
    in `error`), and in the driver's and display's own counters.

    period_us    the sample period, to notice ticks that never came; 0 with the FIFO, whose packets say it
    follow       how readily the expected time follows the ticks' own clock: by late / 2**follow a tick
    display      given only where the tick owns the display's bus
    calibration  None: the filter gets the driver's counts as they are
    mag          a magnetometer that is read by itself, its bus being the tick's; None where it comes with the sample
    """

    def __init__(
        self,
        imu,
        filter,
        period_us,
        display=None,
        chunk=32,
        follow=FOLLOW_TIMER,
        calibration=None,
        mag=None,
    ):
        self._imu = imu
        self._filter = filter
        self._raw = imu.counts
        self._calibration = calibration
        self._counts = imu.counts if calibration is None else calibration.counts
        self._mag = mag
        self._display = display
        self._chunk = chunk
        self._period = period_us
        self._follow = follow
        self._due = ticks_us()
        self._started = False
        self._made_up = 0
        self._inside = False
        self._seen = -1
        self._state = array("i", [0] * _WORDS)
        self._q = memoryview(filter.state)[filter.QUATERNION : filter.QUATERNION + 4]
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
                if self._mag is not None:
                    self._mag.read(self._raw)
                self._step()
                if self._display is not None:
                    self._display.flush_step(self._chunk)
        except Exception as error:
            # it must not stop the timer: counted, and shown by the main program
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
                self._look_after()
            while n > 0:
                imu.fifo_next()  # a packet that is withheld after a reset is a step all the same: it coasts
                if n == 1 and self._mag is not None:
                    self._mag.read(self._raw)
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
            if self._state[_STEPS] == self._seen:
                self._imu.read()
                self._look_after()
                if self._display is not None:  # which is to show that the sensor is lost
                    self._display.flush_step(self._chunk)
            self._seen = self._state[_STEPS]
        except Exception as error:
            self._crashed(error)
        self._inside = False

    @micropython.native
    def _look_after(self):
        """Health of the chip from a tick that comes seldom: a repair is not to take a tick for each register."""
        n = _REPAIRS
        while n > 0 and self._imu.health() == _REPAIRING:
            n -= 1

    def _crashed(self, error):
        self.crashes = (self.crashes + 1) & _WRAP
        self.error = error

    @micropython.native
    def _on_time(self):
        """Coast through ticks that never came. False: this tick is one that was made up for and came late.

        Ticks are held against where the next one is due, not against the last one: a tick that always takes a
        little longer than its period loses some, and every gap alone would look fit.
        """
        period = self._period
        if period == 0:
            return True
        due = self._due
        late = ticks_diff(ticks_us(), due)
        if not self._started:
            self._started = True
            self._due = ticks_add(due, late + period)
            return True
        if late >= period:
            self._coast(late // period)
            due = self._due
        elif self._made_up:
            if late < -(period >> 1):
                self._made_up -= 1
                return False
            if late < period >> 1:
                self._made_up = 0
        self._due = ticks_add(due, period + (late >> self._follow))
        return True

    def _coast(self, lost):
        self.missed = (self.missed + lost) & _WRAP
        self._due = ticks_add(self._due, lost * self._period)
        if lost > _MOST_COASTS:
            lost = _MOST_COASTS
        self._made_up = lost
        self._counts[10] &= ~_ANY_FRESH
        while lost > 0:
            self._filter.update(self._counts)
            lost -= 1

    @micropython.native
    def _step(self):
        counts = self._counts
        if self._calibration is not None:
            self._calibration.apply(self._raw)
        self._filter.update(counts)
        if _publish(self._state, self._q, counts):
            self._imu.health()

    # -- for the main program
    def resume(self):
        """Before the ticks go on after they were stopped: that time is not one of ticks that never came."""
        self._started = False
        self._made_up = 0

    @property
    def steps(self):
        """Steps of the filter, ticks made up for not counted."""
        return self._state[_STEPS]

    @property
    def fresh(self):
        """Steps that had a fresh sample."""
        return self._state[_FRESH_STEPS]

    def snapshot(self, out):
        """Copy the published state into out, an array('i') of SNAPSHOT_WORDS, all of one step: quaternion Q29
        (w x y z), flags, steps, steps with a fresh sample.

        -> False when the tick never left it alone for long enough (then out is not to be used).
        """
        state = self._state
        for _ in range(100):
            before = state[_SEQUENCE]
            for i in range(SNAPSHOT_WORDS):
                out[i] = state[_Q + i]
            if before == state[_SEQUENCE] and not before & 1:
                return True
        return False
