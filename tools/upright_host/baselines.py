"""Other people's filters on a recorded trial's samples, to compare with: VQF, ahrs, x-io's Fusion.

Every one gets the same counts in its units, the raw gyro, its own defaults, and what it cannot know by itself: the
rate, and the gyro's range. All estimates are causal: row i knows the samples up to i. The packages are the optional
extra `baselines`. `python -m upright_host.baselines NAME TRIAL.npz ROWS OUT` runs one of them in a process of its own
and writes float64 (n, 4).
"""

import importlib
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np

from upright_host import trials

INSTALL = ".venv/bin/pip install -c tools/constraints.txt -e '.[baselines]'"


class Missing(Exception):
    """A package is not installed; the message is one line that says which, and how to get it."""


def estimate(name: str, trial: trials.Trial, rows: int | None = None) -> np.ndarray:
    """The baseline's attitudes after each of the first `rows` samples (None: all).

    float64 (n, 4), scalar first, sensor -> earth with x north, y west, z up. Raises Missing, and ValueError for an
    unknown name or for nine axes of a trial without a magnetometer.
    """
    if name not in BASELINES:
        raise ValueError(f"unknown baseline {name!r}; there are {', '.join(BASELINES)}")
    package, axes, run = BASELINES[name]
    if axes == 9 and trial.mag_uT_per_lsb is None:
        raise ValueError(f"{name} needs a magnetometer, {trial.name} has none")
    try:
        module = importlib.import_module(package)
    except ImportError as why:
        raise Missing(f"{package} is not installed: {INSTALL}") from why
    return run(module, *units(trial, axes, rows), trial)


def installed(name: str) -> bool:
    """Can the package of this baseline be imported?"""
    return importlib.util.find_spec(BASELINES[name][0]) is not None


def units(trial: trials.Trial, axes: int, rows: int | None = None) -> tuple:
    """(rate in Hz, gyr in rad/s, acc in m/s2, mag in uT): float64 (n, 3) each; mag is None with six axes."""
    counts = trial.counts[:rows].astype(float)
    num, den = trial.gyro_scale
    gyr = np.radians(counts[:, 3:6] * (den / num))
    acc = counts[:, 0:3] * (trials.STANDARD_GRAVITY / trial.accel_lsb_per_g)
    mag = counts[:, 6:9] * trial.mag_uT_per_lsb if axes == 9 else None
    contiguous = [None if a is None else np.ascontiguousarray(a) for a in (gyr, acc, mag)]
    return trial.rate[0] / trial.rate[1], *contiguous


def _vqf(vqf, rate, gyr, acc, mag, trial):
    filter = vqf.VQF(1 / rate)
    if mag is None:
        return trials.enu_to_nwu(filter.updateBatch(gyr, acc)["quat6D"])
    return trials.enu_to_nwu(filter.updateBatch(gyr, acc, mag)["quat9D"])


def _mahony(ahrs, rate, gyr, acc, mag, trial):
    return trials.enu_to_nwu(ahrs.filters.Mahony(gyr, acc, mag, frequency=rate).Q)


def _madgwick(ahrs, rate, gyr, acc, mag, trial):
    return ahrs.filters.Madgwick(gyr, acc, mag, frequency=rate).Q


def _ekf(ahrs, rate, gyr, acc, mag, trial):
    # Its steps take the accelerometer as gravity, downwards, its start as upwards: so it is told where to start. And it
    # has to be told the dip of the field, or it takes that of Munich.
    up = acc[0] / np.linalg.norm(acc[0])
    if mag is None:
        start, dip = ahrs.common.orientation.acc2q(acc[0]), 0.0
    else:
        start = ahrs.common.orientation.am2q(acc[0], mag[0])
        dip = -math.degrees(math.asin(np.clip(mag[0] @ up / np.linalg.norm(mag[0]), -1, 1)))
    filter = ahrs.filters.EKF(
        gyr, -acc, mag, frequency=rate, frame="ENU", magnetic_ref=dip, q0=start
    )
    return trials.enu_to_nwu(filter.Q)


def _fusion(imufusion, rate, gyr, acc, mag, trial):
    # Its gyro bias estimator beside it, as in its own examples.
    filter, bias = imufusion.Ahrs(), imufusion.Bias()
    filter.set_settings(
        imufusion.AhrsSettings(sample_rate=rate, gyroscope_range=trial.gyro_range_dps)
    )
    bias.set_settings(imufusion.BiasSettings(sample_rate=rate))
    gyr, acc = np.degrees(gyr), acc / trials.STANDARD_GRAVITY
    out = np.empty((len(gyr), 4))
    for i in range(len(gyr)):
        w = bias.update(gyr[i])
        if mag is None:
            filter.update_no_magnetometer(w, acc[i])
        else:
            filter.update(w, acc[i], mag[i])
        out[i] = filter.get_quaternion()
    return out


# name: (package, axes, function of the package, the samples and the trial)
BASELINES = {
    "vqf6": ("vqf", 6, _vqf),
    "vqf9": ("vqf", 9, _vqf),
    "ahrs-mahony6": ("ahrs", 6, _mahony),
    "ahrs-mahony9": ("ahrs", 9, _mahony),
    "ahrs-madgwick6": ("ahrs", 6, _madgwick),
    "ahrs-madgwick9": ("ahrs", 9, _madgwick),
    "ahrs-ekf6": ("ahrs", 6, _ekf),
    "ahrs-ekf9": ("ahrs", 9, _ekf),
    "imufusion6": ("imufusion", 6, _fusion),
    "imufusion9": ("imufusion", 9, _fusion),
}


def main(name, path, rows, out):
    estimate(name, trials.load(path), int(rows)).tofile(Path(out))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (Missing, ValueError) as why:
        sys.exit(str(why))
