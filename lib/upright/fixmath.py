# Integer kernels and set-up arithmetic that the attitude filters share: turning a quaternion, Euler angles.
# Needs the viper emitter of MicroPython, or CPython with a stand-in `micropython` module.
# The part marked "tick" allocates nothing, raises nothing and uses no float; all of it gives the
# same bits on every port.
#
# The kernels work on a filter's state, one array('i') that starts with the words below. Viper's
# ptr32 zero-extends on 64-bit ports, so word 0 holds -1: a kernel that reads it as a positive
# number shifts every signed load by 32 bits up and down again (`<< k >> k`). For products a
# Q-number v is split as h = (v + half) >> b, l = v - (h << b): the centred low part l keeps sums of
# products below 2**31 and free of a bias. docs/numerics.md has the bounds.

from array import array

import micropython
from micropython import const

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1: ptr32 zero-extends on 64-bit ports, see fixmath.py
_Q = const(1)  # 4, Q29: quaternion w x y z, body to earth
_QR = const(5)  # 4, Q44: its rounding remainder, 0..32767
_W = const(9)  # 3, Q31: half the angle of this step, rad
_WR = const(12)  # 3, Q46: its rounding remainder, 0..32767
# -- end of the words

ONE = const(1 << 29)  # 1.0 in Q29

# pi to 16 digits, for set-up in integers: single-precision boards get the same gains bit for bit
PI_NUM = 3141592653589793
PI_DEN = 1000000000000000


# ------------------------------------------------------------------------------------------ tick
@micropython.viper
def turn(s: ptr32):
    """Turn Q by the half angle d = W, |d| < 1 rad: Q = Q (x) (cos|d|, d sin|d| / |d|), renormalised.

    The closed form: 1 - sin(d)/d and 1 - cos(d) as polynomials in d**2, their integer coefficients
    fitted near those of the series: within 2e-6 |d|**5 rad, less than the rounding below 0.3 rad.
    The renormalisation, a factor of 1 - (|Q|**2 - 1)/2, goes into the cosine. Remainders are
    carried in WR and QR. W becomes d sin|d| / |d|.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    x = s[_W] << k >> k
    y = s[_W + 1] << k >> k
    z = s[_W + 2] << k >> k
    xh = (x + 32768) >> 16
    yh = (y + 32768) >> 16
    zh = (z + 32768) >> 16
    xl = x - (xh << 16)
    yl = y - (yh << 16)
    zl = z - (zh << 16)
    # n = d**2, Q30
    n = xh * xh + yh * yh + zh * zh + ((xh * xl + yh * yl + zh * zl + 16384) >> 15)
    h = n >> 15
    n &= 32767
    # c = 1 - sin(d)/d = n (1/6 - n (1/120 - n (1/5040 - n/362880))), Q31
    p = 34953 - (h * (835 - (14 * h >> 15)) >> 15)  # Q22
    p = 715827883 - ((h * p + (n * p >> 15)) >> 5)  # Q32
    f = (p + 32768) >> 16
    c = h * f + (n * f >> 15) + (h * (p - (f << 16)) >> 16)
    # f = cos(d) - 1 = -n (1/2 - n (1/24 - n (1/720 - n/40320))), Q31
    p = 43690 - (h * (1455 - (25 * h >> 15)) >> 15)  # Q20
    p = 536870912 - ((h * p + (n * p >> 15)) >> 5)  # Q30
    f = (p + 32768) >> 16
    f = 0 - (h * f << 2) - (n * f >> 13) - (h * (p - (f << 16)) >> 14)
    # d sin(d)/|d| = d - d c
    h = (c + 16384) >> 15
    c -= h << 15
    p = s[_WR] - xh * c - ((xl * h + (xl * c >> 15)) >> 1)
    s[_WR] = p & 32767
    x += (p >> 15) - xh * h
    p = s[_WR + 1] - yh * c - ((yl * h + (yl * c >> 15)) >> 1)
    s[_WR + 1] = p & 32767
    y += (p >> 15) - yh * h
    p = s[_WR + 2] - zh * c - ((zl * h + (zl * c >> 15)) >> 1)
    s[_WR + 2] = p & 32767
    z += (p >> 15) - zh * h
    q0 = s[_Q] << k >> k
    q1 = s[_Q + 1] << k >> k
    q2 = s[_Q + 2] << k >> k
    q3 = s[_Q + 3] << k >> k
    h0 = (q0 + 16384) >> 15
    h1 = (q1 + 16384) >> 15
    h2 = (q2 + 16384) >> 15
    h3 = (q3 + 16384) >> 15
    l0 = q0 - (h0 << 15)
    l1 = q1 - (h1 << 15)
    l2 = q2 - (h2 << 15)
    l3 = q3 - (h3 << 15)
    # |Q|**2 - 1, Q28
    r = h0 * h0 + h1 * h1 + h2 * h2 + h3 * h3 - 0x10000000
    f -= (r + ((h0 * l0 + h1 * l1 + h2 * l2 + h3 * l3 + 8192) >> 14)) << 2
    # Q += Q (x) (f, x, y, z), 16 bits of the second at a time; the last 15 bits of the sum are
    # carried
    n = (f + 32768) >> 16
    xh = (x + 32768) >> 16
    yh = (y + 32768) >> 16
    zh = (z + 32768) >> 16
    p = f - (n << 16)
    xl = x - (xh << 16)
    yl = y - (yh << 16)
    zl = z - (zh << 16)
    r = l0 * n - l1 * xh - l2 * yh - l3 * zh
    r += s[_QR] + ((h0 * p - h1 * xl - h2 * yl - h3 * zl) >> 1)
    s[_QR] = r & 32767
    s[_Q] = q0 + h0 * n - h1 * xh - h2 * yh - h3 * zh + (r >> 15)
    r = l0 * xh + l1 * n + l2 * zh - l3 * yh
    r += s[_QR + 1] + ((h0 * xl + h1 * p + h2 * zl - h3 * yl) >> 1)
    s[_QR + 1] = r & 32767
    s[_Q + 1] = q1 + h0 * xh + h1 * n + h2 * zh - h3 * yh + (r >> 15)
    r = l0 * yh - l1 * zh + l2 * n + l3 * xh
    r += s[_QR + 2] + ((h0 * yl - h1 * zl + h2 * p + h3 * xl) >> 1)
    s[_QR + 2] = r & 32767
    s[_Q + 2] = q2 + h0 * yh - h1 * zh + h2 * n + h3 * xh + (r >> 15)
    r = l0 * zh + l1 * yh - l2 * xh + l3 * n
    r += s[_QR + 3] + ((h0 * zl + h1 * yl - h2 * xl + h3 * p) >> 1)
    s[_QR + 3] = r & 32767
    s[_Q + 3] = q3 + h0 * zh + h1 * yh - h2 * xh + h3 * n + (r >> 15)


# ------------------------------------- main loop: allocates nothing, shares no memory with a tick
@micropython.viper
def _euler(q: ptr32, out: ptr32, zxy: int):
    """euler() with the order as 0 or 1.

    Both orders are the same problem: with (a, b) = (q2, q1) for zyx and (q1, -q2) for zxy,
    (q0 + a, q3 - b) has the length cos(pitch/2) + sin(pitch/2) and the direction (yaw -+ roll)/2,
    (q0 - a, q3 + b) has the length cos(pitch/2) - sin(pitch/2) and the direction (yaw +- roll)/2.
    So three directions give all, and near gimbal lock only that of the vanishing one is lost: the
    sum or difference of yaw and roll, and pitch, stay exact.
    """
    out[0] = 0 - 1
    k = 0
    if out[0] > 0:
        k = 32
    w = q[0] << k >> k
    z = q[3] << k >> k
    a = q[2] << k >> k
    b = q[1] << k >> k
    if zxy:
        k = a
        a = b
        b = 0 - k
    angles = ptr32(_ATAN)
    lengths = ptr32(_LENGTH)
    u = w + a
    v = z - b
    plus = 0
    minus = 0
    length = 0
    angle = 0
    k = 0
    while k < 3:
        # x, y: the longer and the shorter of (u, v), without signs; x up to 2**28 and more
        x = u
        if u < 0:
            x = 0 - u
        y = v
        if v < 0:
            y = 0 - v
        steep = x < y
        if steep:
            angle = x
            x = y
            y = angle
        shift = 0
        while x < 0x10000000 and shift < 28:
            x <<= 1
            y <<= 1
            shift += 1
        # t = y / x, Q22: 14 bits, and 8 of what is left
        h = (x >> 14) + 1
        t = y // h
        y -= t * h - ((16384 - (x & 16383)) * t >> 14)
        t = (t << 8) + (y << 8) // h
        if t > 0x3FFFFF:
            t = 0x3FFFFF
        i = t >> 15
        t &= 32767
        # angle: of (u, v), Q17 of a degree
        angle = angles[i]
        angle += (angles[i + 1] - angle) * (t >> 1) >> 14
        if steep:
            angle = 11796480 - angle  # 90
        if u < 0:
            angle = 23592960 - angle  # 180
        if v < 0:
            angle = 0 - angle
        if k == 2:
            break
        # its length: x (1 + t**2)**0.5, Q22, less the bend of the curve, 1 - t/2 in the middle
        y = lengths[i]
        y += ((lengths[i + 1] - y) * t >> 15) - ((t * (32768 - t) >> 15) * (256 - i) >> 16)
        x += ((x >> 15) * (y >> 4) >> 3) + ((x & 32767) * (y >> 6) >> 16)
        x >>= shift
        if k == 0:
            plus = angle
            length = x
            u = w - a
            v = z + b
        else:
            minus = angle
            # lock: the shorter one has no direction left; take roll as 0
            if x < 1024:
                minus = plus
            elif length < 1024:
                plus = minus
            u = length
            v = x
        k += 1
    out[1] = ((11796480 - (angle << 1) >> 1) * 125 + 4096) >> 13  # 90 - 2 angle
    u = minus - plus
    if zxy:
        u = 0 - u
    v = minus + plus
    k = 0
    while k < 3:
        if u > 23592960:
            u -= 47185920
        elif u < 0 - 23592960:
            u += 47185920
        out[k] = ((u >> 1) * 125 + 4096) >> 13
        u = v
        k += 2


def euler(q, out, order="zyx"):
    """Euler angles of the quaternion q in integer millidegrees: roll, pitch, yaw in out[0..2].

    q: array('i') whose first 4 words are w x y z in Q29, of unit length. out: array('i') of 3 words
    or more, the only memory that is written, so that a tick may convert while the main loop does.
    Allocates nothing.

    order 'zyx': R = Rz(yaw) Ry(pitch) Rx(roll), as in aerospace. 'zxy': R = Rz(yaw) Rx(pitch)
    Ry(roll), with pitch about the x and roll about the y axis. In both yaw is right-handed about
    up. Roll and yaw are in -180000..180000, pitch in -90000..90000; the error is below 1
    millidegree at any attitude.

    Gimbal lock: at pitch = +-90 deg roll and yaw turn about the same axis. Closer than 2e-4 deg to
    it roll is given as 0 and yaw as the whole turn. Raises ValueError for another order.
    """
    if order == "zyx":
        _euler(q, out, 0)
    elif order == "zxy":
        _euler(q, out, 1)
    else:
        raise ValueError("order %r is not 'zyx' or 'zxy'" % (order,))


@micropython.viper
def add_scaled(s: ptr32, out: ptr32, k: ptr32):
    """out[0..2] += three words of s, each within +-2**30, times a factor: k, of scale()."""
    at = k[0]
    high = k[1]
    low = k[2]
    shift = k[3]
    half = 1 << shift >> 1
    i = 0
    while i < 3:
        a = ((s[at + i] >> 15 & 0x1FFFF) ^ 0x10000) - 0x10000
        b = s[at + i] & 0x7FFF
        product = a * high + (a * low >> 15) + (b * high >> 15)
        out[i] = out[i] + ((product + half) >> shift)
        i += 1


# ----------------------------------------------------------------------------- set-up: allocates
def scale(at, num, den):
    """array('i') for add_scaled: the words from s[at] on times num/den, which is 1 at the most, to 29 bits."""
    shift = 0
    while shift < 30 and num << (shift + 1) <= den:
        shift += 1
    factor = ratio(num << (30 + shift), den)
    return array("i", [at, factor >> 15, factor & 0x7FFF, shift])


def isqrt(n):
    """The integer part of the square root of n >= 0, of any size."""
    if n < 2:
        return n
    x = 1 << ((_bits(n) + 1) >> 1)
    while True:
        y = (x + n // x) >> 1
        if y >= x:
            return x
        x = y


def ratio(num, den):
    """num / den of integers, den > 0, to the nearest integer (halves away from zero)."""
    if num < 0:
        return -((-2 * num + den) // (2 * den))
    return (2 * num + den) // (2 * den)


def mantissa(num, den, least_shift, most_shift):
    """(m, s) with num/den = m / 2**s as nearly as 8192 <= m < 16384 allows.

    s stays within the shifts given, so a small number gets a shorter m. Returns None for num/den
    too large.
    """
    s = least_shift
    if ratio(num << s, den) > 16383:
        return None
    while s < most_shift and ratio(num << (s + 1), den) <= 16383:
        s += 1
    return ratio(num << s, den), s


def quantise(value, name):
    """A number >= 0 in integer millionths, to six significant digits.

    A gain written with up to six digits gives the same integer from single- and double-precision
    floats. Raises TypeError for what is not a number, ValueError for one that is negative, not
    finite or beyond 1e9.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("%s is %r, expected a number" % (name, value))
    if not 0 <= value < 1e9:
        raise ValueError("%s is %r, expected a number from 0 to 1e9" % (name, value))
    if isinstance(value, int):
        return value * 1000000
    units = 1
    while value * 1000000 / units >= 999999.5:
        units *= 10
    return int(value * 1000000 / units + 0.5) * units


def unit_quaternion(w, x, y, z):
    """(w, x, y, z), any 4 ints or floats that are not all 0, at unit length in Q29 (a tuple of ints).

    Raises ValueError when all are 0 or one is not finite.
    """
    parts = (w, x, y, z)
    largest = max([abs(v) for v in parts])
    if largest != largest or not 0 < largest < float("inf") or sum(parts) != sum(parts):
        raise ValueError("quaternion (%r, %r, %r, %r) has no direction" % parts)
    if not all([isinstance(v, int) for v in parts]):
        # into 30 bits; the numbers themselves are scaled, as the factor could leave the floats' range
        while largest < 1073741824.0:
            largest *= 2
            parts = [v * 2 for v in parts]
        while largest >= 2147483648.0:
            largest /= 2
            parts = [v / 2 for v in parts]
        parts = [int(v) for v in parts]
    # a few bits to spare under the root
    norm = isqrt((parts[0] ** 2 + parts[1] ** 2 + parts[2] ** 2 + parts[3] ** 2) << 64)
    return tuple([ratio(v << 61, norm) for v in parts])


def attitude_from_up(x, y, z):
    """The attitude with yaw 0 (order zyx) in which the body vector (x, y, z), ints, points up.

    Returns (w, x, y, z) in Q29: roll = atan2(y, z), pitch = atan2(-x, hypot(y, z)). Raises
    ValueError for the vector 0.
    """
    if x == 0 and y == 0 and z == 0:
        raise ValueError("the vector (0, 0, 0) points nowhere")
    side = isqrt((y * y + z * z) << 64)
    norm = isqrt((x * x + y * y + z * z) << 64)
    pitch_c, pitch_s = _half(side, -x << 32, norm)
    roll_c, roll_s = _half(z << 32, y << 32, side) if side else (1, 0)
    return unit_quaternion(pitch_c * roll_c, pitch_c * roll_s, pitch_s * roll_c, -pitch_s * roll_s)


def attitude_from_up_and_north(up, field):
    """The attitude in which the body vector `up` points up and `field`'s horizontal part to x, north.

    up, field: 3 ints each, neither 0 nor along the other. Returns (w, x, y, z) in Q29.
    """
    x, y, z = up
    w, i, j, k = attitude_from_up(x, y, z)
    # north and west of the field in the frame of attitude_from_up, both times hypot(y, z) |up|
    side = y * y + z * z
    norm = isqrt((x * x + side) << 64)
    if side:
        north = (field[0] * side - x * (y * field[1] + z * field[2])) << 32
        west = (z * field[1] - y * field[2]) * norm
    else:  # attitude_from_up has roll 0 there
        north = -x * field[2] << 32
        west = norm * field[1]
    c, s = _half(north, -west, isqrt(north * north + west * west))
    return unit_quaternion(c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w)


def _half(c, s, r):
    """(cos, sin) of half the angle whose cos and sin are c/r and s/r, times any positive number."""
    if c >= 0:
        return r + c, s
    return (s, r - c) if s >= 0 else (-s, c - r)


def _bits(n):
    bits = 0
    while n:
        n >>= 1
        bits += 1
    return bits


def _tables():
    """(atan(t) in degrees, Q17; (1 + t**2)**0.5 - 1, Q22), each of t = 0, 1/128 ... 1.

    Between them the kernels go straight. So an angle is moved outwards by half of what a chord is off.
    """
    one = 1 << 40
    angles, lengths = array("i", [0]), array("i", [0])
    angle, root = 0, one
    for i in range(1, 129):
        # atan(t) - atan(t - h) = atan(h / (1 + t (t - h)))
        step = (one << 7) // (16384 + i * (i - 1))
        angle += step - step * step // one * step // (3 * one)
        square = 16384 + i * i
        bend = one * 16 * i // square**2  # h**2 / 16 of the second derivative
        angles.append(ratio((angle + bend) * 180 * PI_DEN, PI_NUM << 23))
        for _ in range(2):
            root = root + (square << 66) // root >> 1
        lengths.append(ratio(root - one, 1 << 18))
    return angles, lengths


_ATAN, _LENGTH = _tables()
