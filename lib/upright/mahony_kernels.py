# Integer kernels of Mahony's filter (mahony.py): the errors that the accelerometer and the magnetometer show.
# Needs the viper emitter. Made for a hard interrupt: they allocate nothing, raise nothing, use no float, and give the
# same bits on every port. fixmath.py says how words and products are split; docs/numerics.md has the bounds.

import micropython
from micropython import const

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1: ptr32 zero-extends on 64-bit ports, see fixmath.py
_Q = const(1)  # 4, Q29: quaternion w x y z, body to earth
_V = const(15)  # 3: a measured vector, scaled so that its length is 2**15..2**16
_VR = const(18)  # Q30: 1 / that length, 16384..32768
_UP = const(19)  # 3, Q28: the estimated up (gravity's reaction) in the body
_E = const(22)  # 3, Q29: the attitude error as a rotation vector in the body; see north
_LOW = const(25)  # least squared length / 4 of the accelerometer's counts that is used, 4..2**28
# -- end of the words

MAG_LOW = const(64)  # least squared length / 4 of the magnetometer's counts that is used: 16 counts
STEPS_MAX = const(253)  # the most steps that a magnetometer sample can stand for


@micropython.viper
def tilt(s: ptr32, counts: ptr16):
    """Set E to (V / |V|) x UP, or to 0 where the accelerometer is not to be used.

    V is the accelerometer of counts, UP row 3 of the rotation matrix of Q. E turns the estimated
    attitude towards the one in which V points up; |E| is the sine of the angle between V and UP.
    Not used: flags (counts[10]) with bit 0 clear (not fresh) or bit 2 set (at full scale), and a
    squared length / 4 below LOW; V and UP then stay as they were.

    1/sqrt: the quadratic of least relative error (2.4 %) on [1/4, 1], then two Newton steps (1e-6,
    less than the rounding of VR). The relative error of VR is below 1.5e-4 and acts as a gain, not as
    an offset.
    """
    s[_E] = 0
    s[_E + 1] = 0
    s[_E + 2] = 0
    if counts[10] & 5 != 1:
        return
    x = ((counts[0] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((counts[1] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((counts[2] & 0xFFFF) ^ 0x8000) - 0x8000
    n = (x * x >> 2) + (y * y >> 2) + (z * z >> 2)
    if n < s[_LOW]:
        return
    shift = 0
    while n < 0x10000000:  # at most 13 times
        n <<= 2
        shift += 1
    x <<= shift
    y <<= shift
    z <<= shift
    # VR = 1 / |V|
    h0 = x >> 1
    h1 = y >> 1
    h2 = z >> 1
    n = (h0 * h0 + h1 * h1 + h2 * h2) >> 15  # squared length, Q15, 1/4..1; exact where shifted
    r = ((((26846 * n >> 15) - 53828) * n) >> 15) + 43759  # Q14
    r = r * (49152 - (n * (r * r >> 14) >> 15)) >> 15
    r = r * (49152 - (n * (r * r >> 14) >> 15)) >> 15
    if r > 32768:
        r = 32768
    s[_V] = x
    s[_V + 1] = y
    s[_V + 2] = z
    s[_VR] = r
    k = 0
    if s[_PROBE] > 0:
        k = 32
    q = s[_Q] << k >> k
    h0 = (q + 16384) >> 15
    l0 = q - (h0 << 15)
    q = s[_Q + 1] << k >> k
    h1 = (q + 16384) >> 15
    l1 = q - (h1 << 15)
    q = s[_Q + 2] << k >> k
    h2 = (q + 16384) >> 15
    l2 = q - (h2 << 15)
    q = s[_Q + 3] << k >> k
    h3 = (q + 16384) >> 15
    l3 = q - (h3 << 15)
    # UP = (2 (q1 q3 - q0 q2), 2 (q0 q1 + q2 q3), q0**2 - q1**2 - q2**2 + q3**2)
    u = ((h1 * h3 - h0 * h2) << 1) + ((h1 * l3 + l1 * h3 - h0 * l2 - l0 * h2 + 8192) >> 14)
    v = ((h0 * h1 + h2 * h3) << 1) + ((h0 * l1 + l0 * h1 + h2 * l3 + l2 * h3 + 8192) >> 14)
    w = h0 * h0 - h1 * h1 - h2 * h2 + h3 * h3
    w += (h0 * l0 - h1 * l1 - h2 * l2 + h3 * l3 + 8192) >> 14
    s[_UP] = u
    s[_UP + 1] = v
    s[_UP + 2] = w
    # E = V x UP VR: the cross product of the unscaled vector, 14 bits of UP at a time; its length comes in last
    h0 = (u + 8192) >> 14
    h1 = (v + 8192) >> 14
    h2 = (w + 8192) >> 14
    l0 = u - (h0 << 14)
    l1 = v - (h1 << 14)
    l2 = w - (h2 << 14)
    q = y * h2 - z * h1 + ((y * l2 - z * l1 + 8192) >> 14)
    h3 = (q + 16384) >> 15
    s[_E] = h3 * r + (((q - (h3 << 15)) * r + 16384) >> 15)
    q = z * h0 - x * h2 + ((z * l0 - x * l2 + 8192) >> 14)
    h3 = (q + 16384) >> 15
    s[_E + 1] = h3 * r + (((q - (h3 << 15)) * r + 16384) >> 15)
    q = x * h1 - y * h0 + ((x * l1 - y * l0 + 8192) >> 14)
    h3 = (q + 16384) >> 15
    s[_E + 2] = h3 * r + (((q - (h3 << 15)) * r + 16384) >> 15)


@micropython.viper
def north(s: ptr32, counts: ptr16, steps: int) -> int:
    """Add `steps` times the error of the magnetometer of counts to E -> what E is coarser by, 0..6.

    steps: 1..STEPS_MAX. E becomes (E + steps e) / 2**shift in Q29, |E| < 4 then; shift is returned:
    the least with steps + 3 <= 4 << shift. Or -1, with E as it was: a word is at full scale
    (-32768, 32767), or the squared length / 4 is below MAG_LOW.

    With m the unit field in the body, h = R m, b = (bx, 0, hz), bx = hypot(hx, hy) and w = R'b the
    error is e = m x w. In the earth frame that is (hy hz, hz (bx - hx), -hy bx), and with
    t = tan(heading error / 2) = hy / (bx + hx): hy (hz, hz t, -bx). So hy alone needs all of its 30
    bits; a relative error of the rest (2e-4) acts as a gain, not as an offset. Only where hx < 0 is
    bx - hx the better form of hy t.
    """
    x = ((counts[6] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((counts[7] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((counts[8] & 0xFFFF) ^ 0x8000) - 0x8000
    n = (x * x >> 2) + (y * y >> 2) + (z * z >> 2)
    full = x > 32766 or y > 32766 or z > 32766 or x < -32767 or y < -32767 or z < -32767
    if full or n < MAG_LOW:
        # nothing times a made-up field: a way out from here would be a jump too far for a Cortex-M0+
        steps = 0
        x = 64
        y = 0
        z = 0
        n = 1024
    down = 0
    while steps + 3 > 4 << down:
        down += 1
    shift = 0
    while n < 0x10000000:  # at most 11 times
        n <<= 2
        shift += 1
    # m: the counts at a length of 2**15..2**16
    x <<= shift
    y <<= shift
    z <<= shift
    h0 = x >> 1
    h1 = y >> 1
    h2 = z >> 1
    gain = 0x1FFFFFFF // ((h0 * h0 + h1 * h1 + h2 * h2) >> 14)  # 2**45 / |m|**2
    k = 0
    if s[_PROBE] > 0:
        k = 32
    n = s[_Q] << k >> k
    h0 = (n + 16384) >> 15
    l0 = n - (h0 << 15)
    n = s[_Q + 1] << k >> k
    h1 = (n + 16384) >> 15
    l1 = n - (h1 << 15)
    n = s[_Q + 2] << k >> k
    h2 = (n + 16384) >> 15
    l2 = n - (h2 << 15)
    n = s[_Q + 3] << k >> k
    h3 = (n + 16384) >> 15
    l3 = n - (h3 << 15)
    # row 2 of R (west in the body), Q28, and py = 2**14 |m| hy, 14 bits of it at a time
    u = ((h1 * h2 + h0 * h3) << 1) + ((h1 * l2 + l1 * h2 + h0 * l3 + l0 * h3 + 8192) >> 14)
    v = h0 * h0 - h1 * h1 + h2 * h2 - h3 * h3
    v += (h0 * l0 - h1 * l1 + h2 * l2 - h3 * l3 + 8192) >> 14
    w = ((h2 * h3 - h0 * h1) << 1) + ((h2 * l3 + l2 * h3 - h0 * l1 - l0 * h1 + 8192) >> 14)
    w0 = (u + 8192) >> 14
    w1 = (v + 8192) >> 14
    w2 = (w + 8192) >> 14
    py = w0 * x + w1 * y + w2 * z
    py += ((u - (w0 << 14)) * x + (v - (w1 << 14)) * y + (w - (w2 << 14)) * z + 8192) >> 14
    # rows 1 and 3, Q14
    u = h0 * h0 - h2 * h2
    v = h1 * h1 - h3 * h3
    n0 = (u + v + 8192) >> 14
    u2 = (u - v + 8192) >> 14
    u = h1 * h3
    v = h0 * h2
    n2 = (u + v + 4096) >> 13
    u0 = (u - v + 4096) >> 13
    n1 = (h1 * h2 - h0 * h3 + 4096) >> 13
    u1 = (h2 * h3 + h0 * h1 + 4096) >> 13
    px = n0 * x + n1 * y + n2 * z
    # u = 2**30 hz / |m|, times steps / 2**down
    u = ((u0 * x + u1 * y + u2 * z) >> 15) * gain >> 14
    u = u * steps >> down
    # b = 2**(shift - 1) |m| bx, 0.43..0.95 times 2**15: a line, then Heron twice
    x = (px + 16384) >> 15
    y = (py + 16384) >> 15
    n = x * x + y * y
    shift = 0
    while n < 0xC000000 and shift < 13:
        n <<= 2
        shift += 1
    x = px >> (15 - shift)
    y = py >> (15 - shift)
    n = x * x + y * y
    b = ((n >> 15) * 21845 >> 15) + 11403
    b = (b + n // b) >> 1
    b = (b + n // b) >> 1
    v = (b * gain >> 15) * steps >> down
    # the error in the earth frame, as E will be
    h = (py + 16384) >> 15
    py -= h << 15
    z = 0 - (((h * v + (py * v >> 15)) >> shift) << 1)
    if x < 0:
        y = (((b - x) >> 2) * u >> shift) << 2
        x = h * u + (py * u >> 15)
    else:
        n = (y << 15) // (b + x)
        x = h * u + (py * u >> 15)
        h = (x + 16384) >> 15
        y = h * n + ((x - (h << 15)) * n >> 15)
    # and in the body
    h0 = (x + 8192) >> 14
    h1 = (y + 8192) >> 14
    h2 = (z + 8192) >> 14
    x -= h0 << 14
    y -= h1 << 14
    z -= h2 << 14
    n = 1 << down >> 1
    u = n0 * h0 + w0 * h1 + u0 * h2 + ((n0 * x + w0 * y + u0 * z + 8192) >> 14)
    s[_E] = (((s[_E] << k >> k) + n) >> down) + u
    u = n1 * h0 + w1 * h1 + u1 * h2 + ((n1 * x + w1 * y + u1 * z + 8192) >> 14)
    s[_E + 1] = (((s[_E + 1] << k >> k) + n) >> down) + u
    u = n2 * h0 + w2 * h1 + u2 * h2 + ((n2 * x + w2 * y + u2 * z + 8192) >> 14)
    s[_E + 2] = (((s[_E + 2] << k >> k) + n) >> down) + u
    if steps == 0:
        down = -1
    return down
