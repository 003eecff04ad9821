"""Replays recorded trials through a filter on a runtime."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from upright_host import (
    console,
    emulated,
    library,
    options,
    registry,
    rp2040,
    scoring,
    simulate,
    trials,
)
from upright_host.console import Wrong

# of a trial on rp2040 when nobody asks for more: each takes ten or more of this machine's
BOARD_SECONDS = 2
# how the emulated board's magnetometer lies to its IMU: any map will do, and this one turns and mirrors
MAG_AXES = ("y", "-x", "-z")


@dataclass
class Replay:
    """A trial replayed: q29 int32 (n, 4), row i after sample i; score is None without a truth."""

    trial: trials.Trial
    q29: np.ndarray
    result: dict
    score: scoring.Score | None


def board_for(filter_name: str) -> str:
    """The simulated board that a filter's samples come from: with a magnetometer for those of nine axes."""
    return "robomaster_a" if registry.axes(filter_name) == 9 else "sim"


def default_filter(trial: trials.Trial) -> str:
    """The firmware's own default for what is in the trial."""
    return registry.default(trial.mag_uT_per_lsb is not None)


def replay(
    trial: trials.Trial,
    filter_name: str | None = None,
    runtime: str = "cpython",
    seconds: float | None = None,
    gains: dict | None = None,
    direct: bool = False,
    on_progress=None,
) -> Replay:
    """Replay a trial: through the chip model's registers, driver and tick, or `direct`, counts to filter.

    filter_name  None: the firmware's own default for this trial
    seconds      only the first so many; None: all of it, on rp2040 BOARD_SECONDS
    on_progress  called with (rows done, rows in all) now and then
    Raises simulate.SimulationError, Unavailable, and Wrong for a filter, gains, or what a runtime cannot do.
    """
    filter_name = filter_name or default_filter(trial)
    scales = registry.Scales(trial.gyro_scale, trial.accel_lsb_per_g)
    registry.check(filter_name, gains, trial.rate, scales)
    if runtime == "rp2040":
        if direct:
            raise Wrong("on rp2040 the counts come through the chip's registers, not straight")
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
    chips, worlds = library.simulator("chips.mpu6050"), library.simulator("world")
    with_mag = board_for(filter_name) != "sim"
    if seconds is None and trial.seconds > BOARD_SECONDS:
        seconds = BOARD_SECONDS
        console.errors.print(
            f"rp2040: the first {seconds} of {trial.seconds:.1f} s, each of which takes ten or more here;"
            " --seconds for more",
            highlight=False,
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trial.imu"
        rows = trial.write(path, seconds)
        world = worlds.World(str(path))
        try:
            files = emulated.project(application=False)
            chip = chips.MPU6050Chip(world)
            if with_mag:
                mag = library.simulator("chips.ist8310").IST8310Chip(world, axes=MAG_AXES)
                chip.aux.append(mag)
            q29, faults = board.replay(
                image, files, chip, filter_name, rows, gains, on_progress, with_mag and MAG_AXES
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


def register(app: typer.Typer) -> None:
    """Give an app the command `replay`."""

    @app.command("replay")
    def replay_command(
        trial: Path = typer.Argument(..., help="Recorded trial, .npz."),
        filter: str = typer.Option(
            None, help="The filter (default: the firmware's, inertial9, or inertial6 for six axes)."
        ),
        runtime: str = options.runtime("cpython", board=True),
        out: Path = options.output("Write rows t,q0,q1,q2,q3 to this CSV file."),
        seconds: float = options.seconds(),
        kp: float = typer.Option(
            None, help="Proportional gain of mahony6 and mahony9, rad/s (0.5)."
        ),
        ki: float = typer.Option(None, help="Their integral gain, rad/s^2 (0)."),
        direct: bool = typer.Option(
            False, "--direct", help="Counts straight into the filter, past chip and driver."
        ),
    ):
        """Replay a trial through the simulated chip's registers, the driver, the tick and a filter; score it."""
        loaded = trials.load(trial)
        filter = filter or default_filter(loaded)
        gains = {name: value for name, value in (("kp", kp), ("ki", ki)) if value is not None}
        with console.progress(f"{loaded.name} on {runtime}", loaded.rows(seconds)) as at:
            done = replay(loaded, filter, runtime, seconds, gains, direct, at)
        if out:
            with console.writing(out):
                scoring.write_csv(out, done.q29, loaded.rate)
        way = (
            "counts straight into the filter"
            if direct
            else "through the chip's registers and the tick"
        )
        console.say(f"{loaded.name}: {len(done.q29)} samples, {filter}, {way}")
        for line in (
            done.score.lines() if done.score else ["no truth in this trial: nothing to score"]
        ):
            console.say(line)
