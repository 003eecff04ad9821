"""Recorded trials: sensor counts with a ground truth in an .npz archive, loaded and checked.

An archive holds gyr, acc, mag int16 (n, 3); q_gt float32 (ceil(n / gt_every), 4), sensor -> earth
with x east, y north, z up, scalar first, NaN where the truth is unknown; movement, numpy.packbits
over q_gt's rows; header, JSON as uint8 with the scales per LSB, rate_hz and gt_every. mag may be
absent, and so may q_gt with movement.
"""

import json
import math
import os
import zipfile
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from upright_host import library, paths
from upright_host.console import Wrong

STANDARD_GRAVITY = 9.80665  # m/s2
ACCEL_RANGES = {16384: 2, 8192: 4, 4096: 8, 2048: 16}  # LSB per g: range in g
GYRO_RANGES = {(131, 1): 250, (131, 2): 500, (164, 5): 1000, (82, 5): 2000}  # LSB per deg/s: deg/s
BESIDE = Path("..", "shared", "data")  # from the project root: where trials may lie
_SCALE_TOLERANCE = 1e-4  # relative: lets float32 pass, not 9.81 for 9.80665


class TrialError(Wrong):
    """A file is not a usable trial; the message says which file and what is wrong with it."""


@dataclass
class Trial:
    """A recorded trial of n samples, as the simulated chip is to deliver it.

    counts          int16 (n, 11): ax ay az gx gy gz mx my mz temp flags; temp stands for 25 degC,
                    flags are 0 (the chip's business)
    rate            (num, den) Hz in lowest terms, within 1e-9 of the header's (0.6 us in 10 min)
    accel_lsb_per_g, accel_range_g      int
    gyro_scale, gyro_range_dps          (num, den) LSB per deg/s, int
    mag_uT_per_lsb  float, or None without a magnetometer
    gt_every        q_gt[k] belongs to sample k*gt_every; None without truth
    q_gt            float64 (m, 4), earth frame x east, y north, z up, NaN where unknown; None
                    without truth
    movement        bool (m,); None without truth
    header          the whole header as a dict
    """

    name: str
    counts: np.ndarray
    rate: tuple
    accel_lsb_per_g: int
    gyro_scale: tuple
    mag_uT_per_lsb: float | None
    gt_every: int | None
    q_gt: np.ndarray | None
    movement: np.ndarray | None
    header: dict

    @property
    def n(self) -> int:
        return len(self.counts)

    @property
    def seconds(self) -> float:
        return self.n * self.rate[1] / self.rate[0]

    @property
    def accel_range_g(self) -> int:
        return ACCEL_RANGES[self.accel_lsb_per_g]

    @property
    def gyro_range_dps(self) -> int:
        return GYRO_RANGES[self.gyro_scale]

    @property
    def has_truth(self) -> bool:
        return self.q_gt is not None and bool((self.movement & np.isfinite(self.q_gt[:, 0])).any())

    @property
    def t_gt(self) -> np.ndarray:
        """Seconds from the first sample of every row of q_gt."""
        return np.arange(len(self.q_gt)) * self.gt_every * self.rate[1] / self.rate[0]

    def q_true(self) -> np.ndarray:
        """q_gt turned into the project's earth frame, x north, y west, z up: float64 (m, 4)."""
        return enu_to_nwu(self.q_gt)

    def rows(self, seconds: float | None = None) -> int:
        """How many samples lie in the first `seconds` (None: all of them), at least one."""
        if seconds is None:
            return self.n
        if not seconds > 0:
            raise ValueError(f"{seconds} s is not a positive length")
        if seconds >= self.seconds:
            return self.n
        # whole microseconds: 0.0035 as a float is a little more than it says
        seconds = Fraction(seconds).limit_denominator(10**6)
        return max(1, math.ceil(seconds * Fraction(*self.rate)))

    def write(self, path, seconds: float | None = None) -> int:
        """Write the first `seconds` (None: all) as the `.imu` file to replay; returns the rows."""
        rows = self.rows(seconds)
        library.simulator("world").write_imu(
            path,
            self.counts[:rows].astype("<i2").tobytes(),
            self.name,
            self.rate,
            self.accel_lsb_per_g,
            self.gyro_scale,
            True,
        )
        return rows


def load(path) -> Trial:
    """Load and check a trial. Raises TrialError for anything that is not one."""
    path = Path(path)
    if not path.exists():
        raise TrialError(f"{path}: no such file")
    if path.is_dir():
        raise TrialError(f"{path} is a folder, not a trial; name one of its .npz files")
    arrays = _arrays(path)
    header = _header(path, arrays)
    gyr = _counts(path, arrays, "gyr")
    acc = _counts(path, arrays, "acc", len(gyr))
    if not len(gyr):
        raise TrialError(f"{path}: the trial has no samples")
    counts = np.zeros((len(gyr), 11), np.int16)
    counts[:, 0:3] = acc
    counts[:, 3:6] = gyr
    counts[:, 9] = round((25 - 36.53) * 340)  # 25 degC on an MPU6050 (RM-MPU-6000A rev 4.2, 4.18)
    mag_scale = None
    if "mag" in arrays:
        counts[:, 6:9] = _counts(path, arrays, "mag", len(gyr))
        mag_scale = _number(path, header, "mag_uT_per_lsb")
    gt_every, q_gt, movement = _truth(path, arrays, header, len(gyr))
    return Trial(
        name=str(header.get("name") or path.stem)[:100],
        counts=counts,
        rate=_rate(path, header),
        accel_lsb_per_g=_accel_scale(path, header),
        gyro_scale=_gyro_scale(path, header),
        mag_uT_per_lsb=mag_scale,
        gt_every=gt_every,
        q_gt=q_gt,
        movement=movement,
        header=header,
    )


def find_data() -> Path | None:
    """The folder of recorded trials: UPRIGHT_DATA, else the one beside the project, else None.

    An empty UPRIGHT_DATA means none. Raises TrialError when UPRIGHT_DATA names no folder.
    """
    named = os.environ.get("UPRIGHT_DATA")
    if named is not None:
        if named and not Path(named).is_dir():
            raise TrialError(f"UPRIGHT_DATA names no folder: {named}")
        return Path(named) if named else None
    beside = paths.ROOT / BESIDE
    return beside.resolve() if beside.is_dir() else None


NO_DATA = "no recorded trials here: set UPRIGHT_DATA to a folder of recorded trials"


def trial_files() -> list[Path]:
    """All trials in find_data()'s folder, sorted by name; empty when there is none."""
    folder = find_data()
    return sorted(folder.glob("*.npz")) if folder else []


def enu_to_nwu(q) -> np.ndarray:
    """Attitudes (m, 4) in an earth frame x east, y north, z up -> in x north, y west, z up."""
    # the product (r, 0, 0, -r) * q with r = sqrt(1/2): the earth frame turned by a quarter about up
    q0, q1, q2, q3 = np.asarray(q, float).T
    return np.stack([q0 + q3, q1 + q2, q2 - q1, q3 - q0], 1) * math.sqrt(0.5)


# What can be wrong with a file


def _arrays(path: Path) -> dict:
    """Every array of the archive by name."""
    known = ("gyr", "acc", "mag", "q_gt", "movement", "header")
    try:
        with open(path, "rb") as file:
            start = file.read(4)
            if start != b"PK\x03\x04":
                raise TrialError(f"{path} is not an .npz archive: it starts with {start!r}")
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in known if name in archive.files}
    except TrialError:
        raise
    except zipfile.BadZipFile as error:
        raise TrialError(f"{path} is truncated or damaged: {error}") from error
    except Exception as error:  # numpy lets zlib's, struct's and the parser's errors through
        raise TrialError(f"{path} is damaged: {type(error).__name__}: {error}") from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # numpy hands such a member over as it is
            raise TrialError(f"{path} is damaged: {name} is no .npy array")
    missing = [name for name in ("gyr", "acc", "header") if name not in arrays]
    if missing:
        raise TrialError(f"{path} is not a trial: it lacks {', '.join(missing)}")
    return arrays


def _header(path: Path, arrays: dict) -> dict:
    raw = arrays["header"]
    if raw.dtype != np.uint8 or raw.ndim != 1:
        raise TrialError(f"{path}: header is {raw.dtype} {raw.shape}, expected uint8 (length,)")
    try:
        header = json.loads(raw.tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise TrialError(f"{path}: the header is not JSON: {error}") from error
    if not isinstance(header, dict):
        raise TrialError(f"{path}: the header is a {type(header).__name__}, expected an object")
    return header


def _counts(path: Path, arrays: dict, name: str, n: int | None = None) -> np.ndarray:
    array = arrays[name]
    if array.dtype.newbyteorder("=") != np.int16:
        raise TrialError(f"{path}: {name} is {array.dtype}, expected int16 counts")
    expected = f"({'n' if n is None else n}, 3)"
    if array.ndim != 2 or array.shape[1] != 3 or n not in (None, len(array)):
        raise TrialError(f"{path}: {name} has the shape {array.shape}, expected {expected}")
    return array


def _number(path: Path, header: dict, key: str) -> float:
    """A positive number of the header."""
    if key not in header:
        raise TrialError(f"{path}: the header lacks {key}")
    value = header[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TrialError(f"{path}: {key} is {value!r}, expected a number")
    if not 0 < value < 1e9:  # NaN and infinity fail as well
        raise TrialError(f"{path}: {key} is {value!r}, expected a positive number")
    return value


def _rate(path: Path, header: dict) -> tuple:
    """The header's rate as a ratio (num, den): the simplest that is as near as a float tells."""
    value = _number(path, header, "rate_hz")
    if not 1 <= value <= 8000:  # the gyro's output rate (RM-MPU-6000A rev 4.2, 4.2)
        raise TrialError(f"{path}: rate_hz {value} is not within 1 and 8000")
    exact = Fraction(value)
    for digits in range(3, 10):  # with den up to 10**9 the error is below 5e-10
        rate = exact.limit_denominator(10**digits)
        if abs(rate - exact) <= exact / 10**9:
            break
    return rate.numerator, rate.denominator


def _accel_scale(path: Path, header: dict) -> int:
    value = _number(path, header, "acc_mps2_per_lsb")
    found = STANDARD_GRAVITY / value
    for scale in ACCEL_RANGES:
        if math.isclose(found, scale, rel_tol=_SCALE_TOLERANCE):
            return scale
    raise TrialError(
        f"{path}: acc_mps2_per_lsb {value} is {found:.6g} LSB per g (of {STANDARD_GRAVITY} m/s2), "
        f"which no range of an MPU6050 gives ({', '.join(str(scale) for scale in ACCEL_RANGES)})"
    )


def _gyro_scale(path: Path, header: dict) -> tuple:
    value = _number(path, header, "gyr_dps_per_lsb")
    for num, den in GYRO_RANGES:
        if math.isclose(1 / value, num / den, rel_tol=_SCALE_TOLERANCE):
            return num, den
    raise TrialError(
        f"{path}: gyr_dps_per_lsb {value} is {1 / value:.6g} LSB per deg/s, which no range of an "
        f"MPU6050 gives ({', '.join(f'{num / den:g}' for num, den in GYRO_RANGES)})"
    )


def _truth(path: Path, arrays: dict, header: dict, n: int) -> tuple:
    """(gt_every, q_gt, movement), or three times None for a trial without truth."""
    if "q_gt" not in arrays:
        return None, None, None
    every = _number(path, header, "gt_every")
    if every != int(every):
        raise TrialError(f"{path}: gt_every is {every!r}, expected a whole number")
    every = int(every)
    q_gt = arrays["q_gt"]
    m = -(-n // every)
    if q_gt.dtype.kind != "f" or q_gt.shape != (m, 4):
        raise TrialError(f"{path}: q_gt is {q_gt.dtype} {q_gt.shape}, expected floats ({m}, 4)")
    with np.errstate(all="ignore"):  # a signalling NaN, numbers whose squares are too large
        q_gt = q_gt.astype(float)
        norm = np.linalg.norm(q_gt, axis=1)
    if (np.abs(norm - 1) > 0.01).any() or np.isinf(q_gt).any():  # false for NaN: no truth
        raise TrialError(f"{path}: q_gt holds rows that are no unit quaternions")
    if "movement" not in arrays:
        raise TrialError(f"{path} has q_gt but lacks movement")
    bits = arrays["movement"]
    if bits.dtype != np.uint8 or bits.shape != (-(-m // 8),):
        raise TrialError(
            f"{path}: movement is {bits.dtype} {bits.shape}, expected uint8 ({-(-m // 8)},)"
        )
    return every, q_gt, np.unpackbits(bits)[:m].astype(bool)
