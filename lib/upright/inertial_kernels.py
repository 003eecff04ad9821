# Integer kernels of the inertial-frame Mahony filter (inertial_mahony.py): levelling, rest, gyro bias, magnetic field.
# Needs the viper emitter of MicroPython, or CPython with a stand-in `micropython` module. All of it is made for a
# hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on every port.
#
# The kernels work on the filter's state, one array('i') that starts as fixmath.py's (probe, quaternion, half angle;
# `turn` needs no more). A block is 2**BLOCK steps of 22 to 44 ms together (up to 80 ms below 90 Hz): what is slow
# runs once a block, each part on a step of its own, so its constants do not depend on the sample rate. Bounds:
# docs/numerics.md.

from array import array

import micropython
from micropython import const

_PROBE = const(0)
_Q = const(1)
_G = const(15)  # half angle per step of one gyro count, Q31 ...
_GR = const(16)  # ... and its last bits, 2**-46, 0..32767
_O = const(17)  # 3: minus the bias as a half angle per step, Q31
_OR = const(20)  # 3: its last bits, 2**-46, -32767..32767
# the filter's own words, after fixmath's WR; inertial_mahony.py has the same list
_CE = const(23)  # 3: correction of the next step in the earth frame, half angle, Q31
_R = const(26)  # 9: rotation matrix; rows are north, west, up in the body; Q15
_S = const(35)  # 3: low-passed specific force in the earth frame, counts, Q14
_OFF = const(38)  # 2: its last sample less the low-pass, horizontal, counts, Q14
_K = const(40)  # tilt gain times dt = K / 2**K_SHIFT, K < 2**15
_K_SHIFT = const(41)
_KC = const(42)  # the same for S (normalised) to half angle
_KC_SHIFT = const(43)
_N = const(44)  # fresh steps since the start of the ramp, no more than N_END
_N_RAMP = const(45)  # steps of the ramp
_N_LATE = const(46)  # steps until the bias is estimated in motion
_RAMP = const(47)  # ramp of the tilt, Q8
_K_END = const(48)  # K after the ramp
_K_END_SHIFT = const(49)
_NORM = const(50)  # shift that brings 1 g to 2**14..2**15 counts
_G1 = const(51)  # 1 g in counts
_LI = const(52)  # 2**29 / (1 g, normalised)
_OM_GAIN = const(53)  # 2**24 / (0.3 g, normalised)
_BLOCK = const(54)  # log2 of the steps of a block
_DECIDED = const(55)  # yes/no decisions, for the tests' float twin
_X = const(56)  # 6: regressors north and west: inner low-pass, Q24
_Y = const(62)  # 6: outer low-pass, Q24
_Z = const(68)  # 3: regressor up, Q24
_D = const(71)  # square of the horizontal deviation / (0.3 g)**2, Q15
_OM = const(72)  # tilt confidence 1 / (1 + D), Q15
_GS = const(73)  # 3: gyro counts summed over the block
_LOW1 = const(76)  # 6: first low-pass of accelerometer, gyro less base; counts, Q12
_LOW2 = const(82)  # 6: second
_BASE = const(88)  # 3: gyro bias that was set, 1/256 count
_B = const(91)  # 3: learned bias on top, counts, Q(B_SHIFT)
_J = const(94)  # 3: information in blocks, Q14
_II = const(97)  # 3: 1 / information in seconds, Q20
_BLOCKS = const(100)  # of the rest detector's start
_STILL = const(101)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(102)
_REST_K = const(103)  # Q15
_REST_GYRO = const(104)  # counts**2, Q6
_REST_ACCEL = const(105)  # counts**2, Q6
_REST_MOST = const(106)  # most that is taken for a bias, counts, Q12
_REST_OFF = const(107)  # most that a known bias may be off, counts, Q12
_J_KNOWN = const(108)  # blocks, Q14
_UPSET = const(109)  # tilt at rest that restarts the ramps: (counts / 4)**2
_B_SHIFT = const(110)
_B_MAX = const(111)  # counts, Q(B_SHIFT)
_CC = const(112)  # half angle (Q31) to counts (Q12): CC / 2**CC_SHIFT
_CC_SHIFT = const(113)
_CE_MAX = const(114)  # 4096 counts as a half angle, Q31
_J_DECAY = const(115)  # 2**22 / blocks of 150 s
_RATE_T = const(116)  # blocks a second, Q4
_J_LEAST = const(117)  # first information, blocks, Q14
_MS = const(118)  # 3: magnetometer in the earth frame, counts, Q9, summed over the block
_MN = const(121)  # samples in it
_SINCE = const(122)  # blocks since the last with a sample
_J_MAG = const(123)  # blocks that the heading of this block stands for; 0: none
_E = const(124)  # heading error, rad, Q28
_NOW = const(125)  # 2: horizontal and vertical field, counts, Q13
_HAVE = const(127)  # 1: field and candidate are set; 2: reference, too
_F = const(128)  # 2: smoothed field, counts, Q13
_FR = const(130)  # 2: reference
_FC = const(132)  # 2: candidate
_NEAR = const(134)  # blocks near the reference, no more than FIELD_AFTER
_CAND = const(135)  # blocks near the candidate
_REJECTED = const(136)  # blocks
_WEIGHT = const(137)  # of the heading, in halves: 2 accepted, 1 after a long rejection, 0
_TOL = const(138)  # tolerance squared, Q15
_SMOOTH = const(139)  # blocks of 0.05 s, Q10
_REF = const(140)  # blocks of the reference's time constant, Q10
_FIELD_AFTER = const(141)
_FIELD_FIRST = const(142)
_FIELD_NEW = const(143)
_REJECT_FOR = const(144)
_TURNING_MIN = const(145)  # counts**2, Q4
_AGREE = const(146)  # rad, Q28
_HN = const(147)  # blocks since the start of the heading's ramp
_LOST = const(148)  # blocks of large heading error
_FAR_MIN = const(149)  # rad, Q28
_RESTART_AFTER = const(150)
_HRAMP = const(151)  # ramp of the heading, Q8
_HK = const(152)  # heading gain of a block, Q22
_LIMIT_AFTER = const(153)  # blocks
_PUSH = const(154)  # heading correction of one block, rad, Q28
_ZK = const(155)  # gain of it, Q22
_PUSH_MAX = const(156)  # bound of it for the bias, rad, Q28
_HC = const(157)  # PUSH to counts, Q12: HC / 2**(HC_SHIFT + 8)
_HC_SHIFT = const(158)
_DOUBT = const(159)  # heading uncertainty, rad, Q28
_DOUBT_RATE = const(160)  # its growth in a block where 1/information is 1, rad, Q20
_LITE = const(161)  # 1: no field rejection, no restart of the heading
_LATE = const(162)  # 1: the bias is estimated in motion
_C = const(163)  # 3: correction (north, west; up) in counts, Q12
_U = const(166)  # 3: what the block tells about the bias, counts, Q15
_O_BASE = const(169)  # 3: O of BASE alone
_OR_BASE = const(172)  # 3: its last bits
_N_END = const(175)  # steps after which the start is over
_PHASE = const(176)  # fresh steps of the block
_BLOCK_MASK = const(177)  # steps of a block less 1
_NINE = const(178)  # 1: use the magnetometer
_HK_DOUBT = const(179)  # heading gain of a block where 1/information is 1, Q22
_GAP = const(180)  # steps since the last fresh sample
_OUTAGE = const(181)  # steps without one that restart the ramps
WORDS = const(182)

_STILL_BIT = const(1)
_NEAR_REFERENCE = const(2)
_NEAR_CANDIDATE = const(4)
_TURNING = const(8)
_FAR = const(16)
_OVER = const(32)
_AGREES = const(64)
_UPSET_BIT = const(128)

_LIMIT = const(42949673)  # 0.16 rad, Q28
PI28 = const(843314857)  # pi, Q28

# atan(2**-i) in rad, Q28
# fmt: off
_ATAN = array("i", [
    210828714, 124459457, 65760959, 33381290, 16755422, 8385879, 4193963, 2097109, 1048571,
    524287, 262144, 131072, 65536, 32768, 16384, 8192, 4096, 2048, 1024, 512,
])
# fmt: on


# ------------------------------------------------------------------------------------------ every step
@micropython.viper
def ramp(s: ptr32):
    """The tilt gain of step N of the start: K dt = 1 / (RAMP N + 2), then the steady one."""
    n = s[_N] + 1
    s[_N] = n
    s[_LATE] = 0
    if n > s[_N_LATE]:
        s[_LATE] = 1
    m = s[_K_END]
    e = s[_K_END_SHIFT]
    if n < s[_N_RAMP]:
        x = s[_RAMP] * n + 512  # 1 / K dt, Q8
        m = 0x3FFFFFFF // x
        m = (m << 6) + ((0x3FFFFFFF - m * x) << 6) // x  # Q28
        e = 28
        while m >= 32768:
            m >>= 1
            e -= 1
    s[_K] = m
    s[_K_SHIFT] = e
    m = m * s[_LI] >> 14
    e -= 1
    if m >= 32768:
        m >>= 1
        e -= 1
    s[_KC] = m
    s[_KC_SHIFT] = e


@micropython.viper
def level(s: ptr32, counts: ptr16):
    """R of Q; the specific force in the earth frame, R a, goes into its low-pass S.

    a is as measured: neither normalised nor left out at full scale, so that what comes in swings cancels.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    a = ((s[_Q] << k >> k) + 8192) >> 14
    b = ((s[_Q + 1] << k >> k) + 8192) >> 14
    c = ((s[_Q + 2] << k >> k) + 8192) >> 14
    d = ((s[_Q + 3] << k >> k) + 8192) >> 14
    x = ((counts[0] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((counts[1] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((counts[2] & 0xFFFF) ^ 0x8000) - 0x8000
    gain = s[_K]
    shift = s[_K_SHIFT] - 16  # twice K, and 15 bits are in the split
    half = 1 << shift >> 1
    m = 32768 - ((c * c + d * d + 8192) >> 14)
    n = (b * c - a * d + 8192) >> 14
    o = (b * d + a * c + 8192) >> 14
    s[_R] = m
    s[_R + 1] = n
    s[_R + 2] = o
    f = s[_S] << k >> k
    h = ((m * x + n * y + o * z) >> 1) - f
    s[_OFF] = h
    m = (h + 32768) >> 16
    n = h - (m << 16)
    s[_S] = f + (((m * gain << 1) + (n * gain >> 15) + half) >> shift)
    m = (b * c + a * d + 8192) >> 14
    n = 32768 - ((b * b + d * d + 8192) >> 14)
    o = (c * d - a * b + 8192) >> 14
    s[_R + 3] = m
    s[_R + 4] = n
    s[_R + 5] = o
    f = s[_S + 1] << k >> k
    h = ((m * x + n * y + o * z) >> 1) - f
    s[_OFF + 1] = h
    m = (h + 32768) >> 16
    n = h - (m << 16)
    s[_S + 1] = f + (((m * gain << 1) + (n * gain >> 15) + half) >> shift)
    m = (b * d - a * c + 8192) >> 14
    n = (c * d + a * b + 8192) >> 14
    o = 32768 - ((b * b + c * c + 8192) >> 14)
    s[_R + 6] = m
    s[_R + 7] = n
    s[_R + 8] = o
    f = s[_S + 2] << k >> k
    h = ((m * x + n * y + o * z) >> 1) - f
    m = (h + 32768) >> 16
    n = h - (m << 16)
    f += ((m * gain << 1) + (n * gain >> 15) + half) >> shift
    s[_S + 2] = f


@micropython.viper
def lean(s: ptr32):
    """CE: the turn that levels S, K dt (S1, -S0) / g, each part at most K dt; upside down, 1.4 K dt as a whole."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    most = s[_G1] << 14
    x = s[_S] << k >> k
    if x > most:
        x = most
    elif x < 0 - most:
        x = 0 - most
    y = s[_S + 1] << k >> k
    if y > most:
        y = most
    elif y < 0 - most:
        y = 0 - most
    n = s[_NORM]
    x <<= n
    y <<= n
    decided = s[_DECIDED] | _OVER
    if (s[_S + 2] << k >> k) < 0:
        most = s[_G1] << n
        i = (x + 8192) >> 14
        j = (y + 8192) >> 14
        h = (i * i >> 2) + (j * j >> 2)
        if h < most * most >> 2:
            # root of h, bit by bit; to 1/1024 g
            r = 0
            bit = 8192
            while bit:
                t = r + bit
                if t * t <= h:
                    r = t
                bit >>= 1
            r = (r << 1) + (most >> 10)
            most = most * 45875 >> 15
            x = i * most // r << 14
            y = j * most // r << 14
    else:
        decided ^= _OVER
    s[_DECIDED] = decided
    gain = s[_KC]
    shift = s[_KC_SHIFT] - 14
    half = 1 << shift >> 1
    h = (y + 8192) >> 14
    s[_CE] = (h * gain + ((y - (h << 14)) * gain >> 14) + half) >> shift
    h = (x + 8192) >> 14
    s[_CE + 1] = 0 - ((h * gain + ((x - (h << 14)) * gain >> 14) + half) >> shift)


@micropython.viper
def gather(s: ptr32, counts: ptr16):
    """Add a magnetometer sample, turned into the earth frame, to the block's sum.

    Left out: all zero, an axis at full scale.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    x = ((counts[6] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((counts[7] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((counts[8] & 0xFFFF) ^ 0x8000) - 0x8000
    if (x | y | z) == 0:
        return
    if x > 32766 or y > 32766 or z > 32766 or x < -32766 or y < -32766 or z < -32766:
        return
    s[_MN] += 1
    t = (s[_R] << k >> k) * x + (s[_R + 1] << k >> k) * y + (s[_R + 2] << k >> k) * z
    s[_MS] = (s[_MS] << k >> k) + ((t + 32) >> 6)
    t = (s[_R + 3] << k >> k) * x + (s[_R + 4] << k >> k) * y + (s[_R + 5] << k >> k) * z
    s[_MS + 1] = (s[_MS + 1] << k >> k) + ((t + 32) >> 6)
    t = (s[_R + 6] << k >> k) * x + (s[_R + 7] << k >> k) * y + (s[_R + 8] << k >> k) * z
    s[_MS + 2] = (s[_MS + 2] << k >> k) + ((t + 32) >> 6)


# ------------------------------------------------------------------------------------------ once a block
@micropython.viper
def rest(s: ptr32, counts: ptr16):
    """Rest: gyro and accelerometer stay near their two-pole low-passes, the gyro near its bias where that is known.

    A block's mean goes into the gyro's low-pass; what is judged is the sample.
    At rest a tilt error that cannot be restarts the ramps.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    gain = s[_REST_K]
    i = s[_BLOCKS] + 1
    if i * gain < 32768:
        s[_BLOCKS] = i
        gain = 32768 // i  # the mean of all, until the low-pass takes over
    b_shift = s[_B_SHIFT] - 12
    fine = 12 - s[_BLOCK]
    still = 1
    gyro = 0
    accel = 0
    i = 0
    while i < 6:
        x = ((counts[i] & 0xFFFF) ^ 0x8000) - 0x8000
        x <<= 12
        v = x
        if i > 2:
            base = (s[_BASE + i - 3] << k >> k) << 4
            x -= base
            v = ((s[_GS + i - 3] << k >> k) << fine) - base
            s[_GS + i - 3] = 0
        f = s[_LOW1 + i] << k >> k
        v -= f
        h = v >> 15
        f += h * gain + ((v - (h << 15)) * gain + 16384 >> 15)
        s[_LOW1 + i] = f
        v = s[_LOW2 + i] << k >> k
        f -= v
        h = f >> 15
        v += h * gain + ((f - (h << 15)) * gain + 16384 >> 15)
        s[_LOW2 + i] = v
        x = (x - v) >> 9
        if x < 0:
            x = 0 - x
        if x > 16383:
            x = 16383
        if i < 3:
            accel += x * x
        else:
            gyro += x * x
            f = v - ((s[_B + i - 3] << k >> k) >> b_shift)
            if f < 0:
                f = 0 - f
            if v < 0:
                v = 0 - v
            if v > s[_REST_MOST] or (s[_J + i - 3] > s[_J_KNOWN] and f > s[_REST_OFF]):
                still = 0
        i += 1
    decided = s[_DECIDED] | (_STILL_BIT | _UPSET_BIT)
    i = 0
    if still and gyro < s[_REST_GYRO] and accel < s[_REST_ACCEL]:
        i = s[_STILL] + 1
        if i > s[_REST_AFTER]:
            i = s[_REST_AFTER]
    else:
        decided ^= _STILL_BIT
    x = (s[_S] << k >> k) >> 16
    v = (s[_S + 1] << k >> k) >> 16
    if i == s[_REST_AFTER] and x * x + v * v > s[_UPSET]:
        i = 0
        s[_N] = 0
        s[_LATE] = 0
        if s[_LITE] == 0:
            s[_HN] = 0
    else:
        decided ^= _UPSET_BIT
    s[_STILL] = i
    s[_DECIDED] = decided


@micropython.viper
def regress(s: ptr32):
    """The horizontal earth axes in the body, filtered as the tilt correction is; and the tilt's confidence."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    gain = s[_K]
    shift = s[_K_SHIFT] - s[_BLOCK]
    if shift < 16:
        gain = 32767
        shift = 16
    shift -= 12  # of twice the gain, with 11 bits in the split
    half = 1 << shift >> 1
    i = 0
    while i < 6:
        x = s[_X + i] << k >> k
        y = s[_Y + i] << k >> k
        x += ((((s[_R + i] << k >> k) << 9) - y - x + 1024 >> 11) * gain + half) >> shift
        s[_X + i] = x
        s[_Y + i] = y + (((x + 1024 >> 11) * gain + (half << 1)) >> (shift + 1))
        i += 1
    most = 3 * s[_G1] << 14
    norm = 13 - s[_NORM]
    total = 0
    i = 0
    while i < 2:
        x = s[_OFF + i] << k >> k
        if x < 0:
            x = 0 - x
        if x > most:
            x = most
        x = (x >> norm) * s[_OM_GAIN] >> 14  # horizontal deviation / 0.3 g, Q11
        total += x * x
        i += 1
    y = s[_D]
    x = (total >> 7) - y
    i = x >> 12
    y += (i * gain + ((x - (i << 12)) * gain >> 12) + (half >> 1)) >> (shift - 1)
    if y < 0:
        y = 0
    s[_D] = y
    s[_OM] = 0x3FFFFFFF // (32768 + y)


@micropython.viper
def compass(s: ptr32):
    """E: the heading error, from the block's mean field; NOW: its horizontal and vertical part. CORDIC."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    n = s[_MN]
    j = s[_SINCE] + 1
    if j > 16:
        j = 16
    s[_SINCE] = j
    s[_J_MAG] = 0
    if n == 0:
        return
    s[_J_MAG] = j
    s[_SINCE] = 0
    s[_MN] = 0
    x = (s[_MS] << k >> k) // n << 4
    y = 0 - ((s[_MS + 1] << k >> k) // n << 4)
    s[_NOW + 1] = (s[_MS + 2] << k >> k) // n << 4
    s[_MS] = 0
    s[_MS + 1] = 0
    s[_MS + 2] = 0
    angle = 0
    if x < 0:
        angle = PI28
        if y < 0:
            angle = 0 - angle
        x = 0 - x
        y = 0 - y
    t = y
    if t < 0:
        t = 0 - t
    if x + t == 0:
        s[_E] = 0
        s[_NOW] = 0
        return
    shift = 0
    while x + t < 0x10000000:
        x <<= 1
        y <<= 1
        t <<= 1
        shift += 1
    table = ptr32(_ATAN)
    i = 0
    while i < 20:
        t = y >> i
        if y > 0:
            y -= x >> i
            x += t
            angle += table[i]
        else:
            y += x >> i
            x -= t
            angle -= table[i]
        i += 1
    s[_E] = angle
    # x is 1.64676 times the length
    t = x >> 15
    s[_NOW] = t * 19898 + ((x - (t << 15)) * 19898 >> 15) >> shift


@micropython.viper
def field(s: ptr32, counts: ptr16):
    """Smooth the field (horizontal and vertical part) and compare: near the reference, near the candidate, turning."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J_MAG]
    have = s[_HAVE]
    gain = (j << 24) // ((j << 10) + s[_SMOOTH])  # Q14
    i = 0
    while i < 2:
        x = s[_NOW + i] << k >> k
        if have == 0:
            s[_F + i] = x
            s[_FC + i] = x
        y = s[_F + i] << k >> k
        x -= y
        n = x >> 14
        s[_F + i] = y + n * gain + ((x - (n << 14)) * gain >> 14)
        i += 1
    bits = 0
    if have == 0:
        s[_HAVE] = 1
    i = 0
    if have < 2:
        i = 2  # no reference yet
    while i < 4:
        x = s[_FR + i] << k >> k
        y = s[_FR + i + 1] << k >> k
        n = (s[_F] << k >> k) - x
        m = (s[_F + 1] << k >> k) - y
        if y < 0:
            y = 0 - y
        if n < 0:
            n = 0 - n
        if m < 0:
            m = 0 - m
        while (x | y | n | m) > 32767:
            x >>= 1
            y >>= 1
            n >>= 1
            m >>= 1
        if n * n + m * m < (x * x + y * y >> 15) * s[_TOL]:
            bits |= _NEAR_REFERENCE << (i >> 1)
        i += 2
    have = s[_B_SHIFT] - 2
    m = 0
    i = 0
    while i < 3:
        x = ((counts[3 + i] & 0xFFFF) ^ 0x8000) - 0x8000
        x = (x << 2) - ((s[_BASE + i] << k >> k) >> 6) - ((s[_B + i] << k >> k) >> have)
        if x < 0:
            x = 0 - x
        if x > 16383:
            x = 16383
        m += x * x
        i += 1
    if m >= s[_TURNING_MIN]:
        bits |= _TURNING
    x = s[_E] << k >> k
    if x < s[_AGREE] and x > 0 - s[_AGREE]:
        bits |= _AGREES
    m = _NEAR_REFERENCE | _NEAR_CANDIDATE | _TURNING | _AGREES
    s[_DECIDED] = (s[_DECIDED] | m) ^ m | bits


@micropython.viper
def judge(s: ptr32):
    """WEIGHT: whether the field is that of the reference, which follows slowly.

    A field that stays the same while the body turns becomes the reference, if its heading agrees with the gyro's.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J_MAG]
    bits = s[_DECIDED]
    have = s[_HAVE]
    gain = (j << 26) // ((j << 10) + s[_REF] >> 4)  # Q20
    if gain > 65535:
        gain = 65535
    good = 0
    near = 0
    if have > 1 and bits & _NEAR_REFERENCE:
        near = s[_NEAR] + j
        if near >= s[_FIELD_AFTER]:
            near = s[_FIELD_AFTER]
            good = 1
    count = s[_CAND]
    if bits & _NEAR_CANDIDATE == 0:
        count = 0
    elif have < 2 or bits & _TURNING:
        count += j
    i = 0
    if good == 0:
        i = 2
    while i < 4:
        y = s[_FR + i] << k >> k
        x = (s[_F + (i & 1)] << k >> k) - y
        if i > 1 and bits & _NEAR_CANDIDATE == 0:
            y += x
        else:
            n = x >> 15
            y += n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5
        s[_FR + i] = y
        i += 1
    i = s[_FIELD_FIRST]
    if have > 1:
        i = s[_FIELD_NEW]
    if count >= i:
        count = i
        if good + near == 0 and (have < 2 or bits & _AGREES):
            s[_FR] = s[_FC]
            s[_FR + 1] = s[_FC + 1]
            s[_HAVE] = 2
            have = 2
            near = s[_FIELD_AFTER]
            good = 1
    s[_CAND] = count
    s[_NEAR] = near
    n = s[_REJECTED]
    i = 2
    if good:
        n -= j << 1
        if n < 0:
            n = 0
    else:
        if have > 1:
            i = 1
        if n <= s[_REJECT_FOR]:
            n += j
            if have > 1:
                i = 0
    s[_REJECTED] = n
    s[_WEIGHT] = i


@micropython.viper
def steer(s: ptr32):
    """The turn about up that the heading error asks for, bounded: PUSH in one block, CE for all since the last."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    u = 0  # uncertainty of the vertical bias, Q28
    i = 0
    while i < 3:
        x = s[_R + 6 + i] << k >> k
        u += (x * x >> 16) * (s[_II + i] >> 4)
        i += 1
    u >>= 2
    j = s[_J_MAG]
    w = s[_WEIGHT]
    doubt = s[_DOUBT]
    s[_PUSH] = 0
    s[_ZK] = 0
    if j == 0 or w == 0:
        doubt += (u >> 14) * s[_DOUBT_RATE] >> 6
        if doubt > PI28:
            doubt = PI28
        s[_DOUBT] = doubt
        s[_J_MAG] = 0
        return
    e = s[_E] << k >> k
    a = e
    if a < 0:
        a = 0 - a
    n = s[_HN] + j
    if n > 65535:
        n = 65535
    if s[_LITE] == 0:
        x = s[_DECIDED] | _FAR
        i = s[_LOST]
        if a <= s[_FAR_MIN]:
            x ^= _FAR
        if a > s[_FAR_MIN] and w > 1 and s[_HAVE] > 1:
            i += j
            if i > s[_RESTART_AFTER]:
                i = 0
                n = 0
        else:
            i -= j
            if i < 0:
                i = 0
        s[_LOST] = i
        s[_DECIDED] = x
    s[_HN] = n
    x = 0x3FFFFFFF // (s[_HRAMP] * n + (j << 9))  # Q22
    i = (u >> 16) * s[_HK_DOUBT] >> 12
    if i < s[_HK]:
        i = s[_HK]
    if x <= i:
        x = i
        n = 65535
    if n >= s[_LIMIT_AFTER]:
        u += _LIMIT
        if e > u:
            e = u
        elif e < 0 - u:
            e = 0 - u
    if w == 1:
        x >>= 1
    n = e >> 14
    e -= n << 14
    i = x * j
    if i > 0x200000:  # no more than half of it
        x = 0x200000 // j
        i = x * j
    s[_ZK] = i
    if x < 32768:
        e = n * x + (e * x >> 14) + 128 >> 8
    else:
        x >>= 6
        e = n * x + (e * x >> 14) + 2 >> 2
    s[_PUSH] = e
    e *= j
    if e > 0x8000000:
        e = 0x8000000
    elif e < 0 - 0x8000000:
        e = 0 - 0x8000000
    s[_CE + 2] = e << 2
    s[_DOUBT] = doubt + (((a - doubt) >> 14) * (i >> 7) >> 1)


@micropython.viper
def inform(s: ptr32):
    """The regressor up, and what the block tells about the bias: U, times information; J grows and decays."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    i = s[_ZK]
    shift = 12
    if i > 32767:
        i >>= 6
        shift = 6
    half = 1 << shift >> 1
    n = 0
    while n < 3:
        z = s[_Z + n] << k >> k
        s[_Z + n] = z + (((((s[_R + 6 + n] << k >> k) << 9) - z >> 10) * i + half) >> shift)
        n += 1
    gain = s[_CC]
    shift = s[_CC_SHIFT]
    most = s[_CE_MAX]
    n = 0
    while n < 2:
        x = s[_CE + n] << k >> k
        if x > most:
            x = most
        elif x < 0 - most:
            x = 0 - most
        m = x >> 14
        x = m * gain + ((x - (m << 14)) * gain >> 14)
        if shift < 14:
            x <<= 14 - shift
        else:
            x >>= shift - 14
        s[_C + n] = x
        n += 1
    x = s[_PUSH] << k >> k
    most = s[_PUSH_MAX]
    if x > most:
        x = most
    elif x < 0 - most:
        x = 0 - most
    m = x >> 8
    gain = s[_HC]
    s[_C + 2] = m * gain + ((x - (m << 8)) * gain >> 8) >> s[_HC_SHIFT]
    still = s[_STILL] == s[_REST_AFTER]
    j = s[_J_MAG]
    om = s[_OM]
    n = 0
    while n < 3:
        x = s[_J + n]
        if x > s[_J_LEAST]:
            m = (x >> 10) * s[_J_DECAY] >> 14
            x -= m * m >> 10
        u = 0
        if still:
            x += 1638400  # 100 a second
            u = ((s[_B + n] << k >> k) >> s[_B_SHIFT] - 15) - ((s[_LOW2 + 3 + n] << k >> k) << 3)
        elif s[_LATE]:
            y = (s[_Y + n] << k >> k) >> 9
            z = (s[_Y + 3 + n] << k >> k) >> 9
            x += ((y * y >> 16) + (z * z >> 16)) * om >> 15
            m = s[_C] << k >> k
            i = s[_C + 1] << k >> k
            u = y * (m >> 12) + (y * (m & 4095) >> 12) + z * (i >> 12) + (z * (i & 4095) >> 12)
            u = (u >> 15) * om + ((u & 32767) * om >> 15)
            z = (s[_Z + n] << k >> k) >> 9
            x += (z * z >> 18) * (13107 * j) >> 15  # 0.1 a second
            m = s[_C + 2] << k >> k
            m = (z * (m >> 12) + (z * (m & 4095) >> 12)) * j
            u += (m >> 9) * 3277 + ((m & 511) * 3277 >> 9) >> 6
        s[_J + n] = x
        s[_U + n] = u
        n += 1


@micropython.viper
def learn(s: ptr32):
    """The bias less U / J, and from it O, what the steps subtract: minus the bias as a half angle."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    b_shift = s[_B_SHIFT]
    still = s[_STILL] == s[_REST_AFTER]
    gain = s[_G]
    rest = s[_GR]
    n = 0
    while n < 3:
        m = s[_J + n]
        shift = 30 - b_shift
        x = 30
        while m < 0x20000000:
            m <<= 1
            shift -= 1
            x -= 1
        r = 0x3FFFFFFF // (m >> 14)  # 1 / J = r / 2**x
        s[_II + n] = ((r << (30 - x)) >> 8) * s[_RATE_T] >> 6
        if still:
            r = r * 25 >> 5
            shift -= 7
        x = s[_U + n] << k >> k
        x = (x >> 15) * r + ((x & 32767) * r >> 15)
        if shift > 0:
            x = x + (1 << shift >> 1) >> shift
        else:
            x <<= 0 - shift
        x = (s[_B + n] << k >> k) - x
        if x > s[_B_MAX]:
            x = s[_B_MAX]
        elif x < 0 - s[_B_MAX]:
            x = 0 - s[_B_MAX]
        s[_B + n] = x
        m = x >> 15
        x -= m << 15
        r = m * gain
        shift = b_shift - 15
        r -= r >> shift << shift
        y = (m * gain) >> shift
        m = m * rest + x * gain + (x * rest >> 15) + (r << 15)
        s[_O + n] = (s[_O_BASE + n] << k >> k) - y - (m >> b_shift)
        s[_OR + n] = (s[_OR_BASE + n] << k >> k) - ((m - (m >> b_shift << b_shift)) >> shift)
        n += 1
