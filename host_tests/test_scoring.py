"""The score against errors whose size is known, and the output file."""

import math

import motions
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from upright_host import scoring

Z, X = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])


def turn(degrees, axis):
    return motions.exponential(np.radians(degrees) * np.asarray(axis, float))


@pytest.fixture(scope="module")
def hand():
    return motions.render("hand", 100, seconds=20, errors=None)


def angles(s):
    return (
        *(s.inclination, s.heading, s.total),
        *(s.aligned_heading, s.aligned_total, s.offset, s.max_inclination),
    )


def test_the_truth_itself_scores_zero(hand):
    s = scoring.score_motion(hand.q_true, hand)
    assert angles(s) == pytest.approx([0] * 7, abs=1e-5)
    assert (s.samples, s.coverage) == (hand.n, 1)
    assert angles(scoring.score_motion(-3 * hand.q_true, hand)) == pytest.approx([0] * 7, abs=1e-5)


@given(degrees=st.floats(-179, 179))
def test_a_constant_heading_offset_is_heading_alone_and_can_be_taken_out(hand, degrees):
    s = scoring.score_motion(motions.multiply(turn(degrees, Z), hand.q_true), hand)
    size = abs(degrees)
    expected = [0, size, size, 0, 0, degrees, 0]
    assert angles(s) == pytest.approx(expected, abs=1e-4)


@given(degrees=st.floats(0, 170), direction=st.floats(0, 360))
def test_a_constant_tilt_about_a_level_axis_is_inclination_alone(hand, degrees, direction):
    axis = [math.cos(math.radians(direction)), math.sin(math.radians(direction)), 0]
    s = scoring.score_motion(motions.multiply(turn(degrees, axis), hand.q_true), hand)
    expected = [degrees, 0, degrees, 0, degrees, 0, degrees]
    assert angles(s) == pytest.approx(expected, abs=1e-4)


@given(heading=st.floats(-170, 170), tilt=st.floats(0, 80), share=st.floats(0.1, 0.9))
def test_heading_and_tilt_come_apart_and_average_as_squares(heading, tilt, share):
    n = 200
    part = int(share * n)
    truth = np.tile([1.0, 0, 0, 0], (n, 1))
    q = truth.copy()
    q[:part] = motions.multiply(turn(heading, Z), turn(tilt, X))
    t = np.arange(n) * 0.01
    s = scoring.score(t, q, t, truth)
    assert s.inclination == pytest.approx(tilt * math.sqrt(part / n), abs=1e-4)
    assert s.heading == pytest.approx(abs(heading) * math.sqrt(part / n), abs=1e-4)
    whole = 2 * math.degrees(
        math.acos(math.cos(math.radians(heading / 2)) * math.cos(math.radians(tilt / 2)))
    )
    assert s.total == pytest.approx(whole * math.sqrt(part / n), abs=1e-4)
    assert s.max_inclination == pytest.approx(tilt, abs=1e-4)
    assert s.aligned_heading <= s.heading + 1e-9


def test_the_best_offset_is_the_mean_across_the_half_turn():
    t = np.arange(4.0)
    q = np.stack([turn(a, Z) for a in (178, -178, 176, -176)])
    s = scoring.score(t, q, t, np.tile([1.0, 0, 0, 0], (4, 1)))
    assert abs(s.offset) == pytest.approx(180, abs=1e-6)
    assert s.aligned_heading == pytest.approx(math.sqrt((4 + 4 + 16 + 16) / 4), abs=1e-4)
    assert s.heading == pytest.approx(math.sqrt((178**2 + 176**2) / 2), abs=1e-4)


def test_the_best_offset_is_the_one_of_the_least_squares():
    t = np.arange(4.0)
    q = np.stack([turn(a, Z) for a in (0, 0, 0, 90)])
    s = scoring.score(t, q, t, np.tile([1.0, 0, 0, 0], (4, 1)))
    assert s.offset == pytest.approx(22.5, abs=1e-6)
    assert s.aligned_heading == pytest.approx(math.sqrt((3 * 22.5**2 + 67.5**2) / 4), abs=1e-6)


def test_an_error_in_the_sensor_frame_is_seen_in_the_earth_frame(hand):
    # a turn about the sensor's z axis: as much inclination as that axis leaves the vertical
    s = scoring.score_motion(motions.multiply(hand.q_true, turn(10, Z)), hand)
    assert s.total == pytest.approx(10, abs=1e-4)
    assert 0.5 < s.inclination < 10 and 0.5 < s.heading < 10


def test_the_output_is_interpolated_between_its_rows():
    # rows 40 ms and 14.4 deg apart: the middle of the chord lies on the arc, other places nearly
    t = np.arange(51) * 0.04
    q = motions.exponential(np.radians(360) * t[:, None] * Z)
    middle = t[:-1] + 0.02
    truth = motions.exponential(np.radians(360) * middle[:, None] * Z)
    assert scoring.score(t, q, middle, truth).total < 1e-5
    flipped = q * np.where(np.arange(51) % 2, -1, 1)[:, None]
    assert scoring.score(t, flipped, middle, truth).total < 1e-5
    third = t[:-1] + 0.01
    truth = motions.exponential(np.radians(360) * third[:, None] * Z)
    assert scoring.score(t, q, third, truth).total < 0.02
    assert scoring.score(t, q, third + 0.01, truth).total == pytest.approx(3.6, abs=0.02)


def test_only_known_truth_of_the_movement_counts(hand):
    q = hand.q_true.copy()
    truth = hand.q_true.copy()
    movement = np.ones(hand.n, bool)
    q[:500] = motions.multiply(turn(50, X), q[:500])
    movement[:400] = False
    truth[400:500] = np.nan
    s = scoring.score(hand.t, q, hand.t, truth, movement)
    assert s.total < 1e-5 and s.samples == hand.n - 500 and s.coverage == 1
    assert scoring.score(hand.t, q, hand.t, truth).total > 10


def test_an_output_that_stops_early_says_how_much_it_covers(hand):
    s = scoring.score_motion(hand.q_true[:500], hand)
    assert (s.samples, s.coverage) == (500, 0.25)
    assert "25.0 % of the truth: the output covers only a part" in str(s)
    movement = np.arange(hand.n) >= 1000
    s = scoring.score(hand.t[:500], hand.q_true[:500], hand.t, hand.q_true, movement)
    assert s.samples == 0 and math.isnan(s.total) and s.coverage == 0
    assert s.lines() == ["nothing to score: there is no truth of the movement in this span"]
    one = scoring.score_motion(hand.q_true[:1], hand)
    assert one.samples == 1 and one.total < 1e-5


def test_a_score_reads_well():
    s = scoring.Score(0.7331, 2.5, 2.61, 1.25, 1.449, -12.3, 4.567, 9000, 1.0)
    assert s.lines() == [
        "inclination      0.733 deg RMSE, 4.57 at most",
        "as given       heading   2.500  total   2.610",
        "best heading   heading   1.250  total   1.449  (offset -12.30)",
        "compared       9000 samples, 100.0 % of the truth",
    ]


def test_what_cannot_be_scored_is_refused():
    t, q = np.arange(3.0), np.tile([1.0, 0, 0, 0], (3, 1))
    assert scoring.score(t, q, t, q).samples == 3
    with pytest.raises(ValueError, match="do not fit 3 times"):
        scoring.score(t, q[:2], t, q)
    with pytest.raises(ValueError, match=r"true quaternions \(2, 4\)"):
        scoring.score(t, q, t, q[:2])
    with pytest.raises(ValueError, match="do not fit 0 times"):
        scoring.score(t[:0], q[:0], t, q)
    with pytest.raises(ValueError, match="do not ascend"):
        scoring.score(t[::-1], q, t, q)
    for bad in (0.0, np.nan, np.inf):
        wrong = q.copy()
        wrong[1] = bad
        with pytest.raises(ValueError, match="row 1 is no attitude"):
            scoring.score(t, wrong, t, q)


def test_the_output_file_has_fixed_bytes(tmp_path):
    one = scoring.ONE
    rows = [[one, 0, 0, 0], [1, -1, 3 * one // 4, -one], [one // 3, 2, -2, 5]]
    scoring.write_csv(tmp_path / "a.csv", rows, (2000, 7))
    assert (tmp_path / "a.csv").read_bytes() == (
        b"t,q0,q1,q2,q3\n"
        b"0.000000000,1.000000000,0.000000000,0.000000000,0.000000000\n"
        b"0.003500000,0.000000002,-0.000000002,0.750000000,-1.000000000\n"
        b"0.007000000,0.333333332,0.000000004,-0.000000004,0.000000009\n"
    )
    scoring.write_csv(tmp_path / "b.csv", np.array(rows, np.int32), (2000, 7))
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@given(
    rows=st.lists(st.tuples(*[st.integers(-(2**29) - 9, 2**29 + 9)] * 4), min_size=1, max_size=30),
    rate=st.tuples(st.integers(1, 8000), st.integers(1, 9)),
)
def test_every_integer_can_be_read_back(rows, rate, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "back.csv"
    scoring.write_csv(path, rows, rate)
    t, q = scoring.read_csv(path)
    assert (np.rint(q * scoring.ONE) == rows).all()
    assert t == pytest.approx(np.arange(len(rows)) * rate[1] / rate[0], abs=1e-9)


@pytest.mark.parametrize(
    "content, message",
    [
        ("", "has no rows"),
        ("t,q0,q1,q2,q3\n", "has no rows"),
        ("t,q0,q1,q2,q3\n0,1,0,0\n", "line 2: expected t,q0,q1,q2,q3, found '0,1,0,0'"),
        ("0,1,0,0,0\n0.1,1,0,zero,0\n", "line 2"),
        ("0,1,0,0,0,0\n", "line 1"),
        ("0,1,0,0,0\n\n", "line 2"),
    ],
)
def test_a_wrong_output_file_is_refused_by_its_line(content, message, tmp_path):
    path = tmp_path / "wrong.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=message):
        scoring.read_csv(path)


def test_only_integers_of_the_right_shape_are_written(tmp_path):
    for wrong in ([[1.0, 0, 0, 0]], [[1, 2, 3]], [1, 2, 3, 4]):
        with pytest.raises(ValueError, match="expected integers"):
            scoring.write_csv(tmp_path / "x.csv", wrong, (200, 1))


def test_truth_within_the_slack_of_both_ends_counts(hand):
    """A recording's clock and the output's are not one: half a step before the first row and behind the last."""
    t = hand.t[10:-10]
    reach = 3 / 100
    counted = scoring.score(t, hand.q_true[10:-10], hand.t, hand.q_true, slack=reach + 1e-6)
    assert counted.samples == len(t) + 6
    assert scoring.score(t, hand.q_true[10:-10], hand.t, hand.q_true).samples == len(t)
