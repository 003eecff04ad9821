# What the attitude filters of this library have in common: how they are told of the sensor, and how they are read.
# Needs fixmath.py. Every port.

import math
from array import array

from micropython import const

from upright import fixmath

_PROBE = const(0)  # always -1, see fixmath.py
_Q = const(1)
_BIAS_MAX = const(8192 * 256)  # 1/256 counts: 62 deg/s at +-250, 500 deg/s at +-2000 deg/s


class Attitude:
    """A filter's scales and state; its quaternion and angles.

    rate              samples per second: (num, den), num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int
    state             array('i'); state[QUATERNION] and the next three words are w x y z in Q29, body to earth

    A filter has besides: NAME, AXES (6 or 9), seed(counts), set_bias(x, y, z), bias(out), bias_mdps(out),
    update(counts), and _attitude(q), which takes four words in Q29 and starts from there. A class below it names update
    again: MicroPython finds it at once then, where a look-up in the class above costs 400 instructions in each step.
    """

    QUATERNION = _Q  # where w x y z (Q29) stand in `state`

    def _begin(self, rate, gyro_scale, accel_lsb_per_g, words):
        """Take the scales, or raise ValueError; make a state of so many words."""
        self.rate = ratio_of(rate, "rate", "Hz")
        self.gyro_scale = ratio_of(gyro_scale, "gyro_scale", "LSB per deg/s")
        if not isinstance(accel_lsb_per_g, int) or not 64 <= accel_lsb_per_g <= 32767:
            raise ValueError(
                "accel_lsb_per_g is %r, expected an int, 64..32767" % (accel_lsb_per_g,)
            )
        self.accel_lsb_per_g = accel_lsb_per_g
        self.state = self._s = s = array("i", [0] * words)
        self._q = memoryview(s)[_Q : _Q + 4]
        s[_PROBE] = -1
        return s

    def set_quaternion(self, w, x, y, z):
        """Set the attitude outright: any 4 ints or floats; they need not be normalised.

        A filter whose gains change with time starts anew: it follows the sensors quickly at first. Raises ValueError
        when all are 0 or one is not finite.
        """
        self._attitude(fixmath.unit_quaternion(w, x, y, z))

    def quaternion_floats(self):
        """The attitude as 4 floats (w, x, y, z) of unit length, for hosts."""
        q = self._q
        w, x, y, z = q[0], q[1], q[2], q[3]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        return w / norm, x / norm, y / norm, z / norm

    # -- tick
    def quaternion(self, out):
        """Copy the attitude to out[0..3], an array('i'): w x y z in Q29, body to earth."""
        q = self._q
        out[0] = q[0]
        out[1] = q[1]
        out[2] = q[2]
        out[3] = q[3]

    def angles(self, out, order="zyx"):
        """Roll, pitch, yaw of the attitude in integer millidegrees: see fixmath.euler.

        Where a tick may cut in, convert a copy of the quaternion: fixmath.euler(copy, out, order).
        """
        fixmath.euler(self._q, out, order)


# ----------------------------------------------------------------------------- set-up: allocates
def ratio_of(value, name, unit_name):
    """An int or a pair (num, den) of them as a pair; raises ValueError for anything else, and unless both are > 0."""
    num, den = value if isinstance(value, (tuple, list)) else (value, 1)
    if not isinstance(num, int) or not isinstance(den, int) or num <= 0 or den <= 0:
        raise ValueError(
            "%s is %r, expected a positive int or a pair (num, den) of them, in %s"
            % (name, value, unit_name)
        )
    return num, den


def hertz(rate):
    """(num, den) in words."""
    num, den = rate
    return "%d Hz" % num if den == 1 else "%d/%d Hz" % (num, den)


def bias_of(x, y, z):
    """A gyro bias as a tuple; raises ValueError for what is no int, or beyond +-8192 counts."""
    bias = (x, y, z)
    for b in bias:
        if not isinstance(b, int) or not -_BIAS_MAX <= b <= _BIAS_MAX:
            raise ValueError(
                "bias is %r, expected ints in 1/256 count, at most +-%d" % (bias, _BIAS_MAX)
            )
    return bias
