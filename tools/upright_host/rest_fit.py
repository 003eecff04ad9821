"""The gyro's bias out of a recording at rest; the accelerometer's offsets and scales out of still positions."""

from dataclasses import dataclass

import numpy as np

from upright_host.console import Wrong
from upright_host.recordings import Recording

# At rest: blocks of so long, and what they may hold. The noise of an MPU6050 is 0.05 deg/s and 4 mg (PS 6.1, 6.2, at
# 98 Hz).
BLOCK_S = 0.2
STILL_GYRO_DPS = 1.0  # standard deviation in a block
STILL_ACCEL_G = 0.015
REST_SECONDS = 2  # at least
REST_GYRO_DPS = 0.5  # how far the blocks' means may lie apart, drift with temperature included
REST_ACCEL_G = 0.025
MOST_BIAS_DPS = 20  # PS 6.1: zero-rate output

# Accelerometer
LEAST_BLOCKS = 5  # in one position; the first and the last are left out
FACE_DEG = 30  # how far an axis may be off the vertical
OTHER_POSE_DEG = 15
FULL_POSES = 12  # from so many on the cross terms are fitted as well: 9 unknowns
MOST_ACCEL_RESIDUAL_G = 0.02


def _blocks(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means and standard deviations of blocks of BLOCK_S: accel mean (b, 3), its std, gyro mean, its std."""
    accel, gyro = recording.inertial()
    if recording.rate is None:
        raise Wrong(
            f"{recording.name} does not say how many rows there are a second: give --rate, or a column t in seconds"
        )
    n = max(2, round(BLOCK_S * recording.rate))
    b = len(accel) // n
    accel, gyro = (v[: b * n].reshape(b, n, 3) for v in (accel, gyro))
    return accel.mean(1), accel.std(1), gyro.mean(1), gyro.std(1)


def _apart(means: np.ndarray) -> float:
    """How far means (b, 3) lie apart on the worst axis."""
    return float(np.ptp(means, axis=0).max())


@dataclass
class GyroFit:
    """bias in deg/s (3,), chip's frame; how far the blocks' means lay apart; seconds of it."""

    bias: np.ndarray
    moved_dps: float
    moved_g: float
    seconds: float


def fit_gyro(recording: Recording) -> GyroFit:
    """The gyro's bias from a recording at rest. Raises Wrong when it was not at rest."""
    accel, accel_std, gyro, gyro_std = _blocks(recording)
    if len(accel) * BLOCK_S < REST_SECONDS:
        raise Wrong(
            f"{recording.name}: {len(accel) * BLOCK_S:.1f} s are too short, {REST_SECONDS} s are needed"
        )
    moved_dps, moved_g = _apart(gyro), _apart(accel)
    shaken_dps, shaken_g = gyro_std.max(), accel_std.max()
    if (
        moved_dps > REST_GYRO_DPS
        or moved_g > REST_ACCEL_G
        or shaken_dps > STILL_GYRO_DPS
        or shaken_g > STILL_ACCEL_G * 2
    ):
        raise Wrong(
            f"{recording.name}: the board was not at rest: it turned at up to {max(moved_dps, shaken_dps):.2f} deg/s "
            f"and the accelerometer moved by {1000 * max(moved_g, shaken_g):.0f} mg (at rest: {REST_GYRO_DPS:g} deg/s, "
            f"{1000 * REST_ACCEL_G:.0f} mg). Lay it on something solid, let go of it, and record again"
        )
    _, gyro_rows = recording.inertial()
    bias = gyro_rows.mean(0)
    if np.abs(bias).max() > MOST_BIAS_DPS:
        raise Wrong(
            f"{recording.name}: a steady {np.abs(bias).max():.1f} deg/s is more than any bias ({MOST_BIAS_DPS} deg/s): "
            "was the board turning, or is the range another one?"
        )
    return GyroFit(bias, moved_dps, moved_g, len(gyro_rows) / recording.rate)


@dataclass
class AccelFit:
    """corrected = matrix (raw - offset) in g. before, after: rms of |.| - 1 over the positions, g."""

    offset: np.ndarray
    matrix: np.ndarray
    full: bool
    positions: np.ndarray
    poses: int
    before: float
    after: float


def positions(recording: Recording) -> np.ndarray:
    """The mean accelerometer vector, g, of every stretch of the recording in which the board lay still: (p, 3)."""
    accel, accel_std, _, gyro_std = _blocks(recording)
    still = (accel_std.max(1) < STILL_ACCEL_G) & (gyro_std.max(1) < STILL_GYRO_DPS)
    found, start = [], None
    low = high = np.zeros(3)
    for i, quiet in enumerate([*still, False]):
        if start is not None and quiet:
            low, high = np.minimum(low, accel[i]), np.maximum(high, accel[i])
            quiet = (high - low).max() <= REST_ACCEL_G  # a steady turn is quiet, too
        if start is not None and not quiet:
            if i - start >= LEAST_BLOCKS:
                found.append(accel[start + 1 : i - 1].mean(0))
            start = None
        elif quiet and start is None:
            start, low, high = i, accel[i], accel[i]
    return np.array(found).reshape(-1, 3)


def fit_accel(still: np.ndarray) -> AccelFit:
    """Offset and matrix from the accelerometer's mean in still positions, g (p, 3): |matrix (a - offset)| = 1.

    Gauss-Newton. The length alone leaves a common rotation open; the symmetric matrix is the choice that turns nothing
    on the whole and prefers no axis, where a triangular one would hold on to x. Six positions on the faces tell
    offsets and scales; the cross terms are fitted from FULL_POSES different ones on.
    """
    if not len(still):
        raise Wrong("the board never lay still: hold it in each position for two seconds")
    unit = still / np.linalg.norm(still, axis=1)[:, None]
    near = np.cos(np.radians(FACE_DEG))
    best = np.stack([unit.max(0), -unit.min(0)], 1)
    missing = [s + "xyz"[i] for i in range(3) for j, s in enumerate("+-") if best[i, j] < near]
    if missing:
        count = "1 still position" if len(still) == 1 else f"{len(still)} still positions"
        raise Wrong(
            f"{count}, but none with {', '.join(missing)} up (within {FACE_DEG} deg; the axes as "
            "printed on the sensor): hold each of the six faces up for two seconds, in any order"
        )
    poses = []
    for u in unit:
        if all(u @ p < np.cos(np.radians(OTHER_POSE_DEG)) for p in poses):
            poses.append(u)
    full = len(poses) >= FULL_POSES
    offset, matrix = np.zeros(3), np.eye(3)
    for _ in range(30):
        w = still - offset
        v = w @ matrix  # symmetric
        length = np.linalg.norm(v, axis=1)
        u = v / length[:, None]
        columns = [-u @ matrix, u * w]
        if full:
            columns.append(u[:, [1, 0, 0]] * w[:, [2, 2, 1]] + u[:, [2, 2, 1]] * w[:, [1, 0, 0]])
        jacobian = np.concatenate(columns, 1)
        step, _, rank, _ = np.linalg.lstsq(jacobian, 1 - length, rcond=1e-3)
        if rank < jacobian.shape[1]:
            raise Wrong("the positions are too much alike: hold each of the six faces up, and more")
        offset = offset + step[:3]
        matrix = matrix + np.diag(step[3:6])
        if full:
            a, b, c = step[6:]
            matrix = matrix + np.array([[0, c, b], [c, 0, a], [b, a, 0]])
        if np.abs(step).max() < 1e-10:
            break
    after = np.linalg.norm((still - offset) @ matrix, axis=1) - 1
    before = np.linalg.norm(still, axis=1) - 1
    rms = float(np.sqrt((after**2).mean()))
    if not rms < MOST_ACCEL_RESIDUAL_G:
        raise Wrong(
            f"no offset and scale fit the positions: {1000 * rms:.0f} mg remain (rms). Was it held, not laid down? "
            "Is the range the one that it was recorded with?"
        )
    return AccelFit(
        offset, matrix, full, still, len(poses), float(np.sqrt((before**2).mean())), rms
    )
