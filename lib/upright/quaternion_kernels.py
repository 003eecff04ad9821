# Integer kernels of the quaternion Kalman filter (quaternion_kalman.py): the covariance, its propagation and scalar
# measurements; rest and magnetic field. Needs the viper emitter. In earth_kernels.py is what is not this filter's
# alone, and what a state and a block are. All of it is made for a hard interrupt: it allocates nothing, raises nothing,
# uses no float, and gives the same bits on every port.
#
# The error state x, true less estimated:
#     0 1 2  attitude, rotation vector in the earth frame     2**-15 rad
#     3 4 5  gyro bias in the body, times the block           2**-C rad; C such that bias_start is below 26000
#     6 7    horizontal velocity / (g * block)                2**-10
# In these units the covariance P fits 30 bits, every element of it (|P_ij| <= root of P_ii P_jj), and its propagation
# over a block needs no multiplication but those with the rotation matrix. Estimates of x are held 10 bits finer.

from array import array

import micropython
from micropython import const

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_G = const(15)  # Q31: half angle per step of one gyro count
_O = const(17)  # 3, Q31: minus the bias as a half angle per step
_OR = const(20)  # 3, Q46: its last bits, -32767..32767
_TURN = const(23)  # 3, Q31: correction that the next step takes up, earth frame, half angle
_R = const(26)  # 9, Q15: rotation matrix; its rows are north, west, up in the body
_FS = const(35)  # 3, Q9: specific force in the earth frame, counts, summed over the block
_BASE = const(49)  # 3, Q8: gyro bias that was set, counts
_O_BASE = const(52)  # 3, Q31: O of BASE alone
_OR_BASE = const(55)  # 3, Q46: its last bits
_B = const(58)  # 3: learnt bias on top of BASE, in the filter's own unit
_BLOCK = const(62)  # log2 of the steps of a block
_DECIDED = const(65)  # yes/no decisions, for the tests' float twin
_GS = const(66)  # 3: gyro counts summed over the block
_MS = const(69)  # 3, Q9: magnetometer in the earth frame, counts, summed over the block
_MN = const(72)  # samples in it
_SINCE = const(73)  # blocks since the last with a magnetometer sample, no more than 16
_J = const(74)  # blocks that the heading of this block stands for; 0: none
_HEADING = const(75)  # Q28: heading error, rad
_NOW = const(76)  # 2, Q13: horizontal and vertical field, counts
_IN = const(78)  # 6, Q12: what LOW1 takes up: accelerometer, gyro less BASE, counts
_LOW2 = const(90)  # 6, Q12: second
_AWAY = const(96)  # 2, Q6: squared distance from LOW2 of accelerometer and gyro, counts**2
_STILL = const(99)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(100)  # blocks
_REST_GYRO = const(102)  # Q6: at rest AWAY is less: counts**2
_REST_ACCEL = const(103)  # Q6: the same of the accelerometer
_REST_MOST = const(104)  # Q12: most that is taken for a bias, counts
_AS = const(105)  # 3: accelerometer counts, summed
_T = const(110)  # 9, Q15: R at the end of the block
_H = const(119)  # 3, Q20: the block's mean specific force in the earth frame, g
_GM = const(122)  # 3: GS of the block
_ML = const(125)  # 3, Q9: MS of the block
_MLN = const(128)  # MN of the block
_X = const(129)  # 8: estimated errors, not applied yet; 10 bits finer than P's units
_V = const(137)  # 2, Q20: horizontal velocity, g * block
_P = const(139)  # 36: upper triangle of the covariance, row by row
_N = const(175)  # 9: attitude-bias part of P, mean of before and after the block
_ROW = const(184)  # 8: row of P of what is measured
_M = const(192)  # 8: gain of error i = M / 2**(E + 15), M of 28 to 31 bits
_E = const(200)  # 8
_FOLDED = const(208)  # 3, Q25: correction that the new block starts with, rad
_UH = const(211)  # which error is measured ...
_UE = const(212)  # ... its measured value, in X's units ...
_UR = const(213)  # ... its variance / 16, in P's units ...
_UM = const(214)  # ... bits of the errors that it must not correct
_OVER = const(215)  # 1: it was beyond 2.5 sigma
_MEANT = const(216)  # 2: tilt from the accelerometer as measured, X's units
_HG = const(218)  # HS to H: HG / 2**HG_SHIFT
_HG_SHIFT = const(219)
_C = const(220)  # C - 15; the bias is in units of 2**-C rad a block, B 10 bits finer
_B_SHIFT = const(221)  # B to half angle per step, Q31
_B_MOST = const(222)  # bound of B
_QT = const(223)  # variance that a block adds to the attitude, 2**-16 of P's unit ...
_QTR = const(224)  # ... and what is carried of it
_QB = const(225)  # the same for the bias, 2**-12
_QBR = const(226)
_QS = const(227)  # variance per (4 counts)**2 of the gyro: QS / 2**QS_SHIFT
_QS_SHIFT = const(228)
_BS = const(229)  # first variance of the bias
_RM = const(231)  # ... heading from one block ...
_Z = const(236)  # 3: low-passed gyro in B's units
_REST_OFF = const(239)  # most that a known bias may be off, B's units
_KNOWN = const(240)  # variance of a known bias
_CB = const(241)  # counts (Q12) to B's units: CB / 2**CB_SHIFT
_CB_SHIFT = const(242)
_WIDE_FOR = const(243)  # blocks with the accelerometer used as measured; then 2, 1, 0
_WIDE_MOST = const(244)
_LOST = const(245)  # blocks with the velocity beyond 2.5 sigma
_LOST_MOST = const(246)
_FIELD = const(247)  # 2, Q13: smoothed field, counts; NOW, FIELD and REF as (horizontal, vertical)
_REF = const(249)  # 2, Q13: reference
_HAVE = const(251)  # 1: there is one
_NEAR = const(252)  # blocks near the reference, no more than FIELD_AFTER
_AGE = const(253)  # blocks with a field, no more than 16384
_FAR = const(254)  # blocks of large heading error
_FIELD_AFTER = const(255)  # blocks
_TOL = const(256)  # Q14: tolerance squared
_SMOOTH = const(257)  # Q10: blocks of 0.05 s
_TAU = const(258)  # Q10: blocks of the reference's time constant
_TAU_FAR = const(259)  # Q10: the same while the field is another
_TAU_0 = const(260)  # Q10: blocks of 0.2 s
_FAR_MOST = const(261)  # blocks
_GOOD = const(262)  # 1: the field is that of the reference; 2: there is no reference yet
_FIRST = const(263)  # blocks after which there is one
_NOISE = const(264)  # variance / 16 of the heading
_WAIT = const(267)  # blocks of a rest that a known bias contradicts
_CLIP = const(268)  # steps of the block with the gyro at full scale, no more than 100
_TIPPED = const(270)  # blocks of a rest in which the force is 1 g, but not along the vertical
# -- end of the words

_STILL_BIT = const(1)
_NEAR_BIT = const(2)
_FAR_BIT = const(4)
_WIDE = const(8)
_RUNAWAY = const(16)
_UNDER = const(32)
_LEAN = const(64)
_UPSET = const(128)
_DOUBTED = const(256)
_ADOPT = const(512)
_TILTED = const(1024)

_CAP = const(687194767)  # 0.64 of the largest variance, Q30
OPEN = const(603979776)  # variance of an attitude of which nothing is known: (0.75 rad)**2
_WIDE_SUM = const(147102629)  # 2 (15 deg)**2, Q30
_WIDE_ONE = const(73551315)
_LEAN_ONE = const(131533373)  # (20 deg)**2, Q30
_FOLD_MOST = const(11744051)  # 0.35 rad, Q25
_V_MOST = const(1072693248)  # 1023, Q20
_FAR_RAD = const(18454938)  # 0.55, Q25
_TURNED = const(14055000)  # 3 deg, Q28
_PI25 = const(105414357)
_LEAST = const(16)  # no variance falls below

# where P_ij stands in the triangle: _AT[8 i + j]
_AT = array(
    "B",
    [
        8 * min(i, j) - min(i, j) * (min(i, j) + 1) // 2 + max(i, j)
        for i in range(8)
        for j in range(8)
    ],
)


# ------------------------------------------------------------------------------------------ end of a block
@micropython.viper
def take_sums(s: ptr32):
    """Take over the block's sums and the attitude at its end, and begin new ones."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    i = 0
    while i < 9:
        s[_T + i] = s[_R + i]
        i += 1
    gain = s[_HG]
    shift = s[_HG_SHIFT]
    fine = 12 - s[_BLOCK]
    i = 0
    while i < 3:
        # H = HS / (steps * 1 g)
        x = s[_FS + i] << k >> k
        m = x >> 15
        x -= m << 15
        if shift < 15:
            x = (m * gain << 15 - shift) + (x * gain >> shift)
        else:
            x = m * gain + (x * gain >> 15) + (1 << shift - 15 >> 1) >> shift - 15
        s[_H + i] = x
        s[_FS + i] = 0
        s[_IN + i] = (s[_AS + i] << k >> k) << fine
        s[_AS + i] = 0
        x = s[_GS + i] << k >> k
        s[_GM + i] = x
        s[_IN + 3 + i] = (x << fine) - ((s[_BASE + i] << k >> k) << 4)
        s[_GS + i] = 0
        s[_ML + i] = s[_MS + i]
        s[_MS + i] = 0
        i += 1
    s[_MLN] = s[_MN]
    s[_MN] = 0


@micropython.viper
def carry_errors(s: ptr32):
    """Carry the errors found in the last block through this one, as the errors themselves went, and apply them.

    attitude -= R bias; velocity += attitude x up. Then bias and velocity take theirs at once, the attitude with the
    next step: FOLDED, F; what is more than 0.35 rad stays for the blocks to come.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # x_a -= R x_b
    x = s[_X + 3] << k >> k
    y = s[_X + 4] << k >> k
    z = s[_X + 5] << k >> k
    a = x >> 14
    b = y >> 14
    c = z >> 14
    x -= a << 14
    y -= b << 14
    z -= c << 14
    shift = s[_C] + 1
    half = 1 << shift >> 1
    i = 0
    while i < 3:
        m = s[_T + 3 * i] << k >> k
        n = s[_T + 3 * i + 1] << k >> k
        o = s[_T + 3 * i + 2] << k >> k
        m = a * m + b * n + c * o + (x * m + y * n + z * o >> 14)
        s[_X + i] = (s[_X + i] << k >> k) - (m + half >> shift)
        i += 1
    shift = s[_B_SHIFT]
    # v0 += x_a1 + H0 + x_v0; v1 += H1 + x_v1 - x_a0
    m = ((s[_X + 1] << k >> k) + 16 >> 5) + (s[_H] << k >> k) + (s[_X + 6] << k >> k)
    n = (s[_H + 1] << k >> k) + (s[_X + 7] << k >> k) - ((s[_X] << k >> k) + 16 >> 5)
    i = 0
    while i < 3:
        # FOLDED = TURN = x_a, no more than 0.35 rad; b += x_b
        x = s[_X + i] << k >> k
        y = x
        if y > _FOLD_MOST:
            y = _FOLD_MOST
        elif y < 0 - _FOLD_MOST:
            y = 0 - _FOLD_MOST
        s[_X + i] = x - y
        s[_FOLDED + i] = y
        s[_TURN + i] = y << 5
        x = (s[_B + i] << k >> k) + (s[_X + 3 + i] << k >> k)
        s[_X + 3 + i] = 0
        if x > s[_B_MOST]:
            x = s[_B_MOST]
        elif x < 0 - s[_B_MOST]:
            x = 0 - s[_B_MOST]
        s[_B + i] = x
        y = x >> shift
        s[_O + i] = (s[_O_BASE + i] << k >> k) - y
        s[_OR + i] = (s[_OR_BASE + i] << k >> k) - (x - (y << shift) << 15 - shift)
        i += 1
    i = 0
    while i < 2:
        x = (s[_V + i] << k >> k) + m
        m = n
        if x > _V_MOST:
            x = _V_MOST
        elif x < 0 - _V_MOST:
            x = 0 - _V_MOST
        s[_V + i] = x
        s[_X + 6 + i] = 0
        i += 1


# ------------------------------------------------------------------------------------------ covariance of a block
@micropython.viper
def spread_bias(s: ptr32):
    """Attitude -= R bias, in the columns of bias and velocity: P_ab -= R P_bb, P_av -= R P_bv; N is made."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    at = ptr8(_AT)
    shift = s[_C]
    half = 1 << shift >> 1
    j = 3
    while j < 8:
        # P_aj -= R P_bj; N the same, half of it
        x = s[_P + at[24 + j]] << k >> k
        y = s[_P + at[32 + j]] << k >> k
        z = s[_P + at[40 + j]] << k >> k
        a = x + 16384 >> 15
        b = y + 16384 >> 15
        c = z + 16384 >> 15
        x -= a << 15
        y -= b << 15
        z -= c << 15
        i = 0
        while i < 3:
            m = s[_T + 3 * i] << k >> k
            n = s[_T + 3 * i + 1] << k >> k
            o = s[_T + 3 * i + 2] << k >> k
            m = a * m + b * n + c * o + (x * m + y * n + z * o + 16384 >> 15)
            o = _P + at[8 * i + j]
            n = s[o] << k >> k
            if j < 6:
                s[_N + 3 * i + j - 3] = n - (m + (half << 1) >> shift + 1)
            s[o] = n - (m + half >> shift)
            i += 1
        j += 1


@micropython.viper
def spread_attitude(s: ptr32):
    """The same in the attitude's own part: P_aa -= N R' + R N', where N is P_ab halfway through the block."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    at = ptr8(_AT)
    shift = s[_C] - 1
    half = 1 << shift >> 1
    i = 0
    while i < 3:
        j = i
        while j < 3:
            # P_ij -= row i of N times row j of R, and the other way round
            total = half
            u = 3 * i
            v = 3 * j
            n = 0
            while n < 2:
                x = s[_N + u] << k >> k
                y = s[_N + u + 1] << k >> k
                z = s[_N + u + 2] << k >> k
                a = x + 16384 >> 15
                b = y + 16384 >> 15
                c = z + 16384 >> 15
                x -= a << 15
                y -= b << 15
                z -= c << 15
                o = s[_T + v] << k >> k
                a = a * o
                x = x * o
                o = s[_T + v + 1] << k >> k
                a += b * o
                x += y * o
                o = s[_T + v + 2] << k >> k
                a += c * o + (x + z * o + 16384 >> 15)
                total += a >> 1
                u = v
                v = 3 * i
                n += 1
            o = _P + at[8 * i + j]
            s[o] = (s[o] << k >> k) - (total >> shift)
            j += 1
        i += 1


@micropython.viper
def spread_velocity(s: ptr32):
    """Velocity += attitude x up: v0 += a1, v1 -= a0."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    at = ptr8(_AT)
    # P_vv += P_av + P_va + P_aa, by columns: P_v0j += P_a1j, P_v1j -= P_a0j
    a = s[_P]
    b = s[_P + 1] << k >> k
    c = s[_P + 8]
    s[_P + 33] += ((s[_P + 13] << k >> k) << 1) + (c + 16 >> 5) + 16 >> 5
    s[_P + 35] += (a + 16 >> 5) - ((s[_P + 7] << k >> k) << 1) + 16 >> 5
    m = (s[_P + 14] << k >> k) - (s[_P + 6] << k >> k) - (b + 16 >> 5)
    s[_P + 34] = (s[_P + 34] << k >> k) + (m + 16 >> 5)
    i = 0
    while i < 6:
        a = s[_P + at[8 + i]] << k >> k
        b = s[_P + at[i]] << k >> k
        c = _P + at[8 * i + 6]
        s[c] = (s[c] << k >> k) + (a + 16 >> 5)
        c += 1
        s[c] = (s[c] << k >> k) - (b + 16 >> 5)
        i += 1


@micropython.viper
def add_noise(s: ptr32):
    """What a block adds to the variances: gyro noise, the gyro's scale errors, wandering of the bias.

    Where a variance would outgrow its 30 bits, all of its row is halved (a quarter of the variance): a congruence, so
    P stays a covariance.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    at = ptr8(_AT)
    fine = s[_BLOCK]
    # P_aa += gyro_noise**2 T + (scale_error |gyro|)**2 T, a quarter of the last sigma about the vertical
    m = 0
    i = 0
    while i < 3:
        x = ((s[_GM + i] << k >> k) << 2 >> fine) - ((s[_BASE + i] << k >> k) >> 6) >> 4
        m += x * x
        i += 1
    x = m >> 15
    m = x * s[_QS] + ((m - (x << 15)) * s[_QS] >> 15) >> s[_QS_SHIFT] - 15
    x = s[_QTR] + s[_QT]
    s[_QTR] = x & 65535
    x >>= 16
    s[_P] += x + m
    s[_P + 8] += x + m
    s[_P + 15] += x + (m >> 4)
    # full scale: every such step may have turned by half as much again, up to all that can be unknown
    n = s[_CLIP]
    if n:
        s[_CLIP] = 0
        n = n * s[_G] >> 8
        if n > 192:
            n = 192
        n = n * n << 14
        if s[_WIDE_FOR] > 1:
            s[_WIDE_FOR] = 1  # as after a start
        i = 0
        while i < 3:
            o = _P + at[9 * i]
            if s[o] < OPEN:
                x = s[o] + n
                if x > OPEN:
                    x = OPEN
                s[o] = x
            i += 1
    # P_bb += bias_walk**2 T, up to the first variance
    x = s[_QBR] + s[_QB]
    s[_QBR] = x & 4095
    x >>= 12
    i = 3
    while i < 6:
        m = _P + at[9 * i]
        if s[m] < s[_BS]:
            s[m] += x
        i += 1
    i = 0
    while i < 8:
        m = _P + at[9 * i]
        if s[m] > _CAP:
            j = 0
            while j < 8:
                n = _P + at[8 * i + j]
                s[n] = (s[n] << k >> k) + 1 >> 1
                j += 1
            s[m] >>= 1
        i += 1


@micropython.viper
def forget(s: ptr32, i: int, variance: int):
    """Nothing is known of error i any more, but its size."""
    at = ptr8(_AT)
    j = 0
    while j < 8:
        s[_P + at[8 * i + j]] = 0
        j += 1
    s[_P + at[9 * i]] = variance
    s[_X + i] = 0


# ------------------------------------------------------------------------------------------ a measurement
@micropython.viper
def measure(s: ptr32):
    """Error h = UH is UE, with variance r = 16 UR, and corrects all errors but those of UM.

    The innovation is bounded by 5 sigma.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    at = ptr8(_AT)
    h = s[_UH]
    mask = s[_UM]
    # n = P_hh + r, S in the textbooks
    n = s[_P + at[9 * h]] + 8 >> 4
    n += s[_UR]
    f = 0
    while n < 0xC000000:
        n <<= 2
        f += 2
    # root: a line, then Heron twice; 5 sigma in X's units is 5 * 2**10 * 4 times the root
    r = ((n >> 15) * 21845 >> 15) + 11403
    r = (r + n // r) >> 1
    r = (r + n // r) >> 1
    r = 20480 * r >> (f >> 1)
    # e = z - x_h, within 5 sigma; over: beyond 2.5
    e = (s[_UE] << k >> k) - (s[_X + h] << k >> k)
    c = r >> 1
    s[_OVER] = 0
    if e > c or e < 0 - c:
        s[_OVER] = 1
    if e > r:
        e = r
    elif e < 0 - r:
        e = 0 - r
    c = e >> 15
    e &= 32767
    # 1 / n = (r + d / 2**15) / 2**43: a quotient of 14 bits, and Newton's step for the rest
    # K_i = P_ih / n, as M and E; x_i += K_i e
    r = 0x1FFFFFFF // (n + 8192 >> 14)
    h = n >> 15
    d = 0x10000000 - r * h - (r * (n - (h << 15)) >> 15)
    d = d * (r >> 1) >> 12
    r += d >> 15
    d &= 32767
    i = 0
    while i < 8:
        x = s[_P + at[8 * s[_UH] + i]] << k >> k
        s[_ROW + i] = x
        a = x
        if a < 0:
            a = 0 - a
        m = 0
        n = 44
        if a:
            n = 17 - f
            while a < 0x20000000:
                a <<= 1
                n += 1
            if n < 45:
                h = a >> 15
                m = h * r + (h * d >> 15) + ((a - (h << 15)) * r >> 15)
                if x < 0:
                    m = 0 - m
            else:
                n = 44  # too little to move anything
        s[_M + i] = m
        s[_E + i] = n
        if (mask >> i) & 1 == 0:
            h = m >> 15
            m -= h << 15
            m = c * m + e * h
            if n < 15:
                m = (c * h << 15 - n) + (m >> n)
            else:
                n -= 15
                m = c * h + (m >> 15) + (1 << n >> 1) >> n
            s[_X + i] = (s[_X + i] << k >> k) + m
        i += 1
    # P_ij -= K_i P_jh, but for pairs of which neither must be corrected (Schmidt's form)
    p = _P
    i = 0
    while i < 8:
        m = s[_M + i] << k >> k
        o = m >> 15
        n = s[_E + i]
        if m == 0:
            p += 8 - i
        else:
            m -= o << 15
            fixed = (mask >> i) & 1
            down = n - 15
            half = 0
            if down > 0:
                half = 1 << down >> 1
            j = i
            while j < 8:
                if ((mask >> j) & fixed) == 0:
                    x = s[_ROW + j] << k >> k
                    h = x + 16384 >> 15
                    x = h * m + (x - (h << 15)) * o
                    if down < 0:
                        x = (h * o << 0 - down) + (x >> n)
                    else:
                        x = h * o + (x >> 15) + half >> down
                    s[p] = (s[p] << k >> k) - x
                p += 1
                j += 1
            j = p + i - 8
            if (s[j] << k >> k) < _LEAST:
                s[j] = _LEAST
        i += 1


# ------------------------------------------------------------------------------------------ what is measured
@micropython.viper
def measure_rest(s: ptr32) -> int:
    """Whether gyro and accelerometer stay near their low-passes, 1 or 0.

    Z: the low-passed gyro, which measures the bias then. Where it contradicts a well-known bias, either may be wrong.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    at = ptr8(_AT)
    # still: |IN - LOW2| small, |gyro| <= REST_MOST, and no contradiction: |Z - B| > REST_OFF where B's variance is
    # below KNOWN
    wait = 0
    still = s[_AWAY] < s[_REST_ACCEL] and s[_AWAY + 1] < s[_REST_GYRO]
    i = 0
    while i < 3:
        v = s[_LOW2 + 3 + i] << k >> k
        f = s[_REST_MOST]
        if v > f:
            v = f
            still = False
        elif v < 0 - f:
            v = 0 - f
            still = False
        h = v >> 13
        v -= h << 13
        f = s[_CB_SHIFT]
        h = h * s[_CB]
        v = v * s[_CB]
        if f < 13:
            v = (h << 13 - f) + (v >> f)
        else:
            v = h + (v >> 13) >> f - 13
        s[_Z + i] = v
        h = s[_B + i] << k >> k
        f = v - h
        if f < 0:
            f = 0 - f
        if f > s[_REST_OFF] and s[_P + at[27 + 9 * i]] < s[_KNOWN]:
            wait |= 1
            # nearer to a gyro without bias: it was a turn that was taken for one
            h = s[_O + i] << k >> k
            v = (s[_Z + i] << k >> k >> s[_B_SHIFT]) - (s[_O_BASE + i] << k >> k)
            if h < 0:
                h = 0 - h
            if v < 0:
                v = 0 - v
            if v >= h:
                wait |= 2
                if f > s[_REST_OFF] << 3:
                    still = False
        i += 1
    if still and wait:
        # a bias has to be contradicted for 8 rests, if it is not nearer to 0 then; where the field is good, the heading
        # has to be off as well: else the body turns
        h = s[_WAIT] + 1
        if h >= s[_REST_AFTER] * 7:
            h = s[_REST_AFTER] * 7
            wait &= 1
        v = s[_HEADING] << k >> k
        if s[_GOOD] == 1 and s[_SINCE] < 16 and v < _TURNED and v > 0 - _TURNED:
            wait |= 2
        s[_WAIT] = h
        if wait & 2:
            still = False
    else:
        s[_WAIT] = 0
    i = 0
    if still:
        i = 1
    return i


@micropython.viper
def count_rest(s: ptr32, still: int):
    """STILL: for how many blocks it has been still; this one is (1) or not (0).

    At rest a tilt error that cannot be is UPSET: the force is 1 g, and not along the vertical.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    decided = (s[_DECIDED] | (_STILL_BIT | _UPSET)) ^ _UPSET
    i = 0
    if still:
        i = s[_STILL] + 1
        if i > s[_REST_AFTER]:
            i = s[_REST_AFTER]
    else:
        decided ^= _STILL_BIT
    s[_STILL] = i
    # upset: at rest for 8 blocks |(H0, H1)| > 1/4 g, and |H|**2 within 5 % of 1 g, which that of a push is not
    f = 0
    if i == s[_REST_AFTER]:
        x = (s[_H] << k >> k) >> 10
        v = (s[_H + 1] << k >> k) >> 10
        h = (s[_H + 2] << k >> k) >> 10
        if x < 2048 and x > -2048 and v < 2048 and v > -2048 and h < 2048 and h > -2048:
            x = x * x + v * v
            h = x + h * h
            if x > 65536 and h > 996147 and h < 1101004:
                f = s[_TIPPED] + 1
                if f == 8:
                    f = 0
                    decided |= _UPSET
    s[_TIPPED] = f
    s[_DECIDED] = decided


@micropython.viper
def contradicted(s: ptr32, i: int) -> int:
    """UE: what the rest says of bias i. ADOPT: it is another one; TILTED: so far off that the tilt is wrong too."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    x = (s[_Z + i] << k >> k) - (s[_B + i] << k >> k)
    s[_UE] = x
    if x < 0:
        x = 0 - x
    decided = (s[_DECIDED] | (_ADOPT | _TILTED)) ^ (_ADOPT | _TILTED)
    if x > s[_REST_OFF]:
        decided |= _ADOPT
        if x > s[_REST_OFF] << 2:
            decided |= _TILTED
    s[_DECIDED] = decided
    return decided


@micropython.viper
def tilt_from_accel(s: ptr32):
    """WIDE: whether the accelerometer is believed as it is; MEANT: what it then says of the tilt."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    decided = (s[_DECIDED] | (_WIDE | _UNDER | _LEAN)) ^ (_WIDE | _UNDER | _LEAN)
    if s[_P] + s[_P + 8] > _WIDE_SUM:
        decided |= _WIDE
        # meant = (H1, -H0), no part of it more than 2 g; upside down at least 1.5 rad
        most = 0
        total = 0
        i = 0
        while i < 2:
            x = s[_H + 1 - i] << k >> k
            if i:
                x = 0 - x
            if x > 0x200000:
                x = 0x200000
            elif x < -0x200000:
                x = -0x200000
            s[_M + i] = x
            if x < 0:
                x = 0 - x
            if x > most:
                most = x
            total += (x >> 8) * (x >> 8)
            i += 1
        if total > 167772:  # (0.1 g)**2
            decided |= _LEAN
        if (s[_H + 2] << k >> k) < 0:
            decided |= _UNDER
            most += 1024
            if most < 0x180000:
                # at least 1.5 rad, in the direction that there is
                i = 0
                while i < 2:
                    x = (s[_M + i] << k >> k) << 9
                    y = x // most
                    x = (y << 9) + (x - y * most << 9) // most
                    s[_M + i] = x * 6
                    i += 1
        s[_MEANT] = ((s[_M] << k >> k) << 5) - (s[_FOLDED] << k >> k)
        s[_MEANT + 1] = ((s[_M + 1] << k >> k) << 5) - (s[_FOLDED + 1] << k >> k)
    s[_DECIDED] = decided


@micropython.viper
def after_tilt(s: ptr32) -> int:
    """After both measurements of the tilt -> what to open up: bit 0 attitude, bit 1 velocity."""
    decided = s[_DECIDED]
    if decided & _WIDE:
        i = s[_WIDE_FOR] + 1
        if i > s[_WIDE_MOST]:
            i = s[_WIDE_MOST]
        s[_WIDE_FOR] = i
        if decided & _UNDER or (decided & _LEAN and i < s[_WIDE_MOST]):
            if s[_P] < _LEAN_ONE:
                s[_P] = _LEAN_ONE
            if s[_P + 8] < _LEAN_ONE:
                s[_P + 8] = _LEAN_ONE
        s[_V] = 0
        s[_V + 1] = 0
        s[_LOST] = 0
        return 2
    # for three blocks the last corrections come through
    i = s[_WIDE_FOR]
    if i > 3:
        i = 3
    if i:
        # the last correction has to come through before the heading means something
        s[_WIDE_FOR] = i - 1
    i = 0
    # lost: beyond 2.5 sigma for a second
    if decided & _RUNAWAY:
        i = s[_LOST] + 1
    s[_LOST] = i
    if i > s[_LOST_MOST]:
        s[_LOST] = 0
        return 1
    return 0


@micropython.viper
def weigh_field(s: ptr32):
    """GOOD: whether the field is that of its reference, which follows; NOISE: the less it is, the larger."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    # FIELD += k (NOW - FIELD), k = j T / (0.05 s + j T)
    rate = (j << 24) // ((j << 10) + s[_SMOOTH])  # Q14
    i = 0
    while i < 2:
        x = s[_NOW + i] << k >> k
        if s[_HAVE] == 0:
            s[_FIELD + i] = x
            s[_REF + i] = x
        y = s[_FIELD + i] << k >> k
        x -= y
        n = x >> 14
        s[_FIELD + i] = y + n * rate + ((x - (n << 14)) * rate >> 14)
        i += 1
    s[_HAVE] = 1
    decided = s[_DECIDED] | _NEAR_BIT
    # squared distances from the reference, as a part of it, Q14: of the smoothed field, of this one
    off = 0
    i = _FIELD
    while i:
        x = s[_REF] << k >> k
        y = s[_REF + 1] << k >> k
        n = (s[i] << k >> k) - x
        m = (s[i + 1] << k >> k) - y
        if y < 0:
            y = 0 - y
        if n < 0:
            n = 0 - n
        if m < 0:
            m = 0 - m
        while (x | y | n | m) > 16383:
            x >>= 1
            y >>= 1
            n >>= 1
            m >>= 1
        off = (n * n + m * m) // ((x * x + y * y >> 14) + 1)
        if i == _FIELD:
            i = _NOW
            if off >= s[_TOL]:
                decided ^= _NEAR_BIT
        else:
            i = 0
    s[_DECIDED] = decided
    # NOISE = mag_noise**2 / (j T) (1 + min(8, (off / 0.1)**2))
    n = s[_RM] // j
    if off > 1310:
        off = 1310
    n += (n >> 10) * (off * 100 >> 4)
    if n > 0x20000000:
        n = 0x20000000
    s[_NOISE] = n
    # good: near the reference for 0.3 s
    near = 0
    tau = s[_TAU_FAR]
    s[_GOOD] = 0
    if decided & _NEAR_BIT:
        near = s[_NEAR] + j
        if near >= s[_FIELD_AFTER]:
            near = s[_FIELD_AFTER]
            tau = s[_TAU]
            s[_GOOD] = 1
    s[_NEAR] = near
    n = s[_AGE] + j
    if n > 16384:
        n = 16384
    s[_AGE] = n
    if n <= s[_FIRST] and s[_GOOD] == 0:
        s[_GOOD] = 2
    # REF += k (FIELD - REF), k = j T / (tau + j T); tau: 20 s, or 100 s, no more than AGE + 0.2 s
    n = (n << 10) + s[_TAU_0]
    if tau > n:
        tau = n
    rate = (j << 26) // ((j << 10) + tau >> 4)  # Q20
    i = 0
    while i < 2:
        y = s[_REF + i] << k >> k
        x = (s[_FIELD + i] << k >> k) - y
        n = x >> 15
        x -= n << 15
        if rate > 65535:
            m = rate >> 5
            y += n * m + (x * m >> 15)
        else:
            y += n * rate + (x * rate >> 15) + 16 >> 5
        s[_REF + i] = y
        i += 1


@micropython.viper
def ready_for_heading(s: ptr32) -> int:
    """Make ready to measure the heading -> 0: not now, 1: do; 3: and open it up before."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    if j == 0 or s[_GOOD] == 0 or s[_WIDE_FOR]:
        return 0
    decided = (s[_DECIDED] | (_DOUBTED | _FAR_BIT)) ^ (_DOUBTED | _FAR_BIT)
    n = s[_NOISE]
    if s[_P + 15] > _WIDE_ONE:
        decided |= _DOUBTED
        if n > 4026532:  # 0.06 rad**2
            n = 4026532
    s[_UR] = n
    e = (s[_HEADING] << k >> k) + 4 >> 3
    if e > _FAR_RAD or e < 0 - _FAR_RAD:
        decided |= _FAR_BIT
    s[_DECIDED] = decided
    # far in a good field for 5 s: the heading is opened up
    n = s[_FAR]
    found = 1
    if decided & _FAR_BIT and s[_GOOD] == 1:
        n += j
        if n > s[_FAR_MOST]:
            n = 0
            found = 3
            s[_X + 2] = 0
    else:
        n -= j
        if n < 0:
            n = 0
    s[_FAR] = n
    x = s[_X + 2] << k >> k
    # z = e - FOLDED2, the short way round from x
    e -= (s[_FOLDED + 2] << k >> k) + x
    if e > _PI25:
        e -= _PI25 << 1
    elif e < 0 - _PI25:
        e += _PI25 << 1
    s[_UE] = e + x
    return found
