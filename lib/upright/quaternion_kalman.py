# The multiplicative quaternion Kalman filter in 32-bit integers: sensor counts in, quaternion out, with the gyro's bias
# and the variances of both. Needs fixmath.py, earth_kernels.py,
# quaternion_kernels.py and the viper emitter. update() is made for a hard interrupt: it allocates nothing, raises
# nothing, uses no float, and gives the same bits on every port.

import micropython
from micropython import const

from upright import fixmath
from upright.earth_kernels import MILLION, EarthFilter, compass, fine_mantissa, low_pass, to_earth
from upright.fixmath import turn
from upright.quaternion_kernels import (
    add_noise,
    after_tilt,
    carry_errors,
    contradicted,
    count_rest,
    forget,
    measure,
    measure_rest,
    ready_for_heading,
    spread_attitude,
    spread_bias,
    spread_velocity,
    take_sums,
    tilt_from_accel,
    weigh_field,
)

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)
_W = const(9)
_WR = const(12)
_G = const(15)
_GR = const(16)
_O = const(17)
_OR = const(20)
_TURN = const(23)
_R = const(26)
_FS = const(35)
_B = const(58)
_NINE = const(61)
_BLOCK = const(62)
_BLOCK_MASK = const(63)
_PHASE = const(64)
_DECIDED = const(65)
_GS = const(66)
_SINCE = const(73)
_J = const(74)
_IN = const(78)
_STILL = const(99)
_REST_AFTER = const(100)
_REST_MOST = const(104)
_AS = const(105)
_STAGE = const(108)
_PER = const(109)
_ML = const(125)
_X = const(129)
_V = const(137)
_P = const(139)
_UH = const(211)
_UE = const(212)
_UR = const(213)
_UM = const(214)
_OVER = const(215)
_MEANT = const(216)
_HG = const(218)
_HG_SHIFT = const(219)
_C = const(220)
_B_SHIFT = const(221)
_B_MOST = const(222)
_QT = const(223)
_QB = const(225)
_QS = const(227)
_QS_SHIFT = const(228)
_BS = const(229)
_RV = const(230)
_RM = const(231)
_RR = const(232)
_RA = const(233)
_V0 = const(234)
_AXIS = const(235)
_Z = const(236)
_REST_OFF = const(239)
_KNOWN = const(240)
_CB = const(241)
_CB_SHIFT = const(242)
_WIDE_FOR = const(243)
_WIDE_MOST = const(244)
_LOST = const(245)
_LOST_MOST = const(246)
_FAR = const(254)
_FIELD_AFTER = const(255)
_TOL = const(256)
_SMOOTH = const(257)
_TAU = const(258)
_TAU_FAR = const(259)
_TAU_0 = const(260)
_FAR_MOST = const(261)
_GOOD = const(262)
_FIRST = const(263)
_YOUNG = const(265)
_AFTER = const(266)
_WAIT = const(267)
_CLIP = const(268)
_RP = const(269)
_WORDS = const(271)
# -- end of the words

_PI28 = const(105414357 << 3)  # quaternion_kernels' pi, Q25
_OPEN = const(603979776)  # quaternion_kernels.OPEN
_WIDE = const(8)
_RUNAWAY = const(16)
_UPSET = const(128)
_NOT_BY_MAG = const(0xC3)  # tilt and velocity
_ADOPT = const(512)
_TILTED = const(1024)
_BIAS = const(0x38)
_FOLD_W = const(651000000)  # half of sqrt(3) 0.35 rad, Q31
_SEEDED = const(47099587)  # (12 deg)**2, Q30: of an attitude from one sample
_HEADING_START = const(8177247)  # (5 deg)**2: of a heading that is relative
_BIAS_MOST = const(25)  # deg/s: largest learnt bias
_FINEST = const(800000)  # 1e-6 deg/s: B holds 25 deg/s in the unit of this first sigma
_PRIOR = const(10)  # deg/s per root Hz: of the bias being 0, with six axes
_SIGMA = const(26000)  # first sigma of the bias in P's units, no more


@micropython.viper
def measure_bias(state):
    """One axis of the gyro's bias: from rest; or, with six axes and now and then, that it is near 0."""
    s = ptr32(state)
    j = s[_AXIS] + 1
    if j == 48:
        j = 0
    s[_AXIS] = j
    i = j % 3
    s[_UH] = 3 + i
    s[_UM] = 0
    if s[_STILL] == s[_REST_AFTER]:
        j = int(contradicted(state, i))
        if j & _ADOPT:
            # it is taken over as it is: an innovation would be bounded
            forget(state, 3 + i, s[_BS])
            s[_B + i] = s[_Z + i]
            s[_UE] = 0
        if j & _TILTED:
            forget(state, 0, _OPEN)
            forget(state, 1, _OPEN)
        s[_UR] = s[_RR]
        measure(state)
    elif j < 3 and s[_NINE] == 0:
        # without a heading nothing shows the vertical bias but rest: it stays near 0
        s[_UE] = 0 - s[_B + i]
        s[_UR] = s[_RP]
        measure(state)


@micropython.viper
def work(state, n: int):
    """Piece n of a block's work, 0..7; it is done while the next block is measured."""
    s = ptr32(state)
    if n == 0:
        take_sums(state)
        carry_errors(state)
    elif n == 1:
        spread_bias(state)
        if s[_NINE]:
            compass(state, _ML, _PI28)
    elif n == 2:
        spread_attitude(state)
        spread_velocity(state)
        add_noise(state)
    elif n == 3:
        if s[_YOUNG]:
            s[_YOUNG] -= 1
        low_pass(state, _IN + 3)
        count_rest(state, int(measure_rest(state)))
        if s[_DECIDED] & _UPSET:
            forget(state, 0, _OPEN)
            forget(state, 1, _OPEN)
        if s[_NINE]:
            if s[_WIDE_FOR]:
                s[_J] = 0  # no heading without the vertical
            elif s[_J]:
                weigh_field(state)
    elif n == 7:
        measure_bias(state)
    elif n == 6:
        if s[_NINE]:
            i = int(ready_for_heading(state))
            if i:
                if i > 1:
                    forget(state, 2, _OPEN)
                s[_UH] = 2
                s[_UM] = _NOT_BY_MAG
                if s[_YOUNG]:
                    s[_UM] |= _BIAS
                measure(state)
    else:
        if n == 4:
            tilt_from_accel(state)
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
        measure(state)
        m = s[_OVER]
        if n == 4:
            s[_DECIDED] = (s[_DECIDED] | _RUNAWAY) ^ _RUNAWAY
        if m:
            s[_DECIDED] |= _RUNAWAY
        if n == 5:
            i = int(after_tilt(state))
            if i == 1:
                forget(state, 0, _OPEN)
                forget(state, 1, _OPEN)
            elif i == 2:
                forget(state, 6, s[_V0])
                forget(state, 7, s[_V0])


class QuaternionKalman9(EarthFilter):
    """Attitude and gyro bias from gyro, accelerometer and magnetometer: an error-state Kalman filter of 8 states.

    The attitude is the quaternion, turned by every gyro sample; the filter estimates its error as a small rotation
    vector, and corrects by multiplication (E. J. Lefferts, F. L. Markley, M. D. Shuster, Kalman Filtering for
    Spacecraft Attitude Estimation, JGCD 5(5), 1982). The error is that in the earth frame (right-invariant: A. Barrau,
    S. Bonnabel, IEEE TAC 62(4), 2017), where gravity and north stand still, so that the measurements are constant.

    An accelerometer measures motion as well as gravity. Velocities stay small, so the specific force is turned into
    the earth frame and integrated, and the measurement is a horizontal velocity of 0, within velocity_noise. Swings
    and shakes cancel; a tilt error makes the velocity grow.

    The magnetometer measures the heading, and corrects only heading and bias (Schmidt's form): a magnet cannot tilt
    the attitude. Its noise grows with the distance of the field (horizontal and vertical part) from a slowly tracked
    reference, and beyond field_tolerance it is left out. At rest the averaged gyro measures the bias. Innovations are
    bounded by 5 sigma. If that lasts, the variance is increased, so a wrong start is forgotten. Raw counts are enough,
    with one set of parameters.

    The covariance is propagated once a block of 22 to 44 ms. The work is spread over the steps of the next block.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767

    parameters        by name, see PARAMETERS; taken to six significant digits

    Limits: a very long push (0.3 g for 10 s) is taken for a tilt. A turn that the gyro has not measured is corrected at
    once at rest, but takes up to 15 s in motion. A steady rotation from power-on, up to 25 deg/s, looks like a bias and
    is taken for one. Later a rest that contradicts a known bias by more than 0.3 deg/s is adopted after 1.5 s
    (rest_after) if the new value is nearer to 0, else after 8 times that, and not at all beyond 2.4 deg/s; with a good
    field only if the heading is off by more than 3 deg. With six axes a turn of less than that is taken for a bias.

    Raises ValueError for a rate, scale or parameter that the numbers cannot hold, with the range that they can:
    60 to 1439 Hz at +-2000 deg/s, from 50 Hz on at +-1000 deg/s and less.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "quaternion-kalman9"
    AXES = 9
    BLOCKS_HZ = 45  # a block takes 22 to 44 ms
    LEAST_HZ = 50
    # name: (default, least, most)
    # fmt: off
    PARAMETERS = {
        "gyro_noise": (0.043, 0.001, 1),  # random walk of the attitude, vibration included, deg/s per root Hz
        "bias_walk": (0.0033, 0, 0.1),  # random walk of the bias, deg/s per root s, no more than bias_start / 20
        # gyro noise that grows with the rate of turn: so many times the rate per root Hz; a quarter of it about the
        # vertical
        "scale_error": (0.007, 0, 0.02),
        # of the tilt from one block of the accelerometer, g, where so little is known of the tilt (15 deg) that it is
        # believed as it is
        "accel_noise": (0.1, 0.02, 1),
        "velocity_noise": (1.1, 0.1, 2),  # m/s per root Hz
        "mag_noise": (0.15, 0.01, 0.2),  # of the heading, rad per root Hz
        # first sigma of the bias (on top of set_bias), deg/s
        "bias_start": (3.3, 0.5, 10),
        # before this time only rest shows the bias, s: after a start in motion the corrections are those of a wrong
        # attitude, not of a bias
        "bias_after": (5, 0, 60),
        "rest_noise": (0.03, 0.01, 1),  # of the averaged gyro at rest, deg/s per root Hz
        "rest_gyro_dps": (2, 0.1, 10),  # at rest the gyro's mean of a block stays this near to its average, deg/s
        "rest_accel_g": (0.05, 0.01, 0.1),  # and the accelerometer's this near to its own, g
        "rest_after": (1.5, 0.2, 10),  # for this long, s
        "field_tolerance": (0.2, 0.02, 0.7),  # a field that differs by less is the reference's, as a part of it
    }
    # fmt: on

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        EarthFilter.__init__(self, rate, gyro_scale, accel_lsb_per_g, _WORDS, parameters)

    # -- set-up and main loop: allocates
    def bounds(self, p):
        return _BIAS_MOST * MILLION, _FOLD_W

    def set_up(self, p, given):
        # every variance stays below 2**30
        s, lsb = self.state, self.accel_lsb_per_g
        blocks, counts, ratio = self.blocks, self.gyro_counts, fixmath.ratio
        num, den = self.rate
        scale, per = self.gyro_scale
        shift = s[_BLOCK]
        t = den << shift  # a block lasts t / num s
        rad, degrees = fixmath.PI_NUM, 180 * fixmath.PI_DEN  # a degree

        def squared(value, of, power, bits):
            """(value / of)**2 (t / num)**power in units of 2**-bits."""
            if power < 0:
                return ratio((value * value << bits) * num**-power, of * of * t**-power)
            return ratio((value * value << bits) * t**power, of * of * num**power)

        s[_STAGE] = 8
        s[_PER] = 2 if shift == 2 else 1
        s[_HG], s[_HG_SHIFT] = fine_mantissa(1 << 11, lsb << shift, 14)
        if p["bias_walk"] * 20 > p["bias_start"]:
            raise ValueError(
                "bias_walk is %r, expected no more than 1/20 of bias_start" % (given["bias_walk"],)
                if "bias_walk" in given
                else "bias_start is %r, expected at least 20 times bias_walk"
                % (given["bias_start"],)
            )
        # the bias: 2**-c rad a block
        c = 16
        most = max(p["bias_start"], _FINEST)
        while squared(most * rad, MILLION * degrees, 2, 2 * c + 2) <= _SIGMA**2:
            c += 1
        s[_C] = c - 15
        s[_B_SHIFT] = c + shift - 20
        s[_BS] = squared(p["bias_start"] * rad, MILLION * degrees, 2, 2 * c)
        s[_B_MOST] = ratio(_BIAS_MOST * rad * t << (c + 10), degrees * num)
        s[_AFTER] = blocks(p["bias_after"])
        # noise of a block
        s[_QT] = squared(p["gyro_noise"] * rad, MILLION * degrees, 1, 46)
        s[_QB] = squared(p["bias_walk"] * rad, MILLION * degrees, 3, 2 * c + 12)
        value = p["scale_error"] * rad * per
        s[_QS], s[_QS_SHIFT] = fine_mantissa(
            (value * value << 34) * t, (MILLION * degrees * scale) ** 2 * num, 15
        )
        if not 15 <= s[_QS_SHIFT] <= 46:  # scale_error is 0, or as good as that
            s[_QS], s[_QS_SHIFT] = 0, 15
        # variances of measurements, / 16
        s[_RA] = squared(p["accel_noise"], MILLION, 0, 26)
        s[_RV] = squared(p["velocity_noise"] * 100000, MILLION * 980665, -3, 16)
        s[_RM] = squared(p["mag_noise"], MILLION, -1, 26)
        r = ratio(squared(p["rest_noise"] * rad, MILLION * degrees, 1, 2 * c), 48)
        s[_RR] = min(max(r, 256), 1 << 29)
        r = ratio(squared(_PRIOR * rad, degrees, 1, 2 * c), 16 * 48)
        s[_RP] = min(max(r, 256), 1 << 29)
        s[_V0] = squared(5, 100, -2, 20)
        # rest
        s[_REST_MOST] = counts(_BIAS_MOST * MILLION, 4096)
        s[_REST_OFF] = ratio(3 * rad * t << (c + 10), 10 * degrees * num)
        s[_KNOWN] = squared(rad, 10 * degrees, 2, 2 * c)
        s[_CB], s[_CB_SHIFT] = fine_mantissa(
            (rad * per * t) << (c + 10), (degrees * scale * num) << 12, 15
        )
        s[_WIDE_MOST] = max(1, blocks(400000))
        s[_LOST_MOST] = blocks(MILLION)
        # field
        s[_FIELD_AFTER] = max(1, blocks(300000))
        s[_TOL] = ratio(p["field_tolerance"] ** 2 << 14, MILLION**2)
        s[_SMOOTH] = blocks(50000, 10)
        s[_TAU] = blocks(20 * MILLION, 10)
        s[_TAU_FAR] = blocks(100 * MILLION, 10)
        s[_TAU_0] = blocks(200000, 10)
        s[_FAR_MOST] = blocks(5 * MILLION)
        s[_FIRST] = blocks(2 * MILLION)

    def start_at(self, q, known=0):
        EarthFilter.start_at(self, q)
        s = self.state
        for first, n in ((_FS, 3), (_AS, 3), (_GS, 3), (_X, 8), (_V, 2)):
            for i in range(n):
                s[first + i] = 0
        for i in (_WIDE_FOR, _LOST, _FAR, _CLIP):
            s[i] = 0
        s[_YOUNG] = s[_AFTER]
        s[_STAGE] = 8  # the block in work belongs to the old attitude
        s[_PHASE] = 1
        tilt = _SEEDED if known else _OPEN
        self._open(0, tilt)
        self._open(1, tilt)
        self._open(2, (_SEEDED if known == 2 else _OPEN) if s[_NINE] else _HEADING_START)
        self._open(6, s[_V0])
        self._open(7, s[_V0])

    def _open(self, i, variance):
        """forget, for variances of more than 30 bits."""
        forget(self.state, i, 0)
        self.state[_P + (0, 8, 15, 21, 26, 30, 33, 35)[i]] = variance

    def bias_is_new(self, known_s):
        s = self.state
        first = s[_BS]
        # rest measures each axis every third block, with 16 RR
        num, den = self.rate
        rests = fixmath.ratio(int(known_s * 1000) * num, 3000 * den << s[_BLOCK])
        variance = max(16, fixmath.ratio(16 * first * s[_RR], 16 * s[_RR] + first * rests))
        for i in range(3):
            self._open(3 + i, variance)
        s[_WAIT] = 0

    @property
    def bias_unit(self):
        num, den = self.rate
        scale, per = self.gyro_scale
        unit = 1 << (self.state[_C] + 25 + self.state[_BLOCK])
        return 180 * fixmath.PI_DEN * num * scale, unit * fixmath.PI_NUM * den * per

    @property
    def mag_accepted(self):
        """True while the magnetometer measures the heading; False if its field is rejected or absent."""
        s = self.state
        return s[_GOOD] > 0 and s[_SINCE] < 16 and s[_WIDE_FOR] == 0

    @property
    def tilt_uncertainty_mdeg(self):
        """Sigma of the tilt about the worse horizontal axis, in millidegrees. For the main loop: it may allocate."""
        return _mdeg(max(self.state[_P], self.state[_P + 8]))

    @property
    def heading_uncertainty_mdeg(self):
        """Sigma of the heading, in millidegrees, no more than 46000. Six axes: since the start, which counts as 5000.

        For the main loop: it may allocate.
        """
        return _mdeg(self.state[_P + 15])

    # -- tick
    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        With bit 0 of flags (word 10) clear (no fresh sample) the filter turns with the last gyro words, without
        feedback, and all estimates stay unchanged. Bit 1: the magnetometer's words are fresh; its rate may be as low as
        a tenth of the steps'. Bit 2 (accelerometer at full scale): the sample counts once the axis has come back,
        see earth_kernels.believe_later(). Bit 3 (gyro): the variances grow by what may be missing.
        """
        state = self.state
        s = ptr32(state)
        c = ptr16(counts)
        k = 0
        if s[_PROBE] > 0:
            k = 32
        # W = (gyro - bias) dt / 2
        gain = s[_G]
        fine = s[_GR]
        n = ((c[3] & 0xFFFF) ^ 0x8000) - 0x8000
        x = (s[_O] << k >> k) + n * gain
        u = (s[_OR] << k >> k) + n * fine + s[_WR]
        m = ((c[4] & 0xFFFF) ^ 0x8000) - 0x8000
        y = (s[_O + 1] << k >> k) + m * gain
        v = (s[_OR + 1] << k >> k) + m * fine + s[_WR + 1]
        o = ((c[5] & 0xFFFF) ^ 0x8000) - 0x8000
        z = (s[_O + 2] << k >> k) + o * gain
        w = (s[_OR + 2] << k >> k) + o * fine + s[_WR + 2]
        fresh = c[10] & 1
        if fresh:
            if c[10] & 8 and s[_CLIP] < 100:
                s[_CLIP] += 1
            s[_GS] = (s[_GS] << k >> k) + n
            s[_GS + 1] = (s[_GS + 1] << k >> k) + m
            s[_GS + 2] = (s[_GS + 2] << k >> k) + o
            if s[_PHASE] == 1:
                # the first step of a block: + R' TURN, the last correction, from the earth into the body
                i = 0
                r = _R
                while i < 3:
                    n = s[_TURN + i] << k >> k
                    s[_TURN + i] = 0
                    m = (n + 16384) >> 15
                    n -= m << 15
                    o = s[r] << k >> k
                    x += o * m + (o * n + 16384 >> 15)
                    o = s[r + 1] << k >> k
                    y += o * m + (o * n + 16384 >> 15)
                    o = s[r + 2] << k >> k
                    z += o * m + (o * n + 16384 >> 15)
                    r += 3
                    i += 1
        s[_WR] = u & 32767
        s[_W] = x + (u >> 15)
        s[_WR + 1] = v & 32767
        s[_W + 1] = y + (v >> 15)
        s[_WR + 2] = w & 32767
        s[_W + 2] = z + (w >> 15)
        turn(state)
        if fresh:
            to_earth(state, counts)
            n = ((c[0] & 0xFFFF) ^ 0x8000) - 0x8000
            s[_AS] = (s[_AS] << k >> k) + n
            n = ((c[1] & 0xFFFF) ^ 0x8000) - 0x8000
            s[_AS + 1] = (s[_AS + 1] << k >> k) + n
            n = ((c[2] & 0xFFFF) ^ 0x8000) - 0x8000
            s[_AS + 2] = (s[_AS + 2] << k >> k) + n
            n = s[_PHASE]
            s[_PHASE] = (n + 1) & s[_BLOCK_MASK]
            if n == 0:
                s[_STAGE] = 0
            i = s[_PER]
            n = s[_STAGE]
            while i and n < 8:
                work(state, n)
                n += 1
                i -= 1
            s[_STAGE] = n


class QuaternionKalman6(QuaternionKalman9):
    """QuaternionKalman9 without a magnetometer: the heading is relative to the start."""

    NAME = "quaternion-kalman6"
    AXES = 6

    update = QuaternionKalman9.update  # see attitude.py


# ----------------------------------------------------------------------------- set-up: allocates
def _mdeg(variance):
    """The root of a variance in rad**2, Q30, in millidegrees."""
    return fixmath.ratio(fixmath.isqrt(variance << 20) * 57296, 1 << 25)
