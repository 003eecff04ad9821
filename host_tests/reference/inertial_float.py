"""The inertial-frame Mahony filter in double-precision floats: what lib/upright/inertial.py is measured against.

Plain Python without numpy; runs on CPython. Same schedule and same order of work as the integer filter (what runs every
step, what every BLOCK steps), but physical units, true roots and angles, and no rounding. Yes/no decisions are taken
here, or copied from the integer run (`update(counts, decisions)`), so that a comparison measures arithmetic alone.
"""

import math

# decisions, as lib/upright/inertial.py has them in its state
STILL = 1  # gyro and accelerometer near their averages in this block
NEAR_REFERENCE = 2  # field near the reference
NEAR_CANDIDATE = 4  # field near the candidate for a new reference
TURNING = 8  # turning quickly enough to learn a field
FAR = 16  # heading error beyond what a good field explains
OVER = 32  # more than 90 degrees from level (this one is taken every step)
AGREES = 64  # heading near enough for a new reference
UPSET = 128  # a tilt error at rest that cannot be

DEFAULTS = {
    "tau_tilt": 3.0,
    "tau_heading": 10.0,
    "tau_doubt": 2.0,
    "ramp_tilt": 0.5,
    "ramp_heading": 0.75,
    "bias_after": 5.0,
    "bias_limit_dps": 6.0,
    "rest_gyro_dps": 2.0,
    "rest_accel_g": 0.051,
    "rest_after": 1.5,
    "rest_dps": 0.5,
    "upset_g": 0.25,
    "field_tolerance": 0.2,
    "field_after": 0.3,
    "field_tau": 20.0,
    "field_first": 5.0,
    "field_new": 20.0,
    "field_dps": 20.0,
    "field_agree": 0.5,
    "reject_for": 60.0,
    "restart_rad": 0.55,
    "restart_after": 5.0,
    "outage": 0.5,
}
REST_TAU = 0.25  # s
FIELD_SMOOTH = 0.05  # s
INFORMATION_FIRST = 1.0  # s
INFORMATION_MOTION = 150.0  # s
INFORMATION_KNOWN = 20.0  # s
REST_WEIGHT = 100.0
HEADING_WEIGHT = 0.1
HALF_WEIGHT_G = 0.3
HEADING_RATE_DPS = 3.0
LIMIT = 0.16  # rad
LIMIT_U = 1.0  # rad per unit of uncertainty
LIMIT_AFTER = 10.0  # s
REJECTED_WEIGHT = 0.5


def block_of(rate):
    """Steps of a block: the power of two that takes 22 to 44 ms."""
    block = 4
    while rate / block >= 45:
        block *= 2
    return block


def clamp(v, limit):
    return limit if v > limit else -limit if v < -limit else v


class EarthFloat:
    """What both float twins do that average in the earth frame."""

    def chosen(self, defaults, parameters):
        unknown = set(parameters) - set(defaults)
        if unknown:
            raise TypeError(f"no parameter {min(unknown)!r}")
        return defaults | parameters

    def decide(self, bit, value):
        if self.forced is not None:
            taken = bool(self.forced & bit)
            self.disagreed += taken != bool(value)
            value = taken
        self.decided = self.decided | bit if value else self.decided & ~bit
        return bool(value)

    def gather(self, counts):
        """A fresh magnetometer sample into its sum in the earth frame."""
        m = counts[6:9]
        if self.axes == 9 and counts[10] & 2 and any(m) and max(abs(v) for v in m) < 32767:
            for i, row in enumerate(self.R):
                self.mag_sum[i] += row[0] * m[0] + row[1] * m[1] + row[2] * m[2]
            self.mag_n += 1


class InertialFloat(EarthFloat):
    """The float twin of inertial.Inertial9, and by axes and lite of the others there.

    rate in Hz (float); gyro_scale LSB per deg/s and accel_lsb_per_g as floats; axes 6 or 9; lite: no field rejection
    and no heading restart; any of DEFAULTS.
    q: [w, x, y, z]; b: learned bias, rad/s; rest: bool; weight: 1 field accepted, 0 or 0.5 rejected;
    disagreed: how many decisions would have been taken otherwise here.
    """

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, axes=9, lite=False, **parameters):
        p = self.chosen(DEFAULTS, parameters)
        self.p = p
        self.dt = 1 / rate
        self.block = block_of(rate)
        self.T = self.block / rate
        self.gyro = math.radians(1 / gyro_scale)
        self.lsb = accel_lsb_per_g
        self.axes, self.lite = axes, lite
        self.base = [0.0, 0.0, 0.0]
        self.b = [0.0, 0.0, 0.0]
        self.information = [INFORMATION_FIRST] * 3
        self.phase = 1
        self.gyro_sum = [0, 0, 0]
        self.blocks = 0  # of the rest detector
        self.low1, self.low2 = [0.0] * 6, [0.0] * 6
        self.still = self.rest = 0
        self.field, self.reference, self.candidate = None, None, None
        self.near = self.candidate_for = 0
        self.rejected = self.whole(p["reject_for"])
        self.weight = 1.0 if lite else 0.0
        self.tilt_weight = 1.0
        self.ramp_tilt, self.ramp_heading = (
            round(p[name] * 256) / 256 for name in ("ramp_tilt", "ramp_heading")
        )
        self.late = int(p["bias_after"] * rate + 0.5)
        self.decided = self.disagreed = 0
        self.set_quaternion([1.0, 0.0, 0.0, 0.0])

    def whole(self, seconds):
        """Blocks."""
        return int(seconds / self.T + 0.5)

    def set_quaternion(self, q):
        norm = math.sqrt(sum(v * v for v in q))
        self.q = [v / norm for v in q]
        self.n = self.heading_n = self.lost = 0
        self.s = [0.0, 0.0, 1.0]
        self.c = [0.0, 0.0, 0.0]  # correction (earth), rad/s
        self.C = [0.0, 0.0, 0.0]  # correction (body) that the next step applies, rad
        self.d = 0.0
        self.x, self.y, self.z = [0.0] * 6, [0.0] * 6, [0.0] * 3
        self.zk = self.push = 0.0
        self.mag_sum = [0.0, 0.0, 0.0]
        self.mag_n = self.since = self.j = self.gap = 0

    # -- one step
    def update(self, counts, decisions=None):
        fresh = counts[10] & 1
        dt = self.dt
        turn = [(counts[3 + i] - self.base[i]) * self.gyro * dt - self.b[i] * dt for i in range(3)]
        if fresh:
            turn = [turn[i] + self.C[i] for i in range(3)]
        self.q = turned(self.q, turn)
        if not fresh:
            self.gap += 1
            return
        if self.gap >= int(self.p["outage"] / dt + 0.5):
            self.n = self.heading_n = 0
        self.gap = 0
        self.forced = decisions
        self.n += 1
        K = max(1 / self.p["tau_tilt"], 1 / (self.ramp_tilt * self.n * dt + 2 * dt))
        R = self.R = rows(self.q)
        a = counts[0:3]
        h = [(r[0] * a[0] + r[1] * a[1] + r[2] * a[2]) / self.lsb for r in R]
        s = self.s
        k = 2 * K * dt
        self.off = [h[i] - s[i] for i in range(3)]
        for i in range(3):
            s[i] += k * self.off[i]
        c0, c1 = clamp(K * s[1], K), clamp(-K * s[0], K)
        if self.decide(OVER, s[2] < 0):
            n = math.sqrt(s[0] * s[0] + s[1] * s[1])
            if n < 1:
                c0, c1 = 1.4 * c0 / (n + 1 / 1024), 1.4 * c1 / (n + 1 / 1024)
        self.K, self.c = K, [c0, c1]
        self.C = [(R[0][i] * c0 + R[1][i] * c1) * dt for i in range(3)]
        for i in range(3):
            self.gyro_sum[i] += counts[3 + i]
        self.gather(counts)
        if self.phase == 0:
            self._rest(counts)
        elif self.phase == 1:
            self._regressors()
        elif self.phase == 2:
            self._compass()
        elif self.phase == 3 and self.j and not self.lite:
            self._field(counts)
        # a block of four steps has no room for one part a step
        if self.phase == (3 if self.block == 4 else 4):
            self._steer()
        if self.phase == (3 if self.block == 4 else 5):
            self._bias()
        self.phase = (self.phase + 1) % self.block

    # -- parts of a block
    def _rest(self, counts):
        """Rest: gyro and accelerometer stay near their two-pole low-passes."""
        self.blocks += 1
        k = max(1 / self.blocks, self.T / (REST_TAU + self.T))
        mean = [v / self.block - self.base[i] for i, v in enumerate(self.gyro_sum)]
        self.gyro_sum = [0, 0, 0]
        now = [counts[3 + i] - self.base[i] for i in range(3)] + list(counts[0:3])
        size = [0.0, 0.0]
        for i, v in enumerate(mean + list(counts[0:3])):
            self.low1[i] += k * (v - self.low1[i])
            self.low2[i] += k * (self.low1[i] - self.low2[i])
            size[i // 3] += (now[i] - self.low2[i]) ** 2
        dps = math.radians(1) / self.gyro
        still = size[0] < (self.p["rest_gyro_dps"] * dps) ** 2
        still = still and size[1] < (self.p["rest_accel_g"] * self.lsb) ** 2
        for i in range(3):
            still = still and abs(self.low2[i]) <= self.p["bias_limit_dps"] * dps
            if self.information[i] > INFORMATION_KNOWN:
                off = abs(self.low2[i] - self.b[i] / self.gyro)
                still = still and off <= self.p["rest_dps"] * dps
        self.still = self.still + 1 if self.decide(STILL, still) else 0
        after = max(1, self.whole(self.p["rest_after"]))
        upset = math.hypot(*self.s[:2]) > self.p["upset_g"]
        if self.decide(UPSET, self.still >= after and upset):
            self.n = self.still = 0
            if not self.lite:
                self.heading_n = 0
        self.rest = self.still >= after

    def _regressors(self):
        """The earth's horizontal axes in the body, filtered as the tilt correction is."""
        k = min(0.5, self.K * self.T)
        v = [*self.R[0], *self.R[1]]
        for i in range(6):
            self.x[i] += 2 * k * (v[i] - self.y[i] - self.x[i])
            self.y[i] += k * self.x[i]
        off = sum(clamp(v, 3.0) ** 2 for v in self.off[:2]) / HALF_WEIGHT_G**2
        self.d += 2 * k * (off - self.d)
        self.tilt_weight = 1 / (1 + self.d)

    def _compass(self):
        """The heading error, and the pair (horizontal, vertical) field."""
        self.since = min(16, self.since + 1)
        self.j = 0
        if not self.mag_n:
            return
        n, w, up = (v / self.mag_n for v in self.mag_sum)
        self.mag_sum, self.mag_n = [0.0, 0.0, 0.0], 0
        self.j, self.since = self.since, 0
        self.e = math.atan2(-w, n)
        self.now = math.hypot(n, w), up

    def _steer(self):
        """The turn about up that the heading error asks for, bounded; it never touches tilt."""
        self.push = self.zk = 0.0
        if not (self.j and self.weight):
            self.j = 0
            return
        e, j = self.e, self.j
        u = sum(self.R[2][i] ** 2 / self.information[i] for i in range(3))
        self.heading_n += j
        if not self.lite:
            far = self.decide(FAR, abs(e) > self.p["restart_rad"])
            good = self.weight == 1 and self.reference
            self.lost = self.lost + j if far and good else max(0, self.lost - j)
            if self.lost > self.whole(self.p["restart_after"]):
                self.heading_n = self.lost = 0
        slow = self.T * max(1 / self.p["tau_heading"], u / self.p["tau_doubt"])
        ramp = 1 / (self.ramp_heading * self.heading_n + 2 * j)
        if ramp <= slow or self.heading_n >= self.whole(LIMIT_AFTER):
            e = clamp(e, LIMIT + LIMIT_U * u)
        k = min(max(slow, ramp) * self.weight, 0.5 / j)
        self.push = k * e
        self.zk = k * j
        angle = clamp(self.push * j, 0.5)
        for i in range(3):
            self.C[i] += self.R[2][i] * angle

    def _field(self, counts):
        """The weight of the heading: whether the field is that of the reference."""
        p, now, j = self.p, self.now, self.j
        if self.field is None:
            self.field, self.candidate = list(now), list(now)
        f, d = self.field, self.candidate
        k = j * self.T / (FIELD_SMOOTH + j * self.T)
        for i in range(2):
            f[i] += k * (now[i] - f[i])

        def near(r):
            return math.hypot(f[0] - r[0], f[1] - r[1]) < p["field_tolerance"] * math.hypot(*r)

        k, ok, r = min(1 / 16, j * self.T / (p["field_tau"] + j * self.T)), False, self.reference
        if self.decide(NEAR_REFERENCE, r is not None and near(r)):
            self.near += j
            if self.near >= max(1, self.whole(p["field_after"])):
                ok = True
                for i in range(2):
                    r[i] += k * (f[i] - r[i])
        else:
            self.near = 0
        rate = math.sqrt(
            sum(((counts[3 + i] - self.base[i]) * self.gyro - self.b[i]) ** 2 for i in range(3))
        )
        turning = self.decide(TURNING, rate >= math.radians(p["field_dps"]))
        if self.decide(NEAR_CANDIDATE, near(d)):
            if turning or r is None:
                self.candidate_for += j
            for i in range(2):
                d[i] += k * (f[i] - d[i])
        else:
            self.candidate_for, self.candidate = 0, list(f)
        after = self.whole(p["field_new"] if r else p["field_first"])
        agrees = self.decide(AGREES, abs(self.e) < p["field_agree"]) or r is None
        if not ok and self.near == 0 and self.candidate_for >= after and agrees:
            self.reference, self.near, ok = list(self.candidate), self.whole(p["field_after"]), True
        if ok:
            self.rejected = max(0, self.rejected - 2 * j)
            self.weight = 1.0
            return
        self.weight = REJECTED_WEIGHT
        if self.rejected <= self.whole(p["reject_for"]):
            self.rejected += j
            self.weight = 0.0
        if not self.reference:
            self.weight = 1.0

    def _bias(self):
        """Information, bias and the regressor of the heading."""
        T, b, info, y = self.T, self.b, self.information, self.y
        for i in range(3):
            self.z[i] += self.zk * (self.R[2][i] - self.z[i])
        z = self.z
        late = self.n > self.late
        rate = clamp(self.push / T, math.radians(HEADING_RATE_DPS))
        for i in range(3):
            if info[i] > INFORMATION_FIRST:
                info[i] -= T * (info[i] / INFORMATION_MOTION) ** 2
            u = 0.0
            if self.rest:
                info[i] += REST_WEIGHT * T
                u = -REST_WEIGHT * T * (self.low2[i] * self.gyro - b[i])
            elif late:
                w = self.tilt_weight * T
                info[i] += w * (y[i] ** 2 + y[3 + i] ** 2)
                u = w * (y[i] * self.c[0] + y[3 + i] * self.c[1])
                w = HEADING_WEIGHT * self.j * T
                info[i] += w * z[i] ** 2
                u += w * z[i] * rate
            b[i] = clamp(b[i] - u / info[i], math.radians(self.p["bias_limit_dps"]))


def turned(q, angle):
    """q turned by the rotation vector `angle` (rad, body), normalised."""
    x, y, z = angle
    n = math.sqrt(x * x + y * y + z * z) / 2
    c, s = math.cos(n), (math.sin(n) / n if n > 1e-9 else 1.0) / 2
    x, y, z = x * s, y * s, z * s
    a, b, d, e = q
    r = (
        a * c - b * x - d * y - e * z,
        b * c + a * x + d * z - e * y,
        d * c + a * y + e * x - b * z,
        e * c + a * z + b * y - d * x,
    )
    n = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3])
    return [v / n for v in r]


def rows(q):
    """The rotation matrix: rows are the earth's north, west and up in the body."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def start(counts, axes=9):
    """The attitude of one accelerometer (and magnetometer, flags bit 1) sample; yaw 0 (order zyx) without one."""
    x, y, z = counts[0:3]
    roll, pitch = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
    q = turned([math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0], [roll, 0, 0])
    if axes == 9 and counts[10] & 2 and any(counts[6:9]):
        R, m = rows(q), counts[6:9]
        n, w = (r[0] * m[0] + r[1] * m[1] + r[2] * m[2] for r in R[:2])
        yaw = math.atan2(-w, n) / 2
        c, s = math.cos(yaw), math.sin(yaw)
        a, b, d, e = q
        q = [c * a - s * e, c * b - s * d, c * d + s * b, c * e + s * a]
    return q
