"""The firmware on the simulated RoboMaster A: nine axes at 1 kHz, a magnetometer behind the IMU, and what goes wrong.

Every run is a process of its own on a runtime; faults are put in at their simulated time.
"""

import json

import numpy as np
import pytest
from conftest import healthy
from upright import calibration
from upright_host import scoring, simulate

SECOND = 1000000
BOARD = "robomaster_a"
FILTER = "mahony9"  # the figures are its


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The demo's motion: 8 s of it, at 1 kHz, with a typical sensor's errors."""
    import motions

    path = tmp_path_factory.mktemp("world") / "demo.imu"
    motion = motions.render("demo", rate=(1000, 1), seconds=8)
    motion.write(path)
    return path, motion


@pytest.fixture
def boot(boot_board, world):
    def run(runtime=None, flash=None, **config):
        config = {"board_name": BOARD, "world": str(world[0]), "seconds": 5} | config
        config["board"] = {"FILTER": FILTER} | config.get("board", {})
        return boot_board(runtime, flash, **config)

    return run


def error(world, run, since_us=0):
    """Score against the truth: heading as given, for nine axes know where north is."""
    motion = world[1]
    once = scoring.once(run.rows) & (run.times >= since_us)
    return scoring.score(
        run.rows[once] / 1000, run.q29[once] / scoring.ONE, motion.t, motion.q_true
    )


def first_after(run, at_us, bit):
    """Microseconds from a moment to the first step whose sample has this bit of the flags."""
    after = run.times[(run.times > at_us) & (run.flags & bit != 0)]
    assert len(after), f"never again bit {bit}"
    return after[0] - at_us


def longest_gap(run, bit, since_us=0):
    """The longest time in us between two steps whose samples have this bit of the flags."""
    return int(np.diff(run.times[(run.times >= since_us) & (run.flags & bit != 0)]).max())


def test_nine_axes_at_1_khz_on_every_runtime_with_the_same_bits(runtime, boot, world):
    run = boot(runtime)
    healthy(run.result)
    assert run.result["missed"] == run.result["errors"] == run.result["mag_errors"] == 0
    assert run.result["filter"] == FILTER
    assert run.result["chip"] == "MPU6500"
    assert run.result["mag_stale"] == 0
    seconds = len(run.times) / 1000
    assert abs(np.count_nonzero(run.flags & 2) - 100 * seconds) <= 2  # each sample once
    score = error(world, run)
    assert score.inclination < 0.6
    assert score.total < 1.5
    assert any("IST8310" in line for line in run.lines)
    if runtime != "cpython":
        there = boot("cpython")
        assert (run.rows == there.rows).all()
        assert (run.q29 == there.q29).all()
        assert run.picture == there.picture


@pytest.mark.parametrize(
    "drive",
    [{"DRIVE": "data_ready"}, {"DRIVE": "fifo", "FIFO_HZ": 200}],
    ids=["data_ready", "fifo"],
)
def test_the_other_drives_carry_the_magnetometer_too(boot, drive):
    run = boot(board=drive)
    healthy(run.result)
    assert run.result["missed"] == run.result["fifo_overflows"] == 0
    assert run.result["mag_stale"] == 0
    assert longest_gap(run, 2) <= 15000


def test_without_a_magnetometer_six_axes_go_on_and_it_is_said(boot, world):
    run = boot(mag=False)
    healthy(run.result)
    assert run.result["mag_fresh"] == 0
    assert any(line.startswith("magnetometer:") and "0x0e" in line for line in run.lines)
    assert error(world, run).inclination < 0.6


def test_a_magnetometer_that_appears_late_is_set_up_by_the_tick(boot):
    run = boot(
        world=None,
        seconds=8,
        faults=[[0, "mag", "vanish"], [6 * SECOND, "mag", "come_back"]],
    )
    healthy(run.result)
    assert first_after(run, 6 * SECOND, 2) < 500000


def test_a_magnetometer_that_vanishes_is_done_without_and_taken_up_again(boot, world):
    run = boot(
        seconds=6,
        faults=[[3 * SECOND, "mag", "vanish"], [4 * SECOND, "mag", "come_back"]],
    )
    healthy(run.result)
    gone = (run.times > 3020000) & (run.times < 4 * SECOND)
    assert not (run.flags[gone] & 2).any()
    assert (run.flags[gone] & 1).all()
    assert first_after(run, 4 * SECOND, 2) < 500000
    assert error(world, run).total < 2.0
    assert run.result["mag_errors"] > 0
    assert run.result["mag_stale"] > 50


def test_nack_storms_on_the_auxiliary_bus_cost_samples_of_the_magnetometer_alone(boot, world):
    faults = [[2 * SECOND + 41000 * i, "mag", "nack_next", 7] for i in range(40)]
    run = boot(faults=faults)
    healthy(run.result)
    assert longest_gap(run, 1, 2 * SECOND) <= 2000
    assert longest_gap(run, 2, 2 * SECOND) < 500000
    assert run.result["errors"] == 0
    assert error(world, run).total < 1.5


@pytest.mark.parametrize("drive", ["timer", "data_ready", "fifo"])
def test_an_imu_that_resets_itself_is_back_in_time_and_brings_the_magnetometer(boot, drive):
    run = boot(
        world=None,
        seconds=6,
        board={"DRIVE": drive, "FIFO_HZ": 200},
        faults=[[4 * SECOND, "imu", "brown_out"]],
    )
    healthy(run.result)
    assert run.result["resets"] == 1
    # from the reset on: the 20 ms that the chip itself is away are in it
    assert first_after(run, 4 * SECOND + 20000, 1) < 200000
    assert first_after(run, 4 * SECOND + 20000, 2) < 500000
    assert longest_gap(run, 2, 4 * SECOND + 600000) <= 20000


def test_the_attitude_and_the_bias_outlive_a_reset_of_both_chips(boot, world):
    run = boot(
        seconds=8,
        faults=[[5 * SECOND, "imu", "brown_out"], [5 * SECOND, "mag", "brown_out"]],
    )
    healthy(run.result)
    assert run.result["bias_known"]
    assert run.result["mag_resets"] >= 1
    assert first_after(run, 5 * SECOND + 20000, 2) < 500000
    score = error(world, run, 7 * SECOND)
    assert score.total < 6  # what it turned in the 0.1 s without samples is made up for slowly


def test_an_imu_that_nobody_hears_on_spi_is_counted_and_back_again(boot):
    run = boot(
        world=None,
        seconds=6,
        faults=[[4 * SECOND, "imu", "vanish"], [4300000, "imu", "come_back"]],
    )
    healthy(run.result)
    assert run.result["errors"] >= 250
    assert first_after(run, 4300000, 1) < 200000
    assert first_after(run, 4300000, 2) < 500000


def test_sampling_slower_than_the_chip_would_lose_magnetometer_samples_and_is_refused(boot):
    with pytest.raises(simulate.SimulationError, match="SENSOR_RATE_HZ"):
        boot(board={"RATE": 200, "SENSOR_RATE_HZ": 1000})


# Calibration


def write_calibration(flash, **sections):
    calibration.write(str(flash / "upright_cal.json"), calibration.blank() | sections)


@pytest.fixture
def iron(tmp_path):
    """The demo's motion with a hard iron of (20, -15, 25) uT beside the magnetometer."""
    import motions

    path = tmp_path / "iron.imu"
    errors = motions.Errors(mag_bias_uT=(20.0, -15.0, 25.0))
    motion = motions.render("demo", rate=(1000, 1), seconds=6, errors=errors)
    motion.write(path)
    return path, motion


@pytest.mark.parametrize(
    "content, said",
    [
        (None, "no such file"),
        (json.dumps(calibration.blank() | {"checksum": "00000000"}), "checksum"),
        (json.dumps({"format": "recipe", "version": 1}), "not of the format"),
    ],
    ids=["missing", "corrupt", "foreign"],
)
def test_a_calibration_file_that_cannot_be_used_means_defaults_and_a_message(
    boot, tmp_path, content, said
):
    if content is not None:
        (tmp_path / "upright_cal.json").write_text(content)
    run = boot(flash=tmp_path)
    healthy(run.result)
    assert any(line.startswith("calibration:") and said in line for line in run.lines)


def test_a_calibration_that_cannot_be_used_is_named_on_the_display_too(boot, tmp_path):
    """While it asks for stillness, the one time at which everybody looks."""
    pictures = []
    for content in ("{}", None):
        if content:
            (tmp_path / "upright_cal.json").write_text(content)
        else:
            write_calibration(tmp_path)
        run = boot(flash=tmp_path, seconds=1)
        assert not run.result["started"]
        pictures.append(run.picture)
    title_and_two_lines, note = slice(0, 32), slice(32, 44)
    assert pictures[0][title_and_two_lines] == pictures[1][title_and_two_lines]
    assert any(map(any, pictures[0][note]))
    assert not any(map(any, pictures[1][note]))


def test_hard_iron_turns_the_heading_until_it_is_calibrated_away(boot, iron, tmp_path):
    path, motion = iron
    spoilt = boot(world=str(path))
    # body (x, y, z) is chip (y, -x, -z) on this board; 0.3 uT a count in the world
    offset = [round(1000 * v / 0.3) for v in (15.0, 20.0, -25.0)]
    write_calibration(
        tmp_path, mag={"offset_mlsb": offset, "matrix_ppm": [10**6, 0, 0, 0, 10**6, 0, 0, 0, 10**6]}
    )
    mended = boot(world=str(path), flash=tmp_path)
    healthy(mended.result)
    assert "calibration: upright_cal.json" in mended.lines
    assert error((path, motion), spoilt).total > 10
    assert error((path, motion), mended).total < 1.5


def test_the_bias_of_the_file_is_used_when_the_board_never_rests(boot, tmp_path):
    import motions

    path = tmp_path / "spin.imu"
    motions.render("spin", rate=(1000, 1), seconds=8).write(path)
    write_calibration(tmp_path, gyro_bias_udps=[100000, -200000, 300000])
    run = boot(world=str(path), seconds=8, flash=tmp_path)
    healthy(run.result)
    assert run.result["bias_known"]
    assert "bias: from upright_cal.json" in run.lines
