"""Mahony's filter in double-precision floats: what lib/mahony.py is measured against.

Plain Python without numpy; runs on CPython. It takes the integer filter's gains as they were
quantised, and the same decisions (flags, the least accelerometer norm, the integral's limit), so
that a comparison measures arithmetic alone.
"""

import math

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
        import mahony

        s = integer.state
        num, den = integer.rate
        rate = num / den
        per_half_angle = 2 * rate  # half angle per step -> rad/s
        gyro = (s[mahony._G] + s[mahony._GR] / 32768) / 2**31 * per_half_angle
        i_shift = s[mahony._I_SHIFT]
        bias = tuple((s[mahony._B + i] + s[mahony._BR + i] / 32768) / 2**31 for i in range(3))
        twin = cls(
            rate,
            gyro,
            s[mahony._LOW],
            s[mahony._KP] / 2 ** (s[mahony._KP_SHIFT] + 14) * rate / 2,
            s[mahony._KI] / 2 ** (s[mahony._KI_SHIFT] + 14) * rate**2 / 2 ** (i_shift + 1),
            s[mahony._I_MAX] / 2 ** (31 + i_shift) * per_half_angle,
            tuple(b * per_half_angle for b in bias),
            **kw,
        )
        twin.q = [v / 2**29 for v in s[mahony._Q : mahony._Q + 4]]
        twin.normalise()
        for i in range(3):
            twin.integral[i] = s[mahony._I + i] / 2 ** (31 + i_shift) * per_half_angle
        return twin

    def normalise(self):
        norm = math.sqrt(sum(v * v for v in self.q))
        self.q = [v / norm for v in self.q]

    def update(self, counts):
        """One step with 11 counts (ax ay az gx gy gz mx my mz temp flags), of any sequence of ints."""
        ax, ay, az, gx, gy, gz = counts[0], counts[1], counts[2], counts[3], counts[4], counts[5]
        q0, q1, q2, q3 = self.q
        b, i = self.bias, self.integral
        scale = self.gyro
        wx, wy, wz = gx * scale - b[0], gy * scale - b[1], gz * scale - b[2]
        # the integer filter's own comparison, truncation of each square included
        long_enough = (ax * ax >> 2) + (ay * ay >> 2) + (az * az >> 2) >= self.accel_low
        self.fed_back = counts[10] & 5 == 1 and long_enough
        if self.fed_back:
            norm = math.sqrt(ax * ax + ay * ay + az * az)
            vx = 2 * (q1 * q3 - q0 * q2)
            vy = 2 * (q0 * q1 + q2 * q3)
            vz = q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
            e = ((ay * vz - az * vy) / norm, (az * vx - ax * vz) / norm, (ax * vy - ay * vx) / norm)
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


def angle_between(p, q):
    """The angle of the rotation from quaternion p to q in degrees, both of any length; exact for small angles."""
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = p[0] * q[2] - p[2] * q[0] - p[3] * q[1] + p[1] * q[3]
    z = p[0] * q[3] - p[3] * q[0] - p[1] * q[2] + p[2] * q[1]
    return math.degrees(2 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w)))
