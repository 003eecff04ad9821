"""How far estimated attitudes are from the truth: RMSE in degrees; and the output CSV.

The measure is that of the BROAD benchmark (D. Laidig, M. Caruso, A. Cereatti, T. Seel, Data 6:72,
2021): the error quaternion in the earth frame, q_estimated * conj(q_true), is split into a turn
about the vertical (heading) and the least turn that remains (inclination), over the samples of the
movement phase that have a truth.
Quaternions are scalar first, sensor -> earth (x north, y west, z up).
"""

import math
from dataclasses import dataclass

import numpy as np

CSV_HEADER = "t,q0,q1,q2,q3"
ONE = 1 << 29  # Q29, the runtimes' quaternion


@dataclass(frozen=True)
class Score:
    """Angles in degrees: root mean squares over `samples`, but for offset and max_inclination.

    inclination                     error of tilt; no heading in it
    heading, total                  as given, against the true north
    aligned_heading, aligned_total  after the best constant heading offset: the fair figures for an
                                    estimate without a magnetometer
    offset                          that offset
    samples                         rows of the truth that were compared; with 0 every angle is NaN
    coverage                        samples / rows of the truth in the movement phase, 0..1
    """

    inclination: float
    heading: float
    total: float
    aligned_heading: float
    aligned_total: float
    offset: float
    max_inclination: float
    samples: int
    coverage: float

    def lines(self) -> list[str]:
        """The few lines that a person reads."""
        if not self.samples:
            return ["nothing to score: there is no truth of the movement in this span"]
        lines = [
            f"inclination    {self.inclination:7.3f} deg RMSE, {self.max_inclination:.2f} at most",
            f"as given       heading {self.heading:7.3f}  total {self.total:7.3f}",
            f"best heading   heading {self.aligned_heading:7.3f}  total {self.aligned_total:7.3f}"
            f"  (offset {self.offset:.2f})",
            f"compared       {self.samples} samples, {100 * self.coverage:.1f} % of the truth",
        ]
        if self.coverage < 0.99:
            lines[-1] += ": the output covers only a part"
        return lines

    def __str__(self) -> str:
        return "\n".join(self.lines())


def once(rows) -> np.ndarray:
    """A mask (n,) of the steps whose sample, a row of the world, no earlier step has seen."""
    return np.concatenate([[True], np.diff(rows) > 0])


def score(t, q, t_true, q_true, movement=None, slack=0.0) -> Score:
    """Compare the attitudes q (n, 4) at the times t (n,) with q_true (m, 4) at t_true (m,).

    Times in seconds, t ascending. q is interpolated to the times of the truth (normalised chord)
    and held beyond its ends. Truth that is NaN, lies outside the movement mask (m,), or more than
    `slack` seconds before t[0] or after t[-1] does not count.
    Raises ValueError for shapes that do not fit, for times that do not ascend, and for a quaternion
    that is zero or not finite.
    """
    t, q = np.asarray(t, float), np.asarray(q, float)
    t_true, q_true = np.asarray(t_true, float), np.asarray(q_true, float)
    if q.shape != (len(t), 4) or not len(t):
        raise ValueError(f"quaternions {q.shape} do not fit {len(t)} times")
    if q_true.shape != (len(t_true), 4):
        raise ValueError(f"true quaternions {q_true.shape} do not fit {len(t_true)} times")
    if not (np.diff(t) > 0).all():
        raise ValueError("the times do not ascend")
    norm = np.linalg.norm(q, axis=1)
    if not (np.isfinite(norm) & (norm > 0)).all():
        k = int(np.argmin(np.isfinite(norm) & (norm > 0)))
        raise ValueError(f"row {k} is no attitude: {q[k]}")
    q = q / norm[:, None]

    wanted = np.isfinite(q_true).all(1)
    if movement is not None:
        wanted &= movement
    used = wanted & (t_true >= t[0] - slack) & (t_true <= t[-1] + slack)
    if not used.any():
        return Score(*[math.nan] * 7, samples=0, coverage=0.0)
    truth = q_true[used] / np.linalg.norm(q_true[used], axis=1)[:, None]
    error = _multiply(_at(t_true[used], t, q), truth * [1, -1, -1, -1])

    inclination = 2 * np.arccos(np.clip(np.hypot(error[:, 0], error[:, 3]), 0, 1))
    heading = 2 * np.arctan2(error[:, 3], error[:, 0])
    # the circle's mean, then the mean of what is left: three rounds settle it
    offset = np.arctan2(np.sin(heading).mean(), np.cos(heading).mean())
    for _ in range(3):
        offset += _wrap(heading - offset).mean()
    # only the scalar part of the error turned back by the offset is needed
    aligned = np.cos(offset / 2) * error[:, 0] + np.sin(offset / 2) * error[:, 3]
    return Score(
        inclination=_rms(inclination),
        heading=_rms(_wrap(heading)),
        total=_rms(_angle(error[:, 0])),
        aligned_heading=_rms(_wrap(heading - offset)),
        aligned_total=_rms(_angle(aligned)),
        offset=math.degrees(_wrap(offset)),
        max_inclination=math.degrees(inclination.max()),
        samples=int(used.sum()),
        coverage=float(used.sum() / wanted.sum()),
    )


def score_trial(q, trial) -> Score:
    """Score q (n, 4), row i the attitude after sample i, against the truth of a trials.Trial."""
    num, den = trial.rate
    t = np.arange(len(q)) * den / num
    return score(t, q, trial.t_gt, trial.q_true(), trial.movement, slack=0.5 * den / num)


def score_motion(q, motion) -> Score:
    """Score q (n, 4), row i the attitude after row i, against a synthetic motion (q_true, rate)."""
    num, den = motion.rate
    t = np.arange(max(len(q), len(motion.q_true))) * den / num
    return score(t[: len(q)], q, t[: len(motion.q_true)], motion.q_true)


def write_csv(path, q29, rate) -> None:
    """Write rows t,q0,q1,q2,q3 from integer quaternions.

    q29: (n, 4) integers in Q29; row i is the attitude after sample i, at t = i*den/num seconds;
    rate: (num, den) or int Hz. Nine decimals, correctly rounded: the same integers give the same
    bytes whichever runtime made them, and every integer can be read back (2**-29 > 1e-9).
    Raises ValueError when q29 is of another shape or kind.
    """
    num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
    q29 = np.asarray(q29)
    if q29.ndim != 2 or q29.shape[1] != 4 or q29.dtype.kind not in "iu":
        raise ValueError(f"expected integers (n, 4), got {q29.dtype} {q29.shape}")
    with open(path, "w", encoding="ascii", newline="\n") as out:
        out.write(CSV_HEADER + "\n")
        for i, (q0, q1, q2, q3) in enumerate((q29 / ONE).tolist()):
            out.write(f"{i * den / num:.9f},{q0:.9f},{q1:.9f},{q2:.9f},{q3:.9f}\n")


def read_csv(path) -> tuple[np.ndarray, np.ndarray]:
    """(t (n,), q (n, 4)) of an output file. Raises ValueError that names the wrong line."""
    rows = []
    with open(path, encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            if number == 1 and line.strip() == CSV_HEADER:
                continue
            try:
                row = [float(field) for field in line.split(",")]
            except ValueError:
                row = []
            if len(row) != 5 or not all(map(math.isfinite, row)):
                found = line.rstrip("\n")[:60]
                raise ValueError(f"{path}, line {number}: expected {CSV_HEADER}, found {found!r}")
            rows.append(row)
    if not rows:
        raise ValueError(f"{path} has no rows")
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def _at(when, t, q):
    """The unit quaternions q at the times t, interpolated to `when`."""
    if len(t) == 1:
        return np.repeat(q, len(when), axis=0)
    i = np.clip(np.searchsorted(t, when) - 1, 0, len(t) - 2)
    part = np.clip((when - t[i]) / (t[i + 1] - t[i]), 0, 1)[:, None]
    a, b = q[i], q[i + 1]
    b = b * np.where((a * b).sum(1) < 0, -1, 1)[:, None]  # q and -q are one attitude: the near one
    chord = a + part * (b - a)
    return chord / np.linalg.norm(chord, axis=1)[:, None]


def _multiply(a, b):
    """The Hamilton product, row by row."""
    a0, a1, a2, a3 = a.T
    b0, b1, b2, b3 = b.T
    return np.stack(
        [
            a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
            a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
            a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
            a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
        ],
        1,
    )


def _wrap(angle):
    """Into -pi..pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _angle(scalar):
    """The angle of a rotation whose quaternion has this scalar part."""
    return 2 * np.arccos(np.clip(np.abs(scalar), 0, 1))


def _rms(angle):
    return math.degrees(math.sqrt(np.mean(np.square(angle))))
