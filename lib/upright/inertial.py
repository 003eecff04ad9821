# The inertial-frame Mahony filter in 32-bit integers: sensor counts in, quaternion out, with its own gyro bias and its
# own judgement of the magnetic field. Needs attitude.py, fixmath.py, inertial_kernels.py and the viper emitter.
# update() is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on
# every port.

import micropython
from micropython import const

from upright import fixmath, inertial_kernels
from upright.attitude import Attitude, bias_of, hertz
from upright.fixmath import turn
from upright.inertial_kernels import (
    compass,
    field,
    gather,
    inform,
    judge,
    lean,
    learn,
    level,
    ramp,
    regress,
    rest,
    steer,
)

# the words of the state that are used here: see inertial_kernels.py
_PROBE = const(0)
_Q = const(1)
_QR = const(5)
_W = const(9)
_WR = const(12)
_G = const(15)
_GR = const(16)
_O = const(17)
_OR = const(20)
_CE = const(23)
_R = const(26)
_S = const(35)
_N = const(44)
_N_RAMP = const(45)
_N_LATE = const(46)
_RAMP = const(47)
_K_END = const(48)
_K_END_SHIFT = const(49)
_NORM = const(50)
_G1 = const(51)
_LI = const(52)
_OM_GAIN = const(53)
_BLOCK = const(54)
_X = const(56)
_OM = const(72)
_GS = const(73)
_LOW1 = const(76)
_LOW2 = const(82)
_BASE = const(88)
_B = const(91)
_J = const(94)
_II = const(97)
_STILL = const(101)
_REST_AFTER = const(102)
_REST_K = const(103)
_REST_GYRO = const(104)
_REST_ACCEL = const(105)
_REST_MOST = const(106)
_REST_OFF = const(107)
_J_KNOWN = const(108)
_UPSET = const(109)
_B_SHIFT = const(110)
_B_MAX = const(111)
_CC = const(112)
_CC_SHIFT = const(113)
_CE_MAX = const(114)
_J_DECAY = const(115)
_RATE_T = const(116)
_J_LEAST = const(117)
_MS = const(118)
_SINCE = const(122)
_J_MAG = const(123)
_REJECTED = const(136)
_WEIGHT = const(137)
_TOL = const(138)
_SMOOTH = const(139)
_REF = const(140)
_FIELD_AFTER = const(141)
_FIELD_FIRST = const(142)
_FIELD_NEW = const(143)
_REJECT_FOR = const(144)
_TURNING_MIN = const(145)
_AGREE = const(146)
_HN = const(147)
_LOST = const(148)
_FAR_MIN = const(149)
_RESTART_AFTER = const(150)
_HRAMP = const(151)
_HK = const(152)
_LIMIT_AFTER = const(153)
_HK_DOUBT = const(179)
_PUSH = const(154)
_ZK = const(155)
_PUSH_MAX = const(156)
_HC = const(157)
_HC_SHIFT = const(158)
_DOUBT = const(159)
_DOUBT_RATE = const(160)
_LITE = const(161)
_LATE = const(162)
_C = const(163)
_U = const(166)
_O_BASE = const(169)
_OR_BASE = const(172)
_N_END = const(175)
_PHASE = const(176)
_BLOCK_MASK = const(177)
_NINE = const(178)
_GAP = const(180)
_OUTAGE = const(181)

_W_MAX = const((1 << 31) - (1 << 16))  # 1 rad in Q31, less what fixmath.turn adds for rounding
_MILLION = const(1000000)


class InertialMahony(Attitude):
    """Attitude from gyro, accelerometer and magnetometer: Mahony's filter with its error averaged in the earth frame.

    After R. Mahony, T. Hamel, J.-M. Pflimlin, IEEE TAC 53(5), 2008, with the acceleration low-passed in the earth
    frame (an idea of VQF: D. Laidig, T. Seel, Information Fusion 91, 2023), so that swings and shakes cancel before
    they count as tilt. The gyro bias is estimated at rest and in motion, with a gain that falls as knowledge grows. The
    magnetometer turns the heading alone, by a bounded rate, and only while the field looks like the usual one. Raw
    counts will do: no calibration before, one set of parameters.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767
    axes              9, or 6: the magnetometer is ignored, heading is relative to the start
    lite              True: no rejection of fields, no restart of the heading

    Times in s, angles in rad, all taken to six significant digits:

    tau_tilt        3      time constant of the tilt correction, 0.5..30
    tau_heading     10     the same for the heading, 1..100
    tau_doubt       2      the same while nothing is known of the vertical bias; with knowledge it grows, 1..100
    ramp_tilt       0.5    at the start the time constants are this times the time since, in 1/256, 0.1..4
    ramp_heading    0.75
    bias_after      5      no bias estimation in motion before this time, 0..60
    bias_limit_dps  6      a bias is no larger than this (on top of set_bias), deg/s, 0.5..25
    rest_gyro_dps   2      at rest the gyro stays this near to its average, deg/s, 0.1..10
    rest_accel_g    0.051  and the accelerometer this near to its own, g, 0.01..0.1
    rest_after      1.5    for this long, 0.2..10
    rest_dps        0.5    a well-known bias does not change by more: a slow turn is not rest, deg/s, 0.05..5
    upset_g         0.25   a tilt error at rest, as its sine, that restarts the ramps, 0.1..2
    field_tolerance 0.2    a field that differs by less is that of the reference, as a part of it, 0.02..0.7
    field_after     0.3    for this long, 0..10
    field_tau       20     time constant with which the reference follows, 1..100
    field_first     5      a field that stays the same for this long is the first reference, 0..100
    field_new       20     the same for another one, counted while turning, 1..1000
    field_dps       20     turning: faster than this, deg/s, 1..30
    field_agree     0.5    a new reference's north is no further from the gyro's than this, rad, 0.05..3.14
    reject_for      60     rejected for longer, a field counts half, 0..1000
    restart_rad     0.55   a heading error that a good field does not explain, 0.1..3.14
    restart_after   5      restarts the heading's ramp when it lasts this long, 0.5..100
    outage          0.5    so long without a fresh sample restarts both ramps, 0.05..10

    A steady rotation from power-on on looks like a bias and is taken for one, up to bias_limit_dps. The first 1.5 s at
    rest settle it.

    Raises ValueError for a rate, scale or parameter that the numbers cannot hold, with the range that they can:
    82 to 1439 Hz at +-2000 deg/s, from 50 Hz on at +-1000 deg/s and less.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "inertial9"
    AXES = 9

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, axes=9, lite=False, **parameters):
        if axes not in (6, 9):
            raise ValueError("axes is %r, expected 6 or 9" % (axes,))
        self.AXES = axes
        self.NAME = "inertial%d" % axes + ("-lite" if lite else "")
        s = self._begin(rate, gyro_scale, accel_lsb_per_g, inertial_kernels.WORDS)
        s[_NINE] = int(axes == 9)
        s[_LITE] = int(bool(lite))
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
        if (
            self.AXES == 9
            and counts[10] & 2
            and (y * k != z * j or z * i != x * k or x * j != y * i)
        ):
            self._attitude(fixmath.level_north((x, y, z), (i, j, k)))
        else:
            self._attitude(fixmath.level(x, y, z))
        return True

    def _attitude(self, q):
        s = self._s
        for i in range(4):
            s[_Q + i] = q[i]
            s[_QR + i] = 16384
        for i in range(3):
            s[_WR + i] = 16384
        for first, n in ((_CE, 3), (_S, 5), (_X, 16), (_MS, 4), (_C, 3), (_U, 3)):
            for i in range(n):
                s[first + i] = 0
        for i in (_N, _LATE, _HN, _LOST, _SINCE, _J_MAG, _PUSH, _ZK, _GAP):
            s[i] = 0
        s[_S + 2] = self.accel_lsb_per_g << 14
        s[_OM] = 32768
        s[_DOUBT] = inertial_kernels.PI28 if s[_NINE] else 0

    def set_bias(self, x, y, z):
        """Set the gyro's bias, ints in 1/256 of a gyro count; what the filter learns from now on comes on top of it.

        Raises ValueError beyond +-8192 counts.
        """
        bias = bias_of(x, y, z)
        s = self._s
        gain = (s[_G] << 15) + s[_GR]
        for i in range(3):
            b = fixmath.ratio(bias[i] * gain, 256)
            change = (s[_BASE + i] - bias[i]) << 4
            s[_LOW1 + 3 + i] += change
            s[_LOW2 + 3 + i] += change
            s[_BASE + i] = bias[i]
            s[_O + i] = s[_O_BASE + i] = -(b >> 15)
            s[_OR + i] = s[_OR_BASE + i] = -(b & 32767)
            s[_B + i] = 0
            s[_J + i] = s[_J_LEAST]
            s[_II + i] = 1 << 20

    def bias(self, out):
        """The gyro's bias, set and learnt, in 1/256 of a gyro count: out[0..2]. For the main loop."""
        s = self._s
        for i in range(3):
            out[i] = s[_BASE + i] + fixmath.ratio(s[_B + i], 1 << (s[_B_SHIFT] - 8))

    def bias_mdps(self, out):
        """The gyro's bias, set and learnt, in millidegrees/s: out[0..2]. For the main loop: it may allocate."""
        num, den = self.gyro_scale
        s = self._s
        shift = s[_B_SHIFT]
        for i in range(3):
            b = (s[_BASE + i] << (shift - 8)) + s[_B + i]
            out[i] = fixmath.ratio(b * 1000 * den, num << shift)

    @property
    def resting(self):
        """True while the body is taken to be at rest: then the bias is what the gyro reads."""
        return self._s[_STILL] == self._s[_REST_AFTER]

    @property
    def mag_accepted(self):
        """True while the magnetometer turns the heading; False when its field is rejected, or there is none."""
        s = self._s
        return s[_WEIGHT] == 2 and s[_SINCE] < 16 and s[_HN] > 0

    @property
    def heading_uncertainty_mdeg(self):
        """How far the heading may be off, in millidegrees, roughly: 0..180000.

        The average distance from the magnetometer's heading while that is accepted; otherwise it grows with what is not
        known of the vertical axis's bias. Six axes: since the start.
        """
        return (self._s[_DOUBT] >> 15) * 7162 >> 10

    @property
    def tilt_confidence(self):
        """How much the accelerometer tells of the vertical, in 1/1000: 1000 at rest, less the harder the shaking."""
        return self._s[_OM] * 125 >> 12

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
        if fresh == 0:
            if s[_GAP] < s[_OUTAGE]:
                s[_GAP] += 1
        else:
            if s[_GAP]:
                if s[_GAP] == s[_OUTAGE]:  # too long to know where it has turned
                    s[_N] = 0
                    s[_HN] = 0
                s[_GAP] = 0
            s[_GS] = (s[_GS] << k >> k) + n
            s[_GS + 1] = (s[_GS + 1] << k >> k) + m
            s[_GS + 2] = (s[_GS + 2] << k >> k) + o
            # the last step's correction, from the earth into the body
            i = 0
            while i < 3:
                n = s[_CE + i] << k >> k
                m = (n + 16384) >> 15
                n -= m << 15
                o = s[_R + 3 * i] << k >> k
                x += o * m + (o * n + 16384 >> 15)
                o = s[_R + 3 * i + 1] << k >> k
                y += o * m + (o * n + 16384 >> 15)
                o = s[_R + 3 * i + 2] << k >> k
                z += o * m + (o * n + 16384 >> 15)
                i += 1
            s[_CE + 2] = 0
        s[_WR] = u & 32767
        s[_W] = x + (u >> 15)
        s[_WR + 1] = v & 32767
        s[_W + 1] = y + (v >> 15)
        s[_WR + 2] = w & 32767
        s[_W + 2] = z + (w >> 15)
        turn(state)
        if fresh:
            if s[_N] < s[_N_END]:
                ramp(state)
            level(state, counts)
            lean(state)
            if c[10] & 2 and s[_NINE]:
                gather(state, counts)
            i = s[_PHASE]
            s[_PHASE] = (i + 1) & s[_BLOCK_MASK]
            if i == 0:
                rest(state, counts)
            elif i == 1:
                regress(state)
            elif i == 2:
                compass(state)
            elif i == 3:
                if s[_J_MAG] and s[_LITE] == 0:
                    field(state, counts)
                    judge(state)
                if s[_BLOCK] == 2:  # a block of four steps: the rest of it as well
                    steer(state)
                    inform(state)
                    learn(state)
            elif i == 4:
                steer(state)
            elif i == 5:
                inform(state)
                learn(state)


# the registry's names
class Inertial6(InertialMahony):
    """InertialMahony without a magnetometer."""

    NAME = "inertial6"
    AXES = 6

    update = InertialMahony.update  # see attitude.py

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        InertialMahony.__init__(self, rate, gyro_scale, accel_lsb_per_g, 6, False, **parameters)


class Inertial9(InertialMahony):
    """InertialMahony with everything."""

    update = InertialMahony.update  # see attitude.py

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        InertialMahony.__init__(self, rate, gyro_scale, accel_lsb_per_g, 9, False, **parameters)


class Inertial9Lite(InertialMahony):
    """InertialMahony that takes every magnetic field as it is."""

    NAME = "inertial9-lite"

    update = InertialMahony.update  # see attitude.py

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        InertialMahony.__init__(self, rate, gyro_scale, accel_lsb_per_g, 9, True, **parameters)


# ----------------------------------------------------------------------------- set-up: allocates
# name: (default, least, most)
PARAMETERS = {
    "tau_tilt": (3, 0.5, 30),
    "tau_heading": (10, 1, 100),
    "tau_doubt": (2, 1, 100),
    "ramp_tilt": (0.5, 0.1, 4),
    "ramp_heading": (0.75, 0.1, 4),
    "bias_after": (5, 0, 60),
    "bias_limit_dps": (6, 0.5, 25),
    "rest_gyro_dps": (2, 0.1, 10),
    "rest_accel_g": (0.051, 0.01, 0.1),
    "rest_after": (1.5, 0.2, 10),
    "rest_dps": (0.5, 0.05, 5),
    "upset_g": (0.25, 0.1, 2),
    "field_tolerance": (0.2, 0.02, 0.7),
    "field_after": (0.3, 0, 10),
    "field_tau": (20, 1, 100),
    "field_first": (5, 0, 100),
    "field_new": (20, 1, 1000),
    "field_dps": (20, 1, 30),
    "field_agree": (0.5, 0.05, 3.14),
    "reject_for": (60, 0, 1000),
    "restart_rad": (0.55, 0.1, 3.14),
    "restart_after": (5, 0.5, 100),
    "outage": (0.5, 0.05, 10),
}


def _mantissa(num, den, bits):
    """(m, s) with num/den = m / 2**s and m of so many bits; s may not be negative."""
    s = 0
    while fixmath.ratio(num << (s + 1), den) < 1 << bits:
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
    corrections; blocks of 22 to 80 ms.
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
    blocks, t = num, den << shift  # blocks a second: blocks / t

    def whole(name):
        return ratio(p[name] * blocks, _MILLION * t)

    def counts(name, units):
        """A rate in deg/s as gyro counts, times units."""
        return ratio(p[name] * units * scale, _MILLION * per)

    gain = ratio(fixmath.PI_NUM * den * per << 46, fixmath.PI_DEN * 360 * num * scale)
    ramp_q8 = ratio(p["ramp_tilt"] * 256, _MILLION)
    tilt = ratio((1 << 31) * 256 * 14143, (ramp_q8 + 512) * 20000)
    turn_most = (
        ((gain * (32768 + 8192) + gain * counts("bias_limit_dps", 1)) >> 15) * 17321 // 10000
    )
    if turn_most + tilt + (1 << 29) > _W_MAX or gain < 1 << 17:
        low = -(-turn_most * num // (den * (_W_MAX - tilt - (1 << 29))))
        raise ValueError(
            "rate is %s, expected %d..%d Hz at %d/%d LSB per deg/s: choose another rate or gyro range"
            % (text, low, min(1439, (gain * num // den) >> 17), scale, per)
        )
    if counts("field_dps", 1) > 4000 or counts("rest_gyro_dps", 1) > 2000:
        raise ValueError(
            "gyro_scale is %d/%d, too fine for field_dps or rest_gyro_dps" % gyro_scale
        )
    s[_G] = gain >> 15
    s[_GR] = gain & 32767
    # levelling
    s[_K_END], s[_K_END_SHIFT] = _mantissa(den * _MILLION, num * p["tau_tilt"], 15)
    s[_RAMP] = ramp_q8
    s[_N_RAMP] = -(-(p["tau_tilt"] * num * 256 // (_MILLION * den) - 512) // ramp_q8)
    s[_N_LATE] = ratio(p["bias_after"] * num, _MILLION * den)
    s[_OUTAGE] = max(1, ratio(p["outage"] * num, _MILLION * den))
    s[_N_END] = max(s[_N_RAMP], s[_N_LATE] + 1)
    while lsb << s[_NORM] < 1 << 14:
        s[_NORM] += 1
    g1 = lsb << s[_NORM]
    s[_G1] = lsb
    s[_LI] = ratio(1 << 29, g1)
    s[_OM_GAIN] = ratio(10 << 24, 3 * g1)
    # block
    s[_BLOCK] = shift
    s[_BLOCK_MASK] = (1 << shift) - 1
    s[_PHASE] = 1  # the first block is a whole one for the gyro's mean
    s[_REST_K] = ratio(t << 17, blocks + 4 * t)  # T / (1/4 + T), Q15
    s[_REST_AFTER] = max(1, whole("rest_after"))
    s[_REST_GYRO] = counts("rest_gyro_dps", 8) ** 2
    s[_REST_ACCEL] = ratio(p["rest_accel_g"] * 8 * lsb, _MILLION) ** 2
    s[_REST_MOST] = counts("bias_limit_dps", 4096)
    s[_REST_OFF] = counts("rest_dps", 4096)
    s[_UPSET] = ratio(p["upset_g"] * lsb, 4 * _MILLION) ** 2
    s[_J_KNOWN] = ratio(20 * blocks << 14, t)
    # bias
    s[_B_SHIFT] = 20
    while counts("bias_limit_dps", 1 << s[_B_SHIFT]) >= 1 << 30:
        s[_B_SHIFT] -= 1
    s[_B_MAX] = counts("bias_limit_dps", 1 << s[_B_SHIFT])
    s[_CC], s[_CC_SHIFT] = _mantissa(1 << 27, gain, 14)
    s[_CE_MAX] = gain >> 3
    s[_J_LEAST] = ratio(blocks << 14, t)
    s[_J_DECAY] = ratio(t << 22, 150 * blocks)
    s[_RATE_T] = ratio(blocks << 4, t)
    # field
    s[_REJECTED] = s[_REJECT_FOR] = whole("reject_for")
    s[_TOL] = ratio(p["field_tolerance"] ** 2 << 15, _MILLION**2)
    s[_SMOOTH] = ratio(blocks << 10, 20 * t)
    s[_REF] = ratio(p["field_tau"] * blocks << 10, _MILLION * t)
    s[_FIELD_AFTER] = max(1, whole("field_after"))
    s[_FIELD_FIRST] = whole("field_first")
    s[_FIELD_NEW] = whole("field_new")
    s[_TURNING_MIN] = counts("field_dps", 4) ** 2
    s[_AGREE] = ratio(p["field_agree"] << 28, _MILLION)
    # heading
    s[_FAR_MIN] = ratio(p["restart_rad"] << 28, _MILLION)
    s[_RESTART_AFTER] = whole("restart_after")
    s[_HRAMP] = ratio(p["ramp_heading"] * 256, _MILLION)
    s[_HK] = ratio(t * _MILLION << 22, p["tau_heading"] * blocks)
    s[_HK_DOUBT] = ratio(t * _MILLION << 22, p["tau_doubt"] * blocks)
    s[_LIMIT_AFTER] = ratio(10 * blocks, t)
    s[_WEIGHT] = 2 if s[_LITE] else 0
    rad = fixmath.PI_NUM * t  # of a deg/s in a block: rad / (180 PI_DEN blocks)
    s[_PUSH_MAX] = ratio(3 * rad << 28, 180 * fixmath.PI_DEN * blocks)
    # with the 8 bits of the split
    s[_HC], s[_HC_SHIFT] = _mantissa(180 * fixmath.PI_DEN * blocks * scale, rad * per << 8, 14)
    s[_DOUBT_RATE] = ratio(
        p["bias_limit_dps"] * rad << 20, 180 * _MILLION * fixmath.PI_DEN * blocks
    )
