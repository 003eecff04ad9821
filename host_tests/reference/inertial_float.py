"""The inertial filter in double-precision floats: what lib/upright/inertial.py is measured against.

Plain Python without numpy; runs on CPython. Same schedule and same order of work as the integer filter, but physical
units, true roots and angles, and no rounding. Yes/no decisions are taken here, or copied from the integer run
(`update(counts, decisions)`), so that a comparison measures arithmetic alone.
"""

# The model. dt: one step; T: a block of 2**n steps, 44 to 88 ms (4 steps at least); T2: two blocks. q turns the body
# into the earth; R: its matrix, whose rows are north, west and up as the body sees them.
#
# Every step, with w the gyro's rate less the bias that was set and the learnt one, b:
#     d = w dt;  q turns by d + d_before x d / 12 + R' turn
# The product is the coning term. `turn` is the last correction (earth frame): the next fresh step takes it up.
#
# Levelling, every block. h: mean of the specific force in the earth frame, in g; s: h low-passed.
#     s += 2 k (h - s);  turn_north = k s_west;  turn_west = -k s_north;  k = T / tau
# k acts twice, on s and on the attitude: a second-order low-pass that is critically damped. Each of s_north and s_west
# counts as 1 g at most; upside down, (s_north, s_west) counts as if it were 1.4 g long.
#     tau = tau_turning (100 deg/s / |w|)**(1/2), between tau_fast and tau_slow
# |w| is held: it follows up at once, and down slowly. tau = tau_start while a bias is known worse than to bias_start /
# 125**(1/2). In the time t after a start k is no less than L / (ramp_tilt t + L), and never more than 1/2; L is what a
# levelling takes: one step at first, then never more than t / 8 until it is T.
# The tilt is lost, and starts again, when |h| (horizontal, low-passed over 0.5 s) is above lost_g for 2 s.
#
# What follows is done every two blocks.
#
# Rest: gyro and accelerometer have been near their two-pole low-passes for rest_after.
#
# A Kalman filter estimates the error of four states, x = (heading, bias), with covariance P. The gyro turns the heading
# away by what is wrong with the bias about the vertical (u = third row of R):
#     heading' = -u . bias + noise of (0.0006 rad)**2 + (scale_error |w|)**2 a second
#     bias'    = noise of bias_walk**2 along u, bias_walk_level**2 across it, a second
# bias_walk_far along u while |e| has been beyond the bound below, to one side, for far_after: the bias changes. And
# only bias_walk across it while a rest contradicts the bias: who turns slowly and steadily changes no bias.
# What is measured, with the variance that its mean over one second would have:
#     compass       e = atan2(-west, north) of the mean field: the heading, mag_noise**2
#     tilt, moving  -(turn_north, turn_west) / T = (y_north, y_west) . bias, tilt_noise**2 (1 + D)
#     rest          low-passed gyro - b: the bias, rest_noise**2
# y_north and y_west are the first two rows of R, low-passed as the tilt is; D is the low-pass of |h - s|**2 /
# accel_doubt_g**2. They take turns, one in two blocks; at rest the three axes of the gyro do.
# Beyond 0.02 rad + 0.7 doubt, doubt**2 = P(heading), the compass's variance grows with |e|: a larger error pulls no
# harder (P. J. Huber, Ann. Math. Stat. 35(1), 1964). What is wrong with a field lasts, and is no noise: so of the gain
# K by which the compass corrects the biases only 0.22 is taken, and P is what that leaves: P - K z' - z K' + K S K',
# with z = P row' and S = row z + variance.
# After two blocks b takes up the bias's part of x, `turn` about up the heading's; the tilt is never touched.
#
# A start, a restart of the tilt, a gyro at full scale, a step without a sample (by what |w| may have turned it), or a
# correction cut off at 1/2 rad (what is left is still to come) make P(heading) larger again, as far as 3 rad**2: this
# part of the error has nothing to do with the biases, and what the rest has in common with them stays. Where
# P(heading) would grow beyond, P(heading, bias) shrinks as a heading scaled to 3 rad**2 has it. What contradicts the
# bias makes P(bias) that of the start.
#
# Field: the pair (horizontal, vertical) of the mean field, and e. It is believed while it is near the reference, and
# |e| below field_gate + 1.125 doubt, or the doubt above 1.5 rad; at rest, with a doubt below 0.3 rad, e stays where it
# was to 0.1 rad, too. Another field, or the same with another heading, becomes the reference when it has stayed for
# long enough, counted while the body turns: field_first for the first, field_new for one with the same heading,
# otherwise twice as long as the reference was seen, and 5 s; 3 s for the reference before this one. A heading error
# that comes up while the field stays the same is the attitude's own: after restart_after the heading starts again.

import math

from reference.earth_float import block_of, clamp, rows, turned, wrap
from reference.earth_float import start as start  # for who starts the twin
from reference.field_float import NEAR_CANDIDATE, NEAR_REFERENCE, FieldFloat

# decisions, as lib/upright/inertial.py has them in its state; the others are in field_float.py
STILL = 1  # gyro and accelerometer near their averages, and the gyro below the largest bias
OVER = 32  # more than 90 degrees from level
UPSET = 128  # a tilt error at rest that cannot be
CONTRADICTS = 256  # a rest that contradicts a known bias
ADOPT = 512  # it is believed
TURNED = 1024  # it is none: the body turned, or moved
LEANS = 2048  # a horizontal force that no tilt should leave
VAGUE = 16384  # little is known of a bias
JUMPED = 32768  # a rest ends the tilting that an unknown bias did

DEFAULTS = {
    "tau_start": 2.4,
    "tau_fast": 3.2,
    "tau_slow": 20.0,
    "tau_turning": 4.4,
    "ramp_tilt": 0.65,
    "accel_doubt_g": 0.16,
    "bias_after": 0.3,
    "bias_full": 7.0,
    "bias_limit_dps": 25.0,
    "bias_start_dps": 4.0,
    "bias_walk": 0.003,
    "bias_walk_level": 0.0525,
    "bias_walk_far": 0.03,
    "far_after": 4.0,
    "tilt_noise": 2.8,
    "rest_noise": 0.05,
    "mag_noise": 0.26,
    "scale_error": 0.0034,
    "rest_gyro_dps": 2.0,
    "rest_accel_g": 0.051,
    "rest_after": 1.5,
    "rest_dps": 0.3,
    "rest_wait": 12.0,
    "upset_g": 0.25,
    "lost_g": 0.6,
    "field_tolerance": 0.15,
    "field_after": 0.3,
    "field_tau": 33.0,
    "field_first": 5.0,
    "field_new": 20.0,
    "field_dps": 20.0,
    "field_gate": 0.3,
    "restart_after": 8.0,
    "outage": 0.5,
}
BLOCKS_HZ = 23
PARTS = 8  # of the work of two blocks
OFF_MOST = 15.625  # in accel_doubt_g
TURN_MOST = 0.5  # rad a block: each part of a correction
LEAN_TAU, LEAN_AFTER = 0.5, 2.0  # s
FULL_MOST = 10  # samples with a gyro at full scale, after which the tilt starts again
REST_TAU = 0.25  # s
SOON = 0.3  # s
JUMP_DPS = 1.0
WAIT_SURE = 30.0  # s
WAIT_MOVED_G = 0.03
TURN_LEAST, TURN_MOST_SEEN = (
    0.1,
    0.25,
)  # rad: four times the noise of two headings; more is not counted
OPEN, SIX = 3.0, 2**-14 * 6.25  # rad**2: nothing is known of the heading; six axes: the start's
WALK = 0.0006  # rad per root s
LIMIT, LIMIT_DOUBT = 0.02, 0.6875  # rad, 1
SHARE = 0.22  # of the gain with which the heading corrects the biases
STEP_MOST = 64  # a rest makes the variance of a bias no smaller than 1/65 at a time
LEAST = 2.0**-24  # of a variance, in units of (2.5 rad)**2 or 2 bias_start**2
NOISE_MOST, TILT_MOST = 512.0, 16.0  # of a measurement, in units of 2 bias_start**2


class InertialFloat(FieldFloat):
    """The float twin of inertial.Inertial9, with 6 axes Inertial6.

    rate in Hz (float); gyro_scale LSB per deg/s and accel_lsb_per_g as floats; axes 6 or 9; any of DEFAULTS.
    q: [w, x, y, z]; b: learned bias, rad/s; P: covariance of heading (rad) and bias (rad/s); rest: bool; weight: 1
    heading accepted, 0 rejected; doubt: of the heading, rad; disagreed: how many decisions would have been taken
    otherwise here.
    """

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, axes=9, **parameters):
        p = self.chosen(DEFAULTS, parameters)
        self.p, self.axes = p, axes
        self.dt = 1 / rate
        self.block = block_of(rate, BLOCKS_HZ)
        self.pace = max(1, -(-PARTS // self.block))
        self.T, self.T2 = self.block / rate, 2 * self.block / rate
        self.gyro = math.radians(1 / gyro_scale)
        self.lsb, self.hz = accel_lsb_per_g, rate
        self.ramp = round(p["ramp_tilt"] * 256) / 256
        self.bias_start = math.radians(p["bias_start_dps"])
        self.unit = math.sqrt(2) * self.bias_start
        self.rest_noise = math.radians(p["rest_noise"]) ** 2  # of 1 s
        self.rest_after = max(1, self.pairs(p["rest_after"]))
        self.base = [0.0] * 3
        self.R = rows([1.0, 0.0, 0.0, 0.0])
        self.P = [[0.0] * 4 for _ in range(4)]
        self.axis = self.side = 0
        self.held = 0.0
        self.blocks = self.still = 0  # of the rest detector
        self.low1, self.low2 = [0.0] * 6, [0.0] * 6
        self.e = self.candidate_e = self.still_e = 0.0
        self.field = self.reference = self.old = self.candidate = None
        self.dx = [0.0] * 4
        self.near = self.seen = self.old_seen = self.candidate_for = self.back = self.steady = 0
        self.good = False
        self.weight = 0
        self.decided = self.disagreed = 0
        self.set_bias([0.0] * 3)
        self.set_quaternion([1.0, 0.0, 0.0, 0.0])

    def steps(self, seconds):
        return int(seconds / self.dt + 0.5)

    def pairs(self, seconds):
        return int(seconds / self.T2 + 0.5)

    @property
    def rest(self):
        return self.still == self.rest_after

    def set_bias(self, counts, known_s=0):
        for i in range(3):
            self.low1[3 + i] += self.base[i] - counts[i]
            self.low2[3 + i] += self.base[i] - counts[i]
        self.base = list(counts)
        self.b = [0.0] * 3
        self.open_bias()
        self.dx[1:4] = [0.0] * 3
        if known_s > 0:
            for i in range(1, 4):
                self.P[i][i] = min(self.P[i][i], math.radians(0.5) ** 2 / known_s)
        self.wait = 0

    def set_quaternion(self, q):
        norm = math.sqrt(sum(v * v for v in q))
        self.q = [v / norm for v in q]
        self.last = [0.0] * 3  # what the step before turned by
        self.turn = [0.0] * 3  # correction (earth) that the next step takes up, rad
        self._forget_sums()
        self.since = self.j = self.gap = 0
        self.full = self.clipped = 0
        self.n = self.lean = 0
        self.k_pace = self.T / self.p["tau_start"]
        self.missed = self.far = 0
        self.p_up = math.inf
        self.again = False
        self.level = 1
        self.s, self.lean_s = [0.0, 0.0, 1.0], [0.0, 0.0]
        self.off = [0.0, 0.0]
        self.c = [0.0, 0.0]  # tilt correction of this block, rad
        self.x, self.y = [0.0] * 6, [0.0] * 6
        self.d, self.tilt_weight = 0.0, 1.0
        self.wait = self.lost = 0
        self.wait_e = self.wait_turn = 0.0
        self.own = self.still_set = False
        self.P[0] = [OPEN if self.axes == 9 else SIX, 0.0, 0.0, 0.0]
        for i in range(1, 4):
            self.P[i][0] = 0.0
        self.doubt = math.sqrt(self.P[0][0])

    def _forget_sums(self):
        """What was summed is of another attitude; the next blocks are whole ones."""
        self.force_sum, self.mag_sum, self.mag_n = [0.0] * 3, [0.0] * 3, 0
        self.full_end, self.full_steps = 0, 0
        self.full_sum = self.later = (0.0, 0.0, 0.0)
        self.gyro_sum, self.pair_sum = [0] * 3, [0] * 3
        self.dx = [0.0] * 4
        self.part, self.phase = PARTS, 1
        self.regress = False

    def open_heading(self, variance):
        """The heading's variance is at least this from now on."""
        variance = min(OPEN, variance)
        self.still_set = False
        if variance > self.P[0][0]:
            self.P[0][0] = variance
            self.doubt = math.sqrt(variance)

    def open_bias(self):
        """Nothing is known of the biases any more."""
        for i in range(1, 4):
            self.P[0][i] = 0.0
            self.P[i] = [0.0] * 4
            self.P[i][i] = self.bias_start**2

    # -- one step
    def update(self, counts, decisions=None):
        fresh = counts[10] & 1
        a, dt = self.last, self.dt
        b = self.last = [
            (counts[3 + i] - self.base[i]) * self.gyro * dt - self.b[i] * dt for i in range(3)
        ]
        turn = [
            b[0] + (a[1] * b[2] - a[2] * b[1]) / 12,
            b[1] + (a[2] * b[0] - a[0] * b[2]) / 12,
            b[2] + (a[0] * b[1] - a[1] * b[0]) / 12,
        ]
        if fresh:
            R, f = self.R, self.turn
            turn = [turn[i] + R[0][i] * f[0] + R[1][i] * f[1] + R[2][i] * f[2] for i in range(3)]
            self.turn = [0.0] * 3
        self.q = turned(self.q, turn)
        if not fresh:
            self.gap += 1
            return
        self.forced = decisions
        if self.gap >= max(1, self.steps(self.p["outage"])):
            self.again = True
            self.open_heading(OPEN)
            self._forget_sums()
        else:
            self.missed = min(self.missed + self.gap, max(1, self.steps(self.p["outage"])))
        self.gap = 0
        if counts[10] & 8:
            self.clipped += 1
            self.full += 1
        else:
            if self.full >= FULL_MOST:
                self.again = True
            self.full = 0
        R = self.R = rows(self.q)
        force = self.force(counts)
        for i in range(3):
            self.force_sum[i] += force[i]
            self.gyro_sum[i] += counts[3 + i]
        self.gather(counts)
        phase = self.phase
        self.phase = (phase + 1) % (2 * self.block)
        if phase == 0:
            self.part = 0
        if phase % self.level == 0:
            self._close(counts, phase)
            self._level()
            self.regress = True
        if self.regress and (phase % self.level or self.level == 1):
            self._regress()
            self.regress = False
        for _ in range(self.pace):
            if self.part < PARTS:
                self._work()
                self.part += 1

    def _work(self):
        part = self.part
        if part == 1:
            self._pace()
            self._rest()
        elif part == 2:
            if self.axes == 9:
                self._compass()
            else:
                self.part += 1
        elif part == 3 and self.j:
            self._smooth_field()
            self._judge_field()
        elif part == 4:
            self._grow()
        elif part == 5:
            self._measure_heading()
        elif part == 6:
            self._measure_bias()
        elif part == 7:
            self._apply()

    # -- levelling
    def _close(self, counts, phase):
        """The end of a levelling: its means; its gain k."""
        steps = self.level
        self.h = [v / steps for v in self.force_sum]
        mean = [v / steps - self.base[i] for i, v in enumerate(self.gyro_sum)]
        self.rate = sum((mean[i] * self.gyro - self.b[i]) ** 2 for i in range(3))
        for i in range(3):
            self.pair_sum[i] += self.gyro_sum[i]
        if phase == 0:
            self.mean = [v / self.block / 2 - self.base[i] for i, v in enumerate(self.pair_sum)]
            self.sample = [*counts[0:3], *(counts[3 + i] - self.base[i] for i in range(3))]
            self.pair_sum = [0] * 3
        self.force_sum, self.gyro_sum = [0.0] * 3, [0] * 3
        if self.again:
            self.again = False
            self.n, steps = 0, 1
            self.level = 1
        k = self.k_pace * steps / self.block
        self.n += steps
        self.k = min(0.5, max(k, steps / (self.ramp * self.n // 1 + steps)))
        # it takes no more than an eighth of the time since the start
        if steps < self.block and self.n // 16 >= steps and phase % (2 * steps) == 0:
            self.level = 2 * steps

    def _pace(self):
        """The gain after the start, for the next two blocks; the watch for a lost tilt."""
        p, T = self.p, self.T2
        if self.rate > self.held:
            self.held = self.rate
        else:
            self.held += T / (2 * p["tau_start"] + T) * (self.rate - self.held)
        for i in range(2):
            self.lean_s[i] += T / (LEAN_TAU + T) * (self.h[i] - self.lean_s[i])
        if self.decide(LEANS, math.hypot(*self.lean_s) > p["lost_g"]):
            self.lean += 1
            if self.lean > self.pairs(LEAN_AFTER):
                self.again, self.lean = True, 0
                self.open_heading(OPEN)
        else:
            self.lean = max(0, self.lean - 2)
        vague = any(self.P[i][i] > self.bias_start**2 / 125 for i in range(1, 4))
        if self.decide(VAGUE, vague):
            tau = p["tau_start"]
        else:
            turns = math.sqrt(self.held) / math.radians(100)
            tau = p["tau_turning"] / math.sqrt(turns) if turns else p["tau_slow"]
            tau = min(p["tau_slow"], max(p["tau_fast"], tau))
        self.k_pace = self.T / tau

    def _level(self):
        h, s, k = self.h, self.s, self.k
        self.off = [h[i] - s[i] for i in range(2)]
        for i in range(3):
            s[i] += 2 * k * (h[i] - s[i])
        x, y = clamp(s[0], 1.0), clamp(s[1], 1.0)
        if self.decide(OVER, s[2] < 0):
            n = math.hypot(x, y)
            if n < 1:
                x, y = 1.4 * x / (n + 1 / 1024), 1.4 * y / (n + 1 / 1024)
        self.c = [k * y, -k * x]
        self.turn[0:2] = [clamp(v, TURN_MOST) for v in self.c]

    def _regress(self):
        """The earth's horizontal axes in the body, filtered as the tilt correction is; the tilt's confidence."""
        k = self.k
        v = [*self.R[0], *self.R[1]]
        for i in range(6):
            self.x[i] += 2 * k * (v[i] - self.y[i] - self.x[i])
            self.y[i] += k * self.x[i]
        off = [clamp(v, 3.0) / self.p["accel_doubt_g"] for v in self.off]
        off = sum(clamp(v, OFF_MOST) ** 2 for v in off)
        self.d += 2 * k * (off - self.d)
        self.tilt_weight = 1 / (1 + self.d)

    # -- rest
    def _rest(self):
        """Rest: gyro and accelerometer stay near their two-pole low-passes."""
        p, low2 = self.p, self.low2
        self.blocks += 1
        k = max(1 / self.blocks, self.T2 / (REST_TAU + self.T2))
        size = [0.0, 0.0]
        for i, v in enumerate(self.sample[0:3] + self.mean):
            self.low1[i] += k * (v - self.low1[i])
            low2[i] += k * (self.low1[i] - low2[i])
            size[i // 3] += (self.sample[i] - low2[i]) ** 2
        dps = math.radians(1) / self.gyro
        still = size[0] < (p["rest_accel_g"] * self.lsb) ** 2
        still = still and size[1] < (p["rest_gyro_dps"] * dps) ** 2
        still = still and max(abs(v) for v in low2[3:6]) <= p["bias_limit_dps"] * dps
        off = [low2[3 + i] * self.gyro - self.b[i] for i in range(3)]
        n = 0
        if self.decide(STILL, still):
            n = self._contradicted(off, min(self.still + 1, self.rest_after))
        else:
            self.wait = 0
        if n == self.rest_after:
            unknown = [i for i in range(3) if self.P[1 + i][1 + i] > self.bias_start**2 / 5]
            jumped = any(abs(off[i]) > math.radians(JUMP_DPS) for i in unknown)
            jumped = self.decide(JUMPED, self.still < n and jumped)
            upset = math.hypot(*self.s[0:2]) > p["upset_g"]
            upset = not jumped and self.n > self.steps(SOON) and upset
            upset = self.decide(UPSET, upset)
            if upset:
                n = 0
            if jumped or upset:
                self.again = True
            if upset or (
                jumped and self.axes == 9
            ):  # six axes: what the bias turned comes back with it
                self.open_heading(OPEN)
        self.still = n

    def _contradicted(self, off, n):
        """A rest that contradicts a known bias is believed when it has lasted as long as the one before.

        n: blocks of rest, with this one -> the same, or less.
        """
        known = [
            self.P[1 + i][1 + i]
            for i in range(3)
            if abs(off[i]) > math.radians(self.p["rest_dps"])
            and self.P[1 + i][1 + i] < 5 * self.rest_noise
        ]
        up = abs(sum(u * v for u, v in zip(self.R[2], off, strict=True)))
        if up > math.radians(self.p["rest_dps"]) and self.p_up < 5 * self.rest_noise:
            known.append(self.p_up)  # however the board is mounted
        if not self.decide(CONTRADICTS, bool(known)):
            self.wait = 0
            return n
        self.wait += 1
        if self.wait == 1:
            self.wait_e, self.wait_turn, self.wait_a = self.e, 0.0, self.low2[0:3]
        turn = min(up * self.wait * self.T2, TURN_MOST_SEEN)
        turned = sum((a - b) ** 2 for a, b in zip(self.low2, self.wait_a, strict=False))
        turned = turned > (WAIT_MOVED_G * self.lsb) ** 2
        adopt = False
        if not turned and known and self.wait >= self._patience(min(known)):
            near = self.decided & (NEAR_REFERENCE | NEAR_CANDIDATE)
            told = (
                up > math.radians(self.p["rest_dps"]) / 2
            )  # a turn about the vertical is what the field can tell
            if told and self._field_known() and near:
                # what the gyro says the heading turned by; the magnetometer knows better
                moved = abs(wrap(self.e - self.wait_e) + self.wait_turn)
                sure = self.wait >= self.pairs(WAIT_SURE)
                turned = moved < TURN_LEAST and (turn >= 2 * TURN_LEAST or sure)
                adopt = moved >= TURN_LEAST
            else:
                waited = self.wait >= max(1, self.pairs(self.p["rest_wait"]))
                adopt = bool(not self._field_known() or near or waited)
        turned = self.decide(TURNED, turned)
        if self.decide(ADOPT, adopt):
            self.open_bias()
            self.open_heading((math.sqrt(self.P[0][0]) + turn) ** 2)
            self.wait = 0
            return n
        if turned:
            self.wait = 0
            return 0
        return min(n, self.rest_after - 1)

    def _field_known(self):
        return self.axes == 9 and self.field is not None and self.since < 16

    def _patience(self, variance):
        """Blocks of rest that would give this variance."""
        most = max(1, self.pairs(self.p["rest_wait"]))
        return max(self.rest_after, min(most, int(self.rest_noise / self.T2 / variance)))

    # -- heading and bias
    def _grow(self):
        """P after two blocks: the heading turns away by -up . bias; heading and bias walk."""
        p, P, T, U = self.p, self.P, self.T2, self.R[2]
        start = self.bias_start**2
        v = [sum(P[1 + i][1 + k] * U[k] for k in range(3)) for i in range(3)]
        c = sum(U[i] * P[0][1 + i] for i in range(3))
        u = sum(U[i] * v[i] for i in range(3))
        for i in range(3):
            P[0][1 + i] -= T * v[i]
            P[1 + i][0] = P[0][1 + i]
        self.p_up = u
        level = math.radians(p["bias_walk_level"]) ** 2 * T
        up = math.radians(p["bias_walk"]) ** 2 * T
        if self.decided & CONTRADICTS:
            level = up
        if abs(self.far) > self.pairs(p["far_after"]):
            up = math.radians(p["bias_walk_far"]) ** 2 * T
        for i in range(3):
            if P[1 + i][1 + i] >= start:
                continue
            for k in range(i + 1):
                if P[1 + k][1 + k] < start:
                    x = P[1 + i][1 + k] + (up - level) * U[i] * U[k]
                    if k == i:
                        x = min(start, x + level)
                    P[1 + i][1 + k] = P[1 + k][1 + i] = x
        x = P[0][0] - 2 * T * c + T * T * u + T * (WALK**2 + p["scale_error"] ** 2 * self.rate)
        if self.clipped or self.missed:
            # a gyro at full scale may have missed as much again, at least 1000 deg/s; a step without a sample all
            missed = self.clipped * max(32768 * self.gyro, math.radians(1000)) * self.dt
            missed += self.missed * math.sqrt(self.held) * self.dt
            x = max(x, min(OPEN, (math.sqrt(P[0][0]) + missed) ** 2))
            self.clipped = self.missed = 0
        if x > OPEN:
            # 1 - (x - OPEN) / (2 OPEN), and a little more, in steps of the integers: (2.5 rad)**2 / 2**16
            over = (int((x - OPEN) / 6.25 * 65536) + 1) / 65536 * 9 / 8
            x = OPEN
            for i in range(1, 4):
                P[0][i] *= 1 - over
                P[i][0] = P[0][i]
        P[0][0] = x
        self.doubt = math.sqrt(x)

    def _take(self, row, value, noise, share=1.0):
        """The measurement value = row . x, of this variance.

        The biases' gain is `share` of the optimal one, and P what that leaves (Joseph's form).
        """
        P, dx = self.P, self.dx
        z = [sum(P[i][k] * row[k] for k in range(4)) for i in range(4)]
        total = max(0.0, sum(z[i] * row[i] for i in range(4))) + noise
        value -= sum(dx[i] * row[i] for i in range(4))
        for i in range(4):
            part = share if i else 1.0
            unit = self.unit if i else 2.5
            dx[i] = clamp(dx[i] + part * z[i] * value / total, 4 * unit)
            for k in range(i, 4):
                P[i][k] -= part * (2 - part) * z[i] * z[k] / total
                P[k][i] = P[i][k]
            P[i][i] = max(P[i][i], LEAST * unit**2)

    def _measure_heading(self):
        if not (self.j and self.weight):
            return
        noise = self.p["mag_noise"] ** 2 / (self.j * self.T2)
        beyond = abs(self.e) / (LIMIT + LIMIT_DOUBT * self.doubt)
        noise *= max(1.0, beyond)
        self._watch_heading(beyond > 1)
        late = self.n > self.steps(self.p["bias_after"])
        self._take([1, 0, 0, 0], self.e, noise, SHARE if late else 0.0)

    def _watch_heading(self, beyond):
        """FAR: for how long the heading has been off to the same side, by more than its doubt."""
        if beyond:
            step = self.j if self.e >= 0 else -self.j
            self.far = step + (self.far if (self.far < 0) == (step < 0) else 0)
        else:
            self.far -= self.far // 4
            if self.far > 0:
                self.far -= 1

    def _measure_bias(self):
        """At rest the gyro's axes in turn, in motion the tilt correction north and west."""
        p, unit = self.p, self.unit
        self.axis = (self.axis + 1) % 3
        if self.rest:
            i = self.axis
            row = [0.0] * 4
            row[1 + i] = 1.0
            off = self.low2[3 + i] * self.gyro - self.b[i]
            noise = max(self.rest_noise / self.T2 / 3, self.P[1 + i][1 + i] / STEP_MOST)
            self._take(row, clamp(off, 4 * unit), noise)
            return
        late, full = self.steps(p["bias_after"]), self.steps(p["bias_full"])
        full = max(late + 1, full)
        if self.n <= late:
            return
        i = self.side
        self.side = 1 - i
        noise = min(TILT_MOST * unit**2, math.radians(p["tilt_noise"]) ** 2 / self.T2 / 2)
        noise /= self.tilt_weight
        if self.n < full:
            noise *= (full / self.n) ** 2
        value = clamp(-self.c[i] / (self.level * self.dt), 4 * unit)
        self._take([0.0, *self.y[3 * i : 3 * i + 3]], value, min(noise, NOISE_MOST * unit**2))

    def _apply(self):
        limit = math.radians(self.p["bias_limit_dps"])
        for i in range(3):
            self.b[i] = clamp(self.b[i] + self.dx[1 + i], limit)
        turn = self.turn[2] = clamp(self.dx[0], TURN_MOST)
        if abs(self.dx[0]) > TURN_MOST:  # the rest of it is still to come
            self.P[0][0], self.doubt = OPEN, math.sqrt(OPEN)
        self.dx = [0.0] * 4
        if abs(self.wait_turn + turn) < 2:
            self.wait_turn += turn
        self.still_e = wrap(self.still_e - turn)
