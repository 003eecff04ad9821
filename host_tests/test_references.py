"""Against independent references: ahrs for Mahony's filter, scipy for rotations; the conventions of docs/methods.md.

Nothing here is compared with code of this project: what a test calls the truth comes from ahrs or scipy.
"""

import math
import re
from array import array

import motions
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import mahony_float
from reference.mahony_float import Mahony9Float, MahonyFloat
from upright import fixmath, mahony_kernels
from upright.mahony import Mahony6, Mahony9
from upright_host import paths, scoring, words

AT = words.places("mahony")
ONE = 1 << 29


@pytest.fixture(scope="module")
def rotation():
    """scipy's Rotation, scalar last: made from our quaternions by `of`."""
    spatial = pytest.importorskip("scipy.spatial.transform", reason="scipy is not installed")
    return spatial.Rotation


@pytest.fixture(scope="module")
def ahrs():
    return pytest.importorskip("ahrs", reason="ahrs is not installed")


def scalar_last(q):
    return np.roll(np.asarray(q, float), -1, axis=-1)


def degrees_apart(p, q):
    """The angle between two of scipy's rotations."""
    return np.degrees((p.inv() * q).magnitude())


# -- Mahony's filter
def rows_of(motion, mag):
    """The counts with the flags of fresh samples; `mag`: the magnetometer's bit as well."""
    rows = motion.counts.astype(int)
    assert np.abs(rows[:, :9]).max() < 32767
    rows[:, 10] = 3 if mag else 1
    return rows.tolist()


def theirs(ahrs, motion, start, kp, ki, mag=False, exact=False):
    """ahrs.filters.Mahony over all rows: (n, 4).

    What it does otherwise than ours: it steps with the first order; north is its y axis; it leaves the attitude alone
    where the gyro reads exactly 0 (no row of these motions does); it knows no flags, no least acceleration, no limit
    of the integral, and refuses k_I = 0 in its constructor alone. Its bias is the negative of our integral.
    exact: lengthen the rate by tan(d)/d, d the half angle of the step, which makes a first-order step exact.
    """
    num, den = motion.rate
    scale = math.radians(motion.gyro_scale[1] / motion.gyro_scale[0])
    filter = ahrs.filters.Mahony(frequency=num / den, k_P=kp)
    filter.k_I = ki
    step = filter.updateMARG if mag else filter.updateIMU
    quarter = np.array([math.sqrt(0.5), 0, 0, -math.sqrt(0.5)])  # our x, north, is its y
    q = motions.multiply(quarter * [1, 1, 1, -1], start) if mag else np.array(start)
    out = np.empty((motion.n, 4))
    for k, row in enumerate(motion.counts.astype(float)):
        gyro = row[3:6] * scale
        assert gyro.any()
        if exact:
            d = np.linalg.norm(gyro) * den / num / 2
            gyro = gyro * (math.tan(d) / d)
        field = (row[6:9],) if mag else ()
        q = step(q, gyro, row[0:3], *field)
        out[k] = q
    return motions.multiply(quarter, out) if mag else out


def worst(rotation, p, q):
    p, q = (rotation.from_quat(scalar_last(v)) for v in (p, q))
    return degrees_apart(p, q).max()


def twin_of(kind, integer, rows):
    twin = kind.like(integer, order=1)
    twin.integral_limit = math.inf
    out = np.empty((len(rows), 4))
    for k, row in enumerate(rows):
        twin.update(row)
        out[k] = twin.q
    return out


NOISY = motions.Errors(gyro_noise_density=0.02)  # so that the gyro never reads 0 on all axes


@pytest.mark.parametrize("name", ["slow", "bursts", "coning", "hand"])
@pytest.mark.parametrize("kp, ki", [(0.5, 0), (2, 0.1)])
def test_the_float_twin_is_ahrs_mahony_with_six_axes(ahrs, rotation, name, kp, ki):
    """The same equations: nothing but rounding is left, with the integral too."""
    motion = motions.render(name, seconds=6, errors=NOISY)
    rows = rows_of(motion, False)
    ours = Mahony6(motion.rate, motion.gyro_scale, motion.accel_lsb_per_g, kp, ki)
    ours.seed(rows[0])
    twin = MahonyFloat.like(ours)
    expected = theirs(ahrs, motion, twin.q, twin.kp, twin.ki)
    apart = worst(rotation, twin_of(MahonyFloat, ours, rows), expected)
    print(f"{name}: {apart:.2e} deg")
    assert apart < 1e-6
    wrong = theirs(ahrs, motion, twin.q, 1.1 * twin.kp, twin.ki)
    assert worst(rotation, twin_of(MahonyFloat, ours, rows), wrong) > 1e-3


@pytest.mark.parametrize("name", ["slow", "bursts", "hand"])
@pytest.mark.parametrize("kp, ki", [(0.5, 0), (2, 0.1)])
def test_the_float_twin_is_ahrs_mahony_with_nine_axes(ahrs, rotation, name, kp, ki):
    motion = motions.render(name, seconds=4, errors=NOISY)
    rows = rows_of(motion, True)
    ours = Mahony9(motion.rate, motion.gyro_scale, motion.accel_lsb_per_g, kp, ki)
    assert ours.seed(rows[0]) and ours.heading_seeded
    twin = Mahony9Float.like(ours)
    expected = theirs(ahrs, motion, twin.q, twin.kp, twin.ki, mag=True)
    apart = worst(rotation, twin_of(Mahony9Float, ours, rows), expected)
    print(f"{name}: {apart:.2e} deg")
    assert apart < 1e-6


def integers(filter, rows):
    out = np.empty((len(rows), 4))
    for k, row in enumerate(rows):
        filter.update(row)
        out[k] = filter.quaternion_floats()
    return out


@pytest.mark.parametrize("name", ["slow", "spin", "bursts", "coning", "hand"])
def test_the_integer_filter_is_ahrs_mahony_but_for_the_order_of_the_step(ahrs, rotation, name):
    """With the rate lengthened so that the step of ahrs is exact, 0.003 deg are left in 5 s of any motion."""
    motion = motions.render(name, seconds=5, errors=NOISY)
    rows = rows_of(motion, False)
    ours = Mahony6(motion.rate, motion.gyro_scale, motion.accel_lsb_per_g, 0.5, 0.02)
    ours.seed(rows[0])
    start = ours.quaternion_floats()
    got = integers(ours, rows)
    apart = worst(rotation, got, theirs(ahrs, motion, start, 0.5, 0.02, exact=True))
    print(f"{name}: {apart:.6f} deg")
    assert apart < 0.003
    if name == "spin":  # first order loses d^3/3 of each step: 360 deg/s at 200 Hz, 0.03 deg/s
        first = worst(rotation, got, theirs(ahrs, motion, start, 0.5, 0.02))
        assert first == pytest.approx(0.0296 * 5, rel=0.05)


def test_the_integer_filter_is_ahrs_mahony_with_nine_axes(ahrs, rotation):
    motion = motions.render("hand", seconds=5, errors=NOISY)
    rows = rows_of(motion, True)
    ours = Mahony9(motion.rate, motion.gyro_scale, motion.accel_lsb_per_g, 0.5, 0.02)
    ours.seed(rows[0])
    start = ours.quaternion_floats()
    expected = theirs(ahrs, motion, start, 0.5, 0.02, mag=True, exact=True)
    apart = worst(rotation, integers(ours, rows), expected)
    print(f"hand, nine axes: {apart:.6f} deg")
    assert apart < 0.005


def test_ahrs_leaves_the_attitude_alone_at_a_gyro_of_exactly_zero(ahrs):
    """Why the motions above are noisy: there it skips the feedback too, and this project does not."""
    tilted = np.array([math.cos(0.1), math.sin(0.1), 0, 0])
    still = ahrs.filters.Mahony(k_P=1.0).updateIMU(tilted, np.zeros(3), np.array([0, 0, 1.0]))
    assert np.array_equal(still, tilted)
    ours = Mahony6(100, (82, 5), 4096, 1)
    ours.set_quaternion(*tilted)
    before = ours.quaternion_floats()
    ours.update(array("h", [0, 0, 4096, 0, 0, 0, 0, 0, 0, 0, 1]))
    assert mahony_float.angle_between(before, ours.quaternion_floats()) > 0.05


# -- quaternions, matrices, angles
part = st.integers(-1000, 1000)
any_quaternion = st.tuples(part, part, part, part).filter(any)
angle = st.floats(-180, 180)
to_the_pole = st.sampled_from([0, 1e-6, 1e-5, 2e-4, 3e-4, 1e-3, 0.01, 0.1])
near_the_pole = st.tuples(angle, to_the_pole, st.sampled_from([-1, 1]), angle)


def euler_of(q, order):
    out = array("i", [0, 0, 0])
    fixmath.euler(array("i", q), out, order)
    return [v / 1000 for v in out]


def from_euler(rotation, order, roll, pitch, yaw):
    """scipy's capital letters are intrinsic: Rz(yaw) first, then about the axes that have turned with it."""
    return rotation.from_euler(order.upper(), (yaw, pitch, roll), degrees=True)


@pytest.mark.parametrize("order", ["zyx", "zxy"])
@settings(max_examples=150)
@given(any_quaternion)
@example((1, 0, 1, 0))
@example((1, 1, 0, 0))
@example((0, 0, 0, 1))
@example((1, 1, 1, 1))
def test_euler_angles_are_scipys(rotation, order, q):
    q = fixmath.unit_quaternion(*q)
    true = rotation.from_quat(scalar_last(q))
    roll, pitch, yaw = euler_of(q, order)
    # three roundings of half a millidegree, and the errors of three arctangents
    assert degrees_apart(true, from_euler(rotation, order, roll, pitch, yaw)) < 0.002
    matrix = true.as_matrix()
    lean = -matrix[2, 0] if order == "zyx" else matrix[2, 1]
    if abs(lean) < 0.9999:
        expected = true.as_euler(order.upper(), degrees=True)
        for got, wanted in zip((yaw, pitch, roll), expected, strict=True):
            assert abs((got - wanted + 180) % 360 - 180) < 0.002 / math.sqrt(1 - lean * lean)


@pytest.mark.parametrize("order", ["zyx", "zxy"])
@settings(max_examples=150)
@given(near_the_pole)
def test_euler_angles_near_gimbal_lock_are_the_same_attitude(rotation, order, at):
    roll, off, sign, yaw = at
    true = from_euler(rotation, order, roll, sign * (90 - off), yaw)
    q = fixmath.unit_quaternion(*np.roll(true.as_quat(), 1).tolist())
    got = euler_of(q, order)
    assert degrees_apart(true, from_euler(rotation, order, *got)) < 0.002
    assert abs(got[1] - sign * (90 - off)) < 0.0015
    if off < 1e-5:
        assert got[0] == 0


@settings(max_examples=100)
@given(any_quaternion)
def test_the_rotation_matrix_is_scipys(rotation, q):
    q = np.array(fixmath.unit_quaternion(*q)) / ONE
    expected = rotation.from_quat(scalar_last(q)).as_matrix()
    assert np.abs(motions._matrix(q[None])[0] - expected).max() < 1e-8


@settings(max_examples=100)
@given(any_quaternion, any_quaternion)
def test_the_product_is_scipys(rotation, p, q):
    p, q = (np.array(v) / np.linalg.norm(v) for v in (p, q))
    expected = rotation.from_quat(scalar_last(p)) * rotation.from_quat(scalar_last(q))
    for product in (motions.multiply(p, q), scoring._multiply(p[None], q[None])[0]):
        assert degrees_apart(expected, rotation.from_quat(scalar_last(product))) < 1e-5


@settings(max_examples=100)
@given(st.tuples(angle, angle, angle))
@example((0.0, 0.0, 0.0))
@example((180.0, 0.0, 0.0))
@example((1e-9, 0.0, -1e-9))
def test_the_exponential_is_scipys(rotation, vector):
    vector = np.radians(vector)
    got = rotation.from_quat(scalar_last(motions.exponential(vector)))
    assert degrees_apart(got, rotation.from_rotvec(vector)) < 1e-5


@settings(max_examples=100)
@given(angle, st.floats(-90, 90), angle)
def test_elementary_rotations_compose_as_scipys(rotation, roll, pitch, yaw):
    got = rotation.from_quat(scalar_last(motions.quaternion_zyx(yaw, pitch, roll)))
    assert degrees_apart(got, from_euler(rotation, "zyx", roll, pitch, yaw)) < 1e-5


# -- what an accelerometer and a magnetometer show
word = st.integers(-32767, 32767)
vector = st.tuples(word, word, word)


def q29(rotation, q):
    return rotation.from_quat(scalar_last(np.array(q) / ONE))


@settings(max_examples=150)
@given(vector.filter(any))
@example((0, 0, -1))
@example((1, 0, 0))
@example((-32767, 0, 0))
@example((32767, 0, -1))
def test_attitude_from_up_turns_the_vector_up_and_has_no_yaw(rotation, up):
    attitude = q29(rotation, fixmath.attitude_from_up(*up))
    unit = np.array(up) / np.linalg.norm(up)
    assert np.degrees(np.linalg.norm(np.cross(attitude.apply(unit), [0, 0, 1]))) < 1e-6
    assert attitude.apply(unit)[2] > 0
    if abs(unit[0]) < 0.9999:
        assert abs(attitude.as_euler("ZYX", degrees=True)[0]) < 1e-4


@settings(max_examples=150)
@given(vector, vector)
@example((0, 0, 4096), (100, 0, -200))
@example((4096, 0, 0), (0, 100, -200))
@example((0, 0, -4096), (-3, 2, 1))
def test_attitude_from_up_and_north_is_scipys_alignment_of_two_vectors(rotation, up, field):
    """With an infinite weight on `up` align_vectors turns the second vector about it alone."""
    u, f = np.array(up, float), np.array(field, float)
    across = np.linalg.norm(np.cross(u, f))
    if across <= 0.03 * np.linalg.norm(u) * np.linalg.norm(f):  # as seed() does, and the vector 0
        return
    u, f = u / np.linalg.norm(u), f / np.linalg.norm(f)
    expected, _ = rotation.align_vectors([[0, 0, 1], [1, 0, 0]], [u, f], weights=[math.inf, 1])
    assert (
        degrees_apart(expected, q29(rotation, fixmath.attitude_from_up_and_north(up, field))) < 1e-4
    )


def kernel_state(q, low=4):
    state = array("i", [0] * AT.size)
    state[AT.PROBE] = -1
    for i in range(4):
        state[AT.Q + i] = q[i]
    state[AT.LOW] = low
    return state


def fresh(accel=(0, 0, 4096), field=(0, 0, 0)):
    return array("h", [*accel, 0, 0, 0, *field, 0, 3])


@settings(max_examples=100)
@given(any_quaternion, vector)
def test_tilt_is_the_cross_product_with_up_seen_from_the_body(rotation, q, accel):
    q = fixmath.unit_quaternion(*q)
    state = kernel_state(q)
    mahony_kernels.tilt(state, fresh(accel))
    length = np.linalg.norm(accel)
    if length < 16:
        return
    up = q29(rotation, q).inv().apply([0, 0, 1])
    error = np.cross(np.array(accel) / length, up)
    got = np.array(state[AT.E : AT.E + 3]) / ONE
    assert np.abs(np.array(state[AT.UP : AT.UP + 3]) / 2**28 - up).max() < 2e-8
    # the root is good to 1.5e-4 and scales; what shifts is below 1e-7
    assert np.abs(got - error).max() < 1.6e-4 * np.linalg.norm(error) + 1e-7


@settings(max_examples=100)
@given(any_quaternion, vector)
def test_north_is_the_cross_product_with_the_field_turned_to_north(rotation, q, field):
    if np.linalg.norm(field) < 64 or max(abs(v) for v in field) > 32766:
        return
    q = fixmath.unit_quaternion(*q)
    attitude = q29(rotation, q)
    m = np.array(field) / np.linalg.norm(field)
    h = attitude.apply(m)
    error = np.cross(m, attitude.inv().apply([math.hypot(h[0], h[1]), 0, h[2]]))
    state = kernel_state(q)
    assert mahony_kernels.north(state, fresh(field=field), 1) == 0
    got = np.array(state[AT.E : AT.E + 3]) / ONE
    # 15 bits of everything but hy (docs/numerics.md); the matrix has 14: more of the error where the field is steep
    across = math.hypot(h[0], h[1])
    chord = math.hypot(h[1], across - h[0])  # 0 where the heading is right
    steep = 3e-4 * min(2, chord / max(across, 1e-9))
    assert np.abs(got - error).max() < 3e-4 * np.linalg.norm(error) + 2e-4 * chord + steep + 4e-8


@settings(max_examples=100)
@given(any_quaternion, st.tuples(*[st.floats(-0.55, 0.55)] * 3))
@example((1, 0, 0, 0), (0.0, 0.0, 0.0))
@example((1, 2, 3, 4), (0.55, 0.55, -0.55))
def test_turn_is_the_closed_form(rotation, q, half):
    """One step by up to 109 deg."""
    q = fixmath.unit_quaternion(*q)
    state = kernel_state(q)
    for i in range(3):
        state[AT.W + i] = round(half[i] * 2**31)
    d = np.array(state[AT.W : AT.W + 3]) / 2**31
    fixmath.turn(state)
    got = q29(rotation, state[AT.Q : AT.Q + 4])
    expected = q29(rotation, q) * rotation.from_rotvec(2 * d)
    assert degrees_apart(expected, got) < math.degrees(2 * (2e-6 * np.linalg.norm(d) ** 5 + 1.5e-8))


# -- Picard's series
PICARD = {1: (12, 3, -1), 2: (24, 3, 1), 3: (480, 5, 1), 4: (1920, 5, -1)}


@pytest.mark.parametrize("order", PICARD)
@pytest.mark.parametrize("degrees", [2, 8, 20])
def test_picards_orders_are_off_by_what_the_methods_page_says(rotation, order, degrees):
    """theta^3/12 too little, theta^3/24 too much, theta^5/480 too much, theta^5/1920 too little in a step by theta."""
    divisor, power, sign = PICARD[order]
    theta = math.radians(degrees)
    axis = np.array([2, -1, 2]) / 3
    c, s = mahony_float.step(axis * theta / 2, order)
    got = rotation.from_quat([*(axis * theta / 2 * s), c])
    apart = (got * rotation.from_rotvec(axis * theta).inv()).as_rotvec() @ axis
    assert apart == pytest.approx(sign * theta**power / divisor, rel=0.06, abs=1e-14)


@pytest.mark.parametrize("order", PICARD)
def test_the_methods_page_says_how_much_each_order_loses(rotation, order):
    """At 200 Hz, in deg/s of the rates 360 and 2000; the sign is that of the error."""
    lost = []
    for dps in (360, 2000):
        half = np.array([0, 0, math.radians(dps / 400)])
        c, s = mahony_float.step(half.tolist(), order)
        got = rotation.from_quat([*(half * s), c]) * rotation.from_rotvec(2 * half).inv()
        lost.append(f"{math.degrees(got.as_rotvec()[2]) * 200:+.3g}")
    for name in ("methods.md", "methods.zh.md"):
        (row,) = re.findall(
            rf"^\| {order} \|.*", (paths.ROOT / "docs" / name).read_text("utf-8"), re.M
        )
        for figure in lost:
            assert f" {figure} |" in row, f"{name}: order {order} loses {figure}"


def test_the_closed_form_of_the_float_twin_is_scipys(rotation):
    for half in (np.zeros(3), np.array([1e-12, 0, 0]), np.array([0.3, -0.5, 0.7])):
        c, s = mahony_float.step(half.tolist())
        got = rotation.from_quat([*(half * s), c])
        assert degrees_apart(got, rotation.from_rotvec(2 * half)) < 1e-6


# -- Kalman's steady state
def steady(q_angle, q_bias, r_angle, rate):
    """The gains of the filter for an angle and a bias, from scipy's solution of the discrete Riccati equation."""
    linalg = pytest.importorskip("scipy.linalg", reason="scipy is not installed")
    f, h = np.array([[1, -1 / rate], [0, 1]]), np.array([[1.0, 0]])
    noise = np.diag([q_angle, q_bias]) / rate
    p = linalg.solve_discrete_are(f.T, h.T, noise, np.array([[r_angle]]))
    return (p @ h.T / (p[0, 0] + r_angle)).ravel()


@pytest.mark.parametrize(
    "q_angle, q_bias, r_angle", [(1e-3, 3e-3, 3e-2), (1e-5, 1e-8, 0.1), (1e-12, 1e-8, 0.1)]
)
def test_the_steady_gains_of_angle_and_bias_are_those_of_a_pi_controller(q_angle, q_bias, r_angle):
    """kp**2 = (q_angle + 2 ki r) / r, ki**2 = q_bias / r with r = r_angle / rate: better the smaller the gains."""
    rate = 200
    r = r_angle / rate
    ki = math.sqrt(q_bias / r)
    kp = math.sqrt(q_angle / r + 2 * ki)
    gains = steady(q_angle, q_bias, r_angle, rate)
    assert gains * rate == pytest.approx([kp, -ki], rel=kp / rate)
    if q_angle < 1e-9:  # nothing but the bias wanders: damped by 0.71 whatever the noise
        assert kp / (2 * math.sqrt(ki)) == pytest.approx(math.sqrt(0.5), rel=1e-3)


def test_the_steady_kalman_filter_of_tilt_and_bias_is_mahonys():
    """From 2 deg wrong and with a bias of 1 deg/s: the same angle at every step, but for the sine of 2 deg."""
    rate, bias = 200, math.radians(1)
    gains = steady(1e-5, 1e-6, 0.1, rate)
    twin = MahonyFloat(rate, 1.0, 16384, gains[0] * rate, -gains[1] * rate, math.inf)
    angle, learnt = math.radians(2), 0.0
    twin.q = [math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]
    worst, span = 0, 0
    for _ in range(rate * 60):
        # predict, then correct by the accelerometer, which shows 0; the twin corrects while it predicts
        error = 0 - angle
        learnt += gains[1] * error
        angle += (bias - learnt) / rate + gains[0] * error
        twin.update([0, 0, 4096, bias, 0, 0, 0, 0, 0, 0, 1])
        worst = max(worst, abs(2 * math.atan2(twin.q[1], twin.q[0]) - angle))
        span = max(span, abs(angle))
    assert math.degrees(span) > 2
    assert abs(angle) < 1e-4
    print(f"{math.degrees(worst):.4f} deg of {math.degrees(span):.1f}")
    assert worst < 0.002 * span
    assert learnt == pytest.approx(-twin.integral[0], rel=0.01)
    assert learnt == pytest.approx(bias, rel=0.01)
