# The inertial-frame Mahony filter in 32-bit integers: sensor counts in, quaternion out. It estimates the gyro bias and
# judges the magnetic field. Needs fixmath.py, earth_kernels.py, inertial_field.py, inertial_kalman.py,
# inertial_tilt.py and the viper emitter.
# update() is made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on
# every port.

import micropython
from micropython import const

from upright import fixmath
from upright.earth_kernels import (
    MILLION,
    EarthFilter,
    compass,
    fine_mantissa,
    low_pass,
    to_earth,
)
from upright.fixmath import turn
from upright.inertial_field import judge_field, smooth_field
from upright.inertial_kalman import apply, grow, measure_bias, measure_heading, take
from upright.inertial_tilt import close, detect_rest, level, pace, regress, start_again

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
_NINE = const(61)
_BLOCK = const(62)
_PHASE = const(64)
_GS = const(66)
_MS = const(69)
_SINCE = const(73)
_J = const(74)
_REST_AFTER = const(100)
_REST_K = const(101)
_REST_MOST = const(104)
_TWO_MASK = const(105)
_LEVEL = const(106)
_LEVEL_MASK = const(107)
_REGRESS = const(108)
_PART = const(109)
_PACE = const(110)
_GG = const(111)
_FULL = const(114)
_CLIPS = const(115)
_CLIPPED = const(116)
_CLIP = const(117)
_MISSED = const(118)
_MISS = const(119)
_OUTAGE = const(120)
_SEEN = const(121)
_HELD_K = const(129)
_S = const(130)
_OFF = const(133)
_SF = const(135)
_SF_K = const(137)
_LEAN_G = const(138)
_LEAN = const(139)
_LEAN_AFTER = const(140)
_AGAIN = const(145)
_N = const(146)
_N_LATE = const(147)
_N_FULL = const(148)
_N_END = const(149)
_RAMP = const(150)
_K_PACE = const(151)
_K_START = const(152)
_K_LEAST = const(153)
_K_MOST = const(154)
_K_TURN = const(155)
_NORM = const(156)
_G1 = const(157)
_LI = const(158)
_OM_GAIN = const(159)
_X = const(160)
_D = const(172)
_OM = const(173)
_REST_OFF = const(174)
_UPSET = const(175)
_JUMP = const(176)
_SOON = const(177)
_WAIT = const(178)
_WAIT_MOST = const(179)
_WAIT_SURE = const(180)
_WAIT_TURN = const(182)
_WAIT_MOVED = const(186)
_GYRO = const(187)
_B_SHIFT = const(188)
_B_MAX = const(189)
_B_UNIT = const(190)
_B_INVERSE = const(191)
_P = const(192)
_DX = const(208)
_P_REST = const(219)
_P_KNOWN = const(220)
_P_VAGUE = const(221)
_P_UP = const(222)
_P_SET = const(223)
_Q_HEADING = const(224)
_Q_SCALE = const(225)
_Q_SCALE_SHIFT = const(226)
_Q_LEVEL = const(227)
_Q_UP = const(228)
_Q_FAR = const(229)
_GROW = const(230)
_R_TILT = const(231)
_R_REST = const(232)
_R_MAG = const(233)
_FAR = const(234)
_FAR_AFTER = const(235)
_CC = const(239)
_C = const(240)
_FOR_MOST = const(253)
_BACK_AFTER = const(257)
_STILL_SET = const(260)
_STILL_K = const(261)
_STEADY_MOST = const(263)
_OWN = const(264)
_LOST = const(265)
_RESTART_AFTER = const(266)
_WEIGHT = const(267)
_TOL = const(268)
_SAME = const(269)
_SMOOTH = const(270)
_REF = const(271)
_FIELD_AFTER = const(272)
_FIELD_FIRST = const(273)
_FIELD_NEW = const(274)
_NEED = const(275)
_TURNING_MIN = const(276)
_GATE = const(277)
_DOUBT = const(279)
_GAP = const(280)
_LAST = const(281)
_WORDS = const(284)
# -- end of the words

_HALF = const(536870912)  # 1/2, Q30: no variance is more
_OPEN = const(515396076)  # 3 rad**2 in units of (2.5 rad)**2, Q30: nothing is known of the heading
_PARTS = const(8)
_PI28 = const(843314857)  # pi, Q28


class Inertial9(EarthFilter):
    """Attitude from gyro, accelerometer and magnetometer: Mahony's filter with its error averaged in the earth frame.

    After R. Mahony, T. Hamel, J.-M. Pflimlin, IEEE TAC 53(5), 2008, with the acceleration low-passed in the earth
    frame (an idea of VQF: D. Laidig, T. Seel, Information Fusion 91, 2023), so that swings and shakes cancel before
    they count as tilt. A Kalman filter of four errors, the heading and the three biases, gives the rest: the
    accelerometer's corrections show the biases, the magnetometer the heading, a rest the bias itself. The magnetometer
    never tilts, and is believed only as far as the gyro can explain what it says. Raw counts are enough: no calibration
    before, one set of parameters.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767

    parameters        by name, see PARAMETERS; taken to six significant digits

    A steady rotation from power-on looks like a bias and is taken for one, up to bias_limit_dps, until it ends; after a
    rest, it is once it has lasted as long as the rest, rest_wait at the most. With nine axes the magnetometer tells a
    turn from a bias.

    Raises ValueError for a rate, scale or parameter that the numbers cannot hold, with the range that they can:
    20 to 1439 Hz at +-500 deg/s and less, from 34 Hz on at +-1000, from 68 Hz on at +-2000 deg/s.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "inertial9"
    AXES = 9
    BLOCKS_HZ = 23  # a block takes 44 to 88 ms, below 46 Hz 4 steps
    LEAST_HZ = 20
    # name: (default, least, most); times in s, angles in rad
    # fmt: off
    PARAMETERS = {
        "tau_start": (2.4, 0.5, 30),  # time constant of the tilt correction while little is known of the bias
        "tau_fast": (3.2, 0.5, 30),  # its least afterwards ...
        "tau_slow": (20, 1, 100),  # ... and its most
        "tau_turning": (4.4, 0.5, 50),  # between them it falls with the root of the turn rate: at 100 deg/s
        "ramp_tilt": (0.65, 0.1, 4),  # at the start the time constant is this times the time since
        "accel_doubt_g": (0.16, 0.1, 2),  # a deviation of so much halves what the tilt tells about the bias
        "bias_after": (0.3, 0, 60),  # no bias estimation in motion before this time ...
        "bias_full": (7, 0.5, 60),  # ... and at less than full weight before this
        "bias_limit_dps": (25, 0.5, 25),  # a bias is no larger than this (on top of set_bias), deg/s
        "bias_start_dps": (4, 1, 10),  # what is known of it at the start: its standard deviation
        "bias_walk": (0.003, 0.0005, 0.1),  # it changes by so much, deg/s per root s ...
        "bias_walk_level": (0.0525, 0.0005, 0.5),  # ... and a horizontal one by this, for the gyro's scale is off, too
        "bias_walk_far": (0.03, 0.0005, 0.5),  # the same while the heading has been off to one side for ...
        "far_after": (4, 0.5, 60),  # ... so long, by more than its doubt
        "tilt_noise": (2.8, 0.5, 20),  # of a tilt correction as a bias, deg/s root s
        "rest_noise": (0.05, 0.02, 1),  # of the gyro at rest, deg/s root s
        "mag_noise": (0.26, 0.05, 0.5),  # of the heading, rad root s
        "scale_error": (0.0034, 0.0005, 0.02),  # the heading walks by this times the turn rate, root s
        "rest_gyro_dps": (2, 0.1, 10),  # at rest the gyro stays this near to its average, deg/s
        "rest_accel_g": (0.051, 0.01, 0.1),  # and the accelerometer this near to its own, g
        "rest_after": (1.5, 0.2, 10),  # for this long
        "rest_dps": (0.3, 0.05, 5),  # a rest that differs by more from a known bias is not believed at once, deg/s
        "rest_wait": (12, 1.5, 60),  # but when it has lasted as long as the rest before, at most this
        "upset_g": (0.25, 0.1, 2),  # a tilt error at rest, as its sine, that restarts the ramp
        "lost_g": (0.6, 0.3, 2),  # a horizontal force of more for 2 s restarts it, too
        "field_tolerance": (0.15, 0.02, 0.7),  # a field that differs by less is the reference's, as a part of it
        "field_after": (0.3, 0, 10),  # for this long
        "field_tau": (33, 1, 100),  # time constant with which the reference follows
        "field_first": (5, 0, 100),  # a field that stays the same for this long is the first reference
        "field_new": (20, 1, 125),  # the same for another one with the same heading, counted while turning
        "field_dps": (20, 1, 30),  # turning: faster than this, deg/s
        "field_gate": (0.3, 0.05, 3),  # a heading error that is believed, beside what the gyro may be off by
        "restart_after": (8, 0.5, 100),  # a larger one in the same field restarts the heading after this; at rest twice
        "outage": (0.5, 0.05, 10),  # so long without a fresh sample restarts tilt and heading
    }
    # fmt: on

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, **parameters):
        EarthFilter.__init__(self, rate, gyro_scale, accel_lsb_per_g, _WORDS, parameters)

    # -- set-up and main loop: allocates
    def bounds(self, p):
        # of tilt and heading: a half angle of 1/4 rad each
        return p["bias_limit_dps"], 929887697

    def set_up(self, p, given):
        s, lsb = self.state, self.accel_lsb_per_g
        whole, counts, ratio = self.blocks, self.gyro_counts, fixmath.ratio

        def pairs(millionths, bits=0):
            return whole(millionths, bits + 4) + 16 >> 5

        num, den = self.rate
        scale, per = self.gyro_scale
        t = den << s[_BLOCK]  # a block lasts t / num s, and two of them
        two = 2 * t
        s[_TWO_MASK] = (2 << s[_BLOCK]) - 1
        pi_num, pi_den = fixmath.PI_NUM, fixmath.PI_DEN
        if counts(p["field_dps"], 1) > 4000:
            raise ValueError("gyro_scale is %d/%d, too fine for field_dps" % self.gyro_scale)
        s[_PACE] = max(1, -(-_PARTS >> s[_BLOCK]))  # parts in a step: all within a block
        s[_OUTAGE] = max(1, ratio(p["outage"] * num, MILLION * den))
        # what a gyro at full scale may have missed: as much again, at least 1000 deg/s; in units of 2.5 rad, Q15
        most = max(32768 * per, 1000 * scale)
        s[_CLIP] = max(1, ratio((most * pi_num * den << 15) * 2, 180 * 5 * scale * pi_den * num))
        most = 32768 * per
        s[_MISS] = max(1, ratio((most * pi_num * den << 15) * 2, 180 * 5 * scale * pi_den * num))
        # levelling
        s[_HELD_K] = ratio(two * MILLION << 15, 2 * p["tau_start"] * num + two * MILLION)
        s[_SF_K] = ratio(two << 16, num + 2 * two)
        s[_LEAN_G] = ratio(p["lost_g"] * lsb, 4 * MILLION) ** 2
        s[_LEAN_AFTER] = pairs(2 * MILLION)
        s[_RAMP] = ratio(p["ramp_tilt"] * 256, MILLION)

        def steps(millionths):
            return ratio(millionths * num, MILLION * den)

        s[_N_LATE] = steps(p["bias_after"])
        s[_N_FULL] = max(s[_N_LATE] + 1, steps(p["bias_full"]))
        s[_SOON] = steps(300000)
        for name, at in (("tau_start", _K_START), ("tau_fast", _K_MOST), ("tau_slow", _K_LEAST)):
            s[at] = min(524287, max(1, ratio(t * MILLION << 20, p[name] * num)))
        s[_N_END] = max(s[_N_FULL], steps(p["tau_slow"] * MILLION // p["ramp_tilt"])) + 1
        # of 256 times the root of a quarter of the counts of 100 deg/s
        root = fixmath.isqrt(ratio(25 * scale << 16, per))
        s[_K_TURN] = ratio(t * MILLION << 30, p["tau_turning"] * num * root)
        while lsb << s[_NORM] < 1 << 14:
            s[_NORM] += 1
        g1 = lsb << s[_NORM]
        s[_G1] = lsb
        s[_LI] = ratio(1 << 29, g1)
        s[_OM_GAIN] = ratio(MILLION << 24, p["accel_doubt_g"] * g1)
        # rest
        s[_REST_K] = ratio(two << 17, num + 4 * two)
        s[_REST_AFTER] = max(1, pairs(p["rest_after"]))
        s[_REST_MOST] = counts(p["bias_limit_dps"], 4096)
        s[_REST_OFF] = counts(p["rest_dps"], 4096)
        s[_JUMP] = counts(MILLION, 4096)
        s[_UPSET] = ratio(p["upset_g"] * lsb, 4 * MILLION) ** 2
        s[_WAIT_MOST] = max(1, pairs(p["rest_wait"]))
        s[_WAIT_SURE] = pairs(30 * MILLION)
        s[_WAIT_MOVED] = ratio(3 * lsb, 400) ** 2
        s[_GYRO] = ratio(per * two * pi_num << 28, 180 * scale * num * pi_den)
        # bias: its unit is bias_start 2**0.5
        unit = ratio(p["bias_start_dps"] * 141421356, 100000000)  # 1e-6 deg/s
        s[_B_SHIFT] = 20
        while counts(max(p["bias_limit_dps"], 4 * unit), 1 << s[_B_SHIFT]) >= 1 << 29:
            s[_B_SHIFT] -= 1
        s[_B_MAX] = counts(p["bias_limit_dps"], 1 << s[_B_SHIFT])
        s[_B_UNIT] = counts(unit, 1 << s[_B_SHIFT] - 13)
        s[_B_INVERSE] = ratio(MILLION * per << 20, unit * scale)
        s[_CC] = ratio(180 * pi_den * MILLION * num << 7, unit * t * pi_num)
        s[_GROW] = ratio(unit * two * pi_num << 21, 900 * MILLION * num * pi_den)
        # variances: of bias in this unit squared, Q30; of measurements Q20
        rest = ratio((p["rest_noise"] ** 2 << 30) * num, unit**2 * two)
        s[_P_REST] = min(_HALF, rest)
        s[_P_KNOWN] = min(_HALF, ratio((p["rest_noise"] ** 2 << 30) * 5, unit**2))
        s[_P_VAGUE] = _HALF // 125
        s[_P_UP] = _HALF
        s[_P_SET] = min(_HALF, ratio(MILLION**2 << 28, unit**2))
        s[_Q_UP], s[_Q_LEVEL], s[_Q_FAR] = [
            min(65000, max(1, ratio((p[name] ** 2 << 30) * two, unit**2 * num)))
            for name in ("bias_walk", "bias_walk_level", "bias_walk_far")
        ]
        s[_FAR_AFTER] = pairs(p["far_after"])
        s[_R_REST] = max(64, rest // 3072)  # each axis in every third pair
        s[_R_TILT] = min(1 << 24, ratio((p["tilt_noise"] ** 2 << 20) * num, 2 * unit**2 * two))
        mag = (p["mag_noise"] ** 2 << 22) * num
        s[_R_MAG] = min(1 << 24, ratio(mag, 25 * MILLION**2 * two))
        s[_Q_HEADING] = max(1, ratio(36 * two << 32, 25 * 100000000 * num))
        rad = 4 * per * p["scale_error"] * pi_num  # RATE is in (4 counts)**2
        s[_Q_SCALE], shift = fine_mantissa(
            rad**2 * two << 32, 25 * (180 * scale * pi_den * MILLION) ** 2 * num, 14
        )
        s[_Q_SCALE_SHIFT] = max(0, shift - 14)
        # field
        s[_TOL] = ratio(p["field_tolerance"] ** 2 << 15, MILLION**2)
        s[_SAME] = ratio(64 << 15, 10000)
        s[_SMOOTH] = pairs(50000, 10)
        s[_REF] = pairs(p["field_tau"], 10)
        s[_FIELD_AFTER] = max(1, pairs(p["field_after"]))
        s[_FIELD_FIRST] = pairs(p["field_first"])
        s[_FIELD_NEW] = pairs(p["field_new"])
        s[_FOR_MOST] = pairs(60 * MILLION)
        s[_NEED] = pairs(5 * MILLION)
        s[_BACK_AFTER] = pairs(3 * MILLION)
        s[_STEADY_MOST] = max(1, pairs(MILLION))
        s[_STILL_K] = ratio(two << 15, 5 * num + two)
        s[_TURNING_MIN] = max(1, counts(p["field_dps"], 1) ** 2 >> 4)
        s[_GATE] = ratio(p["field_gate"] << 28, MILLION)
        s[_RESTART_AFTER] = pairs(2 * p["restart_after"])

    def start_at(self, q, known=0):
        EarthFilter.start_at(self, q)
        s = self.state
        for first, n in (
            (_S, 3),
            (_OFF, 2),
            (_SF, 2),
            (_X, 12),
            (_DX, 4),
            (_FS, 3),
            (_C, 2),
            (_LAST, 3),
            (_GG, 3),
            (_GS, 3),
        ):
            for i in range(n):
                s[first + i] = 0
        for i in (
            _AGAIN,
            _N,
            _D,
            _LEAN,
            _GAP,
            _WAIT,
            _WAIT_TURN,
            _STILL_SET,
            _LOST,
            _OWN,
            _FULL,
            _CLIPPED,
            _MISSED,
            _FAR,
        ):
            s[i] = 0
        s[_PART] = _PARTS
        s[_LEVEL] = s[_LEVEL_MASK] = s[_REGRESS] = 0
        s[_PHASE] = 1  # the first blocks are whole ones
        s[_S + 2] = self.accel_lsb_per_g << 14
        s[_OM] = 32768
        s[_K_PACE] = s[_K_START]
        s[_P] = _OPEN if s[_NINE] else 1 << 16
        for i in range(1, 4):
            s[_P + i] = s[_P + 4 * i] = 0
        s[_DOUBT] = fixmath.isqrt(s[_P]) * 20480

    def bias_is_new(self, known_s):
        s = self.state
        for i in range(1, 16):
            s[_P + i] = 0
        variance = _HALF
        if known_s > 0:  # 0.5 deg/s / known_s**0.5
            variance = fixmath.ratio(
                s[_P_SET] * MILLION, max(1, fixmath.quantise(known_s, "known_s"))
            )
            variance = min(_HALF, max(64, variance))
        for i in range(1, 4):
            s[_DX + i] = 0  # it belongs to the old one
        for i in (5, 10, 15):
            s[_P + i] = variance
        s[_WAIT] = 0

    @property
    def bias_unit(self):
        return 1, 1 << self.state[_B_SHIFT]

    @property
    def mag_accepted(self):
        """True while the magnetometer corrects the heading; False if its field is rejected or absent."""
        s = self.state
        return s[_WEIGHT] == 1 and s[_SINCE] < 16 and s[_N] > 0 and bool(s[_NINE])

    @property
    def heading_uncertainty_mdeg(self):
        """Standard deviation of the heading's error in millidegrees; 180000: nothing is known of it.

        It grows with what is not known of the vertical bias, with turning, and with a gyro at full scale; the
        magnetometer takes it back. Six axes: since the start.
        """
        s = self.state
        return 180000 if s[_P] >= _OPEN - (_OPEN >> 3) else (s[_DOUBT] >> 15) * 7162 >> 10

    @property
    def clipped(self):
        """Samples so far with a gyro axis at full scale: what it turned by meanwhile is not known."""
        return self.state[_CLIPS]

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
        a tenth of the steps'. Bit 2 (accelerometer at full scale): the sample counts once the axis has come back, see
        earth_kernels.believe_later(). Bit 3 (gyro at full scale) makes the heading doubtful; ten in a row restart the
        tilt's ramp.
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
            s[_GS] = s[_GS] + n
            s[_GS + 1] = s[_GS + 1] + m
            s[_GS + 2] = s[_GS + 2] + o
        s[_WR] = u & 32767
        s[_WR + 1] = v & 32767
        s[_WR + 2] = w & 32767
        # coning: + last x this / 6 of the half angles (a 12th of the angles), J. W. Jordan, NASA TN D-5384, 1969
        m = x + 32768 >> 16
        n = y + 32768 >> 16
        o = z + 32768 >> 16
        i = s[_LAST] << k >> k
        gain = s[_LAST + 1] << k >> k
        fine = s[_LAST + 2] << k >> k
        s[_LAST] = m
        s[_LAST + 1] = n
        s[_LAST + 2] = o
        r = gain * o - fine * n
        x += (u >> 15) + (r + 128 >> 8) * 85
        r = fine * m - i * o
        y += (v >> 15) + (r + 128 >> 8) * 85
        r = i * n - gain * m
        z += (w >> 15) + (r + 128 >> 8) * 85
        if fresh and s[_TURN] | s[_TURN + 1] | s[_TURN + 2]:
            # + R' TURN, the last correction, from the earth into the body
            i = 0
            while i < 3:
                n = s[_TURN + i] << k >> k
                m = (n + 16384) >> 15
                n -= m << 15
                o = _R + 3 * i
                gain = s[o] << k >> k
                x += gain * m + (gain * n + 16384 >> 15)
                gain = s[o + 1] << k >> k
                y += gain * m + (gain * n + 16384 >> 15)
                gain = s[o + 2] << k >> k
                z += gain * m + (gain * n + 16384 >> 15)
                s[_TURN + i] = 0
                i += 1
        s[_W] = x
        s[_W + 1] = y
        s[_W + 2] = z
        turn(state)
        if fresh == 0:
            if s[_GAP] < s[_OUTAGE]:
                s[_GAP] += 1
            return
        if s[_GAP] | s[_FULL] | c[10] & 8:
            if s[_GAP] == s[_OUTAGE]:
                start_again(state, counts)
            else:
                i = s[_MISSED] + s[_GAP]
                if i > s[_OUTAGE]:
                    i = s[_OUTAGE]
                s[_MISSED] = i
            s[_GAP] = 0
            if c[10] & 8:
                if s[_CLIPS] < 0x3FFFFFFF:
                    s[_CLIPS] += 1
                s[_CLIPPED] += 1
                if s[_FULL] < 10:
                    s[_FULL] += 1
            else:
                if s[_FULL] == 10:
                    s[_AGAIN] = 1
                s[_FULL] = 0
        to_earth(state, counts)
        i = s[_PHASE]
        s[_PHASE] = (i + 1) & s[_TWO_MASK]
        part = s[_PART]
        if i == 0:
            part = 0
        if i & s[_LEVEL_MASK] == 0:
            close(state, counts)
            level(state)
            s[_REGRESS] = 1
            if s[_LEVEL] == 0:
                regress(state)
        elif s[_REGRESS]:
            s[_REGRESS] = 0
            regress(state)
        n = s[_PACE]
        while n and part < _PARTS:
            if part == 1:
                pace(state)
                low_pass(state, _SEEN)
                detect_rest(state)
            elif part == 2:
                if s[_NINE]:
                    compass(state, _MS, _PI28)
                else:
                    part = 3
            elif part == 3:
                if s[_J]:
                    smooth_field(state)
                    judge_field(state)
            elif part == 4:
                grow(state)
            elif part == 5:
                if int(measure_heading(state)):
                    take(state)
            elif part == 6:
                if int(measure_bias(state)):
                    take(state)
            elif part == 7:
                apply(state)
            part += 1
            n -= 1
        s[_PART] = part


class Inertial6(Inertial9):
    """Inertial9 without a magnetometer: the heading is relative to the start."""

    NAME = "inertial6"
    AXES = 6

    update = Inertial9.update  # see attitude.py
