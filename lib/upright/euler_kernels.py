# Integer kernels of the filters whose state is three Euler angles: sines, the angles that the accelerometer shows, the
# quaternion. Needs the viper emitter of MicroPython, or CPython with a stand-in `micropython` module. Made for a hard
# interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on every port.
#
# Angles are binary: 2**30 is a turn, so that -2**29..2**29 - 1, all that there are, are small ints on 32-bit ports.
# The state is one array('i') that starts with the words below; word 0 and the split products are those of fixmath.py.

import micropython
from micropython import const

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_Q = const(1)  # 4, Q29: quaternion w x y z, body to earth
_X = const(11)  # 3: angles for sines(), any within +-2**30
_S = const(14)  # 3, Q29: their sines
_C = const(17)  # 3, Q29: their cosines
_Z = const(20)  # 2: roll and pitch that the accelerometer shows
_LOW = const(22)  # least squared length / 4 of the accelerometer's counts that is used
# -- end of the words


@micropython.viper
def sines(s: ptr32, n: int):
    """S and C of the first n angles in X, within 5e-9.

    With z = -1..1, eighths of a turn from the nearest quarter, and t = z**2: sin and cos(pi z/4) as polynomials in t,
    their integer coefficients fitted near those of the series (1.2e-9, 5e-11).
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    i = 0
    while i < n:
        x = s[_X + i] << k >> k
        quarter = (x + 0x8000000) >> 28
        x = (x - (quarter << 28)) << 2  # z, Q29
        xh = (x + 8192) >> 14
        xl = x - (xh << 14)
        t = xh * xh + (xh * xl >> 13)  # Q30
        th = t >> 15
        tl = t & 32767
        # z (.7854 - t (.0807 - t (.00249 - t .0000359))), every bracket Q30
        y = 2673480 - (th * 38523 >> 15)
        h = y >> 15
        y &= 32767
        y = 86699678 - th * h - ((th * y + tl * h + 16384) >> 15)
        h = y >> 15
        y &= 32767
        y = 843314845 - th * h - ((th * y + tl * h + 16384) >> 15)
        h = y >> 15
        y &= 32767
        y = (xh * h + ((xh * y + (xl * h << 1) + 16384) >> 15) + 1) >> 1
        # 1 - t (.308 - t (.0159 - t (.000326 - t .00000353)))
        x = 349978 - (th * 3792 >> 15)
        h = x >> 15
        x &= 32767
        x = 17023455 - th * h - ((th * x + tl * h + 16384) >> 15)
        h = x >> 15
        x &= 32767
        x = 331168968 - th * h - ((th * x + tl * h + 16384) >> 15)
        h = x >> 15
        x &= 32767
        x = 0x20000000 - ((th * h + ((th * x + tl * h + 16384) >> 15) + 1) >> 1)
        if quarter & 1:
            h = x
            x = 0 - y
            y = h
        if quarter & 2:
            x = 0 - x
            y = 0 - y
        s[_S + i] = y
        s[_C + i] = x
        i += 1


@micropython.viper
def direction(y: int, x: int) -> int:
    """The angle of the vector (x, y), its parts within +-2**28: -2**29..2**29, within 2e-8 of a turn; 0 for (0, 0).

    From the nearest eighth of a turn, so that the tangent t is at most tan(22.5 deg): t (1 - t**2/3 + ...) / 2 pi, the
    coefficients fitted near those of the series.
    """
    a = x
    if a < 0:
        a = 0 - a
    b = y
    if b < 0:
        b = 0 - b
    steep = b > a
    if steep:
        t = a
        a = b
        b = t
    if a == 0:
        return 0
    while a < 0x8000000:
        a <<= 1
        b <<= 1
    half = b > (a >> 13) * 13573 >> 2
    if half:
        t = a - b
        a += b
        b = t
    # t = b / a in two goes of 15 bits, Q29
    h = a >> 14
    t = b // h
    b -= t * h + (t * (a & 16383) >> 14)
    t = (t << 15) + (b << 15) // h
    h = (t + 8192) >> 14
    t -= h << 14
    n = h * h + (h * t >> 13)  # t**2, Q30
    b = n & 32767
    n >>= 15
    p = 33462183 - (n * 287837 >> 9)  # Q30, as the other brackets
    a = p >> 15
    p &= 32767
    p = 56931023 - n * a - ((n * p + b * a + 16384) >> 15)
    a = p >> 15
    p &= 32767
    p = 170890910 - n * a - ((n * p + b * a + 16384) >> 15)
    a = p >> 15
    p &= 32767
    a = h * a + ((h * p + (t * a << 1) + 16384) >> 15)
    if half:
        a = 0x8000000 - a
    if steep:
        a = 0x10000000 - a
    if x < 0:
        a = 0x20000000 - a
    if y < 0:
        a = 0 - a
    return a


@micropython.viper
def accel_angles(state, counts) -> int:
    """Put the roll and pitch that the accelerometer shows into Z: atan2(ay, az), atan2(-ax, hypot(ay, az)) -> 1.

    Or nothing, and 0, where it is not to be used: flags (counts[10]) with bit 0 clear (not fresh) or bit 2 set (at full
    scale), and a squared length / 4 below LOW. Roll is 0 where ay = az = 0, as it is with C's atan2.
    """
    s = ptr32(state)
    c = ptr16(counts)
    if c[10] & 5 != 1:
        return 0
    x = ((c[0] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((c[1] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((c[2] & 0xFFFF) ^ 0x8000) - 0x8000
    n = (x * x >> 2) + (y * y >> 2) + (z * z >> 2)
    if n < s[_LOW]:
        return 0
    s[_Z] = int(direction(y << 12, z << 12))
    n = ((y * y + 1) >> 1) + ((z * z + 1) >> 1)
    if n:
        shift = 0
        while n < 0x10000000:
            n <<= 2
            shift += 1
        # half of y and z at a length of 2**14.5..2**15.5, and the root: a line, Heron twice, 12 bits more
        y = y << shift >> 1
        z = z << shift >> 1
        n = y * y + z * z
        y = ((n >> 14) * 15447 >> 15) + 8063
        y = (y + n // y) >> 1
        y = (y + n // y) >> 1
        n = ((y << 13) + (((n - y * y) << 12) // y)) >> shift
    s[_Z + 1] = int(direction(0 - (x << 12), n))
    return 1


@micropython.viper
def compose(s: ptr32):
    """Q of the half angles' sines and cosines in S and C: Rz(yaw) Ry(pitch) Rx(roll)."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    n = s[_S + 1] << k >> k
    sh = (n + 16384) >> 15
    sl = n - (sh << 15)
    n = s[_C + 1] << k >> k
    ch = (n + 16384) >> 15
    cl = n - (ch << 15)
    n = s[_S + 2] << k >> k
    yh = (n + 16384) >> 15
    yl = n - (yh << 15)
    n = s[_C + 2] << k >> k
    xh = (n + 16384) >> 15
    xl = n - (xh << 15)
    # pitch and yaw
    w = (ch * xh << 1) + ((ch * xl + cl * xh + 8192) >> 14)
    x = (sh * yh << 1) + ((sh * yl + sl * yh + 8192) >> 14)
    y = (sh * xh << 1) + ((sh * xl + sl * xh + 8192) >> 14)
    z = (ch * yh << 1) + ((ch * yl + cl * yh + 8192) >> 14)
    n = s[_S] << k >> k
    sh = (n + 16384) >> 15
    sl = n - (sh << 15)
    n = s[_C] << k >> k
    ch = (n + 16384) >> 15
    cl = n - (ch << 15)
    # and roll: w = c w + s x, x = s w - c x, y = c y + s z, z = c z - s y
    xh = (w + 16384) >> 15
    xl = w - (xh << 15)
    yh = (x + 16384) >> 15
    yl = x - (yh << 15)
    n = (ch * xh + sh * yh) << 1
    s[_Q] = n + ((ch * xl + cl * xh + sh * yl + sl * yh + 8192) >> 14)
    n = (sh * xh - ch * yh) << 1
    s[_Q + 1] = n + ((sh * xl + sl * xh - ch * yl - cl * yh + 8192) >> 14)
    xh = (y + 16384) >> 15
    xl = y - (xh << 15)
    yh = (z + 16384) >> 15
    yl = z - (yh << 15)
    n = (ch * xh + sh * yh) << 1
    s[_Q + 2] = n + ((ch * xl + cl * xh + sh * yl + sl * yh + 8192) >> 14)
    n = (ch * yh - sh * xh) << 1
    s[_Q + 3] = n + ((ch * yl + cl * yh - sh * xl - sl * xh + 8192) >> 14)
