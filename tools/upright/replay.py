"""Replays recorded trials through a filter on a runtime."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from upright import scoring, simulate, trials


@dataclass
class Replay:
    """A trial replayed: q29 int32 (n, 4), row i after sample i; score is None without a truth."""

    trial: trials.Trial
    q29: np.ndarray
    result: dict
    score: scoring.Score | None


def board_for(filter_name: str) -> str:
    """The simulated board that a filter's samples come from: with a magnetometer for those of nine axes."""
    return "robomaster_a" if "9" in filter_name else "sim"


def replay(
    trial: trials.Trial,
    filter_name: str = "mahony6",
    runtime: str = "cpython",
    seconds: float | None = None,
    gains: dict | None = None,
    direct: bool = False,
    on_progress=None,
) -> Replay:
    """Replay a trial: through the chip model's registers, driver and tick, or `direct`, counts to filter.

    on_progress(done, of) is called now and then. Raises simulate.SimulationError.
    """
    with tempfile.TemporaryDirectory() as folder:
        world, out = Path(folder) / "trial.imu", Path(folder) / "attitudes"
        rows = trial.write(world, seconds)
        config = {
            "world": str(world),
            "filter": filter_name,
            "board_name": board_for(filter_name),
            "mag": trial.mag_uT_per_lsb is not None,
            "gains": gains or {},
            "direct": direct,
            "out": str(out),
        }

        def event(kind, fields):
            if kind == "at" and on_progress:
                on_progress(int(fields[0]), rows)

        result = simulate.run(runtime, simulate.REPLAY, config, event)
        q29 = simulate.read_attitudes(out)
    faults = {k: v for k, v in result.items() if k not in ("rows", "fresh", "mag_fresh") and v}
    if len(q29) != rows or result["fresh"] != rows or faults:
        raise simulate.SimulationError(
            f"{result['fresh']} of {rows} samples reached the filter fresh, {len(q29)} steps; {faults}"
        )
    score = scoring.score_trial(q29 / scoring.ONE, trial) if trial.has_truth else None
    return Replay(trial, q29, result, score)
