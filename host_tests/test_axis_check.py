"""The check of the axes: every wrong map is named and the right one proposed."""

import functools
import itertools
import json
import math

import motions
import numpy as np
import pytest
from upright_app import axis_check
from upright_host import runtimes

RATE = 100
GYRO_BIAS_DPS = np.array(motions.DEFAULT_ERRORS.gyro_bias_dps)
ALL_MAPS = [
    [(index, sign) for index, sign in zip(order, signs, strict=True)]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
]
RIGHT_HANDED = [axes for axes in ALL_MAPS if axis_check.handedness(axes) > 0]


@functools.cache
def tumble_counts(iron_uT=(40.0, -25.0, 60.0), name="hand", seconds=20):
    """A board in a hand, in the body's frame, with hard iron; a field measured in every other row."""
    errors = motions.Errors(mag_bias_uT=iron_uT)
    counts = motions.render(name, RATE, seconds, errors=errors).counts.astype(int)
    counts[:, 10] = np.where(np.arange(len(counts)) % 2, 3, 1)
    return counts


def as_chip(vectors, axes):
    """What a chip delivers that sits on the board by this map (body from chip)."""
    out = np.empty_like(vectors)
    for body, (index, sign) in enumerate(axes):
        out[:, index] = sign * vectors[:, body]
    return out


def judged(counts, imu_axes=("x", "y", "z"), south=False):
    bias = as_chip((GYRO_BIAS_DPS * 16.4)[None], axis_check.parse(imu_axes))[0]
    tumble = axis_check.Tumble((82, 5), 4096, imu_axes, bias)
    for row in counts.tolist():
        tumble.add(row, 1 / RATE)
    return tumble.result(south)


# ---------------------------------------------------------------- maps


def test_the_maps_are_48_and_half_of_them_left_handed():
    assert len({axis_check.names(axes) for axes in ALL_MAPS}) == 48
    assert len(RIGHT_HANDED) == 24
    for axes in ALL_MAPS:
        assert axis_check.parse(axis_check.names(axes)) == axes
        matrix = np.array(
            [axis_check.mapped(unit, axes) for unit in np.eye(3, dtype=int).tolist()]
        ).T
        assert round(np.linalg.det(matrix)) == axis_check.handedness(axes)


@pytest.mark.parametrize("axes", RIGHT_HANDED, ids=lambda axes: ",".join(axis_check.names(axes)))
def test_three_postures_give_the_imus_map(axes):
    up = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]) * 4096  # level, nose up, left side up
    seen = [axis_check.up_axis(row, 4096) for row in as_chip(up, axes).tolist()]
    assert axis_check.imu_axes(*seen) == axis_check.names(axes)


def test_postures_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="opposite way up"):
        axis_check.imu_axes((2, 1), (0, 1), (1, -1))  # right side up instead of left
    with pytest.raises(ValueError, match="same axis"):
        axis_check.imu_axes((2, 1), (0, 1), (0, -1))
    assert axis_check.up_axis((2900, 0, 2900), 4096) is None


# ---------------------------------------------------------------- the tumble


@pytest.mark.parametrize("axes", ALL_MAPS, ids=lambda axes: ",".join(axis_check.names(axes)))
def test_a_tumble_finds_the_magnetometers_map_among_all_48(axes):
    counts = tumble_counts().copy()
    counts[:, 6:9] = as_chip(counts[:, 6:9], axes)
    verdict = judged(counts)
    assert verdict.problem is None
    assert verdict.axes == axis_check.names(axes)
    assert verdict.score < 0.1 < 0.5 < verdict.second


@pytest.mark.parametrize(
    "imu", RIGHT_HANDED[::5], ids=lambda axes: ",".join(axis_check.names(axes))
)
def test_it_finds_it_on_a_board_whose_imu_is_turned_as_well(imu):
    counts = tumble_counts().copy()
    for at in (0, 3):
        counts[:, at : at + 3] = as_chip(counts[:, at : at + 3], imu)
    counts[:, 6:9] = as_chip(counts[:, 6:9], [(1, -1), (0, 1), (2, -1)])
    assert judged(counts, axis_check.names(imu)).axes == ("-y", "x", "-z")


@pytest.mark.parametrize("name, seconds", [("demo", 24), ("bursts", 20), ("hand", 15)])
def test_other_tumbles_serve_too(name, seconds):
    verdict = judged(tumble_counts(name=name, seconds=seconds))
    assert verdict.axes == ("x", "y", "z")


def test_iron_strength_and_dip_come_out_of_the_same_sums():
    verdict = judged(tumble_counts())
    assert np.allclose(np.array(verdict.offset) * 0.3, (40, -25, 60), atol=1)
    assert abs(verdict.strength * 0.3 - motions.FIELD_UT) < 1
    assert abs(verdict.dip_deg - motions.DIP_DEG) < 2


def test_single_precision_as_on_boards_is_enough_even_beside_much_iron():
    counts = tumble_counts((300.0, -200.0, 500.0)).astype(np.float32)
    tumble = axis_check.Tumble((82, 5), 4096, ("x", "y", "z"))
    for row, flags in zip(counts, counts[:, 10].astype(int), strict=True):
        tumble.add([*row[:10], int(flags)], np.float32(1 / RATE))
    verdict = tumble.result()
    assert verdict.axes == ("x", "y", "z")
    assert np.allclose(np.array(verdict.offset) * 0.3, (300, -200, 500), atol=3)


def test_in_the_south_the_field_points_up():
    counts = tumble_counts().copy()
    counts[:, 6:9] *= -1  # the same place's opposite: a field up and south, turned by half
    assert judged(counts).axes == ("-x", "-y", "-z")
    assert judged(counts, south=True).axes == ("x", "y", "z")


def test_near_the_magnetic_equator_it_says_that_the_sign_is_open(monkeypatch):
    monkeypatch.setattr(motions, "DIP_DEG", 3.0)
    counts = motions.render("hand", RATE, 30).counts.astype(int)
    counts[:, 10] = 3
    verdict = judged(counts)
    assert verdict.axes in (("x", "y", "z"), ("-x", "-y", "-z"))
    assert "or its opposite" in verdict.problem


@pytest.mark.parametrize(
    "spoil, why",
    [
        (lambda counts: motions.render("static", RATE, 30).counts, "too little turning"),
        (lambda counts: motions.render("spin", RATE, 30).counts, "about one axis only"),
        (lambda counts: noise(counts), "no map explains"),
        (lambda counts: frozen(counts), "no map explains|one axis"),
    ],
    ids=["at rest", "about one axis", "noise for a field", "a field that stands still"],
)
def test_a_tumble_that_shows_nothing_is_refused(spoil, why):
    counts = np.array(spoil(tumble_counts().copy()), int)
    counts[:, 10] = 3
    verdict = judged(counts)
    assert verdict.axes is None
    assert any(part in verdict.problem for part in why.split("|"))


def noise(counts):
    counts[:, 6:9] = np.random.default_rng(1).integers(-200, 200, (len(counts), 3))
    return counts


def frozen(counts):
    counts[:, 6:9] = (60, 10, -140)
    return counts


def test_a_bias_of_the_gyro_that_was_not_taken_off_does_no_harm():
    tumble = axis_check.Tumble((82, 5), 4096, ("x", "y", "z"))
    for row in tumble_counts().tolist():
        tumble.add(row, 1 / RATE)
    assert tumble.result().axes == ("x", "y", "z")


def test_the_quarter_turn_tells_a_gyro_and_a_field_that_disagree():
    before, after = (
        (60, 0, -150),
        (0, -60, -150),
    )  # the field turns to the right in a board that turns to the left
    needle = axis_check.needle_turn(before, after, ("x", "y", "z"), (0, 0, 0))
    assert math.isclose(needle, -90)
    assert axis_check.judge_turn(90, needle) == []
    assert "opposite" in axis_check.judge_turn(90, -needle)[0]
    assert "to the right" in axis_check.judge_turn(-90, 90)[0]
    assert "once more" in axis_check.judge_turn(40, -40)[0]


# ---------------------------------------------------------------- on simulated boards

# A board checked by hand: (body axis, deg, from s, lasts s); in between it lies still.
NOSE_UP, LEFT_UP, TUMBLE, LEVEL, TURN = 4, 8, 12, 28, 33
MOVES = [
    (1, -90, NOSE_UP, 1),
    (1, 90, LEFT_UP, 1),
    (0, 90, LEFT_UP + 1, 1),
    (0, -90, LEVEL - 1, 1),
    (2, 90, TURN, 1.5),
]


def by_hand(rng):
    def body_rate(t):
        out = np.zeros((len(t), 3))
        for axis, angle, at, lasts in MOVES:
            u = (t - at) / lasts
            rate = angle * np.pi / 2 / lasts * np.sin(np.pi * u)
            out[:, axis] += np.where((u > 0) & (u < 1), rate, 0)
        # to and fro about every axis, each turn taken back before the next
        for k, axis in enumerate((0, 1, 2, 1, 0, 2, 0, 1)):
            u = (t - TUMBLE - 1.8 * k) / 1.8
            on = (u > 0) & (u < 1)
            out[:, axis] += np.where(on, 260 * np.sin(2 * np.pi * u), 0)
        return out

    return body_rate, lambda t: np.zeros((len(t), 3))


@pytest.fixture
def checked_board(monkeypatch, tmp_path):
    """checked_board(board, **settings) -> the console of the guided check on the simulated board, moved by hand."""

    def run(name, **settings):
        monkeypatch.setitem(motions._MOTIONS, "by_hand", ((20, 0, 0), by_hand))
        world = tmp_path / "hand.imu"
        motions.render("by_hand", 200, 44).write(world)
        script = tmp_path / "check.py"
        script.write_text(SCRIPT)
        asked = world, name, json.dumps(settings)
        done = runtimes.run("cpython", script, asked, board=name, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


SCRIPT = """
import json, sys
import boards, machine
from world import World

machine.power_on()
world = World(sys.argv[1])
world.start(0)
import board
from upright_app import guided
parts = boards.wire(sys.argv[2], board, world, {})
for name, value in json.loads(sys.argv[3]).items():
    setattr(board, name, tuple(value))
guided.axes(board, tumble_ms=12000)
"""


def test_the_guided_check_is_content_with_a_board_whose_maps_are_right(checked_board):
    said = checked_board("robomaster_a")
    assert "all is well" in said, said
    for step in "12345":
        assert f"{step}. " in said


def test_the_guided_check_names_the_wrong_map_and_the_right_one(checked_board):
    said = checked_board("robomaster_a", MAG_AXES=["y", "x", "z"])
    assert "MAG_AXES is ('y', 'x', 'z'), should be ('y', '-x', '-z')" in said


def test_the_guided_check_finds_a_wrong_map_of_the_imu(checked_board):
    said = checked_board("sim", IMU_AXES=["y", "-x", "z"])
    assert "IMU_AXES is ('y', '-x', 'z'), should be ('x', 'y', 'z')" in said
