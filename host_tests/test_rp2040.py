"""The real firmware for the Pico, on an emulated RP2040 with our chips on its buses: what the board does as a whole.

One flight (boot, five seconds of motion, then what must fail) serves many tests, so all of them run in one process.
"""

import hashlib
import io
import itertools
import math
from array import array
from pathlib import Path

import numpy as np
import pytest
import rp2040
from chips.ist8310 import IST8310Chip
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from chips.ssd1306 import SSD1306Chip
from rich.console import Console
from trial_files import as_trial
from upright import filters
from upright_host import bench as bench_command
from upright_host import console, emulated, paths, replay, runtimes, scoring, tracing
from upright_host import rp2040 as firmware
from world import StillWorld, World

# A firmware that is not there yet is built first, which takes minutes.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

IMU = 0x68
PERIOD_US = 5000
FLIGHT_S = 5.2
CHECKPOINT_S = 0.3  # of motion, after which the second flight is held against the first


# ---------------------------------------------------------------- the whole firmware
class Flight:
    """The project's files on a board with sensor and display on one bus, and what was seen of them."""

    def __init__(self, image, files, path):
        self.world = World(path)
        self.board = board = rp2040.Board(image, files)
        self.bus = board.i2c(0, sda=4, scl=5)
        self.bus.log = []
        self.imu = self.bus.add(MPU6050Chip(self.world))
        self.oled = self.bus.add(SSD1306Chip())
        self.steps = rp2040.Steps(board, self.bus, self.imu, self.world)
        board.boot()
        board.expect("drive", 5)
        self.steps.begin()
        board.start(self.world)

    @property
    def history(self):
        return self.steps.history

    def fingerprint(self):
        board = self.board
        memory = hashlib.sha256(bytes(board.mcu.sram)).hexdigest()
        return board.now_us, board.cycles, memory, board.console, self.bus.transfers, self.bus.bytes


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    import motions

    path = tmp_path_factory.mktemp("board") / "hand.imu"
    motion = motions.render("hand", rate=(1000, 1), seconds=8)
    motion.write(path)
    return path, motion


@pytest.fixture(scope="module")
def files():
    return emulated.project("pico", rp2040.TELL + "PAGE_SECONDS = 0\nFILTER = 'mahony6'\n")


@pytest.fixture(scope="module")
def flight(image, files, motion):
    """A flight of FLIGHT_S seconds, at its end: main.py is still running."""
    flight = Flight(image, files, motion[0])
    began = flight.board.now_us
    flight.board.run(CHECKPOINT_S)
    flight.checkpoint = flight.fingerprint()
    flight.board.run(FLIGHT_S - CHECKPOINT_S)
    flight.seconds = (flight.board.now_us - began) / 1e6
    flight.ticks = len(flight.history)
    flight.reads = [t for t in flight.bus.log if t[2] == IMU and t[4] > 14 and t[0] > began]
    flight.cuts, flight.whole = (
        flight.bus.cuts,
        all(t[5] for t in flight.bus.log if t[2] in flight.bus.chips),
    )
    return flight


def steps_and_fresh(board):
    """-> [steps, steps with a fresh sample] of one moment: the tick goes on."""
    return board.eval(
        "(lambda out: application.imu.snapshot(out) and list(out)[5:7])"
        "(__import__('array').array('i', [0] * 15))"
    )


@pytest.fixture(scope="module")
def landed(flight):
    """The same board, main.py interrupted: its timer still ticks. `numbers`: the application's counters."""
    flight.board.interrupt()
    flight.numbers = steps_and_fresh(flight.board) + flight.board.eval(
        "[application.imu.status()[name] for name in"
        " ('missed', 'crashes', 'errors', 'resets', 'display_errors')]"
    )
    return flight


def test_it_boots_from_its_file_system_into_main(flight):
    console = flight.board.console
    assert "upright on Raspberry Pi Pico" in console
    assert "sensor: MPU6050" in console
    assert "Traceback" not in console


def test_the_tick_is_a_hard_timer_interrupt(flight):
    assert "tick: machine.Timer, hard, every 5000 us, timer drive" in flight.board.console


def test_every_tick_came_and_had_a_fresh_sample(landed):
    steps, fresh, missed, crashes, errors, resets, display_errors = landed.numbers
    assert (missed, crashes, errors, resets, display_errors) == (0,) * 5
    assert fresh == steps
    numbers = [step[0] for step in landed.history]
    assert numbers == list(range(1, len(numbers) + 1))
    assert abs(landed.ticks - landed.seconds * 200) <= 2


def test_sensor_and_display_share_a_bus_and_no_transfer_is_cut(flight):
    assert flight.seconds >= 5
    assert flight.cuts == 0
    assert flight.whole
    assert flight.oled.errors == []
    assert flight.imu.misuse == []
    displayed = [t for t in flight.bus.log if t[2] == flight.oled.address]
    assert sum(t[3] for t in displayed) > 5000  # it was written all the time


def test_the_ticks_come_on_time(flight):
    """Against a grid of 5 ms: what other interrupts and critical sections cost, and the timer's own microsecond."""
    times = [t[0] for t in flight.reads]
    assert len(times) > 200 * 5
    late = [at - (times[0] + PERIOD_US * n) for n, at in enumerate(times)]
    jitter = max(late) - min(late)
    print(f"jitter of the tick: {jitter} us over {len(times)} ticks")
    assert jitter < 250


def test_the_counts_are_the_worlds_rows(landed):
    rows = [step[1] for step in landed.history]
    assert rows[-1] > 4000
    for _, row, counts, _ in landed.history:
        assert counts[:6] == landed.world.row(row)[:6]
        assert counts[10] == 1


def test_the_quaternions_are_cpythons_bit_for_bit(landed):
    class Scales:
        gyro_scale = landed.world.gyro_scale
        accel_lsb_per_g = landed.world.accel_lsb_per_g

    here = filters.make("mahony6", (200, 1), Scales, {})
    here.state[:] = landed.steps.first_state
    q = array("i", [0] * 4)
    for number, _, counts, there in landed.history:
        here.update(counts)
        here.quaternion(q)
        assert list(q) == there, f"step {number}"
    assert len({tuple(step[3]) for step in landed.history}) > len(landed.history) // 2


def test_the_attitude_is_right(landed, motion):
    q = np.array([step[3] for step in landed.history]) / scoring.ONE
    t = np.array([step[1] for step in landed.history]) / 1000
    score = scoring.score(t, q, motion[1].t, motion[1].q_true)
    assert score.inclination < 1
    # the failing twin: another second's truth
    assert scoring.score(t, q, motion[1].t - 1, motion[1].q_true).inclination > 1


@pytest.mark.parametrize("page", [0, 1])
def test_the_displays_memory_is_what_cpythons_simulation_draws(landed, page):
    import machine
    from upright import ssd1306
    from upright_app import pages

    landed.board.exec(
        "import time\n"
        "def draw(page):\n"
        "    application._page = page\n"
        "    application._frame_at = time.ticks_add(time.ticks_ms(), -1000)\n"
        "    application.poll()\n"
        "    while application.imu.display.busy:\n"  # the tick writes it
        "        time.sleep_ms(5)\n"
        f"draw({page})\n"
    )
    drawn = landed.board.eval(
        "[list(application.angles), application.imu.rate_hz, application.imu.sensor.temperature_cdeg(),"
        " application.imu.status()['faults']]"
    )
    angles, rate_hz, temperature, faults = drawn
    assert (rate_hz, faults) == (200, 0)
    chip = SSD1306Chip()
    machine.wire_i2c(0, chip)
    display = ssd1306.SSD1306(machine.I2C(0))
    display.begin()
    pages.Pages(display).draw(page, array("i", angles), rate_hz, temperature, faults, 0)
    display.show()
    assert display.flush()
    assert landed.oled.lit
    assert landed.oled.ram == chip.ram
    assert any(chip.ram)


def test_two_flights_are_the_same_to_the_cycle(flight, image, files, motion):
    second = Flight(image, files, motion[0])
    second.board.run(CHECKPOINT_S)
    assert second.fingerprint() == flight.checkpoint
    assert second.history == flight.history[: len(second.history)]
    assert len(second.history) > 50


def test_a_float_in_the_tick_fails(landed):
    """The failing twin: the heap is locked in there, and a float wants some of it."""
    said = landed.board.exec(
        "import time\n"
        "class Floating:\n"
        "    def update(self, counts):\n"
        "        self.x = counts[0] * 1.5\n"
        "tick = application.imu.tick\n"
        "whole, tick._filter = tick._filter, Floating()\n"
        "before = tick.crashes\n"
        "time.sleep_ms(52)\n"
        "tick._filter = whole\n"
        "time.sleep_ms(10)\n"
        "after = tick.crashes\n"
        "time.sleep_ms(50)\n"
        "print(before, after, tick.crashes - after, repr(tick.error))\n"
    )
    before, after, later, error = said.split(None, 3)
    assert before == "0"
    assert int(after) in (10, 11)  # ticks in 52 ms, one crash each
    assert later == "0"
    assert "MemoryError" in error


def test_a_main_program_that_writes_the_shared_display_cuts(landed):
    """The failing twin of the shared bus."""
    before = landed.bus.cuts
    landed.board.exec(
        "for _ in range(2):\n"
        "    application.imu.display.fill(_)\n"
        "    application.imu.display.show()\n"
        "    try:\n"
        "        while application.imu.display.busy:\n"
        "            application.imu.display.flush_step(32)\n"
        "    except OSError:\n"
        "        pass\n"
    )
    assert landed.bus.cuts > before


def test_ticks_that_are_kept_from_coming_are_missed(landed):
    """The failing twin of the steps' count."""
    missed = landed.board.exec(
        "import machine, time\n"
        "before = application.imu.tick.missed\n"
        "state = machine.disable_irq()\n"
        "start = time.ticks_us()\n"
        "while time.ticks_diff(time.ticks_us(), start) < 23000:\n"
        "    pass\n"
        "machine.enable_irq(state)\n"
        "time.sleep_ms(20)\n"
        "print(application.imu.tick.missed - before)\n"
    )
    assert int(missed) >= 3


# ---------------------------------------------------------------- replay
def test_a_replay_on_the_board_writes_the_bytes_that_cpython_writes(image, tmp_path, monkeypatch):
    """Through the chip's registers, the driver and the tick, in the data-ready line's hard interrupt."""
    import motions

    trial = as_trial(motions.render("bursts", rate=(2000, 7), seconds=1.5, seed=7))
    gains = {"kp": 1.0, "ki": 0.05}
    # nobody says how much of it: as much as is short, and that is told
    monkeypatch.setattr(replay, "BOARD_SECONDS", 1.05)
    told = io.StringIO()
    monkeypatch.setattr(console, "errors", Console(file=told, width=200))
    progress = []
    there = replay.replay(
        trial, "mahony6", "rp2040", gains=gains, on_progress=lambda *at: progress.append(at)
    )
    here = replay.replay(trial, "mahony6", seconds=1.05, gains=gains)
    assert "the first 1.05 of" in told.getvalue()
    for name, q29 in (("there", there.q29), ("here", here.q29)):
        scoring.write_csv(tmp_path / name, q29, trial.rate)
    lines = (tmp_path / "there").read_bytes()
    assert lines == (tmp_path / "here").read_bytes()
    assert len({tuple(q) for q in there.q29.tolist()}) > 150
    assert progress[-1] == (300, 300)


@pytest.mark.parametrize(("name", "rate"), [("inertial6", (200, 1)), ("inertial9", (2000, 7))])
def test_the_default_filters_give_cpython_s_bits_in_a_hard_interrupt(image, name, rate):
    """With nine axes the IST8310 is behind the IMU, through its auxiliary bus and its driver."""
    import motions

    trial = as_trial(motions.render("bursts", rate=rate, seconds=0.4, seed=3))
    there, here = replay.replay(trial, name, "rp2040"), replay.replay(trial, name)
    assert np.array_equal(there.q29, here.q29)
    assert len(np.unique(there.q29, axis=0)) > 60


def test_counts_cannot_go_straight_into_a_filter_of_the_board():
    import motions

    with pytest.raises(ValueError, match="registers"):
        replay.replay(as_trial(motions.render("static", seconds=1)), runtime="rp2040", direct=True)


KERNELS = sorted([*paths.PACKAGE.glob("*_kernels.py"), *paths.PACKAGE.glob("inertial_*.py")])


def test_every_filter_has_cpython_s_bits_with_kernels_that_the_board_has_compiled_itself(
    image, portable, tmp_path
):
    """As mip installs them. All filters in one boot, 200 samples each: attitudes, biases, every word of the state."""
    import motions

    names = [name for name in filters.FILTERS if name not in filters.HARDWARE]
    world, out, options = (tmp_path / name for name in ("world.imu", "out", "options.json"))
    motions.render("bursts", rate=(200, 1), seconds=1, seed=5).write(world)
    options.write_text('{"mag_every": 3}')
    files = emulated.project(application=False)
    for source in KERNELS:
        del files[f"lib/upright/{source.stem}.mpy"]
        files[f"lib/upright/{source.name}"] = source.read_bytes()
    cross = emulated.mpy_cross()
    script = Path(__file__).parent / "portable" / "filter_history.py"
    for path in (paths.SIMULATOR / "world.py", script):
        files[f"{path.stem}.mpy"] = emulated.compile_module(path, cross)
    files |= {path.name: path.read_bytes() for path in (world, options)}
    board = rp2040.Board(image, files)
    board.boot()
    for source in KERNELS:  # first: while the heap is whole
        board.exec(f"from upright import {source.stem}", 60)
    for name in names:
        said = board.exec(
            f"import sys\nsys.argv[:] = ['', 'world.imu', 'out', {name!r}, 'options.json']\n"
            "sys.modules.pop('filter_history', None)\nimport filter_history\n"
        )
        assert said == portable("cpython", script.name, world, out, name, options), name
        assert board.flash()["out"] == out.read_bytes(), name


# ---------------------------------------------------------------- the other drives, as the Pico is shipped
# machine.Timer of MicroPython before 1.26, which has no `hard`
BEFORE_1_26 = """
import machine

class Before:
    Pin = machine.Pin

    class Timer:
        PERIODIC = machine.Timer.PERIODIC

        def __new__(cls, number, *, period, mode, callback, tick_hz):
            return machine.Timer(number, period=period, mode=mode, callback=callback, tick_hz=tick_hz)

timing.machine = Before
"""


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ("DRIVE = 'fifo'", "machine.Timer, hard, every 5000 us, fifo drive"),
        ("DRIVE = 'data_ready'", "data-ready pin, hard, every 5000 us, data_ready drive"),
        (
            BEFORE_1_26,
            "machine.Timer, soft: ticks wait for the main program, every 5000 us, fifo drive",
        ),
    ],
    ids=["fifo", "data_ready", "before 1.26"],
)
def test_no_sample_is_lost_with_another_drive(image, motion, settings, says):
    """Display and sensor on one bus, the default filter, all other settings as they are shipped."""
    board = rp2040.Board(image, emulated.project("pico", f"{settings}\nMEASURE_BIAS = False\n"))
    bus, board.world = board.i2c(0, sda=4, scl=5), World(motion[0])
    imu, oled = bus.add(MPU6050Chip(board.world)), bus.add(SSD1306Chip())
    board.data_ready(6, imu)
    board.boot()
    board.expect("drive", 10)
    board.start(board.world)
    board.run(0.8)
    board.interrupt()
    assert says in board.console, board.console
    q, row = attitude(board)
    steps, fresh = steps_and_fresh(board)
    faults = board.eval(
        "[application.imu.status()[name] for name in ('missed', 'crashes', 'errors', 'resets', 'display_errors')]"
        " + [application.imu.sensor.fifo_overflows, application.imu.sensor.fifo_lost]"
    )
    assert fresh == steps
    assert 0.8 * 200 - 10 <= steps <= 1.1 * 200
    assert not any(faults), faults
    assert bus.cuts == 0
    assert imu.misuse == oled.errors == []
    assert oled.lit
    tilt = up(q) @ up(motion[1].q_true[row])
    assert math.degrees(math.acos(min(1, tilt))) < 3
    assert math.degrees(math.acos(up(q)[2])) > 3  # it does not lie level


def up(q):
    """The earth's z axis in the body."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z])


# ---------------------------------------------------------------- nine axes on SPI
MAG_AXES = ("y", "-x", "-z")  # as spi_board.py has them
NINE_S = 1.0


@pytest.fixture(scope="module")
def nine(image, tmp_path_factory):
    """MPU6500 and IST8310 on the SPI peripheral, main.py for NINE_S seconds in slow motion, then interrupted."""
    import motions

    path = tmp_path_factory.mktemp("nine") / "slow.imu"
    motion = motions.render("slow", rate=(1000, 1), seconds=3)
    motion.write(path)
    files = emulated.project()
    files["board.py"] = (Path(rp2040.__file__).parent / "spi_board.py").read_bytes()
    board = rp2040.Board(image, files)
    board.motion = motion
    board.spi_bus = board.spi(0)
    board.world = World(path)
    board.imu = board.spi_bus.add(MPU6500Chip(board.world), cs=17)
    board.mag = IST8310Chip(board.world, axes=MAG_AXES)
    board.imu.aux.append(board.mag)
    board.boot()
    board.expect("drive", 5)
    board.start(board.world)
    board.spi_bus.log = []
    board.run(NINE_S)
    board.seen, board.spi_bus.log = board.spi_bus.log, None
    board.interrupt()
    return board


def attitude(board):
    """-> (quaternion as floats, world row of about now) of the running tick."""
    row = board.world.index(board.now_us - board.world.start_us)
    q = board.eval(
        "(lambda out: application.imu.snapshot(out) and list(out))"
        "(__import__('array').array('i', [0] * 15))"
    )
    return np.array(q[:4]) / scoring.ONE, row


def test_nine_axes_over_spi_are_all_fresh(nine):
    console = nine.console
    assert "sensor: MPU6500" in console
    assert "magnetometer: IST8310" in console
    steps, fresh = steps_and_fresh(nine)
    mag_fresh = nine.eval("application.imu.magnetometer.fresh")
    assert fresh == steps
    assert abs(steps - NINE_S * 100) <= 6  # the prompt takes its time
    assert abs(mag_fresh - steps / 2) <= 8  # 50 Hz, and those before the first tick
    faults = nine.eval(
        "(lambda imu, mag: (imu.tick.missed, imu.tick.crashes, imu.sensor.errors, imu.sensor.resets, mag.stale,"
        " mag.errors, mag.resets, mag.saturated))(application.imu, application.imu.magnetometer)"
    )
    assert not any(faults), faults
    assert nine.imu.misuse == nine.mag.misuse == []


def test_what_goes_over_spi_keeps_the_sensors_limits(nine):
    assert len(nine.seen) > NINE_S * 100 * 23  # a burst: its address, 1 + 14 + 7 bytes
    assert {mode for _, _, mode, _, _ in nine.seen} == {0}
    assert max(hz for _, hz, _, _, _ in nine.seen) <= 20_000_000
    written = {hz for _, hz, _, out, _ in nine.seen if not out & 0x80 and out}
    assert all(hz <= 1_000_000 for hz in written)


def test_nine_axes_over_spi_give_the_true_attitude_with_its_heading(nine):
    q, row = attitude(nine)

    def off(row):
        dot = abs(float(q @ nine.motion.q_true[row]))
        return 2 * math.degrees(math.acos(min(1.0, dot)))

    assert off(row) < 3
    assert off(0) > off(row)  # it moved, and was followed


def test_the_fifo_drive_in_a_hard_interrupt_loses_nothing(nine):
    said = nine.exec(
        "import time\n"
        "face = application.imu\n"
        "face.settings.DRIVE = 'fifo'\n"
        "face.start()\n"
        "tick, imu, mag, ticker = face.tick, face.sensor, face.magnetometer, face.ticker\n"
        "fresh = mag.fresh\n"
        "time.sleep_ms(500)\n"
        "face.stop()\n"
        "print(ticker.what, ticker.period_us, sep=',')\n"
        "print(tick.steps, tick.fresh, mag.fresh - fresh, tick.crashes, imu.errors, imu.resets, imu.fifo_overflows,"
        " imu.fifo_lost, mag.errors, mag.resets)\n"
    )
    *_, what, numbers = said.splitlines()
    assert what == "machine.Timer, hard,20000"
    steps, fresh, mag_fresh, *faults = map(int, numbers.split())
    assert 46 <= steps <= 50
    assert fresh == steps
    assert abs(mag_fresh - steps / 2) <= 2
    assert not any(faults), faults
    assert nine.imu.misuse == []


# ---------------------------------------------------------------- a program of one's own
def test_a_program_with_asyncio_gets_readings_step_by_step_beside_its_other_tasks(image):
    files = emulated.project()
    files["main.py"] = (paths.ROOT / "docs" / "examples" / "with_asyncio.py").read_bytes()
    board = rp2040.Board(image, files)
    world = StillWorld((0, 0, 4096))
    board.i2c(0, sda=4, scl=5).add(MPU6050Chip(world))
    board.boot()
    board.start(world)
    board.expect("reading 100 ", 20)
    said = [line.split() for line in board.console.splitlines()]
    readings = [words for words in said if words[:1] == ["reading"]]
    first, last = (int(words[4]) for words in readings)
    assert first >= 50 and last - first >= 50
    assert last <= 116  # two collections of garbage, 33 ms each; otherwise none is missed
    assert all(abs(float(word)) < 1 for words in readings for word in words[6:])
    assert sum(words[:2] == ["other", "task"] for words in said) >= 1


INTERRUPTED = b"""
import upright
imu = upright.start(measure_bias=False, keep_bias=False, log=None)
print("started")
caught = 0
def until_interrupted():
    try:
        while True:
            imu.angles()
    except KeyboardInterrupt:
        pass
while caught < 200:
    try:
        while caught < 200:
            try:
                until_interrupted()
            except KeyboardInterrupt:
                pass
            caught += 1
    except KeyboardInterrupt:
        pass
"""


def test_three_hundred_ctrl_c_never_end_the_tick(image):
    """They come at any time, also in the hard interrupt. The program ends after 200 of them, or where one lands in the
    second handler; the tick goes on beside the prompt."""
    files = emulated.project()
    files["main.py"] = INTERRUPTED
    board = rp2040.Board(image, files)
    world = StillWorld((0, 0, 4096))
    bus = board.i2c(0, sda=4, scl=5)
    bus.add(MPU6050Chip(world))
    board.boot()
    board.start(world)
    board.expect("started", 20)
    board.run(0.1)  # it is in its loop
    for i in range(300):
        board.send(b"\x03")
        board.run(0.003 + 0.00013 * (i % 40))  # 5 ms is the tick's period
    before = bus.transfers
    board.run(0.5)
    assert bus.transfers - before >= 95
    board.interrupt()
    assert board.eval("imu.tick.crashes") == 0
    assert board.eval("caught") > 20
    steps = board.eval("imu.tick.steps")
    board.run(0.2)
    assert board.eval("imu.tick.steps") - steps >= 38
    board.exec("imu.stop()")


HANGS = b"""
import machine
import upright
first = machine.reset_cause() != machine.WDT_RESET
def hang(imu):
    while first and imu.tick.steps > 240:
        pass
make = upright.from_board
upright.from_board = lambda **more: make(on_step=hang, **more)
from upright_app import app
application = app.App()
application.run()
"""


@pytest.mark.soak
def test_the_watchdog_lets_a_healthy_run_be_and_resets_a_board_whose_step_hangs(image, soaking):
    """After 1.2 s, more than the time-out, the control loop never returns to the program."""
    if not soaking:
        pytest.skip("minutes on the emulated board: `make soak` runs it")
    settings = "WATCHDOG_MS = 1000\nMEASURE_BIAS = False\nFILTER = 'mahony6'\n"
    files = emulated.project("pico", settings)
    files["main.py"] = HANGS
    board = rp2040.Board(image, files)
    world = StillWorld((0, 0, 4096))
    bus = board.i2c(0, sda=4, scl=5)
    bus.add(MPU6050Chip(world))
    bus.add(SSD1306Chip())
    board.boot()
    board.start(world)
    board.expect("resets the board after 1000 ms", 20)
    assert "started by: power-on" in board.console
    board.run(1.1)
    before = bus.transfers
    board.run(0.05)
    assert bus.transfers - before >= 9  # it still steps
    assert board.resets == 0
    board.run_until(lambda: board.resets == 1, 2, "reset by the watchdog")
    board.expect("started by: watchdog", 20)
    board.expect("resets the board after 1000 ms", 20)
    board.run(1.2)
    assert board.resets == 1
    board.interrupt()
    steps, fresh = steps_and_fresh(board)
    assert steps == fresh > 220


# ---------------------------------------------------------------- the bench: the emulated board itself
class Register:
    """A chip of 256 registers, on I2C and SPI, that takes notes."""

    def __init__(self, address=0x42):
        self.address = address
        self.registers = bytearray(range(256))
        self.refuse_after = None  # bytes written before the first that is refused
        self.int_level = 0
        self.dc = None
        self.notes = []
        self._pointer = None

    def i2c_start(self, read, now):
        if not read:
            self._pointer = None
            self._written = 0
        return True

    def i2c_write(self, byte, now):
        self._written += 1
        if self.refuse_after is not None and self._written > self.refuse_after:
            return False
        if self._pointer is None:
            self._pointer = byte
        else:
            self.registers[self._pointer] = byte
            self._pointer = self._pointer + 1 & 255
        return True

    def i2c_read(self, now):
        self._pointer = (self._pointer or 0) + 1 & 255
        return self.registers[self._pointer - 1 & 255]

    def i2c_stop(self, now):
        pass

    def spi_select(self, selected, now):
        self.notes.append(("select", selected))

    def spi_transfer(self, byte, now, hz, mode):
        self.notes.append((byte, hz, mode, self.dc))
        return byte ^ 0xFF

    def reset_pin(self, level, now):
        self.notes.append(("reset", level))

    def next_event(self):
        return None

    def poll(self, now):
        pass


@pytest.fixture(scope="module")
def bench(image):
    """A board at its prompt, an empty file system, registers and a sensor on its buses."""
    board = rp2040.Board(image, {"own.txt": b"mine"})
    board.bus = board.i2c(0, sda=4, scl=5)
    board.bus.log = []
    board.register = board.bus.add(Register())
    board.slow = board.bus.add(Register(0x43), stretch_us=300)
    board.world = StillWorld()
    board.imu = board.bus.add(MPU6050Chip(board.world))
    board.data_ready(6, board.imu)
    board.spi_bus = board.spi(0)
    board.spi_chip = board.spi_bus.add(Register(), cs=17, dc=20, rst=21)
    board.boot()
    board.start(board.world)
    board.exec(
        "import time, machine\n"
        "from machine import I2C, SoftI2C, SPI, Pin, Timer\n"
        "bus = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=3000)\n"
        "def said(f):\n"
        "    t = time.ticks_us()\n"
        "    try:\n"
        "        r = f()\n"
        "    except OSError as e:\n"
        "        r = 'OSError %d' % e.errno\n"
        "    return r, time.ticks_diff(time.ticks_us(), t)\n"
    )
    return board


def test_the_board_is_what_it_is_said_to_be(bench, version):
    assert bench.eval("__import__('sys').platform") == "rp2"
    assert bench.eval("'%d.%d.%d' % __import__('sys').implementation.version[:3]") == version
    assert bench.eval("machine.freq()") == 125_000_000
    assert bench.eval("open('own.txt').read()") == "mine"


def test_a_read_takes_its_time_on_the_bus(bench):
    data, us = bench.eval("said(lambda: bus.readfrom_mem(0x42, 0x10, 14))")
    assert data == bytes(range(0x10, 0x1E))
    # two addresses, the register, 14 bytes, two starts and a stop, at 400 kHz and no less
    assert 17 * 9 / 0.4 < us < 17 * 9 / 0.4 * 1.2


def test_what_is_written_arrives(bench):
    bench.exec("bus.writeto_mem(0x42, 0x80, b'\\x01\\x02\\x03')")
    assert bench.register.registers[0x80:0x84] == b"\x01\x02\x03\x83"
    assert bench.bus.log[-1][2:] == (0x42, 4, 0, True)


def test_who_does_not_answer_is_eio(bench):
    said, us = bench.eval("said(lambda: bus.readfrom_mem(0x31, 0, 1))")
    assert said == "OSError 5"
    assert us < 500  # not the timeout


def test_a_byte_that_is_refused_ends_the_write_and_the_bus_goes_on(bench):
    """No OSError on this port: writeto says how many bytes went through (i2c_write_blocking of the SDK)."""
    bench.register.refuse_after = 2
    said, us = bench.eval("said(lambda: bus.writeto(0x42, b'\\x00\\x01\\x02\\x03'))")
    bench.register.refuse_after = None
    assert said == 2
    assert us < 500
    assert bench.eval("bus.readfrom_mem(0x42, 0x11, 1)") == b"\x11"


def test_a_chip_that_stretches_the_clock_is_waited_for(bench):
    _, quick = bench.eval("said(lambda: bus.readfrom_mem(0x42, 0x10, 2))")
    data, us = bench.eval("said(lambda: bus.readfrom_mem(0x43, 0x10, 2))")
    assert data == b"\x10\x11"
    assert 290 < us - quick < 330


def test_a_stuck_bus_times_out_and_comes_back(bench):
    bench.bus.stuck = True
    said, us = bench.eval("said(lambda: bus.readfrom_mem(0x42, 0x10, 2))")
    assert said == "OSError 110"
    assert 3000 <= us < 3600
    bench.bus.stuck = False
    assert bench.eval("bus.readfrom_mem(0x42, 0x10, 2)") == b"\x10\x11"


def test_a_bus_that_is_stuck_for_less_than_the_timeout_is_only_late(bench):
    bench.exec("bus = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=50000)")
    bench.bus.stuck = True
    bench.at(bench.now_us + 15_000, lambda: setattr(bench.bus, "stuck", False))
    data, us = bench.eval("said(lambda: bus.readfrom_mem(0x42, 0x10, 2))")
    bench.exec("bus = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=3000)")
    assert data == b"\x10\x11"
    assert 5000 < us < 15_500


def test_scan_and_a_bit_banged_bus_find_the_same_chips(bench):
    assert bench.eval("bus.scan()") == [0x42, 0x43, 0x68]
    bench.exec("soft = SoftI2C(scl=Pin(5), sda=Pin(4), freq=100000)")
    assert bench.eval("soft.readfrom_mem(0x68, 0x75, 1)") == b"\x68"
    bench.exec("soft.writeto_mem(0x42, 0x90, b'\\x5a')")
    assert bench.register.registers[0x90] == 0x5A
    assert bench.eval("said(lambda: soft.readfrom(0x31, 1))[0]") == "OSError 19"
    bench.exec("bus = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=3000)")
    assert bench.eval("bus.readfrom_mem(0x42, 0x90, 1)") == b"\x5a"


@pytest.mark.parametrize("mode", range(4))
def test_spi_has_the_mode_and_the_clock_that_it_was_set_to(bench, mode):
    bench.exec(
        f"spi = SPI(0, baudrate=1000000, polarity={mode >> 1}, phase={mode & 1},"
        " sck=Pin(18), mosi=Pin(19), miso=Pin(16))\n"
        "cs, buf = Pin(17, Pin.OUT, value=1), bytearray(8)\n"
    )
    bench.spi_chip.notes.clear()
    bench.exec("cs(0)\nspi.write_readinto(bytes([0x12] * 8), buf)\ncs(1)")
    answer = bench.eval("bytes(buf)")
    assert answer == b"\xed" * 8
    first, *bytes_seen, last = bench.spi_chip.notes
    assert (first, last) == (("select", True), ("select", False))
    assert len(bytes_seen) == 8
    for byte, hz, seen, _ in bytes_seen:
        assert (byte, seen) == (0x12, mode)
        assert 900_000 < hz <= 1_000_000


def test_spi_goes_by_its_pins(bench):
    bench.exec("cs, dc, rst = [Pin(n, Pin.OUT, value=1) for n in (17, 20, 21)]")
    bench.spi_chip.notes.clear()
    bench.exec(
        "spi = SPI(0, baudrate=8000000, sck=Pin(18), mosi=Pin(19), miso=Pin(16))\n"
        "rst(0); rst(1)\n"
        "spi.write(b'\\xaa')\n"
        "cs(0); dc(0); spi.write(b'\\x01'); dc(1); spi.write(bytes(64)); cs(1)\n"
    )
    notes = bench.spi_chip.notes
    assert notes[:2] == [("reset", 0), ("reset", 1)]
    sent = [note for note in notes if isinstance(note[0], int)]
    assert [(note[0], note[3]) for note in sent[:2]] == [(1, 0), (0, 1)]  # not the one before cs
    assert len(sent) == 65


def test_the_data_ready_line_interrupts_hard_with_every_sample(bench):
    """200 Hz out of the chip, and the interrupt reads it: the emulated time of each is the chip's own."""
    said = bench.eval(
        "(bus.writeto_mem(0x68, 0x6B, b'\\x01'), bus.writeto_mem(0x68, 0x19, b'\\x04'),"
        " bus.writeto_mem(0x68, 0x1A, b'\\x02'), bus.writeto_mem(0x68, 0x38, b'\\x01'), 0)[4]"
    )
    assert said == 0
    bench.bus.log.clear()
    bench.exec(
        "buf = bytearray(15)\n"
        "n = [0, 0]\n"
        "def ready(pin):\n"
        "    n[0] += 1\n"
        "    try:\n"
        "        n[1] = 1.5 * n[0]\n"
        "    except MemoryError:\n"
        "        bus.readfrom_mem_into(0x68, 0x3A, buf)\n"
        "pin = Pin(6, Pin.IN)\n"
        "pin.irq(ready, trigger=Pin.IRQ_RISING, hard=True)\n"
        "time.sleep_ms(252)\n"
        "pin.irq(handler=None)\n"
    )
    assert bench.eval("n[0]") in (50, 51)
    reads = [t for t in bench.bus.log if t[4] == 15]
    assert len(reads) in (50, 51)  # none: the heap was not locked in there
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(reads)]
    assert all(abs(gap - PERIOD_US) < 30 for gap in gaps)


def test_modules_compiled_for_another_machine_are_refused(bench, tmp_path):
    """The failing twin of every .mpy that the flight runs."""
    module = tmp_path / "probe.py"
    module.write_text(
        "import micropython\n@micropython.viper\ndef f(x: int) -> int:\n    return x + 1\n"
    )
    cross = emulated.mpy_cross()
    right = emulated.compile_module(module, cross)
    for data, expected in ((right, "2"), (right[:2] + bytes([right[2] ^ 0x30]) + right[3:], "no")):
        said = bench.exec(
            f"with open('probe.mpy', 'wb') as file:\n    file.write({data!r})\n"
            "import sys\nsys.modules.pop('probe', None)\n"
            "try:\n    import probe\n    print(probe.f(1))\nexcept ValueError:\n    print('no')\n"
        )
        assert said.split()[-1] == expected
    assert bench.flash()["own.txt"] == b"mine"
    assert bench.flash()["probe.mpy"] != right


def test_a_soft_reset_stops_the_hard_timer_and_keeps_the_files(bench):
    bench.exec(
        "from micropython import const\n"
        "n = [0]\n"
        "def tick(timer):\n"
        "    n[0] += 1\n"
        "    bus.readfrom_mem_into(0x42, 0x10, buf)\n"
        "timer = Timer(-1, period=5, callback=tick, hard=True)\n"
        "time.sleep_ms(52)\n"
    )
    assert bench.eval("n[0]") >= 10
    bench.soft_reset()
    bench.expect("MPY: soft reboot", 2)
    bench.expect(">>> ", 2)
    transfers = bench.bus.transfers
    bench.run(0.05)
    assert bench.bus.transfers == transfers
    assert bench.resets == 0
    assert bench.eval("'n' in globals()") is False
    assert bench.eval("open('own.txt').read()") == "mine"
    bench.exec(
        "import machine, time\n"
        "from machine import I2C, Pin\n"
        "bus = I2C(0, scl=Pin(5), sda=Pin(4), freq=400000, timeout=3000)\n"
    )
    assert bench.eval("bus.readfrom_mem(0x42, 0x10, 2)") == b"\x10\x11"


def test_a_watchdog_that_is_fed_waits_and_one_that_is_not_resets(bench):
    bench.exec(
        "dog = machine.WDT(timeout=50)\nfor _ in range(8):\n    dog.feed()\n    time.sleep_ms(20)\n"
    )
    assert bench.resets == 0
    bench.run_until(lambda: bench.resets == 1 and bench.connected, 5, "reset")
    bench.run(0.05)
    assert bench.eval("__import__('machine').reset_cause()") == 3  # WDT_RESET
    assert bench.eval("open('own.txt').read()") == "mine"


def test_machine_reset_boots_again_with_its_files(bench):
    """Last: what it had in memory is gone."""
    resets = bench.resets
    bench.send(b"\r\x03import machine; machine.reset()\r")
    bench.run_until(lambda: bench.resets > resets and bench.connected, 5, "reset")
    bench.run(0.05)
    assert bench.eval("open('own.txt').read()") == "mine"
    assert bench.eval("__import__('machine').reset_cause()") == 3  # WDT_RESET


# ---------------------------------------------------------------- cycles
def test_cycles_are_counted_between_a_programs_marks(image, tmp_path):
    source = tmp_path / "counts.py"
    source.write_text(
        "import sys\n"
        "from micropython import const\n"
        "import micropython\n"
        "@micropython.viper\n"
        "def spin(n: int):\n"
        "    while n:\n"
        "        n -= 1\n"
        "spin(1)\n"
        "n = int(sys.argv[2])\n"
        "for part, each in (('less', 100), ('more', 300)):\n"
        "    for steps in (0, n):\n"
        "        print('@begin %s %d' % (part, steps))\n"
        "        spin(steps * each)\n"
        "        print('@end %s %d' % (part, steps))\n"
    )
    files = {"counts.mpy": emulated.compile_module(source, emulated.mpy_cross())}
    of = tracing.per_step(rp2040.between_marks(image, files, "counts", "trace", 100))
    assert of.keys() == {"less", "more"}
    assert 100 * 3 < of["less"] < 100 * 30
    assert 2.8 < of["more"] / of["less"] < 3.2


def test_the_benchmark_has_a_section_of_the_board_and_says_where_it_cannot(tmp_path, monkeypatch):
    figures = bench_command.Figures(
        cycles={part: 1000.0 * (k + 1) for k, part in enumerate(bench_command.PARTS)}
    )
    file = tmp_path / "benchmarks.md"
    for _ in range(2):  # what was saved is replaced
        file.write_text(file.read_text() if file.exists() else bench_command.DOCS.read_text())
        bench_command.save(figures, file)
    text = file.read_text()
    assert text.count("On the emulated RP2040: cycles and microseconds") == 1
    assert "| sensor read | 1,000 | 8 |" in text

    def not_here():
        raise runtimes.Unavailable("no mirror")

    monkeypatch.setattr(bench_command.rp2040, "image", not_here)
    for other in ("microseconds", "allocated", "instructions", "bus_calls"):
        monkeypatch.setattr(bench_command, other, lambda *a, **k: {})
    monkeypatch.setattr(bench_command, "net", lambda *a: {"float": 1.0})
    figures = bench_command.measure()
    assert "cycles on rp2040: not measured: no mirror" in figures.not_here
    assert bench_command.board_rows(figures) == []


# ---------------------------------------------------------------- the image
def test_another_version_of_the_emulator_is_refused(monkeypatch):
    from rp2040 import version as guard

    guard.check()
    monkeypatch.setattr(guard.importlib.metadata, "version", lambda name: "0.3.7")
    with pytest.raises(ImportError, match=r"needs rp2040py 0\.3\.6, and 0\.3\.7 is installed"):
        guard.check()


def test_what_is_no_image_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "image.uf2"
    path.write_bytes(b"\x7fELF" + bytes(2000))
    monkeypatch.setenv(firmware.VARIABLE, str(path))
    with pytest.raises(runtimes.Unavailable, match="is not a UF2 image for the RP2040"):
        firmware.image()
    monkeypatch.setenv(firmware.VARIABLE, str(tmp_path / "absent"))
    with pytest.raises(runtimes.Unavailable, match="No such file"):
        firmware.image()


def test_an_image_is_taken_into_the_cache(image, version, tmp_path, monkeypatch):
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    monkeypatch.delenv(firmware.VARIABLE, raising=False)
    assert firmware.take(image) == version
    assert firmware.image().read_bytes() == image.read_bytes()
    assert tmp_path in firmware.image().parents
