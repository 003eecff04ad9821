"""The runtimes: what is obtained, what is said where it cannot be had, and that an interruption does no harm."""

import platform
import subprocess
import sys

import pytest
from typer.testing import CliRunner
from upright_host import cli, console, debian, paths, runtimes


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
    is_64, arch = runtimes.run(micropython_runtime, script).stdout.split()
    assert is_64 == str(micropython_runtime == "unix")
    if micropython_runtime == "arm":
        assert int(arch) in (5, 6, 7, 8)  # armv7m and up: the Thumb-2 emitter


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


def test_the_command_lists_every_runtime_with_a_version_or_a_reason():
    done = CliRunner().invoke(cli.app, ["runtimes"])
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


def test_exec_says_why_a_runtime_cannot_be_had(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("")
    done = CliRunner().invoke(cli.app, ["exec", "--runtime", "z80", str(script)])
    assert done.exit_code == 2
    assert "unknown runtime" in done.stderr


def test_the_cache_is_where_it_is_told_to_be(monkeypatch, tmp_path):
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path / "own"))
    assert paths.cache() == tmp_path / "own"
    monkeypatch.delenv("UPRIGHT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert paths.cache() == tmp_path / "xdg" / "upright"
