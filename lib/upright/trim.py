# The trim of a tilted mounting, computed from the present attitude: AHRS.level(). Needs no other module. Every port.
# Set-up: it allocates and uses floats.

import math
from array import array


def level(filter, calibration):
    """Give the calibration the present tilt as its trim, and turn the filter with the body frame.

    Raises CalibrationError for a tilt that a trim does not take; then nothing has changed.
    """
    bias = array("i", [0] * 3)
    filter.bias(bias)
    before = calibration.fields.get("up_ppm")
    q = _times(filter.quaternion_floats(), _turn_of(before, 1))
    w, x, y, z = q
    up = (x * z - w * y, w * x + y * z, w * w + z * z - 0.5)  # half of it
    calibration.set_level([round(2000000 * u) for u in up])
    after = calibration.fields["up_ppm"]
    filter.set_quaternion(*_times(q, _turn_of(after, -1)))
    # the bias, from the old body frame into the new one
    v = _turned(_turn_of(before, -1), [bias[i] for i in range(3)])
    v = _turned(_turn_of(after, 1), v)
    # at rest it is as good as measured
    filter.set_bias(*[round(b) for b in v], 100 if getattr(filter, "resting", False) else 0)


def _turn_of(up, sign):
    """The quaternion of a trim: the shortest turn that takes `up` to z. sign -1: the opposite turn."""
    if up is None:
        return 1.0, 0.0, 0.0, 0.0
    a, b, c = [u / 1000000 for u in up]
    norm = math.sqrt(2 * (1 + c))
    return (1 + c) / norm, sign * b / norm, -sign * a / norm, 0.0


def _times(p, q):
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def _turned(q, v):
    w, x, y, z = q
    return _times(_times(q, (0.0, v[0], v[1], v[2])), (w, -x, -y, -z))[1:]
