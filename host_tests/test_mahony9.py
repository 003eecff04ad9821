"""Mahony9: as accurate as its float twin at any magnetometer rate, Mahony6 bit for bit without one, right at once."""

import math
from array import array

import motions
import numpy as np
import pytest
from histories import SCALE, angles_between, bias_at_rest, rows_of
from reference import mahony_float
from reference.mahony_float import Mahony9Float
from test_mahony import GAINS, compare, quickest
from upright import mahony
from upright.mahony import Mahony6, Mahony9
from upright_host import scoring, trials

EVERY = [1, 3, 10]  # steps from one magnetometer sample to the next
OF_SIX = slice(0, mahony._MAG_MOST)  # the words that both filters have


def row(accel=(0, 0, 4096), gyro=(0, 0, 0), mag=(200, 0, 0), flags=3):
    return array("h", [*accel, *gyro, *mag, 0, flags])


def float_history(rendered, kp, ki, every, bias=(0, 0, 0)):
    """The float twin over all rows, with the flags that portable/filter_history.py gives: (n, 4)."""
    rows = rows_of(rendered, every)
    integer = Mahony9(rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, kp, ki)
    integer.set_bias(*bias)
    integer.seed(rows[0])
    twin = Mahony9Float.like(integer)
    q = np.empty((len(rows), 4))
    for i, counts in enumerate(rows):
        twin.update(counts)
        q[i] = twin.q
    return q


@pytest.fixture
def history(filter_history):
    """history(runtime, rendered, kp, ki, every, bias): Mahony9 over all rows, (n, 4) int32."""

    def run(runtime, rendered, kp, ki, every, bias=(0, 0, 0)):
        options = {"gains": {"kp": kp, "ki": ki}, "bias": bias, "mag_every": every}
        return filter_history(runtime, rendered, "mahony9", **options).q29

    return run


# -- accuracy; pytest -rP shows the figures
@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize("name", motions.MOTIONS)
def test_within_a_hundredth_of_a_degree_of_the_float_twin(history, name, every):
    for rate, seconds, (kp, ki) in ((200, 20, GAINS[0]), (1000, 4, GAINS[1])):
        rendered = motions.render(name, rate=(rate, 1), seconds=seconds)
        q = history(quickest(), rendered, kp, ki, every)
        what = f"{name} {rate} Hz {seconds} s kp {kp} ki {ki} mag every {every}"
        compare(what, q, float_history(rendered, kp, ki, every))


@pytest.mark.parametrize("dip", [80, -80, 0])
@pytest.mark.parametrize("name", ["slow", "coning"])
def test_a_steep_field_is_followed_as_well(history, monkeypatch, name, dip):
    """An ideal sensor, but for its counts: the field's horizontal part is 28 of them at 80 deg."""
    monkeypatch.setattr(motions, "DIP_DEG", dip)
    rendered = motions.render(name, seconds=20, errors=None)
    q = history(quickest(), rendered, 1, 0.02, 1)
    compare(f"{name} dip {dip}", q, float_history(rendered, 1, 0.02, 1))
    worst = angles_between(q, rendered.q_true).max()
    print(f"{name} dip {dip}: {worst:.3f} deg from the truth")
    assert worst < (4 if dip else 0.3)


def test_within_a_hundredth_of_a_degree_of_the_float_twin_on_a_recorded_trial(history, recorded):
    trial = trials.load(recorded)
    bias = bias_at_rest(trial) or (0, 0, 0)
    runtime = quickest()
    if runtime == "cpython":
        trial.counts = trial.counts[:5000]
    q = history(runtime, trial, 0.5, 0, 1, bias)
    compare(f"{trial.name} kp 0.5 ki 0", q, float_history(trial, 0.5, 0, 1, bias))
    if not trial.name.startswith("broad") or runtime == "cpython":
        return
    # Mahony with these gains has 7.8 deg on all of BROAD, 3.1 of it inclination
    t = np.arange(len(q)) * trial.rate[1] / trial.rate[0]
    score = scoring.score(t, q / 2**29, trial.t_gt, trial.q_true(), trial.movement)
    print(f"{trial.name}: inclination {score.inclination:.2f} total {score.total:.2f} deg")
    assert score.inclination < 7
    assert score.total < 14


# -- without a magnetometer
NOT_USED = {
    "not fresh": row(mag=(0, 300, 0), flags=1),
    "with a sample that is not fresh": row(mag=(0, 300, 0), flags=2),
    "full scale x": row(mag=(32767, 300, 0)),
    "full scale y": row(mag=(0, -32768, 0)),
    "full scale z": row(mag=(0, 300, 32767)),
    "zero": row(mag=(0, 0, 0)),
    "15 counts": row(mag=(0, -15, 0)),
}


@pytest.mark.parametrize("what", NOT_USED)
def test_it_is_mahony6_bit_for_bit_while_the_magnetometer_cannot_be_used(what):
    """In flight, from a state that the magnetometer has made, and from a seed."""
    rendered = motions.render("hand", rate=(500, 1), seconds=1.2)
    nine = Mahony9(500, SCALE, 4096, 0.5, 0.02)
    six = Mahony6(500, SCALE, 4096, 0.5, 0.02)
    counts = [array("h", list(r)) for r in rendered.counts.tolist()]
    for k, c in enumerate(counts[:300]):
        c[10] = 3 if k % 5 == 0 else 1
        nine.update(c)
    six.state[OF_SIX] = nine.state[OF_SIX]
    nine.update(row(mag=(0, 300, 0)))
    assert nine.mag_age == 0
    six.state[OF_SIX] = nine.state[OF_SIX]
    for k, c in enumerate(counts[300:]):
        c[6:9] = NOT_USED[what][6:9]
        c[10] = NOT_USED[what][10]
        if k == 200 and c[10] != 2:
            nine.seed(c)
            six.seed(c)
            assert nine.heading_seeded is False
        nine.update(c)
        six.update(c)
        assert nine.state[OF_SIX] == six.state[OF_SIX]
        assert nine.mag_age == k + 1
    assert list(nine.state[1:5]) != [1 << 29, 0, 0, 0]


def test_one_good_sample_is_what_makes_the_difference():
    """The twin of the test above."""
    nine, six = (kind(500, SCALE, 4096, 0.5, 0.02) for kind in (Mahony9, Mahony6))
    for filter in (nine, six):
        filter.update(row(mag=(0, 16, 0)))
    assert nine.state[OF_SIX] != six.state[OF_SIX]
    assert nine.mag_age == 0


def test_the_age_of_the_magnetometer_counts_the_steps_and_stays_a_small_int():
    filter = Mahony9(200, SCALE, 4096)
    assert filter.mag_age == (1 << 30) - 1
    filter.update(row(flags=1))
    assert filter.mag_age == (1 << 30) - 1
    filter.seed(row())
    assert filter.heading_seeded
    assert filter.mag_age == 0
    for flags, age in ((1, 1), (0, 2), (5, 3), (2, 4), (3, 0), (7, 0), (11, 0), (9, 1)):
        filter.update(row(flags=flags))
        assert filter.mag_age == age


# -- seed
def counts_at(roll, pitch, yaw, dip, field=30000):
    """The row of a sensor at rest without noise."""
    r = motions._matrix(motions.quaternion_zyx(yaw, pitch, roll)[None])[0]
    dip = math.radians(dip)
    accel = np.rint(r.T @ [0, 0, 4096]).astype(int)
    mag = np.rint(field * (r.T @ [math.cos(dip), 0, -math.sin(dip)])).astype(int)
    return row(accel.tolist(), mag=mag.tolist())


@pytest.mark.parametrize("dip", [0, 66, -50, 80, 85])
@pytest.mark.parametrize("yaw", range(-180, 180, 24))
def test_the_heading_is_right_at_once(yaw, dip):
    for roll, pitch in ((0, 0), (30, -40), (-120, 70), (180, 0), (0, 90), (10, -90), (90, 0)):
        counts = counts_at(roll, pitch, yaw, dip)
        filter = Mahony9(1000, SCALE, 4096)
        assert filter.seed(counts) is True
        assert filter.heading_seeded is True
        true = motions.quaternion_zyx(yaw, pitch, roll)
        assert mahony_float.angle_between(filter.quaternion_floats(), true) < 0.1
        # what is seeded is what the feedback asks for: the next step leaves it there
        before = filter.quaternion_floats()
        filter.update(counts)
        assert filter.mag_age == 0
        assert mahony_float.angle_between(before, filter.quaternion_floats()) < 1e-4


@pytest.mark.parametrize(
    "change",
    [
        {"flags": 1}, {"mag": (0, 0, 0)}, {"mag": (0, 15, 0)}, {"mag": (32767, 0, 0)},
        {"mag": (0, -32768, 0)}, {"mag": (0, 0, -300)}, {"mag": (8, 0, -300)}, {"mag": (0, 0, 300)},
    ],
    ids=str,
)  # fmt: skip
def test_seed_has_yaw_0_and_says_so_without_a_field_that_can_be_used(change):
    nine, six = (kind(200, SCALE, 4096) for kind in (Mahony9, Mahony6))
    nine.seed(row(mag=(0, 200, 0)))
    assert nine.heading_seeded
    counts = row(**{"mag": (0, 200, -300), **change})
    assert nine.seed(counts) is six.seed(counts) is True
    assert nine.heading_seeded is False
    assert nine.quaternion_floats() == six.quaternion_floats() == (1, 0, 0, 0)


def test_a_heading_from_a_steep_field_is_still_taken():
    filter = Mahony9(200, SCALE, 4096)
    filter.seed(row(mag=(0, 10, -300)))
    assert filter.heading_seeded
    out = array("i", [0] * 3)
    filter.angles(out)
    assert out[2] == -90000


def test_seed_says_so_when_there_is_no_gravity():
    filter = Mahony9(200, SCALE, 4096)
    filter.seed(row())
    assert filter.seed(row((0, 0, 255))) is False
    assert filter.heading_seeded is False
    assert filter.quaternion_floats() == (1, 0, 0, 0)


# -- feedback
def turned(rate, kp):
    """A filter that is wrong by 90 deg of heading and has just had a magnetometer sample."""
    filter = Mahony9(rate, SCALE, 4096, kp=kp)
    filter.seed(row())
    filter.set_quaternion(1, 0, 0, 1)
    return filter


def heading_error(filter):
    w, _, _, z = filter.quaternion_floats()
    return math.degrees(2 * math.atan2(z, w))


@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize("kp", [0.5, 2])
def test_a_heading_error_of_90_deg_falls_with_the_time_constant_of_kp(kp, every):
    """In a level field the error psi follows psi' = -kp sin(psi): tan(psi/2) = exp(-kp t)."""
    filter = turned(200, kp)
    tau = round(200 / kp)
    for k in range(3 * tau + 1):
        filter.update(row(flags=1 if k % every else 3))
        if k and k % tau == 0:
            expected = math.degrees(2 * math.atan(math.exp(-(k + 1) / tau)))
            # (1 - a)**(t/a) is a little less than exp(-t)
            rel = 0.01 + 0.6 * kp * every / 200 * k / tau
            assert heading_error(filter) == pytest.approx(expected, rel=rel)


@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize("dip", [30, 60, -60])
def test_the_steeper_the_field_the_longer_it_takes(dip, every):
    """1 / (kp (1 - sin dip)): what turns the attitude about the horizontal the accelerometer takes back."""
    kp = 4
    slow = 1 - math.sin(math.radians(abs(dip)))
    filter = turned(500, kp)
    mag = [
        round(20000 * math.cos(math.radians(dip))),
        0,
        round(-20000 * math.sin(math.radians(dip))),
    ]
    found = []
    tau = round(500 / (kp * slow))
    for k in range(5 * tau + 1):
        filter.update(row(mag=mag, flags=1 if k % every else 3))
        if k and k % tau == 0:
            found.append(heading_error(filter))
    assert found[4] / found[3] == pytest.approx(math.exp(-1), rel=0.03)
    assert found[4] < 2


@pytest.mark.parametrize("accel, flags", [((0, 0, 32767), 7), ((0, 0, 0), 3), ((0, 0, 255), 3)])
def test_the_magnetometer_acts_without_the_accelerometer_too(accel, flags):
    filter = turned(200, 2)
    for _ in range(100):  # one time constant
        filter.update(row(accel, flags=flags))
    expected = math.degrees(2 * math.atan(math.exp(-1)))
    assert heading_error(filter) == pytest.approx(expected, rel=0.02)
    before = heading_error(filter)
    for _ in range(100):
        filter.update(row(accel, flags=flags & ~2))
    assert heading_error(filter) == before


def test_the_integral_finds_the_bias_on_all_three_axes():
    filter = Mahony9(200, SCALE, 4096, kp=1, ki=0.3)
    for k in range(200 * 60):
        filter.update(row(gyro=(33, -49, 16), flags=1 if k % 2 else 3))
    out = array("i", [0] * 3)
    filter.bias_mdps(out)
    assert list(out) == pytest.approx([33000 / 16.4, -49000 / 16.4, 16000 / 16.4], rel=0.005)
    # and stands still while there is no feedback
    state = list(filter.state)
    for _ in range(10):
        filter.update(row(flags=2))
    assert list(filter.state)[mahony._I : mahony._I + 3] == state[mahony._I : mahony._I + 3]


@pytest.mark.parametrize("mag", [(0, 0, 200), (0, 0, -200)])
def test_a_vertical_field_turns_nothing(mag):
    filter = Mahony9(200, SCALE, 4096, kp=2)
    filter.set_quaternion(3, 0, 0, 1)
    before = heading_error(filter)
    for _ in range(200):
        filter.update(row(mag=mag))
    assert heading_error(filter) == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize(
    "rate, kp, most",
    [
        (200, 0.5, 20),  # 1/10 s
        (1000, 0.5, 100),
        (8000, 0.5, 253),
        (1000, 50, 10),  # kp n dt = 1/2
        (200, 20, 5),
        (200, 60, 1),
        (50, 10, 1),  # |W| < 1 rad
        (20000, 0, 253),
    ],
)
def test_a_sample_after_a_gap_acts_with_so_many_steps_at_the_most(rate, kp, most):
    """In a level field, at right angles to it, so many steps turn the heading by kp n dt."""
    filter = Mahony9(rate, SCALE, 4096, kp=kp)
    filter.set_quaternion(1, 0, 0, 1)
    filter.update(row())
    step = math.degrees(kp * most / rate)
    assert 90 - heading_error(filter) == pytest.approx(step, rel=1e-3)
    if kp:
        filter.set_quaternion(1, 0, 0, 1)
        filter.update(row())
        assert 90 - heading_error(filter) == pytest.approx(step / most, rel=1e-3)


def test_the_gain_does_not_depend_on_the_magnetometers_rate():
    """A crooked field pulls the heading; how far it has come after 1 s is the same at 10 and 1000 Hz."""
    came = []
    for every in (1, 3, 10, 33, 100):
        filter = Mahony9(1000, SCALE, 4096, kp=0.5)
        filter.seed(row())
        for k in range(1, 1001):
            filter.update(row(mag=(200, 20, -300), flags=1 if k % every else 3))
        came.append(heading_error(filter))
    assert came == pytest.approx([came[0]] * 5, rel=0.03)
    assert abs(came[0]) > 0.5


# -- ranges
@pytest.mark.parametrize("rate", [50, 100, 200, 500, 1000, 2000, 4000, 8000, (2000, 7)])
@pytest.mark.parametrize("scale", [(131, 1), (131, 2), (164, 5), (82, 5)])
@pytest.mark.parametrize("kp, ki", [(10, 1), (0.5, 0), (0.5, 0.02), (0.001, 1e-6), (0, 0)])
def test_the_usual_rates_ranges_and_gains_are_accepted_and_held(rate, scale, kp, ki):
    filter = Mahony9(rate, scale, 4096, kp, ki)
    twin = Mahony9Float.like(filter)
    assert twin.kp == pytest.approx(kp, rel=1e-4 if kp > 0.1 else 5e-3)
    assert twin.ki == pytest.approx(ki, rel=1e-4)
    hz = twin.dt**-1
    most = min(math.ceil(hz / 10 - 1e-9), 253)
    if kp < 1:
        assert twin.mag_most == most
    assert kp * twin.mag_most * twin.dt <= 0.5001


def test_what_the_numbers_cannot_hold_is_refused_with_the_range_that_they_can():
    """Two errors of 1 leave half the room for kp, where the gyro takes much of it."""
    with pytest.raises(ValueError, match=r"kp is 15, expected 0 or 0\.\d+\.\.11\.\d+ rad/s"):
        Mahony9(50, SCALE, 4096, kp=15)
    Mahony6(50, SCALE, 4096, kp=15)
    Mahony9(50, SCALE, 4096, kp=11)
    with pytest.raises(ValueError, match=r"rate is 20 Hz, expected 39\.\."):
        Mahony9(20, SCALE, 4096)
    with pytest.raises(ValueError, match=r"kp is 150, expected 0 or 0\.000006\.\."):
        Mahony9(200, SCALE, 4096, kp=150)


def test_six_axes_use_no_magnetometer():
    assert Mahony6(200, SCALE, 4096).state[mahony._MAG_MOST] == 0
