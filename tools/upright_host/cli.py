"""The command line `upright`."""

import subprocess
import sys
from pathlib import Path

import typer
from rich.console import Console
from rich.table import Table

from upright_host import (
    __version__,
    bench,
    calibrate,
    compare,
    dmp,
    doctor,
    flash,
    packages,
    rp2040,
    runtimes,
    score,
    tune,
    wiring,
)

app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode="rich")
console = Console()


def _version(show: bool):
    if show:
        print(f"upright {__version__}")
        raise typer.Exit()


@app.callback()
def main_options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Show the version and stop."
    ),
):
    """Attitude (roll, pitch, yaw) for MicroPython: simulate, replay, score."""


@app.command("runtimes")
def list_runtimes(
    image: Path = typer.Option(
        None, help="Take this RPI_PICO firmware (.uf2) for rp2040 instead of building one."
    ),
):
    """Obtain and list the interpreters that the portable code is tested on, and the emulated board's firmware."""
    if image:
        try:
            rp2040.take(image)
        except (runtimes.Unavailable, OSError) as why:
            _fail(str(why))
    runtimes.obtain_all()
    table = Table(box=None, pad_edge=False)
    for column in ("runtime", "version", "what"):
        table.add_column(column)
    for name in runtimes.LISTED:
        try:
            _, version = runtimes.interpreter(name)
            table.add_row(name, version, runtimes.what(name))
        except runtimes.Unavailable as why:
            table.add_row(name, "-", f"not here: {why}")
    console.print(table)


@app.command(
    "exec", context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False}
)
def exec_file(
    file: Path = typer.Argument(..., help="The script to run.", exists=True, dir_okay=False),
    args: list[str] = typer.Argument(None, help="What the script finds in sys.argv[1:]."),
    runtime: str = typer.Option("unix", "--runtime", help="cpython, unix, unix32 or arm."),
    board: str = typer.Option("sim", help="The board folder on the search path."),
):
    """Run a file on a runtime, with the simulated board's modules on its search path."""
    try:
        argv, environment = runtimes.command(runtime, file, args or (), board)
    except runtimes.Unavailable as why:
        console.print(f"runtime {runtime} cannot be had here: {why}", style="red")
        raise typer.Exit(3) from None
    raise typer.Exit(subprocess.run(argv, env=environment).returncode)


bench.register(app)
calibrate.register(app)
packages.register(app)
flash.register(app)
doctor.register(app)
wiring.register(app)
score.register(app)
compare.register(app)
dmp.register(app)
tune.register(app)

_RUNTIME = "cpython, unix, unix32 or arm"


def _fail(message: str, code: int = 2):
    console.print(message, style="red", highlight=False, markup=False)
    raise typer.Exit(code)


def _positive(seconds: float | None):
    if seconds is not None and not seconds > 0:
        raise typer.BadParameter(f"{seconds} is not a positive number of seconds")
    return seconds


@app.command("demo")
def demo_command(
    trial: Path = typer.Option(None, help="Feed this recorded trial (.npz) through the chip."),
    motion: str = typer.Option("demo", help="Synthetic motion, when there is no --trial."),
    board: str = typer.Option(
        None, help="The board to simulate, a folder of boards/ (sim; with nine axes robomaster_a)."
    ),
    filters: str = typer.Option(
        None, help="Run it with each of these filters, a,b,... and compare (default: the board's)."
    ),
    headless: bool = typer.Option(
        False, help="No live display: progress, the last picture, the figures."
    ),
    seconds: float = typer.Option(
        None, callback=_positive, help="Simulated time (25; of a trial, all of it)."
    ),
    speed: float = typer.Option(None, min=0, help="Times real time; 0: as fast as it goes."),
    png: Path = typer.Option(None, help="Save the display's last picture."),
    gif: Path = typer.Option(None, help="Save all that the display showed as an animation."),
    dmp_image: Path = typer.Option(
        None, exists=True, dir_okay=False, help="The DMP's image for dmp6 (a stand-in)."
    ),
    runtime: str = typer.Option(None, help=f"{_RUNTIME} (default: unix where it can be had)."),
):
    """Boot the firmware on the simulated board: MPU6050, filter in a hard timer tick, OLED; and how far off it was."""
    from upright_host import demo, replay, simulate, trials

    names = filters.split(",") if filters else [None]
    board = board or (replay.board_for(names[0]) if filters else "sim")
    try:
        if board not in demo.boards():
            raise ValueError(f"unknown board {board!r}; there are {', '.join(demo.boards())}")
        source = (
            demo.trial_source(trial, seconds, board)
            if trial
            else demo.motion_source(motion, seconds, board)
        )
        if trial and "dmp6" in names:
            raise ValueError("dmp6 samples by a clock of its own: it cannot follow a --trial")
        source.dmp_image = dmp_image
        runtime = runtime or simulate.best_runtime()
        outcomes = []
        for name in names:
            if name:
                source.board["FILTER"] = name
            outcome = demo.show(source, runtime, headless or bool(outcomes), speed, console)
            outcomes.append(outcome)
            for line in demo.summary(outcome):
                console.print(line, highlight=False, soft_wrap=True)
        if len(outcomes) > 1:
            console.print(demo.compare(outcomes))
        outcome = outcomes[0]
        if png:
            demo.save_png(outcome, png)
            console.print("picture:", png)
        if gif:
            demo.save_gif(outcome, gif)
            console.print("animation:", gif)
    except (trials.TrialError, ValueError) as why:
        _fail(str(why))
    except runtimes.Unavailable as why:
        _fail(f"runtime {runtime} cannot be had here: {why}", 3)
    except (simulate.SimulationError, OSError) as why:
        _fail(str(why), 1)
    for r in [outcome.result for outcome in outcomes]:
        if not r["started"] or r["crashes"] or r["uncaught"]:
            raise typer.Exit(1)


@app.command("replay")
def replay_command(
    trial: Path = typer.Argument(..., help="Recorded trial, .npz."),
    filter: str = typer.Option("mahony6", help="The filter."),
    runtime: str = typer.Option(
        "cpython", help="cpython, unix, unix32, arm, or rp2040, the emulated board."
    ),
    out: Path = typer.Option(None, help="Write rows t,q0,q1,q2,q3 to this CSV file."),
    seconds: float = typer.Option(None, callback=_positive, help="Only the first so many seconds."),
    kp: float = typer.Option(None, help="Proportional gain of mahony6 and mahony9, rad/s (0.5)."),
    ki: float = typer.Option(None, help="Their integral gain, rad/s^2 (0)."),
    direct: bool = typer.Option(
        False, help="Counts straight into the filter, past chip and driver."
    ),
):
    """Replay a recorded trial through the simulated chip's registers, the driver, the tick and a filter; score it."""
    from rich.progress import Progress

    from upright_host import replay, scoring, simulate, trials

    try:
        loaded = trials.load(trial)
        with Progress(console=Console(stderr=True)) as progress:
            task = progress.add_task(f"{loaded.name} on {runtime}", total=loaded.rows(seconds))
            done = replay.replay(
                loaded,
                filter,
                runtime,
                seconds,
                {k: v for k, v in (("kp", kp), ("ki", ki)) if v is not None},
                direct,
                lambda at, of: progress.update(task, completed=at, total=of),
            )
            progress.update(task, completed=len(done.q29))
        if out:
            scoring.write_csv(out, done.q29, loaded.rate)
    except trials.TrialError as why:
        _fail(str(why))
    except runtimes.Unavailable as why:
        _fail(f"runtime {runtime} cannot be had here: {why}", 3)
    except (simulate.SimulationError, OSError, ValueError) as why:
        _fail(str(why), 1)
    how = (
        "counts straight into the filter" if direct else "through the chip's registers and the tick"
    )
    console.print(f"{loaded.name}: {len(done.q29)} samples, {filter}, {how}", highlight=False)
    if done.score is None:
        console.print("no truth in this trial: nothing to score")
    else:
        for line in done.score.lines():
            console.print(line, highlight=False)


def main():
    app()


if __name__ == "__main__":
    sys.exit(main())
