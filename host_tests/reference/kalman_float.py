"""Kalman filters of angles in double-precision floats: what lib/upright/kalman.py is measured against."""

import math

from reference.complementary_float import EulerFloat


class KalmanFloat(EulerFloat):
    """The float twin of kalman.Kalman6; made by `like`.

    bias_gain   rad of bias a step, per rad of error
    bias_limit  of what is learnt, rad a step
    learnt      rad a step, 3 floats; it is a part of `bias`
    """

    @classmethod
    def like(cls, integer, **kw):
        from upright import kalman as k

        twin = super().like(integer, **kw)
        s = integer.state
        unit = 2 * math.pi / 2 ** (30 + s[k._I_SHIFT])
        twin.bias_gain = s[k._K2] / 2 ** (s[k._K2_SHIFT] + 14 + s[k._I_SHIFT])
        twin.bias_limit = s[k._I_MAX] * unit
        twin.learnt = [v * unit for v in s[k._I : k._I + 3]]
        twin.set = list(twin.bias)
        twin.bias = [a + b for a, b in zip(twin.set, twin.learnt, strict=True)]
        return twin

    def update(self, counts):
        super().update(counts)
        if not self.used:
            return
        roll, pitch, _ = self.angles
        forward, left = self.error[0] * math.cos(pitch), self.error[1]
        sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
        body = (forward * cp, forward * sp * sr + left * cr, forward * sp * cr - left * sr)
        for i in range(3):
            learnt = self.learnt[i] - self.bias_gain * body[i]
            self.learnt[i] = max(-self.bias_limit, min(self.bias_limit, learnt))
            self.bias[i] = self.set[i] + self.learnt[i]


class PerAngleFloat(KalmanFloat):
    """As the widespread code has it: each angle's rate has a bias of its own, whatever the attitude."""

    def update(self, counts):
        for i in range(2):
            self.angles[i] -= self.learnt[i]
        EulerFloat.update(self, counts)
        if self.used:
            for i in range(2):
                self.learnt[i] -= self.bias_gain * self.error[i]


class ScalarFloat:
    """The float twin of kalman.KalmanFilter: the five equations as they stand in a textbook. turn None: no wrap."""

    def __init__(self, x, Q, R, turn=360000):
        self.x = float(x)
        self.Q = Q
        self.R = R
        self.P = R
        self.K = 1.0
        self.turn = turn

    def update(self, z):
        predicted = self.P + self.Q
        self.K = predicted / (predicted + self.R)
        self.x = self.wrap(self.x + self.K * self.wrap(z - self.x))
        self.P = (1 - self.K) * predicted
        return self.x

    def wrap(self, angle):
        return (angle + self.turn / 2) % self.turn - self.turn / 2 if self.turn else angle
