"""`upright compare`: its figures are score's, its costs are counted, its pictures show what they say."""

import csv
import math
import shutil
import sys

import motions
import numpy as np
import pytest
from conftest import require
from pictures import line_of
from trial_files import save
from upright_host import (
    compare,
    filter_costs,
    paths,
    plotting,
    runtimes,
    score,
    scoring,
    simulate,
    tracing,
    trials,
)
from upright_host.registry import filters as known_filters

# as a start 90 deg off comes down to 2 deg: tan(e / 2) falls with exp(-kp t)
MAHONY_SETTLES = math.log(math.tan(math.radians(45)) / math.tan(math.radians(1))) / 0.5

INJECTED = '''
from array import array
from upright.mahony import Mahony6


class Wasteful(Mahony6):
    """Six floats a step."""

    HARD = False

    def update(self, counts):
        Mahony6.update(self, counts)
        for i in range(6):
            abs(counts[i] * 0.5)


class Frozen(Mahony6):
    def update(self, counts):
        pass


class Broken(Mahony6):
    def update(self, counts):
        raise RuntimeError("it breaks")
'''


@pytest.fixture
def run(upright):
    """run(*arguments) -> what `upright compare ARGUMENTS --runtime cpython` said, with exit_code."""

    def run(*arguments, command="compare", runtime="cpython", costs=False):
        more = ["--no-costs"] if command == "compare" and not costs else []
        return upright(command, *arguments, "--runtime", runtime, *more)

    return run


@pytest.fixture
def registry(tmp_path, monkeypatch):
    """registry(name=class name) puts filters of INJECTED into the firmware's registry."""
    shutil.copytree(paths.LIB, tmp_path / "lib")
    folder = tmp_path / "lib" / "upright"
    (folder / "injected.py").write_text(INJECTED)
    monkeypatch.setattr(paths, "LIB", tmp_path / "lib")
    monkeypatch.setattr(paths, "PACKAGE", folder)
    monkeypatch.syspath_prepend(tmp_path / "lib")
    for name in [name for name in sys.modules if name.partition(".")[0] == "upright"]:
        monkeypatch.delitem(sys.modules, name)

    def add(hardware=(), **filters):
        with open(folder / "filters.py", "a") as file:
            file.write(f"\nHARDWARE += {tuple(hardware)!r}\n")
            for name, kind in filters.items():
                file.write(f"\nFILTERS[{name!r}] = ('injected', {kind!r})\n")

    return add


def rows_of(path):
    with open(path) as file:
        return list(csv.DictReader(file))


# -- the table
def test_the_figures_are_those_of_score(run, tmp_path):
    file, filters = save(tmp_path / "hand.npz"), "mahony6,mahony9,inertial9"
    done = run(file, "--filters", filters, "--csv", tmp_path / "a.csv")
    assert done.exit_code == 0, done.output
    assert (
        run(file, "--filters", filters, "--csv", tmp_path / "b.csv", command="score").exit_code == 0
    )
    found, scored = rows_of(tmp_path / "a.csv"), rows_of(tmp_path / "b.csv")
    assert tuple(found[0]) == compare.COLUMNS
    assert [row["filter"] for row in found] == filters.split(",")
    same = [name for name in compare.COLUMNS if name in score.COLUMNS]
    assert len(same) == 8
    for mine, theirs in zip(found, scored[:3], strict=True):
        assert [mine[name] for name in same] == [theirs[name] for name in same]
    # and the same on the screen
    (line,) = [line for line in done.output.splitlines() if line.startswith("mahony9")]
    words = line.split()
    assert [float(w) for w in words[1:4]] == pytest.approx(
        [float(found[1][name]) for name in ("inclination", "heading", "total")], abs=0.006
    )
    assert " ".join(words[4:6]) == found[1]["heading_measure"] == "as given"
    assert words[7:] == ["-", "-"]  # without costs
    assert "…" not in done.output


def test_every_filter_of_the_registry_is_compared_unless_some_are_asked_for(
    run, tmp_path, registry
):
    registry(["frozen"], frozen="Frozen")
    file = save(tmp_path / "hand.npz", seconds=1.5)
    done = run(file, "--csv", tmp_path / "a.csv")
    assert done.exit_code == 0, done.output
    names = [row["filter"] for row in rows_of(tmp_path / "a.csv")]
    (line,) = [line for line in done.output.splitlines() if "computed in the chip" in line]
    left_out = line.split(": ")[1].split(", ")
    assert "frozen" in left_out and "mahony6" in names
    assert sorted(names + left_out) == sorted(known_filters())


def test_nine_axes_are_left_out_without_a_magnetometer(run, tmp_path):
    file = save(tmp_path / "six.npz", seconds=1.5, without=("mag",))
    done = run(file, "--filters", "mahony6,mahony9,inertial9", "--csv", tmp_path / "a.csv")
    assert done.exit_code == 0, done.output
    assert [row["filter"] for row in rows_of(tmp_path / "a.csv")] == ["mahony6"]
    assert "left out: mahony9, inertial9: six has no magnetometer" in done.output
    assert run(file, "--filters", "mahony9").exit_code == 1


def test_without_a_truth_there_is_a_table_without_errors_and_a_picture(run, tmp_path):
    pytest.importorskip("matplotlib")
    file = save(tmp_path / "unknown.npz", seconds=1.5, without=("q_gt", "movement"))
    done = run(
        file, "--filters", "mahony6", "--csv", tmp_path / "a.csv", "--png", tmp_path / "p.png"
    )
    assert done.exit_code == 0, done.output
    assert "no truth in this trial" in done.output
    (row,) = rows_of(tmp_path / "a.csv")
    assert row["inclination"] == row["total"] == "" and row["samples"] == "0"
    assert float(row["settling_s"]) == pytest.approx(MAHONY_SETTLES, rel=0.01)
    assert (tmp_path / "p.png").stat().st_size > 10000
    assert (tmp_path / "p_kalman.png").stat().st_size > 10000


def test_a_span_before_the_truth_has_a_table_too(run, tmp_path, figures):
    file = save(tmp_path / "late.npz", unknown_s=1)
    done = run(file, "--filters", "mahony6", "--seconds", 0.5, "--png", tmp_path / "p.png")
    assert done.exit_code == 0, done.output
    assert "no truth in this span" in done.output
    assert len(figures) == 2 and len(figures[0].axes) == 3  # no errors to draw


def test_a_filter_that_fails_is_named_and_stops_no_other(run, tmp_path, registry):
    registry(broken="Broken")
    done = run(
        save(tmp_path / "hand.npz"), "--filters", "broken,mahony6", "--csv", tmp_path / "a.csv"
    )
    assert done.exit_code == 0, done.output
    assert "left out: broken on hand: " in done.output and "it breaks" in done.output
    assert [row["filter"] for row in rows_of(tmp_path / "a.csv")] == ["mahony6"]


def test_a_baseline_has_errors_but_no_costs(run, tmp_path):
    pytest.importorskip("vqf")
    done = run(save(tmp_path / "hand.npz"), "--filters", "vqf6", "--csv", tmp_path / "a.csv")
    assert done.exit_code == 0, done.output
    (row,) = rows_of(tmp_path / "a.csv")
    assert float(row["inclination"]) < 5
    assert row["settling_s"] == row["instructions"] == row["bytes"] == ""


@pytest.mark.parametrize(
    ("arguments", "runtime", "code", "message"),
    [
        (("--filters", "mahony7"), "cpython", 2, "unknown filter 'mahony7'; there are inertial6"),
        (("--filters", ","), "cpython", 2, "no filter is named"),
        (("--png", "one.png"), "cpython", 2, "one.png is one file, and there are 2 trials"),
        ((), "brainfuck", 2, "unknown runtime 'brainfuck'; there are cpython"),
    ],
)
def test_a_wrong_command_says_what_is_wrong(run, tmp_path, arguments, runtime, code, message):
    files = [save(tmp_path / f"{name}.npz", seconds=1.5) for name in "ab"]
    done = run(*files, *arguments, runtime=runtime)
    assert done.exit_code == code
    assert message in done.output


def test_a_missing_trial_is_named(run, tmp_path):
    done = run(tmp_path / "none.npz")
    assert done.exit_code == 2
    assert "none.npz: no such file" in done.output and "no trial to compare on" in done.output


def test_on_the_emulated_board_samples_go_through_the_chip_and_are_few(run, tmp_path, monkeypatch):
    asked = []

    def replayed(trial, name, runtime, seconds, gains, direct, on_progress):
        asked.append((name, runtime, seconds, direct))
        raise ValueError("not today")

    monkeypatch.setattr(compare.replay, "replay", replayed)
    monkeypatch.setattr(runtimes, "interpreter", lambda name: ([], "1.25"))
    done = run(save(tmp_path / "hand.npz"), "--filters", "mahony6", runtime="rp2040")
    assert asked == [("mahony6", "rp2040", compare.replay.BOARD_SECONDS, False)]
    assert done.exit_code == 1 and "not today" in done.output


# -- settling time and costs
def test_the_settling_time_of_a_known_filter_is_that_of_its_closed_form(runtime):
    found = filter_costs.settling("mahony6", (200, 1), (82, 5), 4096, runtime)
    assert found == pytest.approx(MAHONY_SETTLES, rel=0.003)
    slower = filter_costs.settling("mahony6", (2000, 17), (131, 1), 16384, runtime)
    assert slower == pytest.approx(MAHONY_SETTLES, rel=0.01)


def test_a_filter_that_never_finds_up_has_no_settling_time(registry):
    registry(frozen="Frozen", broken="Broken")
    arguments = ((200, 1), (82, 5), 4096, simulate.best_runtime())
    assert filter_costs.settling("frozen", *arguments) is None
    with pytest.raises(tracing.TraceError, match="it breaks"):
        filter_costs.settling("broken", *arguments)


def test_bytes_are_counted_and_the_ticks_filters_take_none(micropython_runtime, registry):
    registry(wasteful="Wasteful", frozen="Frozen")
    taken = {
        name: filter_costs.bytes_of(name, micropython_runtime)
        for name in ("mahony6", "wasteful", "frozen")
    }
    if taken["mahony6"] is None:
        pytest.skip(f"runtime {micropython_runtime}: it does not tell what is allocated")
    assert taken["mahony6"] == taken["frozen"] == 0
    assert 6 * 8 <= taken["wasteful"] < 1000  # a float's block at least


@pytest.fixture
def memory(tmp_path, monkeypatch):
    monkeypatch.setattr(filter_costs, "_memory", lambda: tmp_path / "costs.json")


@pytest.mark.slow
def test_instructions_are_an_updates_own(memory, registry):
    require("arm")
    require("unix32")
    registry(wasteful="Wasteful")  # Mahony6 and more
    with filter_costs.Meter() as meter:
        assert not meter.notes
        cost = meter.cost("wasteful")
    print(cost)
    assert 6000 < cost.instructions < 30000
    assert cost.bytes == filter_costs.bytes_of("wasteful", filter_costs._BYTES_ON[0]) >= 6 * 8


def test_costs_are_measured_once_until_a_source_changes(memory, registry, monkeypatch):
    require("unix")
    measured = []
    monkeypatch.setattr(tracing, "compile_for", lambda *of: None)
    monkeypatch.setattr(filter_costs, "_instructions", lambda name, _: measured.append(name) or 7.0)
    monkeypatch.setattr(filter_costs, "bytes_of", lambda *of: 0.0)
    monkeypatch.setattr(runtimes, "interpreter", lambda name: ([name], "1.25"))
    notes = []
    for _ in range(2):
        costs = compare.measure_costs(["mahony6", "vqf6", "mahony9"], notes)
        assert costs == dict.fromkeys(["mahony6", "mahony9"], filter_costs.Cost(7, 0))
    assert sorted(measured) == ["mahony6", "mahony9"] and not notes
    registry(frozen="Frozen")
    compare.measure_costs(["mahony6"], notes)
    assert len(measured) == 3


def test_what_cannot_be_measured_here_is_a_dash_and_a_line(memory, run, tmp_path, monkeypatch):
    file = save(tmp_path / "hand.npz", seconds=1.5)
    monkeypatch.setattr(runtimes, "_find", _unavailable)
    monkeypatch.setattr(runtimes, "_ready", {})
    done = run(file, "--filters", "mahony6", "--csv", tmp_path / "a.csv", costs=True)
    assert done.exit_code == 0, done.output
    assert "no instructions: runtime arm: not on this machine" in done.output
    assert "no bytes from runtime unix: not on this machine" in done.output
    (row,) = rows_of(tmp_path / "a.csv")
    assert row["instructions"] == row["bytes"] == ""
    assert float(row["settling_s"]) > 5


def _unavailable(name):
    raise runtimes.Unavailable("not on this machine")


# -- the pictures
def row(trial, name, q, measure=score.BEST):
    return score.Row(trial.name, name, measure, scoring.score_trial(q, trial), q, int(name[-1]))


def test_the_picture_shows_truth_estimates_and_their_errors(tmp_path, figures):
    trial = trials.load(save(tmp_path / "hand.npz", seconds=6))
    t = np.arange(trial.n) * trial.rate[1] / trial.rate[0]
    truth = scoring._at(t, trial.t_gt, trial.q_true())
    turned = scoring._multiply(motions.quaternion_zyx(25, 0, 0)[None], truth)
    leaning = scoring._multiply(motions.exponential(np.radians([0, 10, 0]))[None], truth)
    rows = [
        row(trial, "turned6", turned),
        row(trial, "turned9", turned, score.AS_GIVEN),
        row(trial, "leaning6", leaning),
    ]
    plotting.attitudes(trial, rows, "none.png")
    (figure,) = figures
    roll, _, yaw, inclination, heading = figure.axes
    assert len(roll.get_lines()) == 4  # the truth first
    assert len(inclination.get_lines()) == len(heading.get_lines()) == 3
    shown_t, shown = line_of(roll, 0)
    angles = plotting.euler(trial.q_true())[:, 0]
    off = plotting.wrap(shown - angles[np.searchsorted(trial.t_gt, shown_t)])
    assert np.abs(off).max() < 0.01
    # six axes after the best heading, nine as given
    for k, turn in ((1, 0), (2, 25)):
        off = plotting.wrap(line_of(yaw, k)[1] - line_of(yaw, 0)[1])
        assert np.mean(np.abs(off - turn) < 0.2) > 0.9  # but beside a gap
    assert line_of(heading, 1)[1] == pytest.approx(25, abs=0.2)
    assert line_of(inclination, 2)[1] == pytest.approx(10, abs=0.2)
    assert line_of(inclination, 1)[1].max() < 0.3
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0] == "truth" and labels[3].startswith("leaning6: 10.0")


def test_angles_stay_within_180_and_break_where_they_jump(tmp_path, figures):
    trial = trials.load(save(tmp_path / "spin.npz", "spin", seconds=3))
    t = np.arange(trial.n) * trial.rate[1] / trial.rate[0]
    truth = scoring._at(t, trial.t_gt, trial.q_true())
    plotting.attitudes(trial, [row(trial, "true9", truth, score.AS_GIVEN)], "none.png")
    yaw = figures[0].axes[2]
    for k in (0, 1):
        angle = line_of(yaw, k)[1]
        assert np.nanmax(np.abs(angle)) <= 180
        assert 2 <= (np.abs(np.diff(angle)) > 120).sum() <= 6  # three turns
        assert np.abs(plotting.wrap(np.diff(angle))).max() < 40
    assert np.isnan(plotting._broken([10, 170, -170, -160])[2])


def test_euler_angles_are_roll_pitch_yaw():
    for yaw, pitch, roll in ((10, 20, 30), (-170, -80, 100), (0, 0, -179)):
        q = motions.quaternion_zyx(yaw, pitch, roll)
        assert plotting.euler(q[None])[0] == pytest.approx([roll, pitch, yaw])


def test_pictures_are_written_and_are_those_of_their_trial(run, tmp_path):
    pytest.importorskip("matplotlib")
    from PIL import Image

    files = [
        save(tmp_path / "a.npz", "hand", seconds=2),
        save(tmp_path / "b.npz", "slow", seconds=2, name="dir/b c"),
    ]
    done = run(*files, "--filters", "mahony6,mahony9", "--png", tmp_path / "out")
    assert done.exit_code == 0, done.output
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["a.png", "a_kalman.png", "dir_b_c.png", "dir_b_c_kalman.png"]
    seen = set()
    for name in names:
        with Image.open(tmp_path / "out" / name) as picture:
            assert picture.width > 1000 and picture.height > 700
            pixels = picture.convert("RGB")
            assert len(pixels.getcolors(1 << 22)) > 20
            seen.add(pixels.tobytes())
    assert len(seen) == 4


def test_without_matplotlib_there_are_tables_and_one_clear_line(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    files = [save(tmp_path / f"{name}.npz", seconds=1.5) for name in "ab"]
    out = tmp_path / "a.csv"
    done = run(*files, "--filters", "mahony6", "--csv", out, "--png", tmp_path / "out")
    assert done.exit_code == 3
    assert done.output.count("matplotlib is not installed: .venv/bin/pip install") == 1
    assert len(rows_of(out)) == 2
