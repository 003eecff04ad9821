"""The kernels of Mahony's filter against formulas in floats, over their whole ranges."""

import math
import random
from array import array

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import mahony_float
from test_fixmath import AT, ONE, int16, matrix, multiply, new_state, q29, unit_quaternions
from upright import mahony_kernels


# -- tilt
def tilt(q, x, y, z, flags=1, low=4):
    s = new_state()
    s[1:5] = q29(q)
    s[AT.LOW] = low
    mahony_kernels.tilt(s, array("h", [x, y, z, 0, 0, 0, 0, 0, 0, 0, flags]))
    return s


@given(int16, int16, int16)
@example(-32768, -32768, -32768)
@example(0, 0, 4)
@example(5, -1, 3)
@example(32767, 0, 0)
@example(20065, 20065, 20065)
def test_tilt_scales_the_accelerometer_and_takes_its_reciprocal_length(x, y, z):
    s = tilt([1, 0, 0, 0], x, y, z)
    if (x * x >> 2) + (y * y >> 2) + (z * z >> 2) < 4:
        assert list(s[AT.V : AT.VR + 1]) == [0] * 4
        return
    v = s[AT.V : AT.V + 3]
    factor = max(v, key=abs) / max((x, y, z), key=abs)
    assert list(v) == [x * factor, y * factor, z * factor]
    norm = math.hypot(*v)
    assert 2**15 * 0.9999 <= norm < 2**16
    # 8.6e-5 of the root, and 5e-5 of halving odd counts that need no scaling
    assert s[AT.VR] * norm / 2**30 == pytest.approx(1, abs=1.5e-4)


@given(unit_quaternions(), int16, int16, int16)
def test_tilt_gives_up_in_the_body_and_the_cross_product_of_the_directions(q, x, y, z):
    s = tilt(q, x, y, z, low=16)
    if (x * x >> 2) + (y * y >> 2) + (z * z >> 2) < 16:
        return
    up = matrix(q)[2]
    for i in range(3):
        assert s[AT.UP + i] / 2**28 == pytest.approx(up[i], abs=3e-8)
    norm = math.sqrt(x * x + y * y + z * z)
    a = (x / norm, y / norm, z / norm)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        expected = a[j] * up[k] - a[k] * up[j]
        assert s[AT.E + i] / 2**29 == pytest.approx(expected, rel=2e-4, abs=1e-7)


@pytest.mark.parametrize(
    "z, flags, used", [(64, 1, 1), (63, 1, 0), (64, 0, 0), (64, 5, 0), (64, 9, 1)]
)
def test_tilt_leaves_out_what_is_short_stale_or_at_full_scale(z, flags, used):
    s = new_state()
    s[1:5] = q29([0.8, 0.6, 0, 0])
    s[AT.LOW] = 1024
    for i in range(3):
        s[AT.E + i] = 99
    mahony_kernels.tilt(s, array("h", [0, 0, z, 0, 0, 0, 0, 0, 0, 0, flags]))
    assert any(s[AT.E : AT.E + 3]) == bool(used)
    assert any(s[AT.V : AT.UP + 3]) == bool(used)


# -- north
def field_error(q, m):
    """m x w as in Mahony9Float, for the unit vector of m: 3 floats in the body."""
    twin = mahony_float.Mahony9Float(200, 1, 4, 1, 0, 1)
    twin.q = q
    return twin.field_error(*m)


def north(q, m, steps, e=(0, 0, 0)):
    """(shift, E in units of 1) after north(), which starts with E = e."""
    s = new_state()
    s[1:5] = q29(q)
    for i in range(3):
        s[AT.E + i] = round(e[i] * ONE)
    shift = mahony_kernels.north(s, array("h", [0] * 6 + list(m) + [0, 3]), steps)
    return shift, [s[AT.E + i] / 2 ** (29 - max(shift, 0)) for i in range(3)]


def usable(m):
    quarter = mahony_float.quarter_square(*m)
    return quarter >= mahony_kernels.MAG_LOW and max(m) < 32767 and min(m) > -32768


@settings(max_examples=400)
@given(
    unit_quaternions(), st.tuples(int16, int16, int16), st.integers(1, mahony_kernels.STEPS_MAX),
    st.tuples(*[st.floats(-0.57, 0.57)] * 3),
)  # fmt: skip
@example([1.0, 0.0, 0.0, 0.0], (0, 16, 0), 1, (0, 0, 0))
@example([1.0, 0.0, 0.0, 0.0], (-20000, 0, -30000), 253, (0, 0, 0))
@example([1.0, 0.0, 0.0, 0.0], (-20000, 1, -3000), 7, (0, 0, 0))
@example([1.0, 0.0, 0.0, 0.0], (0, 0, -165), 253, (0.5, 0, 0))
@example([1.0, 0.0, 0.0, 0.0], (1, 0, -165), 3, (0.5, 0, 0))
@example([0.42261643503, 0.51066152567, 0.56348858005, 0.49305250754], (0, 16, -3), 1, (0, 0, 0))
@example([0.67372004368, 0.0, -0.73898667291, 0.0], (13941, 0, -733), 1, (0, 0, 0))
def test_north_adds_the_magnetometers_error_as_often_as_it_is_told(q, m, steps, e):
    shift, got = north(q, m, steps, e)
    if not usable(m):
        assert shift == -1
        assert got == pytest.approx(e, abs=2e-9)
        return
    assert 4 << shift >= steps + 3 and (shift == 0 or 4 << shift - 1 < steps + 3)
    error = field_error(q, m)
    h = [sum(row[i] * m[i] for i in range(3)) / math.hypot(*m) for row in matrix(q)]
    chord = math.hypot(h[1], math.hypot(h[0], h[1]) - h[0])  # 0 where the heading is right
    # the rows of R have 14 bits: up to 1.5e-4 of the field, which is more of its horizontal part the steeper that is
    steep = 3e-4 * min(2, chord / max(math.hypot(h[0], h[1]), 1e-9))
    for i in range(3):
        # a gain of nearly 1, and the rounding of a step's own share
        bound = steps * (3e-4 * math.hypot(*error) + 2e-4 * chord + steep + 3e-8) + 2e-9 * 2**shift
        assert got[i] == pytest.approx(e[i] + steps * error[i], abs=bound)


@given(unit_quaternions(), st.integers(-89, 89), st.floats(1e-5, 1e-3))
def test_north_sees_a_small_heading_error_to_a_part_in_three_thousand(q, dip, error):
    """No constant offset, however steep the field is: the counts here are as good as exact."""
    r = matrix(q)
    h = (math.cos(math.radians(dip)), 0, -math.sin(math.radians(dip)))
    m = [round(30000 * sum(r[j][i] * h[j] for j in range(3))) for i in range(3)]
    turn = multiply([math.cos(error / 2), 0, 0, math.sin(error / 2)], q)
    if not usable(m):
        return
    e = [a - b for a, b in zip(north(turn, m, 1)[1], north(q, m, 1)[1], strict=True)]
    true = [a - b for a, b in zip(field_error(turn, m), field_error(q, m), strict=True)]
    for i in range(3):
        assert e[i] == pytest.approx(true[i], abs=3e-4 * math.hypot(*true) + 3e-8)


def test_what_north_rounds_away_of_the_other_error_has_no_mean():
    """The field is right, so only the rounding to 23 bits is left; truncation would give -1/2."""
    rng = random.Random(1)
    total = 0
    for _ in range(2000):
        e = [rng.uniform(-0.5, 0.5) for _ in range(3)]
        shift, got = north([1.0, 0.0, 0.0, 0.0], (20000, 0, -9000), mahony_kernels.STEPS_MAX, e)
        assert shift == 6
        total += sum((a - b) * 2**23 for a, b in zip(got, e, strict=True))
    assert abs(total / 6000) < 0.02


@pytest.mark.parametrize(
    "m, used",
    [
        ((16, 0, 0), 1), ((0, -16, 0), 1), ((0, 0, 15), 0), ((0, 0, 0), 0), ((9, 9, 9), 0),
        ((32766, 0, 0), 1), ((32767, 0, 0), 0), ((0, 32767, 0), 0), ((5, 5, 32767), 0),
        ((-32767, 0, 0), 1), ((-32768, 0, 0), 0), ((0, -32768, 0), 0), ((5, 5, -32768), 0),
    ],
)  # fmt: skip
def test_north_leaves_out_what_is_short_or_at_full_scale(m, used):
    shift, e = north([0.8, 0.0, 0.0, 0.6], m, 40, (0.25, -0.5, 0.125))
    assert shift == (4 if used else -1)
    assert used or e == [0.25, -0.5, 0.125]
