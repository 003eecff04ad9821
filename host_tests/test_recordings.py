"""The default filters on the recorded trials, group by group; a machine without the recordings skips them."""

import motions
import numpy as np
import pytest
import translate
from upright_host import scoring, trials

pytestmark = pytest.mark.skipif(not translate.GCC, reason=translate.NO_GCC)

# files of the data's folder, axes, measure: (inclination, heading, total), how they are put together, the most
GROUPS = [
    ("broad_*", 9, "as given", np.mean, (0.73, None, 1.82)),
    ("broad_*", 6, "best", np.mean, (0.735, 1.755, 1.95)),
    ("more/tyrex_iphone4s_*", 9, "best", np.median, (1.3, 5.4, None)),
    ("more/tyrex_iphone5_*", 9, "best", np.median, (1.9, 6.5, None)),
    ("more/tyrex_iphone*", 9, "best", np.max, (None, 34.5, None)),
    ("mpu6050_static_*", 9, "best", np.mean, (0.05, None, 0.1)),
    ("mpu6050_static_*", 6, "best", np.mean, (0.05, None, 0.1)),
    ("more/als_vicon", 6, "best", np.mean, (2.2, None, None)),
]


def loaded(file):
    """A trial with its flags, as a driver gives them."""
    trial = trials.load(file)
    c = trial.counts
    full = np.abs(c[:, :6].astype(int)) >= 32767
    c[:, 10] = 1 if trial.mag_uT_per_lsb is None else 3
    c[:, 10] += (4 * full[:, :3].any(1) + 8 * full[:, 3:].any(1)).astype(np.int16)
    return trial


def found(pattern):
    folder = trials.find_data()
    files = sorted(folder.glob(pattern + ".npz")) if folder else []
    if not files:
        pytest.skip(f"no recordings {pattern}")
    return files


@pytest.mark.parametrize("pattern, axes, measure, together, most", GROUPS)
def test_a_group_of_recordings_is_as_accurate_as_promised(pattern, axes, measure, together, most):
    rows = []
    for file in found(pattern):
        trial = loaded(file)
        words, run = translate.history(trial, f"inertial{axes}")
        assert run.overflows() == []
        s = scoring.score_trial(words / scoring.ONE, trial)
        given = measure == "as given"
        rows.append(
            (
                s.inclination,
                *((s.heading, s.total) if given else (s.aligned_heading, s.aligned_total)),
            )
        )
    figures = together(rows, axis=0)
    print(f"{pattern}, {axes} axes: {len(rows)} trials, {np.round(figures, 3)}")
    for name, figure, limit in zip(("inclination", "heading", "total"), figures, most, strict=True):
        assert limit is None or figure <= limit, name


def test_a_magnet_that_comes_near_a_board_at_rest_does_not_turn_it():
    """A magnet lies near from 101 to 116 s; the six-axis truth knows that nothing turned."""
    trial = loaded(found("more/xio_sensor_data")[0])
    words, _ = translate.history(trial, "inertial9")
    q, truth = words / scoring.ONE, trial.q_true()
    rows = np.arange(len(truth)) * trial.gt_every
    rows = rows[rows < len(q)]
    e = motions.multiply(q[rows], truth[: len(rows)] * [1, -1, -1, -1])
    heading = 2 * np.arctan2(e[:, 3], e[:, 0])
    t = rows * trial.rate[1] / trial.rate[0]
    before = np.angle(np.exp(1j * heading[(t > 60) & (t < 100)]).mean())
    off = np.degrees(np.abs(np.angle(np.exp(1j * (heading - before)))))
    assert off[t > 60].max() < 10
