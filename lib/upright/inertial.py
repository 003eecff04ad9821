# The inertial-frame Mahony filter in 32-bit integers: sensor counts in, quaternion out, which estimates the gyro bias
# and rejects a disturbed magnetic field. Needs fixmath.py, earth_kernels.py, inertial_kernels.py and the viper emitter.
# update() is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on
# every port.

import micropython
from micropython import const

from upright import fixmath
from upright.earth_kernels import MILLION, EarthFilter, compass, fine_mantissa, low_pass, to_earth
from upright.fixmath import turn
from upright.inertial_kernels import (
    detect_rest,
    judge_field,
    learn,
    level,
    ramp,
    regress,
    smooth_field,
    steer,
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
_BASE = const(38)
_NINE = const(50)
_BLOCK = const(51)
_BLOCK_MASK = const(52)
_PHASE = const(53)
_GS = const(55)
_MS = const(58)
_SINCE = const(62)
_J = const(63)
_IN = const(67)
_REST_MOST = const(93)
_SEEN = const(94)
_S = const(97)
_N = const(106)
_N_RAMP = const(107)
_N_LATE = const(108)
_N_END = const(109)
_LATE = const(110)
_RAMP = const(111)
_K_END = const(112)
_K_END_SHIFT = const(113)
_NORM = const(114)
_G1 = const(115)
_LI = const(116)
_OM_GAIN = const(117)
_X = const(118)
_OM = const(134)
_U = const(135)
_INFO = const(138)
_II = const(141)
_INFO_LEAST = const(144)
_INFO_KNOWN = const(145)
_INFO_DECAY = const(146)
_RATE_T = const(147)
_REST_OFF = const(148)
_UPSET = const(149)
_B_SHIFT = const(150)
_B_MAX = const(151)
_C = const(152)
_CC = const(155)
_CC_SHIFT = const(156)
_TURN_MAX = const(157)
_REJECTED = const(167)
_WEIGHT = const(168)
_TOL = const(169)
_SMOOTH = const(170)
_REF = const(171)
_FIELD_AFTER = const(172)
_FIELD_FIRST = const(173)
_FIELD_NEW = const(174)
_REJECT_FOR = const(175)
_TURNING_MIN = const(176)
_AGREE = const(177)
_HN = const(178)
_LOST = const(179)
_FAR_MIN = const(180)
_RESTART_AFTER = const(181)
_HRAMP = const(182)
_HK = const(183)
_HK_DOUBT = const(184)
_LIMIT_AFTER = const(185)
_PUSH = const(186)
_ZK = const(187)
_PUSH_MAX = const(188)
_HC = const(189)
_HC_SHIFT = const(190)
_DOUBT = const(191)
_DOUBT_RATE = const(192)
_LITE = const(193)
_GAP = const(194)
_OUTAGE = const(195)
_WORDS = const(196)
# -- end of the words

_PI28 = const(843314857)  # pi, Q28


class Inertial9(EarthFilter):
    """Attitude from gyro, accelerometer and magnetometer: Mahony's filter with its error averaged in the earth frame.

    After R. Mahony, T. Hamel, J.-M. Pflimlin, IEEE TAC 53(5), 2008, with the acceleration low-passed in the earth
    frame (an idea of VQF: D. Laidig, T. Seel, Information Fusion 91, 2023), so that swings and shakes cancel before
    they count as tilt. The gyro bias is estimated at rest and in motion, with a gain that falls as it becomes known.
    The magnetometer turns only the heading, at a bounded rate, and only while the field is like its reference. Raw
    counts are enough: no calibration before, one set of parameters.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767

    parameters        by name, see PARAMETERS; taken to six significant digits

    A steady rotation from power-on looks like a bias and is taken for one, up to bias_limit_dps, until the first 1.5 s
    at rest.

    Raises ValueError for a rate, scale or parameter that the numbers cannot hold, with the range that they can:
    82 to 1439 Hz at +-2000 deg/s, from 50 Hz on at +-1000 deg/s and less.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "inertial9"
    AXES = 9
    LITE = False  # True: no rejection of fields, no restart of the heading
    # name: (default, least, most); times in s, angles in rad
    # fmt: off
    PARAMETERS = {
        "tau_tilt": (3, 0.5, 30),  # time constant of the tilt correction
        "tau_heading": (10, 1, 100),  # the same for the heading
        "tau_doubt": (2, 1, 100),  # the same while nothing is known of the vertical bias; with knowledge it grows
        "ramp_tilt": (0.5, 0.1, 4),  # at the start the time constants are this times the time since, in 1/256
        "ramp_heading": (0.75, 0.1, 4),
        "bias_after": (5, 0, 60),  # no bias estimation in motion before this time
        "bias_limit_dps": (6, 0.5, 25),  # a bias is no larger than this (on top of set_bias), deg/s
        "rest_gyro_dps": (2, 0.1, 10),  # at rest the gyro stays this near to its average, deg/s
        "rest_accel_g": (0.051, 0.01, 0.1),  # and the accelerometer this near to its own, g
        "rest_after": (1.5, 0.2, 10),  # for this long
        "rest_dps": (0.5, 0.05, 5),  # a well-known bias does not change by more: a slow turn is not rest, deg/s
        "upset_g": (0.25, 0.1, 2),  # a tilt error at rest, as its sine, that restarts the ramps
        "field_tolerance": (0.2, 0.02, 0.7),  # a field that differs by less is the reference's, as a part of it
        "field_after": (0.3, 0, 10),  # for this long
        "field_tau": (20, 1, 100),  # time constant with which the reference follows
        "field_first": (5, 0, 100),  # a field that stays the same for this long is the first reference
        "field_new": (20, 1, 1000),  # the same for another one, counted while turning
        "field_dps": (20, 1, 30),  # turning: faster than this, deg/s
        "field_agree": (0.5, 0.05, 3.14),  # a new reference's north is no further from the gyro's than this
        "reject_for": (60, 0, 1000),  # rejected for longer, a field counts half
        "restart_rad": (0.55, 0.1, 3.14),  # a heading error that a good field does not explain
        "restart_after": (5, 0.5, 100),  # restarts the heading's ramp when it lasts this long
        "outage": (0.5, 0.05, 10),  # so long without a fresh sample restarts both ramps
    }
    # fmt: on

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        EarthFilter.__init__(self, rate, gyro_scale, accel_lsb_per_g, _WORDS, parameters)

    # -- set-up and main loop: allocates
    def bounds(self, p):
        # of the tilt, and 0.25 rad of the heading
        ramp_q8 = fixmath.ratio(p["ramp_tilt"] * 256, MILLION)
        tilt = fixmath.ratio((1 << 31) * 256 * 14143, (ramp_q8 + 512) * 20000)
        return p["bias_limit_dps"], tilt + (1 << 29)

    def set_up(self, p, given):
        s, lsb = self.state, self.accel_lsb_per_g
        s[_LITE] = int(self.LITE)
        whole, counts, ratio = self.blocks, self.gyro_counts, fixmath.ratio
        num, den = self.rate
        scale, per = self.gyro_scale
        gain = (s[_G] << 15) + s[_GR]
        t = den << s[_BLOCK]  # a block lasts t / num s
        if counts(p["field_dps"], 1) > 4000:
            raise ValueError("gyro_scale is %d/%d, too fine for field_dps" % self.gyro_scale)
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
        s[_DOUBT_RATE] = ratio(
            p["bias_limit_dps"] * rad << 20, 180 * MILLION * fixmath.PI_DEN * num
        )

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
        """True while the magnetometer corrects the heading; False if its field is rejected or absent."""
        s = self.state
        return s[_WEIGHT] == 2 and s[_SINCE] < 16 and s[_HN] > 0

    @property
    def heading_uncertainty_mdeg(self):
        """Approximate error of the heading in millidegrees: 0..180000.

        It is the average difference from the magnetometer's heading while that is accepted. Otherwise it grows with the
        uncertainty of the vertical axis's bias. Six axes: since the start.
        """
        return (self.state[_DOUBT] >> 15) * 7162 >> 10

    @property
    def tilt_confidence(self):
        """How well the accelerometer shows the vertical, in 1/1000: 1000 at rest, less with harder shaking."""
        return self.state[_OM] * 125 >> 12

    # -- tick
    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        With bit 0 of flags (word 10) clear (no fresh sample) the filter turns with the last gyro words, without
        feedback, and all estimates stay unchanged. Bit 1: the magnetometer's words are fresh; its rate may be as low as
        a tenth of the steps'. Bits 2 and 3 (full scale) change nothing: leaving such samples out would be worse.
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
            s[_GS] = (s[_GS] << k >> k) + n
            s[_GS + 1] = (s[_GS + 1] << k >> k) + m
            s[_GS + 2] = (s[_GS + 2] << k >> k) + o
            # + R' TURN, the last correction, from the earth into the body
            i = 0
            r = _R
            while i < 3:
                n = s[_TURN + i] << k >> k
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
            s[_TURN + 2] = 0  # the others are of each step
        s[_WR] = u & 32767
        s[_W] = x + (u >> 15)
        s[_WR + 1] = v & 32767
        s[_W + 1] = y + (v >> 15)
        s[_WR + 2] = w & 32767
        s[_W + 2] = z + (w >> 15)
        turn(state)
        if fresh == 0:
            if s[_GAP] < s[_OUTAGE]:
                s[_GAP] += 1
        else:
            if s[_GAP]:
                if s[_GAP] == s[_OUTAGE]:  # too long: the attitude is unknown
                    s[_N] = 0
                    s[_HN] = 0
                s[_GAP] = 0
            if s[_N] < s[_N_END]:
                ramp(state)
            to_earth(state, counts)
            level(state)
            i = s[_PHASE]
            s[_PHASE] = (i + 1) & s[_BLOCK_MASK]
            if i == 0:
                # input of the rest detector: sample and block mean, less the bias that was set
                fine = 12 - s[_BLOCK]
                i = 0
                while i < 3:
                    n = ((c[i] & 0xFFFF) ^ 0x8000) - 0x8000
                    s[_IN + i] = n << 12
                    m = (s[_BASE + i] << k >> k) << 4
                    n = ((c[3 + i] & 0xFFFF) ^ 0x8000) - 0x8000
                    s[_SEEN + i] = (n << 12) - m
                    s[_IN + 3 + i] = ((s[_GS + i] << k >> k) << fine) - m
                    s[_GS + i] = 0
                    i += 1
                low_pass(state, _SEEN)
                detect_rest(state)
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
                    learn(state)
            elif i == 4:
                steer(state)
            elif i == 5:
                learn(state)


class Inertial9Lite(Inertial9):
    """Inertial9 that accepts every magnetic field, and never restarts its heading."""

    NAME = "inertial9-lite"
    LITE = True

    update = Inertial9.update  # see attitude.py


class Inertial6(Inertial9):
    """Inertial9 without a magnetometer: the heading is relative to the start."""

    NAME = "inertial6"
    AXES = 6

    update = Inertial9.update  # see attitude.py
