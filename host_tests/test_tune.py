"""`upright tune kalman`: the scan measures the filter of lib/, knows the truth, and finds a known optimum."""

import csv
import math
import sys

import numpy as np
import pytest
from pictures import line_of
from trial_files import save
from upright_host import kalman_scan, plotting, trials, tune

HZ = 100.0


def gain(ratio):
    """The settled gain of x' = x + w, z = x + v with var w / var v = ratio: from P = P R / (P + R) + Q."""
    before = (ratio + math.sqrt(ratio * ratio + 4 * ratio)) / 2  # P before the measurement, in R
    return before / (before + 1)


def walk(ratio, n=12000, noise=2.0, seed=1):
    """A random walk measured with white noise: the signal that the scalar filter is made for."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(noise * math.sqrt(ratio) * rng.standard_normal(n))
    z = np.rint(1000 * plotting.wrap(truth + noise * rng.standard_normal(n))).astype(int)
    at = np.arange(500, n)
    return kalman_scan.Signal(
        z.tolist(), HZ, at, truth[500:], slice(0, 200), "pitch", "accelerometer"
    )


@pytest.fixture
def run(upright):
    return lambda *arguments: upright("tune", "kalman", *arguments)


# -- what a pair comes to
@pytest.mark.parametrize(("Q", "R"), [(10, 0.05), (0.05, 0.05), (1e-3, 0.05), (2, 2000)])
def test_gain_settling_time_and_lag_are_those_of_the_closed_forms(Q, R):
    K, settling, lag = kalman_scan.response(Q, R, HZ)
    expected = gain(Q / R)
    assert pytest.approx(expected, rel=2e-3) == K
    assert lag * HZ == pytest.approx((1 - expected) / expected, rel=5e-3, abs=1e-4)
    # what is left of a step after k updates is (1 - K)**k
    steps = math.log(0.02) / math.log(1 - expected)
    assert settling * HZ == pytest.approx(max(0, steps - 1), abs=1.01)


def test_the_values_that_are_copied_hardly_filter_at_all():
    K, settling, _ = kalman_scan.response(*kalman_scan.USUAL, HZ)
    assert pytest.approx(0.995, abs=5e-4) == K
    assert settling == 0


def test_what_takes_minutes_has_no_settling_time():
    K, settling, lag = kalman_scan.response(1e-8, 1, HZ)
    assert pytest.approx(1e-4, rel=0.3) == K
    assert settling is lag is None


@pytest.mark.parametrize("ratio", [0.003, 0.3])
def test_the_best_ratio_of_a_random_walk_in_white_noise_is_that_of_their_variances(ratio):
    signal = walk(ratio)
    found = kalman_scan.scan(
        signal, [(Q, kalman_scan.USUAL[1]) for Q in kalman_scan.Q_GRID], jobs=1
    )
    least = kalman_scan.best(found)
    assert abs(math.log10(least.ratio / ratio)) < 0.5  # the grid has two a decade
    # the error of the optimal filter: P = K R
    assert least.rmse == pytest.approx(2.0 * math.sqrt(gain(ratio)), rel=0.1)
    assert kalman_scan.usual(found).rmse == pytest.approx(2.0, rel=0.03)


def test_noise_falls_with_the_square_root_of_k_over_2_minus_k():
    rng = np.random.default_rng(2)
    z = np.rint(1000 * rng.standard_normal(20000)).astype(int).tolist()
    signal = kalman_scan.Signal(z, HZ, None, None, slice(2000, 20000), "roll", "accelerometer")
    for ratio in (0.01, 1):
        K = gain(ratio)
        found = signal.noise(kalman_scan.filtered(z, ratio, 1))
        assert found == pytest.approx(math.sqrt(K / (2 - K)), rel=0.05)


def test_only_the_ratio_counts_and_the_advice_turns_one_knob_twice():
    pairs = [(Q, R) for Q in kalman_scan.Q_GRID[::2] for R in kalman_scan.R_GRID[::2]]
    found = kalman_scan.scan(walk(0.02, 2000), pairs, jobs=1)
    groups = kalman_scan.by_ratio(found)
    assert len(groups) == len(kalman_scan.Q_GRID[::2]) + len(kalman_scan.R_GRID[::2]) - 1
    assert max(map(len, groups.values())) == len(kalman_scan.R_GRID[::2])
    assert kalman_scan.spread(found) < 1e-3 < np.ptp([s.rmse for s in found])
    start, first, second = kalman_scan.advised(found)
    assert (min(kalman_scan.Q_GRID), max(kalman_scan.R_GRID)) == (start.Q, start.R)
    assert first.R == start.R and second.Q == first.Q
    assert (
        start.rmse
        > first.rmse
        >= second.rmse
        == pytest.approx(kalman_scan.best(found).rmse, abs=1e-3)
    )


def test_the_error_of_an_angle_that_passes_180_is_small():
    truth = np.linspace(100, 260, 2000)
    z = np.rint(1000 * plotting.wrap(truth)).astype(int).tolist()
    signal = kalman_scan.Signal(
        z, HZ, np.arange(2000), truth, slice(0, 100), "roll", "accelerometer"
    )
    found = kalman_scan.setting(signal, (0.1, 1))
    # a ramp of 0.08 deg a sample, and the lag behind it
    K = gain(0.1)
    assert found.rmse == pytest.approx(0.08 * (1 - K) / K, rel=0.05)


# -- the signal
def test_the_accelerometers_angles_are_those_of_the_truth_where_nothing_accelerates(tmp_path):
    trial = trials.load(save(tmp_path / "slow.npz", "slow", seconds=6))
    for axis in kalman_scan.AXES:
        signal = kalman_scan.signal(trial, axis)
        assert len(signal.z) == trial.n and signal.rate == HZ
        assert signal.at[0] >= HZ  # the movement phase
        assert 0 < signal.rmse(np.array(signal.z) / 1000) < 1
    assert len(kalman_scan.signal(trial, seconds=2).z) == 200


def test_a_filters_angle_can_be_filtered_too(tmp_path):
    trial = trials.load(save(tmp_path / "hand.npz", seconds=3))
    of_filter = kalman_scan.signal(trial, "roll", "mahony6", "cpython")
    alone = kalman_scan.signal(trial, "roll")
    rough = [np.std(np.diff(signal.z)) for signal in (of_filter, alone)]
    assert rough[0] < rough[1] / 3
    assert of_filter.rmse(np.array(of_filter.z) / 1000) < 3


def test_the_stillest_span_is_found(tmp_path):
    rng = np.random.default_rng(3)
    gyro = 50 * rng.standard_normal((3000, 3))
    gyro[1700:2000] = 500 + rng.standard_normal((300, 3))
    rest = kalman_scan._stillest(gyro, HZ)
    assert rest.start >= 1700 and rest.stop <= 2000 and rest.stop - rest.start == 200
    assert kalman_scan._stillest(gyro[:90], HZ) == slice(0, 90)


# -- the command
def test_the_scan_becomes_a_table_sentences_a_file_and_a_picture(run, tmp_path):
    pytest.importorskip("matplotlib")
    from PIL import Image

    file = save(tmp_path / "hand.npz", seconds=3)
    out, png = tmp_path / "out.csv", tmp_path / "out.png"
    done = run(file, "--csv", out, "--png", png, "--axis", "roll")
    assert done.exit_code == 0, done.output
    with open(out) as rows:
        rows = list(csv.DictReader(rows))
    assert tuple(rows[0]) == kalman_scan.COLUMNS
    assert len(rows) == len(kalman_scan.Q_GRID) * len(kalman_scan.R_GRID)
    for row in rows:
        assert float(row["Q"]) / float(row["R"]) == pytest.approx(float(row["ratio"]), rel=1e-4)
        assert float(row["K"]) == pytest.approx(gain(float(row["ratio"])), rel=0.05)
    least = min(rows, key=lambda row: float(row["rmse_deg"]))
    (line,) = [line for line in done.output.splitlines() if line.rstrip().endswith("best")]
    assert float(line.split()[5]) == pytest.approx(float(least["rmse_deg"]), abs=6e-4)
    assert "roll of the accelerometer alone, 300 samples at 100.0 Hz" in done.output
    assert "Q = 10, R = 0.05: K = 0.995" in done.output
    assert "the usual advice" in done.output
    with Image.open(png) as picture:
        assert picture.width > 1000
        assert len(picture.convert("RGB").getcolors(1 << 22)) > 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--axis", "yaw"), "unknown axis 'yaw'; there are roll, pitch"),
        (
            ("--source", "magic"),
            "unknown source 'magic'; there are accelerometer, inertial6, inertial9, mahony6",
        ),
        (("--seconds", 0.5), "no truth in it, or in this span"),
    ],
)
def test_a_wrong_command_says_what_is_wrong(run, tmp_path, arguments, message):
    done = run(save(tmp_path / "hand.npz", seconds=1.5), *arguments)
    assert done.exit_code == 2
    assert message in done.output


def test_without_a_truth_or_a_trial_there_is_one_clear_line(run, tmp_path):
    done = run(save(tmp_path / "t.npz", seconds=1.5, without=("q_gt", "movement")))
    assert done.exit_code == 2 and "t.npz: no truth in it" in done.output
    done = run(tmp_path / "none.npz")
    assert done.exit_code == 2 and "none.npz: no such file" in done.output


def test_without_matplotlib_there_is_a_table_and_one_clear_line(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(tune, "grid", lambda: [(10.0, 0.05), (1.0, 0.05)])
    done = run(save(tmp_path / "hand.npz", seconds=1.5), "--png", tmp_path / "out.png")
    assert done.exit_code == 3
    assert "matplotlib is not installed: .venv/bin/pip install" in done.output
    assert "best" in done.output


# -- the pictures
def test_the_scans_picture_shows_the_grid_and_four_waves(figures, monkeypatch):
    signal = walk(0.02, 1500)
    found = kalman_scan.scan(signal, kalman_scan.grid(), jobs=1)
    tune.draw_scan(signal, found, "walk", "none.png")
    heat, ratios, motion, still = [axes for axes in figures[0].axes if axes.get_title()]
    (mesh,) = [c for c in heat.collections if c.get_array() is not None]
    values = mesh.get_array().reshape(len(kalman_scan.Q_GRID), len(kalman_scan.R_GRID))
    for s in found:
        assert values[kalman_scan.Q_GRID.index(s.Q), kalman_scan.R_GRID.index(s.R)] == s.rmse
    assert len(ratios.get_lines()) == 4
    labels = [line.get_label() for line in motion.get_lines()]
    assert labels[:3] == ["not filtered", "truth", "Q = 10, R = 0.05"] and len(labels) == 6
    # the best pair, and the same ratio with other values, lie on each other
    assert line_of(motion, 3)[1] == pytest.approx(line_of(motion, 4)[1], abs=0.01)
    assert np.abs(line_of(motion, 3)[1] - line_of(motion, 2)[1]).max() > 0.5
    assert line_of(still, 0)[0][0] == signal.rest.start / HZ


def test_the_waveform_shows_what_is_filtered_and_how_k_and_p_settle(tmp_path, figures):
    trial = trials.load(save(tmp_path / "hand.npz", seconds=6))
    tune.draw_waveform(trial, "none.png")
    wide, zoom, still, K, P = figures[0].axes
    raw, usual, tuned = (line_of(wide, k)[1] for k in (0, 2, 3))
    assert wide.get_lines()[2].get_label().startswith("filtered, Q = 10, R = 0.05: RMSE ")
    # at rest most of the noise is gone, with the usual values none of it
    noise = [np.std(line_of(still, k)[1]) for k in (0, still_usual(still), still_usual(still) + 1)]
    assert noise[1] == pytest.approx(noise[0], rel=0.05) and noise[2] < noise[0]
    assert len(raw) == len(usual) == len(tuned)
    Q, R = (
        float(part.split("=")[1]) for part in K.get_lines()[1].get_label().split(":")[0].split(",")
    )
    for panel, ends in ((K, (gain(200), gain(Q / R))), (P, (0.05 * gain(200), R * gain(Q / R)))):
        assert [line_of(panel, k)[1][-1] for k in (0, 1)] == pytest.approx(ends, rel=0.02)
        assert line_of(panel, 1)[1][0] > 1.1 * line_of(panel, 1)[1][-1]
        assert panel.get_yscale() == "log"
    assert zoom.get_title() and len(zoom.get_lines()) == 4


def still_usual(panel):
    """The truth may not be known where the board lies still."""
    return len(panel.get_lines()) - 2


def test_a_trial_without_a_truth_has_a_waveform_too(tmp_path, figures):
    trial = trials.load(save(tmp_path / "t.npz", seconds=2, without=("q_gt", "movement")))
    tune.draw_waveform(trial, "none.png")
    labels = [line.get_label() for line in figures[0].axes[0].get_lines()]
    assert labels == ["not filtered", "filtered, Q = 10, R = 0.05", "filtered, Q = 5e-05, R = 0.05"]
