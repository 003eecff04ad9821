# Kalman filters with steady gains in 32-bit integers: one for any angle or number, and one for the attitude, which
# learns the gyro's bias. Needs attitude.py, fixmath.py, complementary.py and the viper emitter. update() is made
# for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on every port.

from array import array

import micropython
from micropython import const

from upright import fixmath
from upright.attitude import hertz
from upright.complementary import Euler6, step

# the scalar filter's words
_GAIN = const(1)  # K, Q29 ...
_GAIN_REST = const(2)  # ... and its next 20 bits
_RATIO = const(3)  # Q/R, Q(29 - SHIFT) ...
_RATIO_REST = const(4)  # ... and its next 20 bits
_SHIFT = const(5)  # 2 + Q/R <= 2**SHIFT, 1..20
_SETTLED = const(6)  # 1: K has settled
_VALUE = const(7)  # the estimate ...
_VALUE_REST = const(8)  # ... and its next 29 bits
_TURN = const(9)  # units a turn, 0: does not wrap

_RANGE = const(1 << 29)

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_S = const(14)  # 3, Q29: their sines
_E = const(25)  # 2: roll and pitch error of this step: accelerometer less gyro
_K = const(27)  # the part of the error that is taken up: K / 2**(K_SHIFT + 14)
_K_SHIFT = const(28)  # 0..16
_G = const(29)  # angle per step of one gyro count
_GR = const(30)  # its last 15 bits, 0..32767
_B = const(34)  # 3: gyro bias that is set, angle per step
_BR = const(37)  # 3: its last 15 bits, 0..32767
_O = const(40)  # 3: what is added to the gyro: less the bias, set and learnt
_OR = const(43)  # 3: its last 15 bits, -65534..0
_I = const(46)  # 3: bias that was learnt, angle per step, 2**-(30 + I_SHIFT) turn
_IR = const(49)  # 3: its remainder, K2_SHIFT bits
_V = const(52)  # 3: the error as a turn of the body, its sign that of the gyro's bias
_K2 = const(55)  # bias per error = K2 / 2**(K2_SHIFT + 14) in the units of I
_K2_SHIFT = const(56)  # 1..29
_I_SHIFT = const(57)  # 0..15
_I_MAX = const(58)  # bound of |I|, below 2**30
_WORDS = const(59)
# -- end of the words

_LEAST_MANTISSA = const(64)  # a gain is held to better than 1 %
ONE = 1 << 100  # set-up computes gains with 100 bits behind the point


class KalmanFilter:
    """The scalar Kalman filter: a value that changes at random, measured with noise. Integers in, integers out.

    x     the first measurement, an int within +-2**29
    Q     variance of the change per step, in the unit's square; 0: x is a constant, and this is the running mean
    R     variance of a measurement, in the same unit; only Q/R matters: 0 or 1e-10..1e6
    turn  for an angle: units in a turn, 2..2**30; innovation and estimate wrap. The default is for millidegrees. None
          (or 0): no wrap

    With x known, P = R to begin with, and per measurement the five equations of the textbooks

        x' = x    P' = P + Q    K = P' / (P' + R)    x = x' + K (z - x')    P = (1 - K) P'

    P' / (P' + R) = K and (1 - K) P' = R P' / (P' + R) give P = K R; so with q = Q/R the gain has a recursion of its
    own, K <- (K + q) / (K + q + 1), and x + K (z - x) is all that is left. It settles at K = (sqrt(q**2 + 4 q) - q) / 2
    and is not computed any more. With the much-copied Q = 10 and R = 0.05 that is K = 0.995, from the first step on:
    the estimate is 99.5 % of the newest measurement, so it has no visible effect. Q = 0.001, R = 1 (K = 0.031) averages
    over 32.

    Use one object a signal. A widely copied C function keeps x and P in static variables: called for pitch, roll and
    yaw in turn, it filters each of them into the next.

    Raises TypeError for an argument that is not a number, ValueError with the range for one out of range.

    gain  K as an int, Q29;  K, P: floats, for hosts;  Q, R: as they were given
    """

    def __init__(self, x, Q, R, turn=360000):
        if isinstance(x, bool) or not isinstance(x, int):
            raise TypeError("x is %r, expected an int" % (x,))
        if not -_RANGE <= x <= _RANGE:
            raise ValueError("x is %r, expected an int within +-%d" % (x, _RANGE))
        turn = turn or 0
        if not isinstance(turn, int) or (turn and not 2 <= turn <= 1 << 30):
            raise ValueError("turn is %r, expected an int from 2 to %d, or None" % (turn, 1 << 30))
        q_num, q_den = _decimal(Q, "Q")
        r_num, r_den = _decimal(R, "R")
        if not r_num:
            raise ValueError("R is %r, expected a number above 0" % (R,))
        num, den = q_num * r_den, q_den * r_num
        if num and not den <= num * 10**10 <= den * 10**16:
            raise ValueError("Q / R is %r / %r, expected 0 or 1e-10..1e6" % (Q, R))
        shift = 1
        while num > ((1 << shift) - 2) * den:
            shift += 1
        ratio = fixmath.ratio(num << (49 - shift), den)
        if turn:
            x = (x + (turn >> 1)) % turn - (turn >> 1)
        self.Q = Q
        self.R = R
        self.state = array(
            "i", [-1, 1 << 29, 0, ratio >> 20, ratio & 0xFFFFF, shift, 0, x, 1 << 28, turn]
        )

    @micropython.viper
    def update(self, z: int) -> int:
        """Take the measurement z, an int within +-2**29; returns the estimate, from -turn/2 to below turn/2."""
        state = self.state
        s = ptr32(state)
        if s[_SETTLED] == 0:
            settle_gain(state)
        k = 0
        if s[_PROBE] > 0:
            k = 32
        x = s[_VALUE] << k >> k
        turn = s[_TURN]
        half = turn >> 1
        e = z - x
        if turn:
            e = (e + half) % turn - half
        h = (e + 16384) >> 15
        e -= h << 15
        n = s[_GAIN]
        g = (n + 16384) >> 15
        n -= g << 15
        m = h * n + e * g
        n = ((m & 16383) << 15) + e * n + s[_VALUE_REST]
        s[_VALUE_REST] = n & 0x1FFFFFFF
        x += (h * g << 1) + (m >> 14) + (n >> 29)
        if turn:
            x = (x + half) % turn - half
        s[_VALUE] = x
        return x

    @property
    def x(self):
        return self.state[_VALUE]

    @property
    def gain(self):
        return self.state[_GAIN]

    @property
    def K(self):
        return (self.state[_GAIN] * (1 << 20) + self.state[_GAIN_REST]) / (1 << 49)

    @property
    def P(self):
        return self.K * self.R


@micropython.viper
def settle_gain(s: ptr32):
    """One step of the scalar filter's gain: K = d / (1 + d) with d = K + Q/R, by long division, 49 bits.

    With K = 1e-5 a step changes it by 1e-10 of itself at most, so it needs these bits to converge. Once it does
    not change, it stays constant.
    """
    shift = s[_SHIFT]
    h = s[_GAIN]
    t = s[_GAIN_REST]
    n = ((h & ((1 << shift) - 1)) << (20 - shift)) + (t >> shift) + s[_RATIO_REST]
    a = (h >> shift) + s[_RATIO] + (n >> 20)
    n &= 0xFFFFF
    b = a + (0x20000000 >> shift)
    rest = n
    quotient = 0
    first = 0
    i = 0
    while i < 49:
        n <<= 1
        a = (a << 1) + (n >> 20)
        n &= 0xFFFFF
        quotient <<= 1
        if a > b or (a == b and n >= rest):
            a -= b
            n -= rest
            if n < 0:
                n += 0x100000
                a -= 1
            quotient += 1
        i += 1
        if i == 29:
            first = quotient
            quotient = 0
    if first == h and quotient == t:
        s[_SETTLED] = 1
    s[_GAIN] = first
    s[_GAIN_REST] = quotient


class Kalman6(Euler6):
    """Euler6 with a two-state Kalman filter per axis, angle and gyro bias: yaw by integration.

    All of Euler6 holds but tau. The gains are those at which the filter below settles; set-up computes them. A step is
    Euler6's, with a second gain for the bias.

    The model, for roll and pitch each: angle += (gyro - bias) dt + noise of variance q_angle dt, bias += noise of
    variance q_bias dt, and the accelerometer's angle has noise of variance r_angle.

    q_angle         deg**2 / s, the gyro's share of the angle's variance
    q_bias          (deg/s)**2 / s, random walk of the bias; 0: no bias is learnt
    r_angle         deg**2, of a single sample, so the gains depend on the rate; it includes motion: 0.1 g
                    is 6 deg
    bias_limit_dps  each axis of the bias that is learnt stays within +- this, deg/s, 0..250

    At a high rate, with n = r_angle dt, the gains come to c = sqrt(q_bias / n), 1/s**2, for the bias and to
    1/tau = sqrt(q_angle / n + 2 c) for the angle. The widespread code with Q_angle, Q_bias and R_measure has the same
    units, and its 0.001, 0.003 and 0.03 make tau 0.25 s at 200 Hz: any push tilts it, 12 deg in the mean of eight
    recorded trials. With these defaults it is 2.5 deg with the bias taken off and 4.9 with the raw gyro; tau is 9 s at
    200 Hz, and the bias follows in 80 s. A smaller q_bias is better where the bias is known, a larger one where not.

    What is learnt is the bias of the body's axes, not that of the angles' rates, so it stays right when the body turns.
    The errors of roll and pitch are taken as a turn about two horizontal axes, the forward one (times cos(pitch)) and
    the left one; the gyro is corrected by that, as the body sees it. Each angle's error and its bias then follow the
    model above at any attitude; the vertical part of the bias, which the accelerometer does not show, is not changed.

    Raises ValueError like Euler6, and for variances whose gains the numbers cannot hold.
    """

    NAME = "kalman6"

    def __init__(
        self,
        rate,
        gyro_scale,
        accel_lsb_per_g,
        q_angle=0.001,
        q_bias=2e-7,
        r_angle=20,
        bias_limit_dps=20,
    ):
        limit = self.prepare(rate, gyro_scale, accel_lsb_per_g, _WORDS, bias_limit_dps)
        s = self.state
        k1, k2 = steady_gains(self.rate, q_angle, q_bias, r_angle)
        pair = fixmath.mantissa(k1, ONE, 14, 30)
        # as fine as the limit (2**-45 turn) and the gain allow
        shift = 15
        while shift and (limit << shift >= 1 << 45 or k2 << (shift + 1) >= ONE):
            shift -= 1
        bias_pair = fixmath.mantissa(k2 << shift, ONE, 15, 43)
        s[_I_SHIFT] = shift
        s[_I_MAX] = limit << shift >> 15
        if (
            not pair
            or pair[0] < _LEAST_MANTISSA
            or not bias_pair
            or (k2 and bias_pair[0] < _LEAST_MANTISSA)
        ):
            raise ValueError(
                "q_angle %r, q_bias %r and r_angle %r make the gains %.3g and %.3g at %s, expected 6e-8..0.9999 for "
                "the angle, and 0 or %.3g..%.3g for the bias: choose other variances"
                % (
                    q_angle,
                    q_bias,
                    r_angle,
                    k1 / ONE,
                    k2 / ONE,
                    hertz(self.rate),
                    64 / (1 << (43 + shift)),
                    16383 / (1 << (15 + shift)),
                )
            )
        gain = (s[_G] << 15) + s[_GR]
        self._bias_scale = fixmath.scale(_I, 1 << 23, gain << shift)
        s[_K] = pair[0]
        s[_K_SHIFT] = pair[1] - 14
        s[_K2] = bias_pair[0]
        s[_K2_SHIFT] = bias_pair[1] - 14

    def set_bias(self, x, y, z, known_s=0):
        """Euler6.set_bias; what is learnt afterwards is added to it."""
        Euler6.set_bias(self, x, y, z, known_s)
        for i in range(3):
            self.state[_I + i] = self.state[_IR + i] = 0

    def bias(self, out):
        """The gyro's bias, set and learnt, in 1/256 of a gyro count: out[0..2]. Allocates nothing."""
        for i in range(3):
            out[i] = self.bias_set[i]
        fixmath.add_scaled(self.state, out, self._bias_scale)

    def bias_mdps(self, out):
        """The gyro's bias, set and learnt, in millidegrees/s: out[0..2]. For the main loop: it may allocate."""
        Euler6.bias_mdps(self, out)
        s = self.state
        num, den = self.rate
        for i in range(3):
            out[i] += fixmath.ratio(s[_I + i] * 360000 * num, den << (30 + s[_I_SHIFT]))

    @property
    def gains(self):
        """The gains that are held, as floats for hosts: angle per angle, and bias per angle in 1/s."""
        s = self.state
        num, den = self.rate
        k2 = s[_K2] / (1 << (s[_K2_SHIFT] + 14 + s[_I_SHIFT]))
        return s[_K] / (1 << (s[_K_SHIFT] + 14)), k2 * num / den

    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        The accelerometer is left out, and the bias stands still, when flags (word 10) has bit 0 clear (no fresh sample:
        the last gyro words go on) or bit 2 set (accelerometer at full scale), and below 1/16 g.
        """
        state = self.state
        if int(step(state, counts)):
            learn_bias(state)


@micropython.viper
def learn_bias(s: ptr32):
    """Take the errors E of a Kalman6's step into its bias."""
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # sines and cosines of roll and pitch (Q15) from those of their halves
    x = ((s[_S] << k >> k) + 8192) >> 14
    sr = x * (((s[_S + 3] << k >> k) + 8192) >> 14) >> 14
    cr = 32768 - (x * x >> 14)
    x = ((s[_S + 1] << k >> k) + 8192) >> 14
    sp = x * (((s[_S + 4] << k >> k) + 8192) >> 14) >> 14
    cp = 32768 - (x * x >> 14)
    # a turn by g about the forward axis (cp, sp sr, sp cr), and by n about the left one (0, cr, -sr)
    n = s[_E] << k >> k
    h = (n + 16384) >> 15
    n -= h << 15
    g = h * cp + (n * cp >> 15)
    h = (g + 16384) >> 15
    g -= h << 15
    s[_V] = 0 - h * cp - (g * cp >> 15)
    g = h * sp + (g * sp >> 15)
    n = s[_E + 1] << k >> k
    h = (g + 16384) >> 15
    g -= h << 15
    x = (n + 16384) >> 15
    n -= x << 15
    s[_V + 1] = 0 - h * sr - x * cr - ((g * sr + n * cr) >> 15)
    s[_V + 2] = x * sr - h * cr - ((g * cr - n * sr) >> 15)
    gain = s[_K2]
    shift = s[_K2_SHIFT]
    i_shift = s[_I_SHIFT]
    i_max = s[_I_MAX]
    i = 0
    while i < 3:
        n = s[_V + i] << k >> k
        h = (n + 8192) >> 14
        x = h * gain + (((n - (h << 14)) * gain + 8192) >> 14) + s[_IR + i]
        n = (s[_I + i] << k >> k) + (x >> shift)
        s[_IR + i] = x - (x >> shift << shift)
        if n > i_max:
            n = i_max
        elif n < 0 - i_max:
            n = 0 - i_max
        s[_I + i] = n
        x = n >> i_shift
        s[_O + i] = 0 - x - (s[_B + i] << k >> k)
        s[_OR + i] = 0 - ((n - (x << i_shift)) << 15 >> i_shift) - s[_BR + i]
        i += 1


# ----------------------------------------------------------------------------- set-up: allocates
def steady_gains(rate, q_angle, q_bias, r_angle):
    """The gains at which Kalman6's model settles: (angle per angle, bias times dt per angle), both times 2**100.

    With the bias as an angle per step and r_angle as the unit, a = q_angle dt / r_angle and b = q_bias dt**3 / r_angle
    are the noises of a step. Written out, the Riccati equation of F = [[1, -1], [0, 1]], H = [1, 0] leaves, for the
    innovation's variance S = g**2 and y = g + 1/g, the quadratic y**2 - 4 = sqrt(b) y + a; the gains are 1 - 1/g**2 and
    sqrt(b) / g. In integers, so that every port computes the same.
    """
    num, den = rate
    parts = []
    for name, value in (("q_angle", q_angle), ("q_bias", q_bias), ("r_angle", r_angle)):
        parts.append(_decimal(value, name))
    (an, ad), (bn, bd), (rn, rd) = parts
    if not rn:
        raise ValueError("r_angle is %r, expected a number above 0" % (r_angle,))
    a = fixmath.ratio(an * rd * den << 100, ad * rn * num)
    root = fixmath.isqrt(fixmath.ratio(bn * rd * den**3 << 200, bd * rn * num**3))
    y = (root + fixmath.isqrt(root * root + (16 * ONE + 4 * a) * ONE)) >> 1
    g = (y + fixmath.isqrt((root * y + a * ONE))) >> 1
    return ONE - ONE * ONE * ONE // (g * g), root * ONE // g


def _decimal(value, name):
    """A number >= 0 as a ratio of ints, to six significant digits, which single-precision floats read alike."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("%s is %r, expected a number" % (name, value))
    if not (value == 0 or 1e-30 <= value <= 1e30):
        raise ValueError("%s is %r, expected 0 or a number from 1e-30 to 1e30" % (name, value))
    if isinstance(value, int) or value == 0:
        return int(value), 1
    k = 0
    while value * 10**k < 100000:
        k += 1
    if k:
        return int(value * 10**k + 0.5), 10**k
    while value / 10**k >= 1000000:
        k += 1
    return int(value / 10**k + 0.5) * 10**k, 1
