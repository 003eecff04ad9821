"""What holds for every filter of the registry: the interface, and that the firmware runs with it."""

import dataclasses
import hashlib
import sys
from array import array

import dmp_images
import motions
import numpy as np
import pytest
from conftest import healthy
from test_inertial import FIELD_UT, errors, scene
from test_rp2040 import as_trial
from upright import filters
from upright_host import registry, replay, scoring, simulate

SOFTWARE = [name for name in filters.FILTERS if name not in filters.HARDWARE]
AT_REST = array("h", [0, 0, 4096, 10, -20, 30, 66, 0, -150, 0, 3])


class Scales:
    gyro_scale = (82, 5)
    accel_lsb_per_g = 4096


@pytest.fixture(params=SOFTWARE)
def made(request):
    return filters.make(request.param, 200, Scales, {})


def test_it_has_the_name_it_is_made_by_and_all_that_a_filter_has(made):
    assert filters.FILTERS[made.NAME][1] == type(made).__name__
    assert made.AXES in (6, 9)
    assert made.rate == (200, 1)
    assert made.gyro_scale == (82, 5) and made.accel_lsb_per_g == 4096
    q, angles, bias = array("i", [0] * 4), array("i", [0] * 3), array("i", [0] * 3)
    assert made.seed(AT_REST)
    made.set_bias(256 * 10, -256 * 20, 256 * 30)
    for _ in range(1000):
        made.update(AT_REST)
    made.quaternion(q)
    assert list(made.state[made.QUATERNION : made.QUATERNION + 4]) == list(q)
    assert np.linalg.norm(q) / scoring.ONE == pytest.approx(1, abs=1e-4)
    assert np.linalg.norm(np.array(made.quaternion_floats()) - np.array(q) / scoring.ONE) < 1e-4
    made.angles(angles)
    assert max(abs(a) for a in angles) < 100  # level, north, not turning
    made.bias(bias)
    assert np.abs(np.array(bias) / 256 - (10, -20, 30)).max() < 0.1
    made.bias_mdps(bias)
    assert np.abs(np.array(bias) / 1000 * 16.4 - (10, -20, 30)).max() < 0.1


@pytest.mark.parametrize("b", [8192 * 256, -8192 * 256, 12345, -1, 0])
def test_the_bias_reads_back(made, b):
    out = array("i", [0] * 3)
    made.set_bias(b, -b, 5)
    made.bias(out)
    assert list(out) == [b, -b, 5]
    made.bias_mdps(out)
    assert list(out)[:2] == [round(b * 1000 / 256 / 16.4), round(-b * 1000 / 256 / 16.4)]


@pytest.mark.parametrize("b", [8192 * 256 + 1, -8192 * 256 - 1, 1.5])
def test_a_bias_that_the_numbers_cannot_hold_is_refused(made, b):
    with pytest.raises(ValueError, match=r"bias is .*, at most \+-2097152"):
        made.set_bias(0, b, 0)


def test_a_first_sample_without_gravity_is_none(made):
    made.set_quaternion(1, 2, 3, 4)
    short = array("h", AT_REST)
    short[2] = 255  # 1/16 g
    assert made.seed(short) is False
    assert made.quaternion_floats() == (1, 0, 0, 0)


@pytest.mark.parametrize("yaw", [0, 40, 120, -90, 179])
def test_the_first_sample_gives_tilt_and_with_a_magnetometer_the_heading(made, yaw):
    q = motions.quaternion_zyx(yaw, 20, -35)
    turn = motions._matrix(q[None])[0]
    row = array("h", AT_REST)
    for i in range(3):
        row[i] = round(4096 * turn[2][i])
        row[3 + i] = 0
        row[6 + i] = round((FIELD_UT @ turn)[i] / 0.3)
    angles = array("i", [0] * 3)
    for flags in (3, 1):
        row[10] = flags
        assert made.seed(row) is True
        heading = yaw if flags == 3 and made.AXES == 9 else 0
        for _ in range(2):
            made.angles(angles)
            off = (angles[2] / 1000 - heading + 180) % 360 - 180
            assert abs(off) < 0.5 and abs(angles[1] - 20000) < 300 and abs(angles[0] + 35000) < 300
            made.update(row)


def test_a_field_that_stands_upright_gives_no_heading(made):
    row = array("h", AT_REST)
    row[6] = row[7] = 0
    assert made.seed(row) is True
    assert made.quaternion_floats() == pytest.approx((1, 0, 0, 0), abs=1e-6)


@pytest.mark.parametrize("bad", [(0, 0, 0), (32767, 0, 0), (-32768, 5, 5), (5, 5, -32767)])
def test_a_magnetometer_sample_that_cannot_be_turns_nothing(made, bad):
    row = array("h", AT_REST)
    row[3:6] = array("h", [0, 0, 0])
    row[10] = 1
    made.seed(row)
    row[6:9] = array("h", bad)
    row[10] = 3
    for _ in range(200):
        made.update(row)
    assert not getattr(made, "mag_accepted", False)
    angles = array("i", [0] * 3)
    made.angles(angles)
    assert abs(angles[2]) <= 1


@pytest.mark.parametrize("name", [n for n in SOFTWARE if n.startswith(("inertial", "quaternion"))])
def test_a_bias_that_was_set_is_subtracted_and_what_is_learnt_at_rest_comes_on_top(name):
    made = filters.make(name, 200, Scales, {})
    row = array("h", AT_REST)
    row[3:6] = array("h", [0, 0, 820])
    row[10] = 1
    out = array("i", [0] * 3)
    made.set_bias(0, 0, 820 * 256)  # 50 deg/s
    for _ in range(200):
        made.update(row)
    made.angles(out)
    assert abs(out[2]) < 5
    row[5] = 853  # 2.01 deg/s more
    for _ in range(200 * 10):
        made.update(row)
    made.bias_mdps(out)
    assert out[2] == pytest.approx(853000 / 16.4, abs=50)
    saved = array("i", [0] * 3)
    made.bias(saved)
    fresh = filters.make(name, 200, Scales, {})
    fresh.set_bias(*saved)
    for _ in range(200):
        fresh.update(row)
    fresh.angles(out)
    assert abs(out[2]) < 60


def test_it_goes_on_with_the_last_turn_when_samples_are_missing(made):
    made.seed(AT_REST)
    row = array("h", AT_REST)
    row[3:6] = array("h", [0, 0, 820])  # 50 deg/s
    row[10] = 0
    for _ in range(100):
        made.update(row)
    angles = array("i", [0] * 3)
    made.angles(angles)
    assert angles[2] == pytest.approx(25000, abs=100)
    assert abs(angles[0]) < 50 and abs(angles[1]) < 50


def test_the_attitude_can_be_set(made):
    for q in ((0.5, 0.5, -0.5, 0.5), (3, 0, 0, 4), (1, 2, 3, -4)):
        made.set_quaternion(*q)
        expected = np.array(q) / np.linalg.norm(q)
        assert abs(np.array(made.quaternion_floats()) @ expected) > 1 - 1e-8
    with pytest.raises(ValueError):
        made.set_quaternion(0, 0, 0, 0)


@pytest.mark.parametrize("name", SOFTWARE)
def test_what_it_does_not_take_is_refused(name):
    with pytest.raises(ValueError, match=name):
        filters.make(name, 200, Scales, {"no_such_gain": 1})
    for rate in (0, -200, 2.5, "200", (200, 0)):
        with pytest.raises(ValueError, match="rate"):
            filters.make(name, rate, Scales, {})


def test_an_unknown_name_is_refused_with_those_that_there_are():
    with pytest.raises(ValueError, match=r"unknown filter 'dmp9'.*inertial9"):
        filters.make("dmp9", 200, Scales, {})


def test_a_module_that_is_not_on_the_board_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "upright.kalman", None)
    with pytest.raises(ValueError, match=r"kalman.py is not on this board: .* FILTER = 'kalman6'"):
        filters.make("kalman6", 200, Scales, {})


def test_no_samples_can_be_handed_to_a_filter_in_the_sensor():
    with pytest.raises(ValueError, match="computed in the sensor"):
        filters.make("dmp6", 200, Scales, {})


# -- the firmware with each of them
@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    motion = motions.render("demo", rate=(1000, 1), seconds=7)
    path = tmp_path_factory.mktemp("world") / "demo.imu"
    motion.write(path, truth=True)
    return motion, path


@pytest.mark.parametrize("name", SOFTWARE)
def test_the_firmware_runs_with_it_and_nothing_is_allocated(boot_board, hand, name):
    motion, path = hand
    nine = registry.axes(name) == 9
    boot = boot_board(
        world=str(path),
        seconds=4 if nine else 7,  # which takes 1 kHz
        board_name="robomaster_a" if nine else "sim",
        board={"FILTER": name},
    )
    healthy(boot.result)
    assert boot.result["filter"] == name
    assert boot.result["missed"] == 0 and boot.result["steps"] > 800
    if boot.result["heap_checked"]:
        assert boot.result["irqs"] >= boot.result["steps"]
    rows = scoring.once(boot.rows)
    score = scoring.score(
        boot.rows[rows] / 1000, boot.q29[rows] / scoring.ONE, motion.t, motion.q_true, None, 0.0005
    )
    assert score.inclination < 2.5
    assert (score.total if nine else score.aligned_total) < 4


def dmp_board(tmp_path, image, **board):
    file = tmp_path / "dmp.bin"
    file.write_bytes(image)
    board = {"DMP_IMAGE": str(file), "DMP_SHA256": hashlib.sha256(image).hexdigest()} | board
    return {"dmp_image": str(file), "board": {"FILTER": "dmp6", "RATE": 100} | board}


@pytest.mark.parametrize("version", dmp_images.IMAGES)
@pytest.mark.parametrize("rate", [200, 50])
def test_the_firmware_shows_what_the_dmp_says(boot_board, hand, tmp_path, version, rate):
    motion, path = hand
    config = dmp_board(tmp_path, dmp_images.IMAGES[version], RATE=rate)
    boot = boot_board(world=str(path), seconds=7, **config)
    healthy(boot.result)
    assert boot.result["filter"] == "dmp6"
    assert f"dmp: image {version}" in "\n".join(boot.lines)
    assert boot.result["fresh"] > 5 * rate
    rows = scoring.once(boot.rows)
    score = scoring.score(
        boot.rows[rows] / 1000, boot.q29[rows] / scoring.ONE, motion.t, motion.q_true, None, 0.0005
    )
    # between two packets the attitude is as old as that
    assert score.aligned_total < (0.5 if rate == 200 else 3)


@pytest.mark.parametrize(
    "faults",
    [
        [[2_000_000, "imu", "brown_out"]],
        [[2_000_000, "imu", "vanish"], [2_700_000, "imu", "come_back"]],
    ],
    ids=["brown-out", "gone for a while"],
)
def test_a_dmp_that_lost_its_program_gets_it_again_and_the_display_lives_on(
    boot_board, hand, tmp_path, runtime, faults
):
    config = dmp_board(tmp_path, dmp_images.V612)
    boot = boot_board(runtime, world=str(hand[1]), seconds=5, faults=faults, **config)
    healthy(boot.result)
    assert boot.result["resets"] == 1
    assert "dmp: loaded again" in boot.lines
    # most of a second without, and no ticks to be made up for
    assert boot.result["missed"] == 0
    assert 150 < boot.result["fresh"] < boot.result["steps"]


@pytest.mark.parametrize(
    "change, said",
    [
        ({"DMP_SHA256": "0" * 64}, "this DMP image is not known"),
        ({"DMP_IMAGE": "nowhere.bin"}, "the DMP image nowhere.bin cannot be read"),
    ],
)
def test_an_image_that_cannot_be_had_is_said_on_the_console(boot_board, tmp_path, change, said):
    config = dmp_board(tmp_path, dmp_images.V612, **change)
    boot = boot_board(seconds=2, **config)
    assert not boot.result["started"]
    assert said in "\n".join(boot.lines)


@pytest.mark.parametrize("change", [{"RATE": 30}, {"RATE": [2000, 7]}, {"DRIVE": "fifo"}])
def test_settings_that_a_dmp_cannot_keep_are_refused(boot_board, tmp_path, change):
    config = dmp_board(tmp_path, dmp_images.V612, **change)
    with pytest.raises(simulate.SimulationError, match=r"rate_hz 30|DRIVE is \"timer\""):
        boot_board(seconds=2, **config)


# -- started in the middle of a motion
def thrown(seed):
    """45 s at 200 Hz of turns and pushes in bursts, from the first sample on, and a raw gyro; no magnet near."""
    rng = np.random.default_rng(seed)
    size, hz, phase = (
        rng.uniform(0, 1, (3, 4)),
        rng.uniform(0.05, 1.5, (3, 4)),
        rng.uniform(0, 6, (3, 4)),
    )
    push, push_hz = rng.uniform(0.2, 0.6), rng.uniform(0.3, 4, (3, 3))
    ends = np.cumsum(rng.uniform(2, 12, 40))

    def active(t):
        return np.searchsorted(ends, t) % 2 == 0

    def body_rate(t):
        wave = np.sin(2 * np.pi * hz[..., None] * t + phase[..., None])
        return (active(t) * 150 * (size[..., None] * wave).sum(1)).T

    def accel(t):
        wave = np.sin(2 * np.pi * push_hz[..., None] * t + phase[:, :3, None])
        return (active(t) * push / 2 * wave.sum(1)).T

    return scene(200, 45, body_rate, accel, tuple(rng.uniform(-5, 5, 3)))


@pytest.mark.parametrize(
    "name", ["inertial6", "inertial9", "quaternion-kalman6", "quaternion-kalman9"]
)
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 6])
def test_a_start_in_the_middle_of_a_motion_is_forgotten(name, seed):
    motion = thrown(seed)
    trial = dataclasses.replace(as_trial(motion), mag_uT_per_lsb=0.3)
    q = replay.replay(trial, name, simulate.best_runtime(), direct=True).q29 / scoring.ONE
    inclination, heading = errors(q, motion)
    late = 200 * 25
    print(f"{name} {seed}: {inclination[late:].max():.1f} {np.abs(heading[late:]).max():.1f}")
    assert inclination[late:].max() < 4
    if registry.axes(name) == 9:
        assert np.abs(heading[late:]).max() < 10
