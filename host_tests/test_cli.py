"""The commands that people type: what they show, what they write, and what they say when it cannot be done."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from PIL import Image
from trial_files import save
from upright_host import console, replay, runtimes, scoring, simulate

UPRIGHT = Path(sys.executable).with_name("upright")


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return save(tmp_path_factory.mktemp("trial") / "synthetic.npz", rate=200, seconds=8)


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


@pytest.mark.parametrize("rate", [200, 300])  # one that the chip has, and one that it has not
def test_demo_plays_a_trial_through_the_chip(upright, tmp_path, rate):
    trial = save(tmp_path / "synthetic.npz", rate=rate, seconds=5)
    done = upright("demo", "--headless", "--trial", trial)
    assert done.exit_code == 0, done.output
    assert "data-ready" in done.output
    assert re.search(r"inclination \d\.\d+ deg", done.output)


def test_demo_refuses_a_negative_speed(upright):
    done = upright("demo", "--headless", "--speed", "-2")
    assert done.exit_code == 2
    assert "speed" in done.output


def test_replay_writes_the_same_bytes_on_every_runtime_and_scores(
    upright, runtime, trial, tmp_path
):
    out, ours = tmp_path / "out.csv", tmp_path / "ours.csv"
    mahony = ("replay", trial, "--filter", "mahony6", "--seconds", 3)
    done = upright(*mahony, "--runtime", runtime, "--out", out)
    assert done.exit_code == 0, done.output
    t, _ = scoring.read_csv(out)
    assert len(t) == 600
    assert t[-1] == pytest.approx(599 / 200)
    assert "inclination" in done.output
    assert "best heading" in done.output
    upright(*mahony, "--runtime", "cpython", "--out", ours, "--direct")
    assert out.read_bytes() == ours.read_bytes()


def test_replay_is_right(upright, trial):
    done = upright("replay", trial, "--direct")
    inclination = float(re.search(r"inclination +([\d.]+)", done.output)[1])
    assert inclination < 3  # the gyro's bias of 1.5 deg/s tilts it by bias / kp


def test_replay_takes_the_gains(upright, trial, tmp_path):
    files = []
    for kp in (0.5, 2):
        files.append(tmp_path / f"{kp}.csv")
        mahony = ("replay", trial, "--filter", "mahony6", "--direct")
        assert upright(*mahony, "--kp", kp, "--out", files[-1]).exit_code == 0
    assert files[0].read_bytes() != files[1].read_bytes()


@pytest.mark.parametrize(
    "name, said",
    [("nope", "unknown filter 'nope'; there are inertial6"), ("dmp6", "computed in the sensor")],
)
def test_replay_refuses_a_filter_that_it_cannot_feed_in_one_line(upright, trial, name, said):
    done = upright("replay", trial, "--filter", name)
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert "Traceback" not in done.output and "File" not in done.output


def test_replay_refuses_what_the_filter_refuses(upright, trial):
    done = upright("replay", trial, "--direct", "--filter", "mahony6", "--kp", 1e6)
    assert done.exit_code == 2
    assert "kp is 1000000.0, expected" in done.output


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("inertial6", "inertial6 with {'kp': 1.0}: no parameter 'kp'; there are"),
        ("euler6", "euler6 has no kp; its gains are tau"),
        ("kalman6", "kalman6 has no kp"),
    ],
)
def test_a_gain_that_a_filter_lacks_is_named(upright, trial, name, said):
    done = upright("replay", trial, "--filter", name, "--kp", 1)
    assert done.exit_code == 2
    assert said in done.output and len(done.output.splitlines()) == 1


def test_the_default_filter_is_the_firmwares_everywhere(upright, trial, tmp_path):
    assert ", inertial9, " in upright("replay", trial, "--direct").output
    with np.load(trial) as whole:
        np.savez(tmp_path / "six.npz", **{k: v for k, v in whole.items() if k != "mag"})
    assert ", inertial6, " in upright("replay", tmp_path / "six.npz", "--direct").output
    for board, name in (("sim", "inertial6"), ("robomaster_a", "inertial9")):
        done = upright("demo", "--headless", "--seconds", 2, "--board", board)
        assert f"{name}, error against the truth" in done.output


@pytest.fixture(scope="module")
def recorded_csv(tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "rest.csv"
    path.write_text("ax,ay,az\n" + "0,0,4096\n" * 10)
    return path


# What a person may get wrong, with what is said; TRIAL, CSV, CUT, DIR and NONE stand for files and folders
WRONG = {
    "demo --filters mahony6,foo": "unknown filter 'foo'",
    "demo --filters ,": "no filter is named",
    "demo --motion waltz": "unknown motion 'waltz'",
    "demo --seconds -1": "-1.0 is not a positive number of seconds",
    "demo --runtime z80": "unknown runtime 'z80'",
    "demo --board abacus": "unknown board 'abacus'; there are esp32",
    "demo --png NONE/a.png": "there is no folder",
    "demo --trial CUT": "CUT",
    "replay NONE": "no such file",
    "replay CUT": "CUT",
    "replay DIR": "is a folder",
    "replay TEXT": "TEXT is not an .npz archive",
    "replay TRIAL --runtime z80": "unknown runtime 'z80'",
    "replay TRIAL --seconds 0": "0.0 is not a positive number of seconds",
    "replay TRIAL --out NONE/a.csv": "there is no folder",
    "replay TRIAL --out DIR": "cannot be written",
    "replay TRIAL --direct --out /dev/full": "/dev/full cannot be written: No space left on device",
    "score TRIAL --filters mahony6,foo": "unknown filter 'foo'",
    "score CUT": "no trial to score",
    "score TRIAL --csv NONE/a.csv": "there is no folder",
    "score TRIAL --seconds -3": "-3.0 is not a positive number of seconds",
    "compare TRIAL --filters mahony6,foo": "unknown filter 'foo'",
    "compare CUT": "no trial to compare on",
    "compare TRIAL --runtime z80": "unknown runtime 'z80'",
    "tune kalman CUT": "CUT",
    "tune kalman TRIAL --source foo": "unknown source 'foo'",
    "tune kalman TRIAL --runtime z80": "unknown runtime 'z80'",
    "calibrate mag NONE": "no such file",
    "calibrate mag CUT": "CUT",
    "calibrate mag CSV": "no magnetometer sample",
    "calibrate gyro CSV": "give --rate",
    "calibrate gyro LARGE": "LARGE is larger than 64 MB: cut it into pieces",
    "calibrate gyro CSV --rate 200 --out NONE/a.json": "there is no folder",
    "calibrate show NONE": "missing",
    "doctor --simulated foo": "unknown board 'foo'; there are esp32",
    "doctor --port NONE": "there is no port",
    "doctor --port DIR": "is no serial port",
    "record NONE.imu --port NONE": "there is no port",
    "flash picow": "unknown board 'picow'. Did you mean pico_w? There are esp32",
    "flash ESP32-C3": "Did you mean esp32_c3?",
    "flash abacus": "`upright board new NAME` makes another",
    "flash sim": "name the board that you have",
    "flash pico2 --emulated": "the emulated board is a Pico",
    "flash pico --port NONE": "there is no port",
    "board new pico": "is there already: nothing was changed",
    "board new ../pico": "is no name for a folder",
    "board new x --like y": "unknown board 'y'",
    "flash": "Missing argument 'board'. `upright flash --help` shows what there is",
    "flash pico --seconds x": "Invalid value for '--seconds'",
    "flash pico --emulated --port x": "--port or --emulated, not both",
    "nope": "No such command 'nope'. `upright --help` shows",
    "--nope": "No such option: --nope. `upright --help` shows",
    "calibrate gyro CSV --rate inf": "Invalid value for '--rate'",
    "calibrate gyro CSV --rate 1e300": "Invalid value for '--rate'",
    "demo --seconds inf": "inf is not a positive number",
    "exec NONE": "does not exist. `upright exec --help`",
    "compare TRIAL --png CSV": "that is a file; a folder, or NAME.png, is wanted",
    "exec --runtime z80 CSV": "unknown runtime 'z80'",
    "exec --board abacus CSV": "unknown board 'abacus'",
    "dmp check NONE": "No such file",
    "dmp check /dev/zero": "/dev/zero has more than 1048576 bytes",
    "runtimes cpython --image /dev/zero": "/dev/zero has more than 16777216 bytes",
    "exec CUT": "CUT is no program: 'utf-8' codec can't decode",
    "exec /dev/zero": "/dev/zero has more than 1048576 bytes",
    "faults --file /dev/zero": "/dev/zero has more than 1048576 bytes",
    "faults --file NONE": "No such file",
    "faults --file DEEP": "too deep",
    "runtimes --image NONE": "No such file",
    "bench --save NONE/a.md": "there is no folder",
}


@pytest.mark.parametrize("line", WRONG)
def test_what_is_wrong_is_one_line_without_a_traceback_and_exit_code_2(
    upright, trial, recorded_csv, tmp_path, line
):
    cut = tmp_path / "cut.npz"
    cut.write_bytes(trial.read_bytes()[:2000])
    large = tmp_path / "large.csv"
    with open(large, "wb") as file:
        file.truncate(100_000_000)
    deep = tmp_path / "deep.json"
    deep.write_text("[" * 100_000)
    stand_for = {
        "DEEP": deep,
        **{"TRIAL": trial, "CUT": cut, "CSV": recorded_csv, "TEXT": recorded_csv},
        **{"LARGE": large, "DIR": tmp_path, "NONE": tmp_path / "none"},
    }
    words = line.split()
    for word, file in stand_for.items():
        words = [each.replace(word, str(file)) for each in words]
    done = upright(*words)
    assert isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == 2, done.output
    said = WRONG[line].replace("CUT", str(cut)).replace("TEXT", str(recorded_csv))
    assert said.replace("LARGE", str(large)) in done.stderr
    assert "Traceback" not in done.output and "Usage" not in done.output
    assert len(done.stderr.splitlines()) <= 3  # what was left out has a line each


def test_what_is_not_here_is_exit_code_3(upright, trial, monkeypatch):
    def not_here(name):
        why = runtimes.Unavailable("no mirror")
        why.runtime = name
        raise why

    monkeypatch.setattr(runtimes, "interpreter", not_here)
    for words in (
        ("demo", "--headless", "--runtime", "unix"),
        ("replay", trial, "--runtime", "unix32"),
        ("score", trial, "--runtime", "arm"),
        ("compare", trial, "--no-costs", "--runtime", "arm"),
        ("exec", "--runtime", "unix", __file__),
        ("tune", "kalman", trial, "--source", "mahony6", "--runtime", "unix"),
    ):
        done = upright(*words)
        assert (done.exit_code, done.stdout) == (3, "")
        assert re.fullmatch(r"runtime \w+ is not available here: no mirror\n", done.stderr)


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
    assert replay.board_for("quaternion-kalman9") == "robomaster_a"
    assert replay.board_for("inertial6") == "sim"


def test_what_a_damaged_file_brings_into_a_message_neither_fills_nor_upsets_the_terminal(capsys):
    with pytest.raises(typer.Exit):
        console.fail("a: " + "x" * 5000 + "\x1b[31m\r" + "y" * 60, console.WRONG)
    said = capsys.readouterr().err.rstrip("\n")
    assert len(said) < 700 and said.startswith("a: xxx") and said.endswith("yyy")
    assert said.isprintable()


COMMANDS = (
    "--help",
    "demo --headless --seconds 2 --runtime cpython",
    "runtimes cpython",
    "faults --list",
)


@pytest.mark.parametrize("line", COMMANDS)
@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_command_runs_without_the_streams_that_nobody_has_opened(line, closed):
    done = subprocess.run(
        ["sh", "-c", f"{UPRIGHT} {line} {closed}"], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("line", COMMANDS)
def test_nothing_is_said_when_the_reader_of_the_output_has_gone(line):
    done = subprocess.run(
        ["sh", "-c", f"{UPRIGHT} {line} | true"], capture_output=True, text=True, timeout=60
    )
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("columns", ["20", "200"])
def test_no_figure_is_cut_on_a_narrow_terminal(upright, trial, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    said = upright("score", trial, "--filters", "mahony6", "--seconds", 2).output
    assert re.search(r"mahony6 .*\d\.\d\d +\d\.\d\d", said)
    assert "\u2026" not in said


def test_without_a_cache_there_is_cpython_and_a_reason():
    def demo(*more):
        return subprocess.run(
            [UPRIGHT, "demo", "--headless", "--seconds", "2", *more],
            env=os.environ | {"UPRIGHT_CACHE": "/dev/null/x"},
            capture_output=True,
            text=True,
            timeout=60,
        )

    assert "ran on cpython" in demo().stdout
    done = demo("--runtime", "unix")
    assert (done.returncode, done.stdout) == (3, "")
    assert "the cache /dev/null/x cannot be made (Not a directory)" in done.stderr


def test_a_current_folder_that_has_been_removed_is_named(upright, trial, tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    done = upright("tune", "kalman", trial, "--source", "mahony6")
    assert done.exit_code == 2
    assert done.stderr == "the current folder has been removed\n"
    monkeypatch.chdir(tmp_path)
