"""Mahony's filter in double-precision floats: what lib/upright/mahony.py is measured against.

Plain Python without numpy; runs on CPython. It takes the integer filter's gains as they were
quantised, and the same decisions (flags, the least norms, the integral's limit, the steps that a
magnetometer sample stands for), so that a comparison measures arithmetic alone.
"""

import math

from upright_host import words

AT = words.places("mahony")

EXACT = 0  # the closed form instead of a number of terms


def step(d, order=EXACT):
    """(c, s) so that q (x) (c, s*d) turns q by the half angle d (a 3-vector, rad).

    order 1..4: so many terms of the Picard series of the quaternion's differential equation, as in
    textbooks on strapdown navigation: 1; 1 - n/2, 1; 1 - n/2, 1 - n/6; 1 - n/2 + n^2/24, 1 - n/6
    with n = d.d.
    """
    n = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    if order == EXACT:
        norm = math.sqrt(n)
        return math.cos(norm), math.sin(norm) / norm if norm > 1e-9 else 1.0
    if not 1 <= order <= 4:
        raise ValueError(f"order {order!r} is not 1..4 or EXACT")
    c = (1, 1 - n / 2, 1 - n / 2, 1 - n / 2 + n * n / 24)[order - 1]
    return c, 1.0 if order < 3 else 1 - n / 6


class MahonyFloat:
    """The float twin of mahony.Mahony6.

    rate_hz           samples per second
    gyro              rad/s per count
    accel_low         least squared norm / 4 of the accelerometer counts that gives feedback
    kp, ki            rad/s and rad/s**2 per unit of error
    integral_limit    rad/s
    bias              rad/s, 3-tuple, subtracted
    order             EXACT, or 1..4 terms of the Picard series
    in_place          True: each component of the first-order step uses the already changed ones, as much tutorial
                      code does by mistake (order must be 1)
    q                 [w, x, y, z]; integral: rad/s, 3 floats; fed_back: whether the last step used the accelerometer
    """

    def __init__(
        self,
        rate_hz,
        gyro,
        accel_low,
        kp,
        ki,
        integral_limit,
        bias=(0.0, 0.0, 0.0),
        order=EXACT,
        in_place=False,
    ):
        if in_place and order != 1:
            raise ValueError("in_place belongs to order 1")
        self.dt = 1 / rate_hz
        self.gyro = gyro
        self.accel_low = accel_low
        self.kp = kp
        self.ki = ki
        self.integral_limit = integral_limit
        self.bias = bias
        self.order = order
        self.in_place = in_place
        self.q = [1.0, 0.0, 0.0, 0.0]
        self.integral = [0.0, 0.0, 0.0]
        self.fed_back = False

    @classmethod
    def like(cls, integer, **kw):
        """The twin of a mahony.Mahony6: its quantised gains, its bias, its attitude."""

        s = integer.state
        num, den = integer.rate
        rate = num / den
        per_half_angle = 2 * rate  # half angle per step -> rad/s
        gyro = (s[AT.G] + s[AT.GR] / 32768) / 2**31 * per_half_angle
        i_shift = s[AT.I_SHIFT]
        bias = tuple((s[AT.B + i] + s[AT.BR + i] / 32768) / 2**31 for i in range(3))
        twin = cls(
            rate,
            gyro,
            s[AT.LOW],
            s[AT.KP] / 2 ** (s[AT.KP_SHIFT] + 14) * rate / 2,
            s[AT.KI] / 2 ** (s[AT.KI_SHIFT] + 14) * rate**2 / 2 ** (i_shift + 1),
            s[AT.I_MAX] / 2 ** (31 + i_shift) * per_half_angle,
            tuple(b * per_half_angle for b in bias),
            **kw,
        )
        twin.q = [v / 2**29 for v in s[AT.Q : AT.Q + 4]]
        twin.normalise()
        for i in range(3):
            twin.integral[i] = s[AT.I + i] / 2 ** (31 + i_shift) * per_half_angle
        return twin

    def normalise(self):
        norm = math.sqrt(sum(v * v for v in self.q))
        self.q = [v / norm for v in self.q]

    def error(self, counts):
        """The error that is fed back in this step, or None."""
        ax, ay, az = counts[0], counts[1], counts[2]
        q0, q1, q2, q3 = self.q
        self.fed_back = counts[10] & 5 == 1 and quarter_square(ax, ay, az) >= self.accel_low
        if not self.fed_back:
            return None
        norm = math.sqrt(ax * ax + ay * ay + az * az)
        vx = 2 * (q1 * q3 - q0 * q2)
        vy = 2 * (q0 * q1 + q2 * q3)
        vz = q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
        return ((ay * vz - az * vy) / norm, (az * vx - ax * vz) / norm, (ax * vy - ay * vx) / norm)

    def update(self, counts):
        """One step with 11 counts (ax ay az gx gy gz mx my mz temp flags), of any sequence of ints."""
        gx, gy, gz = counts[3], counts[4], counts[5]
        q0, q1, q2, q3 = self.q
        b, i = self.bias, self.integral
        scale = self.gyro
        wx, wy, wz = gx * scale - b[0], gy * scale - b[1], gz * scale - b[2]
        e = self.error(counts)
        if e:
            gain, limit = self.ki * self.dt, self.integral_limit
            for j in range(3):
                i[j] = max(-limit, min(limit, i[j] + gain * e[j]))
            wx += self.kp * e[0]
            wy += self.kp * e[1]
            wz += self.kp * e[2]
        half = self.dt / 2
        x, y, z = (wx + i[0]) * half, (wy + i[1]) * half, (wz + i[2]) * half
        if self.in_place:
            q0 = q0 + (-q1 * x - q2 * y - q3 * z)
            q1 = q1 + (q0 * x - q3 * y + q2 * z)
            q2 = q2 + (q3 * x + q0 * y - q1 * z)
            q3 = q3 + (-q2 * x + q1 * y + q0 * z)
        else:
            c, s = step((x, y, z), self.order)
            x, y, z = x * s, y * s, z * s
            q0, q1, q2, q3 = (
                q0 * c - q1 * x - q2 * y - q3 * z,
                q1 * c + q0 * x + q2 * z - q3 * y,
                q2 * c + q0 * y + q3 * x - q1 * z,
                q3 * c + q0 * z + q1 * y - q2 * x,
            )
        norm = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        self.q = [q0 / norm, q1 / norm, q2 / norm, q3 / norm]


class Mahony9Float(MahonyFloat):
    """The float twin of mahony.Mahony9; made by `like`.

    The magnetometer's error is written as in the widespread code: the field in the earth frame, its
    horizontal part turned to north, back in the body as w, and e = m x w.

    mag_most  the most steps that a magnetometer sample stands for
    mag_age   steps since the one used last
    """

    mag_most = 1
    mag_age = math.inf

    @classmethod
    def like(cls, integer, **kw):

        twin = super().like(integer, **kw)
        twin.mag_most = integer.state[AT.MAG_MOST]
        twin.mag_age = integer.mag_age
        return twin

    def error(self, counts):
        e = super().error(counts)
        self.mag_age += 1
        field = counts[6], counts[7], counts[8]
        if counts[10] & 3 != 3 or max(field) == 32767 or min(field) == -32768:
            return e
        if quarter_square(*field) < 64:
            return e
        steps = min(self.mag_age, self.mag_most)
        self.mag_age = 0
        return [
            a + steps * b for a, b in zip(e or (0, 0, 0), self.field_error(*field), strict=True)
        ]

    def field_error(self, mx, my, mz):
        """m x w of the field in any unit."""
        q0, q1, q2, q3 = self.q
        norm = math.sqrt(mx * mx + my * my + mz * mz)
        mx, my, mz = mx / norm, my / norm, mz / norm
        hx = 2 * (
            mx * (0.5 - q2 * q2 - q3 * q3) + my * (q1 * q2 - q0 * q3) + mz * (q1 * q3 + q0 * q2)
        )
        hy = 2 * (
            mx * (q1 * q2 + q0 * q3) + my * (0.5 - q1 * q1 - q3 * q3) + mz * (q2 * q3 - q0 * q1)
        )
        bz = 2 * (
            mx * (q1 * q3 - q0 * q2) + my * (q2 * q3 + q0 * q1) + mz * (0.5 - q1 * q1 - q2 * q2)
        )
        bx = math.sqrt(hx * hx + hy * hy)
        wx = 2 * (bx * (0.5 - q2 * q2 - q3 * q3) + bz * (q1 * q3 - q0 * q2))
        wy = 2 * (bx * (q1 * q2 - q0 * q3) + bz * (q0 * q1 + q2 * q3))
        wz = 2 * (bx * (q0 * q2 + q1 * q3) + bz * (0.5 - q1 * q1 - q2 * q2))
        return my * wz - mz * wy, mz * wx - mx * wz, mx * wy - my * wx


def quarter_square(x, y, z):
    """The squared length / 4 that the integer filter compares, truncation of each square included."""
    return (x * x >> 2) + (y * y >> 2) + (z * z >> 2)


def angle_between(p, q):
    """The angle of the rotation from quaternion p to q in degrees, both of any length; exact for small angles."""
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = p[0] * q[2] - p[2] * q[0] - p[3] * q[1] + p[1] * q[3]
    z = p[0] * q[3] - p[3] * q[0] - p[1] * q[2] + p[2] * q[1]
    return math.degrees(2 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w)))
