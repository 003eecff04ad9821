"""A filter that learns the gyro's bias: nobody waits for it, the status page shows it, and the next start has it."""

import numpy as np
import pytest
from upright import calibration
from upright_host import scoring

INERTIAL = {"FILTER": "inertial6", "PAGE_SECONDS": 0}


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """25 s of rest with a typical sensor's errors: a bias of 1.2, -0.8, 0.6 deg/s."""
    import motions

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
    import motions

    path = tmp_path / "hand.imu"
    motion = motions.render("hand", rate=(200, 1), seconds=14)
    motion.write(path)
    run = boot_board(world=str(path), seconds=14, board=INERTIAL)
    assert run.result["started"]
    assert run.times[0] < 2000000  # one try of a second, not four
    late = scoring.once(run.rows) & (run.times > 6000000)
    score = scoring.score(
        run.rows[late] / 200, run.q29[late] / scoring.ONE, motion.t, motion.q_true
    )
    assert score.inclination < 1.0


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
