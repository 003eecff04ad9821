"""`upright score`: recorded trials, each replayed with each filter; tables, a CSV file, and a picture of the errors.

Every replay is a process of its own, several at a time. What cannot be used (a damaged file, a trial without truth, a
package that is not installed) is named and left out. The measure is scoring.py's; docs/accuracy.md shows results.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from upright_host import (
    baselines,
    console,
    options,
    plotting,
    registry,
    replay,
    runtimes,
    scoring,
    simulate,
    trials,
)
from upright_host.console import Failed, Wrong

FILTERS = "inertial6,inertial9,mahony6,mahony9"
COLUMNS = (
    *("trial", "filter", "heading_measure", "inclination", "heading", "total", "max_inclination"),
    *("heading_as_given", "total_as_given", "heading_best", "total_best", "offset"),
    *("samples", "coverage"),
)
STATISTICS = {"mean": np.mean, "median": np.median, "worst": np.max}
FIGURES = ("inclination", "heading", "total")
AS_GIVEN, BEST = "as given", "best heading"
_NO_SCORE = scoring.Score(*[math.nan] * 7, samples=0, coverage=0.0)
BASELINES_OPTION = typer.Option(
    False, "--baselines", help="All of other people's filters beside: vqf, ahrs, imufusion."
)
# What headers say when true north is not known, or not well enough
_NO_NORTH = ("best heading", "best-heading", "heading arbitrary")


@dataclass(frozen=True)
class Row:
    """What one filter made of one trial. measure: AS_GIVEN or BEST, by which heading and total count.

    q: its attitudes, float64 (n, 4), where they were to be kept.
    """

    trial: str
    filter: str
    measure: str
    score: scoring.Score
    q: np.ndarray | None = field(default=None, repr=False, compare=False)
    axes: int = 6

    @property
    def inclination(self) -> float:
        return self.score.inclination

    @property
    def heading(self) -> float:
        s = self.score
        return s.heading if self.measure == AS_GIVEN else s.aligned_heading

    @property
    def total(self) -> float:
        s = self.score
        return s.total if self.measure == AS_GIVEN else s.aligned_total

    def cells(self) -> list:
        """The values of COLUMNS."""
        s = self.score
        return [
            *(self.trial, self.filter, self.measure),
            *(self.inclination, self.heading, self.total, s.max_inclination),
            *(s.heading, s.total, s.aligned_heading, s.aligned_total, s.offset),
            *(s.samples, s.coverage),
        ]


@dataclass
class Report:
    """rows: in the order of trials, then filters; notes: what was left out, and why, a line each."""

    rows: list = field(default_factory=list)
    notes: list = field(default_factory=list)

    def names(self, what: str) -> list[str]:
        """The trials or filters ("trial", "filter") in their order."""
        return list(dict.fromkeys(getattr(row, what) for row in self.rows))

    def statistic(self, name: str, filter: str, figure: str) -> float:
        """Mean, median or worst of a figure over the trials that this filter was scored on."""
        values = [getattr(row, figure) for row in self.rows if row.filter == filter]
        return float(STATISTICS[name](values))


def knows_north(trial: trials.Trial) -> bool:
    """Is the trial's truth turned to magnetic north? By its header: "north", true or false, else its words."""
    said = trial.header.get("north")
    if isinstance(said, bool):
        return said
    words = json.dumps(trial.header).lower()
    return not any(phrase in words for phrase in _NO_NORTH)


def axes_of(name: str) -> int:
    """Of a filter or baseline."""
    return baselines.BASELINES[name][1] if name in baselines.BASELINES else registry.axes(name)


def measure_of(trial: trials.Trial, name: str) -> str:
    """AS_GIVEN for nine axes where both trial and filter know north, else BEST."""
    given = axes_of(name) == 9 and trial.mag_uT_per_lsb is not None and knows_north(trial)
    return AS_GIVEN if given else BEST


def find(paths: list[Path]) -> list[Path]:
    """The .npz files of folders (not of what lies in these), and files as named. Raises Wrong."""
    found = []
    for path in paths:
        path = Path(path)
        if path.is_dir():
            inside = sorted(path.glob("*.npz"))
            if not inside:
                raise Wrong(f"no trials (.npz) in {path}")
            found += inside
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def load(
    files: list[Path], seconds: float | None, notes: list, truthless: bool = False
) -> list[tuple[Path, trials.Trial]]:
    """The trials that can be scored, or with `truthless` replayed; what cannot goes into notes."""
    usable, names = [], set()
    for file in files:
        try:
            trial = trials.load(file)
        except (trials.TrialError, OSError) as why:
            notes.append(f"left out: {why}")
            continue
        if not trial.has_truth and not truthless:
            notes.append(f"left out: {file}: no truth in it")
            continue
        if seconds is not None and not truthless:
            known = trial.movement & np.isfinite(trial.q_gt[:, 0])
            if not (known & (trial.t_gt < seconds)).any():
                notes.append(
                    f"left out: {file}: its truth begins after {trial.t_gt[known][0]:.1f} s"
                )
                continue
        if trial.name in names:  # two trials are not to become one in the tables
            trial.name = str(file)
        names.add(trial.name)
        usable.append((file, trial))
    return usable


def run(
    files: list[Path],
    filters: list[str],
    runtime: str,
    seconds: float | None = None,
    direct: bool = True,
    with_baselines: bool = False,
    jobs: int | None = None,
    on_progress=None,
) -> Report:
    """Score filters, and baselines, on trials. on_progress(done, of) counts rows; it is called from several threads.

    Raises Wrong without a usable trial, Failed when nothing could be scored, and runtimes.Unavailable.
    """
    report = Report()
    names = wanted(filters, with_baselines, report.notes)
    runtimes.interpreter(runtime)
    usable = load(files, seconds, report.notes)
    if not usable:
        raise Wrong("\n".join([*report.notes, "no trial to score"]))
    replay_all(report, usable, names, runtime, seconds, direct, jobs, on_progress)
    if not report.rows:
        raise Failed("\n".join([*report.notes, "nothing could be scored"]))
    return report


def wanted(filters: list[str], with_baselines: bool, notes: list) -> list[str]:
    """The names of filters and baselines, each once; what is not installed goes into notes. Raises Wrong."""
    names = registry.listed(",".join(filters), baselines.BASELINES)
    more = baselines.BASELINES if with_baselines else ()
    return _obtainable(dict.fromkeys([*names, *more]), notes)


def replay_all(
    report: Report,
    usable: list[tuple[Path, trials.Trial]],
    names: list[str],
    runtime: str,
    seconds: float | None = None,
    direct: bool = True,
    jobs: int | None = None,
    on_progress=None,
    keep: bool = False,
) -> None:
    """Every one of the names on every trial: what it came to goes into the report.

    keep: the rows keep the attitudes, and there are rows without a truth too, whose angles are NaN.
    """
    work = [(file, trial, name) for file, trial in usable for name in names]
    progress = _Progress(sum(trial.rows(seconds) for _, trial, _ in work), on_progress)

    def one(task):
        file, trial, name = task
        count = progress.of(trial.rows(seconds))
        try:
            if name in baselines.BASELINES:
                q = _baseline(name, file, trial, seconds)
            else:
                done = replay.replay(
                    trial, name, runtime, seconds, None, direct, lambda at, of: count(at)
                )
                q = done.q29 / scoring.ONE
            score = scoring.score_trial(q, trial) if trial.has_truth else _NO_SCORE
        except (Failed, ValueError, OSError) as why:
            return f"left out: {name} on {trial.name}: {_last_line(why)}"
        finally:
            count(trial.rows(seconds))
        if not keep and (not score.samples or not math.isfinite(score.total)):
            return f"left out: {name} on {trial.name}: no sample of it meets the truth"
        return Row(
            trial.name, name, measure_of(trial, name), score, q if keep else None, axes_of(name)
        )

    # a thread only waits for its process
    with ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        try:
            for done in pool.map(one, work):
                (report.rows if isinstance(done, Row) else report.notes).append(done)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _obtainable(names, notes: list) -> list[str]:
    """The names without the baselines whose package is missing: these go into notes, one line for all."""
    missing = [n for n in names if n in baselines.BASELINES and not baselines.installed(n)]
    if missing:
        packages = dict.fromkeys(baselines.BASELINES[name][0] for name in missing)
        notes.append(f"left out: {', '.join(packages)}: not installed; {baselines.INSTALL}")
    return [name for name in names if name not in missing]


def _baseline(name, file, trial, seconds):
    """Run in a process of its own: other people's compiled code may end it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "attitudes"
        argv = [sys.executable, "-m", "upright_host.baselines", name, str(Path(file).resolve())]
        done = subprocess.run(
            [*argv, str(trial.rows(seconds)), str(out)], capture_output=True, text=True
        )
        if done.returncode:
            raise Failed(done.stderr.strip() or f"ended with {done.returncode}")
        return np.fromfile(out).reshape(-1, 4)


def _last_line(why) -> str:
    lines = str(why).strip().splitlines()
    return lines[-1] if lines else type(why).__name__


class _Progress:
    """Adds up what several threads have done."""

    def __init__(self, total, on_progress):
        self._total = total
        self._tell = on_progress
        self._done = 0
        self._lock = threading.Lock()

    def of(self, rows):
        """-> count(at): this task has done `at` of its rows."""
        before = 0

        def count(at):
            nonlocal before
            at = min(at, rows)
            with self._lock:
                self._done += at - before
                before = at
                if self._tell:
                    self._tell(self._done, self._total)

        return count


# ------------------------------------------------------------------------------------------- output
def summary_table(report: Report) -> Table:
    """Mean, median and worst over the trials; one row a filter."""
    table = Table(box=None, pad_edge=False)
    table.add_column("RMSE in deg\nfilter", no_wrap=True)
    table.add_column("\nn", justify="right")
    for figure in FIGURES:
        table.add_column(f"{figure}\n mean   med worst", no_wrap=True)
    for name in report.names("filter"):
        cells = [
            " ".join(f"{report.statistic(s, name, figure):5.2f}" for s in STATISTICS)
            for figure in FIGURES
        ]
        table.add_row(name, str(sum(row.filter == name for row in report.rows)), *cells)
    return table


def trial_table(report: Report, trial: str) -> Table:
    """One trial: a row for each filter, as given where that means something, and after the best heading."""
    table = Table(box=None, pad_edge=False)
    table.add_column("\nfilter", no_wrap=True)
    table.add_column("\ninclination", justify="right")
    for measure in (AS_GIVEN, BEST):
        table.add_column(f"{measure}\nheading", justify="right", no_wrap=True)
        table.add_column("\ntotal", justify="right")
    table.add_column("\ncovered", justify="right")
    for row in report.rows:
        if row.trial == trial:
            s = row.score
            given = (
                [f"{s.heading:.2f}", f"{s.total:.2f}"] if row.measure == AS_GIVEN else ["-", "-"]
            )
            best = [f"{s.aligned_heading:.2f}", f"{s.aligned_total:.2f}"]
            table.add_row(
                row.filter, f"{s.inclination:.2f}", *given, *best, f"{100 * s.coverage:.0f} %"
            )
    return table


def show(report: Report) -> None:
    """The tables and what was left out, for people."""
    for trial in report.names("trial"):
        console.say(f"\n{trial}", "bold")
        console.show(trial_table(report, trial))
    if report.notes:
        console.say()
    say_notes(report.notes)
    trials_in_all = len(report.names("trial"))
    over = f"over {trials_in_all} trial" + "s" * (trials_in_all != 1)
    console.say("\n" + over, "bold")
    console.show(summary_table(report))
    console.say(
        "heading and total: as given for nine axes where the truth knows north, else after the best constant heading",
        "dim",
    )
    trials_of = {len([r for r in report.rows if r.filter == f]) for f in report.names("filter")}
    if len(trials_of) > 1:
        console.say("not every filter was scored on every trial: compare with care", "red")


def say_notes(notes) -> None:
    for note in notes:
        console.say(note, "yellow")


def write_csv(report: Report, path: Path) -> None:
    """COLUMNS: a row for each trial and filter, then mean, median and worst of each filter as trials of these names.

    Angles in degrees; heading and total by heading_measure.
    """
    rows = [row.cells() for row in report.rows]
    for statistic in STATISTICS:
        for name in report.names("filter"):
            values = [report.statistic(statistic, name, figure) for figure in FIGURES]
            measures = {row.measure for row in report.rows if row.filter == name}
            measure = measures.pop() if len(measures) == 1 else "mixed"
            cells = [statistic, name, measure, *values]
            rows.append(cells + [None] * (len(COLUMNS) - len(cells)))
    console.write_csv(path, COLUMNS, rows)


def save_png(report: Report, path: Path) -> None:
    """Bars of inclination and total for each trial and filter, and their means. Raises what plotting does."""
    names, filters = report.names("trial"), report.names("filter")
    groups = [*names, f"mean_of all {len(names)}"] if len(names) > 1 else names
    by = {(row.trial, row.filter): row for row in report.rows}
    figure = plotting.figure(max(7.0, 1.0 + 1.35 * len(groups)), 7.2)
    panels = figure.subplots(2, 1, sharex=True)
    width = 0.84 / len(filters)
    colours = plotting.colours(len(filters))
    for panel, what in zip(panels, ("inclination", "total"), strict=True):
        shown = []
        for i, name in enumerate(filters):
            values = [getattr(by[t, name], what) if (t, name) in by else math.nan for t in names]
            if len(groups) > len(names):
                values.append(report.statistic("mean", name, what))
            at = np.arange(len(groups)) + (i - (len(filters) - 1) / 2) * width
            panel.bar(at, values, width, label=name, color=colours[i])
            shown += [value for value in values if math.isfinite(value)]
        # One that is lost is not to flatten all others: its bar leaves the picture, with its figure at the top. One too
        # small to be seen gets its figure as well, or it would look left out.
        top = max(min(1.3 * float(np.quantile(shown, 0.9)), 1.05 * max(shown)), 1e-3)
        for bar in panel.patches:
            height = bar.get_height()
            if height > top or height < 0.01 * top:  # false for NaN: that one is left out
                panel.text(
                    bar.get_x() + bar.get_width() / 2,
                    min(height, top) + 0.015 * top,
                    f"{height:.1f}" if height > top else f"{height:.2f}",
                    ha="center",
                    va="bottom",
                    fontsize=6,
                    rotation=90,
                )
        panel.set_ylim(0, top)
        panel.set_ylabel(f"{what}, RMSE in deg")
        plotting.tidy(panel, "y")
        if len(groups) > len(names):
            panel.axvline(len(names) - 0.5, color="0.6", linewidth=0.8)
    panels[1].set_xticks(np.arange(len(groups)), [_short(name) for name in groups], fontsize=8)
    panels[1].set_xlim(-0.5, len(groups) - 0.5)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="upper center",
        ncols=min(len(filters), 6),
        frameon=False,
        fontsize=9,
    )
    lines = -(-len(filters) // 6)
    figure.tight_layout(rect=(0, 0, 1, 0.97 - 0.028 * lines), h_pad=2.2)
    plotting.save(figure, path)


def _short(name: str) -> str:
    """A trial's name in lines of about 14 characters."""
    lines = [""]
    for word in name.split("_"):
        if lines[-1] and len(lines[-1]) + len(word) >= 14:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines[:4])


# ------------------------------------------------------------------------------------------ command
def register(app: typer.Typer) -> None:
    """Give an app the command `score`."""

    @app.command("score")
    def score(
        where: list[Path] = typer.Argument(..., help="Folders of trials (.npz), or trials."),
        filters: str = typer.Option(
            FILTERS,
            show_default=False,
            help="Filters, with commas between; baselines may be among them (default: "
            f"{FILTERS.replace(',', ', ')}). {registry.CHOICE}",
        ),
        runtime: str = options.runtime(),
        baselines: bool = BASELINES_OPTION,
        csv: Path = options.output("Write the figures to this file."),
        png: Path = options.output("Draw them."),
        seconds: float = options.seconds("Only the first so many seconds of each trial."),
        through_chips: bool = typer.Option(
            False,
            "--through-chips",
            help="Through the simulated chips, the drivers and the tick; slow.",
        ),
        jobs: int = options.jobs("Replays"),
    ):
        """Score filters on a folder of recorded trials: RMSE of inclination, heading and total; mean, median, worst."""
        runtime = runtime or simulate.best_runtime()
        with console.progress(f"replaying on {runtime}") as at:
            report = run(
                *(find(where), filters.split(","), runtime, seconds),
                direct=not through_chips,
                with_baselines=baselines,
                jobs=jobs,
                on_progress=at,
            )
        show(report)
        if csv:
            write_csv(report, csv)
            console.say(f"figures: {csv}")
        if png:
            save_png(report, png)
            console.say(f"picture: {png}")
