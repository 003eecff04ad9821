"""`upright doctor`: on a simulated board, and on one whose answers are scripted."""

import pytest
from typer.testing import CliRunner
from upright_host import cli, device, doctor, paths

FACTS = device.Facts("rp2", "Pico", (1, 26, 1), 6, 3, "armv6m", True, False, True, True, 900000)


class Board:
    """Answers as a board with the firmware on it."""

    def __init__(self, files, said):
        self.files = files
        self.said = said
        self.ran = []

    def fs_exists(self, name):
        return name in self.files

    def fs_readfile(self, name):
        return self.files[name]

    def exec(self, code, data_consumer=None):
        self.ran.append(code)
        for piece in self.said:
            data_consumer(piece)


@pytest.fixture
def known(monkeypatch):
    monkeypatch.setattr(device, "facts", lambda transport: FACTS)


def test_a_healthy_simulated_board_and_one_without_its_magnetometer():
    done = CliRunner().invoke(cli.app, ["doctor", "--simulated", "robomaster_a"])
    assert done.exit_code == 0, done.output
    assert "all is well" in done.output
    lines = []
    problems = doctor.examine_simulated("robomaster_a", "cpython", lines.append, mag=False)
    assert any("0x0e" in problem for problem in problems)
    assert any("PROBLEM" in line for line in lines)


@pytest.mark.parametrize("folder", sorted(p.parent.name for p in paths.BOARDS.glob("*/board.py")))
def test_every_board_boots_its_parts_in_simulation(folder):
    """What its board.py constructs is there, and the timer that it asks for can be had."""
    lines = []
    problems = doctor.examine_simulated(folder, "cpython", lines.append)
    if folder == "esp32":
        (problem,) = problems
        assert "no hard timer" in problem
    else:
        assert problems == []


def test_lines_of_a_board_are_passed_on_as_they_come_in_whatever_pieces(known):
    board = Board(
        {"board.py": b'PLATFORM = "rp2"', "lib/upright_app/doctor.mpy": b""},
        [b"heap: 1", b"00 bytes\r\nsen", b"sor: x\r\n\x1e['bad']\r\n"],
    )
    lines = []
    assert doctor.examine(board, False, False, lines.append) == ["bad"]
    assert lines[1:] == ["heap: 100 bytes", "sensor: x"]
    assert "doctor.report(board)" in board.ran[0]


def test_the_check_of_the_axes_is_asked_for_by_its_hemisphere(known):
    board = Board({"board.py": b"", "lib/upright_app/doctor.py": b""}, [b"\x1e[]\n"])
    assert doctor.examine(board, True, True, print) == []
    assert "doctor.axes(board, True)" in board.ran[0]


def test_a_board_without_the_firmware_or_with_that_of_another_is_named(known):
    with pytest.raises(device.DeviceError, match="upright flash"):
        doctor.examine(Board({}, []), False, False, print)
    board = Board(
        {"board.py": b'PLATFORM = "esp32"', "lib/upright_app/doctor.mpy": b""}, [b"\x1e[]\n"]
    )
    assert doctor.examine(board, False, False, print) == [
        "board.py is for the port 'esp32', this is 'rp2'"
    ]


@pytest.mark.parametrize("which", [("--simulated", "sim"), ("--emulated",)])
def test_nobody_turns_a_simulated_board(which):
    done = CliRunner().invoke(cli.app, ["doctor", *which, "--axes"])
    assert done.exit_code == 1
    assert "real one" in done.output
