"""The whole firmware on the simulated board: it boots, it is right, and it survives what goes wrong.

Every run is a process of its own on a runtime; faults are put in at their simulated time.
"""

import motions
import numpy as np
import pytest
from conftest import healthy
from upright import calibration
from upright_host import demo, scoring, simulate
from world import write_imu

SECOND = 1000000


@pytest.fixture
def boot(boot_board, demo_world):
    """boot(**config) -> Boot, in the demo's world where no other is asked for."""

    def run(runtime=None, **config):
        return boot_board(runtime, **({"world": str(demo_world[0])} | config))

    return run


def dark(picture):
    return not any(any(row) for row in picture)


def test_it_boots_and_is_right_on_every_runtime_with_the_same_bits(
    firmware_runtime, boot, demo_world
):
    run = boot(firmware_runtime, seconds=6)
    healthy(run.result)
    assert run.result["missed"] == run.result["errors"] == 0
    assert run.result["bias_known"]
    assert run.result["ticker"] == "machine.Timer, hard"
    assert abs(run.result["steps"] - 200 * (6 - run.rows[0] / 1000)) <= 2
    score = run.score(demo_world[1])
    assert score.inclination < 0.6
    assert score.aligned_total < 1.0
    assert any("MPU6050" in line for line in run.lines)
    assert not dark(run.picture)
    if firmware_runtime != "cpython":
        there = boot("cpython", seconds=6)
        assert (run.rows == there.rows).all()
        assert (run.q29 == there.q29).all()
        assert run.picture == there.picture


@pytest.mark.slow
@pytest.mark.parametrize("own_bus", [False, True], ids=["shared", "separate"])
def test_no_transfer_cuts_into_another_in_ten_minutes(boot, own_bus):
    """And the failing twin below shows that it would be noticed."""
    result, *_ = boot(
        seconds=600, world=None, frame_ms=0, board={"DISPLAY_SHARES_BUS": not own_bus, "RATE": 100}
    )
    healthy(result)
    assert result["steps"] > 59000
    assert result["missed"] == 0
    assert result["display_errors"] == 0
    assert result["bus_bytes"][1 if own_bus else 0] > 50000  # the display was written all the time


def test_a_display_written_by_the_main_program_on_the_sensors_bus_cuts(boot):
    result, *_ = boot(seconds=10, twin="main_writes_shared_bus")
    assert result["cuts"] > 0


def test_1_khz_with_a_display_on_its_own_bus(boot, demo_world):
    run = boot(seconds=5, board={"RATE": 1000, "DISPLAY_SHARES_BUS": False}, irq_cost_us=200)
    healthy(run.result)
    assert run.result["missed"] == 0
    assert run.result["steps"] > 3000
    assert run.score(demo_world[1]).inclination < 0.6


def test_a_tick_that_takes_longer_than_its_period_is_noticed(boot):
    result, *_ = boot(seconds=4, board={"RATE": 1000, "DISPLAY_SHARES_BUS": False}, irq_cost_us=900)
    assert result["missed"] > 500  # every other tick
    assert result["crashes"] == 0


@pytest.mark.parametrize(
    "drive",
    [
        {"DRIVE": "data_ready", "SENSOR_RATE_HZ": 200},
        {"DRIVE": "fifo", "SENSOR_RATE_HZ": 200, "FIFO_HZ": 50},
    ],
    ids=["data_ready", "fifo"],
)
def test_the_other_drives_are_as_right(boot, demo_world, drive):
    run = boot(seconds=10, board=drive)
    healthy(run.result)
    assert run.result["missed"] == 0
    assert run.result["fifo_overflows"] == 0
    if drive["DRIVE"] == "data_ready":
        score = run.score(demo_world[1])
        assert score.inclination < 0.6
        assert score.aligned_total < 1.0
    else:
        # several packets a tick: the last one is the newest sample; only the end is compared
        assert abs(run.result["steps"] / 200 - (10 - run.rows[0] / 1000)) < 0.3
        q = run.q29[-1] / scoring.ONE
        true = demo_world[1].q_true[run.rows[-1]]
        assert abs(np.degrees(2 * np.arccos(min(1, abs(q @ true))))) < 3


def test_without_a_sensor_it_says_so_and_waits_for_one(boot):
    result, lines, picture, *_ = boot(imu=False, seconds=3)
    assert not result["started"]
    assert any("0x68" in line for line in lines)
    assert sum("sensor:" in line for line in lines) >= 2  # it looks again
    assert not dark(picture)


def test_a_sensor_that_appears_late_is_used(boot):
    result, lines, *_ = boot(
        seconds=6,
        world=None,
        faults=[[0, "imu", "silent", 2 * SECOND]],
    )
    healthy(result)
    assert result["steps"] > 200
    assert any("sensor:" in line and "0x68" in line for line in lines)


def test_a_wrong_chip_is_named_with_what_it_answered(boot):
    result, lines, *_ = boot(who_am_i=0x33, seconds=2)
    assert not result["started"]
    assert any("0x33" in line for line in lines)


@pytest.mark.parametrize("identity", [0x70, 0x71, 0x98])
def test_the_clones_work(boot, demo_world, identity):
    run = boot(who_am_i=identity, seconds=6)
    healthy(run.result)
    assert run.score(demo_world[1]).inclination < 0.6


def test_it_goes_on_without_a_display_and_with_one_that_appears(boot):
    result, lines, *_ = boot(display=False, seconds=4)
    healthy(result)
    assert any("display:" in line and "0x3" in line for line in lines)
    result, lines, picture, *_ = boot(seconds=6, faults=[[0, "display", "silent", 3 * SECOND]])
    healthy(result)
    assert result["missed"] == 0
    assert not dark(picture)


def test_a_display_that_loses_its_power_for_a_moment_is_lit_again(boot):
    result, _, picture, *_ = boot(seconds=8, faults=[[4 * SECOND, "display", "unplugged", SECOND]])
    healthy(result)
    assert result["display_errors"] > 0
    assert not dark(picture)


def test_a_sensor_that_stops_answering_is_counted_coasted_and_back_again(boot):
    result, *_ = boot(
        seconds=8,
        faults=[[3 * SECOND, "imu", "silent", SECOND // 10]],
    )
    healthy(result)
    assert 15 <= result["errors"] <= 60  # 0.1 s at 200 Hz, a read and a look at the registers each
    assert result["missed"] == 0
    assert result["fresh"] < result["steps"]


def test_nacks_in_the_middle_of_bursts_are_survived(boot, demo_world):
    faults = [[2 * SECOND + 37000 * i, "imu", "nack", None, 1, i % 3] for i in range(60)]
    run = boot(seconds=6, faults=faults)
    healthy(run.result)
    assert run.result["errors"] >= 50
    assert run.score(demo_world[1]).inclination < 0.7


@pytest.mark.parametrize("drive", ["timer", "data_ready", "fifo"])
@pytest.mark.parametrize(
    "fault, resets, without", [("brown_out", (0, 1), 100), ("jam", (1, 0), 300)]
)
def test_a_chip_that_needs_a_reset_is_put_right_in_flight(boot, drive, fault, resets, without):
    """Brown-out: asleep and unconfigured, then rewritten register by register by the tick. Jam: no samples any more."""
    result, *_ = boot(
        seconds=6,
        board={"DRIVE": drive, "SENSOR_RATE_HZ": 200},
        faults=[[3 * SECOND, "imu", fault, None]],
    )
    healthy(result)
    assert result["resets"] == resets[1]
    assert fault == "brown_out" or result["full_resets"] == resets[0]
    expected = result["steps"] if drive == "timer" else 200 * (result["ended_us"] / SECOND - 1.4)
    assert result["fresh"] > expected - without  # half a second, and a second and a half


@pytest.mark.parametrize("drive", ["timer", "data_ready", "fifo"])
def test_a_sensor_that_is_gone_for_good_is_shown_on_the_display(boot, drive):
    config = {"seconds": 5, "board": {"DRIVE": drive, "SENSOR_RATE_HZ": 200, "PAGE_SECONDS": 0}}
    *_, well = boot(**config)[:3]
    result, _, picture, *_ = boot(**config, faults=[[3 * SECOND, "imu", "silent", None]])
    healthy(result)
    lit = [sum(map(sum, rows[-8:])) for rows in (well, picture)]
    assert lit[1] > lit[0] + 300  # the status line is inverse


def test_a_stuck_bus_costs_time_not_the_program(boot):
    result, *_ = boot(seconds=6, faults=[[3 * SECOND, "bus", "low", SECOND]])
    healthy(result)
    assert result["errors"] > 50  # ticks after a time-out of a period are left out
    assert result["missed"] == 0  # a transfer is given up after 5 ms, and a tick tries one
    assert result["fresh"] > 700


FAULTS = (
    *("missed", "crashes", "step_errors", "errors", "resets", "fifo_overflows", "display_errors"),
    *("full_resets", "mag_errors", "mag_resets"),
)


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        (
            "fifo_overflows",
            {
                "board": {"DRIVE": "fifo", "SENSOR_RATE_HZ": 200, "FIFO_HZ": 50},
                "faults": [[3 * SECOND, "bus", "low", 3 * SECOND // 2]],
            },
        ),
        (
            "mag_resets",
            {"board_name": "robomaster_a", "faults": [[3 * SECOND, "mag", "brown_out", None]]},
        ),
    ],
)
def test_every_kind_of_fault_is_in_the_count_that_the_display_shows(boot, kind, config):
    result, *_ = boot(seconds=6, **config)
    assert result["started"]
    assert result[kind] > 0
    assert result["faults"] == sum(result[name] for name in FAULTS if name in result)


@pytest.mark.parametrize(("counts", "known"), [(327, True), (331, False)])
def test_a_bias_that_no_sensor_has_is_taken_for_motion(boot, tmp_path, counts, known):
    """PS 6.1: the zero-rate output is within 20 deg/s, 328 counts."""
    path = tmp_path / "turning.imu"
    row = np.array([0, 0, 4096, counts, -counts, counts, 0, 0, 0, 0, 0], "<i2")
    write_imu(path, row.tobytes() * 2, "turning", (1, 2), 4096, (82, 5), False)
    result, lines, *_ = boot(world=str(path), seconds=3, board={"KEEP_BIAS": False})
    assert any("never at rest" in line for line in lines) is not known
    assert result["bias_known"] is known


def test_a_board_that_never_rests_goes_on_flagged(boot, tmp_path):
    path = tmp_path / "hand.imu"
    motions.render("spin", rate=(1000, 1), seconds=8).write(path)
    result, lines, *_ = boot(world=str(path), seconds=8)
    healthy(result)
    assert not result["bias_known"]
    assert any("never at rest" in line for line in lines)


def test_a_slow_chip_gives_enough_samples_for_its_bias(boot):
    result, *_ = boot(
        seconds=5,
        board={"RATE": 50, "SENSOR_RATE_HZ": 50, "DRIVE": "data_ready", "FILTER": "mahony6"},
    )
    healthy(result)
    assert result["bias_known"]
    assert result["missed"] == 0


def test_a_setting_with_a_slip_of_the_pen_is_refused(boot):
    with pytest.raises(simulate.SimulationError, match="RATEE"):
        boot(board={"RATEE": 100})


@pytest.mark.parametrize(
    "settings, said",
    [
        ({"RATE": 700}, "cannot tick at"),
        ({"DRIVE": "telepathy"}, 'DRIVE is .telepathy., expected "timer"'),
        ({"EULER": "xyz"}, "EULER is 'xyz'"),
        ({"IMU_AXES": ["x", "x", "z"]}, "imu_axes are"),
        ({"RATE": 500, "DRIVE": "fifo"}, "FIFO_HZ 63"),
        ({"SENSOR_RATE_HZ": 100}, "SENSOR_RATE_HZ is 100"),
        ({"RATE": 1400, "DRIVE": "data_ready", "FILTER": "mahony6"}, "sample_rate_hz"),
        (
            {"RATE": 4000, "SENSOR_RATE_HZ": 8000, "DLPF": 0, "FILTER": "mahony6"},
            "a step takes 4.. us .4.. of them the bus., RATE leaves 250",
        ),
        ({"EULER": "xyz", "PAGE_SECONDS": -1, "GAINS": 7}, "EULER.*PAGE_SECONDS"),  # all at once
        ({"FILTER": "magic"}, "unknown filter"),
        ({"ACCEL_RANGE_G": 3}, "ACCEL_RANGE_G is 3, expected 2, 4, 8 or 16"),
        ({"GAINS": {"kp": 0.5}}, "kp"),  # of another filter than the default
        ({"FILTER": "mahony6", "GAINS": {"kp": 1000.0}}, "kp"),
        ({"RATE": 50}, "rate"),
    ],
)
def test_a_setting_that_cannot_be_had_stops_the_start_with_a_reason(boot, settings, said):
    with pytest.raises(simulate.SimulationError, match=said):
        boot(board=settings)


def test_the_demo_is_as_good_as_it_says():
    source = demo.motion_source("demo", 10)
    outcome = demo.run(source, simulate.best_runtime())
    assert outcome.score.inclination < 0.6
    assert outcome.score.coverage > 0.8
    text = "\n".join(demo.summary(outcome))
    assert "RMSE" in text
    assert "missed 0" in text


# -- a filter that learns the bias: nobody waits for it, the status page shows it, and the next start has it
INERTIAL = {"FILTER": "inertial6", "PAGE_SECONDS": 0}


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """25 s of rest with a typical sensor's errors: a bias of 1.2, -0.8, 0.6 deg/s."""
    path = tmp_path_factory.mktemp("world") / "still.imu"
    motions.render("static", rate=(200, 1), seconds=25).write(path)
    return path


def bias_of(flash):
    fields = calibration.read(str(flash / "upright_cal.json"))
    return [v / 1e6 for v in fields["gyro_bias_udps"]]


def test_at_rest_it_is_kept_once_and_used_at_the_next_start(boot_board, still, tmp_path):
    flash = tmp_path / "flash"
    flash.mkdir()
    board = INERTIAL | {"MEASURE_BIAS": False}
    run = boot_board(world=str(still), seconds=22, board=board, flash=flash)
    assert run.result["crashes"] == run.result["missed"] == 0
    assert [line for line in run.lines if line.startswith("bias:")] == [
        "bias: kept in upright_cal.json"
    ]
    assert bias_of(flash) == pytest.approx([1.2, -0.8, 0.6], abs=0.05)
    again = boot_board(world=str(still), seconds=16, board=board, flash=flash)
    assert "bias: from upright_cal.json" in again.lines
    assert again.result["bias_known"]
    assert not any("kept" in line for line in again.lines)  # it has not changed
    assert again.times[0] < run.times[0] + 100000


def test_the_rest_of_the_calibration_file_stays(boot_board, still, tmp_path):
    flash = tmp_path / "flash"
    flash.mkdir()
    accel = {"offset_ug": [100, 200, 300], "matrix_ppm": [10**6, 0, 0, 0, 10**6, 0, 0, 0, 10**6]}
    calibration.write(str(flash / "upright_cal.json"), calibration.blank() | {"accel": accel})
    boot_board(world=str(still), seconds=16, board=INERTIAL | {"MEASURE_BIAS": False}, flash=flash)
    fields = calibration.read(str(flash / "upright_cal.json"))
    assert fields["accel"] == accel
    assert fields["gyro_bias_udps"] is not None


@pytest.mark.parametrize("settings", [{"KEEP_BIAS": False}, {"FILTER": "mahony6"}])
def test_it_is_not_kept_where_nobody_learns_or_wants_it(boot_board, still, tmp_path, settings):
    flash = tmp_path / "flash"
    flash.mkdir()
    boot_board(world=str(still), seconds=16, board=INERTIAL | settings, flash=flash)
    assert list(flash.iterdir()) == []


def test_it_starts_in_motion_without_waiting_and_is_right(boot_board, tmp_path):
    path = tmp_path / "hand.imu"
    motion = motions.render("hand", rate=(200, 1), seconds=14)
    motion.write(path)
    run = boot_board(world=str(path), seconds=14, board=INERTIAL)
    assert run.result["started"]
    assert run.times[0] < 2000000  # one try of a second, not four
    assert run.score(motion, since_us=6000000).inclination < 1.0


def test_the_status_page_tells_of_rest_field_and_bias(boot_board, still):
    pictures = []
    for name in ("inertial9", "mahony9"):
        board = {"FILTER": name, "PAGE_SECONDS": 2}
        run = boot_board(board_name="robomaster_a", world=str(still), seconds=5, board=board)
        assert run.result["started"]
        pictures.append(np.array(run.picture))
    inertial, mahony = pictures
    assert inertial[:8, :48].any()  # AT REST
    assert not mahony[:8, :48].any()  # it does not say
    assert (inertial[:8, 60:] == mahony[:8, 60:]).all()  # FIELD OK


# -- it comes back by itself


@pytest.mark.parametrize("name", ["sim", "robomaster_a"])
@pytest.mark.parametrize("at", range(50000, 1600000, 103000))
def test_a_sensor_that_is_silent_for_150_ms_at_any_moment_of_the_start_is_waited_for(
    boot_board, name, at
):
    """Also while the magnetometer is set up, and the FIFO is switched on."""
    board = {"DRIVE": "fifo", "RATE": 200} if name == "sim" else {}
    run = boot_board(
        board_name=name, board=board, seconds=5, faults=[[at, "imu", "silent", 150000]]
    )
    healthy(run.result)
    assert run.result["fresh"] > 200
    assert name == "sim" or run.result["mag_fresh"] > 50


@pytest.mark.parametrize("error", ["OSError", "ValueError", "MemoryError"])
def test_an_exception_in_the_main_loop_is_shown_and_it_starts_again(boot, error):
    run = boot(seconds=8, faults=[[3 * SECOND, "board", "raise_in_main", None, error]])
    healthy(run.result)
    assert any(error in line and "starting again" in line for line in run.lines)
    assert run.result["steps"] > 400  # of the second start
    assert not dark(run.picture)


def test_an_exception_at_every_try_does_not_end_it_either(boot):
    faults = [[s * SECOND, "board", "raise_in_main", None, "OSError"] for s in (3, 4, 5)]
    run = boot(seconds=10, faults=faults)
    healthy(run.result)
    assert sum("starting again" in line for line in run.lines) == 3
    assert run.result["steps"] > 400


def test_after_a_ctrl_c_it_can_be_started_again_and_one_tick_runs(boot):
    fault = [3 * SECOND, "board", "raise_in_main", None, "KeyboardInterrupt"]
    run = boot(seconds=8, faults=[fault])
    healthy(run.result)
    assert run.result["interrupts"] == 1
    assert run.result["missed"] == 0
    assert run.result["irqs"] <= 200 * 8


def test_each_of_three_hundred_ctrl_c_in_the_tick_ends_the_program_and_none_the_tick(boot_board):
    faults = [
        [(i + 2) * SECOND, "bus", "raise", None, "KeyboardInterrupt"] for i in range(300)
    ]  # and each time it is started again
    run = boot_board(seconds=303, board={"MEASURE_BIAS": False}, faults=faults)
    healthy(run.result)
    assert run.result["interrupts"] == 300
    assert run.result["fresh"] > 150


# -- the watchdog


def test_a_watchdog_is_off_unless_it_is_asked_for_and_that_is_said(boot):
    run = boot(seconds=8, faults=[[2 * SECOND, "board", "hang", 5 * SECOND]])
    assert run.result["board_resets"] == 0
    assert any("watchdog: off" in line and "WATCHDOG_MS" in line for line in run.lines)
    assert "started by: power-on" in run.lines


@pytest.mark.parametrize(
    "fault", [["board", "hang", 60 * SECOND], ["board", "no_ticks", 60 * SECOND]]
)
def test_a_main_program_that_hangs_and_a_tick_that_has_ended_reset_the_board(boot, fault):
    run = boot(seconds=7, board={"WATCHDOG_MS": 2000}, faults=[[3 * SECOND, *fault]])
    assert run.result["board_resets"] == 1
    assert "started by: watchdog" in run.lines


def test_a_sensor_that_is_lost_resets_the_board_once_and_the_start_waits_for_it(boot):
    faults = [[3 * SECOND, "imu", "silent", 7 * SECOND]]
    run = boot(seconds=14, board={"WATCHDOG_MS": 2000}, faults=faults)
    healthy(run.result)
    assert run.result["board_resets"] == 1
    assert run.result["fresh"] > 200


def test_a_healthy_board_is_never_reset_by_its_watchdog(boot):
    run = boot(seconds=12, board={"WATCHDOG_MS": 1000})
    healthy(run.result)
    assert run.result["board_resets"] == 0
