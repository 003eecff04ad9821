"""The commands that people type: what they show, what they write, and what they say when it cannot be done."""

import re

import motions
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner
from upright_host import cli, replay, scoring, simulate


@pytest.fixture
def upright():
    """upright(*arguments) -> the result, with exit_code and output."""

    def run(*arguments):
        return CliRunner().invoke(cli.app, [str(a) for a in arguments])

    return run


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """A small .npz of a synthetic motion in the form of a recorded trial."""
    import json

    motion = motions.render("hand", rate=(200, 1), seconds=8, rest_seconds=2)
    w, x, y, z = motion.q_true[::4].T
    s = np.sqrt(0.5)  # x north, y west -> x east, y north: a quarter turn about up
    enu = np.stack([s * w - s * z, s * x - s * y, s * y + s * x, s * z + s * w], 1)
    header = {
        "name": "synthetic",
        "rate_hz": 200.0,
        "gt_every": 4,
        "gyr_dps_per_lsb": 5 / 82,
        "acc_mps2_per_lsb": 9.80665 / 4096,
        "mag_uT_per_lsb": 0.3,
    }
    path = tmp_path_factory.mktemp("trial") / "synthetic.npz"
    np.savez_compressed(
        path,
        acc=motion.counts[:, :3],
        gyr=motion.counts[:, 3:6],
        mag=motion.counts[:, 6:9],
        q_gt=enu.astype("f4"),
        movement=np.packbits(np.ones(len(enu), bool)),
        header=np.frombuffer(json.dumps(header).encode(), "u1"),
    )
    return path


def test_demo_shows_the_display_the_error_and_the_ticks(upright, tmp_path):
    png, gif = tmp_path / "a.png", tmp_path / "a.gif"
    done = upright("demo", "--headless", "--seconds", 4, "--png", png, "--gif", gif)
    assert done.exit_code == 0, done.output
    assert re.search(r"inclination 0\.\d+ deg", done.output)
    assert re.search(r"ticks \d{3} ", done.output)
    assert "missed 0" in done.output
    assert "allocated in the tick: " in done.output
    assert len(set(done.output) & {chr(c) for c in range(0x2801, 0x2900)}) > 10  # the picture
    picture = Image.open(png)
    assert len(picture.convert("L").getcolors()) > 2
    assert Image.open(gif).n_frames > 5


def test_demo_on_cpython_alone_says_that_it_cannot_see_allocations(upright):
    done = upright("demo", "--headless", "--seconds", 3, "--runtime", "cpython")
    assert done.exit_code == 0, done.output
    assert "not measured" in done.output


def test_demo_plays_a_trial_through_the_chip(upright, trial):
    done = upright("demo", "--headless", "--trial", trial)
    assert done.exit_code == 0, done.output
    assert "data-ready" in done.output
    assert re.search(r"inclination \d\.\d+ deg", done.output)


@pytest.mark.parametrize("command", [("demo", "--headless", "--trial"), ("replay",)])
def test_what_is_no_trial_is_named_with_what_is_wrong(upright, tmp_path, trial, command):
    absent = upright(*command, tmp_path / "absent.npz")
    assert absent.exit_code == 2
    assert "absent.npz" in absent.output.replace("\n", "")
    cut = tmp_path / "cut.npz"
    cut.write_bytes(trial.read_bytes()[:2000])
    done = upright(*command, cut)
    assert done.exit_code == 2
    assert "cut.npz" in done.output.replace("\n", "")
    assert "Traceback" not in done.output
    text = tmp_path / "text.npz"
    text.write_text("not a trial")
    assert upright(*command, text).exit_code == 2


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("--motion", "waltz"), "unknown motion"),
        (("--seconds", "-1"), "positive"),
        (("--runtime", "z80"), "unknown runtime"),
        (("--speed", "-2"), "speed"),
    ],
)
def test_demo_refuses_what_it_cannot_do(upright, arguments, said):
    done = upright("demo", "--headless", *arguments)
    assert done.exit_code in (2, 3)
    assert said in done.output
    assert "Traceback" not in done.output


def test_replay_writes_the_same_bytes_on_every_runtime_and_scores(
    upright, runtime, trial, tmp_path
):
    out, ours = tmp_path / "out.csv", tmp_path / "ours.csv"
    done = upright("replay", trial, "--runtime", runtime, "--out", out, "--seconds", 3)
    assert done.exit_code == 0, done.output
    t, _ = scoring.read_csv(out)
    assert len(t) == 600
    assert t[-1] == pytest.approx(599 / 200)
    assert "inclination" in done.output
    assert "best heading" in done.output
    upright("replay", trial, "--runtime", "cpython", "--out", ours, "--seconds", 3, "--direct")
    assert out.read_bytes() == ours.read_bytes()


def test_replay_is_right(upright, trial):
    done = upright("replay", trial, "--direct")
    inclination = float(re.search(r"inclination +([\d.]+)", done.output)[1])
    assert inclination < 3  # the gyro's bias of 1.5 deg/s tilts it by bias / kp


def test_replay_takes_the_gains(upright, trial, tmp_path):
    files = []
    for kp in (0.5, 2):
        files.append(tmp_path / f"{kp}.csv")
        assert upright("replay", trial, "--direct", "--kp", kp, "--out", files[-1]).exit_code == 0
    assert files[0].read_bytes() != files[1].read_bytes()


@pytest.mark.parametrize(
    "name, said",
    [("nope", "unknown filter 'nope'; there are dmp6, euler6"), ("dmp6", "computed in the sensor")],
)
def test_replay_refuses_a_filter_that_it_cannot_feed_in_one_line(upright, trial, name, said):
    done = upright("replay", trial, "--filter", name)
    assert done.exit_code == 1
    assert said in " ".join(done.output.split())
    assert "Traceback" not in done.output and "File" not in done.output


def test_replay_refuses_what_the_filter_refuses(upright, trial):
    done = upright("replay", trial, "--direct", "--kp", 1e6)
    assert done.exit_code == 1
    assert "kp" in done.output


def test_a_simulation_that_dies_is_told_with_its_last_words(tmp_path):
    script = tmp_path / "dies.py"
    script.write_text("print('so far')\nraise ValueError('no further')\n")
    with pytest.raises(simulate.SimulationError, match=r"(?s)so far.*no further"):
        simulate.run("cpython", script, {})


def test_the_demo_compares_filters_on_the_same_motion(upright):
    done = upright("demo", "--filters", "mahony6,inertial6", "--headless", "--seconds", 4)
    assert done.exit_code == 0, done.output
    table = done.output[done.output.index("RMSE, degrees") :]
    names = [line.split()[0] for line in table.splitlines()[2:4]]
    assert names == ["mahony6", "inertial6"]


def test_the_demo_takes_the_board_that_a_filter_needs_and_refuses_an_unknown_one(upright):
    done = upright("demo", "--board", "abacus")
    assert done.exit_code == 2
    assert "robomaster_a" in done.output
    assert replay.board_for("inertial9-lite") == "robomaster_a"
    assert replay.board_for("inertial6") == "sim"
