# Integer kernels of the inertial filter (inertial.py): the covariance of heading and bias, and what is measured of
# both. Needs the viper emitter. As inertial_tilt.py, it is made for a hard interrupt.

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
_O_BASE = const(52)  # 3, Q31: O of BASE alone
_OR_BASE = const(55)  # 3, Q46: its last bits
_B = const(58)  # 3: learnt bias on top of BASE, in the filter's own unit
_BLOCK = const(62)  # log2 of the steps of a block
_DECIDED = const(65)  # yes/no decisions, for the tests' float twin
_J = const(74)  # blocks that the heading of this block stands for; 0: none
_HEADING = const(75)  # Q28: heading error, rad
_LOW2 = const(90)  # 6, Q12: second
_STILL = const(99)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(100)  # blocks
_LEVEL = const(106)  # log2 of the steps of a levelling: 0 at the start, BLOCK in the end
_CLIPPED = const(116)  # samples with one since P grew last
_CLIP = const(117)  # Q15: what one adds to the doubt of the heading, units of 2.5 rad
_MISSED = const(118)  # steps without a sample since P grew last
_MISS = const(119)  # Q28: what one of them adds for 4 counts of HELD's root, units of 2.5 rad
_RATE = const(127)  # squared turn rate of the block, (4 counts)**2
_HELD = const(128)  # the same: follows up at once and down slowly
_N = const(146)  # steps since the start of the ramp, no more than N_END
_N_LATE = const(147)  # steps until the bias is estimated in motion
_N_FULL = const(148)  # steps until it is at full weight
_Y = const(166)  # 6, Q24: outer low-pass
_OM = const(173)  # Q15: tilt confidence 1 / (1 + D)
_WAIT_TURN = const(182)  # Q28: corrections of the heading since, rad
_B_SHIFT = const(188)  # B is in counts, Q(B_SHIFT)
_B_MAX = const(189)  # its bound
_B_UNIT = const(190)  # the unit of P's biases in B's, / 2**13
_B_INVERSE = const(191)  # 2**20 counts / this unit
_P = const(192)  # 16, Q30: covariance of heading (2.5 rad) and bias (bias_start * 2**0.5), 4 x 4
_DX = const(208)  # 4, Q27: their correction in these two blocks
_INNOVATION = const(212)  # Q27: what is measured of ROW . (heading, bias), less what DX says ...
_NOISE = const(213)  # Q20: ... its variance ...
_Z = const(214)  # 4, Q30: ... P ROW ...
_TOTAL = const(218)  # Q30: ... and ROW P ROW
_P_UP = const(222)  # Q30: variance of the bias about the vertical
_Q_HEADING = const(224)  # Q30: variance that two blocks add to the heading ...
_Q_SCALE = const(225)  # ... and for RATE: Q_SCALE / 2**Q_SCALE_SHIFT
_Q_SCALE_SHIFT = const(226)
_Q_LEVEL = const(227)  # Q30: variance that two blocks add to a horizontal bias ...
_Q_UP = const(228)  # Q30: ... and to a vertical one
_Q_FAR = const(229)  # Q30: ... the same while the heading stays far off
_GROW = const(230)  # Q20: heading that a unit of bias makes in two blocks
_R_TILT = const(231)  # Q20: variance of a tilt correction as a bias
_R_REST = const(232)  # Q20: variance of the gyro at rest
_R_MAG = const(233)  # Q20: variance of a heading
_FAR = const(234)  # blocks with the heading off by more than its doubt; the sign: to where
_FAR_AFTER = const(235)  # blocks after which the vertical bias is taken to change
_SHARE = const(236)  # Q15: how much of what the measurement says of the bias is believed
_AXIS = const(237)  # of the gyro that was measured last, at rest
_SIDE = const(238)  # which tilt correction comes next: 0 north, 1 west
_CC = const(239)  # TURN to INNOVATION: CC / 2**10
_C = const(240)  # 2, Q31: TURN of the last levelling, north and west
_STILL_E = const(259)  # Q28: slow mean of the heading error at rest, rad
_STILL_SET = const(260)  # 1: it is set
_WEIGHT = const(267)  # 1: the heading is taken up
_DOUBT = const(279)  # Q28: heading uncertainty, rad
# -- end of the words

# decisions
_CONTRADICTS = const(256)

_PI28 = const(843314857)  # pi, Q28
_HALF = const(536870912)  # 1/2, Q30: no variance is more
_OPEN = const(515396076)  # 3 rad**2 in units of (2.5 rad)**2, Q30: nothing is known of the heading
_OPEN_DOUBT = const(464936960)  # its root, Q28: rad
_LIMIT = const(5368709)  # 0.02 rad, Q28
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
    # the biases walk by so much more about the vertical; a heading that stays off shows that this one does
    level = s[_Q_LEVEL]
    if s[_DECIDED] & _CONTRADICTS:
        level = s[_Q_UP]
    walk = s[_Q_UP]
    c = s[_FAR] << k >> k
    if c > s[_FAR_AFTER] or c < 0 - s[_FAR_AFTER]:
        walk = s[_Q_FAR]
    walk -= level
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
                        v += level
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
    s[_P_UP] = u
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
    if s[_CLIPPED] | s[_MISSED]:
        # what a gyro at full scale may have missed, and what steps without a sample
        y = int(root(s[_P])) + s[_CLIPPED] * s[_CLIP]
        y += (int(root(s[_HELD])) * s[_MISSED] >> 7) * s[_MISS] >> 6
        s[_CLIPPED] = 0
        s[_MISSED] = 0
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
    n = s[_FAR] << k >> k
    if x > most:
        s[_NOISE] = (s[_NOISE] >> 5) * ((x >> 4) // (most >> 12)) >> 3
        if e < 0:
            j = 0 - j
        # a change of side begins anew
        if (n ^ j) < 0:
            n = 0
        if n < 0xFFFF and n > 0 - 0xFFFF:
            n += j
    else:
        n -= n >> 2
        if n > 0:
            n -= 1
    s[_FAR] = n
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
    if x > 0x1999999 or x < 0 - 0x1999999:
        # the rest of it is still to come
        s[_P] = _OPEN
        s[_DOUBT] = _OPEN_DOUBT
        if x > 0:
            x = 0x1999999
        else:
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
