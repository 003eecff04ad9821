"""Synthetic motions of exactly known attitude, as the counts of an imperfect IMU.

Needs numpy; runs on the host only. The other runtimes read the result as an `.imu` file (world.py).

How the truth is exact: the body's angular rate is held constant over fine steps of at most 1/4 ms,
and the attitude is the product of those steps' closed-form quaternions. Nothing is integrated
numerically. Row k belongs to the time k/rate:

    q_true    the attitude at that instant, sensor -> earth (x north, y west, z up), scalar first
    gyro      the mean rate over the interval that ends there; 0 in row 0: the body rests until then
    accel     the specific force at that instant in g: +1 on z at rest and level
    mag       the earth's field at that instant

A motion is fixed by its name and the seed; rate and errors only change how it is sampled. Two
machines' sines may differ in the last bit, so compare counts only when one machine rendered them.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import world

ACCEL_LSB_PER_G = {2: 16384, 4: 8192, 8: 4096, 16: 2048}
GYRO_LSB_PER_DPS = {250: (131, 1), 500: (131, 2), 1000: (164, 5), 2000: (82, 5)}
MAG_UT_PER_LSB = 0.3
FIELD_UT = 49.0  # strength and dip of the field in central Europe (IGRF)
DIP_DEG = 66.0
DEMO_SECONDS = 24  # one round of the motion 'demo'
_FINE_HZ = 4000


@dataclass(frozen=True)
class Errors:
    """What a sensor does to the truth. Noise is white and Gaussian, drawn anew for every row.

    The defaults are an MPU6050 with its low-pass filter at 98 Hz (PS-MPU-6000A rev 3.4): gyro
    0.005 deg/s per root Hz (6.1), accel 400 ug per root Hz (6.2). Bias, scale and alignment are
    those of a fairly good part; the same sections allow +-20 deg/s, +-3 % and +-2 % for the gyro,
    +-50 mg (z: 80 mg) for the accelerometer.
    """

    gyro_bias_dps: tuple = (1.2, -0.8, 0.6)
    gyro_noise_density: float = 0.005  # deg/s per root Hz
    gyro_scale_error: tuple = (0.002, -0.003, 0.0015)  # 0.01 reads 1 % too much
    gyro_misalignment_deg: tuple = (0.1, -0.15, 0.1)  # rotation vector, against the accelerometer
    accel_bias_g: tuple = (0.004, -0.003, 0.006)
    accel_noise_density: float = 400e-6  # g per root Hz
    mag_bias_uT: tuple = (0.0, 0.0, 0.0)
    mag_noise_uT: float = 0.6  # standard deviation
    bandwidth_hz: float = 98.0  # of the noise, unless half the rate is less


DEFAULT_ERRORS = Errors()


@dataclass
class Motion:
    """A rendered motion of n rows.

    counts          int16 (n, 11): ax ay az gx gy gz mx my mz temp flags, flags 0
    q_true          float64 (n, 4): sensor -> earth (x north, y west, z up), scalar first, unit norm
    rate_true_dps   float64 (n, 3): mean body rate over the interval that ends at the row
    rate            (num, den) Hz
    accel_lsb_per_g, gyro_scale, mag_uT_per_lsb    scales of the counts
    """

    name: str
    counts: np.ndarray
    q_true: np.ndarray
    rate_true_dps: np.ndarray
    rate: tuple
    accel_lsb_per_g: int
    gyro_scale: tuple
    mag_uT_per_lsb: float = field(default=MAG_UT_PER_LSB)

    @property
    def n(self):
        return len(self.counts)

    @property
    def t(self):
        """Seconds of every row."""
        return np.arange(self.n) * self.rate[1] / self.rate[0]

    def write(self, path, clocked=False, truth=False):
        """Write the `.imu` file that world.World reads; truth: with the true attitude of every row."""
        attitudes = np.rint(self.q_true * 2**30).astype("<i4").tobytes() if truth else b""
        world.write_imu(
            path,
            self.counts.astype("<i2").tobytes(),
            self.name,
            self.rate,
            self.accel_lsb_per_g,
            self.gyro_scale,
            clocked,
            attitudes,
            int(truth),
        )


def render(
    name,
    rate=(200, 1),
    seconds=60,
    seed=1,
    errors=DEFAULT_ERRORS,
    accel_range_g=8,
    gyro_range_dps=2000,
    rest_seconds=0,
    substeps=None,
):
    """Sample the motion `name` (one of MOTIONS) for `seconds` at `rate` Hz; returns a Motion.

    rate          int or (num, den)
    seconds       length, the first row at 0; floor(seconds * rate) rows, at least one
    seed          of the motions that are random (bursts, hand) and of the noise
    errors        an Errors; None for an ideal sensor, which still rounds and saturates
    rest_seconds  the motion starts after so long a rest in its first attitude
    substeps      fine steps per row; None takes as many as make 4 kHz

    Raises ValueError for an unknown name, a range that the chip lacks, and a rate or length that is
    not positive.
    """
    if name not in _MOTIONS:
        raise ValueError(f"no motion {name!r}; there are {', '.join(MOTIONS)}")
    if accel_range_g not in ACCEL_LSB_PER_G:
        raise ValueError(f"accel_range_g {accel_range_g!r} is not one of 2, 4, 8, 16")
    if gyro_range_dps not in GYRO_LSB_PER_DPS:
        raise ValueError(f"gyro_range_dps {gyro_range_dps!r} is not one of 250, 500, 1000, 2000")
    num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
    if num <= 0 or den <= 0 or seconds <= 0 or rest_seconds < 0:
        raise ValueError(f"rate {num}/{den} Hz and {seconds} s must be positive")
    if substeps is None:
        substeps = math.ceil(_FINE_HZ * den / num)

    euler_deg, make = _MOTIONS[name]
    body_rate, acceleration = make(np.random.default_rng([seed, 0]))
    n = max(1, int(seconds * num / den + 1e-9))
    t = np.arange(n) * den / num - rest_seconds
    q_true, rate_true = _integrate(quaternion_zyx(*euler_deg), body_rate, t, den / num, substeps)

    rotation = _matrix(q_true)
    force = acceleration(np.maximum(t, 0)) * (t >= 0)[:, None] + [0, 0, 1]
    accel = np.einsum("nij,ni->nj", rotation, force)  # earth to body: the transpose
    dip = math.radians(DIP_DEG)
    mag = np.einsum("nij,i->nj", rotation, [FIELD_UT * math.cos(dip), 0, -FIELD_UT * math.sin(dip)])
    gyro = rate_true
    if errors is not None:
        accel, gyro, mag = _spoil(accel, gyro, mag, errors, num / den, seed)

    counts = np.zeros((n, 11), np.int16)
    scale = GYRO_LSB_PER_DPS[gyro_range_dps]
    counts[:, 0:3] = _to_int16(accel * ACCEL_LSB_PER_G[accel_range_g])
    counts[:, 3:6] = _to_int16(gyro * scale[0] / scale[1])
    counts[:, 6:9] = _to_int16(mag / MAG_UT_PER_LSB)
    counts[:, 9] = _temperature(np.arange(n) * den / num)
    return Motion(
        name, counts, q_true, rate_true, (num, den), ACCEL_LSB_PER_G[accel_range_g], scale
    )


# Motions. Each maker takes a random generator and returns two functions of the times t >= 0 (n,)
# since the motion's start: the body's rate in deg/s (n, 3), and the linear acceleration in g (n, 3)
# in the earth frame.


def _columns(t, *columns):
    return np.stack([np.broadcast_to(np.asarray(c, float), t.shape) for c in columns], 1)


def _no_acceleration(t):
    return np.zeros((len(t), 3))


def _static(rng):
    return lambda t: np.zeros((len(t), 3)), _no_acceleration


def _slow(rng):
    def body_rate(t):
        w = 2 * np.pi * t
        return _columns(
            t, 15 * np.sin(0.07 * w), 11 * np.sin(0.11 * w + 1), 20 * np.sin(0.05 * w + 2)
        )

    return body_rate, _no_acceleration


def _spin(rng):
    return lambda t: _columns(t, 0, 0, 360), _no_acceleration


def _bursts(rng):
    axes = rng.standard_normal((4096, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]

    def body_rate(t):
        on = (t % 2 >= 1) & (t % 2 < 1.3)
        return 1000 * axes[(t // 2).astype(int) % len(axes)] * on[:, None]

    return body_rate, _no_acceleration


CONING_HZ, CONING_DPS, CONING_Z_DPS = 5, 312, 5  # half angle of the cone: 312/(360*5) rad = 10 deg


def _coning(rng):
    def body_rate(t):
        w = 2 * np.pi * CONING_HZ * t
        return _columns(t, CONING_DPS * np.cos(w), CONING_DPS * np.sin(w), CONING_Z_DPS)

    return body_rate, _no_acceleration


def _hand(rng):
    """Held in a hand: turns of some hundred deg/s, pushes of some tenths of g, rests in between."""
    # 1.5 to 4 s of rest, 3 to 8 s of motion, half a second of smooth change
    edges = np.cumsum(np.stack([rng.uniform(1.5, 4, 2048), rng.uniform(3, 8, 2048)], 1).reshape(-1))

    def envelope(t):
        t = t % edges[-1]
        i = np.searchsorted(edges, t, side="right")
        before = np.where(i > 0, edges[i - 1], 0)
        ramp = np.clip(np.minimum(t - before, edges[np.minimum(i, len(edges) - 1)] - t) / 0.5, 0, 1)
        return np.where(i % 2 == 1, 0.5 - 0.5 * np.cos(np.pi * ramp), 0)[:, None]

    def wander(hz, size):
        hz = rng.uniform(*hz, (6, 3))
        phase = rng.uniform(0, 2 * np.pi, (6, 3))
        size = rng.uniform(0.3, 1, (6, 3)) * size

        def at(t):
            out = np.zeros((len(t), 3))
            for k in range(6):
                out += size[k] * np.sin(2 * np.pi * hz[k] * t[:, None] + phase[k])
            return out

        return at

    turn = wander((0.15, 2.5), np.array([90, 90, 110]))
    push = wander((0.8, 4), np.array([0.12, 0.12, 0.1]))
    return lambda t: envelope(t) * turn(t), lambda t: envelope(t) * push(t)


# 'demo': (body axis, from deg, to deg, start s, duration s); every axis comes back before the next
_SWEEPS = (
    (0, 0, 60, 2.5, 1.2),
    (0, 60, -60, 3.7, 2.0),
    (0, -60, 0, 5.7, 1.2),
    (1, 0, 45, 7.3, 1.2),
    (1, 45, -45, 8.5, 2.0),
    (1, -45, 0, 10.5, 1.2),
    (2, 0, 180, 12.1, 1.8),
    (2, 180, -180, 13.9, 3.0),
    (2, -180, 0, 16.9, 1.8),
)
_SHAKE = (19.1, 2.4)  # start s, duration s


def _demo(rng):
    """A show of DEMO_SECONDS: rest, roll +-60, pitch +-45, yaw +-180 deg, a shake, rest."""

    def shake(t):
        u = (t % DEMO_SECONDS - _SHAKE[0]) / _SHAKE[1]
        return u, np.where((u > 0) & (u < 1), np.sin(np.pi * np.clip(u, 0, 1)), 0)

    def body_rate(t):
        out = np.zeros((len(t), 3))
        for axis, start_deg, end_deg, at, lasts in _SWEEPS:
            u = (t % DEMO_SECONDS - at) / lasts
            # the angle goes as a half cosine; its derivative inside the sweep
            rate = (end_deg - start_deg) * np.pi / 2 / lasts * np.sin(np.pi * u)
            out[:, axis] += np.where((u > 0) & (u < 1), rate, 0)
        u, envelope = shake(t)
        # whole turns under a symmetric envelope: odd about the middle, so that the angle comes back
        out[:, 0] += 200 * envelope * np.sin(2 * np.pi * 7 * u)
        out[:, 1] += 250 * envelope * np.sin(2 * np.pi * 9 * u)
        return out

    def acceleration(t):
        u, envelope = shake(t)
        return envelope[:, None] * _columns(
            t,
            0.7 * np.sin(2 * np.pi * 11 * u),
            0.5 * np.sin(2 * np.pi * 9 * u),
            0.4 * np.sin(2 * np.pi * 13 * u),
        )

    return body_rate, acceleration


# name: (first attitude as yaw, pitch, roll in deg, maker)
_MOTIONS = {
    "static": ((30, -5, 10), _static),
    "slow": ((30, 20, 10), _slow),
    "spin": ((0, 0, 10), _spin),
    "bursts": ((30, 20, 10), _bursts),
    "coning": ((30, 20, 10), _coning),
    "hand": ((-40, 15, -5), _hand),
    "demo": ((0, 0, 0), _demo),
}
MOTIONS = tuple(_MOTIONS)  # the names


# Quaternions: scalar first, Hamilton products, arrays (..., 4)


def multiply(a, b):
    """The quaternion product a*b, row by row."""
    a0, a1, a2, a3 = np.moveaxis(np.asarray(a, float), -1, 0)
    b0, b1, b2, b3 = np.moveaxis(np.asarray(b, float), -1, 0)
    return np.stack(
        [
            a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
            a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
            a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
            a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
        ],
        -1,
    )


def exponential(angle):
    """The rotation by the vector `angle` (..., 3) in rad, as a quaternion: the closed form."""
    half = np.asarray(angle, float) / 2
    norm = np.linalg.norm(half, axis=-1)[..., None]
    return np.concatenate([np.cos(norm), half * np.sinc(norm / np.pi)], -1)


def quaternion_zyx(yaw_deg, pitch_deg, roll_deg):
    """Attitude from Euler angles in the order z, y, x."""
    q = np.array([1.0, 0, 0, 0])
    for axis, angle in ((2, yaw_deg), (1, pitch_deg), (0, roll_deg)):
        q = multiply(q, exponential(math.radians(angle) * np.eye(3)[axis]))
    return q


def _matrix(q):
    """Rotation matrices (n, 3, 3) that turn body vectors into the earth frame."""
    q0, q1, q2, q3 = q.T
    return np.moveaxis(
        np.array(
            [
                [1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)],
                [2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)],
                [2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)],
            ]
        ),
        2,
        0,
    )


def _integrate(q0, body_rate, t, period, substeps):
    """Attitudes at the times t, and mean rates in deg/s over the periods before them.

    At rest at q0 before t = 0. A fine step has the rate of its middle.
    """
    n = len(t)
    mean = np.zeros((n, 3))
    step = np.tile([1.0, 0, 0, 0], (n, 1))
    for s in range(substeps):
        middle = t + ((s + 0.5) / substeps - 1) * period
        w = body_rate(np.maximum(middle, 0)) * (middle >= 0)[:, None]
        mean += w / substeps
        step = multiply(step, exponential(np.radians(w) * (period / substeps)))
    q = multiply(q0, _running_product(step))
    return q / np.linalg.norm(q, axis=1)[:, None], mean


def _running_product(q):
    """q[0], q[0]*q[1], q[0]*q[1]*q[2], ...: 2*sqrt(n) array operations instead of n products."""
    n = len(q)
    size = math.isqrt(n) + 1
    blocks = np.tile([1.0, 0, 0, 0], (size * size, 1))
    blocks[:n] = q
    blocks = blocks.reshape(size, size, 4)
    for j in range(1, size):
        blocks[:, j] = multiply(blocks[:, j - 1], blocks[:, j])
    for i in range(1, size):
        blocks[i] = multiply(blocks[i - 1, -1], blocks[i])
    return blocks.reshape(-1, 4)[:n]


def _spoil(accel, gyro, mag, errors, rate_hz, seed):
    """The ideal readings with an Errors applied: alignment, then scale, then bias and noise."""
    # a stream for each sensor: a longer rendering begins as a shorter one does
    for_gyro, for_accel, for_mag = (np.random.default_rng([seed, k]) for k in (1, 2, 3))
    root_hz = math.sqrt(min(rate_hz / 2, errors.bandwidth_hz))
    n = len(gyro)
    turn = _matrix(exponential(np.radians(errors.gyro_misalignment_deg))[None])[0]
    gyro = (gyro @ turn) * (1 + np.array(errors.gyro_scale_error)) + errors.gyro_bias_dps
    gyro = gyro + errors.gyro_noise_density * root_hz * for_gyro.standard_normal((n, 3))
    accel = accel + errors.accel_bias_g
    accel = accel + errors.accel_noise_density * root_hz * for_accel.standard_normal((n, 3))
    mag = mag + errors.mag_bias_uT + errors.mag_noise_uT * for_mag.standard_normal((n, 3))
    return accel, gyro, mag


def _to_int16(values):
    return np.clip(np.rint(values), -32768, 32767).astype(np.int16)


def _temperature(t):
    """The die warms from 25 to 28 degC; raw = (degC - 36.53) * 340 (RM-MPU-6000A rev 4.2, 4.18)."""
    return np.rint((25 + 3 * (1 - np.exp(-t / 120)) - 36.53) * 340).astype(np.int16)
