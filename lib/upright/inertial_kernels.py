# Integer kernels of the inertial-frame Mahony filter (inertial.py): levelling, rest, gyro bias, magnetic field. Needs
# the viper emitter. In earth_kernels.py is what is not this filter's alone, and what a state and a block are. All of it
# is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on every
# port. K, T, y ...: the names of the equations in docs/methods.md; the float twin is host_tests/reference.

import micropython
from micropython import const

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_G = const(15)  # Q31: half angle per step of one gyro count
_GR = const(16)  # Q46: its last bits, 0..32767
_O = const(17)  # 3, Q31: minus the bias as a half angle per step
_OR = const(20)  # 3, Q46: its last bits, -32767..32767
_TURN = const(23)  # 3, Q31: correction that the next step takes up, earth frame, half angle
_R = const(26)  # 9, Q15: rotation matrix; its rows are north, west, up in the body
_FORCE = const(35)  # 3, Q15: specific force of this sample in the earth frame, counts
_BASE = const(38)  # 3, Q8: gyro bias that was set, counts
_O_BASE = const(41)  # 3, Q31: O of BASE alone
_OR_BASE = const(44)  # 3, Q46: its last bits
_B = const(47)  # 3: learnt bias on top of BASE, in the filter's own unit
_BLOCK = const(51)  # log2 of the steps of a block
_DECIDED = const(54)  # yes/no decisions, for the tests' float twin
_J = const(63)  # blocks that the heading of this block stands for; 0: none
_HEADING = const(64)  # Q28: heading error, rad
_NOW = const(65)  # 2, Q13: horizontal and vertical field, counts
_LOW2 = const(79)  # 6, Q12: second
_AWAY = const(85)  # 2, Q6: squared distance from LOW2 of accelerometer and gyro, counts**2
_STILL = const(88)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(89)  # blocks
_REST_GYRO = const(91)  # Q6: at rest AWAY is less: counts**2
_REST_ACCEL = const(92)  # Q6: the same of the accelerometer
_REST_MOST = const(93)  # Q12: most that is taken for a bias, counts
_S = const(97)  # 3, Q14: low-passed specific force in the earth frame, counts
_OFF = const(100)  # 2, Q14: its last sample less the low-pass, horizontal, counts
_K = const(102)  # tilt gain times dt = K / 2**K_SHIFT, K < 2**15
_K_SHIFT = const(103)
_KC = const(104)  # the same for S (normalised) to half angle
_KC_SHIFT = const(105)
_N = const(106)  # fresh steps since the start of the ramp, no more than N_END
_N_RAMP = const(107)  # steps of the ramp
_N_LATE = const(108)  # steps until the bias is estimated in motion
_LATE = const(110)  # 1: the bias is estimated in motion
_RAMP = const(111)  # Q8: ramp of the tilt
_K_END = const(112)  # K after the ramp
_K_END_SHIFT = const(113)
_NORM = const(114)  # shift that brings 1 g to 2**14..2**15 counts
_G1 = const(115)  # 1 g in counts
_LI = const(116)  # Q29: 1 / (1 g, normalised)
_OM_GAIN = const(117)  # Q24: 1 / (0.3 g, normalised)
_X = const(118)  # 6, Q24: regressors north and west: inner low-pass
_Y = const(124)  # 6, Q24: outer low-pass
_Z = const(130)  # 3, Q24: regressor up
_D = const(133)  # Q15: square of the horizontal deviation / (0.3 g)**2
_OM = const(134)  # Q15: tilt confidence 1 / (1 + D)
_U = const(135)  # 3, Q15: what the block tells about the bias, counts
_INFO = const(138)  # 3, Q14: information about it, blocks
_II = const(141)  # 3, Q20: 1 / information in seconds
_INFO_LEAST = const(144)  # Q14: first information, blocks
_INFO_KNOWN = const(145)  # Q14: with more the bias is well known, blocks
_INFO_DECAY = const(146)  # Q22: 1 / blocks of 150 s
_RATE_T = const(147)  # Q4: blocks a second
_REST_OFF = const(148)  # Q12: most that a known bias may be off, counts
_UPSET = const(149)  # tilt at rest that restarts the ramps: (counts / 4)**2
_B_SHIFT = const(150)  # B is in counts, Q(B_SHIFT)
_B_MAX = const(151)  # its bound
_C = const(152)  # 3, Q12: correction (north, west; up) in counts
_CC = const(155)  # half angle (Q31) to counts (Q12): CC / 2**CC_SHIFT
_CC_SHIFT = const(156)
_TURN_MAX = const(157)  # Q31: 4096 counts as a half angle
_HAVE = const(158)  # 1: field and candidate are set; 2: reference, too
_F = const(159)  # 2, Q13: smoothed field, counts
_FR = const(161)  # 2, Q13: reference; F, FR and FC stand together
_FC = const(163)  # 2, Q13: candidate
_NEAR = const(165)  # blocks near the reference, no more than FIELD_AFTER
_CAND = const(166)  # blocks near the candidate
_REJECTED = const(167)  # blocks
_WEIGHT = const(168)  # of the heading, in halves: 2 accepted, 1 after a long rejection, 0
_TOL = const(169)  # Q15: tolerance squared
_SMOOTH = const(170)  # Q10: blocks of 0.05 s
_REF = const(171)  # Q10: blocks of the reference's time constant
_FIELD_AFTER = const(172)  # blocks
_FIELD_FIRST = const(173)  # blocks
_FIELD_NEW = const(174)  # blocks
_REJECT_FOR = const(175)  # blocks
_TURNING_MIN = const(176)  # Q4: counts**2
_AGREE = const(177)  # Q28: rad
_HN = const(178)  # blocks since the start of the heading's ramp
_LOST = const(179)  # blocks of large heading error
_FAR_MIN = const(180)  # Q28: rad
_RESTART_AFTER = const(181)  # blocks
_HRAMP = const(182)  # Q8: ramp of the heading
_HK = const(183)  # Q22: heading gain of a block
_HK_DOUBT = const(184)  # Q22: the same where 1 / information is 1
_LIMIT_AFTER = const(185)  # blocks
_PUSH = const(186)  # Q28: heading correction of one block, rad
_ZK = const(187)  # Q22: gain of it
_PUSH_MAX = const(188)  # Q28: bound of it for the bias, rad
_HC = const(189)  # PUSH to counts, Q12: HC / 2**(HC_SHIFT + 8)
_HC_SHIFT = const(190)
_DOUBT = const(191)  # Q28: heading uncertainty, rad
_DOUBT_RATE = const(192)  # Q20: its growth in a block where 1 / information is 1, rad
_LITE = const(193)  # 1: no field rejection, no restart of the heading
# -- end of the words

_STILL_BIT = const(1)
_NEAR_REFERENCE = const(2)
_NEAR_CANDIDATE = const(4)
_TURNING = const(8)
_FAR = const(16)
_OVER = const(32)
_AGREES = const(64)
_UPSET_BIT = const(128)

_LIMIT = const(42949673)  # 0.16 rad, Q28
_PI28 = const(843314857)  # pi, Q28


# ------------------------------------------------------------------------------------------ every step
@micropython.viper
def ramp(s: ptr32):
    """The tilt gain of step N of the start: K dt = 1 / (RAMP N + 2), then the steady one."""
    n = s[_N] + 1
    s[_N] = n
    s[_LATE] = 0
    if n > s[_N_LATE]:
        s[_LATE] = 1
    # K dt = 1 / (RAMP N + 2) = m / 2**e, then 1 / (tau_tilt rate)
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
    # KC: K dt / (1 g)
    m = m * s[_LI] >> 14
    e -= 1
    if m >= 32768:
        m >>= 1
        e -= 1
    s[_KC] = m
    s[_KC_SHIFT] = e


@micropython.viper
def level(s: ptr32):
    """S takes up FORCE; TURN: the turn that levels S, each part at most K dt; upside down, 1.4 K dt as a whole."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # OFF = FORCE - S; S += 2 K dt OFF
    gain = s[_K]
    shift = s[_K_SHIFT] - 16  # twice K, and 15 bits are in the split
    half = 1 << shift >> 1
    x = s[_S] << k >> k
    y = ((s[_FORCE] << k >> k) >> 1) - x
    s[_OFF] = y
    h = (y + 32768) >> 16
    x += ((h * gain << 1) + ((y - (h << 16)) * gain >> 15) + half) >> shift
    s[_S] = x
    y = s[_S + 1] << k >> k
    h = ((s[_FORCE + 1] << k >> k) >> 1) - y
    s[_OFF + 1] = h
    t = (h + 32768) >> 16
    y += ((t * gain << 1) + ((h - (t << 16)) * gain >> 15) + half) >> shift
    s[_S + 1] = y
    z = s[_S + 2] << k >> k
    h = ((s[_FORCE + 2] << k >> k) >> 1) - z
    t = (h + 32768) >> 16
    z += ((t * gain << 1) + ((h - (t << 16)) * gain >> 15) + half) >> shift
    s[_S + 2] = z
    # (x, y): S, no part of it more than 1 g
    most = s[_G1] << 14
    if x > most:
        x = most
    elif x < 0 - most:
        x = 0 - most
    if y > most:
        y = most
    elif y < 0 - most:
        y = 0 - most
    n = s[_NORM]
    x <<= n
    y <<= n
    decided = s[_DECIDED] | _OVER
    if z < 0:
        # upside down: (x, y) *= 1.4 / |(x, y)| where that is shorter than 1 g
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
    # TURN = K dt (y, -x)
    gain = s[_KC]
    shift = s[_KC_SHIFT] - 14
    half = 1 << shift >> 1
    h = (y + 8192) >> 14
    s[_TURN] = (h * gain + ((y - (h << 14)) * gain >> 14) + half) >> shift
    h = (x + 8192) >> 14
    s[_TURN + 1] = 0 - ((h * gain + ((x - (h << 14)) * gain >> 14) + half) >> shift)


# ------------------------------------------------------------------------------------------ once a block
@micropython.viper
def detect_rest(s: ptr32):
    """STILL: for how long gyro and accelerometer have stayed near their low-passes, the gyro near a well-known bias.

    A block's mean goes into the gyro's low-pass; what is judged is the sample. At rest a tilt error that cannot be
    restarts the ramps.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # still: |seen - LOW2| small, |gyro| < REST_MOST, and |gyro - B| < REST_OFF where INFO > INFO_KNOWN
    still = s[_AWAY] < s[_REST_ACCEL] and s[_AWAY + 1] < s[_REST_GYRO]
    shift = s[_B_SHIFT] - 12
    i = 0
    while i < 3:
        x = s[_LOW2 + 3 + i] << k >> k
        y = x - ((s[_B + i] << k >> k) >> shift)
        if y < 0:
            y = 0 - y
        if x < 0:
            x = 0 - x
        if x > s[_REST_MOST] or (s[_INFO + i] > s[_INFO_KNOWN] and y > s[_REST_OFF]):
            still = False
        i += 1
    decided = s[_DECIDED] | (_STILL_BIT | _UPSET_BIT)
    i = 0
    if still:
        i = s[_STILL] + 1
        if i > s[_REST_AFTER]:
            i = s[_REST_AFTER]
    else:
        decided ^= _STILL_BIT
    # upset: at rest, and the horizontal part of S is more than upset_g
    x = (s[_S] << k >> k) >> 16
    y = (s[_S + 1] << k >> k) >> 16
    if i == s[_REST_AFTER] and x * x + y * y > s[_UPSET]:
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
    # x += 2 k ((north, west) - y - x); y += k x; k = K T, no more than 1/2
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
    # D += 2 k (|OFF / 0.3 g|**2 - D), no part of OFF more than 3 g; OM = 1 / (1 + D)
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
def smooth_field(s: ptr32, counts: ptr16):
    """Smooth the field (horizontal and vertical part) and compare: near the reference, near the candidate, turning."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    have = s[_HAVE]
    # F += k (NOW - F), k = j T / (0.05 s + j T)
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
    # near: |F - r| < field_tolerance |r|; r is the reference, then the candidate
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
    # turning: |gyro - bias| >= field_dps
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
    # agrees: |e| < field_agree
    x = s[_HEADING] << k >> k
    if x < s[_AGREE] and x > 0 - s[_AGREE]:
        bits |= _AGREES
    m = _NEAR_REFERENCE | _NEAR_CANDIDATE | _TURNING | _AGREES
    s[_DECIDED] = (s[_DECIDED] | m) ^ m | bits


@micropython.viper
def judge_field(s: ptr32):
    """WEIGHT: whether the field is that of the reference, which follows slowly.

    A field that stays the same while the body turns becomes the reference, if its heading agrees with the gyro's.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    bits = s[_DECIDED]
    have = s[_HAVE]
    # r += k (F - r), k = j T / (field_tau + j T), no more than 1/16
    gain = (j << 26) // ((j << 10) + s[_REF] >> 4)  # Q20
    if gain > 65535:
        gain = 65535
    # good: near the reference for field_after
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
    # a candidate of field_first, later of field_new, becomes the reference
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
    # weight: 1 when good or without a reference; 0, but 1/2 when rejected for longer than reject_for
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
    # u = sum of up_i**2 / INFO_i
    u = 0  # uncertainty of the vertical bias, Q28
    i = 0
    while i < 3:
        x = s[_R + 6 + i] << k >> k
        u += (x * x >> 16) * (s[_II + i] >> 4)
        i += 1
    u >>= 2
    j = s[_J]
    w = s[_WEIGHT]
    doubt = s[_DOUBT]
    s[_PUSH] = 0
    s[_ZK] = 0
    if j == 0 or w == 0:
        # DOUBT += u bias_limit T
        doubt += (u >> 14) * s[_DOUBT_RATE] >> 6
        if doubt > _PI28:
            doubt = _PI28
        s[_DOUBT] = doubt
        s[_J] = 0
        return
    e = s[_HEADING] << k >> k
    a = e
    if a < 0:
        a = 0 - a
    n = s[_HN] + j
    if n > 65535:
        n = 65535
    if s[_LITE] == 0:
        # |e| > restart_rad in a good field for restart_after: the ramp starts anew
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
    # k = max(1 / (ramp_heading HN + 2 j), T / tau_heading, u T / tau_doubt)
    x = 0x3FFFFFFF // (s[_HRAMP] * n + (j << 9))  # Q22
    i = (u >> 16) * s[_HK_DOUBT] >> 12
    if i < s[_HK]:
        i = s[_HK]
    if x <= i:
        x = i
        n = 65535
    # after the ramp |e| <= 0.16 rad + u
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
    # ZK = k j, no more than 1/2; PUSH = k e
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
    # TURN2 = j PUSH / 2, no more than 1/4 rad
    e *= j
    if e > 0x8000000:
        e = 0x8000000
    elif e < 0 - 0x8000000:
        e = 0 - 0x8000000
    s[_TURN + 2] = e << 2
    # DOUBT += k j (|e| - DOUBT)
    s[_DOUBT] = doubt + (((a - doubt) >> 14) * (i >> 7) >> 1)


@micropython.viper
def learn(s: ptr32):
    """B: what the block tells about the bias is taken up; INFO: how much is known of it."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # z += ZK (up - z)
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
    # C = (TURN0, TURN1) / dt and PUSH / T, bounded, as counts of a gyro
    gain = s[_CC]
    shift = s[_CC_SHIFT]
    most = s[_TURN_MAX]
    n = 0
    while n < 2:
        x = s[_TURN + n] << k >> k
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
    # INFO -= T (INFO / 150 s)**2, and for each axis, with T = 1:
    # at rest    INFO += 100, U = 100 (b - gyro)
    # in motion  INFO += OM (y_n**2 + y_w**2) + 0.1 j z**2, U = OM (y_n C0 + y_w C1) + 0.1 j z C2
    still = s[_STILL] == s[_REST_AFTER]
    j = s[_J]
    om = s[_OM]
    n = 0
    while n < 3:
        x = s[_INFO + n]
        if x > s[_INFO_LEAST]:
            m = (x >> 10) * s[_INFO_DECAY] >> 14
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
        s[_INFO + n] = x
        s[_U + n] = u
        n += 1
    # b -= U / INFO, within +-bias_limit; O = O_BASE - b dt / 2, what the steps add
    b_shift = s[_B_SHIFT]
    gain = s[_G]
    rest = s[_GR]
    n = 0
    while n < 3:
        m = s[_INFO + n]
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
