# The tick: sample, filter, published state, a bounded piece of the display. Runs in a hard interrupt.
# Needs fixmath.py and viper. A driver (read, health, counts) and a filter (update, state) are passed in, and where
# the board has them a calibration (apply, counts) and a magnetometer on a bus of its own (read). Every port.

from array import array
from time import ticks_add, ticks_diff, ticks_us

import micropython
from micropython import const

from upright.fixmath import euler

# The published state, array('i'): a sequence number, whether on_step is called, the side of north at the last step, and
# the counters of steps, of steps with a fresh sample, and of turns. Then come two sets. The lowest bit of the sequence
# number selects the newest. A step writes the other one and then increments the sequence number, so an interrupt that
# cuts into the tick also reads a complete set.
_SEQUENCE = const(0)
_CALLS = const(1)  # _CALL_ON_STEP or 0
_SIDE = const(2)
_STEPS = const(3)
_FRESH_STEPS = const(4)
_TURNS = const(5)
_SETS = const(6)
_WORDS = const(36)
# A set, and what snapshot() gives: quaternion Q29 (w x y z), flags, steps, steps with a fresh sample, full turns of the
# yaw, accelerometer x y z, gyro x y z, temperature (counts, calibrated, body frame)
SNAPSHOT_WORDS = const(15)
FLAGS = const(4)
STEPS = const(5)
FRESH_STEPS = const(6)
TURNS = const(7)
ACCEL = const(8)
GYRO = const(11)
TEMPERATURE = const(14)

# How fast the expected time of a tick follows the actual one: by late / 2**shift a tick.
# A timer has the clock of ticks_us, but for make_tick's rounding (100 ppm: 0.1 of a period behind).
PHASE_GAIN_SHIFT_TIMER = const(10)
# The chip's clock on the data-ready line may be off by some percent (2 %: 0.64 of a period behind).
PHASE_GAIN_SHIFT_CHIP = const(5)

_FRESH = const(1)  # bit 0 of the flags: accelerometer and gyro
_ANY_FRESH = const(3)  # bit 1: magnetometer
_WRAP = const(0x3FFFFFFF)  # counters stay small ints
# Steps between two checks of a configuration register while samples arrive: a power of 2
_HEALTH_EVERY = const(8)
# What health() returns while it restores a chip's registers; and how many of them a slow tick restores at once
_REPAIRING = const(2)
_REPAIRS = const(8)
# Missed ticks that one tick coasts through at most: it bounds the tick. The next ticks go on with it.
_MOST_COASTS = const(16)
# And in all: an older gyro rate means nothing
_MOST_US = const(1000000)
# A poll or read of a rare tick that took so long has met a time-out of the bus; one that finds nothing takes 0.2 ms
_TIME_OUT_US = const(2500)


# Attempts to read one set. If 100 steps cut into as many, the tick leaves no time for a program
_TRIES = const(100)

# Words of _marks. They are no attributes: to store one takes 2000 instructions, as the class has properties.
_RUNNING = const(0)  # 0 between two ticks
_DUE = const(1)  # when the next tick is due, ticks_us
# _RUNNING from the beginning of a tick on, and after its step
_BEGUN = const(1)
_STEPPED = const(2)

# What _publish returns
_HEALTH_DUE = const(1)
_CALL_ON_STEP = const(2)


@micropython.viper
def _publish(state: ptr32, q: ptr32, counts: ptr16) -> int:
    """Write the set of this step. Returns _HEALTH_DUE every few steps and after every failed sample, and _CALL_ON_STEP
    as set.

    Turns are counted where the yaw passes 180 deg: the sine of the yaw changes its sign while its cosine is negative.
    """
    sequence = (state[_SEQUENCE] + 1) & _WRAP
    at = _SETS
    if sequence & 1:
        at += SNAPSHOT_WORDS
    state[at] = q[0]
    state[at + 1] = q[1]
    state[at + 2] = q[2]
    state[at + 3] = q[3]
    # Q15, signed by arithmetic: ptr32 zero-extends where a word is 64 bits
    w = ((q[0] >> 14 & 0x3FFFF) ^ 0x20000) - 0x20000
    x = ((q[1] >> 14 & 0x3FFFF) ^ 0x20000) - 0x20000
    y = ((q[2] >> 14 & 0x3FFFF) ^ 0x20000) - 0x20000
    z = ((q[3] >> 14 & 0x3FFFF) ^ 0x20000) - 0x20000
    side = 1  # west
    if w * z + x * y < 0:
        side = 2  # east
    turns = state[_TURNS]
    before = state[_SIDE]
    if side != before:
        state[_SIDE] = side
        if before and w * w + x * x < y * y + z * z:
            turns += side + side - 3
            state[_TURNS] = turns
    flags = counts[10]
    steps = (state[_STEPS] + 1) & _WRAP
    fresh = (state[_FRESH_STEPS] + (flags & _FRESH)) & _WRAP
    state[_STEPS] = steps
    state[_FRESH_STEPS] = fresh
    state[at + FLAGS] = flags
    state[at + STEPS] = steps
    state[at + FRESH_STEPS] = fresh
    state[at + TURNS] = turns
    i = 0
    at += ACCEL
    while i < 6:
        state[at + i] = counts[i]
        i += 1
    state[at + 6] = counts[9]
    state[_SEQUENCE] = sequence
    if flags & _FRESH and steps & (_HEALTH_EVERY - 1):
        return state[_CALLS]
    return state[_CALLS] | _HEALTH_DUE


@micropython.viper
def _copy(state: ptr32, out: ptr32) -> int:
    """Copy the newest set into out; returns its sequence number."""
    sequence = state[_SEQUENCE]
    at = _SETS
    if sequence & 1:
        at += SNAPSHOT_WORDS
    i = 0
    while i < ACCEL:
        out[i] = state[at + i]
        i += 1
    while i < SNAPSHOT_WORDS:
        out[i] = ((state[at + i] & 0xFFFF) ^ 0x8000) - 0x8000
        i += 1
    return sequence


@micropython.viper
def _rates(state: ptr32, out: ptr32, num: int, den: int):
    """out[0..2], a bias in 1/256 count, becomes the newest set's gyro less that bias, in mdeg/s; den/num is 1 count.

    At most 40960 counts and 255/256: with den up to 5000 (+-2000 deg/s) the products stay below 2**28.
    """
    at = _SETS + GYRO
    if state[_SEQUENCE] & 1:
        at += SNAPSHOT_WORDS
    i = 0
    while i < 3:
        counts = ((state[at + i] & 0xFFFF) ^ 0x8000) - 0x8000
        bias = ((out[i] & 0xFFFFFF) ^ 0x800000) - 0x800000
        rate = (counts << 8) - bias
        out[i] = ((rate >> 8) * den + ((rate & 255) * den >> 8) + (num >> 1)) // num
        i += 1


# The methods of the tick are native code: it takes half the time. And a `try` soon makes a bytecode frame larger than
# 11 words, which comes from the heap when that is not locked.


class Tick:
    """One step a sample: read -> calibrate -> update -> publish -> on_step, then at most `chunk` bytes of the display.

    `on_sample` and `on_fifo` are the callbacks: on_sample for a timer or the chip's data-ready line, on_fifo for a
    timer that drains the FIFO. (They are made once, because fetching a bound method allocates.) They never raise.
    The filter coasts through packets that the FIFO has lost, as through ticks that did not come.
    Faults are counted in `missed` (ticks that did not come), `crashes` (ticks that raised; the last exception is in
    `error`), `step_errors` (of on_step; the last one is in `step_error`), and in the counters of driver and display.
    A KeyboardInterrupt during the tick is stored in `interrupt`, for the main program to raise.

    period_us         the sample period, to detect missed ticks; 0 with the FIFO, where each packet is a step
    phase_gain_shift  the expected time of a tick follows the actual one by late / 2**phase_gain_shift a tick
    display           only if the tick owns the display's bus
    calibration       None: the filter gets the driver's raw counts
    mag               a magnetometer on a bus of its own, which the tick owns; None if it comes with the sample
    on_step           called with `argument` after each step; the rules of a hard interrupt hold for it
    black_box         its look() is called after what is no fresh sample, a missed tick, or an exception
    """

    def __init__(
        self,
        imu,
        filter,
        period_us,
        display=None,
        chunk=32,
        phase_gain_shift=PHASE_GAIN_SHIFT_TIMER,
        calibration=None,
        mag=None,
        on_step=None,
        argument=None,
        black_box=None,
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
        self._phase_gain_shift = phase_gain_shift
        self._marks = array("i", [0, ticks_us()])
        self._started = False
        self._coasted_ahead = 0
        # Steps still to be coasted through: of missed ticks (then _coasted_ahead is not 0), or of packets that the FIFO
        # has lost, of which so many were known at the last tick
        self._owed = self._lost = 0
        self._seen = -1
        self._state = array("i", [0] * _WORDS)
        self._state[_CALLS] = 0 if on_step is None else _CALL_ON_STEP
        self._q = memoryview(filter.state)[filter.QUATERNION : filter.QUATERNION + 4]
        num, den = imu.gyro_scale
        self._num, self._den = num, 1000 * den  # counts per mdeg/s
        self._on_step = on_step
        self._argument = argument
        self._black_box = black_box
        # the quaternion of each set, for a reader that may not allocate
        self._sets = [
            memoryview(self._state)[at : at + 4] for at in (_SETS, _SETS + SNAPSHOT_WORDS)
        ]
        self.missed = 0
        self.crashes = 0
        self.error = None
        self.step_errors = 0
        self.step_error = None
        self.interrupt = None
        self.on_sample = self._on_sample
        self.on_fifo = self._on_fifo
        self.on_guard = self._on_guard

    @micropython.native
    def _on_sample(self, source):
        marks = self._marks
        if marks[_RUNNING]:  # another source of the same tick, at a higher priority
            return
        marks[_RUNNING] = _BEGUN
        try:
            if self._on_time():
                self._imu.read()
                if self._mag is not None:
                    # on a stuck bus it would time out as well
                    if self._raw[10] & _FRESH or self._spent() << 1 <= self._period:
                        self._mag.read(self._raw)
                if self._step() and self._display is not None:
                    self._display.flush_step(self._chunk)
        except BaseException as error:
            # it must not stop the timer: it is counted, and the main program shows it
            self._crashed(error)
        marks[_RUNNING] = 0

    @micropython.native
    def _on_fifo(self, source):
        marks = self._marks
        if marks[_RUNNING]:
            return
        marks[_RUNNING] = _STEPPED  # until there is a packet
        try:
            imu = self._imu
            began = ticks_us()
            n = imu.fifo_poll()
            well = n > 0 or ticks_diff(ticks_us(), began) < _TIME_OUT_US
            if n == 0:
                self._no_packet(well)
            lost = imu.fifo_lost
            if lost != self._lost:
                self._owed += (lost - self._lost) & _WRAP
                self._lost = lost
            if self._owed > 0:
                self._make_up()
            while n > 0:
                imu.fifo_next()  # a packet that is withheld after a reset is still a step: the filter coasts
                if n == 1 and self._mag is not None:
                    self._mag.read(self._raw)
                marks[_RUNNING] = _BEGUN
                self._step()
                n -= 1
            if well and self._display is not None:
                self._display.flush_step(self._chunk)
        except BaseException as error:
            self._crashed(error)
        marks[_RUNNING] = 0

    def _no_packet(self, well):
        if well:
            self._look_after()
        if self._black_box is not None:
            self._black_box.look()

    @micropython.native
    def _on_guard(self, source):
        """Slow timer beside the data-ready line. A chip that has reset itself no longer drives that line: it is
        detected and restored here."""
        marks = self._marks
        if marks[_RUNNING]:
            return
        marks[_RUNNING] = _BEGUN
        try:
            if self._state[_STEPS] == self._seen:
                began = ticks_us()
                self._imu.read()
                if ticks_diff(ticks_us(), began) < _TIME_OUT_US:
                    self._look_after()
                    if self._display is not None:  # it shows that the sensor is lost
                        self._display.flush_step(self._chunk)
                if self._black_box is not None:
                    self._black_box.look()
            self._seen = self._state[_STEPS]
        except BaseException as error:
            self._crashed(error)
        marks[_RUNNING] = 0

    def _look_after(self):
        """Check the chip from a tick that comes rarely: it restores several registers at once."""
        n = _REPAIRS
        while n > 0 and self._imu.health() == _REPAIRING:
            n -= 1

    @micropython.native
    def _crashed(self, error):
        if isinstance(error, Exception):
            self.crashes = (self.crashes + 1) & _WRAP
            self.error = error
        else:
            self.interrupt = error
        if self._marks[_RUNNING] != _STEPPED:  # a step is always one step
            try:
                self._counts[10] &= ~_ANY_FRESH
                self._filter.update(self._counts)
            except BaseException as another:  # of the same tick, which is counted
                if not isinstance(another, Exception):
                    self.interrupt = another
        if self._black_box is not None:
            self._black_box.look()

    @micropython.native
    def _on_time(self):
        """Coast through ticks that did not come. False: this tick is late, and the filter has coasted through it
        already.

        A tick is compared with its due time, not with the tick before. A tick that always takes a little longer than
        its period loses some, and no single gap would show that.
        """
        period = self._period
        if period == 0:
            return True
        marks = self._marks
        due = marks[_DUE]
        late = ticks_diff(ticks_us(), due)
        if not self._started:
            self._started = True
            marks[_DUE] = ticks_add(due, late + period)
            return True
        if late >= period:
            self._coast(late // period)
            if self._black_box is not None:
                self._black_box.look()
            late %= period
            due = marks[_DUE]
        elif self._coasted_ahead:
            if late < -(period >> 1):
                self._coasted_ahead -= 1
                return False
            if self._owed:
                self._coast(0)
            elif late < period >> 1:
                self._coasted_ahead = 0
        marks[_DUE] = ticks_add(due, period + (late >> self._phase_gain_shift))
        return True

    def _coast(self, lost):
        self.missed = (self.missed + lost) & _WRAP
        self._marks[_DUE] = ticks_add(self._marks[_DUE], lost * self._period)
        self._owed += lost
        self._coasted_ahead = self._make_up()
        self._owed = min(self._owed, _MOST_US // self._period)

    def _make_up(self):
        """Coast through steps that are owed, a bounded number a tick; returns how many."""
        done = n = min(self._owed, _MOST_COASTS)
        self._owed -= n
        self._counts[10] &= ~_ANY_FRESH
        while n > 0:
            self._filter.update(self._counts)
            n -= 1
        return done

    @micropython.native
    def _step(self):
        """One step of the filter. Returns whether there is time for the display: not after a time-out of the bus, for
        each further transfer may take as long."""
        counts = self._counts
        if self._calibration is not None:
            self._calibration.apply(self._raw)
        self._filter.update(counts)
        due = _publish(self._state, self._q, counts)
        self._marks[_RUNNING] = _STEPPED
        if due:
            if due & _CALL_ON_STEP:
                self._call_on_step()
            if due & _HEALTH_DUE:
                if not counts[10] & _FRESH:
                    return self._without_sample()
                self._imu.health()
        return True

    def _without_sample(self):
        """Returns whether there is time for more."""
        spent = self._spent()
        well = spent + spent <= self._period
        if well:
            # a repair takes what it can of half a period
            n = _REPAIRS
            while (
                self._imu.health() == _REPAIRING
                and n > 0
                and 0 < self._spent() << 1 <= self._period
            ):
                n -= 1
        elif spent > self._period - (self._period >> 3):
            self._leave_out((spent + spent) // self._period)
        if self._black_box is not None:
            self._black_box.look()
        return well

    @micropython.native
    def _spent(self):
        """How much of the period is over, us. With the FIFO it is none."""
        period = self._period
        return period - ticks_diff(self._marks[_DUE], ticks_us()) if period else 0

    def _leave_out(self, n):
        """Coast through the next n steps now, so that their ticks find nothing to do: else the time-outs of a stuck
        bus would leave the main program no time."""
        n = min(n, _MOST_COASTS)
        self._marks[_DUE] = ticks_add(self._marks[_DUE], n * self._period)
        self._owed += n
        self._coasted_ahead = self._make_up()

    @micropython.native
    def _call_on_step(self):
        try:
            self._on_step(self._argument)
        except BaseException as error:
            if isinstance(error, Exception):
                self.step_errors = (self.step_errors + 1) & _WRAP
                self.step_error = error
                if self._black_box is not None:
                    self._black_box.look()
            else:
                self.interrupt = error

    # -- for the main program, while the tick is stopped
    def seeded(self):
        """Publish the filter's attitude and the newest counts without counting a step."""
        state = self._state
        was = [state[i] for i in (_STEPS, _FRESH_STEPS)]
        _publish(state, self._q, self._counts)
        at = _SETS + SNAPSHOT_WORDS * (state[_SEQUENCE] & 1)
        state[_STEPS], state[_FRESH_STEPS] = state[at + STEPS], state[at + FRESH_STEPS] = was

    def calibrate(self, calibration):
        """Take another calibration from the next step on; None: the driver's counts as they are."""
        self._calibration = calibration
        self._counts = self._raw if calibration is None else calibration.counts

    def hold(self):
        """Do nothing until resume(), should a timer still call: a Ctrl-C may have come while it was stopped."""
        self._marks[_RUNNING] = _BEGUN

    def resume(self):
        """Call before stopped ticks go on: ticks of the pause are not counted as missed."""
        self._marks[_RUNNING] = 0
        self._started = False
        self._coasted_ahead = self._owed = 0
        self._lost = self._imu.fifo_lost

    # -- for programs, interrupts and a second core: nothing here allocates
    @property
    def steps(self):
        """Steps of the filter, without missed ticks."""
        return self._state[_STEPS]

    @property
    def fresh(self):
        """Steps that had a fresh sample."""
        return self._state[_FRESH_STEPS]

    @micropython.native
    def snapshot(self, out):
        """Copy what was published with the newest step into out, an array('i') of SNAPSHOT_WORDS: the words are named
        at the top of this file.

        Returns False if steps kept cutting into the copy; then do not use out.
        """
        if len(out) < SNAPSHOT_WORDS:
            raise ValueError("a snapshot takes %d words" % SNAPSHOT_WORDS)
        n = _TRIES
        while n > 0:
            if _copy(self._state, out) == self._state[_SEQUENCE]:
                return True
            n -= 1
        return False

    @micropython.native
    def angles_into(self, out, order="zyx"):
        """Roll, pitch, yaw of the newest step in millidegrees into out, an array('i') of 3 words or more. Returns as
        snapshot() does.

        See fixmath.euler for the order.
        """
        if len(out) < 3:  # a kernel writes where it is told to
            raise ValueError("angles and rates take 3 words")
        n = _TRIES
        while n > 0:
            sequence = self._state[_SEQUENCE]
            euler(self._sets[sequence & 1], out, order)
            if sequence == self._state[_SEQUENCE]:
                return True
            n -= 1
        return False

    @micropython.native
    def rates_into(self, out):
        """Angular rates of the newest step about body x, y, z, without the filter's bias, in millidegrees per second,
        into out[0..2]. Returns as snapshot() does."""
        if len(out) < 3:
            raise ValueError("angles and rates take 3 words")
        n = _TRIES
        while n > 0:
            sequence = self._state[_SEQUENCE]
            self._filter.bias(out)
            _rates(self._state, out, self._num, self._den)
            if sequence == self._state[_SEQUENCE]:
                return True
            n -= 1
        return False
