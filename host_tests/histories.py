"""Runs of one filter over all rows of a motion or a trial, and what tests compare them with."""

import json
from dataclasses import dataclass

import motions
import numpy as np

ONE = 1 << 29
SCALE = (82, 5)  # LSB per deg/s at +-2000 deg/s
SCALES = {250: (131, 1), 500: (131, 2), 1000: (164, 5), 2000: (82, 5)}


@dataclass
class History:
    """q29 (n, 4) and q, the same as floats; bias_dps (n, 3); words (n, ...) of the state; said: the last state."""

    q29: np.ndarray
    bias_dps: np.ndarray
    words: np.ndarray
    said: str

    @property
    def q(self):
        return self.q29 / ONE


def run(portable, folder, runtime, rendered, name, **options):
    """A filter of the registry over all rows of `rendered`; options: see portable/filter_history.py."""
    world, out = folder / "world.imu", folder / "out"
    rendered.write(world)
    asked = folder / "options.json"
    asked.write_text(json.dumps(options))
    said = portable(runtime, "filter_history.py", world, out, name, asked)
    width = 7 + len(options.get("words", ()))
    rows = np.fromfile(out, "<i4").reshape(-1, width)
    assert "only" in options or len(rows) == len(rendered.counts)
    num, den = rendered.gyro_scale
    return History(rows[:, :4], rows[:, 4:7] / 256 * den / num, rows[:, 7:], said)


def rows_of(rendered, mag_every=1):
    """The rows as lists, with the flags that portable/filter_history.py gives."""
    rows = rendered.counts.astype(int)
    plain = rows[:, 10] == 0
    fresh = np.arange(len(rows)) % mag_every == 0 if mag_every else np.zeros(len(rows), bool)
    rows[plain, 10] = np.where(fresh[plain], 3, 1)
    rows[((rows[:, :3] == -32768) | (rows[:, :3] == 32767)).any(1), 10] |= 4
    return rows.tolist()


def of_twin(kind, twin, rendered, mag_every=1, bias=(), gains=None, **options):
    """A float twin over the same rows, begun as portable/filter_history.py begins the filter: attitudes (n, 4)."""
    rows = rows_of(rendered, mag_every)
    filter = kind(rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, **(gains or {}))
    if bias:
        filter.set_bias(*bias)
    filter.seed(rows[0])
    twin = twin.like(filter, **options)
    q = np.empty((len(rows), 4))
    for i, row in enumerate(rows):
        twin.update(row)
        q[i] = twin.q
    return q


def follow(twin, rows, decided):
    """A float twin over rows with the decisions of the integer run: its attitudes (n, 4)."""
    q = np.empty((len(rows), 4))
    for i, (row, bits) in enumerate(zip(rows, decided, strict=True)):
        twin.update(row, bits)
        q[i] = twin.q
    return q


def hold(what, q, twin, limit):
    """Never further than limit degrees apart; pytest -rP shows the figure."""
    worst = angles_between(q, twin).max()
    print(f"{what}: {worst:.6f} deg")
    assert worst < limit


def angles_between(p, q):
    """Degrees between the quaternions of two (n, 4) arrays."""
    p, q = p / np.linalg.norm(p, axis=1)[:, None], q / np.linalg.norm(q, axis=1)[:, None]
    e = motions.multiply(p * [1, -1, -1, -1], q)
    return np.degrees(2 * np.arctan2(np.linalg.norm(e[:, 1:], axis=1), np.abs(e[:, 0])))


def bias_at_rest(trial):
    """The bias of a trial at rest in 1/256 count, as the firmware would have measured it; [] where it is not known."""
    scale = trial.gyro_scale[0] / trial.gyro_scale[1] * 256
    return [round(b * scale) for b in trial.header.get("gyro_bias_rest_dps", ())]
