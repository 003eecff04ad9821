"""The last faults with their times: noted in the tick, kept in a file by the application, told by the doctor."""

import kernel
import pytest
from conftest import healthy
from upright.black_box import ENTRIES, BlackBox

SECOND = 1000000


class Part:
    errors = resets = 0


@pytest.fixture
def part():
    return Part()


@pytest.fixture
def box(part):
    box = BlackBox(["errors", "resets", "missed"])
    box.watch({"errors": (part, "errors"), "resets": (part, "resets")})
    return box


def test_nothing_new_is_no_entry(box):
    box.look()
    assert box.entries() == []
    assert box.total == 0


def test_what_has_grown_is_noted_with_its_time(box, part):
    part.errors = 3
    box.look()
    kernel.advance(2 * SECOND)
    part.resets = 1
    box.look()
    kernel.advance(SECOND)
    assert box.entries() == [("errors", 3, 3.0, 3.0), ("resets", 1, 1.0, 1.0)]


def test_faults_of_a_kind_that_follow_each_other_are_one_entry(box, part):
    for _ in range(50):
        kernel.advance(SECOND // 10)
        part.errors += 2
        part.resets += 1
        box.look()
    assert box.entries() == [("errors", 100, 4.9, 0.0), ("resets", 50, 4.9, 0.0)]
    kernel.advance(2 * SECOND)
    part.errors += 1
    box.look()
    assert box.entries()[2] == ("errors", 1, 0.0, 0.0)


def test_the_last_32_stay_and_a_kind_that_was_pushed_out_begins_anew(box, part):
    part.resets = 1
    box.look()
    for _ in range(ENTRIES + 3):
        kernel.advance(2 * SECOND)
        part.errors += 1
        box.look()
    assert [entry[0] for entry in box.entries()] == ["errors"] * ENTRIES
    assert box.total == ENTRIES + 4
    part.resets = 2
    box.look()
    assert box.entries()[-1] == ("resets", 1, 0.0, 0.0)


def test_a_counter_that_wraps_is_noted_as_what_came(box, part):
    part.errors = (1 << 30) - 1
    box.look()
    part.errors = 1
    kernel.advance(2 * SECOND)
    box.look()
    assert box.entries()[1][1] == 2


def test_a_new_start_begins_at_its_counters_and_keeps_the_entries(box, part):
    part.errors = 5
    box.look()
    other = Part()
    box.watch({"errors": (other, "errors")})
    box.look()
    assert len(box.entries()) == 1


def test_a_look_that_interrupts_another_leaves_it_to_that_one(box, part):
    class Meddler:
        @property
        def errors(self):
            box.look()
            return 1

    box.watch({"errors": (part, "errors"), "resets": (part, "resets")})
    box._parts[0] = Meddler()
    box.look()
    assert box.entries() == [("errors", 1, 0.0, 0.0)]


def test_the_application_keeps_them_once_and_not_while_it_is_at_work(boot_board, tmp_path):
    flash = tmp_path / "flash"
    flash.mkdir()
    faults = [
        [4 * SECOND, "imu", "silent", SECOND // 2],
        [7 * SECOND, "display", "unplugged", SECOND],
    ]
    run = boot_board(seconds=14, flash=flash, faults=faults, board={"KEEP_BIAS": False})
    healthy(run.result)
    first, *lines = (flash / "upright_faults.txt").read_text().splitlines()
    assert "power-on" in first
    (line,) = [line for line in lines if " errors " in line]
    assert f"errors {run.result['errors']}, over 0.5 s" in line
    assert any("display_errors" in line for line in lines)


def test_without_faults_nothing_is_written(boot_board, tmp_path):
    flash = tmp_path / "flash"
    flash.mkdir()
    boot_board(seconds=20, flash=flash, board={"KEEP_BIAS": False})
    assert list(flash.iterdir()) == []


def test_a_disk_that_takes_nothing_is_told_and_not_asked_again_at_once(boot_board):
    faults = [[0, "board", "disk_full", None], [3 * SECOND, "imu", "silent", SECOND // 2]]
    run = boot_board(seconds=14, faults=faults)
    healthy(run.result)
    assert sum("faults: not kept" in line for line in run.lines) == 1


def test_the_doctor_tells_what_was_kept(tmp_path, monkeypatch, capsys):
    from upright_app import doctor

    monkeypatch.chdir(tmp_path)
    doctor._report_faults()
    assert "none kept" in capsys.readouterr().out
    (tmp_path / "upright_faults.txt").write_text("started by: watchdog\n1.0 s before: errors 3\n")
    doctor._report_faults()
    assert "errors 3" in capsys.readouterr().out
