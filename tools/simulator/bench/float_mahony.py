# Mahony's filter as it is usually written for MicroPython, in floats: what the integer filter is
# timed against. Six axes, first-order integration, no gates beyond a zero accelerometer. Every
# float operation allocates.

import math


class FloatMahony:
    """kp, ki in rad/s and rad/s**2; update(counts) with counts as in array('h') ax ay az gx gy gz ..."""

    def __init__(self, rate_hz, lsb_per_dps, kp=0.5, ki=0.0):
        self.dt = 1 / rate_hz
        self.gyro = math.pi / 180 / lsb_per_dps
        self.kp = kp
        self.ki = ki
        self.q0, self.q1, self.q2, self.q3 = 1.0, 0.0, 0.0, 0.0
        self.ix = self.iy = self.iz = 0.0

    def update(self, counts):
        ax, ay, az = counts[0], counts[1], counts[2]
        gx, gy, gz = counts[3] * self.gyro, counts[4] * self.gyro, counts[5] * self.gyro
        q0, q1, q2, q3 = self.q0, self.q1, self.q2, self.q3
        norm = math.sqrt(ax * ax + ay * ay + az * az)
        if norm > 0:
            ax /= norm
            ay /= norm
            az /= norm
            vx = 2 * (q1 * q3 - q0 * q2)
            vy = 2 * (q0 * q1 + q2 * q3)
            vz = q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
            ex = ay * vz - az * vy
            ey = az * vx - ax * vz
            ez = ax * vy - ay * vx
            self.ix += self.ki * ex * self.dt
            self.iy += self.ki * ey * self.dt
            self.iz += self.ki * ez * self.dt
            gx += self.kp * ex + self.ix
            gy += self.kp * ey + self.iy
            gz += self.kp * ez + self.iz
        half = self.dt / 2
        gx *= half
        gy *= half
        gz *= half
        p0 = q0 - q1 * gx - q2 * gy - q3 * gz
        p1 = q1 + q0 * gx + q2 * gz - q3 * gy
        p2 = q2 + q0 * gy - q1 * gz + q3 * gx
        p3 = q3 + q0 * gz + q1 * gy - q2 * gx
        norm = math.sqrt(p0 * p0 + p1 * p1 + p2 * p2 + p3 * p3)
        self.q0 = p0 / norm
        self.q1 = p1 / norm
        self.q2 = p2 / norm
        self.q3 = p3 / norm
