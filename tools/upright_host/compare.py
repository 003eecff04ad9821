"""`upright compare`: every filter on a recorded trial: how far off, how soon right, at what cost; a table and pictures.

The replays and their figures are score.py's, the costs filter_costs.py's, the scalar Kalman filter's picture tune.py's.
"""

import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import typer
from rich.table import Table

from upright_host import (
    baselines,
    console,
    filter_costs,
    options,
    plotting,
    registry,
    replay,
    runtimes,
    score,
    simulate,
    tracing,
    trials,
    tune,
)
from upright_host.console import Failed, Wrong

COLUMNS = (
    *("trial", "filter", "heading_measure", "inclination", "heading", "total"),
    *("settling_s", "instructions", "bytes", "samples", "coverage"),
)


@dataclass(frozen=True)
class Line:
    """What one filter came to on one trial. settling in s, cost of an update; None in them: not known."""

    row: score.Row
    settling: float | None
    cost: filter_costs.Cost

    def figures(self) -> list:
        """Inclination, heading, total in deg, settling time, instructions, bytes; None for what is not known."""
        row = self.row
        angles = (row.inclination, row.heading, row.total) if row.score.samples else [None] * 3
        return [*angles, self.settling, self.cost.instructions, self.cost.bytes]


@dataclass
class Comparison:
    """One trial: a line for each filter, and what was left out, and why."""

    trial: trials.Trial
    lines: list[Line]
    notes: list[str] = field(default_factory=list)


def choose(filters: str | None, with_baselines: bool, notes: list) -> list[str]:
    """The names to compare, all of the registry unless some are asked for. Raises Wrong."""
    names = (
        list(registry.filters())
        if filters is None
        else registry.listed(filters, baselines.BASELINES)
    )
    hardware = registry.hardware()
    left_out = [name for name in names if name in hardware]
    if left_out:
        notes.append(
            f"left out: {', '.join(left_out)}: computed in the chip, and the simulated chip is told the truth"
        )
    return score.wanted([name for name in names if name not in hardware], with_baselines, notes)


def measure_costs(names: list[str], notes: list, on_progress=lambda at: None) -> dict:
    """{filter: Cost}; baselines have none, and what cannot be measured goes into notes."""
    names = [name for name in names if name not in baselines.BASELINES]
    costs = {}

    def one(name):
        try:
            return meter.cost(name)
        except (tracing.TraceError, OSError) as why:
            return f"no costs of {name}: {why}"

    with filter_costs.Meter() as meter:
        notes += meter.notes
        for at, (name, found) in enumerate(zip(names, _each(one, names), strict=True), 1):
            if isinstance(found, filter_costs.Cost):
                costs[name] = found
            else:
                notes.append(found)
            on_progress(at)
    return costs


def settling_times(names: list[str], trial: trials.Trial, notes: list) -> dict:
    """{filter: s, or None} at the trial's rate and scales, for the filters that can be started wrong."""
    runtime = simulate.best_runtime()
    scales = (trial.rate, trial.gyro_scale, trial.accel_lsb_per_g)

    def one(name):
        try:
            return filter_costs.settling(name, *scales, runtime)
        except (tracing.TraceError, runtimes.Unavailable) as why:
            notes.append(f"no settling time of {name} on {trial.name}: {why}")
            return None

    names = [name for name in names if name not in baselines.BASELINES]
    return dict(zip(names, _each(one, names), strict=True))


def _each(one, names) -> Iterator:
    """one(name) for each, several at a time: a thread only waits for its process."""
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        yield from pool.map(one, names)
    finally:
        pool.shutdown(cancel_futures=True)


def compare(
    file: Path,
    trial: trials.Trial,
    names: list[str],
    costs: dict,
    runtime: str,
    seconds: float | None = None,
    direct: bool = True,
    jobs: int | None = None,
    on_progress=None,
) -> Comparison:
    """Every one of the filters and baselines on a trial; its rows keep the attitudes.

    Nine axes are left out where the trial has no magnetometer. on_progress(done, of) counts samples.
    """
    report = score.Report()
    suitable = list(names)
    if trial.mag_uT_per_lsb is None:
        suitable = [name for name in names if score.axes_of(name) == 6]
        left_out = ", ".join(name for name in names if name not in suitable)
        if left_out:
            report.notes.append(f"left out: {left_out}: {trial.name} has no magnetometer")
    score.replay_all(
        *(report, [(file, trial)], suitable, runtime, seconds, direct, jobs, on_progress), keep=True
    )
    settled = settling_times([row.filter for row in report.rows], trial, report.notes)
    lines = [
        Line(row, settled.get(row.filter), costs.get(row.filter, filter_costs.Cost()))
        for row in report.rows
    ]
    return Comparison(trial, lines, report.notes)


# ------------------------------------------------------------------------------------------- output
_FORMATS = ("{:.2f}", "{:.2f}", "{:.2f}", "{:.2f}", "{:,.0f}", "{:,.0f}")
REMARKS = (
    "inclination, heading, total: RMSE in deg; heading and total as given (nine axes, where the truth knows north),"
    " else after the best constant heading",
    "settles: seconds at rest until the tilt stays within 2 deg, begun 90 deg off about a horizontal axis; - for what"
    " cannot be begun so, or takes over 60 s",
    "insns, bytes: of one update: Thumb-2 instructions, none of them to collect garbage, and what it takes"
    " from the heap",
)


def table(comparison: Comparison) -> Table:
    made = Table(box=None, pad_edge=False)
    made.add_column("\nfilter", no_wrap=True)
    for head in ("incli-\nnation", "\nheading", "\ntotal"):
        made.add_column(head, justify="right", no_wrap=True)
    made.add_column("heading\nmeasured", no_wrap=True)
    for head in ("settles\ns", "\ninsns", "\nbytes"):
        made.add_column(head, justify="right", no_wrap=True)
    for line in comparison.lines:
        cells = [
            "-" if value is None else form.format(value)
            for value, form in zip(line.figures(), _FORMATS, strict=True)
        ]
        measure = line.row.measure if line.row.score.samples else "-"
        made.add_row(line.row.filter, *cells[:3], measure, *cells[3:])
    return made


def show(comparison: Comparison) -> None:
    console.say(f"\n{comparison.trial.name}", "bold")
    if comparison.lines:
        console.show(table(comparison))
    if not comparison.trial.has_truth:
        score.say_notes(["no truth in this trial: no errors to tell"])
    elif comparison.lines and not any(line.row.score.samples for line in comparison.lines):
        score.say_notes(["no truth in this span: no errors to tell"])
    score.say_notes(comparison.notes)


def rows(comparison: Comparison) -> Iterator[list]:
    """For a CSV file: the values of COLUMNS."""
    for line in comparison.lines:
        s = line.row.score
        yield [
            *(line.row.trial, line.row.filter, line.row.measure),
            *(*line.figures(), s.samples, s.coverage),
        ]


def picture_files(where: Path, names: list[str]) -> list[Path]:
    """A file for each trial: `where` itself for one, if it ends in .png, else NAME.png in the folder `where`."""
    if where.suffix.lower() == ".png":
        if len(names) > 1:
            raise Wrong(f"{where} is one file, and there are {len(names)} trials: name a folder")
        return [where]
    return [where / f"{re.sub('[^A-Za-z0-9_.-]+', '_', name).strip('_')}.png" for name in names]


def draw(comparison: Comparison, file: Path, seconds: float | None = None) -> list[Path]:
    """The attitudes in `file`, the scalar Kalman filter in ..._kalman.png beside it. Raises what plotting does."""
    file.parent.mkdir(parents=True, exist_ok=True)
    beside = file.with_name(f"{file.stem}_kalman{file.suffix}")
    plotting.attitudes(comparison.trial, [line.row for line in comparison.lines], file)
    tune.draw_waveform(comparison.trial, beside, seconds)
    return [file, beside]


# ------------------------------------------------------------------------------------------ command
def register(app: typer.Typer) -> None:
    """Give an app the command `compare`."""

    @app.command("compare")
    def compare_command(
        where: list[Path] = typer.Argument(..., help="Trials (.npz), or folders of them."),
        filters: str = typer.Option(
            None,
            help="Filters, with commas between (default: all); baselines may be among them. "
            + registry.CHOICE,
        ),
        runtime: str = options.runtime(board=True),
        baselines: bool = score.BASELINES_OPTION,
        csv: Path = options.output("Write the figures to this file."),
        png: Path = typer.Option(
            None, help="Draw two pictures a trial: into this folder, or for one trial NAME.png."
        ),
        seconds: float = options.seconds("Only the first so many seconds of each trial."),
        through_chips: bool = typer.Option(
            False,
            "--through-chips",
            help="Through the simulated chips, the drivers and the tick; slow. rp2040: always.",
        ),
        costs: bool = typer.Option(
            True, help="Count instructions and bytes; kept until a source changes."
        ),
        jobs: int = options.jobs("Replays"),
    ):
        """Compare all filters on recorded trials: errors, settling time, cost; truth, attitudes and errors drawn."""
        runtime = runtime or simulate.best_runtime()
        if runtime == "rp2040":
            seconds = seconds or replay.BOARD_SECONDS
        if png and png.exists() and not png.is_dir() and png.suffix != ".png":
            raise Wrong(f"--png {png}: that is a file; a folder, or NAME.png, is wanted")
        notes, no_picture = [], None
        names = choose(filters, baselines, notes)
        runtimes.interpreter(runtime)
        usable = score.load(score.find(where), seconds, notes, truthless=True)
        if not usable:
            raise Wrong("\n".join([*notes, "no trial to compare on"]))
        files = picture_files(png, [trial.name for _, trial in usable]) if png else []
        found = {}
        if costs:
            with console.progress("costs of an update", len(names)) as at:
                found = measure_costs(names, notes, at)
        lines = []
        for i, (file, trial) in enumerate(usable):
            with console.progress(f"{trial.name} on {runtime}") as at:
                direct = not through_chips and runtime != "rp2040"
                done = compare(file, trial, names, found, runtime, seconds, direct, jobs, at)
            show(done)
            lines += rows(done)
            if png and done.lines and not no_picture:
                try:
                    for picture in draw(done, files[i], seconds):
                        console.say(f"picture: {picture}")
                except (runtimes.Unavailable, Wrong, OSError) as why:
                    no_picture = why
        console.say()
        score.say_notes(notes)
        for remark in REMARKS:
            console.say(remark, "dim")
        if csv:
            console.write_csv(csv, COLUMNS, lines)
            console.say(f"figures: {csv}")
        if not lines:
            raise Failed("nothing could be compared")
        if no_picture:
            raise no_picture
