"""Euler6: as accurate as its float twin, the same bits on every runtime, right at every gate, and lost at the pole only
as far as it says."""

import math
import random
from array import array

import motions
import numpy as np
import overflow
import pytest
from histories import ONE, SCALE, angles_between, bias_at_rest, hold, of_twin
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from reference.complementary_float import EulerFloat
from reference.mahony_float import angle_between
from samples import counts, run
from upright import euler_kernels
from upright.complementary import Euler6
from upright.mahony import Mahony6
from upright_host import paths, scoring, trials, words
from upright_host.simulate import best_runtime as quickest

TURN = 1 << 30
AT = words.places("euler")
LIMIT_DEG = 0.01
# Seven times in half a minute this motion comes within degrees of the pole at 10 deg a step, where a difference grows
# by 1/cos(pitch), up to 32, each time.
NEAR_THE_POLE_DEG = {("bursts", 100): 0.5}


def degrees(filter):
    """Roll, pitch and yaw of the state."""
    return [v * 360 / TURN for v in filter.state[AT.A : AT.A + 3]]


def turned(angle):
    """Degrees into -180..180."""
    return (angle + 180) % 360 - 180


@pytest.fixture
def history(filter_history):
    """history(runtime, rendered, bias, **gains): the filter over all rows, (n, 4) int32."""

    def go(runtime, rendered, bias=(), **gains):
        return filter_history(runtime, rendered, "euler6", gains=gains, bias=bias).q29

    return go


def float_history(rendered, bias=(), gains=None, **options):
    """The float twin over all rows: (n, 4)."""
    return of_twin(Euler6, EulerFloat, rendered, bias=bias, gains=gains, **options)


# -- accuracy; pytest -rP shows the figures
# -- accuracy; pytest -rP shows the figures
@pytest.mark.parametrize("name", motions.MOTIONS)
@pytest.mark.parametrize("rate, seconds", [(100, 30), (200, 10), (1000, 2)])
def test_within_a_hundredth_of_a_degree_of_the_float_twin(history, name, rate, seconds):
    rendered = motions.render(name, rate=(rate, 1), seconds=seconds)
    for tau in (8, 0.5):
        q = history(quickest(), rendered, tau=tau)
        twin = float_history(rendered, gains={"tau": tau})
        limit = NEAR_THE_POLE_DEG.get((name, rate), LIMIT_DEG)
        hold(f"{name} {rate} Hz {seconds} s tau {tau}", q, twin, limit)


def test_within_a_hundredth_of_a_degree_of_the_float_twin_on_a_recorded_trial(history, recorded):
    trial = trials.load(recorded)
    trial.counts = trial.counts[:10000]
    runtime = quickest()
    if runtime == "cpython":
        trial.counts = trial.counts[:5000]
    bias = bias_at_rest(trial)
    hold(trial.name, history(runtime, trial, bias), float_history(trial, bias), LIMIT_DEG)


def test_the_comparison_sees_a_first_order_step(history):
    rendered = motions.render("spin", seconds=5)
    first = float_history(rendered, midpoint=False)
    assert angles_between(history(quickest(), rendered), first).max() > 100 * LIMIT_DEG


def test_a_fast_spin_costs_no_degrees_by_the_step_s_order(history):
    """60 turns of 360 deg/s, an ideal gyro and nothing else; to first order the tilt is lost."""
    rendered = motions.render("spin", seconds=60, errors=None)
    score = scoring.score_motion(history(quickest(), rendered, tau=None) / ONE, rendered)
    assert score.inclination < 1 and score.heading < 0.1
    first = float_history(rendered, gains={"tau": None}, midpoint=False)
    assert scoring.score_motion(first, rendered).inclination > 30


def test_it_agrees_with_mahony_s_filter_on_gentle_motion():
    rendered = motions.render("slow", seconds=30)
    bias = (round(1.2 * 16.4 * 256), round(-0.8 * 16.4 * 256), round(0.6 * 16.4 * 256))
    one = Euler6(rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, tau=2)
    two = Mahony6(rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, kp=0.5)
    rows = rendered.counts.copy()
    rows[:, 10] = 1
    worst = 0
    for k, row in enumerate(rows.tolist()):
        for f in (one, two):
            if k == 0:
                f.set_bias(*bias)
                f.seed(row)
            f.update(row)
        worst = max(worst, angle_between(one.quaternion_floats(), two.quaternion_floats()))
    assert worst < 1


def test_the_default_tau_is_better_than_a_short_one_where_the_body_moves(history, recorded):
    """What the default was chosen by; where the body rests either will do."""
    trial = trials.load(recorded)
    trial.counts = trial.counts[:12000]
    errors = []
    for tau in (8, 0.5):
        q = history(quickest(), trial, bias_at_rest(trial), tau=tau) / ONE
        errors.append(scoring.score_trial(q, trial).inclination)
    print(f"{trial.name}: inclination {errors[0]:.2f} and {errors[1]:.2f} deg")
    assert errors[0] < max(errors[1], 0.1)


# -- the kernels
UNIT = 2 * math.pi / TURN


@given(st.integers(-TURN, TURN))
@example(0)
@example(1 << 27)
@example((1 << 27) - 1)
@example(-(1 << 28))
@example(1 << 29)
def test_sines_are_right_to_5e_9(x):
    s = array("i", [0] * AT.size)
    s[0] = -1
    s[AT.X] = x
    euler_kernels.sines(s, 1)
    assert abs(s[AT.S] / ONE - math.sin(x * UNIT)) < 5e-9
    assert abs(s[AT.C] / ONE - math.cos(x * UNIT)) < 5e-9


part = st.one_of(st.integers(-(1 << 28), 1 << 28), st.integers(-300, 300))


@given(part, part)
@example(0, 0)
@example(0, -1)
@example(1, 1)
@example(1 << 28, -(1 << 28))
def test_direction_is_atan2_to_2e_5_of_a_degree(y, x):
    found = euler_kernels.direction(y, x) * UNIT
    assert abs(math.remainder(found - math.atan2(y, x), 2 * math.pi)) < math.radians(2e-5)


word = st.one_of(st.integers(-32768, 32767), st.integers(-20, 20))


@given(word, word, word)
@example(4096, 0, 0)
@example(32767, 1, 0)
@example(-32768, -32768, -32768)
def test_accel_angles_is_what_the_accelerometer_shows_to_2e_3_of_a_degree(x, y, z):
    s = array("i", [0] * AT.size)
    s[0] = -1
    s[AT.LOW] = 4
    assert euler_kernels.accel_angles(s, counts(x, y, z)) == (
        (x * x >> 2) + (y * y >> 2) + (z * z >> 2) >= 4
    )
    if not s[AT.Z] and not s[AT.Z + 1]:
        return
    roll, pitch = s[AT.Z] * UNIT, s[AT.Z + 1] * UNIT
    assert abs(math.remainder(roll - math.atan2(y, z), 2 * math.pi)) < math.radians(2e-5)
    assert abs(pitch - math.atan2(-x, math.hypot(y, z))) < math.radians(2e-3)


near_the_pole = st.integers(0, 1 << 22).flatmap(
    lambda d: st.sampled_from([(TURN >> 2) - d, d - (TURN >> 2)])
)
few = st.integers(-20000000, 20000000)


@given(st.integers(-ONE, ONE - 1), near_the_pole, st.tuples(few, few), st.tuples(word, word, word))
@example(0, TURN >> 2, (0, 10000000), (0, 0, 9000))
@example(1 << 27, TURN >> 2, (-999, 10000000), (0, 9000, -9000))
@example(0, -(TURN >> 2), (0, -10000000), (30000, 30000, 30000))
def test_each_step_at_the_pole_is_the_twin_s(roll, pitch, turned, gyro):
    """The gyro's part, and not where half-way is the pole itself, where either sign of 1/cos(pitch) will do."""
    assume(abs(abs(pitch + turned[1] / 2) - (TURN >> 2)) > 1000)
    filter = Euler6(200, SCALE, 4096, tau=1)
    s = filter.state
    s[AT.A], s[AT.A + 1] = roll, pitch
    s[AT.D], s[AT.D + 1] = turned
    twin = EulerFloat.like(filter)
    twin.turned = tuple(v * UNIT for v in turned)
    row = counts(0, 0, 0, *gyro)
    filter.update(row)
    twin.update(row)
    assert angle_between(filter.quaternion_floats(), twin.q) < 1e-3


def test_a_slow_turn_of_a_tilted_body_is_not_lost_by_rounding():
    """A count a step for 5 s: half of the last bit each, left out, would be ten times the bound."""
    filter = Euler6(1000, SCALE, 4096, tau=None)
    filter.set_quaternion(*motions.quaternion_zyx(10, 30, 20))
    twin = EulerFloat.like(filter)
    row = counts(gx=1, gy=-1, gz=1)
    run(filter, row, 5000)
    run(twin, row, 5000)
    assert degrees(filter) == pytest.approx(np.degrees(twin.angles).tolist(), abs=8e-5)


# -- no overflow
LIB = paths.PACKAGE


def extreme(rng, most):
    return rng.choice((-most, most, 0, rng.randint(-most, most), rng.randint(-99, 99)))


def test_nothing_leaves_32_bits_at_the_corners_of_the_accepted_range():
    watch = overflow.Watch()
    paths = [LIB / "euler_kernels.py", LIB / "complementary.py"]
    kind = overflow.loaded(paths, watch)["complementary"].Euler6
    rng = random.Random(1)
    corners = []
    for scale, slow, fast in (((82, 5), 42, 89000), ((131, 1), 6, 11000)):
        for rate in (slow, 200, fast):
            for tau in (8, 1.001 / rate + 1e-6, 0.99 * (1 << 24) / rate, None):
                corners.append((rate, scale, tau))
    for rate, scale, tau in corners:
        filter = kind(rate, scale, 2048, tau)
        s = filter.state
        most = s[AT.G] * 40960
        for i in range(120):
            if i % 4 == 0:
                # anywhere, at the pole, and with the remainders at their ends
                filter.set_bias(*(rng.choice((-8192 * 256, 8192 * 256, 0)) for _ in range(3)))
                near = rng.choice((0, 1, -1)) * (TURN >> 2)
                angles = (
                    rng.randint(-ONE, ONE - 1),
                    extreme(rng, TURN >> 2),
                    extreme(rng, ONE - 1),
                )
                s[AT.A : AT.A + 3] = array("i", angles)
                if near:
                    s[AT.A + 1] = near - (near > 0) * rng.randint(0, 1 << 20)
                for j in range(3):
                    s[AT.AR + j] = s[AT.WR + j] = rng.choice((0, 32767))
                s[AT.D] = extreme(rng, most + (TURN >> 2))
                s[AT.D + 1] = extreme(rng, most)
            row = [rng.choice((-32768, 32767, 0, rng.randint(-32768, 32767))) for _ in range(10)]
            row.append(rng.choice((0, 1, 1, 1, 5)))
            for j in range(3):
                if i % 3 == 0:  # everything on one side
                    row[3 + j] = -32768 if filter.bias_set[j] > 0 else 32767
            filter.update(array("h", row))
            assert abs(math.hypot(*s[1:5]) / ONE - 1) < 1e-7
            assert min(s[AT.A], s[AT.A + 2]) >= -ONE and max(s[AT.A], s[AT.A + 2]) < ONE
            assert abs(s[AT.A + 1]) <= (TURN >> 2) + 1
    assert watch.missed() == []
    assert watch.functions == {
        "euler_kernels.sines",
        "euler_kernels.direction",
        "euler_kernels.accel_angles",
        "euler_kernels.compose",
        "complementary.update",
        "complementary.step",
    }


# -- seed, set_quaternion, bias
@given(*[st.integers(-1000, 1000)] * 4)
@example(0, 0, 0, 1)
@example(1, 0, 1, 0)  # pitch 90
@example(1, 1, 1, 1)
@example(1, 0, -1, 0)
@example(0, 1, 0, -1)
@example(1, 2, -1, 2)
def test_set_quaternion_sets_it_at_any_attitude(w, x, y, z):
    filter = Euler6(200, SCALE, 4096)
    if not any((w, x, y, z)):
        with pytest.raises(ValueError, match="no direction"):
            filter.set_quaternion(w, x, y, z)
        return
    filter.set_quaternion(w, x, y, z)
    # two thousandths of that is the roll within 2e-4 deg of the pole
    assert angle_between((w, x, y, z), filter.quaternion_floats()) < 3e-4
    out = array("i", [0] * 4)
    filter.quaternion(out)
    assert list(filter.state[filter.QUATERNION : filter.QUATERNION + 4]) == list(out)


def test_the_angles_are_those_of_the_quaternion_to_a_millidegree():
    filter = Euler6(200, SCALE, 4096)
    out = array("i", [0] * 3)
    for roll, pitch, yaw in ((10, 20, 30), (-170, -80, 179), (90, 45, -90), (0, 89.9, 0)):
        filter.set_quaternion(*motions.quaternion_zyx(yaw, pitch, roll))
        filter.angles(out)
        assert list(out) == pytest.approx([1000 * roll, 1000 * pitch, 1000 * yaw], abs=1)
        assert degrees(filter) == pytest.approx([roll, pitch, yaw], abs=1e-4)


# -- the kinematics
angle = st.integers(-170, 170)
tilt = st.integers(-70, 70)
rate = st.integers(-3000, 3000)


@settings(max_examples=60)
@given(angle, tilt, angle, rate, rate, rate)
@example(40, 60, 0, 0, 3000, 3000)
def test_the_angles_follow_the_gyro_at_any_attitude(roll, pitch, yaw, gx, gy, gz):
    """A tenth of a second at a constant rate against the closed form; seed code with the inverse matrix is far off."""
    filter = Euler6(1000, SCALE, 4096, tau=None)
    q = motions.quaternion_zyx(yaw, pitch, roll)
    filter.set_quaternion(*q)
    run(filter, counts(gx=gx, gy=gy, gz=gz), 100)
    w = np.radians(np.array([gx, gy, gz]) / 16.4) * 0.1
    assert (
        angle_between(motions.multiply(q, motions.exponential(w)), filter.quaternion_floats())
        < 0.05
    )


def test_the_inverse_of_that_matrix_does_not():
    """A matrix that turns body rates into angle rates already, inverted once more, as some tutorials have it."""
    roll, pitch, w = 0.7, 0.6, np.array([0.1, 0.2, 0.3])
    right = np.array(
        [
            [1, math.sin(roll) * math.tan(pitch), math.cos(roll) * math.tan(pitch)],
            [0, math.cos(roll), -math.sin(roll)],
            [0, math.sin(roll) / math.cos(pitch), math.cos(roll) / math.cos(pitch)],
        ]
    )
    filter = Euler6(1000, SCALE, 4096, tau=None)
    filter.set_quaternion(*motions.quaternion_zyx(0, math.degrees(pitch), math.degrees(roll)))
    row = counts(
        **dict(zip(("gx", "gy", "gz"), np.round(np.degrees(w) * 16.4).astype(int), strict=True))
    )
    run(filter, row, 10)
    moved = np.radians(degrees(filter)) - [roll, pitch, 0]
    assert moved == pytest.approx(right @ w * 0.01, abs=2e-5)
    assert np.abs(moved - np.linalg.inv(right) @ w * 0.01).max() > 1e-3


# -- the accelerometer
def test_it_takes_the_short_way_across_half_a_turn():
    filter = Euler6(200, SCALE, 4096, tau=1)
    filter.set_quaternion(*motions.quaternion_zyx(0, 0, 170))
    row = counts(
        0, round(-4096 * math.sin(math.radians(10))), round(-4096 * math.cos(math.radians(10)))
    )
    for _ in range(1600):
        filter.update(row)
        assert abs(degrees(filter)[0]) > 169
    assert degrees(filter)[0] == pytest.approx(-170, abs=0.02)


def test_a_gyro_bias_tilts_it_by_tau_times_the_bias_and_yaw_drifts():
    filter = Euler6(200, SCALE, 4096, tau=2)
    run(filter, counts(gx=33, gz=33), 200 * 30)
    roll, _, yaw = degrees(filter)
    assert roll == pytest.approx(2 * 33 / 16.4, rel=0.01)
    assert yaw == pytest.approx(30 * 33 / 16.4, rel=0.01)


# -- the pole
def up_in_body(q):
    w, x, y, z = q
    return 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z


class Flight:
    """A body and the filter that follows it, tau 1 s, 200 Hz, an ideal accelerometer and gyro."""

    def __init__(self, roll, pitch, yaw=20):
        self.q = motions.quaternion_zyx(yaw, pitch, roll)
        self.filter = Euler6(200, SCALE, 4096, tau=1)
        self.filter.set_quaternion(*self.q)

    def fly(self, seconds, gyro=(0, 0, 0), accel=None):
        """With gyro in counts -> inclination and heading error at the end, the largest inclination, all in deg.

        accel: what the accelerometer says instead of the truth.
        """
        gyro = [round(v) for v in gyro]
        step = motions.exponential(np.radians(np.array(gyro) / 16.4) / 200)
        worst = 0
        for _ in range(round(200 * seconds)):
            self.q = motions.multiply(self.q, step)
            said = accel or (round(4096 * v) for v in up_in_body(self.q))
            self.filter.update(counts(*said, *gyro))
            e = motions.multiply(
                np.array(self.filter.quaternion_floats()), self.q * [1, -1, -1, -1]
            )
            inclination = math.degrees(2 * math.acos(min(1, math.hypot(e[0], e[3]))))
            worst = max(worst, inclination)
        return inclination, turned(math.degrees(2 * math.atan2(e[3], e[0]))), worst


@pytest.mark.parametrize("roll", [0, 3, 130, -90])
@pytest.mark.parametrize("dps", [50, 500])
@pytest.mark.parametrize("aside", [0, 0.01, 0.3])
def test_it_flies_through_the_pole_and_comes_back_level(roll, dps, aside):
    """About the body's left axis from pitch 40 to 140, straight and aside; nothing but the gyro can carry the yaw."""
    flight = Flight(roll, 40)
    a = math.radians(roll)
    w = (aside * dps, math.cos(a) * dps, -math.sin(a) * dps)
    _, _, worst = flight.fly(100 / dps, [v * 16.4 for v in w])
    assert worst < 1.5
    inclination, heading, _ = flight.fly(3)
    assert inclination < 0.1
    assert abs(heading) < 15


@pytest.mark.parametrize("wrong", [(180, 0, 0), (170, 50, 90), (-90, -89, 10)])
def test_however_wrong_it_is_at_the_pole_it_levels_within_a_few_tau(wrong):
    flight = Flight(30, 88)
    flight.filter.set_quaternion(*motions.quaternion_zyx(*wrong[::-1]))
    flight.fly(0.5, (0, 3000, 1000))
    inclination, _, _ = flight.fly(7)
    assert inclination < 0.2


def test_yaw_is_lost_by_as_much_as_roll_turned_at_the_pole():
    """The limit: at pitch 90 the accelerometer shows no roll; what it is drawn to is missing in yaw afterwards."""
    flight = Flight(60, 60)
    up, down = [
        (0, n, -n * 1.732050808) for n in (246, -246)
    ]  # 30 deg/s about the horizontal at roll 60
    pole = (-4096, 0, 0)
    flight.fly(1, up)
    assert degrees(flight.filter)[1] == pytest.approx(90, abs=0.1)
    inclination, heading, _ = flight.fly(6, accel=pole)
    assert inclination < 0.2 and abs(heading) == pytest.approx(60, abs=2)
    # and nothing brings it back
    flight.fly(2, down)
    inclination, heading, _ = flight.fly(4)
    assert inclination < 1 and abs(heading) > 30
    # a quaternion keeps it
    quaternion = Mahony6(200, SCALE, 4096, kp=1)
    quaternion.set_quaternion(*motions.quaternion_zyx(20, 90, 60))
    before = quaternion.quaternion_floats()
    run(quaternion, counts(-4096, 0, 0), 1200)
    assert angle_between(before, quaternion.quaternion_floats()) < 0.1


# -- limits and refusals
@pytest.mark.parametrize(
    "change, said",
    [
        ({"rate": 20}, r"rate is 20 Hz, expected 42\.\.\d+ Hz at 82/5 LSB"),
        ({"rate": (83, 2)}, r"rate is 83/2 Hz, expected 42\.\."),
        ({"rate": 1000000}, r"rate is 1000000 Hz, expected 42\.\.90\d\d\d Hz"),
        ({"tau": 0}, r"tau is 0, expected None or 0\.005001\.\.83886 s at a rate of 200 Hz"),
        ({"tau": 0.004}, r"tau is 0\.004, expected"),
        ({"tau": 100000}, "tau is 100000, expected"),
        ({"tau": -1}, "tau is -1, expected a number from 0"),
        ({"tau": float("nan")}, "tau is nan, expected a number"),
    ],
)
def test_what_the_numbers_cannot_hold_is_refused_with_the_range_that_they_can(change, said):
    arguments = {"rate": 200, "gyro_scale": SCALE, "accel_lsb_per_g": 4096, **change}
    with pytest.raises(ValueError, match=said):
        Euler6(**arguments)


def test_the_ends_of_the_ranges_in_a_message_are_accepted():
    for rate in (42, 90000):
        Euler6(rate, SCALE, 4096, tau=None)
    for tau in (0.005001, 83886):
        Euler6(200, SCALE, 4096, tau=tau)


@pytest.mark.parametrize("rate", [50, 100, 200, 1000, 8000, (2000, 7)])
@pytest.mark.parametrize("tau", [0.1, 0.5, 8, 100])
def test_the_usual_rates_and_gains_are_held(rate, tau):
    filter = Euler6(rate, SCALE, 4096, tau)
    twin = EulerFloat.like(filter)
    num, den = filter.rate
    assert twin.gain * tau * num / den == pytest.approx(1, rel=2e-4 if tau > 10 else 1e-4)
    assert twin.gyro * num / den == pytest.approx(math.radians(5 / 82), rel=1e-5)
