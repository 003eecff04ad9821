"""The integer kernels against formulas in floats, over their whole ranges."""

import math
from array import array
from fractions import Fraction

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import mahony_float
from upright import fixmath
from upright_host import words

ONE = fixmath.ONE
AT = words.places("mahony")
int16 = st.integers(-32768, 32767)


def new_state():
    s = array("i", bytes(4 * AT.size))
    s[AT.PROBE] = -1
    s[AT.Q] = ONE
    return s


@st.composite
def unit_quaternions(draw):
    """Floats of unit length, axes and near-axes included."""
    part = st.one_of(st.floats(-1, 1), st.sampled_from([0.0, 1.0, -1.0, 1e-6, -1e-4]))
    q = [draw(part) for _ in range(4)]
    norm = math.sqrt(sum(v * v for v in q))
    return [v / norm for v in q] if norm > 1e-3 else [1.0, 0.0, 0.0, 0.0]


def q29(q):
    return array("i", [round(v * ONE) for v in q])


def matrix(q):
    n = sum(v * v for v in q)
    w, x, y, z = q
    return [
        [(w * w + x * x - y * y - z * z) / n, 2 * (x * y - w * z) / n, 2 * (x * z + w * y) / n],
        [2 * (x * y + w * z) / n, (w * w - x * x + y * y - z * z) / n, 2 * (y * z - w * x) / n],
        [2 * (x * z - w * y) / n, 2 * (y * z + w * x) / n, (w * w - x * x - y * y + z * z) / n],
    ]


def multiply(a, b):
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]


# -- turn
@given(unit_quaternions(), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0, 0.9999))
@example([1.0, 0, 0, 0], (1.0, 0, 0), 0.9999)
@example([0.5, 0.5, 0.5, 0.5], (1.0, 1.0, 1.0), 0.9999)
@example([0.5, 0.5, 0.5, 0.5], (0.0, 0.0, 0.0), 0.5)
def test_turn_is_the_closed_form(q, axis, size):
    norm = math.sqrt(sum(v * v for v in axis))
    d = [v / norm * size for v in axis] if norm > 1e-3 else [0.0] * 3
    s = new_state()
    s[1:5] = q29(q)
    for i in range(3):
        s[AT.W + i] = round(d[i] * 2**31)
    d = [v / 2**31 for v in s[AT.W : AT.W + 3]]
    c, k = mahony_float.step(d)
    expected = multiply(list(s[1:5]), [c] + [k * v for v in d])
    fixmath.turn(s)
    # rad: the rounding of a Q29 quaternion, and of the polynomials in proportion to the turn cubed
    allowed = 1.2e-8 + 1.9e-6 * size**5
    assert math.radians(mahony_float.angle_between(s[1:5], expected)) < allowed
    assert math.hypot(*s[1:5]) / ONE == pytest.approx(1, abs=1e-8 + 1.9e-6 * size**6)


def test_turn_carries_what_rounding_leaves():
    """A tenth of the quaternion's last bit a step is not lost: 100,000 steps turn as far as they should."""
    s = new_state()
    s[1:5] = q29([0.6, 0.0, 0.8, 0.0])
    start = list(s[1:5])
    for _ in range(100000):
        s[AT.W + 2] = 1  # 2**-31 rad, a quarter of 2**-29
        fixmath.turn(s)
    expected = multiply(start, [1, 0, 0, 100000 / 2**31])
    assert mahony_float.angle_between(s[1:5], expected) < 1e-6
    assert mahony_float.angle_between(s[1:5], start) > 0.005


def test_turn_brings_a_wrong_length_back_to_one():
    s = new_state()
    s[AT.Q] = round(ONE * 1.0001)
    for _ in range(3):
        fixmath.turn(s)
    assert s[AT.Q] == pytest.approx(ONE, abs=4)


# -- euler
def euler_float(q, order):
    """Roll, pitch, yaw in deg from the rotation matrix."""
    r = matrix(q)
    if order == "zyx":
        angles = (
            math.atan2(r[2][1], r[2][2]),
            math.atan2(-r[2][0], math.hypot(r[2][1], r[2][2])),
            math.atan2(r[1][0], r[0][0]),
        )
    else:
        angles = (
            math.atan2(-r[2][0], r[2][2]),
            math.atan2(r[2][1], math.hypot(r[2][0], r[2][2])),
            math.atan2(-r[0][1], r[1][1]),
        )
    return [math.degrees(a) for a in angles]


def from_euler(roll, pitch, yaw, order):
    """The quaternion whose Euler angles these are, deg."""

    def about(axis, angle):
        q = [math.cos(math.radians(angle) / 2), 0.0, 0.0, 0.0]
        q[1 + axis] = math.sin(math.radians(angle) / 2)
        return q

    pitch_axis, roll_axis = (1, 0) if order == "zyx" else (0, 1)
    return multiply(multiply(about(2, yaw), about(pitch_axis, pitch)), about(roll_axis, roll))


def euler(q, order):
    out = array("i", [7, 7, 7, 7])
    fixmath.euler(q, out, order)
    assert out[3] == 7
    return [v / 1000 for v in out[:3]]


def apart(a, b):
    return abs((a - b + 180) % 360 - 180)


orders = st.sampled_from(["zyx", "zxy"])


@settings(max_examples=400)
@given(unit_quaternions(), orders)
def test_euler_agrees_with_the_formulas_to_2_millidegrees(q, order):
    q = q29(q)
    expected = euler_float(q, order)
    if 90 - abs(expected[1]) < 0.001:
        return  # see the next two
    for got, want in zip(euler(q, order), expected, strict=True):
        assert apart(got, want) <= 0.002


@settings(max_examples=400)
@given(
    st.floats(-180, 180),
    st.floats(-6, 0),
    st.sampled_from([-1, 1]),
    st.floats(-180, 180),
    orders,
)
def test_euler_near_gimbal_lock_is_the_same_attitude(roll, decade, sign, yaw, order):
    """From 1 deg to 1 millionth of a degree from the lock; single angles as far as q resolves them."""
    pitch = sign * (90 - 10**decade)
    q = q29(from_euler(roll, pitch, yaw, order))
    got = euler(q, order)
    assert abs(got[1] - pitch) <= 0.002
    back = from_euler(*got, order)
    assert mahony_float.angle_between(back, q) < 0.003
    if decade > -3:
        resolution = math.degrees(2**-28 / math.radians(10**decade))
        assert apart(got[0], roll) <= 0.002 + resolution
        assert apart(got[2], yaw) <= 0.002 + resolution


@pytest.mark.parametrize("order", ["zyx", "zxy"])
@pytest.mark.parametrize("pitch", [90, -90])
def test_euler_at_gimbal_lock_gives_the_whole_turn_as_yaw(order, pitch):
    for turn in (0, 40, 179, -100):
        got = euler(q29(from_euler(0, pitch, turn, order)), order)
        assert got[0] == 0
        assert got[1] == pitch
        assert apart(got[2], turn) <= 0.002


@pytest.mark.parametrize("order", ["zyx", "zxy"])
def test_euler_through_gimbal_lock_leaves_no_jump_of_the_attitude(order):
    """Pitching over the top in steps of 1 millidegree."""
    before = None
    for k in range(-50, 51):
        q = q29(from_euler(20, 90 + k / 1000, 30, order))
        got = euler(q, order)
        attitude = from_euler(*got, order)
        if before is not None:
            assert mahony_float.angle_between(before, attitude) < 0.004
        before = attitude


def test_euler_of_plain_attitudes():
    assert euler(q29([1, 0, 0, 0]), "zyx") == [0, 0, 0]
    assert euler(q29(from_euler(10, 20, 30, "zyx")), "zyx") == [10, 20, 30]
    assert euler(q29(from_euler(10, 20, 30, "zxy")), "zxy") == [10, 20, 30]
    assert abs(euler(q29([0, 1, 0, 0]), "zyx")[0]) == 180
    # pitch: nose down for zyx (x axis towards the earth), about the x axis for zxy
    assert euler(q29(from_euler(0, 0, 90, "zyx")), "zxy")[2] == 90


def test_euler_refuses_an_unknown_order():
    with pytest.raises(ValueError, match="'xyz' is not 'zyx' or 'zxy'"):
        fixmath.euler(q29([1, 0, 0, 0]), array("i", [0] * 3), "xyz")


# -- set-up arithmetic
small = st.integers(-32767, 32766)


@given(small, small, small, small, small, small)
@example(0, 0, 4096, 100, 0, -200)
@example(0, 0, -4096, -100, 1, -200)
@example(4096, 0, 0, 30, 40, -50)
@example(-4096, 0, 0, 30, 40, -50)
@example(-4096, 0, 0, 30, 0, 0)
@example(1, 2, -3, 0, 5, 5)
def test_attitude_from_up_and_north_points_up_up_and_the_field_north(x, y, z, a, b, c):
    up, field = (x, y, z), (a, b, c)
    west = [y * c - z * b, z * a - x * c, x * b - y * a]
    if not any(west):
        return
    q = fixmath.attitude_from_up_and_north(up, field)
    assert math.hypot(*q) / ONE == pytest.approx(1, abs=5e-9)
    rows = matrix([v / ONE for v in q])
    for row, v in ((2, up), (1, west)):
        norm = math.sqrt(sum(k * k for k in v))
        for i in range(3):
            assert rows[row][i] == pytest.approx(v[i] / norm, abs=1e-8)
    assert sum(rows[0][i] * field[i] for i in range(3)) > 0


@given(st.integers(0, 1 << 200))
@example(0)
@example(1)
@example(3)
@example((1 << 60) - 1)
def test_isqrt(n):
    assert fixmath.isqrt(n) == math.isqrt(n)


@given(st.integers(-(1 << 80), 1 << 80), st.integers(1, 1 << 70))
def test_ratio_rounds_to_the_nearest(num, den):
    exact = Fraction(num, den)
    assert abs(fixmath.ratio(num, den) - exact) <= Fraction(1, 2)
    assert fixmath.ratio(-num, den) == -fixmath.ratio(num, den)


@given(st.integers(0, 1 << 60), st.integers(1, 1 << 60), st.integers(10, 20), st.integers(0, 20))
def test_mantissa_holds_a_ratio_to_14_bits(num, den, least, more):
    pair = fixmath.mantissa(num, den, least, least + more)
    value = Fraction(num, den)
    if pair is None:
        assert value * 2**least > 16383
        return
    m, shift = pair
    assert 0 <= m <= 16383 and least <= shift <= least + more
    assert abs(Fraction(m, 2**shift) - value) <= Fraction(1, 2 ** (shift + 1))
    assert m >= 8191 or shift == least + more


@given(st.integers(1, 999999), st.integers(-6, 2))
def test_quantise_takes_six_digits_alike_from_single_and_double_precision(digits, exponent):
    exact = Fraction(digits) * Fraction(10) ** exponent
    text = f"{digits}e{exponent}"
    single = memoryview(array("f", [float(text)]))[0]
    assert fixmath.quantise(float(text), "x") == exact * 1000000
    # a board computes in single precision throughout: each operation rounds again
    product = memoryview(array("f", [single * 1000000]))[0]
    units = 1
    while memoryview(array("f", [product / units]))[0] >= 999999.5:
        units *= 10
    scaled = memoryview(array("f", [product / units]))[0]
    assert int(memoryview(array("f", [scaled + 0.5]))[0]) * units == exact * 1000000


@pytest.mark.parametrize("value", [-1, -0.001, float("nan"), float("inf"), 2e9])
def test_quantise_refuses_what_is_no_gain(value):
    with pytest.raises(ValueError, match=r"kp is .*, expected a number from 0 to 1e9"):
        fixmath.quantise(value, "kp")


@pytest.mark.parametrize("value", ["1", None, True, 1j])
def test_quantise_refuses_what_is_no_number(value):
    with pytest.raises(TypeError, match=r"kp is .*, expected a number"):
        fixmath.quantise(value, "kp")


number = st.one_of(
    st.integers(-(10**12), 10**12), st.floats(allow_nan=False, allow_infinity=False), st.just(0)
)


@given(number, number, number, number)
@example(0, 0, 0, 1)
@example(1e-30, 0, 0, -1e-30)
@example(5e-324, 0, 0, 0)
@example(1.7e308, 0, 0, -1.7e308)
@example(3, 4.0, 0, 0)
def test_unit_quaternion_keeps_the_direction(w, x, y, z):
    largest = max(abs(v) for v in (w, x, y, z))
    if largest == 0:
        with pytest.raises(ValueError, match="has no direction"):
            fixmath.unit_quaternion(w, x, y, z)
        return
    q = fixmath.unit_quaternion(w, x, y, z)
    assert math.hypot(*q) / ONE == pytest.approx(1, abs=5e-9)
    exact = [v / largest for v in (w, x, y, z)]
    assert mahony_float.angle_between(q, exact) < 1e-6
    assert all(isinstance(v, int) for v in q)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_unit_quaternion_refuses_what_is_not_finite(bad):
    for i in range(4):
        q = [1.0, 0.0, 0.0, 0.0]
        q[i] = bad
        with pytest.raises(ValueError, match="has no direction"):
            fixmath.unit_quaternion(*q)


@given(int16, int16, int16)
@example(0, 0, -1)
@example(-32768, 0, 0)
@example(32767, 0, 0)
@example(20065, 20065, 20065)
@example(0, -5, -32768)
@example(1, 1, -32768)
def test_attitude_from_up_agrees_with_the_arc_tangents_to_a_hundredth_of_a_degree(x, y, z):
    if x == y == z == 0:
        with pytest.raises(ValueError, match="points nowhere"):
            fixmath.attitude_from_up(x, y, z)
        return
    pitch = math.degrees(math.atan2(-x, math.hypot(y, z)))
    roll = math.degrees(math.atan2(y, z))
    q = fixmath.attitude_from_up(x, y, z)
    assert mahony_float.angle_between(q, from_euler(roll, pitch, 0, "zyx")) < 1e-5
    assert math.hypot(*q) / ONE == pytest.approx(1, abs=5e-9)


# ---------------------------------------------------------------- scaled words


@pytest.mark.parametrize(
    "num, den", [(1, 1), (1, 4096), (1 << 23, 12345678901234), (999, 1000), (1, 3), (7, 1 << 40)]
)
def test_words_times_a_factor_are_right_to_the_last_bit(num, den):
    k = fixmath.scale(2, num, den)
    for value in (0, 1, -1, 12345, -54321, 1 << 29, -(1 << 29), (1 << 30) - 1, -(1 << 30)):
        state = array("i", [7, 7, value, -value, value // 3, 7])
        out = array("i", [100, -100, 0])
        fixmath.add_scaled(state, out, k)
        for got, base, word in zip(out, (100, -100, 0), state[2:5], strict=True):
            exact = word * num / den
            # one for the limbs' and one for the last rounding; the factor has 29 bits
            assert abs(got - base - exact) <= 2.01 + abs(exact) * 2**-28
