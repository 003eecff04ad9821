"""Installing on a board: only what changed, nothing of the user's, and never half, whenever the power fails."""

import hashlib
import json
import shutil
import sys

import pytest
from conftest import some_micropython
from mpremote.transport import TransportExecError
from typer.testing import CliRunner
from unix_board import POWER_CUT, PowerCut, UnixBoard, boot
from upright_host import cli, console, contents, device, flash, paths, runtimes

MAIN = "import upright\nfrom upright import a\nprint('main %d', upright.VERSION, a.VERSION)"
OWN_BOOT = b"# mine\n"


@pytest.fixture
def board(tmp_path):
    """board(left=None, free=None) -> a board with the same file system each time, `board.folder`."""
    some_micropython()
    made = []
    folder = tmp_path / "flash"
    folder.mkdir()

    def make(left=None, free=None, kind=UnixBoard):
        made.append(kind(folder, left, free))
        return made[-1]

    make.folder = folder
    yield make
    for one in made:
        one.close()


def files_of(version, main=None):
    """A small installation: sources as they are, and some modules. main: the version of its main.py."""
    return {
        "main.py": (MAIN % (main or version)).encode(),
        "board.py": b"NAME = 'x'",
        "lib/upright/__init__.py": f"VERSION = {version}".encode(),
        "lib/upright/a.py": f"VERSION = {version}\n".encode() * 40,
        f"lib/upright/only_in_{version}.py": b"x = 1",
    }


def install(transport, files, force=False):
    steps = flash.plan(transport, files, force)
    flash.execute(transport, steps)
    return steps


def put(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def on_board(folder, record=False):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and (record or path.name != flash.RECORD)
    }


def recorded(files):
    """The record of an installation of these files, as an earlier version left it."""
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    return {flash.RECORD: json.dumps({"version": "0", "files": hashes}).encode()}


# ------------------------------------------------------------------------------------------ what is copied


def test_it_installs_and_the_second_time_there_is_nothing_to_do(board):
    steps = install(board(), files_of(1))
    assert len(steps.install) == 5
    assert on_board(board.folder) == files_of(1)
    again = flash.plan(board(), files_of(1))
    assert (again.install, again.remove, again.same) == ({}, [], 5)
    assert boot(board.folder).stdout == "main 1 1 1\n"


def test_only_what_changed_is_copied_and_what_is_gone_is_removed(board):
    install(board(), files_of(1))
    steps = install(board(), files_of(2, main=1))
    assert set(steps.install) == {
        "lib/upright/__init__.py",
        "lib/upright/a.py",
        "lib/upright/only_in_2.py",
    }
    assert steps.remove == ["lib/upright/only_in_1.py"]
    assert on_board(board.folder) == files_of(2, main=1)


def test_the_hash_in_the_record_is_that_of_the_file(board):
    install(board(), files_of(1))
    record = json.loads((board.folder / flash.RECORD).read_text())
    for name, digest in record["files"].items():
        assert hashlib.sha256((board.folder / name).read_bytes()).hexdigest() == digest


def test_a_file_that_arrives_wrong_is_not_put_in_place(board):
    install(board(), files_of(1))

    class Noisy(UnixBoard):
        def fs_writefile(self, dest, data, chunk_size=256, progress_callback=None):
            super().fs_writefile(dest, data.replace(b"VERSION = 2", b"VERSION = 3"), chunk_size)

    with pytest.raises(device.DeviceError, match=r"__init__\.py: what the board holds is not"):
        install(board(kind=Noisy), files_of(2))
    assert boot(board.folder).stdout == "main 1 1 1\n"
    install(board(), files_of(2))
    assert on_board(board.folder) == files_of(2)


def test_a_board_without_hashlib_is_compared_all_the_same(board):
    install(board(), files_of(1))

    class Bare(UnixBoard):
        def exec(self, command, data_consumer=None):
            if "hashlib" in command:
                raise TransportExecError(1, "ImportError: no module named 'hashlib'")
            return super().exec(command, data_consumer)

    steps = install(board(kind=Bare), files_of(2, main=1))
    assert len(steps.install) == 3
    assert on_board(board.folder) == files_of(2, main=1)


# ------------------------------------------------------------------------------------------ the power fails


@pytest.mark.slow
@pytest.mark.parametrize(
    "main, own_boot",
    [(1, False), (1, True), (2, False), (2, True)],
    ids=["main stays", "main stays, own boot.py", "new main", "new main, own boot.py"],
)
def test_whenever_the_power_fails_the_board_boots_old_or_new_and_never_mixed(board, main, own_boot):
    """Before each command of the host and each step of the board's, on a file system that cannot replace a file."""
    install(board(), files_of(1))
    more = {"boot.py": OWN_BOOT} if own_boot else {}
    put(board.folder, more)
    backup = board.folder.with_name("backup")
    shutil.copytree(board.folder, backup)
    old, new = files_of(1) | more, files_of(2, main=main) | more
    outcomes, without_main = [], 0
    for left in range(1000):
        shutil.rmtree(board.folder)
        shutil.copytree(backup, board.folder)
        transport = board(left)
        try:
            install(transport, files_of(2, main=main))
            ended = True
        except PowerCut:
            ended = False
        if own_boot and not (board.folder / "main.py").exists():
            # the one moment at which a boot finishes nothing: the user's own boot.py keeps ours from standing in
            without_main += 1
            assert boot(board.folder, then="import upright").returncode == 0
        done = boot(board.folder)
        assert done.returncode == 0, done.stderr
        now = {n: c for n, c in on_board(board.folder).items() if not n.startswith(flash.STAGE)}
        if done.stdout == "main 1 1 1\n":
            if now.get("boot.py") == flash.BOOT:
                del now["boot.py"]
            assert now == old, f"mixed after {left} steps"
            outcomes.append(1)
        else:
            assert done.stdout == f"main {main} 2 2\n"
            assert now == new, f"mixed after {left} steps"
            assert not (board.folder / flash.STAGE).exists()
            outcomes.append(2)
        if ended:
            break
        transport.close()
        install(board(), files_of(2, main=main))  # and again, to the end
        assert on_board(board.folder) == new
    assert outcomes == sorted(outcomes)
    assert outcomes.count(1) > 10
    assert outcomes.count(2) > 10
    assert without_main == (1 if own_boot and main == 2 else 0)


def test_a_boot_that_is_itself_interrupted_ends_the_same(board):
    install(board(), files_of(1))
    with pytest.raises(PowerCut):  # just when the installation has come to hold
        for left in range(1, 1000):
            if (board.folder / flash.SELF).exists():
                raise PowerCut
            transport = board(left)
            try:
                install(transport, files_of(2))
            except PowerCut:
                transport.close()
    backup = board.folder.with_name("backup")
    shutil.copytree(board.folder, backup)
    for left in range(100):
        shutil.rmtree(board.folder)
        shutil.copytree(backup, board.folder)
        ended = boot(board.folder, left).returncode != POWER_CUT
        assert boot(board.folder).stdout == "main 2 2 2\n"
        assert on_board(board.folder) == files_of(2)
        if ended:
            break
    assert 8 < left < 99


@pytest.mark.parametrize(
    "first", ["import upright", "from upright import a", "import upright.a as a"]
)
def test_whoever_imports_it_first_finishes_it_and_gets_the_new(board, first):
    install(board(), files_of(1))
    put(board.folder, {"main.py": b""})  # the user's, who has other plans

    class Cut(UnixBoard):
        def exec(self, command, data_consumer=None):
            if command == flash.FINISH:
                return b""
            return super().exec(command, data_consumer)

    transport = board(kind=Cut)
    install(transport, files_of(2))
    assert (board.folder / flash.SELF).exists()
    show = "\nimport upright\nfrom upright import a\nprint(upright.VERSION, a.VERSION)"
    assert boot(board.folder, then=first + show).stdout == "2 2\n"
    assert not (board.folder / flash.SELF).exists()
    assert on_board(board.folder) == files_of(2) | {"main.py": b""}


# ------------------------------------------------------------------------------------------ room


def need_of(board, files):
    """Bytes of file system, free on an empty board, that an installation asks for."""
    with pytest.raises(device.DeviceError) as refused:
        install(board(free=0), files)
    return int(str(refused.value).split()[0]) + flash.SPARE


def test_it_fits_to_the_byte_or_is_refused_before_anything_is_written(board):
    need = need_of(board, files_of(1))
    with pytest.raises(
        device.DeviceError, match=f"{need - flash.SPARE} bytes and 8192 to spare do not fit"
    ):
        install(board(free=need - 512), files_of(1))
    assert on_board(board.folder, record=True) == {}
    install(board(free=need), files_of(1))
    assert on_board(board.folder) == files_of(1)
    used = sum(-(-len(content) // 512) * 512 for content in files_of(1).values())
    assert used < need - flash.SPARE < used + 8192


def big(version):
    return files_of(version) | {"lib/upright/big.py": b"# %d\n" % version + b"#" * 30000}


def test_without_room_for_both_the_new_takes_the_place_of_the_old(board):
    need = need_of(board, big(1))
    install(board(), big(1))
    steps = flash.plan(board(free=need), big(2))
    assert flash.execute(board(free=need), steps) is False
    assert on_board(board.folder) == big(2)
    assert boot(board.folder).stdout == "main 2 2 2\n"
    assert flash.plan(board(), big(2)).install == {}
    # and with room for both they lie beside each other
    assert flash.execute(board(free=2 * need), flash.plan(board(), big(1))) is True


@pytest.mark.slow
def test_a_board_cut_off_between_old_and_new_says_so_and_is_installed_again(board):
    need = need_of(board, big(1))
    install(board(), big(1))
    backup = board.folder.with_name("backup")
    shutil.copytree(board.folder, backup)
    said = set()
    for left in range(0, 1000, 3):
        shutil.rmtree(board.folder)
        shutil.copytree(backup, board.folder)
        transport = board(left, need)
        try:
            install(transport, big(2))
            break
        except PowerCut:
            transport.close()
        if (board.folder / flash.SELF).exists():
            done = boot(board.folder, then="import upright")
            said.add(done.stderr.strip().splitlines()[-1])
        else:
            assert boot(board.folder).stdout in ("main 1 1 1\n", "main 2 2 2\n")
        install(board(free=need), big(2))
        assert on_board(board.folder) == big(2)
    assert said == {
        "ImportError: an installation of Upright was cut off: run `upright flash` again"
    }


# ------------------------------------------------------------------------------------------ the user's files


def test_what_is_the_users_survives_and_breaks_nothing(board):
    own = {
        "mpu6050.py": b"raise ValueError('a tutorial')",
        "ssd1306.py": b"raise ValueError('a tutorial')",
        "config.py": b"WIFI = 'x'",
        "timing.py": b"x = 1",
        "boot.py": OWN_BOOT,
        "lib/ssd1306.py": b"# micropython-lib's",
        "lib/upright/notes.txt": b"mine",
        "calibration.json": b"{}",
        "data.csv": b"1,2",
    }
    put(board.folder, own)
    for version in (1, 2):
        steps = install(board(), files_of(version))
        assert (steps.kept, steps.blocked, steps.backup) == ([], [], [])
        assert on_board(board.folder) == files_of(version) | own
        assert boot(board.folder).stdout == f"main {version} {version} {version}\n"


def test_a_users_main_and_board_are_kept_unless_forced(board):
    put(board.folder, {"main.py": b"print('mine')", "boot.py": OWN_BOOT})
    steps = install(board(), files_of(1))
    assert steps.kept == [("main.py", "not installed by Upright")]
    assert (board.folder / "main.py").read_text() == "print('mine')"
    put(board.folder, {"board.py": b"NAME = 'edited'"})
    steps = install(board(), files_of(2))
    assert dict(steps.kept).keys() == {"main.py", "board.py"}
    assert dict(steps.kept)["board.py"] == "changed since it was installed"
    assert install(board(), files_of(2), force=True).kept == []
    assert on_board(board.folder) == files_of(2) | {
        "boot.py": OWN_BOOT,
        "main.py.bak": b"print('mine')",
        "board.py.bak": b"NAME = 'edited'",
    }
    put(board.folder, {"main.py": b"print('mine again')"})
    install(board(), files_of(2), force=True)
    assert (board.folder / "main.py.bak2").read_bytes() == b"print('mine again')"
    assert (board.folder / "main.py.bak").read_bytes() == b"print('mine')"


def test_the_main_py_of_a_new_board_is_nobodys(board):
    put(board.folder, {"main.py": b"# main.py -- put your code here!\r\n"})
    assert install(board(), files_of(1)).kept == []
    assert boot(board.folder).stdout == "main 1 1 1\n"


IN_THE_WAY = {
    "upright.py": "would be imported instead of lib/upright",
    "upright/x.py": "would be imported instead of lib/upright",
    "upright_app.py": "would be imported instead of lib/upright_app",
    "upright_app.mpy": "would be imported instead of lib/upright_app",
    "lib/upright/a.mpy": "would be imported instead of lib/upright/a.py",
    "lib/upright/a.py": "not installed by Upright",
}


@pytest.mark.parametrize("name, why", IN_THE_WAY.items())
def test_what_is_in_the_way_is_named_and_only_force_moves_it_aside(board, name, why):
    put(board.folder, {name: b"mine = 1"})
    with pytest.raises(device.DeviceError) as refused:
        install(board(), files_of(1))
    top = "upright" if name.startswith("upright/") else name
    assert f"\n{top}: " in str(refused.value) and why in str(refused.value)
    assert on_board(board.folder, record=True) == {name: b"mine = 1"}
    install(board(), files_of(1), force=True)
    copy = name.replace(top, f"{top}.bak")
    assert on_board(board.folder) == files_of(1) | {copy: b"mine = 1"}
    assert boot(board.folder).stdout == "main 1 1 1\n"


def test_a_module_that_was_changed_on_the_board_is_in_the_way(board):
    install(board(), files_of(1))
    put(board.folder, {"lib/upright/a.py": b"VERSION = 7", "lib/upright/only_in_1.py": b"x = 7"})
    with pytest.raises(device.DeviceError, match=r"a\.py: changed since it was installed"):
        install(board(), files_of(2))
    assert boot(board.folder).stdout == "main 1 1 7\n"
    steps = install(board(), files_of(2), force=True)
    assert [name for name, _ in steps.kept] == ["lib/upright/only_in_1.py"]
    assert on_board(board.folder) == files_of(2) | {
        "lib/upright/a.py.bak": b"VERSION = 7",
        "lib/upright/only_in_1.py": b"x = 7",
    }


def test_a_source_of_ours_gives_way_to_the_compiled_module(board):
    install(board(), files_of(1))
    compiled = files_of(1)
    del compiled["lib/upright/a.py"]
    compiled["lib/upright/a.mpy"] = b"M"
    assert install(board(), compiled).remove == ["lib/upright/a.py"]
    assert on_board(board.folder) == compiled


# ------------------------------------------------------------------------------------------ an older Upright


OLD_BOARD = b"""import ssd1306
import timing
from sys import path
from mpu6050 import MPU6050
NAME = "Raspberry Pi Pico"
PLATFORM = "rp2"
COLOUR = 3
def display(chunk):
    return ssd1306.SSD1307(_i2c, chunk=chunk)
"""
OLD = {
    "boot.py": b"try:\n    import update\n    update.finish()\nexcept ImportError:\n    pass\n",
    "main.py": b"import app\nimport board\nprint('old', app.config.X)",
    "board.py": OLD_BOARD,
    "update.py": b"def finish():\n    pass\n",
    "app.py": b"import config\n",
    "config.py": b"X = 1\n",
    "timing.py": b"",
    "lib/ssd1306.py": b"",
    "lib/mpu6050.py": b"MPU6050 = 1",
}


def test_an_older_installation_is_moved_over_and_its_calibration_with_it(board):
    put(board.folder, OLD | recorded(OLD) | {"calibration.json": b"{1}"})
    assert boot(board.folder).stdout == "old 1\n"
    steps = install(board(), files_of(1))
    assert (steps.kept, steps.blocked) == ([], [])
    calibration = {"calibration.json": b"{1}", "upright_cal.json": b"{1}"}
    assert on_board(board.folder) == files_of(1) | calibration
    assert boot(board.folder).stdout == "main 1 1 1\n"
    put(board.folder, {"upright_cal.json": b"{2}"})
    install(board(), files_of(2))
    assert (board.folder / "upright_cal.json").read_bytes() == b"{2}"


def test_whenever_the_power_fails_on_the_way_from_an_older_one_the_board_boots(board):
    put(board.folder, OLD | recorded(OLD))
    backup = board.folder.with_name("backup")
    shutil.copytree(board.folder, backup)
    outcomes = []
    for left in range(1000):
        shutil.rmtree(board.folder)
        shutil.copytree(backup, board.folder)
        transport = board(left)
        try:
            install(transport, files_of(1))
            break
        except PowerCut:
            transport.close()
        done = boot(board.folder)
        assert done.returncode == 0, done.stderr
        outcomes.append(done.stdout)
        if done.stdout != "old 1\n":
            assert on_board(board.folder) == files_of(1)
    assert outcomes == sorted(outcomes, reverse=True)
    assert set(outcomes) == {"old 1\n", "main 1 1 1\n"}


@pytest.mark.parametrize(
    "record",
    [
        b"\xff{",
        b"[" * 5000,
        b"[1]",
        b'{"version": 1}',
        *(json.dumps({"files": files}).encode() for files in (None, 5, "abc", ["a"], {"a": [1]})),
    ],
    ids=range(9),
)
def test_a_record_that_is_none_is_taken_for_none(board, record):
    put(board.folder, {flash.RECORD: record, "a": b"mine"})
    install(board(), files_of(1))
    assert on_board(board.folder) == files_of(1) | {"a": b"mine"}


def test_a_record_reaches_no_file_outside_the_boards_own_folders(board):
    outside = board.folder.with_name("outside.txt")
    outside.write_bytes(b"mine")
    digest = hashlib.sha256(b"mine").hexdigest()
    names = ["../outside.txt", str(outside), "./../outside.txt", "lib/../../outside.txt", "", "/"]
    put(board.folder, {flash.RECORD: json.dumps({"files": dict.fromkeys(names, digest)}).encode()})
    steps = install(board(), files_of(1))
    assert (steps.remove, steps.kept) == ([], [])
    assert outside.read_bytes() == b"mine"


@pytest.mark.parametrize(
    "text", ["import\n", "", "x = 1\n", "finish()\n", "finish(x)\n", "finish('a')[0]\n"]
)
def test_an_upright_py_that_no_installation_wrote_is_the_users(board, text):
    put(board.folder, {"upright.py": f"{flash.MARK}, or so\n{text}".encode()})
    steps = flash.plan(board(), files_of(1))
    assert [name for name, _ in steps.blocked] == ["upright.py"]


def test_an_installation_that_cannot_be_finished_says_why(board):
    put(board.folder, {"upright.new/0": b"1", "a.txt/mine": b"x"})
    put(board.folder, {"upright.py": flash._in_front("finish(['a.txt'], [])")})
    with pytest.raises(device.DeviceError, match=r"cannot be finished: .*in the way"):
        flash.plan(board(), files_of(1))


def test_users_files_under_the_names_of_the_installation_are_kept(board):
    put(board.folder, {"upright.new/photo.jpg": b"mine", "upright.new/0": b"left over"})
    install(board(), files_of(1))
    assert on_board(board.folder) == files_of(1) | {"upright.new/photo.jpg": b"mine"}
    shutil.rmtree(board.folder / "upright.new")
    put(board.folder, {"upright.new": b"mine"})
    assert "rename it" in dict(flash.plan(board(), files_of(2)).blocked)["upright.new"]
    (board.folder / flash.RECORD).unlink()
    put(board.folder, {f"{flash.RECORD}/x": b"mine"})
    assert flash.RECORD in dict(flash.plan(board(), files_of(2)).blocked)


def test_an_older_journal_is_followed_and_no_program_of_the_users_is_run(board):
    journal = {"install": ["app.py", "../x"], "remove": ["old.py", "../outside.txt"]}
    outside = board.folder.with_name("outside.txt")
    outside.write_bytes(b"mine")
    put(board.folder, {"app.py": b"1", "app.py.new": b"2", "old.py": b""})
    put(board.folder, {"update.py": b"raise SystemExit\n"})
    put(board.folder, {"update.json": json.dumps(journal).encode()})
    install(board(), files_of(1))
    assert on_board(board.folder) == files_of(1) | {
        "app.py": b"2",
        "update.py": b"raise SystemExit\n",
    }
    assert outside.exists()
    put(board.folder, {"update.json": b"{}", "calibration.json/x": b"mine"} | recorded(OLD))
    install(board(), files_of(1))
    assert (board.folder / "update.json").exists()


def test_old_files_that_were_changed_are_kept_and_named(board):
    put(board.folder, OLD | recorded(OLD))
    put(board.folder, {"config.py": b"X = 2\n", "boot.py": OLD["boot.py"] + b"import x\n"})
    steps = install(board(), files_of(1))
    assert dict(steps.kept).keys() == {"config.py", "boot.py"}
    assert "changed since" in dict(steps.kept)["config.py"]
    assert set(on_board(board.folder)) == {*files_of(1), "config.py", "boot.py"}


def test_a_board_py_made_for_the_old_names_stops_the_flash_with_the_lines_to_change(board):
    put(board.folder, OLD | recorded(OLD))
    own = {
        "board.py": OLD_BOARD + b"# pins of mine\n",
        "robot.py": b"import os\nimport mpu6050 as sensor, sys\n",
        "other.py": b"import machine\n",
    }
    put(board.folder, own)
    before = on_board(board.folder, record=True)
    with pytest.raises(device.DeviceError) as refused:
        install(board(), files_of(1))
    said = str(refused.value)
    assert "nothing was changed" in said
    for line in (
        "line 1: import ssd1306  ->  from upright import ssd1306",
        "line 2: import timing  ->  from upright import timing",
        "line 4: from mpu6050 import MPU6050  ->  from upright.mpu6050 import MPU6050",
        "line 7: COLOUR is no setting",
        "line 9: upright/ssd1306.py has no SSD1307",
        "line 2: import mpu6050 as sensor, sys  ->  from upright import mpu6050 as sensor; import sys",
    ):
        assert line in said, said
    assert "other.py" not in said and "line 3" not in said
    assert on_board(board.folder, record=True) == before
    install(board(), files_of(1), force=True)
    assert on_board(board.folder)["board.py.bak"] == own["board.py"]
    assert on_board(board.folder)["robot.py"] == own["robot.py"]


# ------------------------------------------------------------------------------------------ what is installed


def test_facts_of_a_board_and_files_that_it_can_load(board):
    facts = device.facts(board())
    assert facts.platform == "linux"
    assert facts.architecture in ("x86", "x64")
    assert facts.viper
    assert facts.frozen == ""
    assert facts.problems() == ["this build of MicroPython has no timer"]
    facts.architecture = "armv6m"
    files = contents.board_files("pico", facts)
    assert files["board.py"] == (paths.BOARDS / "pico" / "board.py").read_bytes()
    assert files["lib/upright/fixmath.mpy"][:2] == b"M\x06"
    assert "lib/upright/fixmath.py" not in files
    assert "main.py" in files and "boot.py" not in files
    # of the filters the one that it runs, and that of a board.py that may stay
    assert "lib/upright/inertial.mpy" in files and "lib/upright/mahony.mpy" not in files
    assert "lib/upright/mahony.mpy" in contents.board_files(
        "pico", facts, own='FILTER = "mahony6"\n'
    )
    for name in (
        "lib/upright_app/doctor.mpy",
        "lib/upright_app/record.mpy",
        "lib/upright/mpu_selftest.mpy",
    ):
        assert name not in files
        assert name in contents.board_files("pico", facts, everything=True)
    with pytest.raises(console.Wrong, match="unknown board"):
        contents.board_files("abacus", facts)


def test_the_newest_mpy_cross_is_taken_that_the_board_understands(board):
    facts = device.facts(board())
    facts.architecture = "armv6m"
    newest = max(runtimes.MPY_CROSS_VERSIONS, key=lambda v: [int(x) for x in v.split(".")[:2]])
    assert contents.find_compiler(facts) == runtimes.mpy_cross(newest)
    facts.mpy_sub_version = 9
    with pytest.raises(device.DeviceError, match=r"no mpy-cross at hand for .mpy version 6\.9"):
        contents.find_compiler(facts)


def test_the_architecture_is_told_from_four_bits_whatever_flags_stand_above(board):
    transport = board()
    transport.exec(
        "import sys\nclass I: pass\n_i = I()\n_i.version = (1, 29, 0)\n_i._mpy = 1 << 16 | 11 << 10 | 0x306"
    )
    asked = transport.exec
    transport.exec = lambda code, *rest: asked(code.replace("sys.implementation", "_i"), *rest)
    assert device.facts(transport).architecture == "rv32imc"


def test_with_upright_in_the_firmware_only_main_and_board_are_installed(board):
    transport = board()
    transport.exec(
        "class U:\n    __version__ = '9.9'\n_import = __import__\n"
        "def __import__(name, *rest):\n    return U if name == 'upright' else _import(name, *rest)"
    )
    facts = device.facts(transport)
    assert facts.frozen == "9.9"
    assert set(contents.board_files("pico", facts)) == {"main.py", "board.py"}


@pytest.mark.parametrize("board_py, has, lacks", [
    ("", {"inertial", "inertial_tilt", "inertial_kalman"}, {"mahony", "ist8310", "dmp", "kalman", "mpu_selftest"}),
    ('FILTER = "kalman6"', {"kalman", "euler_kernels", "fixmath"}, {"inertial", "dmp"}),
    ('FILTER = "dmp6"\nfrom upright import mpu6500', {"dmp", "dmp_image", "mpu6500"}, {"mahony"}),
    ("FILTER = None\ndef f():\n    from upright import ist8310", {"inertial", "ist8310", "magnetometer"}, {"mahony"}),
    ("import os\nFILTER = os.environ", {"inertial", "mahony", "quaternion_kalman", "dmp"}, {"ist8310"}),
    ("from upright.mpu_selftest import run", {"inertial", "mpu_selftest"}, {"mahony"}),
])  # fmt: skip
def test_a_board_gets_the_library_that_it_needs(board_py, has, lacks):
    needed = contents.library(board_py)
    assert has <= needed and not lacks & needed
    assert {"__init__", "fixmath", "calibration", "ssd1306"} <= needed
    assert all((paths.PACKAGE / f"{module}.py").exists() for module in needed)


# ------------------------------------------------------------------------------------------ the board at hand


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


def test_what_the_emulated_board_needs_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "rp2040", None)
    with pytest.raises(runtimes.Unavailable, match=r"no emulated board: .*rp2040"):
        device.opened(None, emulated=True).__enter__()


def test_only_the_pico_is_emulated():
    done = CliRunner().invoke(cli.app, ["flash", "pico2", "--emulated"])
    assert done.exit_code == console.WRONG
    assert "a Pico, not pico2" in done.output
