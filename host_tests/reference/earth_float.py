"""What the float twins share that average in the earth frame: inertial_float.py and quaternion_kalman_float.py.

Plain Python without numpy; runs on CPython.
"""

import math


def block_of(rate, blocks_hz):
    """Steps of a block: the least power of two, 4 or more, with which there are fewer than blocks_hz a second."""
    block = 4
    while rate / block >= blocks_hz:
        block *= 2
    return block


def clamp(v, limit):
    return limit if v > limit else -limit if v < -limit else v


def wrap(angle):
    return math.remainder(angle, 2 * math.pi)


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

    full_end = full_steps = 0  # the end of which axis is full, and for how many steps
    full_sum = later = (0.0, 0.0, 0.0)  # what they said, less 1 g; and earlier ones

    def force(self, counts):
        """The specific force in the earth frame in g. An axis at full scale is believed once it has come back."""
        a = counts[0:3]
        f = [(row[0] * a[0] + row[1] * a[1] + row[2] * a[2]) / self.lsb for row in self.R]
        end = 0
        if counts[10] & 4:
            axis = max(range(3), key=lambda i: abs(a[i]))
            end = 1 + 2 * axis + (a[axis] < 0)
        most = self.hz * self.lsb // 32100
        if end != self.full_end:
            if self.full_steps <= most:
                self.later = [v + u for v, u in zip(self.later, self.full_sum, strict=True)]
            self.full_end, self.full_steps, self.full_sum = end, 0, (0.0, 0.0, 0.0)
        if end:
            if self.full_steps <= most:
                self.full_steps += 1
                self.full_sum = [
                    u + v - g for u, v, g in zip(self.full_sum, f, (0, 0, 1), strict=True)
                ]
            f = [0.0, 0.0, 1.0]
        room = [max(0.0, 32768 / self.lsb - abs(v)) for v in f]
        taken = [clamp(v, r) for v, r in zip(self.later, room, strict=True)]
        self.later = [v - u for v, u in zip(self.later, taken, strict=True)]
        return [v + u for v, u in zip(f, taken, strict=True)]

    def gather(self, counts):
        """A fresh magnetometer sample into its sum in the earth frame."""
        m = counts[6:9]
        wanted = self.axes == 9 and counts[10] & 2 and self.mag_n < 64
        if wanted and any(m) and max(abs(v) for v in m) < 32767:
            for i, row in enumerate(self.R):
                self.mag_sum[i] += row[0] * m[0] + row[1] * m[1] + row[2] * m[2]
            self.mag_n += 1


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
