"""Recordings of a board's counts: `.imu` as the board writes them, `.npz` (a trial), `.csv`."""

import csv
import fractions
import json
import os
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from upright_host import library, trials
from upright_host.console import Wrong

_MOST_CSV = 64 << 20  # bytes: an hour at 1 kHz in few columns
COLUMNS = ("ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temp", "flags")


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
            raise Wrong(f"{self.name}: no fresh sample of accelerometer and gyro in it")
        if not rows[:, :6].any():
            raise Wrong(f"{self.name}: the counts of accelerometer and gyro are all 0")
        num, den = self.gyro_scale
        return rows[:, :3] / self.accel_lsb_per_g, rows[:, 3:6] * (den / num)

    def magnetic(self) -> np.ndarray:
        """Fresh rows of the magnetometer, counts, float (m, 3), without those at full scale."""
        mag = self.counts[self.fresh(2)][:, 6:9]
        mag = mag[(np.abs(mag) < 32767).all(1)]
        if not mag.any():
            raise Wrong(f"{self.name}: no magnetometer sample in it")
        return mag.astype(float)


def load(path: Path, rate=None, accel_range=None, gyro_range=None) -> Recording:
    """A recording: `.imu`, `.npz` (a trial), or `.csv` of counts. Raises Wrong.

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
        raise Wrong(f"{path}: no such file") from None


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
    try:
        held = library.simulator("world").World(str(path))
    except ValueError as why:
        raise Wrong(str(why)) from why
    held.close()
    for name in ("accel_lsb_per_g", "gyro_scale"):
        value = getattr(held, name)
        if max(value if isinstance(value, tuple) else (value,)) >= 2**31:
            raise Wrong(f"{path}: {name} {value} is none of a sensor")
    if not 1e-3 <= fractions.Fraction(*held.rate) <= 1e6:
        raise Wrong(f"{path}: a rate of {held.rate[0]}/{held.rate[1]} Hz is none")
    data = path.read_bytes()
    end = data.index(b"\n")
    more = json.loads(data[:end])  # what a board that recorded it says besides
    scale = more.get("mag_lsb_per_uT")
    if scale is not None and not _is_ratio(scale):
        raise Wrong(f"{path}: mag_lsb_per_uT is {scale!r}, expected two positive numbers")
    for name in ("chip", "board"):
        if not isinstance(more.get(name, ""), str | None):
            raise Wrong(f"{path}: {name} is {more[name]!r}, expected a name")
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


def _is_ratio(pair) -> bool:
    return (
        isinstance(pair, list)
        and len(pair) == 2
        and all(type(number) is int and 0 < number < 2**31 for number in pair)
    )


def _from_csv(path: Path, rate, accel_range, gyro_range) -> Recording:
    lsb = {g: scale for scale, g in trials.ACCEL_RANGES.items()}
    scale = {dps: pair for pair, dps in trials.GYRO_RANGES.items()}
    if accel_range not in lsb or gyro_range not in scale:
        raise Wrong(
            f"no range of +-{accel_range} g and +-{gyro_range} deg/s; there are "
            f"{', '.join(map(str, sorted(lsb)))} g and {', '.join(map(str, sorted(scale)))} deg/s"
        )
    with open(path, encoding="utf-8-sig", newline="") as file:
        if os.fstat(file.fileno()).st_size > _MOST_CSV:
            raise Wrong(f"{path} is larger than {_MOST_CSV >> 20} MB: cut it into pieces")
        try:
            counts, times = _rows(csv.reader(file))
        except (UnicodeDecodeError, csv.Error) as why:
            raise Wrong(f"{path}: not a CSV file with a header line: {why}") from why
        except ValueError as why:
            raise Wrong(f"{path}{why}") from why
    if rate is None and len(times) > 1 and times[-1] > times[0]:
        rate = (len(times) - 1) / (times[-1] - times[0])
    return Recording(path.name, counts, rate, lsb[accel_range], scale[gyro_range])


def _rows(lines) -> tuple[np.ndarray, list]:
    """(counts, times) of a CSV's lines. Raises ValueError with what stands behind the file's name."""
    head = next(lines, None)
    if head is None:
        raise csv.Error("it is empty")
    names = [name.strip().lower() for name in head]
    if not set(names) & set(COLUMNS):
        raise ValueError(f": the first line names none of the columns {' '.join(COLUMNS)}")
    places = [COLUMNS.index(name) if name in COLUMNS else None for name in names]
    counts, times = array("h"), []  # millions of rows: as small as they can be
    row = [0] * len(COLUMNS)
    for i, fields in enumerate(lines):
        try:
            for name, place, text in zip(names, places, fields, strict=True):
                if place is not None:
                    row[place] = int(text)
                elif name == "t":
                    times.append(float(text))
            counts.extend(row)
        except (ValueError, OverflowError) as why:
            raise ValueError(f", line {i + 2}: {why}; expected whole counts of 16 bits") from why
    if not counts:
        raise ValueError(": no rows")
    return np.array(counts, np.int64).reshape(-1, len(COLUMNS)), times
