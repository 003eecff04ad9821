# Integer kernels of the inertial filter (inertial.py): levelling, rest, covariance of heading and bias, magnetic field.
# Needs the viper emitter. In earth_kernels.py is what is not this filter's alone, and what a state and a block are. All
# of it is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on
# every port. K, T, y ...: the names of the equations in docs/methods.md; the float twin is host_tests/reference.

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
_FS = const(35)  # 3, Q9: specific force in the earth frame, counts, summed over the block
_BASE = const(38)  # 3, Q8: gyro bias that was set, counts
_O_BASE = const(41)  # 3, Q31: O of BASE alone
_OR_BASE = const(44)  # 3, Q46: its last bits
_B = const(47)  # 3: learnt bias on top of BASE, in the filter's own unit
_NINE = const(50)  # 1: use the magnetometer
_BLOCK = const(51)  # log2 of the steps of a block
_PHASE = const(53)  # fresh steps of the block
_DECIDED = const(54)  # yes/no decisions, for the tests' float twin
_GS = const(55)  # 3: gyro counts summed over the block
_MS = const(58)  # 3, Q9: magnetometer in the earth frame, counts, summed over the block
_MN = const(61)  # samples in it
_SINCE = const(62)  # blocks since the last with a magnetometer sample, no more than 16
_J = const(63)  # blocks that the heading of this block stands for; 0: none
_HEADING = const(64)  # Q28: heading error, rad
_NOW = const(65)  # 2, Q13: horizontal and vertical field, counts
_IN = const(67)  # 6, Q12: what LOW1 takes up: accelerometer, gyro less BASE, counts
_LOW2 = const(79)  # 6, Q12: second
_AWAY = const(85)  # 2, Q6: squared distance from LOW2 of accelerometer and gyro, counts**2
_STILL = const(88)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(89)  # blocks
_REST_GYRO = const(91)  # Q6: at rest AWAY is less: counts**2
_REST_ACCEL = const(92)  # Q6: the same of the accelerometer
_REST_MOST = const(93)  # Q12: most that is taken for a bias, counts
_LEVEL = const(95)  # log2 of the steps of a levelling: 0 at the start, BLOCK in the end
_LEVEL_MASK = const(96)  # steps of it less 1
_REGRESS = const(97)  # 1: the regressors take their step next
_PART = const(98)  # part of the work of two blocks that comes next
_GG = const(100)  # 3: gyro counts summed over two blocks
_CLIPPED = const(105)  # samples with one since P grew last
_CLIP = const(106)  # Q15: what one adds to the doubt of the heading, units of 2.5 rad
_SEEN = const(108)  # 3, Q12: the gyro of one sample, less BASE
_H = const(111)  # 3, Q14: specific force of the block in the earth frame, counts
_RATE = const(114)  # squared turn rate of the block, (4 counts)**2
_HELD = const(115)  # the same: follows up at once and down slowly
_HELD_K = const(116)  # Q15: gain down
_S = const(117)  # 3, Q14: low-passed specific force in the earth frame, counts
_OFF = const(120)  # 2, Q14: the block's force less the low-pass, horizontal, counts
_SF = const(122)  # 2, Q14: the force low-passed quickly, horizontal, counts
_SF_K = const(124)  # Q15: gain of it
_LEAN_G = const(125)  # |SF| beyond which the tilt is lost: (4 counts)**2
_LEAN = const(126)  # blocks with more
_LEAN_AFTER = const(127)  # blocks
_K = const(128)  # tilt gain of this levelling = K / 2**K_SHIFT, K < 2**15
_K_SHIFT = const(129)
_KC = const(130)  # the same for S (normalised) to half angle
_KC_SHIFT = const(131)
_AGAIN = const(132)  # 1: the ramp starts anew
_N = const(133)  # steps since the start of the ramp, no more than N_END
_N_LATE = const(134)  # steps until the bias is estimated in motion
_N_FULL = const(135)  # steps until it is at full weight
_N_END = const(136)  # steps after which the start is over
_RAMP = const(137)  # Q8: ramp of the tilt
_K_PACE = const(138)  # Q20: tilt gain of a block after the start
_K_START = const(139)  # Q20: tilt gain of a block while little is known of the bias ...
_K_LEAST = const(140)  # Q20: ... and its bounds afterwards
_K_MOST = const(141)  # Q20
_K_TURN = const(142)  # tilt gain for the fourth root of HELD: K_TURN / 2**22
_NORM = const(143)  # shift that brings 1 g to 2**14..2**15 counts
_G1 = const(144)  # 1 g in counts
_LI = const(145)  # Q29: 1 / (1 g, normalised)
_OM_GAIN = const(146)  # Q24: 1 / (accel_doubt, normalised)
_X = const(147)  # 6, Q24: regressors north and west: inner low-pass
_Y = const(153)  # 6, Q24: outer low-pass
_D = const(159)  # Q15: square of the horizontal deviation / accel_doubt**2
_OM = const(160)  # Q15: tilt confidence 1 / (1 + D)
_REST_OFF = const(161)  # Q12: most that a known bias may be off, counts
_UPSET = const(162)  # tilt at rest that restarts the ramp: (counts / 4)**2
_JUMP = const(163)  # Q12: a bias found at rest that restarts the ramp, counts
_SOON = const(164)  # steps after a restart in which no other follows
_WAIT = const(165)  # blocks for which a rest has contradicted the bias
_WAIT_MOST = const(166)  # blocks
_WAIT_SURE = const(167)  # blocks after which a slow turn is decided, too
_WAIT_E = const(168)  # Q28: the heading error at their start, rad
_WAIT_TURN = const(169)  # Q28: corrections of the heading since, rad
_WAIT_A = const(170)  # 3, Q12: accelerometer at their start, counts
_WAIT_MOVED = const(173)  # how far it may be from there: counts**2 / 16
_GYRO = const(174)  # Q28: the angle of a count in two blocks, rad
_B_SHIFT = const(175)  # B is in counts, Q(B_SHIFT)
_B_MAX = const(176)  # its bound
_B_UNIT = const(177)  # the unit of P's biases in B's, / 2**13
_B_INVERSE = const(178)  # 2**20 counts / this unit
_P = const(179)  # 16, Q30: covariance of heading (2.5 rad) and bias (bias_start * 2**0.5), 4 x 4
_DX = const(195)  # 4, Q27: their correction in these two blocks
_INNOVATION = const(199)  # Q27: what is measured of ROW . (heading, bias), less what DX says ...
_NOISE = const(200)  # Q20: ... its variance ...
_Z = const(201)  # 4, Q30: ... P ROW ...
_TOTAL = const(205)  # Q30: ... and ROW P ROW
_P_REST = const(206)  # Q30: variance of a bias after two blocks of rest
_P_KNOWN = const(207)  # Q30: variance of a bias that is known ...
_P_VAGUE = const(208)  # Q30: ... and of one of which little is known
_Q_HEADING = const(210)  # Q30: variance that two blocks add to the heading ...
_Q_SCALE = const(211)  # ... and for RATE: Q_SCALE / 2**Q_SCALE_SHIFT
_Q_SCALE_SHIFT = const(212)
_Q_LEVEL = const(213)  # Q30: variance that two blocks add to a horizontal bias ...
_Q_UP = const(214)  # Q30: ... and to a vertical one
_GROW = const(215)  # Q20: heading that a unit of bias makes in two blocks
_R_TILT = const(216)  # Q20: variance of a tilt correction as a bias
_R_REST = const(217)  # Q20: variance of the gyro at rest
_R_MAG = const(218)  # Q20: variance of a heading
_SHARE = const(219)  # Q15: how much of what the measurement says of the bias is believed
_AXIS = const(220)  # of the gyro that was measured last, at rest
_SIDE = const(221)  # which tilt correction comes next: 0 north, 1 west
_CC = const(222)  # TURN to INNOVATION: CC / 2**10
_C = const(223)  # 2, Q31: TURN of the last levelling, north and west
_HAVE = const(225)  # 1: field and candidate are set; 2: reference, too; 4: the one before, too
_F = const(226)  # 2, Q13: smoothed field, counts, horizontal and vertical
_FR = const(228)  # 2, Q13: reference; F, FR, FO and FC stand together
_FO = const(230)  # 2, Q13: the reference before this one
_FC = const(232)  # 2, Q13: candidate
_NEAR = const(234)  # blocks near the reference, no more than FIELD_AFTER
_FOR = const(235)  # blocks for which the reference was seen while turning
_FOR_MOST = const(236)  # most of it
_FO_FOR = const(237)  # the same of the reference before
_CAND = const(238)  # the same of the candidate
_BACK = const(239)  # blocks near the reference before
_BACK_AFTER = const(240)  # blocks
_CAND_E = const(241)  # Q28: heading error in the candidate's field, rad
_STILL_E = const(242)  # Q28: slow mean of the heading error at rest, rad
_STILL_SET = const(243)  # 1: it is set
_STILL_K = const(244)  # Q15: its gain
_STEADY = const(245)  # blocks with the field near to the reference, no more than STEADY_MOST
_STEADY_MOST = const(246)  # blocks
_OWN = const(247)  # 1: the heading error is the attitude's own, not another field's
_LOST = const(248)  # half blocks of such an error
_RESTART_AFTER = const(249)  # half blocks
_WEIGHT = const(250)  # 1: the heading is taken up
_TOL = const(251)  # Q15: tolerance squared
_SAME = const(252)  # Q15: the same for a field that has not changed
_SMOOTH = const(253)  # Q10: blocks of 0.05 s
_REF = const(254)  # Q10: blocks of the reference's time constant
_FIELD_AFTER = const(255)  # blocks
_FIELD_FIRST = const(256)  # blocks
_FIELD_NEW = const(257)  # blocks
_NEED = const(258)  # blocks of 5 s
_TURNING_MIN = const(259)  # squared turn rate, (4 counts)**2
_GATE = const(260)  # Q28: heading error that is believed, beside the doubt, rad
_GOOD = const(261)  # 1: the field is the reference's, and its heading is believed
_DOUBT = const(262)  # Q28: heading uncertainty, rad
# -- end of the words

# decisions
_STILL_BIT = const(1)
_NEAR_REFERENCE = const(2)
_NEAR_CANDIDATE = const(4)
_TURNING = const(8)
_CONSISTENT = const(16)
_OVER = const(32)
_NEAR_OLD = const(64)
_UPSET_BIT = const(128)
_CONTRADICTS = const(256)
_ADOPT = const(512)
_TURNED = const(1024)
_LEANS = const(2048)
_SAME_BIT = const(4096)
_FORGET = const(8192)
_VAGUE = const(16384)
_JUMPED = const(32768)

_PI28 = const(843314857)  # pi, Q28
_HALF = const(536870912)  # 1/2, Q30: no variance is more
_OPEN = const(515396076)  # 3 rad**2 in units of (2.5 rad)**2, Q30: nothing is known of the heading
_TENTH_P = const(107374182)  # 0.1, Q30
_FORGOTTEN = const(51539608)  # 0.3 rad**2 in units of (2.5 rad)**2, Q30
_TENTH = const(26843546)  # 0.1 rad, Q28
_LIMIT = const(5368709)  # 0.02 rad, Q28
_CAND_TOL = const(93952410)  # 0.35 rad, Q28
_PARTS = const(8)  # of the work of two blocks: none is left
_LEAST = const(64)  # Q30: no variance is less
_HEADING_SHARE = const(7200)  # 0.22, Q15: the magnetometer's errors last, and are not noise alone
_MOST = const(536870912)  # 4 units, Q27


@micropython.viper
def root(n: int) -> int:
    """The integer part of the root of 0 <= n < 2**30."""
    bit = 16384
    while bit and bit * bit > n:
        bit >>= 1
    r = 0
    while bit:
        t = r + bit
        if t * t <= n:
            r = t
        bit >>= 1
    return r


@micropython.viper
def open_heading(state, variance: int):
    """The heading's variance is at least this (Q30) from now on; what was added has nothing to do with the biases."""
    s = ptr32(state)
    s[_STILL_SET] = 0
    if variance <= s[_P]:
        return
    s[_P] = variance
    s[_DOUBT] = int(root(variance)) * 20480


@micropython.viper
def open_bias(state):
    """Nothing is known of the biases any more."""
    s = ptr32(state)
    i = 1
    while i < 16:
        s[_P + i] = 0
        i += 1
    s[_P + 5] = _HALF
    s[_P + 10] = _HALF
    s[_P + 15] = _HALF


@micropython.viper
def start_again(state, counts: ptr16):
    """The first sample after an outage: the attitude is unknown, and what was summed before it is of another."""
    s = ptr32(state)
    s[_AGAIN] = 1
    open_heading(state, _OPEN)
    i = 0
    while i < 3:
        s[_FS + i] = 0
        s[_GS + i] = ((counts[3 + i] & 0xFFFF) ^ 0x8000) - 0x8000
        s[_GG + i] = 0
        s[_MS + i] = 0
        i += 1
    s[_MN] = 0
    i = 0
    while i < 4:
        s[_DX + i] = 0
        i += 1
    s[_PHASE] = 1
    s[_PART] = _PARTS
    s[_REGRESS] = 0


# ------------------------------------------------------------------------------------------ levelling
@micropython.viper
def close(s: ptr32, counts: ptr16):
    """The end of a levelling: H, the mean force; RATE; of two blocks the input of the rest detector; K."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    block = s[_LEVEL]
    b_shift = s[_B_SHIFT] - 12
    two = s[_PHASE] == 1
    rate = 0
    i = 0
    while i < 3:
        x = s[_FS + i] << k >> k
        s[_FS + i] = 0
        if block > 5:
            x >>= 1
        else:
            x <<= 5 - block
        s[_H + i] = x
        # RATE = |gyro - b|**2
        x = s[_GS + i] << k >> k
        s[_GS + i] = 0
        n = (s[_GG + i] << k >> k) + x
        s[_GG + i] = n
        y = (s[_BASE + i] << k >> k) << 4
        x = (x << 12 - block) - y - ((s[_B + i] << k >> k) >> b_shift) >> 14
        rate += x * x
        if two:
            # sample, and mean of the two blocks, less the bias that was set
            x = ((counts[i] & 0xFFFF) ^ 0x8000) - 0x8000
            s[_IN + i] = x << 12
            x = ((counts[3 + i] & 0xFFFF) ^ 0x8000) - 0x8000
            s[_SEEN + i] = (x << 12) - y
            s[_IN + 3 + i] = (n << 11 - s[_BLOCK]) - y
            s[_GG + i] = 0
        i += 1
    if rate > 0xFFFFFFF:
        rate = 0xFFFFFFF
    s[_RATE] = rate
    # K; at the start L / (ramp N + L) of L steps, no more than 1/2
    n = s[_N]
    if s[_AGAIN]:
        s[_AGAIN] = 0
        n = 0
        block = 0
        s[_LEVEL] = 0
        s[_LEVEL_MASK] = 0
    x = s[_K_PACE] >> s[_BLOCK] - block
    if n < s[_N_END]:
        i = 1 << block
        n += i
        s[_N] = n
        y = (i << 20) // ((s[_RAMP] * n >> 8) + i)
        if y > x:
            x = y
        # L is no more than N / 8
        if block < s[_BLOCK] and n >> 4 >= i and (s[_PHASE] - 1) & ((i << 1) - 1) == 0:
            s[_LEVEL] = block + 1
            s[_LEVEL_MASK] = (i << 1) - 1
    n = 20
    while x > 32767:
        x >>= 1
        n -= 1
    if n < 16:
        x = 32767
        n = 16
    s[_K] = x
    s[_K_SHIFT] = n
    # KC: K / (1 g)
    x = x * s[_LI] >> 14
    n -= 1
    while x > 32767:
        x >>= 1
        n -= 1
    s[_KC] = x
    s[_KC_SHIFT] = n


@micropython.viper
def pace(state):
    """K_PACE, the tilt gain after the start: it grows with the root of the turn rate. And the watch of a lost tilt."""
    s = ptr32(state)
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # HELD follows RATE up at once, down with 2 tau_start
    rate = s[_RATE]
    x = s[_HELD]
    if rate > x:
        x = rate
    else:
        y = rate - x
        i = y >> 13
        x += i * s[_HELD_K] + ((y - (i << 13)) * s[_HELD_K] >> 13) >> 2
    s[_HELD] = x
    # lost: |SF| > lost_g for 2 s
    gain = s[_SF_K]
    rate = 0
    i = 0
    while i < 2:
        x = s[_SF + i] << k >> k
        y = (s[_H + i] << k >> k) - x
        n = (y + 32768) >> 16
        x += (n * gain << 1) + ((y - (n << 16)) * gain >> 15)
        s[_SF + i] = x
        x >>= 16
        rate += x * x
        i += 1
    decided = s[_DECIDED] | (_LEANS | _VAGUE)
    i = s[_LEAN]
    if rate > s[_LEAN_G]:
        i += 1
        if i > s[_LEAN_AFTER]:
            i = 0
            s[_AGAIN] = 1
            open_heading(state, _OPEN)
    else:
        decided ^= _LEANS
        i -= 2
        if i < 0:
            i = 0
    s[_LEAN] = i
    # T / tau
    x = s[_K_START]
    if s[_P + 5] <= s[_P_VAGUE] and s[_P + 10] <= s[_P_VAGUE] and s[_P + 15] <= s[_P_VAGUE]:
        decided ^= _VAGUE
        x = int(root(s[_HELD]))
        if x > 16383:
            x = 16383
        x = int(root(x << 16)) * s[_K_TURN] >> 10
        if x > s[_K_MOST]:
            x = s[_K_MOST]
        elif x < s[_K_LEAST]:
            x = s[_K_LEAST]
    s[_DECIDED] = decided
    s[_K_PACE] = x


@micropython.viper
def level(s: ptr32):
    """S takes up H; TURN: the turn that levels S, each part at most K; upside down, 1.4 K as a whole."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # OFF = H - S; S += 2 K OFF
    gain = s[_K]
    shift = s[_K_SHIFT] - 16  # twice K, and 15 bits are in the split
    half = 1 << shift >> 1
    x = s[_S] << k >> k
    y = (s[_H] << k >> k) - x
    s[_OFF] = y
    h = (y + 32768) >> 16
    x += ((h * gain << 1) + ((y - (h << 16)) * gain >> 15) + half) >> shift
    s[_S] = x
    y = s[_S + 1] << k >> k
    h = (s[_H + 1] << k >> k) - y
    s[_OFF + 1] = h
    t = (h + 32768) >> 16
    y += ((t * gain << 1) + ((h - (t << 16)) * gain >> 15) + half) >> shift
    s[_S + 1] = y
    z = s[_S + 2] << k >> k
    h = (s[_H + 2] << k >> k) - z
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
            t = (int(root(h)) << 1) + (most >> 10)  # to 1/1024 g
            most = most * 45875 >> 15
            x = i * most // t << 14
            y = j * most // t << 14
    else:
        decided ^= _OVER
    s[_DECIDED] = decided
    # TURN = K (y, -x), no part of it more than 1/4
    gain = s[_KC]
    shift = s[_KC_SHIFT] - 14
    half = 1 << shift >> 1
    h = (y + 8192) >> 14
    y = (h * gain + ((y - (h << 14)) * gain >> 14) + half) >> shift
    h = (x + 8192) >> 14
    x = 0 - ((h * gain + ((x - (h << 14)) * gain >> 14) + half) >> shift)
    s[_C] = y
    s[_C + 1] = x
    if y > _HALF:
        y = _HALF
    elif y < 0 - _HALF:
        y = 0 - _HALF
    if x > _HALF:
        x = _HALF
    elif x < 0 - _HALF:
        x = 0 - _HALF
    s[_TURN] = y
    s[_TURN + 1] = x


@micropython.viper
def regress(s: ptr32):
    """The horizontal earth axes in the body, filtered as the tilt correction is; and the tilt's confidence."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # x += 2 K ((north, west) - y - x); y += K x
    gain = s[_K]
    shift = s[_K_SHIFT] - 12  # of twice the gain, with 11 bits in the split
    half = 1 << shift >> 1
    i = 0
    while i < 6:
        x = s[_X + i] << k >> k
        y = s[_Y + i] << k >> k
        x += ((((s[_R + i] << k >> k) << 9) - y - x + 1024 >> 11) * gain + half) >> shift
        s[_X + i] = x
        s[_Y + i] = y + (((x + 1024 >> 11) * gain + (half << 1)) >> (shift + 1))
        i += 1
    # D += 2 K (|OFF / accel_doubt|**2 - D), no part of OFF more than 3 g; OM = 1 / (1 + D)
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
        x = (x >> norm) * s[_OM_GAIN] >> 14  # Q11
        if x > 32000:
            x = 32000
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


# ------------------------------------------------------------------------------------------ rest
@micropython.viper
def detect_rest(state):
    """STILL: for how long gyro and accelerometer have stayed near their low-passes.

    A rest that contradicts a known bias counts when it has lasted as long as the rest that it contradicts, and the
    magnetometer does not say that the body turned. At rest a tilt error that cannot be restarts the ramp.
    """
    s = ptr32(state)
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # still: |seen - LOW2| small, |gyro| < bias_limit; contradicts: |gyro - B| > rest_dps where the bias is known
    still = s[_AWAY] < s[_REST_ACCEL] and s[_AWAY + 1] < s[_REST_GYRO]
    contradicts = False
    known = _HALF
    jump = 0
    most = 0
    up = 0
    shift = s[_B_SHIFT] - 12
    i = 0
    while i < 3:
        x = s[_LOW2 + 3 + i] << k >> k
        y = x - ((s[_B + i] << k >> k) >> shift)
        n = y
        if n > 0xFF0000:
            n = 0xFF0000
        elif n < 0 - 0xFF0000:
            n = 0 - 0xFF0000
        if y < 0:
            y = 0 - y
        up += (n >> 8) * (s[_R + 6 + i] << k >> k) >> 7  # of the gyro less B, Q12
        if x < 0:
            x = 0 - x
        if x > s[_REST_MOST]:
            still = False
        x = s[_P + 5 + 5 * i]
        if y > most:
            most = y
        if y > jump and x > _TENTH_P:
            jump = y
        if y > s[_REST_OFF] and x < s[_P_KNOWN]:
            contradicts = True
            if x < known:
                known = x
        i += 1
    decided = s[_DECIDED]
    x = _STILL_BIT | _UPSET_BIT | _CONTRADICTS | _ADOPT | _TURNED | _JUMPED
    decided = (decided | x) ^ x
    n = 0
    wait = 0
    if still:
        decided |= _STILL_BIT
        n = s[_STILL] + 1
        if n > s[_REST_AFTER]:
            n = s[_REST_AFTER]
        if contradicts:
            decided |= _CONTRADICTS
            wait = s[_WAIT] + 1
            if wait == 1:
                s[_WAIT_E] = s[_HEADING]
                s[_WAIT_TURN] = 0
                s[_WAIT_A] = s[_LOW2]
                s[_WAIT_A + 1] = s[_LOW2 + 1]
                s[_WAIT_A + 2] = s[_LOW2 + 2]
            moved = 0
            i = 0
            while i < 3:
                x = (s[_LOW2 + i] << k >> k) - (s[_WAIT_A + i] << k >> k) >> 14
                if x < 0:
                    x = 0 - x
                if x > 8191:
                    x = 8191
                moved += x * x
                i += 1
            # as long as the rest that it contradicts: variance of one block / variance of the bias
            x = s[_P_REST] // known
            if x > s[_WAIT_MOST]:
                x = s[_WAIT_MOST]
            if x < s[_REST_AFTER]:
                x = s[_REST_AFTER]
            turn = 0
            field = 0
            if s[_NINE] and s[_HAVE] & 2 and s[_SINCE] < 16:
                field = 1
            near = decided & (_NEAR_REFERENCE | _NEAR_CANDIDATE)
            if moved > s[_WAIT_MOVED]:
                decided |= _TURNED
            elif wait >= x and (field == 0 or near or wait >= s[_WAIT_MOST]):
                # turn: what the gyro less B would have turned the heading by; the magnetometer knows better
                if up < 0:
                    up = 0 - up
                turn = (up >> 8) * wait
                i = 0x3FFFFFFF // s[_GYRO]
                if turn > i:
                    turn = i
                turn = turn * s[_GYRO] >> 4
                if field and near and up > s[_REST_OFF] >> 1:
                    y = (s[_HEADING] << k >> k) - (s[_WAIT_E] << k >> k)
                    if y > _PI28:
                        y = y - _PI28 - _PI28
                    elif y < 0 - _PI28:
                        y = y + _PI28 + _PI28
                    y += s[_WAIT_TURN] << k >> k
                    if y < 0:
                        y = 0 - y
                    # 0.1 rad are four times the noise of two headings
                    if y < _TENTH:
                        if turn >= _TENTH << 1 or wait >= s[_WAIT_SURE]:
                            decided |= _TURNED
                        else:
                            x = 0x3FFFFFFF
                if x <= wait and decided & _TURNED == 0:
                    decided |= _ADOPT
            if decided & _ADOPT:
                # nothing is known of the bias any more; the heading may be off by what it seemed to turn, up to 14 deg
                jump = most
                open_bias(state)
                x = int(root(s[_P])) + turn // 20480
                if x > 22702:
                    x = 22702
                open_heading(state, x * x)
                wait = 0
            elif decided & _TURNED:
                n = 0
                wait = 0
            elif n == s[_REST_AFTER]:
                n -= 1
    # a bias that was not known: the tilt was turned away meanwhile
    if n == s[_REST_AFTER]:
        # upset: at rest, and the horizontal part of S is more than upset_g
        x = (s[_S] << k >> k) >> 16
        y = (s[_S + 1] << k >> k) >> 16
        if s[_STILL] < n and jump > s[_JUMP]:
            decided |= _JUMPED
            s[_AGAIN] = 1
        elif s[_N] > s[_SOON] and x * x + y * y > s[_UPSET]:
            decided |= _UPSET_BIT
            s[_AGAIN] = 1
            n = 0
        # six axes: what the bias turned comes back with it, as P knows
        if decided & _UPSET_BIT or (decided & _JUMPED and s[_NINE]):
            open_heading(state, _OPEN)
    s[_WAIT] = wait
    s[_STILL] = n
    s[_DECIDED] = decided


# ------------------------------------------------------------------------------------------ magnetic field
@micropython.viper
def smooth_field(s: ptr32):
    """F, the field smoothed; and what it is like: the reference, the one before, the candidate; is the body turning?"""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    have = s[_HAVE]
    e = s[_HEADING] << k >> k
    # F += k (NOW - F), k = j T / (0.05 s + j T)
    gain = (j << 24) // ((j << 10) + s[_SMOOTH])  # Q14
    i = 0
    while i < 2:
        x = s[_NOW + i] << k >> k
        if have == 0:
            s[_F + i] = x
            s[_FC + i] = x
            s[_CAND_E] = e
        y = s[_F + i] << k >> k
        x -= y
        n = x >> 14
        s[_F + i] = y + n * gain + ((x - (n << 14)) * gain >> 14)
        i += 1
    s[_HAVE] = have | 1
    # all fields shifted alike, so that their parts are below 2**14
    n = 0
    i = 0
    while i < 8:
        x = s[_F + i] << k >> k
        if x < 0:
            x = 0 - x
        n |= x
        i += 1
    shift = 0
    while n > 16383:
        n >>= 1
        shift += 1
    x = (s[_F] << k >> k) >> shift
    y = (s[_F + 1] << k >> k) >> shift
    bits = 0
    nearest = 0
    # near: |F - r| < field_tolerance |r|
    i = 2
    while i < 8:
        n = (s[_F + i] << k >> k) >> shift
        m = (s[_F + i + 1] << k >> k) >> shift
        size = n * n + m * m >> 15
        n -= x
        m -= y
        away = n * n + m * m
        if away < size * s[_TOL]:
            if i == 2:
                bits |= _NEAR_REFERENCE
            elif i == 4:
                if bits & _NEAR_REFERENCE == 0 or away < nearest:
                    bits |= _NEAR_OLD
            else:
                bits |= _NEAR_CANDIDATE
        if i == 2:
            nearest = away
            if away < size * s[_SAME]:
                bits |= _SAME_BIT
        i += 2
    if have & 2 == 0:
        bits &= _NEAR_CANDIDATE
    elif have & 4 == 0:
        bits &= _NEAR_CANDIDATE | _NEAR_REFERENCE | _SAME_BIT
    if s[_RATE] >= s[_TURNING_MIN]:
        bits |= _TURNING
    # consistent: |e| < gate + 1.12 doubt; at rest it is where it was to 0.1 rad
    x = e
    if x < 0:
        x = 0 - x
    doubt = s[_DOUBT]
    if x - s[_GATE] < doubt + (doubt >> 3):
        bits |= _CONSISTENT
        if have & 2 and s[_STILL_SET] and s[_STILL] == s[_REST_AFTER]:
            x = e - (s[_STILL_E] << k >> k)
            if x < 0:
                x = 0 - x
            if x > _PI28:
                x = _PI28 - (x - _PI28)
            if x > _TENTH:
                bits ^= _CONSISTENT
    # a candidate has its own heading, as nearly as the doubt allows
    if have & 2 and s[_GOOD] == 0:
        x = e - (s[_CAND_E] << k >> k)
        if x < 0:
            x = 0 - x
        if x > _PI28:
            x = _PI28 - (x - _PI28)
        if x - _CAND_TOL >= doubt:
            bits = (bits | _NEAR_CANDIDATE) ^ _NEAR_CANDIDATE
    if s[_P] > _FORGOTTEN:
        bits |= _FORGET
    m = _NEAR_REFERENCE | _NEAR_CANDIDATE | _NEAR_OLD | _TURNING | _CONSISTENT | _SAME_BIT | _FORGET
    s[_DECIDED] = (s[_DECIDED] | m) ^ m | bits


@micropython.viper
def judge_field(state):
    """WEIGHT: whether the heading of this field is believed.

    It is when the field is that of the reference, and its heading what the gyro can explain. Another field, or another
    heading, takes the reference's place when it has stayed for longer than the reference had, while the body turned.
    """
    s = ptr32(state)
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    bits = s[_DECIDED]
    have = s[_HAVE]
    e = s[_HEADING] << k >> k
    # good: near the reference and consistent for field_after
    good = 0
    near = 0
    if bits & _NEAR_REFERENCE and bits & _CONSISTENT:
        near = s[_NEAR] + j
        if near >= s[_FIELD_AFTER]:
            near = s[_FIELD_AFTER]
            good = 1
            if bits & _TURNING:
                n = s[_FOR] + j
                if n > s[_FOR_MOST]:
                    n = s[_FOR_MOST]
                s[_FOR] = n
    # the candidate: how long it has stayed, while turning
    count = s[_CAND]
    if good or bits & _NEAR_CANDIDATE == 0:
        count = 0
    elif have & 2 == 0 or bits & (_TURNING | _FORGET):
        count += j
    # reference and candidate follow F: r += k (F - r), k = j T / (field_tau + j T), no more than 1/16
    gain = (j << 26) // ((j << 10) + s[_REF] >> 4)  # Q20
    if gain > 65535:
        gain = 65535
    i = 0
    while i < 2:
        if good:
            y = s[_FR + i] << k >> k
            x = (s[_F + i] << k >> k) - y
            n = x >> 15
            s[_FR + i] = y + (n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5)
        y = s[_FC + i] << k >> k
        x = (s[_F + i] << k >> k) - y
        if bits & _NEAR_CANDIDATE == 0:
            y += x
        else:
            n = x >> 15
            y += n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5
        s[_FC + i] = y
        i += 1
    x = e - (s[_CAND_E] << k >> k)
    if bits & _NEAR_CANDIDATE == 0 or good or have & 2 == 0:
        s[_CAND_E] = e
    else:
        if x > _PI28:
            x = x - _PI28 - _PI28
        elif x < 0 - _PI28:
            x = x + _PI28 + _PI28
        n = x >> 15
        x = (s[_CAND_E] << k >> k) + (n * gain + ((x - (n << 15)) * gain >> 15) + 16 >> 5)
        if x > _PI28:
            x = x - _PI28 - _PI28
        elif x < 0 - _PI28:
            x = x + _PI28 + _PI28
        s[_CAND_E] = x
    # own: the field is what it was, and its heading is another: the attitude is wrong
    steady = 0
    if bits & _SAME_BIT:
        steady = s[_STEADY] + j
        if steady > s[_STEADY_MOST]:
            steady = s[_STEADY_MOST]
    s[_STEADY] = steady
    lost = s[_LOST]
    own = s[_OWN]
    restart = False
    if have & 2 == 0 or bits & _CONSISTENT:
        lost -= j << 1
        if lost < 0:
            lost = 0
        own = 0
        if steady >= s[_STEADY_MOST]:
            own = 1
    elif own and steady:
        lost += j
        if bits & _TURNING:
            lost += j
        if lost > s[_RESTART_AFTER]:
            lost = 0
            restart = True
    else:
        lost = 0
        own = 0
    s[_LOST] = lost
    s[_OWN] = own
    back = s[_BACK]
    if good:
        back = 0
    if restart:
        near = s[_FIELD_AFTER]
        good = 1
        count = 0
    elif good + near == 0:
        # another reference, after field_first, field_new, or twice as long as this one was seen and 5 s
        need = s[_FIELD_FIRST]
        n = count
        returns = False
        if have & 2:
            if bits & _FORGET == 0:
                need = (s[_FOR] << 1) + s[_NEED]
                if bits & _CONSISTENT and need > s[_FIELD_NEW]:
                    need = s[_FIELD_NEW]
            if bits & _NEAR_OLD:
                # the one before, soon
                back += j
                if need > s[_BACK_AFTER]:
                    need = s[_BACK_AFTER]
                if back >= n:
                    n = back
                    returns = True
            else:
                back = 0
        if n >= need:
            near = s[_FIELD_AFTER]
            good = 1
            count = 0
            if have & 2 and (bits & _CONSISTENT == 0 or returns):
                restart = True
            if n > s[_FOR_MOST]:
                n = s[_FOR_MOST]
            if returns and n < s[_FO_FOR]:
                n = s[_FO_FOR]
            if have & 2 and bits & _SAME_BIT == 0 and (restart or bits & _NEAR_REFERENCE == 0):
                s[_FO] = s[_FR]
                s[_FO + 1] = s[_FR + 1]
                s[_FO_FOR] = s[_FOR]
                have = 7
                back = 0
            s[_FR] = s[_FC]
            s[_FR + 1] = s[_FC + 1]
            s[_FOR] = n
            s[_HAVE] = have | 3
    s[_BACK] = back
    s[_CAND] = count
    s[_NEAR] = near
    s[_GOOD] = good
    if restart:
        # the heading may be off by e, and the bias is what made it so
        x = e >> 15
        x *= x
        if x > 201326592:
            x = 201326592
        open_heading(state, (x >> 8) * 655)
        open_bias(state)
    # the heading error at rest, slowly
    if good or s[_HAVE] & 2 == 0:
        x = e - (s[_STILL_E] << k >> k)
        if s[_STILL_SET] == 0 or s[_STILL] < s[_REST_AFTER]:
            s[_STILL_SET] = 1
            s[_STILL_E] = e
        else:
            if x > _PI28:
                x = x - _PI28 - _PI28
            elif x < 0 - _PI28:
                x = x + _PI28 + _PI28
            s[_STILL_E] = (s[_STILL_E] << k >> k) + (x >> 15) * s[_STILL_K]
    n = 0
    if good or s[_HAVE] & 2 == 0:
        n = 1
    s[_WEIGHT] = n


# ------------------------------------------------------------------------------------------ heading and bias
@micropython.viper
def grow(s: ptr32):
    """P after two blocks: the heading turns away by -up . bias; heading and bias walk."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # v = P(bias, bias) up; c = up . P(bias, heading); u = up . v
    gain = s[_GROW]
    a = s[_R + 6] << k >> k
    b = s[_R + 7] << k >> k
    o = s[_R + 8] << k >> k
    # the biases walk by so much more about the vertical
    walk = (s[_Q_UP] - s[_Q_LEVEL]) << k >> k
    c = 0
    u = 0
    y = a
    i = 1
    while i < 4:
        at = _P + 4 * i
        x = s[at + 1] << k >> k
        m = x >> 15
        v = m * a + ((x - (m << 15)) * a >> 15)
        x = s[at + 2] << k >> k
        m = x >> 15
        v += m * b + ((x - (m << 15)) * b >> 15)
        x = s[at + 3] << k >> k
        m = x >> 15
        v += m * o + ((x - (m << 15)) * o >> 15)
        m = v >> 15
        n = v - (m << 15)
        u += m * y + (n * y >> 15)
        # P(heading, bias) -= g v
        x = s[at] << k >> k
        v = x - (m * gain + (n * gain >> 15) >> 5)
        s[at] = v
        s[_P + i] = v
        m = x >> 15
        c += m * y + ((x - (m << 15)) * y >> 15)
        # as long as one is known better than at the start
        if s[_P + 5 * i] < _HALF:
            m = y * walk >> 15
            n = 1
            x = a
            while n <= i:
                if s[_P + 5 * n] < _HALF:
                    v = (s[at + n] << k >> k) + (m * x >> 15)
                    if n == i:
                        v += s[_Q_LEVEL]
                        if v > _HALF:
                            v = _HALF
                    s[at + n] = v
                    s[_P + 4 * n + i] = v
                n += 1
                x = b
                if n == 3:
                    x = o
        i += 1
        y = b
        if i == 3:
            y = o
    # P(heading, heading) += g (g u - 2 c) + walk + scale_error RATE
    m = u >> 15
    u = m * gain + ((u - (m << 15)) * gain >> 15) >> 5
    u -= c << 1
    m = u >> 15
    u = m * gain + ((u - (m << 15)) * gain >> 15) >> 5
    n = s[_RATE]
    m = n >> 14
    n -= m << 14
    y = s[_Q_SCALE]
    x = s[_P] + u + s[_Q_HEADING] + (m * y + (n * y >> 14) >> s[_Q_SCALE_SHIFT])
    if s[_CLIPPED]:
        # what a gyro at full scale may have missed
        y = int(root(s[_P])) + s[_CLIPPED] * s[_CLIP]
        s[_CLIPPED] = 0
        if y > 22702:
            y = 22702
        if y * y > x:
            x = y * y
    if x > _OPEN:
        # the error counts for less, and so does what it has in common with the biases: by 1 - (x - OPEN) / (2 OPEN)
        y = (x - _OPEN >> 14) + 1
        y += y >> 3
        x = _OPEN
        i = 1
        while i < 4:
            m = s[_P + i] << k >> k
            n = m >> 15
            m -= n * y + ((m - (n << 15)) * y >> 15) >> 1
            s[_P + i] = m
            s[_P + 4 * i] = m
            i += 1
    s[_P] = x
    s[_DOUBT] = int(root(x)) * 20480


@micropython.viper
def take(s: ptr32):
    """A measurement into DX and P, from Z = P ROW', TOTAL = ROW Z, INNOVATION, NOISE and SHARE.

    The gain of the biases is SHARE of the optimal one; P is what that leaves (Joseph's form).
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    e = s[_INNOVATION] << k >> k
    total = s[_TOTAL] << k >> k
    most = 0
    i = 0
    while i < 4:
        x = s[_Z + i] << k >> k
        if x < 0:
            x = 0 - x
        most |= x
        i += 1
    if total < 0:
        total = 0
    total = (total >> 10) + s[_NOISE]
    if total < 1:
        total = 1
    # 1 / S = r / 2**(29 + shift)
    shift = 0
    while total > 0x7FFFF:
        total >>= 4
        shift += 4
    while total > 32767:
        total >>= 1
        shift += 1
    while total < 16384:
        total <<= 1
        shift -= 1
    r = 0x20000000 // total
    # Z >>= z, into 15 bits
    z = 0
    while most > 0x3FFFF:
        most >>= 4
        z += 4
    while most > 16383:
        most >>= 1
        z += 1
    half = 1 << z >> 1
    i = 0
    while i < 4:
        s[_Z + i] = (s[_Z + i] << k >> k) + half >> z
        i += 1
    # DX += Z e / S
    share = s[_SHARE]
    y = 9 + shift - z
    left = 0
    if y < 0:
        left = 0 - y
        y = 0
    half = 1 << y >> 1
    m = e >> 15
    n = e - (m << 15)
    g = r
    i = 0
    while i < 4:
        x = (s[_Z + i] << k >> k) * g >> 15
        x = m * x + (n * x >> 15) + half >> y
        v = left
        while v:
            x <<= 1
            if x > _MOST:
                x = _MOST
            elif x < 0 - _MOST:
                x = 0 - _MOST
            v -= 1
        x += s[_DX + i] << k >> k
        if x > _MOST:
            x = _MOST
        elif x < 0 - _MOST:
            x = 0 - _MOST
        s[_DX + i] = x
        g = r * share >> 15
        i += 1
    # P -= Z Z' / S; of the biases (2 share - share**2) of it
    y = 24 + shift - z - z
    left = 0
    if y > 30:
        y = 30
    elif y < 0:
        left = 0 - y
        y = 0
    half = 1 << y >> 1
    most = _HALF >> left  # no variance changes by more
    i = 0
    at = _P
    while i < 4:
        m = s[_Z + i] << k >> k
        x = (m * m >> 15) * r + half >> y
        if x > most:
            x = most
        x = (s[at] << k >> k) - (x << left)
        if x < _LEAST:
            x = _LEAST
        elif x > _HALF:
            x = _HALF
        s[at] = x
        n = i + 1
        v = at
        x = at
        while n < 4:
            v += 1
            x += 4
            e = (m * (s[_Z + n] << k >> k) >> 15) * r + half >> y
            if e > most:
                e = most
            elif e < 0 - most:
                e = 0 - most
            e = (s[v] << k >> k) - (e << left)
            if e > _HALF:
                e = _HALF
            elif e < 0 - _HALF:
                e = 0 - _HALF
            s[v] = e
            s[x] = e
            n += 1
        if i == 0 and share < 32768:
            r = r * (share - (share * share >> 16)) >> 14
            if r == 0:
                return
        i += 1
        at += 5


@micropython.viper
def measure_heading(s: ptr32) -> int:
    """Z ... SHARE of the heading of two blocks; 0: there is none."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    j = s[_J]
    if j == 0 or s[_WEIGHT] == 0:
        return 0
    s[_NOISE] = s[_R_MAG] // j
    s[_SHARE] = 0
    if s[_N] > s[_N_LATE]:
        s[_SHARE] = _HEADING_SHARE
    # beyond 0.02 rad + 0.7 doubt an error pulls no harder, and its variance is the larger (Huber)
    e = s[_HEADING] << k >> k
    most = _LIMIT + ((s[_DOUBT] >> 4) * 11)
    x = e
    if x < 0:
        x = 0 - x
    if x > most:
        s[_NOISE] = (s[_NOISE] >> 5) * ((x >> 4) // (most >> 12)) >> 3
    s[_INNOVATION] = e // 5 - (s[_DX] << k >> k)  # units of 2.5 rad, Q27
    s[_Z] = s[_P]
    s[_Z + 1] = s[_P + 1]
    s[_Z + 2] = s[_P + 2]
    s[_Z + 3] = s[_P + 3]
    s[_TOTAL] = s[_P]
    return 1


@micropython.viper
def measure_bias(s: ptr32) -> int:
    """Z ... SHARE of what shows the bias: at rest the gyro's axes in turn, in motion the corrections north, west."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    s[_SHARE] = 32768
    n = s[_N]
    i = s[_AXIS] + 1
    if i > 2:
        i = 0
    s[_AXIS] = i
    if s[_STILL] == s[_REST_AFTER]:
        # gyro - b, counts, Q8
        x = (s[_LOW2 + 3 + i] << k >> k) - ((s[_B + i] << k >> k) >> s[_B_SHIFT] - 12) + 8 >> 4
        most = 0x3FFFFFFF // s[_B_INVERSE]
        if x > most:
            x = most
        elif x < 0 - most:
            x = 0 - most
        i += 1
        s[_INNOVATION] = (x * s[_B_INVERSE] >> 1) - (s[_DX + i] << k >> k)
        s[_NOISE] = s[_R_REST]
        s[_Z] = s[_P + i]
        s[_Z + 1] = s[_P + 4 + i]
        s[_Z + 2] = s[_P + 8 + i]
        s[_Z + 3] = s[_P + 12 + i]
        s[_TOTAL] = s[_Z + i]
        # P becomes no less than 1/65 at a time: 1 - Z / S is exact to 2**-14
        if s[_NOISE] < s[_TOTAL] >> 16:
            s[_NOISE] = s[_TOTAL] >> 16
        return 1
    if n <= s[_N_LATE]:
        return 0
    i = s[_SIDE]
    s[_SIDE] = 1 - i
    # -C as a rate, less what DX says already
    x = 0 - (s[_C + i] << k >> k)
    gain = s[_CC]
    r = s[_BLOCK] - s[_LEVEL]
    most = (0x1FFFFFFF // gain << 10) >> r
    if x > most:
        x = most
    elif x < 0 - most:
        x = 0 - most
    x <<= r
    m = x >> 10
    e = m * gain + ((x - (m << 10)) * gain >> 10)
    # Z = P Y', Y in Q15
    r = _Y + 3 * i
    a = (s[r] << k >> k) >> 9
    b = (s[r + 1] << k >> k) >> 9
    c = (s[r + 2] << k >> k) >> 9
    i = 0
    while i < 16:
        x = s[_P + i + 1] << k >> k
        m = x >> 15
        v = m * a + ((x - (m << 15)) * a >> 15)
        x = s[_P + i + 2] << k >> k
        m = x >> 15
        v += m * b + ((x - (m << 15)) * b >> 15)
        x = s[_P + i + 3] << k >> k
        m = x >> 15
        s[_Z + (i >> 2)] = v + m * c + ((x - (m << 15)) * c >> 15)
        i += 4
    total = 0
    i = 1
    while i < 4:
        x = s[_Z + i] << k >> k
        m = x >> 15
        total += m * a + ((x - (m << 15)) * a >> 15)
        x = s[_DX + i] << k >> k
        m = x >> 15
        e -= m * a + ((x - (m << 15)) * a >> 15)
        a = b
        b = c
        i += 1
    s[_TOTAL] = total
    s[_INNOVATION] = e
    # NOISE = R_TILT / OM, at the start more: (N_FULL / N)**2
    noise = (s[_R_TILT] << 6) // s[_OM]
    if noise > 0xFFFFF:
        noise = 0xFFFFF
    noise <<= 9
    if n < s[_N_FULL]:
        m = (s[_N_FULL] << 8) // n
        if m > 32767:
            m = 32767
        m = m * m >> 8
        if noise >> 8 > 0x1FFFFFFF // m:
            noise = 0x1FFFFFFF
        else:
            noise = (noise >> 8) * m
    s[_NOISE] = noise
    return 1


@micropython.viper
def apply(s: ptr32):
    """DX into B and TURN; O = O_BASE - b dt / 2, what the steps add."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    b_shift = s[_B_SHIFT]
    gain = s[_G]
    rest = s[_GR]
    unit = s[_B_UNIT]
    n = 0
    while n < 3:
        x = s[_DX + 1 + n] << k >> k
        m = x >> 15
        x = (s[_B + n] << k >> k) + (m * unit + ((x - (m << 15)) * unit >> 15) << 1)
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
    # the heading, no more than 1/2 rad in two blocks
    x = s[_DX] << k >> k
    if x > 0x1999999:
        x = 0x1999999
    elif x < 0 - 0x1999999:
        x = 0 - 0x1999999
    n = 0
    while n < 4:
        s[_DX + n] = 0
        n += 1
    s[_TURN + 2] = x * 20  # a half angle, Q31
    x *= 5  # Q28
    y = (s[_WAIT_TURN] << k >> k) + x
    if y < 0x20000000 and y > 0 - 0x20000000:
        s[_WAIT_TURN] = y
    if s[_STILL_SET]:
        x = (s[_STILL_E] << k >> k) - x
        if x > _PI28:
            x = x - _PI28 - _PI28
        elif x < 0 - _PI28:
            x = x + _PI28 + _PI28
        s[_STILL_E] = x
