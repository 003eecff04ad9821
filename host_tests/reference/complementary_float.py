"""The Euler-angle method in double-precision floats: what lib/upright/complementary.py is measured against.

Plain Python without numpy; runs on CPython. It takes the integer filter's gains as they were quantised, and the same
decisions (flags, the least norm, the bounds at the pole), so that a comparison measures arithmetic alone.
"""

import math

HALF = math.pi
QUARTER = math.pi / 2
POLE = 1 / 32  # cos(pitch) is not taken for less


def wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


class EulerFloat:
    """The float twin of complementary.Euler6; made by `like`.

    gyro        rad per count and step; bias: rad a step, 3 floats, subtracted
    accel_low   least squared norm / 4 of the accelerometer counts that is used
    gain        the part of the error that is taken up in a step
    midpoint    False: the sines of the step's begin, first order
    angles      [roll, pitch, yaw], rad; error: (roll, pitch), rad, of the last step; used: whether it was
    """

    def __init__(self, gyro, accel_low, gain, bias=(0.0, 0.0, 0.0), midpoint=True):
        self.gyro = gyro
        self.accel_low = accel_low
        self.gain = gain
        self.bias = list(bias)
        self.midpoint = midpoint
        self.angles = [0.0, 0.0, 0.0]
        self.turned = (0.0, 0.0)
        self.error = (0.0, 0.0)
        self.used = False

    @classmethod
    def like(cls, integer, **kw):
        """The twin of a complementary.Euler6: its quantised gains, its bias, its angles."""
        from upright import complementary as c

        s = integer.state
        unit = 2 * math.pi / 2**30
        twin = cls(
            (s[c._G] + s[c._GR] / 32768) * unit,
            s[c._LOW],
            s[c._K] / 2 ** (s[c._K_SHIFT] + 14),
            [(s[c._B + i] + s[c._BR + i] / 32768) * unit for i in range(3)],
            **kw,
        )
        twin.angles = [v * unit for v in s[c._A : c._A + 3]]
        return twin

    def update(self, counts):
        """One step with 11 counts (ax ay az gx gy gz mx my mz temp flags), of any sequence of ints."""
        p, q, r = (counts[3 + i] * self.gyro - self.bias[i] for i in range(3))
        roll, pitch, yaw = self.angles
        half = 0.5 if self.midpoint else 0
        at_roll, at_pitch = roll + half * self.turned[0], pitch + half * self.turned[1]
        sin_roll, cos_roll = math.sin(at_roll), math.cos(at_roll)
        cos_pitch = math.cos(at_pitch)
        if abs(cos_pitch) < POLE:
            cos_pitch = math.copysign(POLE, cos_pitch)
        turned = (q * sin_roll + r * cos_roll) / cos_pitch
        turned = max(-QUARTER, min(QUARTER, turned))
        yaw += turned
        self.turned = (p + turned * math.sin(at_pitch), q * cos_roll - r * sin_roll)
        roll += self.turned[0]
        pitch += self.turned[1]
        if abs(pitch) > QUARTER:
            pitch = math.copysign(HALF, pitch) - pitch
            roll += HALF
            yaw += HALF
            self.turned = (self.turned[0], -self.turned[1])
        x, y, z = counts[:3]
        square = (x * x >> 2) + (y * y >> 2) + (z * z >> 2)
        self.used = counts[10] & 5 == 1 and square >= self.accel_low
        if self.used:
            self.error = (
                wrap(math.atan2(y, z) - roll),
                math.atan2(-x, math.hypot(y, z)) - pitch,
            )
            roll += self.gain * self.error[0]
            pitch += self.gain * self.error[1]
        self.angles = [wrap(roll), pitch, wrap(yaw)]

    @property
    def q(self):
        """The attitude as a quaternion (w, x, y, z)."""
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in self.angles)
        return [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
