# The readings of one step of an AHRS in floats: degrees, g, degC. All values belong to the same step.
# Needs fixmath.py and what tick.py publishes. It uses floats and allocates: not for interrupts. Every port.

import math
from array import array

from upright import fixmath
from upright import tick as ticks


class Reading:
    """The newest step of an AHRS at the time when this was made.

    step   the number of the step, from 1; 0: the attitude of the start, before the first step
    flags  of its sample: bit 0 fresh, bit 1 with a fresh magnetometer sample, bits 2 and 3 an axis of the accelerometer
           or the gyro at full scale
    """

    def __init__(self, ahrs):
        self._ahrs = ahrs
        self._words = words = array("i", [0] * ticks.SNAPSHOT_WORDS)
        bias = array("i", [0] * 3)
        tick = ahrs.tick
        while True:
            tick.snapshot(words)
            ahrs.filter.bias_mdps(bias)  # which the filter changes with each step
            if words[ticks.STEPS] == tick.steps:
                break
        self._bias = bias
        self._zero = ahrs.yaw_zero
        self.step = words[ticks.STEPS]
        self.flags = words[ticks.FLAGS]

    def angles(self, order=None):
        """(roll, pitch, yaw) in degrees; yaw within +-180, positive to the left; order "zyx", "zxy"; None: EULER."""
        mdeg = self._mdeg(order or self._ahrs.settings.EULER)
        yaw = (mdeg[2] - self._zero[0] + 180000) % 360000 - 180000
        return mdeg[0] / 1000, mdeg[1] / 1000, yaw / 1000

    def quaternion(self):
        """(w, x, y, z) of unit length: turns body vectors into the earth frame."""
        words = self._words
        w, x, y, z = words[0], words[1], words[2], words[3]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        half = -math.radians(self._zero[0] / 1000) / 2
        c, s = math.cos(half) / norm, math.sin(half) / norm
        return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w

    def rates(self):
        """Angular rates about body x, y, z in deg/s, without the gyro's bias."""
        num, den = self._ahrs.sensor.gyro_scale
        words = self._words
        return tuple([words[ticks.GYRO + i] * den / num - self._bias[i] / 1000 for i in range(3)])

    def acceleration(self):
        """What the accelerometer measures along body x, y, z in g: +1 on z at rest and level."""
        lsb = self._ahrs.sensor.accel_lsb_per_g
        return tuple([self._words[ticks.ACCEL + i] / lsb for i in range(3)])

    def linear_acceleration(self, frame="body"):
        """The same without gravity, in g, in the "body" or the "earth" frame."""
        w, x, y, z = self.quaternion()
        a, b, c = self.acceleration()
        a -= 2 * (x * z - w * y)
        b -= 2 * (w * x + y * z)
        c -= w * w - x * x - y * y + z * z
        if frame == "body":
            return a, b, c
        if frame != "earth":
            raise ValueError('frame is %r, expected "body" or "earth"' % (frame,))
        # v + 2 q x (q x v + w v)
        i = y * c - z * b + w * a
        j = z * a - x * c + w * b
        k = x * b - y * a + w * c
        return a + 2 * (y * k - z * j), b + 2 * (z * i - x * k), c + 2 * (x * j - y * i)

    def heading(self):
        """Direction of body x in degrees clockwise from true north, 0..360; None with six axes or no magnetometer."""
        ahrs = self._ahrs
        if ahrs.filter.AXES < 9 or ahrs.magnetometer is None:
            return None
        return (ahrs.settings.DECLINATION - self._mdeg(ahrs.settings.EULER)[2] / 1000) % 360

    def turns(self):
        """The yaw with its full turns since the start or zero_yaw(), in turns to the left."""
        return (self.unwrapped_mdeg() - self._zero[1]) / 360000

    def unwrapped_mdeg(self):
        """The yaw in millidegrees with all its full turns, before zero_yaw()."""
        whole = self._mdeg("zyx")[2] + 360000 * self._words[ticks.TURNS]
        order = self._ahrs.settings.EULER
        if order == "zyx":
            return whole
        # full turns are counted for the yaw of zyx; the yaw of the other order is within half a turn of it
        yaw = self._mdeg(order)[2]
        return yaw + 360000 * ((whole - yaw + 180000) // 360000)

    def _mdeg(self, order):
        """Roll, pitch, yaw in millidegrees, before zero_yaw()."""
        mdeg = array("i", [0] * 3)
        fixmath.euler(self._words, mdeg, order)
        return mdeg

    def temperature(self):
        """Temperature of the sensor chip in degC."""
        return self._ahrs.sensor.temperature_cdeg(self._words[ticks.TEMPERATURE]) / 100
