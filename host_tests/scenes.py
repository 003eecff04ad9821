"""Scenes: motion, errors and events of one's own making, as the counts of a noisy sensor with the truth beside them."""

import math

import motions
import numpy as np
from histories import ONE, SCALES

# (rate, every so many samples with a fresh magnetometer)
PACES = [(90, 1), (200, 3), (500, 10)]
FIELD_UT = motions.FIELD_UT * np.array(
    [math.cos(math.radians(motions.DIP_DEG)), 0, -math.sin(math.radians(motions.DIP_DEG))]
)


def scene(
    rate,
    seconds,
    body_rate=None,
    accel=None,
    bias_dps=(1.2, -0.8, 0.6),
    kick=None,
    field=None,
    range_g=16,
    mag_every=1,
    accel_offset_g=(0.004, -0.003, 0.006),
    range_dps=2000,
    mag_offset_uT=(0, 0, 0),
    noise=1,
):
    """A motion from level and north as the counts of a noisy sensor, flags included.

    body_rate(t): deg/s (n, 3); accel(t): g, earth (n, 3); field(t): uT on top, earth (n, 3); bias_dps: also a function
    of t; kick: (s, rotation vector in deg, earth): the body is elsewhere from then on, and the gyro has not seen it;
    mag_offset_uT: in the body; noise: so many times that of a usual sensor.
    """
    n = int(rate * seconds)
    t = np.arange(n) / rate
    still = np.zeros((n, 3))
    q, gyro = motions._integrate(
        np.array([1.0, 0, 0, 0]),
        body_rate or (lambda t: np.zeros((len(t), 3))),
        t,
        1 / rate,
        max(1, 2000 // rate),
    )
    if kick:
        late = t >= kick[0]
        q[late] = motions.multiply(
            motions.exponential(np.radians(np.array(kick[1], float))), q[late]
        )
    turn = motions._matrix(q)
    force = np.einsum("nij,ni->nj", turn, (accel(t) if accel else still) + [0, 0, 1])
    mag = np.einsum("nij,ni->nj", turn, FIELD_UT + (field(t) if field else still))
    rng = np.random.default_rng(1)
    bias = bias_dps(t) if callable(bias_dps) else np.array(bias_dps)
    read = gyro + bias + 0.07 * noise * rng.standard_normal((n, 3))
    force = force + accel_offset_g + 0.005 * noise * rng.standard_normal((n, 3))
    mag = mag + mag_offset_uT + 0.6 * noise * rng.standard_normal((n, 3))
    scale = SCALES[range_dps]
    counts = np.zeros((n, 11), np.int16)
    counts[:, 0:3] = motions._to_int16(force * (32768 // range_g))
    counts[:, 3:6] = motions._to_int16(read * (scale[0] / scale[1]))
    counts[:, 6:9] = motions._to_int16(mag / 0.3)
    full = np.abs(counts[:, 0:6].astype(int)) >= 32767
    counts[:, 10] = np.where(np.arange(n) % mag_every == 0, 3, 1)
    counts[:, 10] += (4 * full[:, :3].any(1) + 8 * full[:, 3:].any(1)).astype(np.int16)
    return motions.Motion("scene", counts, q, gyro, (rate, 1), 32768 // range_g, scale)


def errors(q, rendered):
    """(inclination, heading) errors in degrees, each (n,)."""
    e = motions.multiply(q, rendered.q_true * [1, -1, -1, -1])
    inclination = np.degrees(2 * np.arccos(np.clip(np.hypot(e[:, 0], e[:, 3]), 0, 1)))
    heading = np.degrees(2 * np.arctan2(e[:, 3], e[:, 0]))
    return inclination, (heading + 180) % 360 - 180


def all_axes(t):
    w = 2 * np.pi * t
    return np.stack(
        [60 * np.sin(0.31 * w), 50 * np.sin(0.23 * w + 1), 70 * np.sin(0.17 * w + 2)], 1
    )


def pushes(t):
    w = 2 * np.pi * t
    return np.stack([0.2 * np.sin(1.3 * w), 0.2 * np.sin(0.9 * w), 0.15 * np.sin(1.7 * w)], 1)


def as_start(axis, degrees):
    q = motions.exponential(math.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
    return [round(v * ONE) for v in q]
