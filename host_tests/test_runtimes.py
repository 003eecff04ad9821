"""The runtimes: what is obtained, what is said where it cannot be had, and that an interruption does no harm."""

import json
import platform
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import missing_boards, require
from upright_host import console, debian, paths, runtimes, simulate


@pytest.fixture
def fresh(monkeypatch):
    """As in a new process: nothing found yet."""
    monkeypatch.setattr(runtimes, "_ready", {})


def test_a_script_gets_its_arguments_and_the_boards_modules(runtime, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import sys, machine\nfrom upright import mahony\nfrom upright_app import app\n"
        "print(sys.argv[1:], sys.implementation.name)\nsys.exit(7)\n"
    )
    done = runtimes.run(runtime, script, ["a", "b c"])
    assert done.returncode == 7, done.stderr
    name = "cpython" if runtime == "cpython" else "micropython"
    assert done.stdout.strip() == f"['a', 'b c'] {name}"


def test_each_micropython_is_what_it_is_named_for(micropython_runtime, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nprint(sys.maxsize > 1 << 32, sys.implementation._mpy >> 10 & 15)\n"
    )
    name = micropython_runtime
    is_64, arch = runtimes.run(name, script).stdout.split()
    assert is_64 == str(name in ("unix", "unix-1.26"))
    # of device._ARCHITECTURES; armv7m and up: the Thumb-2 emitter
    expected = {"arm": (5, 6, 7, 8), "m3": (5, 6), "rv32": (11,)}
    assert int(arch) in expected.get(name, (int(arch),))
    if name == "unix-1.26":
        assert runtimes.interpreter(name)[1].startswith("1.26.")


def test_an_unknown_runtime_is_refused_by_name():
    with pytest.raises(console.Wrong, match="unknown runtime 'z80'; there are cpython"):
        runtimes.interpreter("z80")


def test_another_processor_cannot_have_i386(monkeypatch, fresh):
    monkeypatch.setattr(runtimes, "_MACHINE", "aarch64")
    with pytest.raises(runtimes.Unavailable, match="x86-64"):
        runtimes.interpreter("unix32")


def test_without_apt_the_reason_is_one_line(monkeypatch, fresh, tmp_path):
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(runtimes.Unavailable) as why:
        runtimes.interpreter("arm")
    assert "apt-get is not here" in str(why.value)
    assert "\n" not in str(why.value)


def test_a_dead_mirror_is_said_and_leaves_nothing_behind(monkeypatch, fresh, tmp_path):
    if not debian.shutil.which("apt-get"):
        pytest.skip("no apt-get here")
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    nowhere = tmp_path / "no-such-mirror"
    monkeypatch.setattr(debian.Apt, "_mirror", staticmethod(lambda: f"file:{nowhere}"))
    (tmp_path / "runtimes" / ".unpacking-killed").mkdir(parents=True)  # what a killed run leaves
    with pytest.raises(runtimes.Unavailable) as why:
        runtimes.interpreter("arm")
    assert "apt-get" in str(why.value)
    assert list((tmp_path / "runtimes").iterdir()) == []


def test_an_old_micropython_on_path_is_not_taken(monkeypatch, tmp_path):
    old = tmp_path / "micropython"
    old.write_text("#!/bin/sh\necho 1.20.0 1\n")
    old.chmod(0o755)
    with pytest.raises(runtimes.Unavailable, match=r"1\.20\.0 is older than 1\.22"):
        runtimes._check([str(old)])


def test_a_suite_that_has_another_version_now_is_said(monkeypatch, fresh):
    monkeypatch.setattr(runtimes, "_obtain", lambda names: {})
    monkeypatch.setattr(runtimes, "_check", lambda command: "1.28.0")
    with pytest.raises(
        runtimes.Unavailable, match=r"^Debian's suite has MicroPython 1\.28\.0 now$"
    ):
        runtimes.interpreter("unix-1.26")


def test_the_command_lists_every_runtime_with_a_version_or_a_reason(upright, fresh):
    for name in missing_boards():
        runtimes.leave_out(name, "takes minutes to build")
    done = upright("runtimes")
    assert done.exit_code == 0
    for name in runtimes.NAMES:
        assert name in done.stdout
    assert platform.python_version() in done.stdout


def test_exec_runs_a_file_and_passes_its_status_on(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import sys\nprint('hello', sys.argv[1])\nsys.exit(3)\n")
    upright = [sys.executable, "-m", "upright_host.cli", "exec", "--runtime", "cpython"]
    done = subprocess.run([*upright, script, "-x"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (3, "hello -x\n")
    done = subprocess.run([*upright, tmp_path / "absent.py"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "does not exist" in done.stderr


def readme_program():
    """The program of README's "Use one module alone", and the files that its packages list."""
    section = (paths.ROOT / "README.md").read_text().split("## Use one module alone")[1]
    needs, program = section.split("```python\n")[:2]
    packages = re.findall(r"\blib/upright/\w+\.json", needs)
    urls = [
        pair for name in packages for pair in json.loads((paths.ROOT / name).read_text())["urls"]
    ]
    return program.split("```")[0], {target: paths.PACKAGE / source for target, source in urls}


def test_the_readmes_program_runs_from_the_files_of_its_packages_alone(runtime, tmp_path):
    program, files = readme_program()
    assert len(files) > 4
    for target, source in files.items():
        (tmp_path / "lib" / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, tmp_path / "lib" / target)
    (tmp_path / "program.py").write_text(program)
    argv, environment = runtimes.program(
        runtime, tmp_path / "program.py", seconds=2, folders=[tmp_path / "lib"]
    )
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    angles = np.array([line.split() for line in done.stdout.splitlines()], int)
    assert 300 < len(angles) < 400  # at 200 Hz, from when the sensor is awake
    assert 0 < abs(angles[:, :2]).max() < 500  # level but for the sensor's noise


def test_a_program_has_the_chips_of_its_board_and_simulated_time(runtime, tmp_path):
    script = tmp_path / "program.py"
    script.write_text(
        "import sys, time, utime\n"
        "from machine import I2C, Pin, SoftI2C\n"
        "begin = utime.ticks_ms()\n"
        "time.sleep(1)\n"
        "utime.sleep_ms(500)\n"
        "time.sleep_us(1000)\n"
        "print(time.ticks_diff(time.ticks_ms(), begin), utime.ticks_diff(utime.ticks_ms(), begin))\n"
        "print(I2C(0, scl=Pin(5), sda=Pin(4)).scan(), SoftI2C(scl=Pin(5), sda=Pin(4)).scan())\n"
        "print(__name__, sys.argv[1:])\n"
        "sys.exit(7)\n"
    )
    argv, environment = runtimes.program(runtime, script, ["a", "-b"])
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (7, "")
    assert done.stdout.splitlines() == [
        "1501 1501",
        "[60, 104] [60, 104]",
        "__main__ ['a', '-b']",
    ]


def test_a_program_that_only_prints_comes_to_its_end(upright, tmp_path):
    script = tmp_path / "program.py"
    script.write_text("while True:\n    print('x' * 99)\n")
    done = upright("exec", "--runtime", "cpython", "--seconds", "0.1", script)
    assert done.exit_code == 0


@pytest.mark.parametrize("before", [None, "a real board's"])
def test_exec_leaves_the_folders_calibration_file_as_it_was(upright, tmp_path, monkeypatch, before):
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "upright_cal.json"
    if before:
        kept.write_text(before)
    script = tmp_path / "program.py"
    script.write_text(
        "with open('upright_cal.json', 'w') as file:\n    file.write('simulated')\n"
        "open('log.csv', 'w').close()\n"
    )
    assert upright("exec", "--runtime", "cpython", script).exit_code == 0
    assert (kept.read_text() if kept.exists() else None) == before
    assert (tmp_path / "log.csv").exists()  # what the program itself writes stays


def test_a_program_ended_by_ctrl_c_ends_without_the_simulators_traceback(tmp_path):
    script = tmp_path / "program.py"
    script.write_text("raise KeyboardInterrupt\n")
    argv, environment = runtimes.program("cpython", script)
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.parametrize("board", [name for name in paths.boards() if name != "robomaster_a"])
def test_every_board_has_its_sensor_and_display_on_its_pins(board, tmp_path):
    script = tmp_path / "program.py"
    script.write_text("import board\nprint(board.sensor().read(), board.display(32) is not None)\n")
    argv, environment = runtimes.program("cpython", script, board=board)
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout == "0 True\n", done.stderr  # asleep


def test_exec_refuses_an_unknown_runtime(upright, tmp_path):
    script = tmp_path / "script.py"
    script.write_text("")
    done = upright("exec", "--runtime", "z80", script)
    assert done.exit_code == 2
    assert "unknown runtime" in done.stderr


def test_the_cache_is_where_it_is_told_to_be(monkeypatch, tmp_path):
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path / "own"))
    assert paths.cache() == tmp_path / "own"
    monkeypatch.delenv("UPRIGHT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert paths.cache() == tmp_path / "xdg" / "upright"


def test_the_quickest_of_what_is_left_is_taken(fresh):
    for name in ("unix", "unix32"):
        left = "unix32" if name == "unix" else "cpython"
        runtimes.leave_out(name, "for a reason")
        with pytest.raises(runtimes.Unavailable, match="for a reason"):
            runtimes.interpreter(name)
        if left == "unix32":
            require("unix32")
        assert simulate.best_runtime() == left
