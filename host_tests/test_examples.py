"""The programs of docs/examples on the simulated board (that with asyncio: test_rp2040.py) give what they say."""

import contextlib
import itertools
import subprocess

import pytest
from conftest import ROOT, healthy, require
from upright import filters
from upright_host import runtimes

EXAMPLES = ROOT / "docs" / "examples"
RUNTIMES = ("cpython", "unix32")


@pytest.fixture(params=RUNTIMES)
def one_of_two(request):
    return require(request.param)


@pytest.fixture
def example(tmp_path):
    """example(runtime, file, seconds) -> the lines that the program prints on the simulated board until then."""

    def run(runtime, file, seconds):
        argv, environment = runtimes.program(runtime, EXAMPLES / file, seconds=seconds)
        done = subprocess.run(
            argv, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        return done.stdout.splitlines()

    return run


def numbers(line):
    """The numbers in a line."""
    found = []
    for word in line.replace(",", " ").split():
        with contextlib.suppress(ValueError):
            found.append(float(word))
    return found


def test_five_lines_give_degrees(one_of_two, example):
    lines = example(one_of_two, "angles.py", 3)
    readings = [
        numbers(line) for line in lines if len(line.split()) == 3 and len(numbers(line)) == 3
    ]
    assert len(readings) > 50
    for roll, pitch, yaw in readings:
        assert max(abs(roll), abs(pitch), abs(yaw)) < 1  # level and at rest


def test_the_balancing_robot_allocates_nothing_and_follows_the_pitch(boot_board, tmp_path):
    import motions

    world = tmp_path / "demo.imu"
    motions.render("hand", rate=(1000, 1), seconds=6).write(world)
    runtime = require("unix32")
    run = boot_board(
        runtime, world=str(world), seconds=6, program=str(EXAMPLES / "balance.py"), frame_ms=0
    )
    healthy(run.result)
    assert run.result["heap_checked"]
    assert (run.result["step_errors"], run.result["missed"]) == (0, 0), run.result["step_error"]
    said = [numbers(line) for line in run.lines if line.startswith("step ")]
    assert len(said) > 40
    assert [step for step, _, _ in said] == [20.0 * (k + 1) for k in range(len(said))]
    assert max(abs(pitch) for _, pitch, _ in said) > 10
    together = sum(pitch * power > 0 for _, pitch, power in said if abs(pitch) > 5)
    assert together > 0.8 * sum(abs(pitch) > 5 for _, pitch, _ in said)


@pytest.mark.parametrize("name", [name for name in filters.FILTERS if name not in filters.HARDWARE])
def test_with_every_filter_a_control_loop_allocates_nothing(boot_board, name):
    """On a port with small ints of 31 bits, turning so fast that a product beyond them would show."""
    run = boot_board(
        require("unix32"),
        seconds=5,
        program=str(EXAMPLES / "balance.py"),
        board={"FILTER": name},
        frame_ms=0,
    )
    healthy(run.result)
    assert run.result["filter"] == name
    assert run.result["step_errors"] == 0, run.result["step_error"]


def test_a_driver_in_a_loop_of_20_hz_loses_no_sample(one_of_two, example):
    lines = example(one_of_two, "own_loop.py", 4)
    said = [numbers(line) for line in lines]
    samples, up, lost = zip(*said, strict=True)
    assert set(lost) == {0.0}
    assert all(value == pytest.approx(1, abs=0.05) for value in up)
    steps = [b - a for a, b in itertools.pairwise(samples[1:])]
    assert set(steps) <= {9.0, 10.0, 11.0}  # 200 Hz in 20 Hz
    assert samples[-1] == pytest.approx(200 * 0.05 * len(samples), abs=12)


def test_two_sensors_on_one_bus_give_the_angle_of_a_joint(one_of_two, portable):
    lines = portable(one_of_two, "two_chips.py", EXAMPLES / "two_sensors.py", 6).splitlines()
    joints = [numbers(line)[0] for line in lines if line.startswith("joint")]
    assert len(joints) > 20
    assert all(angle == pytest.approx(30, abs=0.2) for angle in joints)
    for line in lines[-2:]:
        fresh, steps, faults, cuts = numbers(line)
        assert fresh == steps > 200
        assert (faults, cuts) == (0, 0), line
        assert line.endswith("running False")  # `with` stopped them at the program's end
