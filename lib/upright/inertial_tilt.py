# Integer kernels of the inertial filter (inertial.py): levelling, and rest. Needs inertial_kalman.py and the viper
# emitter. In earth_kernels.py is what is not this filter's alone, and what a state and a block are. All of it is made
# for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on every port. K,
# T, y ...: the names of the equations in docs/methods.md; the float twin is host_tests/reference.

import micropython
from micropython import const

from upright.inertial_kalman import open_bias, open_heading, root

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_TURN = const(23)  # 3, Q31: correction that the next step takes up, earth frame, half angle
_R = const(26)  # 9, Q15: rotation matrix; its rows are north, west, up in the body
_FS = const(35)  # 3, Q9: specific force in the earth frame, counts, summed over the block
_FULL_END = const(39)  # 1 + 2 axis + sign of the accelerometer at full scale, 0: none is
_FULL_SUM = const(42)  # 3, Q3: specific force of these steps, less 1 g, in the earth frame
_LATER = const(45)  # 3, Q3: of earlier ones, to be added to FS where there is room
_BASE = const(49)  # 3, Q8: gyro bias that was set, counts
_B = const(58)  # 3: learnt bias on top of BASE, in the filter's own unit
_NINE = const(61)  # 1: use the magnetometer
_BLOCK = const(62)  # log2 of the steps of a block
_PHASE = const(64)  # fresh steps of the block
_DECIDED = const(65)  # yes/no decisions, for the tests' float twin
_GS = const(66)  # 3: gyro counts summed over the block
_MS = const(69)  # 3, Q9: magnetometer in the earth frame, counts, summed over the block
_MN = const(72)  # samples in it
_SINCE = const(73)  # blocks since the last with a magnetometer sample, no more than 16
_HEADING = const(75)  # Q28: heading error, rad
_IN = const(78)  # 6, Q12: what LOW1 takes up: accelerometer, gyro less BASE, counts
_LOW2 = const(90)  # 6, Q12: second
_AWAY = const(96)  # 2, Q6: squared distance from LOW2 of accelerometer and gyro, counts**2
_STILL = const(99)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(100)  # blocks
_REST_GYRO = const(102)  # Q6: at rest AWAY is less: counts**2
_REST_ACCEL = const(103)  # Q6: the same of the accelerometer
_REST_MOST = const(104)  # Q12: most that is taken for a bias, counts
_LEVEL = const(106)  # log2 of the steps of a levelling: 0 at the start, BLOCK in the end
_LEVEL_MASK = const(107)  # steps of it less 1
_REGRESS = const(108)  # 1: the regressors take their step next
_PART = const(109)  # part of the work of two blocks that comes next
_GG = const(111)  # 3: gyro counts summed over two blocks
_SEEN = const(121)  # 3, Q12: the gyro of one sample, less BASE
_H = const(124)  # 3, Q14: specific force of the block in the earth frame, counts
_RATE = const(127)  # squared turn rate of the block, (4 counts)**2
_HELD = const(128)  # the same: follows up at once and down slowly
_HELD_K = const(129)  # Q15: gain down
_S = const(130)  # 3, Q14: low-passed specific force in the earth frame, counts
_OFF = const(133)  # 2, Q14: the block's force less the low-pass, horizontal, counts
_SF = const(135)  # 2, Q14: the force low-passed quickly, horizontal, counts
_SF_K = const(137)  # Q15: gain of it
_LEAN_G = const(138)  # |SF| beyond which the tilt is lost: (4 counts)**2
_LEAN = const(139)  # blocks with more
_LEAN_AFTER = const(140)  # blocks
_K = const(141)  # tilt gain of this levelling = K / 2**K_SHIFT, K < 2**15
_K_SHIFT = const(142)
_KC = const(143)  # the same for S (normalised) to half angle
_KC_SHIFT = const(144)
_AGAIN = const(145)  # 1: the ramp starts anew
_N = const(146)  # steps since the start of the ramp, no more than N_END
_N_END = const(149)  # steps after which the start is over
_RAMP = const(150)  # Q8: ramp of the tilt
_K_PACE = const(151)  # Q20: tilt gain of a block after the start
_K_START = const(152)  # Q20: tilt gain of a block while little is known of the bias ...
_K_LEAST = const(153)  # Q20: ... and its bounds afterwards
_K_MOST = const(154)  # Q20
_K_TURN = const(155)  # tilt gain for the fourth root of HELD: K_TURN / 2**22
_NORM = const(156)  # shift that brings 1 g to 2**14..2**15 counts
_G1 = const(157)  # 1 g in counts
_LI = const(158)  # Q29: 1 / (1 g, normalised)
_OM_GAIN = const(159)  # Q24: 1 / (accel_doubt, normalised)
_X = const(160)  # 6, Q24: regressors north and west: inner low-pass
_Y = const(166)  # 6, Q24: outer low-pass
_D = const(172)  # Q15: square of the horizontal deviation / accel_doubt**2
_OM = const(173)  # Q15: tilt confidence 1 / (1 + D)
_REST_OFF = const(174)  # Q12: most that a known bias may be off, counts
_UPSET = const(175)  # tilt at rest that restarts the ramp: (counts / 4)**2
_JUMP = const(176)  # Q12: a bias found at rest that restarts the ramp, counts
_SOON = const(177)  # steps after a restart in which no other follows
_WAIT = const(178)  # blocks for which a rest has contradicted the bias
_WAIT_MOST = const(179)  # blocks
_WAIT_SURE = const(180)  # blocks after which a slow turn is decided, too
_WAIT_E = const(181)  # Q28: the heading error at their start, rad
_WAIT_TURN = const(182)  # Q28: corrections of the heading since, rad
_WAIT_A = const(183)  # 3, Q12: accelerometer at their start, counts
_WAIT_MOVED = const(186)  # how far it may be from there: counts**2 / 16
_GYRO = const(187)  # Q28: the angle of a count in two blocks, rad
_B_SHIFT = const(188)  # B is in counts, Q(B_SHIFT)
_P = const(192)  # 16, Q30: covariance of heading (2.5 rad) and bias (bias_start * 2**0.5), 4 x 4
_DX = const(208)  # 4, Q27: their correction in these two blocks
_P_REST = const(219)  # Q30: variance of a bias after two blocks of rest
_P_KNOWN = const(220)  # Q30: variance of a bias that is known ...
_P_VAGUE = const(221)  # Q30: ... and of one of which little is known
_P_UP = const(222)  # Q30: variance of the bias about the vertical
_C = const(240)  # 2, Q31: TURN of the last levelling, north and west
_HAVE = const(242)  # 1: field and candidate are set; 2: reference, too; 4: the one before, too
# -- end of the words

# decisions
_STILL_BIT = const(1)
_NEAR_REFERENCE = const(2)
_NEAR_CANDIDATE = const(4)
_OVER = const(32)
_UPSET_BIT = const(128)
_CONTRADICTS = const(256)
_ADOPT = const(512)
_TURNED = const(1024)
_LEANS = const(2048)
_VAGUE = const(16384)
_JUMPED = const(32768)

_PI28 = const(843314857)  # pi, Q28
_HALF = const(536870912)  # 1/2, Q30: no variance is more
_OPEN = const(515396076)  # 3 rad**2 in units of (2.5 rad)**2, Q30: nothing is known of the heading
_TENTH_P = const(107374182)  # 0.1, Q30
_TENTH = const(26843546)  # 0.1 rad, Q28
_PARTS = const(8)  # of the work of two blocks: none is left


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
        s[_FULL_SUM + i] = 0
        s[_LATER + i] = 0
        i += 1
    s[_MN] = 0
    s[_FULL_END] = 0
    i = 0
    while i < 4:
        s[_DX + i] = 0
        i += 1
    s[_PHASE] = 1
    s[_PART] = _PARTS
    s[_REGRESS] = 0


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
    # about the vertical, however the board is mounted
    if up < 0:
        up = 0 - up
    if up > s[_REST_OFF] and s[_P_UP] < s[_P_KNOWN]:
        contradicts = True
        if s[_P_UP] < known:
            known = s[_P_UP]
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
            if s[_NINE] and s[_HAVE] and s[_SINCE] < 16:
                field = 1
            near = decided & (_NEAR_REFERENCE | _NEAR_CANDIDATE)
            if moved > s[_WAIT_MOVED]:
                decided |= _TURNED
            elif wait >= x and (field == 0 or near or wait >= s[_WAIT_MOST]):
                # turn: what the gyro less B would have turned the heading by; the magnetometer knows better
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
