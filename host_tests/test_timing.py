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
    """Put a port's machine.Timer in place -> function(sys.platform, exception at hard=True)."""

    def put(platform, refuses=None):
        kind = type("Timer", (FakeTimer,), {"refuses": refuses})
        monkeypatch.setattr(timing.machine, "Timer", kind)
        monkeypatch.setattr(timing.sys, "platform", platform)
        monkeypatch.setattr(timing, "_taken", [])

    return put


def test_rp2_gets_a_hard_timer_of_exact_microseconds(port):
    port("rp2")
    ticker = timing.make_tick((2000, 7), print)
    assert (ticker.hard, ticker.period_us) == (True, 3500)
    assert ticker.timer.options["period"] == 3500
    assert ticker.timer.options["tick_hz"] == 1000000
    ticker.stop()
    assert ticker.timer.stopped


@pytest.mark.parametrize(
    "refuses", [TypeError("unexpected keyword argument 'hard'"), ValueError("hard Timers")]
)
def test_a_port_without_hard_timers_gets_a_soft_one_and_says_so(port, refuses):
    port("esp32", refuses)
    ticker = timing.make_tick(200, print)
    assert not ticker.hard
    assert "soft" in ticker.what
    assert ticker.timer.options["period"] == 5
    assert "tick_hz" not in ticker.timer.options


def test_a_millisecond_timer_refuses_what_it_cannot_keep(port):
    port("samd")
    for rate in ((2000, 7), 300, 2000):
        with pytest.raises(ValueError, match="cannot tick at"):
            timing.make_tick(rate, print)
    for rate in (100, 200, 250, 500, 1000):
        assert timing.make_tick(rate, print).period_us == 1000000 // rate


def test_a_microsecond_timer_refuses_a_rate_beyond_a_crystals_error(port):
    port("rp2")
    assert timing.make_tick(300, print).period_us == 3333  # 100 ppm off
    with pytest.raises(ValueError):
        timing.make_tick(700, print)  # 1428.57 us: 300 ppm off


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


@pytest.mark.parametrize("platform", ["nrf52", "webassembly"])
def test_a_port_without_a_known_timer_is_refused_by_name(port, platform):
    port(platform)
    with pytest.raises(ValueError, match=f"'{platform}'.*manual drive"):
        timing.make_tick(200, print)


def test_two_ticks_on_an_esp32_have_a_timer_each(port):
    port("esp32", ValueError("hard Timers are not implemented"))
    first, second = timing.make_tick(100, print), timing.make_tick(100, print)
    assert (first.timer.id, second.timer.id) == (0, 1)
    with pytest.raises(ValueError, match="timer 1 drives another tick"):
        timing.make_tick(100, print, 1)
    first.stop()
    assert timing.make_tick(100, print).timer.id == 0
    timing.make_tick(100, print), timing.make_tick(100, print)
    with pytest.raises(ValueError, match="every timer"):
        timing.make_tick(100, print)


@pytest.mark.parametrize("rate", [50, 200, (2000, 7), 500, 1000, 8000])
@pytest.mark.parametrize("clock", [84000000, 168000000])
def test_a_pyboard_gets_its_hardware_timer_close_enough(monkeypatch, rate, clock):
    monkeypatch.setattr(timing, "pyb", types.SimpleNamespace(Timer=PybTimer))
    monkeypatch.setattr(timing, "_taken", [])
    monkeypatch.setattr(PybTimer, "clock", clock)
    ticker = timing.make_tick(rate, print, 4)
    num, den = rate if isinstance(rate, tuple) else (rate, 1)
    exact = clock * den / num
    assert abs(ticker.timer.set - exact) <= exact * 1e-4
    assert abs(ticker.period_us - 1e6 * den / num) <= 1
    assert ticker.hard
    assert "pyb.Timer(4)" in ticker.what
    assert ticker.timer.function is print


def test_without_a_number_a_pyboard_takes_a_timer_that_it_has_and_nobody_uses(monkeypatch):
    class SomeTimers(PybTimer):
        """The STM32F411's: 1 to 5 and 9 to 11."""

        def __init__(self, number):
            if number not in (1, 2, 3, 4, 5, 9, 10, 11):
                raise ValueError(f"Timer({number}) doesn't exist")
            PybTimer.__init__(self, number)

    monkeypatch.setattr(timing, "pyb", types.SimpleNamespace(Timer=SomeTimers))
    monkeypatch.setattr(timing, "_taken", [])
    made = [timing.make_tick(200, print) for _ in range(3)]
    assert [ticker.timer.number for ticker in made] == [4, 10, 11]
    with pytest.raises(ValueError, match="every timer"):
        timing.make_tick(200, print)
    made[1].stop()
    assert timing.make_tick(200, print).timer.number == 10


def test_the_simulated_board_ticks_at_its_rate():
    import kernel

    count = []
    timing.make_tick((2000, 7), count.append)
    kernel.advance(1000000)
    assert len(count) == 285
    assert isinstance(count[0], machine.Timer)


@pytest.mark.parametrize(("centi_us", "kept"), [(300027, True), (300045, False)])
def test_a_rate_is_kept_within_a_crystal_s_error_or_refused(port, centi_us, kept):
    """90 and 150 ppm off the nearest whole microsecond."""
    port("rp2")
    rate = (100_000_000, centi_us)
    if kept:
        assert timing.make_tick(rate, print).period_us == 3000
    else:
        with pytest.raises(ValueError, match="cannot tick at"):
            timing.make_tick(rate, print)
