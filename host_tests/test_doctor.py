"""`upright doctor` and `upright record`: on a simulated board, and from the RAM of one."""

import pytest
from conftest import some_micropython
from typer.testing import CliRunner
from unix_board import UnixBoard
from upright_host import (
    cli,
    console,
    contents,
    device,
    doctor,
    paths,
    ram,
    record,
    recordings,
    runtimes,
)

FACTS = device.Facts("rp2", "Pico", (1, 26, 1), 6, 3, "armv6m", True, False, True, True, 900000)


BOARD = b"""
PLATFORM = "linux"
NAME = "a board"
RATE = 100
def sensor():
    raise OSError("nobody at 0x68")
def display(chunk):
    return None
def make_tick(rate, callback):
    raise ValueError("no timer here")
"""
# A sensor that gives a sample whenever 10 ms have gone by
SENSOR = b"""
import time
from array import array
from upright import settings
NAME = "a board"
class Imu:
    chip, sample_rate, accel_lsb_per_g, gyro_scale = "MPU6050", (100, 1), 4096, (82, 5)
    errors = 0
    def __init__(self):
        self.counts = array("h", [0] * 11)
        self.at = time.ticks_us()
    def configure(self, *a, **k):
        pass
    def health(self):
        pass
    def read(self):
        self.counts[10] = 0
        if time.ticks_diff(time.ticks_us(), self.at) >= 10000:
            self.at = time.ticks_us()
            self.counts[2], self.counts[10] = 4096, 1
        return self.counts[10]
def sensor():
    return Imu()
"""


@pytest.fixture
def unix(tmp_path):
    """unix(files) -> a board with these files, which has to end up with these files and no others."""
    some_micropython()
    made = []
    folder = tmp_path / "flash"
    folder.mkdir()

    def listing():
        return {
            str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()
        }

    def make(files):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        made.append((UnixBoard(folder), files))
        return made[0][0]

    yield make
    for board, files in made:
        board.close()
        assert listing() == files


def modules(*names):
    return {f"lib/upright/{name}.py": (paths.PACKAGE / f"{name}.py").read_bytes() for name in names}


@pytest.mark.slow
def test_a_healthy_simulated_board():
    done = CliRunner().invoke(cli.app, ["doctor", "--simulated", "robomaster_a"])
    assert done.exit_code == 0, done.output
    assert "all is well" in done.output
    assert "sensor: MPU6500, 1000/1 Hz" in done.output
    assert "magnetometer: IST8310, 100/1 Hz" in done.output
    assert "tick: " in done.output and "1000 Hz of 1000/1" in done.output


@pytest.mark.parametrize(
    ("part", "said", "address"), [("imu", "sensor:", ""), ("mag", "magnetometer:", "0x0e")]
)
def test_what_does_not_answer_is_reported(part, said, address):
    lines = []
    problems = doctor.examine_simulated("robomaster_a", "cpython", lines.append, **{part: False})
    assert any(problem.startswith(said) and address in problem for problem in problems)
    text = "\n".join(lines)
    assert f"PROBLEM: {said}" in text and "all is well" not in text


def test_the_report_is_made_on_every_runtime(runtime):
    lines = []
    doctor.examine_simulated("sim", runtime, lines.append)
    text = "\n".join(lines)
    assert "sensor: MPU6050, 1000/1 Hz" in text
    assert runtime == "cpython" or "bytes free" in text


@pytest.mark.parametrize("folder", sorted(p.parent.name for p in paths.BOARDS.glob("*/board.py")))
def test_every_board_boots_its_parts_in_simulation(folder):
    """What its board.py constructs is there, and the timer that it asks for can be had."""
    lines = []
    assert doctor.examine_simulated(folder, "cpython", lines.append) == []
    assert any("soft" in line for line in lines) == folder.startswith("esp32")


LACKS = "inertial.py is not on this board"


@pytest.mark.parametrize(
    "there, said",
    [
        ((), LACKS),
        (("__init__",), LACKS),
        (("__init__", "settings", "mpu_monitor", "mpu_parts"), LACKS),
        (contents.library(BOARD.decode()), "nobody at 0x68"),
    ],
)
def test_the_doctor_runs_from_ram_with_what_the_board_lacks(unix, there, said):
    lines = []
    transport = unix({"board.py": BOARD} | modules(*there))
    problems = doctor.examine(transport, False, False, lines.append)
    assert problems[0] == "this build of MicroPython has no timer"
    assert any(said in problem for problem in problems[1:]), problems
    assert lines[1].startswith("a board, micropython 1.")
    assert ("tick: no timer here" in problems) == (said != LACKS)


def test_without_a_compiler_the_doctor_goes_over_as_sources(unix, monkeypatch):
    def offline(version):
        raise runtimes.Unavailable("no network")

    monkeypatch.setattr(runtimes, "mpy_cross", offline)
    lines = []
    files = {"board.py": BOARD} | modules(*contents.library(BOARD.decode()))
    doctor.examine(unix(files), False, False, lines.append)
    assert any("PROBLEM: sensor: nobody at 0x68" in line for line in lines), lines


def test_the_self_test_is_there_for_the_doctor_though_no_installation_has_it(unix):
    transport = unix({"board.py": BOARD} | modules("__init__", "settings"))
    doctor.examine(transport, False, False, print)
    transport.exec("from upright import mpu_selftest\nprint(mpu_selftest.run)")


def test_a_board_without_a_board_py_or_for_another_port_is_named(unix):
    with pytest.raises(device.DeviceError, match="upright flash"):
        doctor.examine(unix({}), False, False, print)


def test_a_board_py_for_another_port_is_named(unix):
    problems = doctor.examine(
        unix({"board.py": BOARD.replace(b"linux", b"esp32")}), False, False, print
    )
    assert "board.py is for the port 'esp32', this is 'linux'" in problems


def test_a_board_py_that_works_out_its_port_is_examined(unix):
    own = BOARD.replace(b'"linux"', b"str(1)")
    assert own != BOARD
    assert "tick: no timer here" in doctor.examine(
        unix({"board.py": own} | modules(*contents.library(own.decode()))), False, False, print
    )


def test_lines_of_a_board_are_passed_on_as_they_come_in_whatever_pieces():
    plain, marked = [], []
    lines = doctor.Lines({"\x1e": marked.append}, plain.append)
    for piece in (b"heap: 1", b"00 bytes\r\nsen", b"sor: x\r\n\x1e['bad']\r\n"):
        lines.feed(piece)
    assert plain == ["heap: 100 bytes", "sensor: x"]
    assert marked == ["['bad']"]


def test_the_check_of_the_axes_is_asked_for_by_its_hemisphere(monkeypatch):
    ran = []

    class Board:
        def fs_readfile(self, name):
            return b""

        def exec(self, code, data_consumer=None):
            ran.append(code)
            if data_consumer:
                data_consumer(b"\x1e[]\n")

    monkeypatch.setattr(device, "facts", lambda transport: FACTS)
    monkeypatch.setattr(ram, "load", lambda *a: None)
    assert doctor.examine(Board(), True, True, print) == []
    assert "guided.axes(board, True)" in ran[-1]


def test_a_recording_comes_over_the_line_and_nothing_is_written_to_the_board(unix, tmp_path):
    lines = []
    transport = unix({"board.py": SENSOR} | modules("__init__", "settings"))
    file = tmp_path / "rest.imu"
    size = record.record(transport, file, 1, 100, lines.append)
    found = recordings.load(file)
    assert file.stat().st_size == size
    assert len(found.counts) == 100  # a sample that was missed on a busy machine has its row, too
    accel, gyro = found.inertial()
    assert (found.rate, found.chip, found.board) == (100, "MPU6050", "a board")
    assert {tuple(row) for row in accel.tolist()} == {(0.0, 0.0, 1.0)} or accel[:, 2].std() == 0
    assert not gyro.any()
    assert "done" in lines and any("rows" in line for line in lines)


@pytest.mark.parametrize("which", [("--simulated", "sim"), ("--emulated",)])
def test_nobody_turns_a_simulated_board(which):
    done = CliRunner().invoke(cli.app, ["doctor", *which, "--axes"])
    assert done.exit_code == console.WRONG
    assert "real one" in done.output
