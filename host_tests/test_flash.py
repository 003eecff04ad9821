"""Installing on a board: only what changed, nothing of the user's, and never half, whenever the power fails."""

import hashlib
import json
import subprocess
import sys

import pytest
from conftest import require
from mpremote.transport import TransportExecError
from typer.testing import CliRunner
from unix_board import PowerCut, UnixBoard
from upright_host import cli, device, flash, paths, runtimes


@pytest.fixture
def board(tmp_path):
    """board(actions=None) -> a board with the same file system each time, `flash_folder`."""
    require("unix")
    made = []
    folder = tmp_path / "flash"
    folder.mkdir()

    def make(actions=None):
        made.append(UnixBoard(folder, actions))
        return made[-1]

    make.folder = folder
    yield make
    for one in made:
        one.close()


def files_of(version):
    """A small installation: sources as they are, and some modules."""
    return {
        "boot.py": (paths.FIRMWARE / "boot.py").read_bytes(),
        "lib/upright_app/update.py": (paths.APPLICATION / "update.py").read_bytes(),
        "main.py": f"print('main {version}')".encode(),
        "board.py": b"NAME = 'x'",
        "lib/upright/a.py": f"VERSION = {version}".encode() * 40,
        f"lib/only_in_{version}.py": b"x = 1",
    }


def install(transport, files, force=False):
    steps = flash.plan(transport, files, force)
    flash.execute(transport, steps)
    return steps


def on_board(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != flash.RECORD and not path.name.endswith(flash.NEW)
    }


def reboot(folder):
    """Boot: boot.py, then what main.py prints."""
    start, _ = runtimes.interpreter("unix")
    code = "import sys\nsys.path.append('lib')\nexec(open('boot.py').read())\nexec(open('main.py').read())"
    return subprocess.run([*start, "-c", code], cwd=folder, capture_output=True, text=True)


def test_it_installs_and_the_second_time_there_is_nothing_to_do(board):
    steps = install(board(), files_of(1))
    assert len(steps.install) == 6
    assert on_board(board.folder) == files_of(1)
    again = flash.plan(board(), files_of(1))
    assert (again.install, again.remove, again.same) == ({}, [], 6)


def test_only_what_changed_is_copied_and_what_is_gone_is_removed(board):
    install(board(), files_of(1))
    steps = install(board(), files_of(2))
    assert set(steps.install) == {"main.py", "lib/upright/a.py", "lib/upright/only_in_2.py"}
    assert steps.remove == ["lib/upright/only_in_1.py"]
    assert on_board(board.folder) == files_of(2)


def test_interrupted_before_any_of_its_actions_the_board_boots_old_or_new_and_never_mixed(board):
    install(board(), files_of(1))
    backup = {p: p.read_bytes() for p in board.folder.rglob("*") if p.is_file()}
    outcomes = []
    for actions in range(1000):
        for path in board.folder.rglob("*"):
            if path.is_file() and path not in backup:
                path.unlink()
        for path, content in backup.items():
            path.write_bytes(content)
        transport = board(actions)
        try:
            install(transport, files_of(2))
        except PowerCut:
            transport = None
        done = reboot(board.folder)
        assert done.returncode == 0, done.stderr
        now = on_board(board.folder)
        if done.stdout.strip() == "main 1":
            assert now == files_of(1), f"mixed after {actions} actions"
            outcomes.append(1)
        else:
            assert now == files_of(2), f"mixed after {actions} actions"
            outcomes.append(2)
        if transport:
            transport.close()
            break
    assert outcomes == sorted(outcomes)
    assert outcomes.count(1) > 10
    assert outcomes.count(2) >= 2  # a journal that the board's boot followed, and the whole


FAILING_OS = """
import os
class Os:
    stat = os.stat
    remove = os.remove
    left = LEFT

    def rename(a, b):
        if not Os.left:
            raise RuntimeError("power")
        Os.left -= 1
        os.rename(a, b)
"""


@pytest.mark.parametrize("left", range(6))
def test_a_boot_that_is_itself_interrupted_ends_the_same(board, left):
    """Power fails again while boot.py follows the journal, after `left` renames."""
    install(board(), files_of(1))
    for name, content in files_of(2).items():
        (board.folder / (name + flash.NEW)).write_bytes(content)
    journal = {"install": list(files_of(2)), "remove": ["lib/upright/only_in_1.py"]}
    (board.folder / flash.JOURNAL).write_text(json.dumps(journal))
    cut = board()
    with pytest.raises(Exception, match="power"):
        update = (paths.APPLICATION / "update.py").read_text()
        update = update.replace("import os\n", "os_ = Os\n").replace("os.", "os_.")
        cut.exec(FAILING_OS.replace("LEFT", str(left)) + update + "\nfinish()")
    assert reboot(board.folder).stdout.strip() == "main 2"
    assert on_board(board.folder) == files_of(2)


def test_a_users_main_and_board_are_kept_unless_forced(board):
    (board.folder / "main.py").write_text("print('mine')")
    (board.folder / "calibration.json").write_text("{}")
    steps = install(board(), files_of(1))
    assert steps.kept == ["main.py"]
    assert (board.folder / "main.py").read_text() == "print('mine')"
    (board.folder / "board.py").write_text("NAME = 'edited'")
    steps = install(board(), files_of(2))
    assert steps.kept == ["main.py", "board.py"]
    assert install(board(), files_of(2), force=True).kept == []
    assert on_board(board.folder) == files_of(2) | {"calibration.json": b"{}"}


def test_a_file_that_arrives_wrong_is_not_put_in_place(board):
    install(board(), files_of(1))

    class Noisy(UnixBoard):
        def fs_writefile(self, dest, data, chunk_size=256, progress_callback=None):
            super().fs_writefile(dest, data.replace(b"VERSION = 2", b"VERSION = 3"), chunk_size)

    noisy = Noisy(board.folder)
    with pytest.raises(device.DeviceError, match="lib/a"):
        install(noisy, files_of(2))
    noisy.close()
    assert on_board(board.folder) == files_of(1)


def test_sources_give_way_to_compiled_modules_of_their_name(board):
    (board.folder / "lib").mkdir()
    (board.folder / "lib" / "a.py").write_text("old = 1")
    files = {"lib/a.mpy": b"M", "main.py": b""}
    steps = install(board(), files)
    assert steps.remove == ["lib/upright/a.py"]
    assert on_board(board.folder) == files


def test_a_board_without_hashlib_is_compared_all_the_same(board):
    install(board(), files_of(1))

    class Bare(UnixBoard):
        def exec(self, command, data_consumer=None):
            if "hashlib" in command:
                raise TransportExecError(1, "ImportError: no module named 'hashlib'")
            return super().exec(command, data_consumer)

    bare = Bare(board.folder)
    steps = install(bare, files_of(2))
    bare.close()
    assert set(steps.install) == {"main.py", "lib/upright/a.py", "lib/upright/only_in_2.py"}
    assert on_board(board.folder) == files_of(2)


def test_what_the_emulated_board_needs_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "rp2040", None)
    with pytest.raises(runtimes.Unavailable, match=r"no emulated board: .*rp2040"):
        device.open_board(None, emulated=True)


def test_facts_of_a_board_and_files_that_it_can_load(board):
    facts = device.facts(board())
    assert facts.platform == "linux"
    assert facts.architecture == "x64"
    assert facts.viper
    assert facts.problems() == ["this build of MicroPython has no timer"]
    facts.architecture = "armv6m"
    files = flash.board_files("pico", facts)
    assert files["board.py"] == (paths.BOARDS / "pico" / "board.py").read_bytes()
    assert files["lib/upright/fixmath.mpy"][:2] == b"M\x06"
    assert "lib/upright/fixmath.py" not in files
    assert "main.py" in files
    # of the filters the one that it runs, and that of a board.py that may stay
    assert "lib/upright/inertial.mpy" in files and "lib/upright/mahony.mpy" not in files
    assert "lib/upright/mahony.mpy" in flash.board_files("pico", facts, own='FILTER = "mahony6"\n')
    with pytest.raises(device.DeviceError, match="unknown board"):
        flash.board_files("abacus", facts)


@pytest.mark.parametrize("board_py, has, lacks", [
    ("", {"inertial", "inertial_kernels"}, {"mahony", "ist8310", "dmp", "kalman"}),
    ('FILTER = "kalman6"', {"kalman", "euler_kernels", "fixmath"}, {"inertial", "dmp"}),
    ('FILTER = "dmp6"\nfrom upright import mpu6500', {"dmp", "dmp_image", "mpu6500"}, {"mahony"}),
    ("FILTER = None\ndef f():\n    from upright import ist8310", {"inertial", "ist8310", "auxiliary_bus"}, {"mahony"}),
    ("import os\nFILTER = os.environ", {"inertial", "mahony", "quaternion_kalman", "dmp"}, {"ist8310"}),
])  # fmt: skip
def test_a_board_gets_the_library_that_it_needs(board_py, has, lacks):
    needed = flash.library(board_py)
    assert has <= needed and not lacks & needed
    assert {"fixmath", "calibration", "ssd1306"} <= needed
    assert all((paths.PACKAGE / f"{module}.py").exists() for module in needed)


def test_an_old_micropython_without_viper_is_refused_with_both_reasons():
    facts = device.Facts(
        "rp2", "Pico", (1, 20, 0), 6, 3, "armv6m", False, False, True, True, 100000
    )
    old, viper = facts.problems()
    assert "1.20.0 is too old" in old
    assert "viper" in viper


def test_several_boards_are_listed_and_none_is_guessed(monkeypatch):
    monkeypatch.setattr(device, "ports", lambda: [("/dev/a", "Pico"), ("/dev/b", "Pyboard")])
    with pytest.raises(device.DeviceError, match=r"--port /dev/a   Pico\n.*--port /dev/b"):
        device.pick_port(None)
    assert device.pick_port("/dev/c") == "/dev/c"
    monkeypatch.setattr(device, "ports", list)
    with pytest.raises(device.DeviceError, match="no board found"):
        device.pick_port(None)


def test_the_hash_in_the_record_is_that_of_the_file(board):
    install(board(), files_of(1))
    record = json.loads((board.folder / flash.RECORD).read_text())
    for name, digest in record["files"].items():
        assert hashlib.sha256((board.folder / name).read_bytes()).hexdigest() == digest


def test_only_the_pico_is_emulated():
    done = CliRunner().invoke(cli.app, ["flash", "pico2", "--emulated"])
    assert done.exit_code == 1
    assert "a Pico, not pico2" in done.output
