"""Replays recorded trials through a filter on a runtime."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from upright_host import emulated, registry, rp2040, runtimes, scoring, simulate, trials

# of a trial on rp2040 when nobody asks for more: each takes ten or more of this machine's
BOARD_SECONDS = 2


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

    seconds      only the first so many; None: all of it, on rp2040 BOARD_SECONDS
    on_progress  called with (rows done, rows in all) now and then
    Raises simulate.SimulationError, runtimes.Unavailable, and ValueError for what a runtime cannot do.
    """
    registry.check(filter_name)
    if runtime == "rp2040":
        if direct:
            raise ValueError("on rp2040 the counts come through the chip's registers, not straight")
        if board_for(filter_name) != "sim":
            raise ValueError(
                f"{filter_name} on rp2040: the emulated board is replayed without a magnetometer; take six axes"
            )
        return _on_board(trial, filter_name, seconds, gains or {}, on_progress)
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
    return _scored(trial, q29, result)


def _scored(trial, q29, result) -> Replay:
    score = scoring.score_trial(q29 / scoring.ONE, trial) if trial.has_truth else None
    return Replay(trial, q29, result, score)


def _on_board(trial, filter_name, seconds, gains, on_progress) -> Replay:
    """MicroPython's own firmware on an emulated RP2040; see tools/simulator/rp2040."""
    image, board = rp2040.image(), emulated.simulator()
    from chips.mpu6050 import MPU6050Chip
    from world import World

    if seconds is None and trial.seconds > BOARD_SECONDS:
        seconds = BOARD_SECONDS
        runtimes.console.print(
            f"rp2040: the first {seconds} of {trial.seconds:.1f} s, each of which takes ten or more here;"
            " --seconds for more",
            highlight=False,
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trial.imu"
        rows = trial.write(path, seconds)
        world = World(str(path))
        try:
            files = emulated.project(rp2040.version(image), application=False)
            q29, faults = board.replay(
                image, files, MPU6050Chip(world), filter_name, rows, gains, on_progress
            )
        except board.BoardError as why:
            raise simulate.SimulationError(f"on rp2040: {why}") from None
        finally:
            world.close()
    if on_progress:
        on_progress(len(q29), rows)
    faults = {what: n for what, n in faults.items() if n}
    if len(q29) != rows or faults:
        raise simulate.SimulationError(f"rp2040: {len(q29)} of {rows} steps; {faults}")
    return _scored(trial, np.array(q29, np.int32), {"rows": rows, "fresh": rows})
