"""make_tick: the best timer that a port has, and a refusal of the rates that it cannot keep."""

import types

import machine
import pytest
from upright import timing


class FakeTimer:
    """machine.Timer of a port: `refuses` is what it raises at hard=True, as the ports do."""

    PERIODIC = 1
    refuses = None
    made = ()

    def __init__(self, id, **options):
        if options.get("hard") and self.refuses:
            raise self.refuses
        self.id = id
        self.options = options
        self.stopped = False

    def deinit(self):
        self.stopped = True


@pytest.fixture
def port(monkeypatch):
    """Put a port's machine.Timer in place -> function(exception at hard=True)."""

    def put(refuses=None):
        kind = type("Timer", (FakeTimer,), {"refuses": refuses})
        monkeypatch.setattr(timing.machine, "Timer", kind)

    return put


def test_rp2_gets_a_hard_timer_of_exact_microseconds(port):
    port()
    ticker = timing.make_tick((2000, 7), print, microseconds=True)
    assert (ticker.hard, ticker.period_us) == (True, 3500)
    assert ticker.timer.options["period"] == 3500
    assert ticker.timer.options["tick_hz"] == 1000000
    ticker.stop()
    assert ticker.timer.stopped


@pytest.mark.parametrize(
    "refuses", [TypeError("unexpected keyword argument 'hard'"), ValueError("hard Timers")]
)
def test_a_port_without_hard_timers_gets_a_soft_one_and_says_so(port, refuses):
    port(refuses)
    ticker = timing.make_tick(200, print, microseconds=False)
    assert not ticker.hard
    assert "soft" in ticker.what
    assert ticker.timer.options["period"] == 5
    assert "tick_hz" not in ticker.timer.options


def test_a_millisecond_timer_refuses_what_it_cannot_keep(port):
    port()
    for rate in ((2000, 7), 300, 2000):
        with pytest.raises(ValueError, match="cannot tick at"):
            timing.make_tick(rate, print, microseconds=False)
    for rate in (100, 200, 250, 500, 1000):
        assert timing.make_tick(rate, print, microseconds=False).period_us == 1000000 // rate


def test_a_microsecond_timer_refuses_a_rate_beyond_a_crystals_error(port):
    port()
    assert timing.make_tick(300, print, microseconds=True).period_us == 3333  # 100 ppm off
    with pytest.raises(ValueError):
        timing.make_tick(700, print, microseconds=True)  # 1428.57 us: 300 ppm off


@pytest.mark.parametrize("rate", [0, -5, (0, 1), (100, 0)])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(ValueError, match="positive"):
        timing.make_tick(rate, print)


class PybTimer:
    """pyb.Timer of an STM32F4: 84 or 168 MHz into a 16-bit prescaler and a 16-bit counter."""

    clock = 84000000

    def __init__(self, number):
        self.number = number
        self.set = None

    def init(self, freq=None, prescaler=None, period=None):
        if freq is None:
            assert 0 <= prescaler <= 0xFFFF
            assert 0 <= period <= 0xFFFF
            self.set = (prescaler + 1) * (period + 1)

    def source_freq(self):
        return self.clock

    def callback(self, function):
        self.function = function

    def deinit(self):
        self.set = None


@pytest.mark.parametrize("rate", [50, 200, (2000, 7), 500, 1000, 8000])
@pytest.mark.parametrize("clock", [84000000, 168000000])
def test_a_pyboard_gets_its_hardware_timer_close_enough(monkeypatch, rate, clock):
    monkeypatch.setattr(timing, "pyb", types.SimpleNamespace(Timer=PybTimer))
    monkeypatch.setattr(PybTimer, "clock", clock)
    ticker = timing.make_tick(rate, print, pyb_timer=4)
    num, den = rate if isinstance(rate, tuple) else (rate, 1)
    exact = clock * den / num
    assert abs(ticker.timer.set - exact) <= exact * 1e-4
    assert abs(ticker.period_us - 1e6 * den / num) <= 1
    assert ticker.hard
    assert "pyb.Timer(4)" in ticker.what
    assert ticker.timer.function is print


def test_the_simulated_board_ticks_at_its_rate():
    import kernel

    count = []
    timing.make_tick((2000, 7), count.append, microseconds=True)
    kernel.advance(1000000)
    assert len(count) == 285
    assert isinstance(count[0], machine.Timer)
