"""`upright score`: every figure where it belongs, and what cannot be used is named and stops nothing else."""

import csv
import json
import math
import sys

import numpy as np
import pytest
from upright_host import baselines, console, score, scoring, trials

RATE, SECONDS, EVERY = 100, 3, 4
TURN = math.radians(-40)  # the sensor's heading: x is 40 deg east of north
TILT = math.radians(30)  # and its roll


def attitude(heading, roll):
    """Sensor -> earth with x north, y west, z up."""
    a, b = heading / 2, roll / 2
    z = np.array([math.cos(a), 0, 0, math.sin(a)])
    x = np.array([math.cos(b), math.sin(b), 0, 0])
    return scoring._multiply(z[None], x[None])[0]


def body(earth):
    """An earth vector as the still sensor sees it."""
    q = attitude(TURN, TILT)
    v = scoring._multiply(np.array([[0, *earth]], float), q[None])
    return scoring._multiply((q * [1, -1, -1, -1])[None], v)[0, 1:]


def save(path, off_deg=0.0, gyro=(0, 0, 0), rate=RATE, seconds=SECONDS, **header):
    """A still trial, tilted and turned, whose truth has its heading `off_deg` to the left of the field's."""
    n = int(rate * seconds)
    m = -(-n // EVERY)
    q = attitude(TURN + math.radians(off_deg), TILT)
    east_north = scoring._multiply(np.array([[1, 0, 0, 1]]) * math.sqrt(0.5), q[None])
    header = {
        "name": path.stem,
        "rate_hz": rate,
        "gt_every": EVERY,
        "gyr_dps_per_lsb": 1 / 16.4,
        "acc_mps2_per_lsb": 9.80665 / 2048,
        "mag_uT_per_lsb": 0.3,
    } | header
    arrays = {
        "gyr": np.tile(np.array(gyro, "i2"), (n, 1)),
        "acc": np.tile(np.rint(2048 * body((0, 0, 1))).astype("i2"), (n, 1)),
        "mag": np.tile(np.rint(body((20, 0, -40)) / 0.3).astype("i2"), (n, 1)),
        "q_gt": np.tile(east_north, (m, 1)).astype("f4"),
        "movement": np.packbits(np.arange(m) * EVERY >= rate),
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
    }
    left_out = header.get("without", ())
    np.savez(path, **{name: array for name, array in arrays.items() if name not in left_out})
    return path


@pytest.fixture
def run(upright):
    """run(*arguments) -> what `upright score ARGUMENTS --runtime cpython` said, with exit_code."""
    return lambda *arguments: upright("score", *arguments, "--runtime", "cpython")


@pytest.fixture
def folder(tmp_path):
    """Two good trials, one broken, one without truth."""
    folder = tmp_path / "trials"
    folder.mkdir()
    save(folder / "north.npz", off_deg=10)
    save(folder / "nowhere.npz", off_deg=25, sensor="a phone: score with best heading")
    save(folder / "truthless.npz", without=("q_gt", "movement"))
    (folder / "broken.npz").write_bytes((folder / "north.npz").read_bytes()[:700])
    return folder


def rows_of(path):
    with open(path) as file:
        return list(csv.DictReader(file))


def test_a_folder_becomes_tables_and_a_file_of_figures(run, folder, tmp_path):
    done = run(folder, "--filters", "mahony6,inertial9", "--csv", tmp_path / "out.csv")
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert "…" not in done.output  # nothing is cut off at 80 columns
    assert "north" in lines and "nowhere" in lines
    rows = rows_of(tmp_path / "out.csv")
    assert tuple(rows[0]) == score.COLUMNS
    trials_and_filters = [(row["trial"], row["filter"], row["heading_measure"]) for row in rows]
    assert trials_and_filters == [
        ("north", "mahony6", "best heading"),
        ("north", "inertial9", "as given"),
        ("nowhere", "mahony6", "best heading"),
        ("nowhere", "inertial9", "best heading"),
        ("mean", "mahony6", "best heading"),
        ("mean", "inertial9", "mixed"),
        ("median", "mahony6", "best heading"),
        ("median", "inertial9", "mixed"),
        ("worst", "mahony6", "best heading"),
        ("worst", "inertial9", "mixed"),
    ]
    figures = {(r["trial"], r["filter"]): r for r in rows}
    north, nowhere = figures["north", "inertial9"], figures["nowhere", "inertial9"]
    assert float(north["heading"]) == pytest.approx(10, abs=0.3)
    assert float(north["total"]) == pytest.approx(10, abs=0.3)
    assert float(north["offset"]) == pytest.approx(-10, abs=0.3)
    assert float(nowhere["heading_as_given"]) == pytest.approx(25, abs=0.3)
    for row in (north, nowhere):
        assert float(row["inclination"]) < 0.1
        assert float(row["total_best"]) < 0.2
        assert row["samples"] == "50" and row["coverage"] == "1.0000"
    assert float(nowhere["heading"]) < 0.2
    # and the same on the screen
    (line,) = [line for line in lines if line.startswith("inertial9") and "%" not in line]
    ten = float(north["heading"])
    few = float(nowhere["heading"])
    words = line.split()
    assert words[1] == "2"
    assert [float(word) for word in words[5:8]] == pytest.approx(
        [(ten + few) / 2, (ten + few) / 2, ten], abs=0.006
    )
    for statistic, of in (("mean", np.mean), ("median", np.median), ("worst", max)):
        expected = of([float(north["total"]), float(nowhere["total"])])
        found = figures[statistic, "inertial9"]
        assert float(found["total"]) == pytest.approx(expected, abs=1e-4)
        assert found["samples"] == ""


def test_what_is_left_out_is_named_with_its_reason(run, folder):
    done = run(folder, "--filters", "mahony6")
    assert "broken.npz is truncated or damaged" in done.output
    assert "truthless.npz: no truth in it" in done.output
    assert done.output.count("left out") == 2


def test_a_filter_that_refuses_a_trial_does_not_stop_the_others(run, folder, tmp_path):
    save(folder / "slow.npz", rate=50)
    done = run(folder, "--filters", "mahony6,inertial9", "--csv", tmp_path / "out.csv")
    assert done.exit_code == 0
    assert "left out: inertial9 on slow: " in done.output
    assert "not every filter was scored on every trial" in done.output
    found = [row["filter"] for row in rows_of(tmp_path / "out.csv") if row["trial"] == "slow"]
    assert found == ["mahony6"]


def test_single_files_and_the_first_seconds(run, folder, tmp_path):
    out = tmp_path / "out.csv"
    file = folder / "north.npz"
    done = run(file, file, "--filters", "mahony6", "--csv", out, "--seconds", 2)
    assert done.exit_code == 0
    first = rows_of(out)[0]
    assert first["samples"] == "25" and first["coverage"] == "0.5000"
    done = run(file, "--filters", "mahony6", "--seconds", 0.5)
    assert done.exit_code == 2
    assert "north.npz: its truth begins after 1.0 s" in done.output


def test_two_trials_of_one_name_stay_two(folder):
    notes = []
    files = [folder / "north.npz", save(folder / "again.npz", name="north")]
    names = [trial.name for _, trial in score.load(files, None, notes)]
    assert len(set(names)) == 2 and not notes


def test_through_the_chips_it_is_the_same_motion(run, folder, tmp_path):
    found = []
    for more in ([], ["--through-chips"]):
        out = tmp_path / "out.csv"
        arguments = ["--filters", "mahony9", "--seconds", 1.5, "--csv", out, *more]
        done = run(folder / "north.npz", *arguments)
        assert done.exit_code == 0, done.output
        found.append(rows_of(out)[0])
    assert found[0]["samples"] == found[1]["samples"] != "0"
    assert float(found[0]["total"]) == pytest.approx(float(found[1]["total"]), abs=0.05)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            ("--filters", "mahony7"),
            "unknown filter 'mahony7'; there are inertial6, inertial9, mahony6",
        ),
        (("--filters", ","), "no filter is named"),
        (("nothing",), "nothing: no such file"),
    ],
)
def test_a_wrong_command_says_what_is_wrong(run, folder, arguments, message):
    where = [folder] if arguments[0].startswith("-") else []
    done = run(*where, *arguments)
    assert done.exit_code == 2
    assert message in done.output


def test_a_folder_without_trials_says_so(run, tmp_path):
    done = run(tmp_path)
    assert done.exit_code == 2
    assert f"no trials (.npz) in {tmp_path}" in done.output.replace("\n", "")


def test_progress_only_grows_and_ends_with_all_rows(folder):
    told = []
    files = [folder / "north.npz", folder / "broken.npz"]
    score.run(
        files, ["mahony6", "mahony9"], "cpython", on_progress=lambda at, of: told.append((at, of))
    )
    assert told == sorted(told)
    assert told[-1] == (2 * RATE * SECONDS,) * 2


def test_a_header_can_say_that_north_is_known(tmp_path):
    def knows(**header):
        return score.knows_north(trials.load(save(tmp_path / "t.npz", **header)))

    assert knows()
    assert knows(north=True, changes="prefer best-heading score")
    assert not knows(north=False)
    assert not knows(changes="yaw uncertain: prefer best-heading score")


# -- the optional extras
def test_baselines_that_are_not_installed_are_named_in_one_line(run, folder, monkeypatch):
    monkeypatch.setattr(baselines, "installed", lambda name: False)
    done = run(folder / "north.npz", "--filters", "mahony6", "--baselines")
    assert done.exit_code == 0
    assert "left out: vqf, ahrs, imufusion: not installed; .venv/bin/pip install" in done.output
    assert done.output.count("not installed") == 1
    assert "mahony6" in done.output


def test_a_missing_package_is_no_import_error(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "vqf", None)
    with pytest.raises(baselines.Missing, match="vqf is not installed: "):
        baselines.estimate("vqf9", trials.load(folder / "north.npz"))


def test_nine_axes_need_a_magnetometer(tmp_path):
    trial = trials.load(save(tmp_path / "t.npz", without=("mag",)))
    with pytest.raises(ValueError, match="vqf9 needs a magnetometer, t has none"):
        baselines.estimate("vqf9", trial)
    with pytest.raises(ValueError, match="unknown baseline 'ekf'"):
        baselines.estimate("ekf", trial)
    assert score.measure_of(trial, "inertial9") == score.BEST


@pytest.mark.parametrize("name", baselines.BASELINES)
def test_a_baseline_sees_the_attitude_in_our_earth_frame(name, tmp_path):
    pytest.importorskip(baselines.BASELINES[name][0])
    trial = trials.load(save(tmp_path / "t.npz", gyro=(0, 0, 1), seconds=12))
    found = scoring.score_trial(baselines.estimate(name, trial), trial)
    print(name, found)
    assert found.inclination < 1
    assert found.aligned_heading < 1
    if baselines.BASELINES[name][1] == 9:
        assert found.heading < 2


def test_a_baseline_is_scored_beside_the_filters(run, folder, tmp_path):
    pytest.importorskip("vqf")
    out = tmp_path / "out.csv"
    done = run(folder / "north.npz", "--filters", "mahony6,vqf9", "--csv", out, "--seconds", 2)
    assert done.exit_code == 0, done.output
    found = rows_of(out)[1]
    assert (found["filter"], found["heading_measure"]) == ("vqf9", "as given")
    assert float(found["heading"]) == pytest.approx(10, abs=0.5)


def test_without_matplotlib_there_are_tables_and_one_clear_line(run, folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    out = tmp_path / "out.csv"
    picture = tmp_path / "out.png"
    done = run(
        folder / "north.npz", "--filters", "mahony6", "--csv", out, "--png", picture, "--seconds", 2
    )
    assert done.exit_code == 3
    assert "matplotlib is not installed: .venv/bin/pip install" in done.output
    assert rows_of(out) and not picture.exists()


def test_the_picture_has_a_bar_for_each_trial_and_filter_and_means(folder, tmp_path):
    pytest.importorskip("matplotlib")
    from PIL import Image

    made = scoring.Score(1, 2, 3, 1, 2, 0, 4, 10, 1.0)
    lost = scoring.Score(90, 90, 90, 90, 90, 0, 90, 10, 1.0)
    rows = [
        score.Row(f"trial_{i}", f"filter{j}", score.AS_GIVEN, lost if i == j == 2 else made)
        for i in range(3)
        for j in range(4)
    ]
    score.save_png(score.Report(rows), tmp_path / "out.png")
    with Image.open(tmp_path / "out.png") as picture:
        assert picture.width > 600 and picture.height > 500
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 5
    with pytest.raises(console.Wrong, match=r"out\.png cannot be written"):
        score.save_png(score.Report(rows), tmp_path / "none" / "out.png")
    with pytest.raises(console.Wrong, match=r"no picture: .*out\.txt.*not supported"):
        score.save_png(score.Report(rows), tmp_path / "out.txt")
