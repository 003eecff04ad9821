"""Mahony6: as accurate as its float twin, the same bits on every runtime, and right at every gate and limit."""

import math
import random
from array import array

import motions
import numpy as np
import pytest
from histories import ONE, SCALE, angles_between, bias_at_rest, rows_of
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import mahony_float
from reference.mahony_float import MahonyFloat
from samples import counts, run
from upright import mahony
from upright.mahony import Mahony6
from upright_host import trials, words
from upright_host.simulate import best_runtime as quickest

AT = words.places("mahony")
GAINS = [(0.5, 0), (1, 0.02)]
LIMIT_DEG = 0.01


def float_history(rendered, kp, ki, bias=None, **options):
    """The float twin over all rows, with the flags that portable/filter_history.py gives: (n, 4)."""
    rows = rows_of(rendered, 0)
    integer = Mahony6(rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, kp, ki)
    if bias:
        integer.set_bias(*bias)
    integer.seed(rows[0])
    twin = MahonyFloat.like(integer, **options)
    q = np.empty((len(rows), 4))
    for i, row in enumerate(rows):
        twin.update(row)
        q[i] = twin.q
    return q


@pytest.fixture
def history(filter_history):
    """history(runtime, rendered, kp, ki, *bias): the six-axis filter over all rows, (n, 4) int32."""

    def run(runtime, rendered, kp, ki, *bias):
        gains = {"kp": kp, "ki": ki}
        options = {"gains": gains, "bias": bias, "mag_every": 0}
        return filter_history(runtime, rendered, "mahony6", **options).q29

    return run


# -- accuracy; pytest -rP shows the figures
def compare(what, q, twin):
    worst = angles_between(q, twin).max()
    print(f"{what}: {worst:.6f} deg")
    assert worst < LIMIT_DEG


@pytest.mark.parametrize("name", motions.MOTIONS)
@pytest.mark.parametrize("rate, seconds", [(200, 30), (500, 10), (1000, 6)])
def test_within_a_hundredth_of_a_degree_of_the_float_twin(history, name, rate, seconds):
    rendered = motions.render(name, rate=(rate, 1), seconds=seconds)
    for kp, ki in GAINS:
        q = history(quickest(), rendered, kp, ki)
        compare(f"{name} {rate} Hz {seconds} s kp {kp} ki {ki}", q, float_history(rendered, kp, ki))


@pytest.mark.slow
@pytest.mark.parametrize("name, rate", [("static", 1000), ("spin", 500), ("bursts", 200)])
def test_within_a_hundredth_of_a_degree_of_the_float_twin_for_ten_minutes(history, name, rate):
    runtime = quickest()
    seconds = 600 if runtime != "cpython" else 60
    rendered = motions.render(name, rate=(rate, 1), seconds=seconds, substeps=2)
    q = history(runtime, rendered, 0.5, 0)
    compare(f"{name} {rate} Hz {seconds} s kp 0.5 ki 0", q, float_history(rendered, 0.5, 0))


def test_the_comparison_sees_a_first_order_integrator_and_a_changed_q0(history):
    """The twin of the accuracy tests: two known faults stand out from the same figures."""
    rendered = motions.render("spin", seconds=10)
    q = history(quickest(), rendered, 0.5, 0)
    first = angles_between(q, float_history(rendered, 0.5, 0, order=1)).max()
    in_place = angles_between(q, float_history(rendered, 0.5, 0, order=1, in_place=True)).max()
    assert first > 10 * LIMIT_DEG
    assert in_place > 10 * LIMIT_DEG


def test_the_series_converges_to_the_closed_form_order_by_order(history):
    rendered = motions.render("spin", seconds=5)
    exact = float_history(rendered, 0.5, 0)
    errors = [
        angles_between(exact, float_history(rendered, 0.5, 0, order=k)).max() for k in (1, 2, 3, 4)
    ]
    # terms 2 and 4 mend what the renormalisation mends anyhow; the angle gains at 3
    assert errors[0] > 50 * errors[2]
    assert errors[3] < errors[2] < 1e-3


def test_within_a_hundredth_of_a_degree_of_the_float_twin_on_a_recorded_trial(history, recorded):
    trial = trials.load(recorded)
    bias = bias_at_rest(trial)
    runtime = quickest()
    if runtime == "cpython":
        trial.counts = trial.counts[:5000]
    q = history(runtime, trial, 0.5, 0.02, *bias)
    compare(f"{trial.name} kp 0.5 ki 0.02", q, float_history(trial, 0.5, 0.02, bias))


# -- seed, set_quaternion, bias
attitude_part = st.integers(-4096, 4096)


@settings(max_examples=60)
@given(attitude_part, attitude_part, attitude_part)
@example(0, 0, -4096)
@example(4096, 0, 0)
@example(-4096, 0, 0)
@example(1, 0, -4096)
def test_seed_levels_at_once_at_any_attitude(x, y, z):
    if math.hypot(x, y, z) < 300:
        return
    filter = Mahony6(200, SCALE, 4096)
    assert filter.seed(counts(x, y, z)) is True
    out = array("i", [0, 0, 0])
    filter.angles(out)
    assert abs(out[1] - 1000 * math.degrees(math.atan2(-x, math.hypot(y, z)))) <= 10
    if math.hypot(y, z) > 40:  # roll is lost near gimbal lock
        wrong = out[0] - 1000 * math.degrees(math.atan2(y, z))
        assert abs((wrong + 180000) % 360000 - 180000) <= 10
        assert abs(out[2]) <= 10
    # what is seeded is what the feedback asks for: the next step leaves it there
    before = filter.quaternion_floats()
    filter.update(counts(x, y, z))
    assert mahony_float.angle_between(before, filter.quaternion_floats()) < 1e-4


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


def test_a_bias_is_subtracted_to_a_256th_of_a_count():
    """100 s at rest with the bias of 3.3 counts: without it the yaw would drift by 20 deg."""
    filter = Mahony6(200, SCALE, 4096, kp=0)
    bias = round(3.3 * 256)
    filter.set_bias(0, 0, bias)
    rng = random.Random(1)
    total = 0
    for _ in range(20000):
        gz = 3 + (rng.random() < 0.3)
        total += gz
        filter.update(counts(gz=gz))
    out = array("i", [0] * 3)
    filter.angles(out)
    expected = (total - 20000 * bias / 256) / 16.4 / 200
    assert out[2] == pytest.approx(1000 * expected, abs=1)


# -- feedback
def test_it_levels_from_a_wrong_start_with_the_time_constant_of_kp():
    filter = Mahony6(200, SCALE, 4096, kp=2)
    filter.set_quaternion(math.cos(0.1), math.sin(0.1), 0, 0)
    tilt = []
    out = array("i", [0] * 3)
    for _ in range(3):
        filter.angles(out)
        tilt.append(out[0])
        run(filter, counts(), 100)  # half a second: one time constant
    assert tilt[1] / tilt[0] == pytest.approx(math.exp(-1), rel=0.02)
    assert tilt[2] / tilt[1] == pytest.approx(math.exp(-1), rel=0.02)


def test_it_levels_from_upside_down():
    filter = Mahony6(200, SCALE, 4096, kp=2)
    filter.set_quaternion(0.001, 1, 0, 0)
    run(filter, counts(), 200 * 15)
    out = array("i", [0] * 3)
    filter.angles(out)
    assert abs(out[0]) <= 2 and abs(out[1]) <= 2


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


@pytest.mark.parametrize(
    "row",
    [
        counts(flags=0),
        counts(flags=2),
        counts(flags=5),
        counts(0, 0, 0),
        counts(0, 0, 254),
        counts(100, -100, 100),
    ],
    ids=["stale", "only a fresh magnetometer", "full scale", "zero", "62 mg", "42 mg"],
)
def test_no_feedback_from_an_accelerometer_that_cannot_be_used(row):
    filter = tilted_filter(kp=1, ki=0.5)
    assert turned(filter, row) < 1e-7
    out = array("i", [9] * 3)
    filter.integral_mdps(out)
    assert list(out) == [0, 0, 0]


@pytest.mark.parametrize("row", [counts(flags=1), counts(flags=9), counts(0, 0, 256)])
def test_feedback_from_one_that_can(row):
    assert turned(tilted_filter(kp=1), row) > 0.01


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


@pytest.mark.parametrize("rate", [50, 200, (2000, 7), 8000])
@pytest.mark.parametrize("scale", [(131, 1), (131, 2), (164, 5), (82, 5)])
def test_the_gyro_gain_is_exact(rate, scale):
    """One full turn about z at three quarters of full scale ends where it began."""
    filter = Mahony6(rate, scale, 4096, kp=0)
    num, den = rate if isinstance(rate, tuple) else (rate, 1)
    gz = 24000
    steps = round(360 * scale[0] / scale[1] / gz * num / den)
    run(filter, counts(gz=gz), steps)
    yaw = array("i", [0] * 3)
    filter.angles(yaw)
    expected = gz * scale[1] / scale[0] * steps * den / num
    assert (yaw[2] / 1000 - expected + 180) % 360 - 180 == pytest.approx(0, abs=0.002)


@pytest.mark.parametrize("rate", [50, 100, 200, 500, 1000, 2000, 4000, 8000, (2000, 7)])
@pytest.mark.parametrize("scale", [(131, 1), (131, 2), (164, 5), (82, 5)])
@pytest.mark.parametrize("kp, ki", [(20, 1), (0.5, 0), (0.001, 1e-6), (0, 0)])
def test_the_usual_rates_ranges_and_gains_are_accepted_and_held(rate, scale, kp, ki):
    filter = Mahony6(rate, scale, 4096, kp, ki)
    twin = MahonyFloat.like(filter)
    assert twin.kp == pytest.approx(kp, rel=1e-4 if kp > 0.1 else 5e-3)
    assert twin.ki == pytest.approx(ki, rel=1e-4)
    assert twin.gyro == pytest.approx(math.radians(scale[1] / scale[0]), rel=1e-6)
    assert twin.integral_limit == pytest.approx(math.radians(20), rel=1e-6)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"rate": 20}, r"rate is 20 Hz, expected 39\.\.\d+ Hz at 82/5 LSB"),
        ({"rate": (39, 2)}, r"rate is 39/2 Hz, expected 39\.\."),
        ({"rate": 1000000}, r"rate is 1000000 Hz, expected 39\.\.285\d\d\d Hz"),
        ({"rate": 0}, "rate is 0, expected a positive int or a pair"),
        ({"rate": 200.5}, "rate is 200.5, expected a positive int or a pair"),
        ({"rate": (200, 0)}, r"rate is \(200, 0\), expected"),
        ({"gyro_scale": (82, -5)}, r"gyro_scale is \(82, -5\), expected"),
        ({"gyro_scale": 16.4}, "gyro_scale is 16.4, expected"),
        ({"gyro_scale": (1, 1)}, r"rate is 200 Hz, expected 6\d\d\.\.\d+ Hz at 1/1 LSB"),
        ({"accel_lsb_per_g": 40000}, r"accel_lsb_per_g is 40000, expected an int, 64\.\.32767"),
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


def test_the_module_says_what_it_is():
    assert (Mahony6.NAME, Mahony6.AXES, Mahony6.QUATERNION) == ("mahony6", 6, mahony._Q)
