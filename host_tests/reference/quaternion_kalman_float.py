"""The quaternion Kalman filter in double-precision floats: what lib/upright/quaternion_kalman.py is measured against.

Needs numpy; runs on CPython. The same model, schedule and order of work as the integer filter, but physical units, full
matrices, true roots and angles, and no rounding. Yes/no decisions are taken here, or copied from the integer run
(`update(counts, decisions)`), so that a comparison measures arithmetic alone.
"""

import math

import numpy as np

from reference.earth_float import EarthFloat, block_of, clamp, rows, turned

# decisions, as lib/upright/quaternion_kalman.py has them in its state
STILL = 1  # gyro and accelerometer near their averages in this block
NEAR = 2  # the field is near its reference
FAR = 4  # heading error beyond what a good field explains
WIDE = 8  # so little is known of the tilt that the accelerometer is believed as it is
RUNAWAY = 16  # an innovation of the velocity was beyond 2.5 sigma
UNDER = 32  # upside down while wide
LEAN = 64  # wide, and still off by much
UPSET = 128  # at rest and tilted: cannot be
ADOPT = 512  # the rest shows another bias than what was taken for one
TILTED = 1024  # one so far off that the tilt is wrong, too
DOUBTED = 256  # so little is known of the heading that the magnetometer is believed as it is

DEFAULTS = {
    "gyro_noise": 0.043,  # deg/s per root Hz
    "bias_walk": 0.0033,  # deg/s per root s
    "scale_error": 0.007,  # root s
    "accel_noise": 0.1,  # g
    "velocity_noise": 1.1,  # m/s per root Hz
    "mag_noise": 0.15,  # rad per root Hz
    "bias_start": 3.3,  # deg/s
    "bias_after": 5.0,  # s
    "rest_noise": 0.03,  # deg/s per root Hz
    "rest_gyro_dps": 2.0,
    "rest_accel_g": 0.05,
    "rest_after": 1.5,  # s
    "field_tolerance": 0.2,
}
BLOCKS_HZ = 45
GRAVITY = 9.80665
SEEDED, HEADING_START = math.radians(12), math.radians(5)
OPEN = 0.75  # rad: (0.75 rad)**2 is 603979776 in Q30
VELOCITY_START = 0.05  # g s
WIDE_VARIANCE = 0.0685  # rad**2, (15 deg)**2
LEAN_VARIANCE = 0.1225  # rad**2, (20 deg)**2
WIDE_FOR = 0.4  # s
CAP = 0.64  # rad**2
FOLD = 0.35  # rad
BIAS_MOST = 25.0  # deg/s
REST_OFF = 0.3  # deg/s
PRIOR = 10.0  # deg/s per root Hz
TURNED = math.radians(3)
REST_TAU = 0.25  # s
FIELD_SMOOTH = 0.05  # s
FIELD_TAU, FIELD_TAU_FAR = 20.0, 100.0  # s
FIELD_AFTER = 0.3  # s
FIELD_DOUBT = 0.1
FAR_RAD, FAR_FOR = 0.55, 5.0  # s
LOST_FOR = 1.0  # s
NOT_BY_MAG = np.array([1, 1, 0, 0, 0, 0, 1, 1], bool)
BIAS = np.array([0, 0, 0, 1, 1, 1, 0, 0], bool)


class QuaternionKalmanFloat(EarthFloat):
    """The float twin of quaternion_kalman.QuaternionKalman9, with 6 axes QuaternionKalman6.

    rate in Hz (float); gyro_scale LSB per deg/s and accel_lsb_per_g as floats; axes 6 or 9; any of DEFAULTS.
    q: [w, x, y, z]; b: the gyro bias in the body, rad/s * T; P: covariance of the error (rotation vector in the earth
    frame in rad, bias in rad a block, horizontal velocity in g * block), as the integer filter has it.
    disagreed: how many decisions would have been taken otherwise here.
    """

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, axes=9, **parameters):
        p = self.chosen(DEFAULTS, parameters)
        self.p, self.axes = p, axes
        self.block = block_of(rate, BLOCKS_HZ)
        self.T = T = self.block / rate
        self.dt = 1 / rate
        self.lsb, self.gyro_scale, self.hz = accel_lsb_per_g, gyro_scale, rate
        self.gyro = math.radians(1 / gyro_scale)  # rad/s of a count
        dps = self.dps = math.radians(1) * T  # rad a block
        self.bias_start = (p["bias_start"] * dps) ** 2
        self.r_velocity = (p["velocity_noise"] / GRAVITY) ** 2 / T**3
        self.r_mag = p["mag_noise"] ** 2 / T
        self.r_rest = (p["rest_noise"] * dps) ** 2 / T / 3
        self.r_prior = (PRIOR * dps) ** 2 / self.T / 48
        self.q_turn = (p["gyro_noise"] * math.radians(1)) ** 2 * T
        self.q_bias = (p["bias_walk"] * dps) ** 2 * T
        self.q_scale = (p["scale_error"] * self.gyro) ** 2 * T  # of a count of rate
        self.P = np.zeros((8, 8))
        self.base = [0.0, 0.0, 0.0]
        self.low1, self.low2 = [0.0] * 6, [0.0] * 6
        self.blocks = self.still = 0
        self.axis = self.wait = self.tipped = self.clip = 0
        self.seen = 0.0  # heading error
        self.good = False
        self.field = self.reference = None
        self.near = self.field_age = self.lost_mag = 0
        self.decided = self.disagreed = 0
        self.R = rows([1.0, 0.0, 0.0, 0.0])
        self.x = np.zeros(8)
        self.set_bias([0.0] * 3)
        self.set_quaternion([1.0, 0.0, 0.0, 0.0])

    def set_bias(self, counts, known_s=0):
        for i in range(3):
            self.low1[3 + i] += self.base[i] - counts[i]
            self.low2[3 + i] += self.base[i] - counts[i]
        self.base = list(counts)
        self.b = np.zeros(3)
        variance = 1 / (1 / self.bias_start + known_s / (3 * self.T * self.r_rest))
        for i in range(3, 6):
            self.open(i, variance)
        self.wait = 0

    def set_quaternion(self, q, seeded=False):
        """seeded: from a sample, so that tilt and heading are known to a few degrees; "level": the tilt alone."""
        norm = math.sqrt(sum(v * v for v in q))
        self.q = [v / norm for v in q]
        self.x = np.zeros(8)
        self.v = [0.0, 0.0]
        self.fold = [0.0] * 3
        self.block_sum, self.mag_sum, self.mag_n = [0.0] * 3, [0.0] * 3, 0
        self.gyro_sum, self.accel_sum = [0] * 3, [0] * 3
        self.phase = 1  # the first block is a whole one
        self.turn = None
        self.since, self.lost, self.lost_mag, self.wide_for, self.clip = 0, 0, 0, 0, 0
        self.young = int(self.p["bias_after"] / self.T + 0.5)
        self.open(0, SEEDED**2 if seeded else OPEN**2)
        self.open(1, SEEDED**2 if seeded else OPEN**2)
        heading = SEEDED if seeded is True else OPEN
        self.open(2, HEADING_START**2 if self.axes == 6 else heading**2)
        self.open(6, (VELOCITY_START / self.T) ** 2)
        self.open(7, (VELOCITY_START / self.T) ** 2)

    def open(self, i, variance):
        """Nothing is known of error i any more, but its size."""
        self.P[i, :] = self.P[:, i] = 0
        self.P[i, i] = variance
        self.x[i] = 0

    def whole(self, seconds):
        return max(1, int(seconds / self.T + 0.5))

    # -- one step
    def update(self, counts, decisions=None):
        fresh = counts[10] & 1
        turn = [
            (counts[3 + i] - self.base[i]) * self.gyro * self.dt - self.b[i] / self.block
            for i in range(3)
        ]
        if fresh:
            f, R = self.fold, self.R
            turn = [turn[i] + R[0][i] * f[0] + R[1][i] * f[1] + R[2][i] * f[2] for i in range(3)]
            self.fold = [0.0] * 3
        self.q = turned(self.q, turn)
        if not fresh:
            return
        self.forced = decisions
        self.clip += bool(counts[10] & 8)
        self.R = rows(self.q)
        a, force = counts[0:3], self.force(counts)
        for i in range(3):
            self.block_sum[i] += force[i] * self.lsb
            self.accel_sum[i] += a[i]
            self.gyro_sum[i] += counts[3 + i]
        self.gather(counts)
        if self.phase == 0:
            self._close()
        elif self.phase == self.block - 1 and self.turn is not None:
            self._filter()
        self.phase = (self.phase + 1) % self.block

    # -- a block: its end, and what is made of it while the next one is measured
    def _close(self):
        """Take the block's means; carry the correction of the block before through this one, and apply it."""
        n, x = self.block, self.x
        self.turn = np.array(self.R)
        self.h = [v / n / self.lsb for v in self.block_sum]
        self.a = [v / n for v in self.accel_sum]
        self.g = [v / n - self.base[i] for i, v in enumerate(self.gyro_sum)]
        self.m, self.m_n = self.mag_sum, self.mag_n
        self.block_sum, self.accel_sum, self.gyro_sum = [0.0] * 3, [0] * 3, [0] * 3
        self.mag_sum, self.mag_n = [0.0] * 3, 0
        x[0:3] -= self.turn @ x[3:6]
        x[6] += x[1]
        x[7] -= x[0]
        self.fold = [clamp(v, FOLD) for v in x[0:3]]
        x[0:3] -= self.fold
        most = BIAS_MOST * self.dps
        for i in range(3):
            self.b[i] = clamp(self.b[i] + x[3 + i], most)
        for i in range(2):
            self.v[i] = clamp(self.v[i] + x[6 + i] + self.h[i], 1023.0)
        x[3:8] = 0
        self.folded = list(self.fold)

    def _filter(self):
        self._propagate()
        self.young = max(0, self.young - 1)
        rest = self._rest()
        self.unlevel = self.wide_for
        self._tilt()
        if self.axes == 9:
            self._heading()
        self.axis = (self.axis + 1) % 48
        i = self.axis % 3
        if rest:
            off = self.low2[3 + i] * self.gyro * self.T - self.b[i]
            tilted = self.decide(TILTED, abs(off) > 4 * REST_OFF * self.dps)
            if self.decide(ADOPT, abs(off) > REST_OFF * self.dps):
                self.open(3 + i, self.bias_start)
                self.b[i] += off
                off = 0.0
            if tilted:
                self._reopen()
            self._measure(3 + i, off, self.r_rest)
        elif self.axis < 3 and self.axes == 6:
            self._measure(3 + i, -self.b[i], self.r_prior)

    def _propagate(self):
        """P of the error after the block: turn += -R bias, then velocity += turn x up."""
        P = self.P
        F = np.eye(8)
        F[0:3, 3:6] = -self.turn
        P = F @ P @ F.T
        F = np.eye(8)
        F[6, 1], F[7, 0] = 1, -1
        P = F @ P @ F.T
        scale = self.q_scale * sum(v * v for v in self.g)
        for i in range(3):
            P[i, i] += self.q_turn + (scale / 16 if i == 2 else scale)
            if self.clip and P[i, i] < OPEN**2:
                most = self.clip * 32768 * self.gyro * self.dt / 2
                P[i, i] = min(OPEN**2, P[i, i] + most**2)
            if P[3 + i, 3 + i] < self.bias_start:
                P[3 + i, 3 + i] += self.q_bias
        if self.clip:
            self.wide_for = min(1, self.wide_for)
            self.clip = 0
        for i in (0, 1, 2, 6, 7):
            if P[i, i] > (CAP if i < 3 else CAP * 1024):
                P[i, :] /= 2
                P[:, i] /= 2
        self.P = P

    def _measure(self, i, z, r, left_out=None):
        """Error i is z with variance r -> was it beyond 2.5 sigma (the bound is 5).

        left_out (mask): errors that this must not correct.
        """
        P = self.P
        if self.young and i not in (3, 4, 5):
            left_out = BIAS if left_out is None else BIAS | left_out
        s = P[i, i] + r
        k = P[:, i] / s
        e = z - self.x[i]
        most = 5 * math.sqrt(s)
        row = P[i].copy()
        change = np.outer(k, row)
        if left_out is not None:
            change[np.outer(left_out, left_out)] = 0
            k = np.where(left_out, 0, k)
        self.x += k * clamp(e, most)
        self.P = P - change
        return abs(e) > most / 2

    def _rest(self):
        """Rest: gyro and accelerometer stay near their two-pole low-passes."""
        self.blocks += 1
        k = max(1 / self.blocks, self.T / (REST_TAU + self.T))
        size = [0.0, 0.0]
        for i, v in enumerate(self.a + self.g):
            self.low1[i] += k * (v - self.low1[i])
            self.low2[i] += k * (self.low1[i] - self.low2[i])
            size[i // 3] += (v - self.low2[i]) ** 2
        still = size[0] < (self.p["rest_accel_g"] * self.lsb) ** 2
        still = still and size[1] < (self.p["rest_gyro_dps"] * self.gyro_scale) ** 2
        contradicted = wait = False
        for i in range(3):
            z = self.low2[3 + i] * self.gyro * self.T
            base = self.base[i] * self.gyro * self.T
            still = still and abs(z) <= BIAS_MOST * self.dps
            off = abs(z - self.b[i]) / self.dps
            if self.P[3 + i, 3 + i] < (0.1 * self.dps) ** 2 and off > REST_OFF:
                contradicted = True
                if abs(z + base) >= abs(self.b[i] + base):
                    wait = True
                    still = still and off <= 8 * REST_OFF
        if still and contradicted:
            self.wait += 1
            if self.wait >= 7 * self.whole(self.p["rest_after"]):
                wait = False
            still = not wait and not (self.good and abs(self.seen) < TURNED)
        else:
            self.wait = 0
        self.still = self.still + 1 if self.decide(STILL, still) else 0
        after = self.whole(self.p["rest_after"])
        rest = self.still >= after
        self.still = min(self.still, after)
        force = sum(v * v for v in self.h)
        tipped = rest and math.hypot(*self.h[:2]) > 0.25 and 0.95 < force < 1.05
        self.tipped = self.tipped + 1 if tipped else 0
        if self.decide(UPSET, self.tipped == 8):
            self._reopen()
            self.tipped = 0
        return rest

    def _reopen(self):
        self.open(0, OPEN**2)
        self.open(1, OPEN**2)

    def _tilt(self):
        P, h = self.P, self.h
        if self.decide(WIDE, P[0, 0] + P[1, 1] > 2 * WIDE_VARIANCE):
            e = [clamp(h[1], 2.0), clamp(-h[0], 2.0)]
            under = self.decide(UNDER, h[2] < 0)
            lean = self.decide(LEAN, math.hypot(*e) > 0.1)
            if under:
                most = max(abs(e[0]), abs(e[1])) + 1 / 1024
                if most < 1.5:
                    e = [1.5 * v / most for v in e]
            for i in range(2):
                self._measure(i, e[i] - self.folded[i], self.p["accel_noise"] ** 2)
            self.wide_for += 1
            if under or (lean and self.wide_for < self.whole(WIDE_FOR)):
                for i in range(2):
                    self.P[i, i] = max(self.P[i, i], LEAN_VARIANCE)
            for i in (6, 7):
                self.open(i, (VELOCITY_START / self.T) ** 2)
            self.v = [0.0, 0.0]
            self.lost = 0
            return
        self.wide_for = max(0, min(3, self.wide_for) - 1)
        beyond = [self._measure(6 + i, -self.v[i], self.r_velocity) for i in range(2)]
        self.lost = self.lost + 1 if self.decide(RUNAWAY, any(beyond)) else 0
        if self.lost > self.whole(LOST_FOR):
            self._reopen()
            self.lost = 0

    def _heading(self):
        self.since = min(16, self.since + 1)
        if not self.m_n:
            return
        north, west, up = (v / self.m_n for v in self.m)
        j, self.since = self.since, 0
        e = self.seen = math.atan2(-west, north)
        if self.unlevel:
            return
        now = (math.hypot(north, west), up)
        if self.field is None:
            self.field, self.reference = list(now), list(now)
        f, r = self.field, self.reference
        k = j * self.T / (FIELD_SMOOTH + j * self.T)
        for i in range(2):
            f[i] += k * (now[i] - f[i])
        off = math.hypot(f[0] - r[0], f[1] - r[1]) / math.hypot(*r)
        near = self.decide(NEAR, off < self.p["field_tolerance"])
        self.near = self.near + j if near else 0
        good = self.near >= self.whole(FIELD_AFTER)
        self.field_age += j
        tau = min(FIELD_TAU if good else FIELD_TAU_FAR, self.field_age * self.T + 0.2)
        k = j * self.T / (tau + j * self.T)
        off = math.hypot(now[0] - r[0], now[1] - r[1]) / math.hypot(*r)
        for i in range(2):
            r[i] += k * (f[i] - r[i])
        self.good = good or self.field_age <= self.whole(2)
        if not self.good or self.wide_for:
            return
        noise = self.r_mag / j * (1 + min(8, (off / FIELD_DOUBT) ** 2))
        if self.decide(DOUBTED, self.P[2, 2] > WIDE_VARIANCE):
            noise = min(noise, 0.06)
        if self.decide(FAR, abs(e) > FAR_RAD) and good:
            self.lost_mag += j
            if self.lost_mag > self.whole(FAR_FOR):
                self.lost_mag = 0
                self.open(2, OPEN**2)
        else:
            self.lost_mag = max(0, self.lost_mag - j)
        z = e - self.folded[2]
        z = (z - self.x[2] + math.pi) % (2 * math.pi) - math.pi + self.x[2]
        self._measure(2, z, noise, NOT_BY_MAG)
