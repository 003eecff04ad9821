"""Driver, tick and filter together give the same bits on every runtime, over every synthetic motion."""

import motions
import numpy as np
import pytest
from upright_host import replay, scoring, simulate, trials

RATES = {
    "static": 50,
    "slow": 100,
    "spin": 200,
    "bursts": 500,
    "coning": 1000,
    "hand": 200,
    "demo": 200,
}
SAMPLES = 600
GAINS = {"default": {"kp": 0.5, "ki": 0.0}, "integral": {"kp": 1.0, "ki": 0.05}}
CASES = [(name, "default") for name in motions.MOTIONS] + [
    ("hand", "integral"),
    ("bursts", "integral"),
]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """{motion: (.imu file, motion)}: SAMPLES rows each, every row one chip sample."""
    folder = tmp_path_factory.mktemp("identity")
    worlds = {}
    for name in motions.MOTIONS:
        rate = RATES[name]
        # with the errors of a real sensor, and from the middle of the motion too
        motion = motions.render(name, rate=(rate, 1), seconds=SAMPLES / rate, seed=7)
        path = folder / f"{name}.imu"
        motion.write(path, clocked=True)
        worlds[name] = (path, motion)
    return worlds


@pytest.fixture(scope="module")
def reference(rendered, tmp_path_factory):
    """CPython's own run of a case, which every MicroPython is held against, in whatever process it is tested."""
    runs = {}

    def run(name, gains):
        if (name, gains) not in runs:
            folder = tmp_path_factory.mktemp("reference")
            runs[name, gains] = history("cpython", rendered[name][0], GAINS[gains], folder)
        return runs[name, gains]

    return run


def history(runtime, world, gains, tmp_path, direct=False):
    out = tmp_path / "attitudes"
    config = {"world": str(world), "gains": gains, "out": str(out), "direct": direct}
    result = simulate.run(runtime, simulate.REPLAY, config)
    q29 = simulate.read_attitudes(out)
    assert len(q29) == SAMPLES
    if not direct:
        assert result["fresh"] == SAMPLES
        assert result["error"] is None
        assert (result["missed"], result["crashes"], result["errors"], result["cuts"]) == (0,) * 4
    return q29


def test_every_motion_is_covered():
    assert set(RATES) == set(motions.MOTIONS)


@pytest.mark.parametrize("name, gains", CASES)
def test_the_same_bits_through_registers_driver_tick_and_filter(
    micropython_runtime, name, gains, rendered, tmp_path, reference
):
    path, _ = rendered[name]
    q29 = history(micropython_runtime, path, GAINS[gains], tmp_path)
    assert len(np.unique(q29, axis=0)) > SAMPLES // 2  # it did something
    assert (q29 == reference(name, gains)).all()


def test_direct_gives_the_bits_that_the_chip_gives(rendered, tmp_path):
    path, _ = rendered["hand"]
    runtime = simulate.best_runtime()
    through = history(runtime, path, {}, tmp_path)
    straight = history(runtime, path, {}, tmp_path, direct=True)
    assert (through == straight).all()


def test_other_gains_give_other_bits(rendered, tmp_path):
    path, _ = rendered["hand"]
    runtime = simulate.best_runtime()
    one = history(runtime, path, {"kp": 0.5}, tmp_path, direct=True)
    other = history(runtime, path, {"kp": 0.6}, tmp_path, direct=True)
    assert (one != other).any()


def test_recorded_trials_replay_the_same_through_the_chip_and_past_it(recorded):
    trial = trials.load(recorded)
    runtime = simulate.best_runtime()
    through = replay.replay(trial, "mahony6", runtime=runtime, seconds=20)
    straight = replay.replay(trial, "mahony6", runtime=runtime, seconds=20, direct=True)
    assert (through.q29 == straight.q29).all()


def test_recorded_trials_are_followed_as_well_as_this_filter_can(recorded):
    """Loose bounds: a filter that is broken is tens of degrees off; how good it is stands in the docs."""
    trial = trials.load(recorded)
    if not trial.has_truth:
        pytest.skip(f"{trial.name} has no truth")
    done = replay.replay(trial, "mahony6", runtime=simulate.best_runtime(), direct=True)
    assert done.score.coverage > 0.99
    # From raw gyro: the phone and the static MPU6050 have biases of several deg/s, which tilt this filter by bias / kp.
    assert done.score.inclination < (6 if trial.name.startswith("broad") else 20)


def test_rows_of_the_csv_are_the_same_bytes_again(tmp_path):
    q29 = np.array([[1 << 29, 0, 0, 0], [1, -2, 3, -(1 << 29)]])
    scoring.write_csv(tmp_path / "a.csv", q29, (2000, 7))
    scoring.write_csv(tmp_path / "b.csv", q29, (2000, 7))
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    t, q = scoring.read_csv(tmp_path / "a.csv")
    assert (np.rint(q * scoring.ONE) == q29).all()
    assert t[1] == pytest.approx(0.0035)
