"""The tick: one step a sample whatever the timer does, faults counted and survived, a snapshot that is never torn."""

import math
from array import array

import kernel
import pytest
from upright.tick import PHASE_GAIN_SHIFT_CHIP, SNAPSHOT_WORDS, TURNS, Tick

PERIOD = 5000


class Imu:
    """Delivers what the test says; counts how it was used."""

    gyro_scale = (82, 5)

    def __init__(self):
        self.counts = array("h", [0] * 11)
        self.flags = 1
        self.reads = 0
        self.healths = 0
        self.packets = []
        self.fifo_lost = 0
        self.fail = None

    def read(self):
        self.reads += 1
        if self.fail:
            raise self.fail
        self.counts[10] = self.flags
        return self.flags

    def health(self):
        self.healths += 1

    def fifo_poll(self):
        return len(self.packets)

    def fifo_next(self):
        self.counts[0] = self.packets.pop(0)
        self.counts[10] = 1
        return 1


class Filter:
    """Remembers the flags and the first word of every sample; its quaternion is the number of steps."""

    QUATERNION = 1

    def __init__(self):
        self.flags = []
        self.words = []
        self.state = array("i", [0] * 6)

    def bias(self, out):
        for i in range(3):
            out[i] = 256 * len(self.flags)

    def update(self, counts):
        self.flags.append(counts[10])
        self.words.append(counts[0])
        for i in range(4):
            self.state[1 + i] = len(self.flags)


class Display:
    def __init__(self):
        self.asked = []

    def flush_step(self, most):
        self.asked.append(most)
        return 0


@pytest.fixture
def imu():
    return Imu()


@pytest.fixture
def filter():
    return Filter()


@pytest.fixture
def tick(imu, filter):
    return Tick(imu, filter, PERIOD)


def ticks_at(tick, times):
    """Call the tick at these times (us)."""
    for at in times:
        kernel.advance_to(at)
        tick.on_sample(None)


def test_every_tick_is_one_step(tick, filter, imu):
    ticks_at(tick, range(PERIOD, 11 * PERIOD, PERIOD))
    assert filter.flags == [1] * 10
    assert (tick.steps, tick.fresh, tick.missed) == (10, 10, 0)


def test_jitter_within_half_a_period_is_no_missed_tick(tick, filter):
    ticks_at(tick, [5000, 11000, 14000, 20000, 27400, 30100])
    assert (tick.steps, tick.missed) == (6, 0)


def test_missed_ticks_are_counted_and_coasted_through(tick, filter):
    ticks_at(tick, [5000, 10000, 25000, 30000])
    # 15000 and 20000 never came: two steps without a fresh sample, then the sample itself
    assert filter.flags == [1, 1, 0, 0, 1, 1]
    assert tick.missed == 2


def test_a_tick_exactly_a_period_late_is_the_one_after_a_missed_one(tick, filter):
    ticks_at(tick, [5000, 10000, 20000])
    assert filter.flags == [1, 1, 0, 1]
    assert tick.missed == 1


@pytest.mark.parametrize(
    "timeout, every", [(2400, 1), (4000, 1), (5200, 3), (12000, 5), (39000, 16)]
)
def test_the_time_outs_of_a_stuck_bus_leave_half_of_the_time_to_the_main_program(
    timeout, every, tick, filter, imu, monkeypatch
):
    """Where one takes most of a period or more, further steps are made at once, and their ticks do nothing."""
    busy = 0

    def read(self):
        nonlocal busy
        busy += timeout
        kernel.advance(timeout)
        self.counts[10] = 0
        return 0

    monkeypatch.setattr(Imu, "read", read)
    for n in range(1, 101):
        kernel.advance_to(max(n * PERIOD, kernel.now()))
        tick.on_sample(None)
    assert abs(len(filter.flags) - 100) <= every and tick.missed == 0
    assert busy <= 100 * PERIOD * (0.5 if every > 1 else 0.8) + timeout
    monkeypatch.undo()
    ticks_at(tick, range(kernel.now() + PERIOD, kernel.now() + 20 * PERIOD, PERIOD))
    assert filter.flags[-2:] == [1, 1] and tick.missed == 0


def test_on_a_stuck_bus_the_magnetometer_is_not_asked_as_well(imu, filter):
    class Mag:
        reads = 0

        def read(self, counts):
            self.reads += 1

    mag = Mag()
    tick = Tick(imu, filter, PERIOD, mag=mag)
    ticks_at(tick, [5000])
    imu.flags = 0
    ticks_at(tick, [10000])
    assert mag.reads == 2
    read = imu.read
    imu.read = lambda: (kernel.advance(3700), read())
    ticks_at(tick, [15000])
    assert mag.reads == 2


def test_what_was_made_up_for_before_a_stop_is_owed_no_more(tick, filter):
    ticks_at(tick, [5000, 10000, 25000])
    tick.resume()
    ticks_at(tick, [60000, 62000])  # the second is early, and no late one of before
    assert filter.flags == [1, 1, 0, 0, 1, 1, 1]
    assert tick.missed == 2


def test_a_magnetometer_on_its_own_bus_is_read_with_the_newest_packet(imu, filter):
    class Mag:
        def __init__(self):
            self.reads = []

        def read(self, counts):
            self.reads.append(counts[0])

    mag = Mag()
    imu.packets = [1, 2, 3]
    Tick(imu, filter, 0, mag=mag).on_fifo(None)
    assert mag.reads == [3]
    assert filter.words == [1, 2, 3]


def test_ticks_that_were_made_up_for_and_come_late_are_not_stepped_twice(tick, filter, imu):
    # A callback held up to 25000; the port then runs the late ones one after the other (rp2 does).
    ticks_at(tick, [5000, 10000, 25000, 25100, 25200, 30000, 35000])
    assert len(filter.flags) == 7  # 5000..35000: seven periods
    assert filter.flags == [1, 1, 0, 0, 1, 1, 1]
    assert imu.reads == 5


def test_an_early_tick_that_nothing_was_made_up_for_is_a_step(tick, filter):
    ticks_at(tick, [5000, 10000, 12000])
    assert filter.flags == [1, 1, 1]


def test_a_tick_always_a_little_too_long_is_noticed(tick, filter):
    """Every gap alone is below one and a half periods; over 130 ms six of 27 ticks are lost all the same."""
    ticks_at(tick, range(5000, 136001, 6500))
    assert tick.missed in (5, 6)  # the last one shows with the next tick
    assert len(filter.flags) == tick.steps + tick.missed


def test_a_chip_clock_that_is_off_by_two_percent_is_no_missed_tick(imu, filter):
    for period in (4900, 5100):
        tick = Tick(imu, filter, PERIOD, phase_gain_shift=PHASE_GAIN_SHIFT_CHIP)
        start = kernel.now()
        ticks_at(tick, range(start, start + 1000 * period, period))
        assert (tick.missed, tick.steps) == (0, 1000)


def test_a_timer_rounded_to_microseconds_is_no_missed_tick(imu, filter):
    tick = Tick(imu, filter, 3333)
    ticks_at(tick, [10000 * k // 3 for k in range(1, 3000)])
    assert (tick.missed, tick.steps) == (0, 2999)


def test_the_steps_made_up_for_at_once_are_bounded_and_the_next_ticks_go_on_with_them(tick, filter):
    ticks_at(tick, [5000, 5000 + 100 * PERIOD])
    assert tick.missed == 99
    assert len(filter.flags) == 1 + 16 + 1
    ticks_at(tick, [5000 + (101 + k) * PERIOD for k in range(10)])
    assert tick.missed == 99
    assert len(filter.flags) == 1 + 99 + 1 + 10
    assert filter.flags.count(0) == 99


def test_no_more_than_a_second_is_made_up_for(tick, filter):
    ticks_at(tick, [5000, 5000 + 1000 * PERIOD])
    ticks_at(tick, [5000 + (1001 + k) * PERIOD for k in range(30)])
    assert tick.missed == 999
    assert len(filter.flags) == 1 + 16 + 200 + 1 + 30


@pytest.mark.parametrize("took, more", [(2600, 0), (300, 1)])
def test_after_a_time_out_of_the_bus_nothing_more_is_transferred_in_the_tick(
    imu, filter, took, more
):
    """Each transfer of a stuck bus takes as long. A refused one is quick."""
    display = Display()
    tick = Tick(imu, filter, PERIOD, display)

    def fail():
        kernel.advance(took)
        imu.counts[10] = 0
        return 0

    imu.read = fail
    ticks_at(tick, [5000, 10000, 15000])
    assert (imu.healths, len(display.asked), len(filter.flags)) == (3 * more, 3 * more, 3)


def test_a_tick_that_raised_is_a_step_all_the_same(tick, filter, imu):
    imu.fail = RuntimeError("broken driver")
    ticks_at(tick, [5000, 10000])
    assert (tick.crashes, filter.flags) == (2, [0, 0])


def test_a_tick_is_one_crash_although_the_filter_raises_in_the_step_made_up_for_too(tick, filter):
    tried = []

    def broken(counts):
        tried.append(counts[10])
        if len(tried) == 6:
            raise KeyboardInterrupt
        raise ValueError("the filter")

    filter.update = broken
    ticks_at(tick, [5000, 10000])
    assert (tick.crashes, tried, tick.interrupt) == (2, [1, 0, 1, 0], None)
    ticks_at(tick, [15000])
    assert tick.crashes == 3 and isinstance(tick.interrupt, KeyboardInterrupt)


def test_a_stale_sample_is_a_coasting_step_and_health_is_looked_at(tick, filter, imu):
    imu.flags = 0
    ticks_at(tick, [5000, 10000, 15000])
    assert filter.flags == [0, 0, 0]
    assert (tick.steps, tick.fresh, imu.healths) == (3, 0, 3)


def test_health_is_looked_at_now_and_then_while_samples_come(tick, imu):
    ticks_at(tick, range(PERIOD, 25 * PERIOD, PERIOD))
    assert imu.healths == 3


def test_an_exception_is_counted_and_the_next_tick_works(tick, filter, imu):
    imu.fail = RuntimeError("broken driver")
    ticks_at(tick, [5000, 10000])
    imu.fail = None
    ticks_at(tick, [15000])
    assert tick.crashes == 2
    assert str(tick.error) == "broken driver"
    assert tick.steps == 1


def test_a_tick_inside_a_tick_does_nothing(tick, filter, imu):
    """A data-ready line at a higher priority than the guard's timer, or the other way round."""
    read = imu.read
    imu.read = lambda: (tick.on_sample(None), tick.on_guard(None), read())[-1]
    ticks_at(tick, [5000])
    assert (tick.steps, imu.reads) == (1, 1)


def test_the_display_gets_one_bounded_piece_a_tick(imu, filter):
    display = Display()
    tick = Tick(imu, filter, PERIOD, display, chunk=24)
    ticks_at(tick, [5000, 10000])
    assert display.asked == [24, 24]


def test_with_the_fifo_each_packet_is_a_step_however_late(imu, filter):
    tick = Tick(imu, filter, 0)
    imu.packets = [10, 11, 12]
    kernel.advance(90000)
    tick.on_fifo(None)
    assert filter.words == [10, 11, 12]
    assert (tick.steps, tick.missed) == (3, 0)


def test_packets_that_the_fifo_lost_are_coasted_through_a_bounded_number_a_tick(imu, filter):
    tick = Tick(imu, filter, 0)
    imu.packets = [1, 2]
    tick.on_fifo(None)
    imu.fifo_lost = 20
    tick.on_fifo(None)
    assert filter.flags == [1, 1] + [0] * 16
    imu.packets = [3]
    tick.on_fifo(None)
    assert filter.flags[18:] == [0] * 4 + [1] and filter.words[-1] == 3
    assert (tick.steps, tick.fresh) == (3, 3)
    # set-up drops packets, too; that is nothing to make up for
    imu.fifo_lost = 50
    tick.resume()
    tick.on_fifo(None)
    assert len(filter.flags) == 23


def test_an_empty_fifo_is_a_reason_to_look_at_the_chip(imu, filter):
    tick = Tick(imu, filter, 0)
    tick.on_fifo(None)
    assert (tick.steps, imu.healths) == (0, 1)


def test_the_guard_goes_on_with_the_display_when_samples_stop(imu, filter):
    display = Display()
    tick = Tick(imu, filter, PERIOD, display)
    tick._seen = tick.steps
    tick.on_guard(None)
    assert display.asked == [32]


def test_the_guard_looks_at_a_chip_that_has_fallen_silent(tick, imu):
    ticks_at(tick, [5000])
    before = imu.healths
    tick.on_guard(None)  # there was a step since the last one
    assert imu.healths == before
    tick.on_guard(None)
    assert imu.healths == before + 1


def test_the_whole_tick_allocates_nothing(micropython_runtime, portable):
    """Ten thousand of each drive with driver, filter and display, and of nine axes on SPI with calibration, trim and a
    control loop; the script's own twin shows that it would tell."""
    lines = portable(micropython_runtime, "tick_alloc.py").splitlines()
    assert [line.split()[1] for line in lines[:4]] == ["ok"] * 4
    assert lines[4].endswith("found")


class Interrupted(array):
    """The published state, with a tick between any two words that are read from it."""

    def __getitem__(self, i):
        value = array.__getitem__(self, i)
        if self.left and not self.busy:
            self.busy = True
            self.left -= 1
            self.step()
            self.busy = False
        return value


def interrupted(tick, times):
    """Let the tick run at the next `times` reads of its published state."""
    state = Interrupted("i", tick._state)
    state.left, state.busy = times, False

    def step():
        kernel.advance(PERIOD)
        tick.on_sample(None)

    state.step = step
    tick._state = state


@pytest.mark.parametrize("times", range(40))
def test_a_snapshot_is_never_torn(tick, times):
    ticks_at(tick, [5000])
    interrupted(tick, times)
    out = array("i", [0] * SNAPSHOT_WORDS)
    assert tick.snapshot(out)
    assert len(set(out[:4])) == 1
    assert out[5] == out[0]  # the steps of the same step


def test_a_plain_copy_of_the_state_would_be_torn(tick):
    """Of the set that is written next: the tick is ahead of a reader that takes it."""
    ticks_at(tick, [5000, 10000])
    interrupted(tick, 9)
    copy = [tick._state[i] for i in range(len(tick._state))]
    assert len(set(copy[6:10])) > 1


def test_a_snapshot_that_cannot_be_had_says_so(tick):
    ticks_at(tick, [5000])
    interrupted(tick, 10**6)
    assert not tick.snapshot(array("i", [0] * SNAPSHOT_WORDS))


def test_a_reader_that_cuts_into_the_tick_finds_the_step_before(tick, filter):
    """An interrupt above the tick's, or another core, at any word of the set that is being written."""
    ticks_at(tick, [5000])
    found = []

    class Watched(array):
        def __setitem__(self, i, value):
            array.__setitem__(self, i, value)
            if i != 0:  # with word 0 the new set is the newest
                out = array("i", [0] * SNAPSHOT_WORDS)
                assert tick.snapshot(out)
                found.append((len(set(out[:4])), out[0], out[5]))

    tick._state = Watched("i", tick._state)
    ticks_at(tick, [10000])
    assert len(found) > 14
    assert set(found) == {(1, 1, 1)}


def test_a_short_array_for_a_snapshot_is_refused(tick):
    """Native code would write behind its end."""
    with pytest.raises(ValueError, match="15 words"):
        tick.snapshot(array("i", [0] * 7))


def test_rates_are_those_of_the_step_less_the_bias(tick, imu, filter):
    for counts, rate in ((0, 0), (16400, 1000000), (-32768, -1998049), (32767, 1997988)):
        imu.counts[3] = counts
        ticks_at(tick, [kernel.now() + PERIOD])
        out = array("i", [0] * 3)
        assert tick.rates_into(out)
        bias = len(filter.flags) * 5000 / 82  # a count a step
        assert out[0] == pytest.approx(rate - bias, abs=1)


class Yaw(Filter):
    """Turns about z by `degrees` a step."""

    degrees = 0

    def update(self, counts):
        Filter.update(self, counts)
        half = math.radians(self.degrees * len(self.flags) / 2)
        self.state[1:5] = array(
            "i", [round(math.cos(half) * 2**29), 0, 0, round(math.sin(half) * 2**29)]
        )


@pytest.mark.parametrize("degrees", [50, -50, 7, -3])
def test_full_turns_are_counted_both_ways(imu, degrees):
    filter = Yaw()
    filter.degrees = degrees
    tick = Tick(imu, filter, PERIOD)
    tick.seeded()
    out = array("i", [0] * SNAPSHOT_WORDS)
    for k in range(1, 300):
        ticks_at(tick, [PERIOD * k])
        tick.snapshot(out)
        yaw = math.degrees(2 * math.atan2(out[3], out[0]))
        yaw = (yaw + 180) % 360 - 180
        if abs(abs(yaw) - 180) > 0.01:
            assert yaw + 360 * out[TURNS] == pytest.approx(degrees * k, abs=0.01)


# on_step and what must not stop the tick


def test_on_step_is_called_after_each_step_with_its_argument(imu, filter):
    seen = []
    tick = Tick(imu, filter, PERIOD, on_step=seen.append, argument="face")
    ticks_at(tick, [5000, 10000])
    assert seen == ["face"] * 2
    tick = Tick(imu, filter, 0, on_step=lambda _: seen.append(tick.steps))
    imu.packets = [1, 2, 3]
    tick.on_fifo(None)
    assert seen[2:] == [1, 2, 3]


def test_an_exception_of_on_step_is_counted_by_itself_and_the_tick_goes_on(imu, filter):
    display = Display()

    def fall(_):
        raise RuntimeError("no motor")

    tick = Tick(imu, filter, PERIOD, display, on_step=fall)
    ticks_at(tick, [5000, 10000])
    assert (tick.steps, tick.step_errors, tick.crashes) == (2, 2, 0)
    assert str(tick.step_error) == "no motor"
    assert display.asked == [32, 32]  # and the rest of the tick was done


@pytest.mark.parametrize("where", ["driver", "on_step"])
def test_a_ctrl_c_that_lands_in_the_tick_is_kept(imu, filter, where):
    def interrupt(*_):
        raise KeyboardInterrupt

    tick = Tick(imu, filter, PERIOD, on_step=interrupt if where == "on_step" else None)
    if where == "driver":
        imu.fail = KeyboardInterrupt()
    ticks_at(tick, [5000])
    assert isinstance(tick.interrupt, KeyboardInterrupt)
    assert (tick.crashes, tick.step_errors) == (0, 0)
    imu.fail = None
    ticks_at(tick, [10000])
    assert tick.steps >= 1
