# The inertial-frame Mahony filter in 32-bit integers: sensor counts in, quaternion out, with its own gyro bias and its
# own judgement of the magnetic field. Needs attitude.py, fixmath.py, earth_kernels.py, inertial_kernels.py and the
# viper emitter. update() is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives
# the same bits on every port.

import micropython
from micropython import const

from upright import fixmath
from upright.earth_kernels import MILLION, EarthFilter, advance, compass, fine_mantissa
from upright.inertial_kernels import (
    detect_rest,
    inform,
    judge_field,
    learn,
    level,
    ramp,
    regress,
    smooth_field,
    steer,
)

# -- words of the state: written by tools/upright_host/words.py
_G = const(15)
_GR = const(16)
_NINE = const(50)
_BLOCK = const(51)
_BLOCK_MASK = const(52)
_PHASE = const(53)
_MS = const(58)
_SINCE = const(62)
_J = const(63)
_REST_MOST = const(93)
_S = const(100)
_N = const(109)
_N_RAMP = const(110)
_N_LATE = const(111)
_N_END = const(112)
_LATE = const(113)
_RAMP = const(114)
_K_END = const(115)
_K_END_SHIFT = const(116)
_NORM = const(117)
_G1 = const(118)
_LI = const(119)
_OM_GAIN = const(120)
_X = const(121)
_OM = const(137)
_U = const(138)
_INFO = const(141)
_II = const(144)
_INFO_LEAST = const(147)
_INFO_KNOWN = const(148)
_INFO_DECAY = const(149)
_RATE_T = const(150)
_REST_OFF = const(151)
_UPSET = const(152)
_B_SHIFT = const(153)
_B_MAX = const(154)
_C = const(155)
_CC = const(158)
_CC_SHIFT = const(159)
_TURN_MAX = const(160)
_REJECTED = const(170)
_WEIGHT = const(171)
_TOL = const(172)
_SMOOTH = const(173)
_REF = const(174)
_FIELD_AFTER = const(175)
_FIELD_FIRST = const(176)
_FIELD_NEW = const(177)
_REJECT_FOR = const(178)
_TURNING_MIN = const(179)
_AGREE = const(180)
_HN = const(181)
_LOST = const(182)
_FAR_MIN = const(183)
_RESTART_AFTER = const(184)
_HRAMP = const(185)
_HK = const(186)
_HK_DOUBT = const(187)
_LIMIT_AFTER = const(188)
_PUSH = const(189)
_ZK = const(190)
_PUSH_MAX = const(191)
_HC = const(192)
_HC_SHIFT = const(193)
_DOUBT = const(194)
_DOUBT_RATE = const(195)
_LITE = const(196)
_GAP = const(197)
_OUTAGE = const(198)
_WORDS = const(199)
# -- end of the words

_PI28 = const(843314857)  # pi, Q28


class Inertial9(EarthFilter):
    """Attitude from gyro, accelerometer and magnetometer: Mahony's filter with its error averaged in the earth frame.

    After R. Mahony, T. Hamel, J.-M. Pflimlin, IEEE TAC 53(5), 2008, with the acceleration low-passed in the earth
    frame (an idea of VQF: D. Laidig, T. Seel, Information Fusion 91, 2023), so that swings and shakes cancel before
    they count as tilt. The gyro bias is estimated at rest and in motion, with a gain that falls as knowledge grows. The
    magnetometer turns the heading alone, by a bounded rate, and only while the field looks like the usual one. Raw
    counts will do: no calibration before, one set of parameters.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767

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
    LITE = False  # True: no rejection of fields, no restart of the heading
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

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        EarthFilter.__init__(
            self, rate, gyro_scale, accel_lsb_per_g, _WORDS, _bias_most, _corrections, parameters
        )
        self.state[_LITE] = int(self.LITE)
        _set_up(self)
        self.set_bias(0, 0, 0)
        self.start_at((fixmath.ONE, 0, 0, 0))

    # -- set-up and main loop
    def start_at(self, q, known=0):
        EarthFilter.start_at(self, q)
        s = self.state
        for first, n in ((_S, 5), (_X, 16), (_C, 3), (_U, 3)):
            for i in range(n):
                s[first + i] = 0
        for i in (_N, _LATE, _HN, _LOST, _PUSH, _ZK, _GAP):
            s[i] = 0
        s[_S + 2] = self.accel_lsb_per_g << 14
        s[_OM] = 32768
        s[_DOUBT] = _PI28 if s[_NINE] else 0

    def bias_is_new(self, known_s):
        s = self.state
        for i in range(3):
            s[_INFO + i] = s[_INFO_LEAST]
            s[_II + i] = 1 << 20

    @property
    def bias_unit(self):
        return 1, 1 << self.state[_B_SHIFT]

    @property
    def mag_accepted(self):
        """True while the magnetometer turns the heading; False when its field is rejected, or there is none."""
        s = self.state
        return s[_WEIGHT] == 2 and s[_SINCE] < 16 and s[_HN] > 0

    @property
    def heading_uncertainty_mdeg(self):
        """How far the heading may be off, in millidegrees, roughly: 0..180000.

        The average distance from the magnetometer's heading while that is accepted; otherwise it grows with what is not
        known of the vertical axis's bias. Six axes: since the start.
        """
        return (self.state[_DOUBT] >> 15) * 7162 >> 10

    @property
    def tilt_confidence(self):
        """How much the accelerometer tells of the vertical, in 1/1000: 1000 at rest, less the harder the shaking."""
        return self.state[_OM] * 125 >> 12

    # -- tick
    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        Where flags (word 10) has bit 0 clear (no fresh sample) the last gyro words go on, without feedback, and the
        clock of all that is estimated stands still. Bit 1: the magnetometer's words are fresh; any rate down to a tenth
        of the steps' will do. Bits 2 and 3 (full scale) change nothing: to leave such samples out would be worse.
        """
        state = self.state
        advance(state, counts)
        s = ptr32(state)
        c = ptr16(counts)
        if c[10] & 1 == 0:
            if s[_GAP] < s[_OUTAGE]:
                s[_GAP] += 1
        else:
            if s[_GAP]:
                if s[_GAP] == s[_OUTAGE]:  # too long to know where it has turned
                    s[_N] = 0
                    s[_HN] = 0
                s[_GAP] = 0
            if s[_N] < s[_N_END]:
                ramp(state)
            level(state)
            i = s[_PHASE]
            s[_PHASE] = (i + 1) & s[_BLOCK_MASK]
            if i == 0:
                detect_rest(state, counts)
            elif i == 1:
                regress(state)
            elif i == 2:
                compass(state, _MS, _PI28)
            elif i == 3:
                if s[_J] and s[_LITE] == 0:
                    smooth_field(state, counts)
                    judge_field(state)
                if s[_BLOCK] == 2:  # a block of four steps: the rest of it as well
                    steer(state)
                    inform(state)
                    learn(state)
            elif i == 4:
                steer(state)
            elif i == 5:
                inform(state)
                learn(state)


class Inertial9Lite(Inertial9):
    """Inertial9 that takes every magnetic field as it is, and never starts its heading anew."""

    NAME = "inertial9-lite"
    LITE = True

    update = Inertial9.update  # see attitude.py


class Inertial6(Inertial9):
    """Inertial9 without a magnetometer: the heading is relative to the start."""

    NAME = "inertial6"
    AXES = 6

    update = Inertial9.update  # see attitude.py


# ----------------------------------------------------------------------------- set-up: allocates
def _bias_most(p):
    return p["bias_limit_dps"]


def _corrections(p):
    """The largest turn that a step takes up, half angle, Q31: of the tilt, and 0.25 rad of the heading."""
    ramp_q8 = fixmath.ratio(p["ramp_tilt"] * 256, MILLION)
    return fixmath.ratio((1 << 31) * 256 * 14143, (ramp_q8 + 512) * 20000) + (1 << 29)


def _set_up(filter):
    """Turn rate, scales and parameters into the state's words, in integers throughout."""
    s, p, lsb = filter.state, filter.parameters, filter.accel_lsb_per_g
    whole, counts, ratio = filter.blocks, filter.counts, fixmath.ratio
    num, den = filter.rate
    scale, per = filter.gyro_scale
    gain = (s[_G] << 15) + s[_GR]
    t = den << s[_BLOCK]  # a block lasts t / num s
    if counts(p["field_dps"], 1) > 4000:
        raise ValueError("gyro_scale is %d/%d, too fine for field_dps" % filter.gyro_scale)
    # levelling
    s[_RAMP] = ramp_q8 = ratio(p["ramp_tilt"] * 256, MILLION)
    s[_K_END], s[_K_END_SHIFT] = fine_mantissa(den * MILLION, num * p["tau_tilt"], 15)
    s[_N_RAMP] = -(-(p["tau_tilt"] * num * 256 // (MILLION * den) - 512) // ramp_q8)
    s[_N_LATE] = ratio(p["bias_after"] * num, MILLION * den)
    s[_OUTAGE] = max(1, ratio(p["outage"] * num, MILLION * den))
    s[_N_END] = max(s[_N_RAMP], s[_N_LATE] + 1)
    while lsb << s[_NORM] < 1 << 14:
        s[_NORM] += 1
    g1 = lsb << s[_NORM]
    s[_G1] = lsb
    s[_LI] = ratio(1 << 29, g1)
    s[_OM_GAIN] = ratio(10 << 24, 3 * g1)
    # rest
    s[_REST_MOST] = counts(p["bias_limit_dps"], 4096)
    s[_REST_OFF] = counts(p["rest_dps"], 4096)
    s[_UPSET] = ratio(p["upset_g"] * lsb, 4 * MILLION) ** 2
    # bias
    s[_B_SHIFT] = 20
    while counts(p["bias_limit_dps"], 1 << s[_B_SHIFT]) >= 1 << 30:
        s[_B_SHIFT] -= 1
    s[_B_MAX] = counts(p["bias_limit_dps"], 1 << s[_B_SHIFT])
    s[_CC], s[_CC_SHIFT] = fine_mantissa(1 << 27, gain, 14)
    s[_TURN_MAX] = gain >> 3
    s[_INFO_KNOWN] = ratio(20 * num << 14, t)
    s[_INFO_LEAST] = ratio(num << 14, t)
    s[_INFO_DECAY] = ratio(t << 22, 150 * num)
    s[_RATE_T] = ratio(num << 4, t)
    # field
    s[_REJECTED] = s[_REJECT_FOR] = whole(p["reject_for"])
    s[_TOL] = ratio(p["field_tolerance"] ** 2 << 15, MILLION**2)
    s[_SMOOTH] = whole(50000, 10)
    s[_REF] = whole(p["field_tau"], 10)
    s[_FIELD_AFTER] = max(1, whole(p["field_after"]))
    s[_FIELD_FIRST] = whole(p["field_first"])
    s[_FIELD_NEW] = whole(p["field_new"])
    s[_TURNING_MIN] = counts(p["field_dps"], 4) ** 2
    s[_AGREE] = ratio(p["field_agree"] << 28, MILLION)
    # heading
    s[_FAR_MIN] = ratio(p["restart_rad"] << 28, MILLION)
    s[_RESTART_AFTER] = whole(p["restart_after"])
    s[_HRAMP] = ratio(p["ramp_heading"] * 256, MILLION)
    s[_HK] = ratio(t * MILLION << 22, p["tau_heading"] * num)
    s[_HK_DOUBT] = ratio(t * MILLION << 22, p["tau_doubt"] * num)
    s[_LIMIT_AFTER] = ratio(10 * num, t)
    s[_WEIGHT] = 2 if s[_LITE] else 0
    rad = fixmath.PI_NUM * t  # of a deg/s in a block: rad / (180 PI_DEN num)
    s[_PUSH_MAX] = ratio(3 * rad << 28, 180 * fixmath.PI_DEN * num)
    # with the 8 bits of the split
    s[_HC], s[_HC_SHIFT] = fine_mantissa(180 * fixmath.PI_DEN * num * scale, rad * per << 8, 14)
    s[_DOUBT_RATE] = ratio(p["bias_limit_dps"] * rad << 20, 180 * MILLION * fixmath.PI_DEN * num)
