"""Calibration from recordings: magnetometer (ellipsoid), gyro (rest), accelerometer (six positions and more).

The file that it writes is lib/upright/calibration.py's, which also reads and checks it here. All is fitted in the
chip's own frame. docs/calibration.md says how to record, and gives the formula.
"""

import csv
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer
from rich.console import Console

from upright_host import paths, trials

COLUMNS = ("ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temp", "flags")
AXES = "xyz"

# Magnetometer
LEAST_MAG = 200  # samples
LEAST_COVERAGE = 0.7  # of the sphere
_SECTORS = 60  # of equal area, about 30 deg across
LEAST_SPREAD = (
    1 / 9
)  # smallest to largest variance of the cloud: 1/3 of the length; 1/4 is a half sphere
MOST_AXES = 2.5  # longest to shortest axis of the ellipsoid; soft iron of a board: 1.2
MOST_RESIDUAL = 0.10  # of the field
DOUBTFUL_RESIDUAL = 0.04
DOUBTFUL_OUTLIERS = 0.05  # of the samples
EARTH_UT = (22, 67)  # the field's strength at the surface (IGRF)

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


class CalibrateError(ValueError):
    """A recording that nothing can be made of, or a file; the message says why and what to do."""


# ---------------------------------------------------------------------------------------- recordings
@dataclass
class Recording:
    """Counts of a recording, in the chips' own frames.

    counts           int64 (n, 11), the columns COLUMNS
    rate             rows per second; None where nobody said
    accel_lsb_per_g, gyro_scale    of the counts; gyro_scale is (num, den) LSB per deg/s
    mag_lsb_per_uT   float or None
    chip, board      names or None
    """

    name: str
    counts: np.ndarray
    rate: float | None
    accel_lsb_per_g: int
    gyro_scale: tuple
    mag_lsb_per_uT: float | None = None
    chip: str | None = None
    board: str | None = None

    def fresh(self, bit: int) -> np.ndarray:
        """Which rows hold a fresh sample, bool (n,): where no row has a flag, all do."""
        flags = self.counts[:, 10]
        return (flags & bit) != 0 if flags.any() else np.ones(len(flags), bool)

    def inertial(self) -> tuple[np.ndarray, np.ndarray]:
        """Fresh rows as (accelerometer in g, gyro in deg/s), float (m, 3) each; an axis at full scale is an error."""
        rows = self.counts[self.fresh(1)]
        if not len(rows):
            raise CalibrateError(f"{self.name}: no fresh sample of accelerometer and gyro in it")
        if not rows[:, :6].any():
            raise CalibrateError(f"{self.name}: the counts of accelerometer and gyro are all 0")
        num, den = self.gyro_scale
        return rows[:, :3] / self.accel_lsb_per_g, rows[:, 3:6] * (den / num)

    def magnetic(self) -> np.ndarray:
        """Fresh rows of the magnetometer, counts, float (m, 3), without those at full scale."""
        mag = self.counts[self.fresh(2)][:, 6:9]
        mag = mag[(np.abs(mag) < 32767).all(1)]
        if not mag.any():
            raise CalibrateError(f"{self.name}: no magnetometer sample in it")
        return mag.astype(float)


def load(path: Path, rate=None, accel_range=None, gyro_range=None) -> Recording:
    """A recording: `.imu`, `.npz` (a trial), or `.csv` of counts. Raises CalibrateError.

    rate, accel_range (g) and gyro_range (deg/s) are for a .csv, which does not say them.
    """
    path = Path(path)
    try:
        if path.suffix == ".npz":
            return _from_trial(path)
        if path.suffix == ".csv":
            return _from_csv(path, rate, accel_range or 8, gyro_range or 2000)
        return _from_imu(path)
    except FileNotFoundError:
        raise CalibrateError(f"{path}: no such file") from None
    except (OSError, trials.TrialError) as why:
        raise CalibrateError(str(why)) from why


def _from_trial(path: Path) -> Recording:
    trial = trials.load(path)
    return Recording(
        path.name,
        trial.counts.astype(np.int64),
        trial.rate[0] / trial.rate[1],
        trial.accel_lsb_per_g,
        trial.gyro_scale,
        1 / trial.mag_uT_per_lsb if trial.mag_uT_per_lsb else None,
    )


def _from_imu(path: Path) -> Recording:
    if str(paths.SIMULATOR) not in sys.path:
        sys.path.append(str(paths.SIMULATOR))  # last: nothing of the host may be hidden by it
    import world

    try:
        held = world.World(str(path))
    except ValueError as why:
        raise CalibrateError(str(why)) from why
    held.close()
    data = path.read_bytes()
    end = data.index(b"\n")
    more = json.loads(data[:end])  # what a board that recorded it says besides
    scale = more.get("mag_lsb_per_uT")
    return Recording(
        path.name,
        np.frombuffer(data, "<i2", offset=end + 1).reshape(-1, 11).astype(np.int64),
        held.rate[0] / held.rate[1],
        held.accel_lsb_per_g,
        held.gyro_scale,
        scale[0] / scale[1] if scale else None,
        more.get("chip"),
        more.get("board"),
    )


def _from_csv(path: Path, rate, accel_range, gyro_range) -> Recording:
    lsb = {g: scale for scale, g in trials.ACCEL_RANGES.items()}
    scale = {dps: pair for pair, dps in trials.GYRO_RANGES.items()}
    if accel_range not in lsb or gyro_range not in scale:
        raise CalibrateError(
            f"no range of +-{accel_range} g and +-{gyro_range} deg/s; there are "
            f"{', '.join(map(str, sorted(lsb)))} g and {', '.join(map(str, sorted(scale)))} deg/s"
        )
    with open(path, newline="") as file:
        try:
            head, *rows = csv.reader(file)
        except (ValueError, UnicodeDecodeError, csv.Error) as why:
            raise CalibrateError(f"{path}: not a CSV file with a header line: {why}") from why
    names = [name.strip().lower() for name in head]
    if not set(names) & set(COLUMNS):
        raise CalibrateError(
            f"{path}: the first line names none of the columns {' '.join(COLUMNS)}"
        )
    counts = np.zeros((len(rows), 11), np.int64)
    times = []
    for i, row in enumerate(rows):
        try:
            for name, text in zip(names, row, strict=True):
                if name in COLUMNS:
                    counts[i, COLUMNS.index(name)] = int(text)
                elif name == "t":
                    times.append(float(text))
        except ValueError as why:
            raise CalibrateError(f"{path}, line {i + 2}: {why}; expected whole counts") from why
    if not len(rows) or np.abs(counts).max() > 32768:
        raise CalibrateError(f"{path}: no rows, or counts beyond 16 bits")
    if rate is None and len(times) > 1 and times[-1] > times[0]:
        rate = (len(times) - 1) / (times[-1] - times[0])
    return Recording(path.name, counts, rate, lsb[accel_range], scale[gyro_range])


# ---------------------------------------------------------------------------------------- magnetometer
@dataclass
class MagFit:
    """corrected = matrix (raw - offset); |corrected| is the field's strength, all in counts.

    matrix is the symmetric root of the ellipsoid, of determinant 1: `strength` is the geometric mean of the three
    semi-axes, so the field neither grows nor shrinks. before, after: standard deviation of the strength, relative.
    """

    offset: np.ndarray
    matrix: np.ndarray
    strength: float
    before: float
    after: float
    samples: int
    outliers: int
    coverage: float


def fit_ellipsoid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(centre c, A) with (p - c)' A (p - c) = 1 for points (n, 3): the least squares that can only give an ellipsoid.

    Q. Li, J. G. Griffiths, Least Squares Ellipsoid Specific Fitting, Geometric Modeling and Processing 2004, with
    k = 4: the algebraic distance is minimised under 4J - I^2 = 1, an eigenvalue problem of which exactly one
    eigenvalue is positive.
    """
    middle = points.mean(0)
    size = np.linalg.norm(points - middle, axis=1).mean()
    x, y, z = ((points - middle) / size).T
    one = np.ones_like(x)
    d = np.stack([x * x, y * y, z * z, 2 * y * z, 2 * x * z, 2 * x * y, 2 * x, 2 * y, 2 * z, one])
    s = d @ d.T
    constraint = np.diag([-2.0, -2, -2, -4, -4, -4])
    constraint[:3, :3] += 1
    rest = np.linalg.solve(s[6:, 6:], s[6:, :6])
    values, vectors = np.linalg.eig(np.linalg.solve(constraint, s[:6, :6] - s[:6, 6:] @ rest))
    v = vectors[:, np.argmax(values.real)].real
    a = np.array([[v[0], v[5], v[4]], [v[5], v[1], v[3]], [v[4], v[3], v[2]]])
    *b, c = -rest @ v
    centre = -np.linalg.solve(a, b)
    return middle + size * centre, a / (centre @ a @ centre - c) / size**2


def fit_mag(points: np.ndarray) -> MagFit:
    """The hard and soft iron of a tumble, counts (n, 3). Raises CalibrateError for one that cannot tell them."""
    if len(points) < LEAST_MAG:
        raise CalibrateError(
            f"{len(points)} magnetometer samples are too few, {LEAST_MAG} are needed: record for a minute, "
            "turning the board slowly through all directions"
        )
    spread = np.linalg.eigvalsh(np.cov(points.T))
    if spread[0] <= LEAST_SPREAD * spread[2]:
        raise CalibrateError(
            "the board was turned about one axis only, or hardly: the samples lie in a plane "
            f"({np.sqrt(max(spread[0], 0)):.0f} counts thick, {np.sqrt(spread[2]):.0f} wide). Turn it about all "
            "three axes, each of its six faces up once"
        )
    kept = np.ones(len(points), bool)
    try:
        for _ in range(10):
            centre, a = fit_ellipsoid(points[kept])
            distance = points - centre
            squared = np.einsum("ni,ij,nj->n", distance, a, distance)
            off = np.sqrt(np.maximum(squared, 0)) - 1
            middle = np.median(off[kept])
            most = max(4 * 1.4826 * np.median(np.abs(off[kept] - middle)), 0.005)
            before, kept = kept, np.abs(off - middle) <= most
            if (before == kept).all() or kept.sum() < LEAST_MAG:
                break
        weights, vectors = np.linalg.eigh(a)
    except np.linalg.LinAlgError:
        weights = np.zeros(3)
    if weights[0] <= 0 or weights[2] > MOST_AXES**2 * weights[0] or kept.sum() < LEAST_MAG:
        raise CalibrateError(
            "the samples lie on no ellipsoid that soft iron could make (its axes would differ by more than "
            f"{MOST_AXES:g} to 1): record again, away from iron and magnets, through all directions"
        )
    strength = float(np.prod(weights) ** (-1 / 6))
    matrix = (vectors * np.sqrt(weights) * strength) @ vectors.T
    corrected = (points[kept] - centre) @ matrix
    coverage, missing = cover(corrected)
    if coverage < LEAST_COVERAGE:
        more = f"; nothing near the field along {', '.join(missing)}" if missing else ""
        raise CalibrateError(
            f"the tumble covers {coverage:.0%} of all directions, {LEAST_COVERAGE:.0%} are needed{more}. Record "
            "for longer, each of the six faces up once, and turn slowly about the vertical meanwhile"
        )
    lengths = np.linalg.norm(corrected, axis=1)
    raw = np.linalg.norm(points[kept], axis=1)
    after = lengths.std() / lengths.mean()
    if after > MOST_RESIDUAL:
        raise CalibrateError(
            f"after the correction the field's strength still varies by {after:.0%} (rms): it was disturbed, or the "
            "board was not turned. Record again, away from iron, magnets, motors and loudspeakers"
        )
    return MagFit(
        centre,
        matrix,
        strength,
        raw.std() / raw.mean(),
        after,
        len(points),
        int((~kept).sum()),
        coverage,
    )


def cover(vectors: np.ndarray) -> tuple[float, list[str]]:
    """How much of the sphere the directions (n, 3) cover, 0..1, and the half axes with none within 35 deg."""
    unit = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    i = np.arange(_SECTORS)
    z = 1 - (2 * i + 1) / _SECTORS  # a Fibonacci lattice: sectors of equal area
    turn = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    lattice = np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)
    filled = np.unique(np.argmax(unit @ lattice.T, 1))
    near = np.cos(np.radians(35))
    names = [s + axis for axis in AXES for s in "+-"]
    most = np.stack([unit.max(0), -unit.min(0)], 1).ravel()
    return len(filled) / _SECTORS, [name for name, m in zip(names, most, strict=True) if m < near]


# ---------------------------------------------------------------------------------------- at rest
def _blocks(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means and standard deviations of blocks of BLOCK_S: accel mean (b, 3), its std, gyro mean, its std."""
    accel, gyro = recording.inertial()
    if recording.rate is None:
        raise CalibrateError(
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
    """The gyro's bias from a recording at rest. Raises CalibrateError when it was not at rest."""
    accel, accel_std, gyro, gyro_std = _blocks(recording)
    if len(accel) * BLOCK_S < REST_SECONDS:
        raise CalibrateError(
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
        raise CalibrateError(
            f"{recording.name}: the board was not at rest: it turned at up to {max(moved_dps, shaken_dps):.2f} deg/s "
            f"and the accelerometer moved by {1000 * max(moved_g, shaken_g):.0f} mg (at rest: {REST_GYRO_DPS:g} deg/s, "
            f"{1000 * REST_ACCEL_G:.0f} mg). Lay it on something solid, let go of it, and record again"
        )
    _, gyro_rows = recording.inertial()
    bias = gyro_rows.mean(0)
    if np.abs(bias).max() > MOST_BIAS_DPS:
        raise CalibrateError(
            f"{recording.name}: a steady {np.abs(bias).max():.1f} deg/s is more than any bias ({MOST_BIAS_DPS} deg/s): "
            "was the board turning, or is the range another one?"
        )
    return GyroFit(bias, moved_dps, moved_g, len(gyro_rows) / recording.rate)


# ---------------------------------------------------------------------------------------- accelerometer
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
        raise CalibrateError("the board never lay still: hold it in each position for two seconds")
    unit = still / np.linalg.norm(still, axis=1)[:, None]
    near = np.cos(np.radians(FACE_DEG))
    best = np.stack([unit.max(0), -unit.min(0)], 1)
    missing = [s + AXES[i] for i in range(3) for j, s in enumerate("+-") if best[i, j] < near]
    if missing:
        count = "1 still position" if len(still) == 1 else f"{len(still)} still positions"
        raise CalibrateError(
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
            raise CalibrateError(
                "the positions are too much alike: hold each of the six faces up, and more"
            )
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
        raise CalibrateError(
            f"no offset and scale fit the positions: {1000 * rms:.0f} mg remain (rms). Was it held, not laid down? "
            "Is the range the one that it was recorded with?"
        )
    return AccelFit(
        offset, matrix, full, still, len(poses), float(np.sqrt((before**2).mean())), rms
    )


# ---------------------------------------------------------------------------------------- the file
def calibration():
    """lib/upright/calibration.py, the same file that runs on the board."""
    for folder in (paths.LIB, paths.SHIM):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
    from upright import calibration

    return calibration


def _whole(values, unit: float) -> list[int]:
    return [round(float(v) * unit) for v in np.ravel(values)]


def mag_fields(fit: MagFit) -> dict:
    return {"offset_mlsb": _whole(fit.offset, 1e3), "matrix_ppm": _whole(fit.matrix, 1e6)}


def accel_fields(fit: AccelFit) -> dict:
    return {"offset_ug": _whole(fit.offset, 1e6), "matrix_ppm": _whole(fit.matrix, 1e6)}


def store(out: Path, key: str, value, chip: str | None, board: str | None) -> str:
    """Put one part into a calibration file, made where it is missing; -> what happened. Raises CalibrateError."""
    file = calibration()
    try:
        fields = file.read(str(out), chip, board)
        did = "updated"
    except file.CalibrationError as why:
        if why.kind != "missing":
            raise CalibrateError(f"{why}; remove it, or give another --out") from why
        fields = file.blank()
        did = "written"
    fields["chip"] = fields["chip"] or chip
    fields["board"] = fields["board"] or board
    fields[key] = value
    try:
        file.write(str(out), fields)
    except file.CalibrationError as why:
        raise CalibrateError(f"not written: {why}") from why
    kept = [k for k in ("gyro_bias_udps", "accel", "mag") if k != key and fields[k]]
    return f"{out} {did}: {key}" + (f"; kept: {', '.join(kept)}" if kept else "")


def describe(fields: dict) -> list[str]:
    """What a calibration file says, in lines for people."""
    of = [f"for the {k} {fields[k]}" for k in ("chip", "board") if fields[k]]
    lines = [", ".join(of) or "for any chip and board"]
    bias = fields["gyro_bias_udps"]
    lines.append("gyro bias      " + (_vector(bias, 1e6, ".3f", "deg/s") if bias else "none"))
    for key, offset, unit, form, name in (
        ("accel", "offset_ug", 1e3, ".2f", "mg"),
        ("mag", "offset_mlsb", 1e3, ".1f", "counts"),
    ):
        part = fields[key]
        if not part:
            lines.append(f"{key:<15}none")
            continue
        lines.append(f"{key + ' offset':<15}" + _vector(part[offset], unit, form, name))
        for i in range(3):
            row = "".join(f"{v / 1e6:10.6f}" for v in part["matrix_ppm"][3 * i : 3 * i + 3])
            lines.append(f"{key + ' matrix' if i == 0 else '':<14}{row}")
    return lines


def _vector(values, unit, form, name) -> str:
    said = (f"{axis} {v / unit:{form}}" for axis, v in zip(AXES, values, strict=True))
    return "  ".join(said) + f" {name}"


def _matrix_lines(title: str, matrix: np.ndarray) -> list[str]:
    rows = ["".join(f"{v:10.5f}" for v in row) for row in matrix]
    return [f"{title if i == 0 else '':<14}{row}" for i, row in enumerate(rows)]


# ---------------------------------------------------------------------------------------- commands
_FILE = typer.Argument(..., help="A recording: .imu, a trial .npz, or .csv of counts.")
_OUT = typer.Option(Path("calibration.json"), help="The calibration file to write or update.")
_CHIP = typer.Option(
    None, help="The IMU's name, as the firmware prints it (a recorded .imu knows)."
)
_BOARD = typer.Option(None, help="The board's NAME (a recorded .imu knows).")
_RATE = typer.Option(None, min=1, help="Rows per second of a .csv.")
_ACCEL_RANGE = typer.Option(8, help="Accelerometer range of a .csv, g.")
_GYRO_RANGE = typer.Option(2000, help="Gyro range of a .csv, deg/s.")


def _run(work):
    """Show the lines that `work` gives; its refusal in red, exit code 1."""
    console = Console()
    try:
        for line in work():
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    except (CalibrateError, OSError) as why:
        console.print(str(why), style="red", highlight=False, markup=False, soft_wrap=True)
        raise typer.Exit(1) from None


def register(app: typer.Typer) -> None:
    """Give an app the commands `calibrate mag`, `gyro`, `accel` and `show`."""
    commands = typer.Typer(
        no_args_is_help=True, help="Calibrate from recordings; see docs/calibration.md."
    )
    app.add_typer(commands, name="calibrate")

    @commands.command("mag")
    def mag(
        file: Path = _FILE,
        out: Path = _OUT,
        chip: str = _CHIP,
        board: str = _BOARD,
        lsb_per_ut: float = typer.Option(
            None, help="Counts per uT, to show the field in uT (IST8310: 3.3)."
        ),
    ):
        """Hard and soft iron from a tumble through all directions."""

        def work():
            recording = load(file)
            fit = fit_mag(recording.magnetic())
            scale = lsb_per_ut or recording.mag_lsb_per_uT
            strength = f"{fit.strength:.1f} counts"
            if scale:
                strength = f"{fit.strength / scale:.1f} uT ({strength})"
            share = np.linalg.norm(fit.offset) / fit.strength
            yield f"{recording.name}: {fit.samples} samples, {fit.outliers} left out as outliers"
            yield f"directions    {fit.coverage:.0%} covered"
            yield f"field         {strength}"
            yield f"hard iron     {_vector(fit.offset, 1, '.1f', 'counts')} ({share:.0%} of the field)"
            yield from _matrix_lines("soft iron", fit.matrix)
            yield f"strength      varies by {fit.before:.1%} before, {fit.after:.1%} after (rms)"
            if fit.after > DOUBTFUL_RESIDUAL or fit.outliers > DOUBTFUL_OUTLIERS * fit.samples:
                yield "doubtful: the field was not the same all the way; record again, away from iron and magnets"
            if scale and not EARTH_UT[0] <= fit.strength / scale <= EARTH_UT[1]:
                yield f"doubtful: the earth's field is {EARTH_UT[0]} to {EARTH_UT[1]} uT strong"
            yield store(
                out, "mag", mag_fields(fit), chip or recording.chip, board or recording.board
            )

        _run(work)

    @commands.command("gyro")
    def gyro(
        file: Path = _FILE,
        out: Path = _OUT,
        chip: str = _CHIP,
        board: str = _BOARD,
        rate: float = _RATE,
        gyro_range: int = _GYRO_RANGE,
        accel_range: int = _ACCEL_RANGE,
    ):
        """The gyro's bias from a recording at rest."""

        def work():
            recording = load(file, rate, accel_range, gyro_range)
            fit = fit_gyro(recording)
            yield f"{recording.name}: at rest for {fit.seconds:.1f} s"
            yield f"bias          {_vector(fit.bias, 1, '.3f', 'deg/s')}"
            yield f"moved         {fit.moved_dps:.2f} deg/s, {1000 * fit.moved_g:.0f} mg"
            bias = _whole(fit.bias, 1e6)
            yield store(
                out, "gyro_bias_udps", bias, chip or recording.chip, board or recording.board
            )

        _run(work)

    @commands.command("accel")
    def accel(
        file: Path = _FILE,
        out: Path = _OUT,
        chip: str = _CHIP,
        board: str = _BOARD,
        rate: float = _RATE,
        gyro_range: int = _GYRO_RANGE,
        accel_range: int = _ACCEL_RANGE,
    ):
        """The accelerometer's offsets and scales from still positions: all six faces up, in any order."""

        def work():
            recording = load(file, rate, accel_range, gyro_range)
            fit = fit_accel(positions(recording))
            what = "with cross terms" if fit.full else f"without cross terms (from {FULL_POSES} on)"
            yield f"{recording.name}: still {len(fit.positions)} times, {fit.poses} different positions: {what}"
            yield f"offset        {_vector(fit.offset * 1000, 1, '.2f', 'mg')}"
            yield from _matrix_lines("matrix", fit.matrix)
            left = f"{1000 * fit.after:.2f} mg after (rms)"
            if len(fit.positions) <= (9 if fit.full else 6):
                left = "no position left over to check the fit with"
            yield f"1 g           off by {1000 * fit.before:.2f} mg before, {left}"
            yield store(
                out, "accel", accel_fields(fit), chip or recording.chip, board or recording.board
            )

        _run(work)

    @commands.command("show")
    def show(
        file: Path = typer.Argument(Path("calibration.json"), help="A calibration file."),
        chip: str = typer.Option(None, help="Is it for this IMU?"),
        board: str = typer.Option(None, help="Is it for this board?"),
    ):
        """What a calibration file holds, and whether it is valid."""

        def work():
            library = calibration()
            try:
                fields = library.read(str(file), chip, board)
            except library.CalibrationError as why:
                raise CalibrateError(f"{why.kind}: {why}") from why
            yield f"{file}: valid"
            yield from describe(fields)

        _run(work)
