"""The Kalman filters of angles: the textbook's equations, gains that settle where other people's code settles, and a
bias that stays right when the body turns."""

import math
import random
from array import array
from pathlib import Path

import motions
import numpy as np
import overflow
import pytest
from histories import ONE, SCALE, bias_at_rest, hold, of_twin
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference.kalman_float import KalmanFloat, PerAngleFloat, ScalarFloat
from samples import counts, run
from upright import complementary, kalman
from upright.complementary import Euler6
from upright.kalman import Kalman6, KalmanFilter
from upright_host import trials
from upright_host.simulate import best_runtime as quickest

TURN = 1 << 30
LIMIT_DEG = 0.05
# As in test_complementary.py: it comes so near the pole that a difference grows by 1/cos(pitch), up to 32, each time
NEAR_THE_POLE_DEG = {("bursts", 100): 1}
QUICK = {"q_angle": 0.001, "q_bias": 0.003, "r_angle": 0.03}  # as in widespread code


def other(name):
    return pytest.importorskip(name, reason=f"{name} is what the Kalman gains are compared with")


# -- the scalar filter
def settled(q):
    """The gain at which it settles, from the textbook's quadratic."""
    return (math.sqrt(q * q + 4 * q) - q) / 2 if q else 0


ratios = st.floats(-10, 6).map(lambda e: 10.0**e)


@settings(max_examples=60)
@given(
    ratios,
    st.integers(-180000, 179999),
    st.lists(st.integers(-(10**6), 10**6), min_size=1, max_size=60),
)
@example(200.0, 179999, [-179999, 179999, 180000, -180000])
@example(1e-10, 0, [100000] * 50)
@example(1e-3, -180000, [179000] * 50)
def test_it_is_the_textbook_s_filter_to_one_unit(q, x, measurements):
    # Q to six digits, as the filter takes it
    q = float(f"{q:.5e}")
    filter, twin = KalmanFilter(x, q, 1), ScalarFloat(x, q, 1)
    for z in measurements:
        estimate = filter.update(z)
        assert abs(twin.wrap(estimate - twin.update(z))) <= 1
        assert -180000 <= estimate < 180000
        assert pytest.approx(twin.K, rel=2e-5) == filter.K
        assert pytest.approx(twin.P, rel=2e-5) == filter.P
        twin.x = float(estimate) if abs(abs(twin.wrap(z - twin.x)) - 180000) < 2 else twin.x
    assert filter.x == estimate


@settings(max_examples=10)
@given(
    st.floats(1e-4, 1e3),
    st.floats(1e-3, 1e3),
    st.lists(st.integers(-170000, 170000), min_size=1, max_size=40),
)
def test_it_is_filterpy_s_step_by_step(q, r, measurements):
    theirs = other("filterpy.kalman").KalmanFilter(dim_x=1, dim_z=1)
    q, r = float(f"{q:.5e}"), float(f"{r:.5e}")
    theirs.x, theirs.F, theirs.H = np.zeros((1, 1)), np.eye(1), np.eye(1)
    theirs.P, theirs.Q, theirs.R = np.eye(1) * r, np.eye(1) * q, np.eye(1) * r
    ours = KalmanFilter(0, q, r, None)
    for z in measurements:
        theirs.predict()
        theirs.update(z)
        assert abs(ours.update(z) - theirs.x[0, 0]) <= 1
        assert pytest.approx(theirs.K[0, 0], rel=2e-5) == ours.K
        assert pytest.approx(theirs.P[0, 0], rel=2e-5) == ours.P


def test_it_is_filterpy_s_across_half_a_turn():
    """filterpy does not wrap: its own innovation is handed to it, as its users do."""
    theirs = other("filterpy.kalman").KalmanFilter(dim_x=1, dim_z=1)
    theirs.x, theirs.F, theirs.H = np.array([[179000.0]]), np.eye(1), np.eye(1)
    theirs.P, theirs.Q, theirs.R = np.eye(1), np.eye(1) * 0.01, np.eye(1)
    ours = KalmanFilter(179000, 0.01, 1)
    rng = random.Random(5)
    crossed = 0
    for k in range(400):
        z = round(180000 + 3000 * math.sin(k / 20) + rng.gauss(0, 500))
        theirs.predict()
        theirs.update(theirs.x[0, 0] + math.remainder(z - theirs.x[0, 0], 360000))
        before = ours.x
        estimate = ours.update((z + 180000) % 360000 - 180000)
        assert abs(math.remainder(estimate - theirs.x[0, 0], 360000)) <= 1
        crossed += before * estimate < 0
    assert crossed >= 4


@pytest.mark.parametrize(
    "q, steps", [(1e6, 9), (200, 9), (1, 40), (0.1, 100), (1e-3, 600), (1e-5, 4500)]
)
def test_the_gain_settles_where_the_quadratic_says_and_then_stands_still(q, steps):
    filter = KalmanFilter(0, q, 1)
    gains = []
    for _ in range(steps):
        filter.update(1)
        gains.append(filter.K)
    assert pytest.approx(settled(q), rel=1e-8) == filter.K
    assert filter.gain == int(filter.K * ONE)
    assert gains == sorted(gains, reverse=True)
    assert filter.state[kalman._SETTLED]
    before = list(filter.state[:6])
    filter.update(12345)
    assert list(filter.state[:6]) == before


def test_the_gain_of_a_hundred_thousandth_is_right_as_well():
    filter = KalmanFilter(0, 1e-10, 1)
    filter.state[kalman._GAIN], filter.state[kalman._GAIN_REST] = 5363, 0  # 1e-3 short of it
    for _ in range(1000):
        filter.update(0)
    # what is missing falls with a time constant of 50,000 steps
    exact = (5363 / ONE / 1e-5 - 1) * math.exp(-2e-5 * 1000)
    assert pytest.approx(exact, abs=2e-5) == filter.K / 1e-5 - 1


def test_much_copied_values_follow_the_newest_measurement_and_filter_nothing():
    """Q = 10 and R = 0.05: K = 0.995 from the first step on."""
    filter = KalmanFilter(0, 10.0, 0.05)
    assert filter.update(100000) == 99505
    assert pytest.approx(201 / 202) == filter.K
    assert pytest.approx(0.05 * 201 / 202) == filter.P
    for _ in range(9):
        filter.update(100000)
    assert pytest.approx(0.995049, abs=1e-6) == filter.K
    rng = random.Random(1)
    noise = [round(rng.gauss(0, 1000)) for _ in range(2000)]
    for q, r, most, least in ((10.0, 0.05, 1, 0.98), (0.001, 1, 0.15, 0.1)):
        filter = KalmanFilter(0, q, r)
        out = [filter.update(z) for z in noise]
        assert least < np.std(out) / np.std(noise) < most


def test_q_0_is_the_running_mean():
    filter = KalmanFilter(100, 0, 3, None)
    values = [100]
    rng = random.Random(2)
    for _ in range(300):
        values.append(rng.randint(-5000, 5000))
        assert abs(filter.update(values[-1]) - sum(values) / len(values)) <= 1


@pytest.mark.parametrize("start", [5000, 10000, -1000001])
def test_a_small_gain_arrives_at_the_last_unit(start):
    """K = 1e-4: a unit of innovation is a ten-thousandth of a unit a step."""
    filter = KalmanFilter(start, 1e-8, 1, None)
    filter.state[kalman._GAIN], filter.state[kalman._GAIN_REST] = round(1e-4 * ONE), 0
    z = 5000
    for _ in range(200):
        # a thousand steps at once would be exp(-0.1); so far off it is only the way there
        if abs(filter.x - z) > 20:
            filter.state[kalman._VALUE] += (z - filter.x) * 9 // 10
        for _ in range(1000):
            filter.update(z)
        if filter.x == z:
            break
    assert filter.x == z
    for _ in range(100):
        assert filter.update(z) == z


@pytest.mark.parametrize(
    "turn, half", [(360000, 180000), (7, 3), (360, 180), (1 << 30, 1 << 29), (2, 1)]
)
def test_estimates_stay_within_half_a_turn(turn, half):
    filter = KalmanFilter(half, 10, 1, turn)
    assert -half <= filter.x < turn - half
    rng = random.Random(3)
    for _ in range(300):
        assert -half <= filter.update(rng.randint(-ONE, ONE)) < turn - half


def test_it_takes_the_short_way_round():
    filter = KalmanFilter(179000, 0.01, 1)
    for _ in range(100):
        x = filter.update(-179000)
        assert abs(x) >= 179000
    assert x == -179000
    straight = KalmanFilter(179000, 0.01, 1, turn=None)
    assert min(straight.update(-179000) for _ in range(100)) < -170000
    assert any(
        abs(KalmanFilter(179000, 0.3, 1, turn=t).update(-179000)) < 100000 for t in (None, 0)
    )


def test_one_object_filters_one_signal():
    """What the C function with static variables does to three angles: each becomes a mixture of all."""
    angles = {"pitch": 10000, "roll": -20000, "yaw": 90000}
    shared = KalmanFilter(0, 1, 1)
    own = {name: KalmanFilter(z, 1, 1) for name, z in angles.items()}
    for _ in range(50):
        mixed = {name: shared.update(z) for name, z in angles.items()}
        apart = {name: own[name].update(z) for name, z in angles.items()}
    assert apart == angles
    assert all(abs(mixed[name] - z) > 3000 for name, z in angles.items())


@pytest.mark.parametrize(
    "arguments, kind, said",
    [
        ((0, -1, 1), ValueError, "Q is -1, expected 0 or a number from 1e-30"),
        ((0, 1, 0), ValueError, "R is 0, expected a number above 0"),
        ((0, 1, -0.5), ValueError, "R is -0.5, expected"),
        ((0, float("nan"), 1), ValueError, "Q is nan"),
        ((0, 1, float("inf")), ValueError, "R is inf"),
        ((0, "1", 1), TypeError, "Q is '1', expected a number"),
        ((0, True, 1), TypeError, "Q is True"),
        ((0.5, 1, 1), TypeError, "x is 0.5, expected an int"),
        ((1 << 30, 1, 1), ValueError, "x is 1073741824, expected an int within"),
        ((0, 1e-11, 1), ValueError, r"Q / R is 1e-11 / 1, expected 0 or 1e-10\.\.1e6"),
        ((0, 1, 1e-7), ValueError, "Q / R is 1 / 1e-07, expected"),
        ((0, 1, 1, 1), ValueError, "turn is 1, expected an int from 2 to 1073741824, or None"),
        ((0, 1, 1, -360), ValueError, "turn is -360"),
        ((0, 1, 1, 360.0), ValueError, "turn is 360.0"),
        ((0, 1, 1, 1 << 31), ValueError, "turn is 2147483648"),
    ],
)
def test_the_scalar_filter_refuses_what_it_cannot_hold(arguments, kind, said):
    with pytest.raises(kind, match=said):
        KalmanFilter(*arguments)


def test_the_ends_of_the_ratio_are_accepted():
    for q, r in ((1e-10, 1), (1e6, 1), (1e-20, 1e-10), (1e20, 1e14), (5, 5e-6)):
        filter = KalmanFilter(0, q, r)
        assert (q, r) == (filter.Q, filter.R)


@given(st.floats(1e-30, 9e29), st.sampled_from([np.float32, np.float64]))
@example(0.1, np.float32)
@example(999999.5, np.float64)
@example(1e-30, np.float32)
def test_six_digits_are_the_same_from_single_precision(value, kind):
    value = float(f"{value:.5e}")
    num, den = kalman._decimal(float(kind(value)), "value")
    assert num / den == pytest.approx(value, rel=1e-9)


# -- the attitude filter's gains
variances = st.floats(-6, 1).map(lambda e: float(f"{10.0**e:.5e}"))
small_variances = st.floats(-9, -1).map(lambda e: float(f"{10.0**e:.5e}"))


def model(rate, q_angle, q_bias):
    """F, H, Q of the two-state model, bias in deg/s."""
    dt = 1 / rate
    return np.array([[1, -dt], [0, 1]]), np.array([[1.0, 0]]), np.diag([q_angle * dt, q_bias * dt])


@settings(max_examples=60)
@given(st.sampled_from([50, 200, 1000]), variances, small_variances, st.floats(0.01, 30))
@example(200, 0.001, 2e-7, 20)
@example(200, 0.001, 0.003, 0.03)
def test_its_gains_solve_the_riccati_equation(rate, q_angle, q_bias, r_angle):
    solve = other("scipy.linalg").solve_discrete_are
    r_angle = float(f"{r_angle:.5e}")
    F, H, Q = model(rate, q_angle, q_bias)
    P = solve(F.T, H.T, Q, np.array([[r_angle]]))
    K = (P @ H.T / (H @ P @ H.T + r_angle))[:, 0]
    k1, k2 = kalman.steady_gains((rate, 1), q_angle, q_bias, r_angle)
    assert k1 / kalman.ONE == pytest.approx(K[0], rel=1e-6)
    assert k2 * rate / kalman.ONE == pytest.approx(-K[1], rel=1e-6)
    try:
        held = Kalman6(rate, SCALE, 4096, q_angle, q_bias, r_angle, bias_limit_dps=5).gains
    except ValueError:
        assert not 1e-6 < K[0] < 0.9999 or not 1e-9 < -K[1] / rate < 1e-3
        return
    assert held == pytest.approx([K[0], -K[1]], rel=1e-4)


@pytest.mark.parametrize("rate", [100, 200])
@pytest.mark.parametrize("noise", [(0.001, 0.003, 0.03), (0.01, 1e-3, 0.1)])
def test_its_gains_are_filterpy_s_after_a_long_run(rate, noise):
    theirs = other("filterpy.kalman").KalmanFilter(dim_x=2, dim_z=1)
    theirs.F, theirs.H, theirs.Q = model(rate, *noise[:2])
    theirs.R = np.array([[noise[2]]])
    for _ in range(40 * rate):
        theirs.predict()
        theirs.update(0)
    held = Kalman6(rate, SCALE, 4096, *noise).gains
    assert held == pytest.approx([theirs.K[0, 0], -theirs.K[1, 0]], rel=1e-4)


def test_without_a_bias_to_learn_it_is_the_scalar_filter():
    """q_bias = 0: what the gyro adds per step against the accelerometer's variance, and Euler6 bit for bit."""
    filter = Kalman6(200, SCALE, 4096, 0.02, 0, 1)
    assert filter.gains[0] == pytest.approx(settled(0.0001), rel=1e-4)
    plain = Euler6(200, SCALE, 4096)
    plain.state[complementary._K] = filter.state[kalman._K]
    plain.state[complementary._K_SHIFT] = filter.state[kalman._K_SHIFT]
    rng = random.Random(4)
    for _ in range(500):
        row = counts(*(rng.randint(-4000, 4000) for _ in range(6)))
        filter.update(row)
        plain.update(row)
    assert list(filter.state[:26]) == list(plain.state[:26])


def test_the_gains_of_the_docstring():
    for noise, tau, c in (((0.001, 2e-7, 20), 8.85, 0.00141), ((0.001, 0.003, 0.03), 0.25, 4.47)):
        k1, k2 = (200 * k for k in Kalman6(200, SCALE, 4096, *noise).gains)
        assert 1 / k1 == pytest.approx(tau, rel=0.03)
        assert k2 == pytest.approx(c, rel=0.02)
        n = noise[2] / 200
        assert k2 == pytest.approx(math.sqrt(noise[1] / n), rel=0.02)
        assert k1 == pytest.approx(math.sqrt(noise[0] / n + 2 * k2), rel=0.02)


# -- the attitude filter
def bias_dps(filter):
    out = array("i", [0] * 3)
    filter.bias_mdps(out)
    return [v / 1000 for v in out]


@pytest.fixture
def history(filter_history):
    """history(runtime, rendered, bias, **gains): the filter over all rows, (n, 4) int32."""

    def go(runtime, rendered, bias=(), **gains):
        return filter_history(runtime, rendered, "kalman6", gains=gains, bias=bias).q29

    return go


def compare(what, q, rendered, limit=LIMIT_DEG, bias=(), **gains):
    """With the twin over the same rows."""
    hold(what, q, of_twin(Kalman6, KalmanFloat, rendered, bias=bias, gains=gains), limit)


@pytest.mark.parametrize("name", motions.MOTIONS)
@pytest.mark.parametrize("rate, seconds", [(100, 20), (200, 5), (1000, 2)])
def test_within_a_twentieth_of_a_degree_of_the_float_twin(history, name, rate, seconds):
    rendered = motions.render(name, rate=(rate, 1), seconds=seconds)
    for gains in ({}, QUICK):
        q = history(quickest(), rendered, **gains)
        limit = NEAR_THE_POLE_DEG.get((name, rate), LIMIT_DEG)
        compare(f"{name} {rate} Hz {seconds} s {gains}", q, rendered, limit, **gains)


@pytest.mark.parametrize("known", [True, False], ids=["bias off", "raw"])
def test_within_a_twentieth_of_a_degree_of_the_float_twin_on_a_recorded_trial(
    history, recorded, known
):
    trial = trials.load(recorded)
    runtime = quickest()
    trial.counts = trial.counts[: 6000 if runtime != "cpython" else 4000]
    bias = bias_at_rest(trial) if known else ()
    compare(trial.name, history(runtime, trial, bias), trial, bias=bias)


def test_the_scalar_filter_and_all_gains_have_the_same_bits_on_every_runtime(
    portable, micropython_runtime
):
    expected = portable("cpython", "kalman_history.py")
    assert len(expected.splitlines()) == 27
    assert portable(micropython_runtime, "kalman_history.py") == expected


LIB = Path(kalman.__file__).parent


def test_nothing_leaves_32_bits_at_the_corners_of_the_accepted_range():
    watch = overflow.Watch()
    names = ("euler_kernels", "complementary", "kalman")
    k = overflow.loaded([LIB / f"{name}.py" for name in names], watch)["kalman"]
    words = kalman
    rng = random.Random(1)
    for rate, scale, limit in (
        (50, (82, 5), 250),
        (200, (82, 5), 20),
        (6, (131, 1), 0),
        (8000, (131, 1), 250),
    ):
        for noise in ((0.001, 2e-7, 20), (50, 30, 1e-2), (0, 1e-10, 1), (1e-3, 1e3, 1), (1, 0, 1)):
            try:
                filter = k.Kalman6(rate, scale, 2048, *noise, limit)
            except ValueError:
                continue
            s = filter.state
            for i in range(60):
                if i % 3 == 0:
                    filter.set_bias(*(rng.choice((-8192 * 256, 8192 * 256, 0)) for _ in range(3)))
                    s[5:8] = array(
                        "i", [rng.randint(-ONE, ONE - 1), rng.choice((-1, 0, 1)) << 28, 0]
                    )
                    for j in range(3):
                        s[words._I + j] = rng.choice((-1, 0, 1)) * s[words._I_MAX]
                        s[words._IR + j] = (1 << s[words._K2_SHIFT]) - 1
                row = [
                    rng.choice((-32768, 32767, 0, rng.randint(-32768, 32767))) for _ in range(10)
                ]
                filter.update(array("h", [*row, rng.choice((0, 1, 1, 1))]))
    for q in (0, 1e-10, 1e-3, 1, 1e6):
        for turn in (None, 2, 360000, TURN - 1, TURN):
            filter = k.KalmanFilter(rng.choice((-ONE, ONE)), q, 1, turn)
            for i in range(40):
                if i % 7 == 0:
                    filter.state[words._VALUE_REST] = ONE - 1
                filter.update(rng.choice((-ONE, ONE, rng.randint(-ONE, ONE))))
    filter = k.KalmanFilter(0, 200, 1)
    run(filter, 5, 20)
    ours = ("kalman.", "complementary.")
    assert [m for m in watch.missed() if m.startswith("kalman.")] == []
    assert {f for f in watch.functions if f.startswith(ours)} == {
        "kalman.update",
        "kalman.settle_gain",
        "kalman.learn_bias",
        "complementary.update",
        "complementary.step",
    }


def test_it_learns_the_bias_across_gravity_and_no_other():
    filter = Kalman6(200, SCALE, 4096, *QUICK.values())
    run(filter, counts(gx=33, gy=-49, gz=16), 200 * 20)
    learnt = bias_dps(filter)
    assert learnt[0] == pytest.approx(33 / 16.4, rel=0.002)
    assert learnt[1] == pytest.approx(-49 / 16.4, rel=0.002)
    assert abs(learnt[2]) < 0.01
    out = array("i", [0] * 3)
    filter.bias(out)
    assert list(out) == pytest.approx([33 * 256, -49 * 256, 0], abs=30)
    filter.angles(out)
    assert abs(out[0]) < 10 and abs(out[1]) < 10  # and it is level: Euler6 would lean


def test_the_default_finds_it_in_minutes():
    filter = Kalman6(50, SCALE, 4096)
    run(filter, counts(gx=33, gy=-49), 50 * 320)
    # until it is level, a part of the vertical is taken for horizontal
    assert bias_dps(filter) == pytest.approx([33 / 16.4, -49 / 16.4, 0], abs=0.3)


def test_nothing_of_a_small_bias_is_lost_by_rounding():
    """What is learnt in a step is a few of its last bits, and the bias that is set has a fraction of them."""
    filter = Kalman6(1000, SCALE, 4096)
    filter.set_bias(77, -300, 123)
    twin = KalmanFloat.like(filter)
    for _ in range(6000):
        row = counts(gx=1, gz=1)
        filter.update(row)
        twin.update(row)
    unit = 2 * math.pi / (TURN << filter.state[kalman._I_SHIFT])
    learnt = [v * unit for v in filter.state[kalman._I : kalman._I + 3]]
    assert learnt[:2] == pytest.approx(twin.learnt[:2], rel=5e-3)
    assert filter.state[7] * 360 / TURN == pytest.approx(math.degrees(twin.angles[2]), abs=1e-4)


def attitude(roll, pitch, yaw=0):
    return motions.quaternion_zyx(yaw, pitch, roll)


def gravity(q):
    w, x, y, z = q
    up = (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    return [round(4096 * v) for v in up]


@pytest.mark.parametrize(
    "roll, pitch", [(0, 0), (90, 0), (-60, 50), (180, -30), (35, 75), (0, -85)]
)
def test_it_learns_it_at_any_attitude_at_the_same_pace(roll, pitch):
    """The horizontal part, as it should: the vertical part of the bias, which nothing shows, is left out."""
    q = attitude(roll, pitch)
    up = np.array(gravity(q)) / 4096
    bias = np.array([40, -25, 30])
    across = bias - up * (bias @ up)  # counts
    filter = Kalman6(100, SCALE, 4096, 0.1, 0.01, 0.05)
    filter.set_quaternion(*q)
    row = counts(*gravity(q), *(int(v) for v in bias))
    for seconds, left in ((1, 0.745), (17, 0.0035)):
        run(filter, row, 100 * seconds)
        missing = across - np.array(bias_dps(filter)) * 16.4
        assert np.linalg.norm(missing) / np.linalg.norm(across) == pytest.approx(left, abs=0.01)


def test_the_bias_stays_right_when_the_body_turns_and_that_of_an_angle_s_rate_does_not():
    """Learnt level, then the body is laid on its side: pitch now turns about the gyro's z axis, which has no bias."""
    filter = Kalman6(100, SCALE, 4096, 0.1, 0.01, 0.05)
    twin = PerAngleFloat.like(filter)
    bias = 66
    q = attitude(0, 0)

    def fly(seconds, roll_dps=0):
        nonlocal q
        worst = [0, 0]
        step = motions.exponential(np.radians([round(roll_dps * 16.4) / 16.4, 0, 0]) / 100)
        for _ in range(100 * seconds):
            q = motions.multiply(q, step)
            row = counts(*gravity(q), round(roll_dps * 16.4), bias, 0)
            for k, f in enumerate((filter, twin)):
                f.update(row)
                found = f.angles[1] if f is twin else f.state[6] * 2 * math.pi / TURN
                worst[k] = max(worst[k], abs(math.degrees(found)))
        return worst

    fly(18)
    assert max(fly(1)) < 0.1
    learnt = bias_dps(filter)
    assert learnt == pytest.approx([0, bias / 16.4, 0], abs=0.05)
    ours, per_angle = fly(2, 45)
    assert ours < 0.05 < 0.2 < per_angle
    assert bias_dps(filter) == pytest.approx(learnt, abs=0.05)


@pytest.mark.parametrize("limit", [5, 0.5, 0])
def test_the_bias_stays_within_its_limit_and_leaves_it_again(limit):
    filter = Kalman6(200, SCALE, 4096, *QUICK.values(), bias_limit_dps=limit)
    for sign in (1, -1):
        worst = 0
        for _ in range(30):
            run(filter, counts(gx=sign * round(16.4 * (limit + 8))), 100)
            worst = max(worst, abs(bias_dps(filter)[0]))
        assert worst == pytest.approx(limit, abs=2e-3)
        assert bias_dps(filter)[0] == pytest.approx(sign * limit, abs=2e-3)


def test_set_bias_starts_the_learning_again():
    filter = Kalman6(200, SCALE, 4096, *QUICK.values())
    run(filter, counts(gx=33), 2000)
    filter.set_bias(10 * 256, 0, 0)
    assert bias_dps(filter) == pytest.approx([10 / 16.4, 0, 0], abs=1e-3)
    run(filter, counts(gx=33), 4000)
    assert bias_dps(filter)[0] == pytest.approx(33 / 16.4, rel=0.002)


def test_it_coasts_on_the_last_gyro_words_and_the_bias():
    filter = Kalman6(200, SCALE, 4096, *QUICK.values())
    run(filter, counts(gx=33), 200 * 20)
    learnt = bias_dps(filter)
    filter.set_quaternion(1, 0, 0, 0)
    # the accelerometer words disagree with the attitude, and nothing must come of it
    run(filter, counts(4096, 0, 0, gx=33, gz=820, flags=0), 200)
    assert bias_dps(filter) == learnt
    out = array("i", [0] * 3)
    filter.angles(out)
    assert out[2] == pytest.approx(50000, abs=20)
    assert abs(out[0]) < 30


@pytest.mark.parametrize(
    "change, said",
    [
        ({"q_angle": -1}, "q_angle is -1, expected 0 or a number from 1e-30"),
        ({"q_bias": float("nan")}, "q_bias is nan"),
        ({"r_angle": 0}, "r_angle is 0, expected a number above 0"),
        ({"r_angle": 1e-12}, r"make the gains 1 and .* at 200 Hz, expected 6e-8\.\.0\.9999"),
        ({"q_angle": 0, "q_bias": 0}, "make the gains 0 and 0 at 200 Hz"),
        ({"q_bias": 1e9}, "make the gains .* choose other variances"),
        ({"bias_limit_dps": 251}, r"bias_limit_dps is 251, expected 0\.\.250 deg/s"),
    ],
)
def test_what_the_numbers_cannot_hold_is_refused_with_the_range_that_they_can(change, said):
    arguments = {"rate": 200, "gyro_scale": SCALE, "accel_lsb_per_g": 4096, **change}
    with pytest.raises(ValueError, match=said):
        Kalman6(**arguments)


@pytest.mark.parametrize("rate", [50, 100, 200, 1000, 4000, (2000, 7)])
@pytest.mark.parametrize("scale", [(131, 1), (82, 5)])
def test_the_defaults_hold_at_the_usual_rates_and_ranges(rate, scale):
    filter = Kalman6(rate, scale, 4096)
    num, den = filter.rate
    exact = [v / kalman.ONE for v in kalman.steady_gains(filter.rate, 0.001, 2e-7, 20)]
    assert filter.gains == pytest.approx([exact[0], exact[1] * num / den], rel=3e-3)
