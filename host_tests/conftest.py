"""What every test shares: the board's search path under CPython, a fresh simulated machine, and the runtimes."""

import os
import resource
import signal
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import hypothesis

ROOT = Path(__file__).resolve().parents[1]
for folder in (
    *("boards/sim", "firmware", "lib", "host_tests"),
    *("tools/simulator", "tools/simulator/shim"),
):
    sys.path.insert(0, str(ROOT / folder))

import histories  # noqa: E402
import micropython  # noqa: E402, F401  (the shim: it prepares `time` before anything of lib/ is imported)
import motions  # noqa: E402
import pytest  # noqa: E402
from upright_host import oled, plotting, qemu, rp2040, runtimes, scoring, simulate, trials  # noqa: E402

PORTABLE = Path(__file__).parent / "portable"

# No test is a matter of time. The same examples every time, so that a red run means that something changed;
# EXPLORE=1 looks for new ones.
hypothesis.settings.register_profile(
    "upright", deadline=None, derandomize=not os.environ.get("EXPLORE")
)
hypothesis.settings.load_profile("upright")


# What an ordinary user of Debian may have open: who forgets to close fails here as well.
OPEN_FILES = 1024

# The recorded trials that tests hold to figures; others in the folder change nothing.
TRIALS = (
    "broad_02_undisturbed_slow_rotation_B",
    "broad_07_undisturbed_fast_rotation_B",
    "broad_15_undisturbed_fast_translation_A",
    "broad_24_disturbed_tapping_A",
    "broad_28_disturbed_stationary_magnet_A",
    "broad_34_disturbed_attached_magnet_3cm",
    "mpu6050_static_655s",
    "tyrex_nexus5_Thibaud_NoDist_Texting",
)


def recorded_trials(beginning=""):
    """Those of TRIALS that are there, as paths; of these, whose name begins so."""
    return [
        path
        for path in trials.trial_files()
        if path.stem in TRIALS and path.stem.startswith(beginning)
    ]


def pytest_addoption(parser):
    parser.addoption(
        "--runtimes", help="only these, as in cpython,unix32; tests of the others skip"
    )
    parser.addoption(
        "--build-board",
        action="store_true",
        help="build the emulated boards' firmware, where there is none yet, beside the tests that do without it",
    )
    parser.addoption(
        "--soak", action="store_true", help="run tests marked soak at their full length"
    )


def pytest_configure(config):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft > OPEN_FILES or soft == resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES, hard))
    chosen = config.getoption("--runtimes")
    if chosen:
        unknown = set(chosen.split(",")) - set(runtimes.LISTED)
        if unknown:
            raise pytest.UsageError(f"--runtimes: unknown {', '.join(sorted(unknown))}")
        for name in set(runtimes.LISTED) - set(chosen.split(",")):
            runtimes.leave_out(name, "left out by --runtimes")
    if not hasattr(config, "workerinput"):  # once, and the workers get the option as it is then
        config.option.build_board = config.option.build_board and missing_boards()
        if config.option.build_board:
            config.pluginmanager.register(BoardBuild(config.option.build_board))
    for name in qemu.RECIPES:  # without the option nobody waits minutes for one test
        if not qemu.at_hand(name) and not config.option.build_board:
            runtimes.leave_out(name, f"not built yet: `upright runtimes {name}`, or --build-board")


def missing_boards():
    """The emulated boards whose firmware would have to be built."""
    missing = [name for name in qemu.RECIPES if not qemu.at_hand(name)]
    return missing if rp2040.at_hand() else ["rp2040", *missing]


class BoardBuild:
    """The emulated boards' firmware in the making; the fixtures `image` and `runtime` wait for it."""

    def __init__(self, names):
        command = [Path(sys.executable).with_name("upright"), "runtimes", *names]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def pytest_report_header(self):
        return (
            "the emulated boards' firmware is built meanwhile; its tests come last and wait for it"
        )

    def pytest_terminal_summary(self, terminalreporter):
        if self._process.poll() is None:  # none of its tests was among these
            self._process.send_signal(signal.SIGINT)
        terminalreporter.section("the emulated boards' firmware")
        said = self._process.communicate()[0].splitlines()[-6:] or [
            "given up: nothing waits for it"
        ]
        terminalreporter.write("\n".join(said) + "\n")


def pytest_generate_tests(metafunc):
    """`recorded`: each of TRIALS in turn, as a path; one that is not there is one skip, in one clear line."""
    if "recorded" in metafunc.fixturenames:
        there = {path.stem: path for path in recorded_trials()}
        if there:
            why, names = "this recorded trial is not in the folder", TRIALS
        else:
            why, names = trials.NO_DATA, ("none",)
        absent = pytest.mark.skip(reason=why)
        params = [
            pytest.param(there.get(name), id=name, marks=() if name in there else absent)
            for name in names
        ]
        metafunc.parametrize("recorded", params)


def pytest_collection_modifyitems(config, items):
    """The emulated boards' first, since they take the longest; last while their firmware is still being built.

    What runs whole recorded trials is slow.
    """
    last = bool(config.option.build_board)
    items.sort(key=lambda item: on_a_board(item) == last)
    for item in items:
        if "recorded" in item.fixturenames:
            item.add_marker(pytest.mark.slow)
        if last and on_a_board(item):
            item.add_marker(pytest.mark.timeout(1800))


def on_a_board(item):
    """Does a test need an emulated board's firmware?"""
    values = item.callspec.params.values() if hasattr(item, "callspec") else ()
    return "test_rp2040" in item.nodeid or any(
        value in qemu.RECIPES for value in values if isinstance(value, str)
    )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each file of the emulated board's tests to one worker, for they share boards; every other test by itself.

    (xdist 3.8's groups do nothing with pytest 9.2, which keeps a test's id elsewhere.)
    """
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            path = nodeid.partition("::")[0]
            return path if "test_rp2040" in path else nodeid

    return Scheduling(config, log)


@pytest.fixture(scope="session")
def image():
    """The emulated board's firmware; built first where it is not there yet, which takes minutes."""
    require("rp2040")
    return rp2040.image()


@pytest.fixture(scope="session")
def version(image):
    """Of the MicroPython in `image`."""
    return rp2040.version(image)


@pytest.fixture(scope="session")
def soaking(request):
    """Is this `make soak`, which has hours? For tests marked soak."""
    return request.config.getoption("--soak")


@pytest.fixture(autouse=True)
def fresh_machine():
    """Every test starts with a board that has just been powered, and nothing wired to it."""
    import machine

    machine.power_on()
    yield
    machine.power_on()


def require(name: str) -> str:
    """Skip, in one clear line, where a runtime cannot be had on this machine."""
    try:
        runtimes.interpreter(name)
    except runtimes.Unavailable as why:
        pytest.skip(f"runtime {name}: {why}")
    return name


def some_micropython() -> str:
    """The quickest MicroPython that is at hand."""
    name = simulate.best_runtime()
    return require("unix") if name == "cpython" else name


@pytest.fixture(params=runtimes.NAMES)
def runtime(request):
    """Each runtime in turn."""
    return require(request.param)


@pytest.fixture(params=[name for name in runtimes.NAMES if name != "cpython"])
def micropython_runtime(request):
    """Each MicroPython in turn: those that can refuse to allocate."""
    return require(request.param)


@pytest.fixture(params=[name for name in runtimes.NAMES if name != "m3"])
def firmware_runtime(request):
    """Each runtime in turn for a whole flight of the firmware, but one emulated board only: there it takes long."""
    return require(request.param)


@pytest.fixture(params=[name for name in runtimes.NAMES if name not in qemu.RECIPES])
def quick_runtime(request):
    """Each runtime in turn but the emulated boards, for many flights of the firmware."""
    return require(request.param)


@pytest.fixture
def upright():
    """upright(*arguments) -> the result of the command line, with exit_code, output, stdout and stderr."""
    from typer.testing import CliRunner
    from upright_host import cli

    def run(*arguments):
        return CliRunner().invoke(cli.app, [str(a) for a in arguments])

    return run


@pytest.fixture
def figures(monkeypatch):
    """The figures that were drawn, instead of files."""
    pytest.importorskip("matplotlib")
    drawn = []
    monkeypatch.setattr(plotting, "save", lambda figure, path: drawn.append(figure))
    return drawn


@pytest.fixture
def portable():
    """run(runtime, script, *args) -> what a script of host_tests/portable printed; its failure fails the test."""

    def run(name, script, *args, timeout=300):
        done = runtimes.run(name, PORTABLE / script, args, timeout=timeout)
        assert done.returncode == 0, f"{script} on {name}:\n{done.stdout}\n{done.stderr}"
        return done.stdout

    return run


@pytest.fixture
def filter_history(portable, tmp_path):
    """filter_history(runtime, rendered, name, **options) -> histories.History; options: portable/filter_history.py."""

    def run(runtime, rendered, name, **options):
        return histories.run(portable, tmp_path, runtime, rendered, name, **options)

    return run


class Boot(namedtuple("Boot", "result lines picture rows q29 times flags")):
    """Of a run of the firmware on a simulated board: see boot_board."""

    def score(self, motion, since_us=0, slack=0.0):
        """The steps after since_us against the motion's truth."""
        once = scoring.once(self.rows) & (self.times >= since_us)
        num, den = motion.rate
        t, q = self.rows[once] * den / num, self.q29[once] / scoring.ONE
        return scoring.score(t, q, motion.t, motion.q_true, None, slack)


@pytest.fixture(scope="session")
def demo_world(tmp_path_factory):
    """(its file, the motion): 12 s of the demo's at 1 kHz, with a typical sensor's errors."""
    path = tmp_path_factory.mktemp("world") / "demo.imu"
    motion = motions.render("demo", rate=(1000, 1), seconds=12)
    motion.write(path, truth=True)
    return path, motion


@pytest.fixture
def boot_board(tmp_path):
    """boot_board(runtime=None, flash=None, **config) -> Boot: the firmware run on a simulated board, to its end.

    config: that of tools/simulator/run_firmware.py. lines: the console; picture: the display's last, as rows;
    for each step the world's row, the attitude (Q29), its time in us, and its sample's flags.
    """

    def run(runtime=None, flash=None, **config):
        lines, frames = [], []

        def event(kind, fields):
            if kind == "console":
                lines.append(fields[0])
            elif kind == "frame":
                frames.append(bytes.fromhex(fields[1]))

        out = tmp_path / "steps"
        config = {"seconds": 4, "frame_ms": 100, "out": str(out)} | config
        result = simulate.run(
            runtime or simulate.best_runtime(), simulate.FIRMWARE, config, event, flash
        )
        picture = oled.rows_of_frame(frames[-1]) if frames else None
        return Boot(result, lines, picture, *simulate.read_steps(out), *simulate.read_flags(out))

    return run


def healthy(result):
    """Nothing went wrong that should not have."""
    assert result["started"]
    assert result["error"] is None
    assert (result["crashes"], result["uncaught"], result["cuts"]) == (0, 0, 0)
    assert result["display_misuse"] == []
