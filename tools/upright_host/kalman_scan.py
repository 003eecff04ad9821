"""The scalar Kalman filter of lib/upright/kalman.py on an angle of a recorded trial, for many Q and R.

The angle is by default that of the accelerometer alone, the Euler-angle method without the gyro: noisy, and wrong under
acceleration. It is all that a scalar filter has; what it can do is to trade noise for lag. One filter of the registry
can take the accelerometer's place.
"""

import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from upright_host import library, plotting, registry, replay, simulate, trials
from upright_host.console import Wrong

USUAL = (10.0, 0.05)  # Q, R in deg**2: the values that are widely copied
# half decades about them
Q_GRID = tuple(USUAL[0] * 10 ** (k / 2) for k in range(-10, 3))
R_GRID = tuple(USUAL[1] * 10 ** (k / 2) for k in range(-2, 9))
ACCELEROMETER = "accelerometer"
AXES = ("roll", "pitch")
REST_S = 2.0
COLUMNS = ("Q", "R", "ratio", "K", "settling_s", "lag_s", "noise_deg", "rmse_deg")
_STEP = 100000  # millideg
_NEAR = 0.02  # of a step
_LONGEST_S = 60


@dataclass(frozen=True)
class Signal:
    """An angle to be filtered.

    z      int (n,): what was measured, millideg within +-180000
    rate   Hz
    truth  deg (m,) of the samples `at` (m,), or None
    rest   the slice of samples where the board lies most still, REST_S long
    axis   of AXES; source: ACCELEROMETER, or a filter's name
    """

    z: list
    rate: float
    at: np.ndarray | None
    truth: np.ndarray | None
    rest: slice
    axis: str
    source: str

    def error(self, x) -> np.ndarray:
        """Of the estimates x (n,) in deg, at the samples that have a truth."""
        return plotting.wrap(np.asarray(x)[self.at] - self.truth)

    def rmse(self, x) -> float:
        return float(np.sqrt(np.mean(self.error(x) ** 2)))

    def noise(self, x) -> float:
        """Standard deviation at rest, deg."""
        still = np.asarray(x)[self.rest]
        return float(np.std(plotting.wrap(still - still[0])))


@dataclass(frozen=True)
class Setting:
    """What a pair of Q and R comes to.

    K         gain, settled
    settling  s to stay within 2 % of a step
    lag       s behind a ramp; None, and settling None, where they run to minutes
    noise     standard deviation where the board lies most still, deg
    rmse      deg
    """

    Q: float
    R: float
    K: float
    settling: float | None
    lag: float | None
    noise: float
    rmse: float

    @property
    def ratio(self) -> float:
        return self.Q / self.R

    def cells(self) -> list:
        """The values of COLUMNS."""
        return [self.Q, self.R, self.ratio, self.K, self.settling, self.lag, self.noise, self.rmse]


# ------------------------------------------------------------------------------------------- the signal
def signal(
    trial: trials.Trial,
    axis: str = "pitch",
    source: str = ACCELEROMETER,
    runtime: str | None = None,
    seconds: float | None = None,
) -> Signal:
    """An angle of a trial as the accelerometer alone shows it, or a filter of the registry.

    Raises Wrong, and what replay.replay raises.
    """
    if axis not in AXES:
        raise Wrong(f"unknown axis {axis!r}; there are {', '.join(AXES)}")
    n = trial.rows(seconds)
    if source == ACCELEROMETER:
        x, y, z = trial.counts[:n, :3].astype(float).T
        angle = np.arctan2(y, z) if axis == "roll" else np.arctan2(-x, np.hypot(y, z))
        angle = np.degrees(angle)
    elif source not in registry.filters():
        names = ", ".join([ACCELEROMETER, *registry.filters()])
        raise Wrong(f"unknown source {source!r}; there are {names}")
    else:
        done = replay.replay(
            trial, source, runtime or simulate.best_runtime(), seconds, direct=True
        )
        angle = plotting.euler(done.q29 / 2**29)[:, AXES.index(axis)]
    millideg = (np.rint(angle * 1000).astype(int) + 180000) % 360000 - 180000
    at = truth = None
    if trial.has_truth:
        at = np.arange(len(trial.q_gt)) * trial.gt_every
        used = trial.movement & np.isfinite(trial.q_gt[:, 0]) & (at < n)
        if used.any():
            at, truth = at[used], plotting.euler(trial.q_true()[used])[:, AXES.index(axis)]
    rate = trial.rate[0] / trial.rate[1]
    still = _stillest(trial.counts[:n, 3:6], rate)
    return Signal(
        millideg.tolist(), rate, at if truth is not None else None, truth, still, axis, source
    )


def _stillest(gyro, rate) -> slice:
    """The REST_S in which the gyro changes least, not too near to the start for a filter to have settled."""
    span = min(len(gyro), max(2, round(REST_S * rate)))
    sums = [np.cumsum(np.vstack([np.zeros((1, 3)), gyro.astype(float) ** k]), 0) for k in (1, 2)]
    mean, square = [(of[span:] - of[:-span]) / span for of in sums]
    spread = (square - mean**2).sum(1)
    first = min(round(5 * rate), (len(gyro) - span) // 2)
    begin = first + int(np.argmin(spread[first:]))
    return slice(begin, begin + span)


# ------------------------------------------------------------------------------------------- the filter
def kalman_filter():
    """lib/upright/kalman.py's KalmanFilter, which needs nothing of a board's."""
    return library.upright("kalman").KalmanFilter


def filtered(z: list, Q: float, R: float) -> np.ndarray:
    """The estimates in deg after each measurement z in millideg."""
    update = kalman_filter()(z[0], Q, R).update
    return np.array([update(value) for value in z]) / 1000


def response(Q: float, R: float, rate: float) -> tuple[float, float | None, float | None]:
    """(settled K, seconds to stay within 2 % of a step, lag behind a ramp in s) of the filter at `rate` Hz."""
    filter = kalman_filter()(0, Q, R, turn=None)
    longest, before = int(_LONGEST_S * rate), None
    for k in range(longest):
        filter.update(0)
        if k % 64 == 63:
            if before == filter.K:
                break
            before = filter.K
    left, far = 0.0, -1
    for k in range(longest):
        rest = 1 - filter.update(_STEP) / _STEP
        # a lag behind a ramp is the sum of what is left of a step: (1 - K) / K samples
        left += rest
        if abs(rest) > _NEAR:
            far = k
        elif abs(rest) < 1e-4:
            break
    if far == longest - 1:
        return filter.K, None, None
    return filter.K, (far + 1) / rate, left / rate


def setting(of: Signal, pair: tuple[float, float]) -> Setting:
    """What a pair of Q and R comes to on a signal with a truth."""
    x = filtered(of.z, *pair)
    return Setting(*pair, *response(*pair, of.rate), of.noise(x), of.rmse(x))


def scan(of: Signal, pairs, jobs: int | None = None, on_progress=lambda at: None) -> list[Setting]:
    """setting() of every pair, in several processes."""
    found = []
    # not forked: a thread may be drawing the progress
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, fresh) as pool:
        for one in pool.map(partial(setting, of), pairs, chunksize=4):
            found.append(one)
            on_progress(len(found))
    return found


def grid() -> list[tuple[float, float]]:
    return [(Q, R) for Q in Q_GRID for R in R_GRID]


def best(found: list[Setting]) -> Setting:
    """The least RMSE; of those that are as good, with the R that is nearest to the usual one."""
    least = min(s.rmse for s in found)
    equal = [s for s in found if s.rmse <= least * 1.0001]
    return min(equal, key=lambda s: abs(math.log(s.R / USUAL[1])))


def by_ratio(found: list[Setting]) -> dict[float, list[Setting]]:
    """{Q/R: the settings that have it}, from small to large."""
    groups: dict[float, list[Setting]] = {}
    for s in sorted(found, key=lambda s: s.ratio):
        groups.setdefault(float(f"{s.ratio:.4g}"), []).append(s)
    return groups


def spread(found: list[Setting]) -> float:
    """How far the RMSE of settings with the same Q/R lie apart at most, deg."""
    return max(np.ptp([s.rmse for s in group]) for group in by_ratio(found).values())


def advised(found: list[Setting]) -> tuple[Setting, Setting, Setting]:
    """The usual advice: with Q small and R large, raise Q until it gets no better; then, Q fixed, lower R likewise."""
    start = min(found, key=lambda s: s.ratio)
    first = min((s for s in found if s.R == start.R), key=lambda s: s.rmse)
    second = min((s for s in found if s.Q == first.Q), key=lambda s: s.rmse)
    return start, first, second


def usual(found: list[Setting]) -> Setting:
    return next(s for s in found if (s.Q, s.R) == USUAL)
