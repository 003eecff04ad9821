"""What a board of boards/ gets by default fits its own file system, with 8 kB to spare, as MicroPython makes it."""

import pytest
from conftest import some_micropython
from unix_board import UnixBoard
from upright_host import __version__, contents, device, flash, paths

# Of boards that boot, the file system that MicroPython makes: kind, bytes of a block, blocks. pyboard: 112 KiB of FAT,
# 97,280 bytes of them for files. weact_f411_blackpill: 64 KiB, 48,128. The others: mpconfigboard.h and partition
# tables of the ports; robomaster_a: ours.
DISKS = {
    "esp32": ("VfsLfs2", 4096, 512),
    "esp32_c3": ("VfsLfs2", 4096, 512),
    "esp32_s3": ("VfsLfs2", 4096, 512),
    "pico": ("VfsLfs2", 4096, 352),
    "pico2": ("VfsLfs2", 4096, 640),
    "pico2_w": ("VfsLfs2", 4096, 640),
    "gy87_pico": ("VfsLfs2", 4096, 352),
    "mpu9250_pico": ("VfsLfs2", 4096, 352),
    "pico_w": ("VfsLfs2", 4096, 212),
    "pyboard": ("VfsFat", 512, 224),
    "robomaster_a": ("VfsFat", 512, 512),
    "weact_f411_blackpill": ("VfsFat", 512, 128),
}
TOO_SMALL = ("weact_f411_blackpill",)


class Facts(device.Facts):
    """Of a board in the simulator's place."""

    def problems(self):
        return []


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """fresh(board) -> one with its file system as MicroPython makes it, empty."""
    some_micropython()
    made = []

    def make(board):
        made.append(UnixBoard(tmp_path, disk=DISKS[board]))
        architecture = contents.ARCHITECTURES[board]
        facts = Facts(
            contents.platform(board),
            "",
            (1, 27, 0),
            6,
            3,
            architecture,
            True,
            True,
            True,
            True,
            0,
            True,
        )
        monkeypatch.setattr(device, "facts", lambda transport: facts)
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_every_board_has_its_file_system_here():
    boards = {path.parent.name for path in paths.BOARDS.glob("*/board.py")} - {"sim"}
    assert set(DISKS) == boards == set(contents.ARCHITECTURES)


@pytest.mark.slow
@pytest.mark.parametrize("board", sorted(set(DISKS) - {*TOO_SMALL}))
def test_the_default_of_a_board_fits_its_file_system_with_room_to_spare(board, fresh):
    transport = fresh(board)
    assert flash.run(transport, board, source=False, force=False)
    _, free = device.space(transport)
    assert free >= flash.SPARE
    # and again, which changes nothing
    assert not flash.run(transport, board, source=False, force=False)


@pytest.mark.parametrize("board", TOO_SMALL)
def test_a_board_that_cannot_hold_it_is_refused_before_anything_is_written(board, fresh):
    transport = fresh(board)
    _, before = device.space(transport)
    assert before == 48128
    with pytest.raises(device.DeviceError, match=r"do not fit: 48128 are free.* freeze Upright"):
        flash.run(transport, board, source=False, force=False)
    assert device.space(transport)[1] == before
    assert transport.fs_listdir("") == []


def test_the_pyboards_file_system_is_the_one_that_its_readme_names(fresh):
    assert device.space(fresh("pyboard"))[1] == 97280
    assert "97,280" in (paths.BOARDS / "pyboard" / "README.md").read_text()


def test_a_packed_installation_is_imported_as_any_other(tmp_path):
    some_micropython()
    board = UnixBoard(tmp_path, disk=DISKS["robomaster_a"])
    try:
        facts = device.facts(board)
        assert facts.deflate
        files = contents.packed(contents.board_files("pyboard", facts))
        assert not [name for name in files if name.endswith(".mpy")]
        flash.execute(board, flash.plan(board, files))
        board.exec("import upright\nfrom upright import fixmath, mahony\nimport upright.ssd1306")
        board.exec("from upright_app import pages")
        assert board.eval("fixmath.isqrt(49)") == 7
        assert board.eval("upright.__version__") == __version__
        assert board.eval("mahony.__file__") == "/upright_z/upright/mahony.mpy"
        assert board.eval("pages.__name__") == "upright_app.pages"
    finally:
        board.close()
