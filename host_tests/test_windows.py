"""Windows: no fcntl, other folders, no make, a console that does not take every character."""

import os
import runpy
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import SimpleNamespace

import pytest
from upright_host import paths

AS_WINDOWS = Path(__file__).with_name("as_windows.py")
COMMAND = "from upright_host.cli import main; main()"
BOOTSTRAP = runpy.run_path(str(paths.ROOT / "tools" / "bootstrap.py"))


def upright(*arguments):
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    command = [sys.executable, AS_WINDOWS, "-c", COMMAND, *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, encoding="cp1252", env=environment
    )


@pytest.mark.parametrize("arguments", [["--version"], ["flash", "--help"], ["packages", "--check"]])
def test_the_command_starts_where_fcntl_is_missing(arguments):
    done = upright(*arguments)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_the_demo_runs_there_on_cpython_alone(tmp_path):
    done = upright("demo", "--headless", "--seconds", "3", "--png", str(tmp_path / "a.png"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ran on cpython" in done.stdout and "bus errors 0" in done.stdout
    assert (tmp_path / "a.png").exists()


def test_runtimes_that_windows_cannot_have_are_told_as_such(tmp_path, monkeypatch):
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    done = upright("runtimes", "unix", "rp2040")
    assert done.returncode == 0, done.stderr
    assert "needs Linux, this is win32" in done.stdout
    assert "upright runtimes --image" in " ".join(done.stdout.split())


HOLD = """
import sys, time
sys.path.insert(0, {tools!r})
from upright_host import lock
with lock.held(sys.argv[1]):
    print("in", flush=True)
    time.sleep(float(sys.argv[2]))
    print("out", flush=True)
"""


@pytest.mark.parametrize("start", [[], [AS_WINDOWS]], ids=["here", "windows"])
def test_a_lock_keeps_another_process_waiting_and_goes_with_its_process(tmp_path, start):
    hold = HOLD.format(tools=str(paths.ROOT / "tools"))
    command = [sys.executable, *start, "-c", hold, tmp_path / "lock"]
    first = subprocess.Popen([*command, "60"], stdout=subprocess.PIPE, text=True)
    assert first.stdout.readline() == "in\n"
    second = subprocess.Popen([*command, "0"], stdout=subprocess.PIPE, text=True)
    time.sleep(0.5)
    assert second.poll() is None
    first.kill()
    assert second.communicate(timeout=30)[0] == "in\nout\n"
    first.communicate()


@pytest.mark.parametrize(
    "venv, python",
    [
        (PureWindowsPath(r"C:\up right\.venv"), r"C:\up right\.venv\Scripts\python.exe"),
        (PurePosixPath("/up right/.venv"), "/up right/.venv/bin/python"),
    ],
)
def test_setup_knows_where_each_system_has_an_environments_programs(venv, python):
    assert str(BOOTSTRAP["program"](venv, "python")) == python


@pytest.mark.parametrize("refused, ends", [(0, True), (1, True), (2, False)])
def test_a_system_that_cannot_have_what_the_tests_need_gets_the_command_alone(
    monkeypatch, capfd, refused, ends
):
    asked = []

    def run(command):
        asked.append(command[-1])
        return SimpleNamespace(returncode=int(len(asked) <= refused))

    monkeypatch.setattr(subprocess, "run", run)
    with nullcontext() if ends else pytest.raises(SystemExit, match="could not install"):
        BOOTSTRAP["install_packages"]()
    assert asked == [f"{paths.ROOT}[test]", str(paths.ROOT)][: refused + 1]


def test_make_setup_and_a_machine_without_make_use_one_script():
    assert "tools/bootstrap.py\n" in (paths.ROOT / "Makefile").read_text()
    assert "python tools/bootstrap.py" in (paths.ROOT / "README.md").read_text()
