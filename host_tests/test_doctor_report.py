"""What the doctor on the board finds out: INT line, FIFO, time of a step, the display's controller, a soft tick."""

from types import SimpleNamespace

import kernel
import machine
import pytest
from chips.mpu6050 import MPU6050Chip
from chips.ssd1306 import SSD1306Chip
from upright import ssd1306, timing
from upright.mpu6050 import MPU6050
from upright_app import doctor
from world import LEVEL, StillWorld


def board(panel="SSD1306 128x64", int_pin=6, hz=400_000, soft=False, **settings):
    """A board.py with an MPU6050 and a display on I2C 0."""
    i2c = machine.I2C(0, scl=machine.Pin(5), sda=machine.Pin(4), freq=hz, timeout=20_000)

    def make_tick(rate, callback):
        ticker = timing.make_tick(rate, callback)
        ticker.hard = not soft
        return ticker

    return SimpleNamespace(
        NAME="a board",
        sensor=lambda: MPU6050(i2c),
        display=lambda chunk: ssd1306.SSD1306(i2c, panel, chunk=chunk),
        data_ready_pin=lambda: machine.Pin(int_pin, machine.Pin.IN),
        make_tick=make_tick,
        CALIBRATION=None,
        **settings,
    )


def wire(sh1106=False, int_pin=6):
    chip = MPU6050Chip(StillWorld(LEVEL))
    display = SSD1306Chip(sh1106=sh1106)
    machine.wire_i2c(0, chip, 5, 4)
    machine.wire_i2c(0, display, 5, 4)
    machine.wire_pin(int_pin, chip)
    kernel.advance(200_000)
    return display


def test_all_is_measured(capsys):
    wire()
    assert doctor.report(board()) == []
    said = capsys.readouterr().out
    assert "INT line: 200 pulses/s of 200/1" in said
    assert "FIFO: 200 packets/s of 200/1, 0 overflows" in said
    assert "step: " in said and "of a period of 5000" in said
    assert "display: SSD1306 128x64 answers like an SSD1306" in said


@pytest.mark.parametrize(
    "named, sh1106, wanted",
    [("SSD1306", True, "SH1106"), ("SH1106", False, "SSD1306"), ("SH1106", True, None)],
)
def test_another_controller_than_board_py_names_is_found(named, sh1106, wanted):
    display = wire(sh1106)
    problems = doctor.report(board(f"{named} 128x64"))
    assert problems == [] if wanted is None else f'set "{wanted} 128x64"' in problems[0]
    assert wanted or display.errors == []


def test_a_frame_shows_whether_the_panel_has_the_size_and_offset_of_board_py():
    display = wire()
    doctor.report(board())
    rows = display.picture()
    assert all(rows[0]) and all(rows[-1])
    assert all(row[0] and row[-1] for row in rows)


def test_the_frame_of_the_wrong_panel_is_two_columns_too_far_to_the_left():
    display = wire(sh1106=True)
    doctor.report(board())
    rows = display.picture()
    assert not all(row[0] for row in rows) and all(row[125] for row in rows)


def test_an_int_line_that_is_not_wired_matters_to_the_drive_that_needs_it(capsys):
    wire()
    assert doctor.report(board(int_pin=9)) == []
    assert 'INT line: 0 pulses/s of 200/1 (needed only with DRIVE = "data_ready")' in (
        capsys.readouterr().out
    )
    (problem,) = doctor.report(board(int_pin=9, DRIVE="data_ready"))
    assert "is INT wired to the pin of data_ready_pin()?" in problem


@pytest.mark.parametrize("wired", ["PE1", "elsewhere"])
def test_the_pin_that_int_is_wired_to_is_found_among_all(monkeypatch, capsys, wired):
    wire(int_pin=wired)
    names = [port + str(n) for port in "ABCDE" for n in range(16)]
    pins = {name: machine.Pin("P" + name) for name in names}
    pins["B2"].on()  # always
    monkeypatch.setattr(machine.Pin, "cpu", SimpleNamespace(**pins), raising=False)
    (problem,) = doctor.report(board(int_pin="PB8", DRIVE="data_ready"))
    found = wired == "PE1"
    assert ("return Pin.cpu.E1 in data_ready_pin()" in problem) == found
    assert ("samples are seen at Pin.cpu.E1\n" in capsys.readouterr().out) == found


def test_a_bus_that_is_too_slow_for_the_fifo_is_found():
    wire()
    problems = doctor.report(board(hz=20_000, RATE=200, DRIVE="fifo", FIFO_HZ=50))
    assert any("FIFO: " in problem and "choose a lower RATE" in problem for problem in problems)


def test_a_step_that_is_longer_than_its_period_is_found():
    wire()
    problems = doctor.report(board(hz=20_000))
    assert any("step" in problem and "RATE" in problem for problem in problems), problems


def test_a_soft_tick_is_a_problem_only_where_it_keeps_the_time():
    wire()
    assert doctor.report(board(soft=True)) == []
    (problem,) = doctor.report(board(soft=True, DRIVE="timer"))
    assert 'DRIVE = "fifo"' in problem
