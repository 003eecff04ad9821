# The multiplicative quaternion Kalman filter in 32-bit integers: sensor counts in, quaternion out, with the gyro's bias
# and with variances that say how well all of it is known. Needs attitude.py, fixmath.py, quaternion_kernels.py and the
# viper emitter. update() is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives
# the same bits on every port.

import micropython
from micropython import const

from upright import fixmath, quaternion_kernels
from upright.attitude import Attitude, bias_of, hertz
from upright.fixmath import turn
from upright.quaternion_kernels import (
    carry,
    close,
    compass,
    field,
    gain,
    gather,
    level,
    noise,
    open_up,
    rest,
    run,
    settle,
    shrink,
    spread,
    steer,
    swell,
    tilted,
)

# the words of the state that are used here: see quaternion_kernels.py
_PROBE = const(0)
_Q = const(1)
_QR = const(5)
_W = const(9)
_WR = const(12)
_G = const(15)
_GR = const(16)
_O = const(17)
_OR = const(20)
_F = const(23)
_R = const(26)
_HS = const(35)
_GS = const(41)
_BLOCK = const(49)
_DECIDED = const(52)
_X = const(77)
_V = const(85)
_B = const(87)
_P = const(90)
_UH = const(162)
_UE = const(163)
_UR = const(164)
_UM = const(165)
_OVER = const(166)
_MEANT = const(249)
_YOUNG = const(251)
_AFTER = const(252)
_HG = const(168)
_HG_SHIFT = const(169)
_C = const(170)
_B_SHIFT = const(171)
_B_MOST = const(172)
_QT = const(173)
_QB = const(175)
_QS = const(177)
_QS_SHIFT = const(178)
_BS = const(179)
_RV = const(180)
_RM = const(181)
_RA = const(183)
_V0 = const(184)
_LOW1 = const(185)
_LOW2 = const(191)
_BASE = const(197)
_O_BASE = const(200)
_OR_BASE = const(203)
_Z = const(206)
_STILL = const(210)
_REST_AFTER = const(211)
_REST_K = const(212)
_REST_GYRO = const(213)
_REST_ACCEL = const(214)
_REST_MOST = const(215)
_REST_OFF = const(216)
_KNOWN = const(217)
_CB = const(218)
_CB_SHIFT = const(219)
_WIDE_FOR = const(221)
_WIDE_MOST = const(222)
_LOST = const(223)
_LOST_MOST = const(224)
_SINCE = const(225)
_J = const(226)
_FAR = const(237)
_FIELD_AFTER = const(238)
_TOL = const(240)
_SMOOTH = const(241)
_TAU = const(242)
_TAU_FAR = const(243)
_FAR_MOST = const(244)
_GOOD = const(245)
_FIRST = const(246)
_TAU_0 = const(248)
_STAGE = const(53)  # the next piece of the block's work, 0..8
_PER = const(54)  # pieces in a step
_PHASE = const(48)  # fresh steps of the block
_MASK = const(50)  # steps of a block less 1
_NINE = const(51)  # 1: use the magnetometer
_RR = const(182)  # variance / 16 of the bias at rest
_AXIS = const(220)  # that is measured at rest

_OPEN = const(603979776)  # quaternion_kernels.OPEN
_WIDE = const(8)
_RUNAWAY = const(16)
_UPSET = const(128)
_NOT_BY_MAG = const(0xC3)  # tilt and velocity
_BIAS = const(0x38)
_W_MAX = const((1 << 31) - (1 << 16))  # 1 rad in Q31, less what fixmath.turn adds for rounding
_FOLD_W = const(651000000)  # half of sqrt(3) 0.35 rad, Q31
_SEEDED = const(47099587)  # (12 deg)**2, Q30: of an attitude from one sample
_HEADING_START = const(8177247)  # (5 deg)**2: of a heading that is relative
_SIGMA = const(26000)  # first sigma of the bias in P's units, no more
_MILLION = const(1000000)


@micropython.viper
def work(state, n: int):
    """Piece n of a block's work, 0..7; it is done while the next block is measured."""
    s = ptr32(state)
    if n == 0:
        close(state)
        carry(state)
    elif n == 1:
        spread(state)
        if s[_NINE]:
            compass(state)
    elif n == 2:
        swell(state)
        run(state)
        noise(state)
    elif n == 3:
        if s[_YOUNG]:
            s[_YOUNG] -= 1
        rest(state)
        if s[_DECIDED] & _UPSET:
            open_up(state, 0, _OPEN)
            open_up(state, 1, _OPEN)
        if s[_NINE]:
            if s[_WIDE_FOR]:
                s[_J] = 0  # no heading without the vertical
            elif s[_J]:
                field(state)
    elif n == 7:
        i = s[_AXIS] + 1
        if i == 3:
            i = 0
        s[_AXIS] = i
        if s[_STILL] == s[_REST_AFTER]:
            s[_UE] = s[_Z + i] - s[_B + i]
            s[_UH] = 3 + i
            s[_UR] = s[_RR]
            s[_UM] = 0
            gain(state)
            shrink(state)
    elif n == 6:
        if s[_NINE]:
            i = int(steer(state))
            if i:
                if i > 1:
                    open_up(state, 2, _OPEN)
                s[_UH] = 2
                s[_UM] = _NOT_BY_MAG
                if s[_YOUNG]:
                    s[_UM] |= _BIAS
                gain(state)
                shrink(state)
    else:
        if n == 4:
            tilted(state)
        i = n - 4
        s[_UM] = 0
        if s[_YOUNG]:
            s[_UM] = _BIAS
        if s[_DECIDED] & _WIDE:
            s[_UH] = i
            s[_UE] = s[_MEANT + i]
            s[_UR] = s[_RA]
        else:
            s[_UH] = 6 + i
            s[_UE] = 0 - s[_V + i]
            s[_UR] = s[_RV]
        gain(state)
        shrink(state)
        m = s[_OVER]
        if n == 4:
            s[_DECIDED] = (s[_DECIDED] | _RUNAWAY) ^ _RUNAWAY
        if m:
            s[_DECIDED] |= _RUNAWAY
        if n == 5:
            i = int(settle(state))
            if i == 1:
                open_up(state, 0, _OPEN)
                open_up(state, 1, _OPEN)
            elif i == 2:
                open_up(state, 6, s[_V0])
                open_up(state, 7, s[_V0])


class QuaternionKalman(Attitude):
    """Attitude and gyro bias from gyro, accelerometer and magnetometer: an error-state Kalman filter of 8 states.

    The attitude is the quaternion, turned by every gyro sample; the filter estimates its error as a small rotation
    vector, and corrects by multiplication (E. J. Lefferts, F. L. Markley, M. D. Shuster, Kalman Filtering for
    Spacecraft Attitude Estimation, JGCD 5(5), 1982). The error is that in the earth frame (right-invariant: A. Barrau,
    S. Bonnabel, IEEE TAC 62(4), 2017), where gravity and north stand still, so that the measurements are constant.

    An accelerometer measures motion as well as gravity. What is known of the motion is that velocities stay small: so
    the specific force is turned into the earth frame and integrated, and what is measured is that the horizontal
    velocity is 0, within velocity_noise. Swings and shakes cancel; a tilt error makes the velocity run away.

    The magnetometer measures the heading alone, and corrects nothing but heading and bias (Schmidt's form): a magnet
    cannot tilt. Its noise grows with the distance of the field (horizontal and vertical part) from a slowly tracked
    reference, and beyond field_tolerance it is left out. At rest the averaged gyro measures the bias. Innovations are
    bounded by 5 sigma; when that lasts, the variance is opened up, so that a wrong start is forgotten. Raw counts will
    do, one set of parameters.

    The covariance is propagated once a block of 22 to 44 ms, and the work for it spread over the steps of the next.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767
    axes              9, or 6: the magnetometer is ignored, heading is relative to the start

    All taken to six significant digits:

    gyro_noise       0.043   random walk of the attitude, vibration included, deg/s per root Hz, 0.001..1
    bias_walk        0.0033  random walk of the bias, deg/s per root s, 0..0.1, no more than bias_start / 20
    scale_error      0.007   the faster the body turns, the less the gyro is believed: noise of so many times the rate
                             per root Hz, 0..0.02; a quarter of it about the vertical
    accel_noise      0.1     of the tilt from one block of the accelerometer, g, where so little is known of the tilt
                             (15 deg) that it is believed as it is, 0.02..1
    velocity_noise   1.1     m/s per root Hz, 0.1..2
    mag_noise        0.15    of the heading, rad per root Hz, 0.01..0.2
    bias_start       3.3     first sigma of the bias (on top of set_bias), which is no larger than 2.5 of them, deg/s,
                             0.5..10
    bias_after       5       nothing but rest tells of the bias before this time, s, 0..60: a start in motion is a
                             wrong start, and its corrections are not those of a bias
    rest_noise       0.03    of the averaged gyro at rest, deg/s per root Hz, 0.01..1
    rest_gyro_dps    2       at rest the gyro's mean of a block stays this near to its average, deg/s, 0.1..10
    rest_accel_g     0.05    and the accelerometer's this near to its own, g, 0.01..0.1
    rest_after       1.5     for this long, s, 0.2..10
    field_tolerance  0.2     a field that differs by less is that of the reference, as a part of it, 0.02..0.7

    Limits: a push that lasts (0.3 g for 5 s) is taken for a tilt; a kick that the gyro has not seen is forgotten at
    once at rest, but only within 15 s in motion; a steady rotation from power-on on looks like a bias and is taken for
    one.

    Raises ValueError for a rate, scale or parameter that the numbers cannot hold, with the range that they can:
    60 to 1439 Hz at +-2000 deg/s, from 50 Hz on at +-1000 deg/s and less.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "quaternion-kalman9"
    AXES = 9

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, axes=9, **parameters):
        if axes not in (6, 9):
            raise ValueError("axes is %r, expected 6 or 9" % (axes,))
        self.AXES = axes
        self.NAME = "quaternion-kalman%d" % axes
        s = self._begin(rate, gyro_scale, accel_lsb_per_g, quaternion_kernels.WORDS)
        s[_NINE] = int(axes == 9)
        _set_up(s, self.rate, self.gyro_scale, accel_lsb_per_g, parameters)
        self.set_bias(0, 0, 0)
        self._attitude((fixmath.ONE, 0, 0, 0))

    # -- set-up and main loop
    def seed(self, counts):
        """Take roll and pitch from one accelerometer sample, heading from the magnetometer's where flags bit 1 is set.

        Without a magnetometer sample yaw is 0 (order zyx). Returns True, or False when the accelerometer is shorter
        than 1/16 g: then the attitude is the identity. What has been learnt of bias and field stays. update() is to be
        given the same sample next.
        """
        x, y, z = counts[0], counts[1], counts[2]
        if (x * x + y * y + z * z) << 8 < self.accel_lsb_per_g**2:
            self._attitude((fixmath.ONE, 0, 0, 0))
            return False
        i, j, k = counts[6], counts[7], counts[8]
        heading = _SEEDED
        if (
            self.AXES == 9
            and counts[10] & 2
            and (y * k != z * j or z * i != x * k or x * j != y * i)
        ):
            q = fixmath.level_north((x, y, z), (i, j, k))
        else:
            q = fixmath.level(x, y, z)
            heading = _OPEN
        self._attitude(q, _SEEDED)
        self._open(2, heading if self.AXES == 9 else _HEADING_START)
        return True

    def _attitude(self, q, variance=_OPEN):
        s = self._s
        for i in range(4):
            s[_Q + i] = q[i]
            s[_QR + i] = 16384
        for i in range(3):
            s[_WR + i] = 16384
        for first, n in ((_F, 3), (_HS, 13), (_X, 8), (_V, 2)):
            for i in range(n):
                s[first + i] = 0
        for i in (_WIDE_FOR, _LOST, _SINCE, _J, _FAR):
            s[i] = 0
        s[_YOUNG] = s[_AFTER]
        s[_STAGE] = 8  # the block that was being worked on is of the old attitude
        s[_PHASE] = 1
        self._open(0, variance)
        self._open(1, variance)
        self._open(2, variance if s[_NINE] else _HEADING_START)
        self._open(6, s[_V0])
        self._open(7, s[_V0])

    def _open(self, i, variance):
        """open_up, for variances of more than 30 bits."""
        open_up(self._s, i, 0)
        self._s[_P + (0, 8, 15, 21, 26, 30, 33, 35)[i]] = variance

    def set_bias(self, x, y, z):
        """Set the gyro's bias, ints in 1/256 of a gyro count; what the filter learns from now on comes on top of it.

        Raises ValueError beyond +-8192 counts.
        """
        bias = bias_of(x, y, z)
        s = self._s
        step = (s[_G] << 15) + s[_GR]
        for i in range(3):
            b = fixmath.ratio(bias[i] * step, 256)
            change = (s[_BASE + i] - bias[i]) << 4
            s[_LOW1 + 3 + i] += change
            s[_LOW2 + 3 + i] += change
            s[_BASE + i] = bias[i]
            s[_O + i] = s[_O_BASE + i] = -(b >> 15)
            s[_OR + i] = s[_OR_BASE + i] = -(b & 32767)
            s[_B + i] = 0
            self._open(3 + i, s[_BS])

    def bias(self, out):
        """The gyro's bias, set and learnt, in 1/256 of a gyro count: out[0..2]. For the main loop."""
        num, den = self._counts
        for i in range(3):
            out[i] = self._s[_BASE + i] + fixmath.ratio(self._s[_B + i] * num << 8, den)

    def bias_mdps(self, out):
        """The gyro's bias, set and learnt, in millidegrees/s: out[0..2]. For the main loop: it may allocate."""
        scale, per = self.gyro_scale
        num, den = self._counts
        for i in range(3):
            b = self._s[_BASE + i] * den + (self._s[_B + i] * num << 8)
            out[i] = fixmath.ratio(b * 1000 * per, 256 * den * scale)

    @property
    def _counts(self):
        """(num, den): gyro counts of one unit of a bias."""
        num, den = self.rate
        scale, per = self.gyro_scale
        unit = 1 << (self._s[_C] + 25 + self._s[_BLOCK])
        return 180 * fixmath.PI_DEN * num * scale, unit * fixmath.PI_NUM * den * per

    @property
    def resting(self):
        """True while the body is taken to be at rest: then the gyro measures its own bias."""
        return self._s[_STILL] == self._s[_REST_AFTER]

    @property
    def mag_accepted(self):
        """True while the magnetometer measures the heading; False when its field is rejected, or there is none."""
        s = self._s
        return s[_GOOD] > 0 and s[_SINCE] < 16 and s[_WIDE_FOR] == 0

    @property
    def tilt_uncertainty_mdeg(self):
        """Sigma of the tilt about the worse horizontal axis, in millidegrees. For the main loop: it may allocate."""
        return _mdeg(max(self._s[_P], self._s[_P + 8]))

    @property
    def heading_uncertainty_mdeg(self):
        """Sigma of the heading, in millidegrees, no more than 46000. Six axes: since the start, which counts as 5000.

        For the main loop: it may allocate.
        """
        return _mdeg(self._s[_P + 15])

    # -- tick
    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        Where flags (word 10) has bit 0 clear (no fresh sample) the last gyro words go on, without feedback, and the
        clock of all that is estimated stands still. Bit 1: the magnetometer's words are fresh; any rate down to a tenth
        of the steps' will do. Bits 2 and 3 (full scale) change nothing: to leave such samples out would be worse.
        """
        state = self._s
        s = ptr32(state)
        c = ptr16(counts)
        k = 0
        if s[_PROBE] > 0:
            k = 32
        step = s[_G]
        fine = s[_GR]
        n = ((c[3] & 0xFFFF) ^ 0x8000) - 0x8000
        x = (s[_O] << k >> k) + n * step
        u = (s[_OR] << k >> k) + n * fine + s[_WR]
        m = ((c[4] & 0xFFFF) ^ 0x8000) - 0x8000
        y = (s[_O + 1] << k >> k) + m * step
        v = (s[_OR + 1] << k >> k) + m * fine + s[_WR + 1]
        o = ((c[5] & 0xFFFF) ^ 0x8000) - 0x8000
        z = (s[_O + 2] << k >> k) + o * step
        w = (s[_OR + 2] << k >> k) + o * fine + s[_WR + 2]
        fresh = c[10] & 1
        if fresh:
            s[_GS] = (s[_GS] << k >> k) + n
            s[_GS + 1] = (s[_GS + 1] << k >> k) + m
            s[_GS + 2] = (s[_GS + 2] << k >> k) + o
            if s[_PHASE] == 1:
                # the first step of a block: the last one's correction, from the earth into the body
                i = 0
                while i < 3:
                    n = s[_F + i] << k >> k
                    s[_F + i] = 0
                    m = (n + 16384) >> 15
                    n -= m << 15
                    o = s[_R + 3 * i] << k >> k
                    x += o * m + (o * n + 16384 >> 15)
                    o = s[_R + 3 * i + 1] << k >> k
                    y += o * m + (o * n + 16384 >> 15)
                    o = s[_R + 3 * i + 2] << k >> k
                    z += o * m + (o * n + 16384 >> 15)
                    i += 1
        s[_WR] = u & 32767
        s[_W] = x + (u >> 15)
        s[_WR + 1] = v & 32767
        s[_W + 1] = y + (v >> 15)
        s[_WR + 2] = w & 32767
        s[_W + 2] = z + (w >> 15)
        turn(state)
        if fresh:
            level(state, counts)
            if c[10] & 2 and s[_NINE]:
                gather(state, counts)
            n = s[_PHASE]
            s[_PHASE] = (n + 1) & s[_MASK]
            if n == 0:
                s[_STAGE] = 0
            o = s[_PER]
            n = s[_STAGE]
            while o and n < 8:
                work(state, n)
                n += 1
                o -= 1
            s[_STAGE] = n


# the registry's names
class QuaternionKalman6(QuaternionKalman):
    """QuaternionKalman without a magnetometer."""

    NAME = "quaternion-kalman6"
    AXES = 6

    update = QuaternionKalman.update  # see attitude.py

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        QuaternionKalman.__init__(self, rate, gyro_scale, accel_lsb_per_g, 6, **parameters)


class QuaternionKalman9(QuaternionKalman):
    """QuaternionKalman with everything."""

    update = QuaternionKalman.update  # see attitude.py

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        QuaternionKalman.__init__(self, rate, gyro_scale, accel_lsb_per_g, 9, **parameters)


# ----------------------------------------------------------------------------- set-up: allocates
# name: (default, least, most)
PARAMETERS = {
    "gyro_noise": (0.043, 0.001, 1),
    "bias_walk": (0.0033, 0, 0.1),
    "scale_error": (0.007, 0, 0.02),
    "accel_noise": (0.1, 0.02, 1),
    "velocity_noise": (1.1, 0.1, 2),
    "mag_noise": (0.15, 0.01, 0.2),
    "bias_start": (3.3, 0.5, 10),
    "bias_after": (5, 0, 60),
    "rest_noise": (0.03, 0.01, 1),
    "rest_gyro_dps": (2, 0.1, 10),
    "rest_accel_g": (0.05, 0.01, 0.1),
    "rest_after": (1.5, 0.2, 10),
    "field_tolerance": (0.2, 0.02, 0.7),
}


def _mdeg(variance):
    """The root of a variance in rad**2, Q30, in millidegrees."""
    return fixmath.ratio(fixmath.isqrt(variance << 20) * 57296, 1 << 25)


def _mantissa(num, den, bits):
    """(m, s) with num/den = m / 2**s and m of so many bits; s may not be negative."""
    s = 0
    while num and fixmath.ratio(num << (s + 1), den) < 1 << bits:
        s += 1
    return fixmath.ratio(num << s, den), s


def _block_of(num, den):
    """log2 of the steps of a block: at least 4 steps, 22 to 44 ms."""
    shift = 2
    while num >= 45 * den << shift:
        shift += 1
    return shift


def _set_up(s, rate, gyro_scale, lsb, parameters):
    """Turn rate, scales and parameters into the state's words, in integers throughout.

    Bounds: |W| < 1 rad with every axis of the gyro at full scale against a bias of 8192 counts and the largest
    corrections; blocks of 22 to 80 ms; every variance below 2**30.
    """
    p = {}
    for name in PARAMETERS:
        default, least, most = PARAMETERS[name]
        value = parameters.get(name, default)
        p[name] = fixmath.quantise(value, name)
        if not fixmath.quantise(least, "") <= p[name] <= fixmath.quantise(most, ""):
            raise ValueError("%s is %r, expected %r..%r" % (name, value, least, most))
    for name in parameters:
        if name not in p:
            raise TypeError("no parameter %r; there are %s" % (name, ", ".join(sorted(p))))
    ratio = fixmath.ratio
    num, den = rate
    scale, per = gyro_scale
    shift = _block_of(num, den)
    text = hertz(rate)
    if shift > 5 or num < 50 * den:
        raise ValueError("rate is %s, expected 50..1439 Hz" % text)
    t = den << shift  # a block lasts t / num s
    rad, degrees = fixmath.PI_NUM, 180 * fixmath.PI_DEN  # a degree

    def blocks(millionths, bits=0):
        return ratio(millionths * num << bits, _MILLION * t)

    def squared(value, of, power, bits):
        """(value / of)**2 (t / num)**power in units of 2**-bits."""
        if power < 0:
            return ratio((value * value << bits) * num**-power, of * of * t**-power)
        return ratio((value * value << bits) * t**power, of * of * num**power)

    def counts(millionths, units):
        """A rate in 1e-6 deg/s as gyro counts, times units."""
        return ratio(millionths * units * scale, _MILLION * per)

    step = ratio(fixmath.PI_NUM * den * per << 46, fixmath.PI_DEN * 360 * num * scale)
    bias_most = counts(25 * _MILLION, 1)
    turn_most = ((step * (32768 + 8192 + bias_most)) >> 15) * 17321 // 10000
    if turn_most + _FOLD_W > _W_MAX or step < 1 << 17:
        raise ValueError(
            "rate is %s, expected %d..%d Hz at %d/%d LSB per deg/s: choose another rate or gyro range"
            % (
                text,
                max(50, -(-turn_most * num // (den * (_W_MAX - _FOLD_W)))),
                min(1439, (step * num // den) >> 17),
                scale,
                per,
            )
        )
    if counts(p["rest_gyro_dps"], 1) > 2000:
        raise ValueError("gyro_scale is %d/%d, too fine for rest_gyro_dps" % gyro_scale)
    s[_G] = step >> 15
    s[_GR] = step & 32767
    s[_STAGE] = 8
    s[_PER] = 2 if shift == 2 else 1
    s[_BLOCK] = shift
    s[_MASK] = (1 << shift) - 1
    s[_PHASE] = 1  # the first block is a whole one
    s[_HG], s[_HG_SHIFT] = _mantissa(1 << 11, lsb << shift, 14)
    if p["bias_walk"] * 20 > p["bias_start"]:
        raise ValueError(
            "bias_walk is %r, expected no more than 1/20 of bias_start" % (parameters["bias_walk"],)
            if "bias_walk" in parameters
            else "bias_start is %r, expected at least 20 times bias_walk"
            % (parameters["bias_start"],)
        )
    # the bias: 2**-c rad a block
    c = 16
    while squared(p["bias_start"] * rad, _MILLION * degrees, 2, 2 * c + 2) <= _SIGMA**2:
        c += 1
    s[_C] = c - 15
    s[_B_SHIFT] = c + shift - 20
    s[_BS] = squared(p["bias_start"] * rad, _MILLION * degrees, 2, 2 * c)
    most = p["bias_start"] * 5 * rad * t << (c + 9)  # 2.5 sigma
    s[_B_MOST] = min((1 << 30) - 1, ratio(most, _MILLION * degrees * num))
    s[_AFTER] = blocks(p["bias_after"])
    # noise of a block
    s[_QT] = squared(p["gyro_noise"] * rad, _MILLION * degrees, 1, 46)
    s[_QB] = squared(p["bias_walk"] * rad, _MILLION * degrees, 3, 2 * c + 12)
    value = p["scale_error"] * rad * per
    s[_QS], s[_QS_SHIFT] = _mantissa(
        (value * value << 34) * t, (_MILLION * degrees * scale) ** 2 * num, 15
    )
    # variances of measurements, / 16
    s[_RA] = squared(p["accel_noise"], _MILLION, 0, 26)
    s[_RV] = squared(p["velocity_noise"] * 100000, _MILLION * 980665, -3, 16)
    s[_RM] = squared(p["mag_noise"], _MILLION, -1, 26)
    r = ratio(squared(p["rest_noise"] * rad, _MILLION * degrees, 1, 2 * c), 48)
    s[_RR] = min(max(r, 256), 1 << 29)
    s[_V0] = squared(5, 100, -2, 20)
    # rest
    s[_REST_K] = ratio(t << 17, num + 4 * t)  # T / (1/4 + T), Q15
    s[_REST_AFTER] = max(1, blocks(p["rest_after"]))
    s[_REST_GYRO] = counts(p["rest_gyro_dps"], 8) ** 2
    s[_REST_ACCEL] = ratio(p["rest_accel_g"] * 8 * lsb, _MILLION) ** 2
    s[_REST_MOST] = counts(p["bias_start"] * 5 // 2, 4096)
    s[_REST_OFF] = ratio(rad * t << (c + 9), degrees * num)
    s[_KNOWN] = squared(rad, 10 * degrees, 2, 2 * c)
    s[_CB], s[_CB_SHIFT] = _mantissa((rad * per * t) << (c + 10), (degrees * scale * num) << 12, 15)
    s[_WIDE_MOST] = max(1, blocks(400000))
    s[_LOST_MOST] = blocks(_MILLION)
    # field
    s[_FIELD_AFTER] = max(1, blocks(300000))
    s[_TOL] = ratio(p["field_tolerance"] ** 2 << 14, _MILLION**2)
    s[_SMOOTH] = blocks(50000, 10)
    s[_TAU] = blocks(20 * _MILLION, 10)
    s[_TAU_FAR] = blocks(100 * _MILLION, 10)
    s[_TAU_0] = blocks(200000, 10)
    s[_FAR_MOST] = blocks(5 * _MILLION)
    s[_FIRST] = blocks(2 * _MILLION)
