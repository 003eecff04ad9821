# What all attitude filters have in common: the sensor's scales, the state, and the readings.
# Needs fixmath.py. Every port.

import math
from array import array

from micropython import const

from upright import fixmath

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)
_Q = const(1)
# -- end of the words

_BIAS_MAX = const(8192 * 256)  # 1/256 counts: 62 deg/s at +-250, 500 deg/s at +-2000 deg/s
_KNOWN_MAX_S = const(3600)


class Attitude:
    """A filter's scales and state; its quaternion and angles.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767
    state             array('i'); state[QUATERNION] and the next three words are w x y z in Q29, body to earth

    A filter adds NAME, AXES (6 or 9), update(counts), seed(counts), set_bias(x, y, z, known_s), and start_at(q), which
    takes four words in Q29 and starts from there. A subclass of a filter assigns update again: MicroPython then finds
    it at once, while a look-up in the base class costs 400 instructions in each step.
    """

    QUATERNION = _Q  # where w x y z (Q29) stand in `state`

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, words):
        """Check the scales, or raise ValueError; make a state of so many words."""
        self.rate = ratio_of(rate, "rate", "Hz")
        self.gyro_scale = ratio_of(gyro_scale, "gyro_scale", "LSB per deg/s")
        if not isinstance(accel_lsb_per_g, int) or not 64 <= accel_lsb_per_g <= 32767:
            raise ValueError(
                "accel_lsb_per_g is %r, expected an int, 64..32767" % (accel_lsb_per_g,)
            )
        self.accel_lsb_per_g = accel_lsb_per_g
        self.hold(array("i", [0] * words))

    @classmethod
    def for_sensor(cls, imu, **gains):
        """A filter for a configured driver `imu`, with its sample rate and scales."""
        return cls(imu.sample_rate, imu.gyro_scale, imu.accel_lsb_per_g, **gains)

    def hold(self, state):
        """Use this array('i') as the state."""
        self.state = state
        self._q = memoryview(state)[_Q : _Q + 4]
        state[_PROBE] = -1

    def set_quaternion(self, w, x, y, z):
        """Set the attitude outright: any 4 ints or floats; they need not be normalised.

        A filter whose gains change with time starts anew: it follows the sensors quickly at first. Raises ValueError
        when all are 0 or one is not finite.
        """
        self.start_at(fixmath.unit_quaternion(w, x, y, z))

    def quaternion_floats(self):
        """The attitude as 4 floats (w, x, y, z) of unit length, for hosts."""
        q = self._q
        w, x, y, z = q[0], q[1], q[2], q[3]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        return w / norm, x / norm, y / norm, z / norm

    def bias(self, out):
        """The gyro's bias that is set, in 1/256 of a gyro count: out[0..2]."""
        for i in range(3):
            out[i] = self.bias_set[i]

    def bias_mdps(self, out):
        """The gyro's bias that is set, in millidegrees/s: out[0..2]. For the main loop: it may allocate."""
        num, den = self.gyro_scale
        for i in range(3):
            out[i] = fixmath.ratio(self.bias_set[i] * 1000 * den, 256 * num)

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


def bias_of(x, y, z, known_s=0):
    """A gyro bias as a tuple; raises ValueError for what is no int, or beyond +-8192 counts, or no known_s."""
    bias = (x, y, z)
    for b in bias:
        if not isinstance(b, int) or not -_BIAS_MAX <= b <= _BIAS_MAX:
            raise ValueError(
                "bias is %r, expected ints in 1/256 count, at most +-%d" % (bias, _BIAS_MAX)
            )
    if not isinstance(known_s, (int, float)) or not 0 <= known_s <= _KNOWN_MAX_S:
        raise ValueError("known_s is %r, expected seconds of rest, 0..%d" % (known_s, _KNOWN_MAX_S))
    return bias
