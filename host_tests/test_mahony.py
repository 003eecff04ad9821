"""Mahony6 and Mahony9: as accurate as their float twins, and right at every gate and limit.

Mahony9 at any magnetometer rate; without one it is Mahony6 bit for bit.
"""

import math
import random
from array import array

import motions
import numpy as np
import pytest
from histories import ONE, SCALE, angles_between, bias_at_rest, hold, of_twin
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import mahony_float
from reference.mahony_float import Mahony9Float, MahonyFloat
from samples import counts, run
from upright import mahony
from upright.mahony import Mahony6, Mahony9
from upright_host import scoring, trials, words
from upright_host.simulate import best_runtime as quickest

AT = words.places("mahony")
GAINS = [(0.5, 0), (1, 0.02)]
EVERY = [1, 3, 10]  # steps from one magnetometer sample to the next
OF_SIX = slice(0, mahony._MAG_MOST)  # the words that both filters have
LIMIT_DEG = 0.01


def row(accel=(0, 0, 4096), gyro=(0, 0, 0), mag=(200, 0, 0), flags=3):
    return array("h", [*accel, *gyro, *mag, 0, flags])


def with_gains(kp, ki):
    return {"kp": kp, "ki": ki}


def twin_history(rendered, kp, ki, every=0, bias=(), **options):
    """The float twin over all rows; a fresh magnetometer every so many, with none the filter of six axes."""
    kind, twin = (Mahony9, Mahony9Float) if every else (Mahony6, MahonyFloat)
    return of_twin(kind, twin, rendered, every, bias, with_gains(kp, ki), **options)


@pytest.fixture
def history(filter_history):
    """history(rendered, kp, ki, every, bias): the filter over all rows, (n, 4) int32."""

    def run(rendered, kp, ki, every=0, bias=()):
        options = {"gains": with_gains(kp, ki), "bias": bias, "mag_every": every}
        return filter_history(quickest(), rendered, f"mahony{9 if every else 6}", **options).q29

    return run


# -- accuracy; pytest -rP shows the figures
@pytest.mark.slow
@pytest.mark.parametrize("every", [0, *EVERY])
@pytest.mark.parametrize("name", motions.MOTIONS)
def test_within_a_hundredth_of_a_degree_of_the_float_twin(history, name, every):
    six = [(*run, *gains) for run in ((200, 30), (500, 10), (1000, 6)) for gains in GAINS]
    nine = [(200, 20, *GAINS[0]), (1000, 4, *GAINS[1])]
    for rate, seconds, kp, ki in nine if every else six:
        rendered = motions.render(name, rate=(rate, 1), seconds=seconds)
        what = f"{name} {rate} Hz {seconds} s kp {kp} ki {ki} mag every {every}"
        q, twin = (of(rendered, kp, ki, every) for of in (history, twin_history))
        hold(what, q, twin, LIMIT_DEG)


@pytest.mark.slow
@pytest.mark.parametrize("name, rate", [("static", 1000), ("spin", 500), ("bursts", 200)])
def test_within_a_hundredth_of_a_degree_of_the_float_twin_for_ten_minutes(history, name, rate):
    seconds = 600 if quickest() != "cpython" else 60
    rendered = motions.render(name, rate=(rate, 1), seconds=seconds, substeps=2)
    q, twin = history(rendered, 0.5, 0), twin_history(rendered, 0.5, 0)
    hold(f"{name} {rate} Hz {seconds} s kp 0.5 ki 0", q, twin, LIMIT_DEG)


def test_the_comparison_sees_a_first_order_integrator_and_a_changed_q0(history):
    """The twin of the accuracy tests: two known faults stand out from the same figures."""
    rendered = motions.render("spin", seconds=10)
    q = history(rendered, 0.5, 0)
    first = angles_between(q, twin_history(rendered, 0.5, 0, order=1)).max()
    in_place = angles_between(q, twin_history(rendered, 0.5, 0, order=1, in_place=True)).max()
    assert first > 10 * LIMIT_DEG
    assert in_place > 10 * LIMIT_DEG


def test_the_series_converges_to_the_closed_form_order_by_order(history):
    rendered = motions.render("spin", seconds=5)
    exact = twin_history(rendered, 0.5, 0)
    errors = [
        angles_between(exact, twin_history(rendered, 0.5, 0, order=k)).max() for k in (1, 2, 3, 4)
    ]
    # terms 2 and 4 mend what the renormalisation mends anyhow; the angle gains at 3
    assert errors[0] > 50 * errors[2]
    assert errors[3] < errors[2] < 1e-3


@pytest.mark.parametrize("dip", [80, -80, 0])
@pytest.mark.parametrize("name", ["slow", "coning"])
def test_a_steep_field_is_followed_as_well(history, monkeypatch, name, dip):
    """An ideal sensor, but for its counts: the field's horizontal part is 28 of them at 80 deg."""
    monkeypatch.setattr(motions, "DIP_DEG", dip)
    rendered = motions.render(name, seconds=20, errors=None)
    q = history(rendered, 1, 0.02, 1)
    hold(f"{name} dip {dip}", q, twin_history(rendered, 1, 0.02, 1), LIMIT_DEG)
    worst = angles_between(q, rendered.q_true).max()
    print(f"{name} dip {dip}: {worst:.3f} deg from the truth")
    assert worst < (4 if dip else 0.3)


@pytest.mark.parametrize(("ki", "every"), [(0.02, 0), (0, 1)])
def test_within_a_hundredth_of_a_degree_of_the_float_twin_on_a_recorded_trial(
    history, recorded, ki, every
):
    trial = trials.load(recorded)
    bias = bias_at_rest(trial)
    if quickest() == "cpython":
        trial.counts = trial.counts[:5000]
    q, twin = (of(trial, 0.5, ki, every, bias) for of in (history, twin_history))
    hold(f"{trial.name} kp 0.5 ki {ki} mag every {every}", q, twin, LIMIT_DEG)
    if every and trial.name.startswith("broad") and quickest() != "cpython":
        # Mahony with these gains has 7.8 deg on all of BROAD, 3.1 of it inclination
        score = scoring.score_trial(q / ONE, trial)
        print(f"{trial.name}: inclination {score.inclination:.2f} total {score.total:.2f} deg")
        assert score.inclination < 7
        assert score.total < 14


# -- seed, set_quaternion, bias
def test_set_quaternion_normalises():
    filter = Mahony6(200, SCALE, 4096)
    out = array("i", [0] * 4)
    filter.set_quaternion(0, -3, 0, 4)
    filter.quaternion(out)
    assert list(out) == [0, round(-0.6 * ONE), 0, round(0.8 * ONE)]
    assert list(filter.state[filter.QUATERNION : filter.QUATERNION + 4]) == list(out)
    filter.set_quaternion(1e-3, 0.0, 0, -1e-3)
    assert filter.quaternion_floats() == pytest.approx((0.5**0.5, 0, 0, -(0.5**0.5)), abs=1e-9)
    with pytest.raises(ValueError, match="no direction"):
        filter.set_quaternion(0, 0, 0, 0)


# -- feedback
def test_the_integral_finds_the_bias_across_gravity_and_no_other():
    filter = Mahony6(200, SCALE, 4096, kp=1, ki=0.3)
    run(filter, counts(gx=33, gy=-49, gz=16), 200 * 60)
    out = array("i", [0] * 3)
    filter.bias_mdps(out)
    assert out[0] == pytest.approx(33000 / 16.4, rel=0.002)
    assert out[1] == pytest.approx(-49000 / 16.4, rel=0.002)
    assert abs(out[2]) < 200
    filter.integral_mdps(out)
    assert out[0] == pytest.approx(-33000 / 16.4, rel=0.002)


@pytest.mark.parametrize("limit", [20, 2.5, 0])
def test_the_integral_stays_within_its_limit_and_leaves_it_again(limit):
    """A bias 8 deg/s beyond the limit; the proportional part holds the rest."""
    filter = Mahony6(200, SCALE, 4096, kp=0.5, ki=1, bias_limit_dps=limit)
    out = array("i", [0] * 3)
    for sign in (1, -1):
        worst = 0
        for _ in range(40):
            run(filter, counts(gx=sign * round(16.4 * (limit + 8))), 100)
            filter.integral_mdps(out)
            worst = max(worst, abs(out[0]))
        assert worst == round(1000 * limit)
        assert out[0] == -sign * round(1000 * limit)


def test_set_bias_starts_the_integral_again():
    filter = Mahony6(200, SCALE, 4096, kp=1, ki=0.3)
    run(filter, counts(gx=33), 2000)
    filter.set_bias(33 * 256, 0, 0)
    out = array("i", [9] * 3)
    filter.integral_mdps(out)
    assert list(out) == [0, 0, 0]


# -- gates
def tilted_filter(**gains):
    filter = Mahony6(200, SCALE, 4096, **gains)
    filter.set_quaternion(10, 1, 0, 0)
    return filter


def turned(filter, row):
    before = filter.quaternion_floats()
    filter.update(row)
    return mahony_float.angle_between(before, filter.quaternion_floats())


@settings(max_examples=30)
@given(st.integers(-400, 400), st.integers(-400, 400), st.integers(-400, 400))
@example(0, 0, 256)
@example(0, 255, 32)
def test_the_float_twin_takes_the_same_decision(x, y, z):
    filter = tilted_filter(kp=1)
    twin = MahonyFloat.like(filter)
    fed_back = turned(filter, counts(x, y, z)) > 1e-7
    twin.update(counts(x, y, z))
    cross = math.hypot(*(filter.state[AT.E + i] for i in range(3)))
    assert fed_back == (twin.fed_back and cross > 100)


def test_it_coasts_on_the_last_gyro_words_and_the_integral():
    filter = Mahony6(200, SCALE, 4096, kp=1, ki=0.3)
    run(filter, counts(gx=33), 200 * 60)
    out = array("i", [0] * 3)
    filter.integral_mdps(out)
    integral = list(out)
    filter.set_quaternion(1, 0, 0, 0)
    # the accelerometer words disagree with the attitude, and nothing must come of it
    run(filter, counts(4096, 0, 0, gx=33, gz=820, flags=0), 200)
    filter.integral_mdps(out)
    assert list(out) == integral
    filter.angles(out)
    assert out[2] == pytest.approx(50000, abs=5)  # 820 counts are 50 deg/s, for 1 s
    assert abs(out[0]) < 30  # the gyro's 2 deg/s are cancelled


# -- long runs and limits
def test_the_length_stays_one_over_100000_steps():
    filter = Mahony6(1000, SCALE, 4096)
    rng = random.Random(3)
    worst = 0
    for i in range(100000):
        if i % 50 == 0:
            row = counts(*(rng.randint(-32768, 32767) for _ in range(6)))
        filter.update(row)
        if i % 50 == 49:
            worst = max(worst, abs(math.hypot(*filter.state[1:5]) / ONE - 1))
    assert worst < 2e-8


@pytest.mark.parametrize("rate", [50, 100, 200, 500, 1000, 2000, 4000, 8000, (2000, 7)])
@pytest.mark.parametrize("scale", [(131, 1), (131, 2), (164, 5), (82, 5)])
@pytest.mark.parametrize("kp, ki", [(10, 1), (0.5, 0), (0.5, 0.02), (0.001, 1e-6), (0, 0)])
@pytest.mark.parametrize("axes", [6, 9])
def test_the_usual_rates_ranges_and_gains_are_accepted_and_held(rate, scale, kp, ki, axes):
    kp *= 2 if kp == 10 and axes == 6 else 1
    kind, of = (Mahony6, MahonyFloat) if axes == 6 else (Mahony9, Mahony9Float)
    twin = of.like(kind(rate, scale, 4096, kp, ki))
    assert twin.kp == pytest.approx(kp, rel=1e-4 if kp > 0.1 else 5e-3)
    assert twin.ki == pytest.approx(ki, rel=1e-4)
    assert twin.gyro == pytest.approx(math.radians(scale[1] / scale[0]), rel=1e-6)
    assert twin.integral_limit == pytest.approx(math.radians(20), rel=1e-6)
    if axes == 9:
        if kp < 1:
            assert twin.mag_most == min(math.ceil(1 / twin.dt / 10 - 1e-9), 253)
        assert kp * twin.mag_most * twin.dt <= 0.5001


@pytest.mark.parametrize(
    "change, said",
    [
        ({"rate": 20}, r"rate is 20 Hz, expected 39\.\.\d+ Hz at 82/5 LSB"),
        ({"rate": (39, 2)}, r"rate is 39/2 Hz, expected 39\.\."),
        ({"rate": 1000000}, r"rate is 1000000 Hz, expected 39\.\.285\d\d\d Hz"),
        ({"gyro_scale": (1, 1)}, r"rate is 200 Hz, expected 6\d\d\.\.\d+ Hz at 1/1 LSB"),
        ({"kp": 150}, r"kp is 150, expected 0 or 0\.000006\.\.99\.992000 rad/s at a rate of 200"),
        ({"rate": 40, "kp": 15}, r"kp is 15, expected 0 or 0\.\d+\.\.3\.\d+ rad/s"),
        ({"kp": 1e-6}, r"kp is 1e-06, expected 0 or 0\.000006"),
        ({"kp": -1}, "kp is -1, expected a number from 0"),
        ({"ki": 30}, r"ki is 30, expected 0 or 0\.000001\.\.19\.530057 rad/s\*\*2"),
        ({"ki": 1e-7}, "ki is 1e-07, expected 0 or 0.000001"),
        ({"bias_limit_dps": 251}, r"bias_limit_dps is 251, expected 0\.\.250 deg/s"),
    ],
)
def test_what_the_numbers_cannot_hold_is_refused_with_the_range_that_they_can(change, said):
    arguments = {"rate": 200, "gyro_scale": SCALE, "accel_lsb_per_g": 4096, **change}
    with pytest.raises(ValueError, match=said):
        Mahony6(**arguments)


def test_the_ends_of_the_ranges_in_a_message_are_accepted():
    """What a refusal names as allowed is allowed."""
    for rate in (39, 285675):
        Mahony6(rate, SCALE, 4096, kp=0)
    for kp in (0.000006, 99.992):
        Mahony6(200, SCALE, 4096, kp=kp)
    for ki in (0.000001, 19.53):
        Mahony6(200, SCALE, 4096, ki=ki)
    for rate in (38, 285680):
        with pytest.raises(ValueError, match="rate is"):
            Mahony6(rate, SCALE, 4096, kp=0)


def test_the_gains_are_those_of_the_widespread_code():
    """exInt += ex * Ki per sample is ki = Ki / dt; Kp is kp: compared over a second of tilt."""
    rate, kp, per_sample = 200, 2.0, 0.0005
    filter = Mahony6(rate, SCALE, 4096, kp, per_sample * rate)
    filter.set_quaternion(math.cos(0.1), math.sin(0.1), 0, 0)
    half_t = 0.5 / rate
    angle, integral = 0.2, 0.0
    for _ in range(rate):
        filter.update(counts())
        e = -math.sin(angle)  # a x v for a = (0, 0, 1), v = (0, sin, cos)
        integral += e * per_sample
        angle += 2 * half_t * (kp * e + integral)
    out = array("i", [0] * 3)
    filter.angles(out)
    assert out[0] / 1000 == pytest.approx(math.degrees(angle), abs=0.005)


# -- nine axes, without a magnetometer
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


# -- seed with a magnetometer
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


# -- feedback of a magnetometer
def turned_off(rate, kp):
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
    filter = turned_off(200, kp)
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
    filter = turned_off(500, kp)
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
    filter = turned_off(200, 2)
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


# -- ranges of nine axes
def test_two_errors_leave_half_the_room_for_kp():
    """Where the gyro takes much of it."""
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
