"""The demo: boots the firmware on the simulated board and shows its display, its console, and how far off it was."""

import hashlib
import random
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import typer
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from upright_host import (
    console,
    library,
    oled,
    options,
    registry,
    replay,
    runtimes,
    scoring,
    simulate,
    trials,
)
from upright_host.console import Wrong

FRAME_MS = 100
WORLD_HZ = 1000
MOTION_SECONDS = 25
SHOW_SECONDS = 30  # a longer trial is shown faster than it was


@dataclass
class Source:
    """What moves the board: an .imu file, its truth, and what board.py has to say for it."""

    name: str
    seconds: float
    write: object  # write(path)
    rate: tuple
    t_true: np.ndarray | None
    q_true: np.ndarray | None
    movement: np.ndarray | None = None
    board_name: str = "sim"
    board: dict = field(default_factory=dict)
    dmp_image: Path | None = None  # of the filter dmp6; None: a stand-in


def motion_source(name: str, seconds: float | None, board_name: str = "sim") -> Source:
    """A synthetic motion with the errors of a typical MPU6050. Raises Wrong for an unknown name."""
    motions = library.simulator("motions")
    seconds = seconds or MOTION_SECONDS
    if name not in motions.MOTIONS:
        raise Wrong(f"unknown motion {name!r}; there are {', '.join(motions.MOTIONS)}")
    motion = motions.render(name, rate=(WORLD_HZ, 1), seconds=seconds)

    def write(path):
        motion.write(path, truth=True)  # which a simulated DMP shows

    return Source(name, seconds, write, motion.rate, motion.t, motion.q_true, board_name=board_name)


def trial_source(path: Path, seconds: float | None, board_name: str = "sim") -> Source:
    """A recorded trial: its samples are the chip's samples, so the data-ready line drives the tick."""
    trial = trials.load(path)
    rows = trial.rows(seconds)
    num, den = trial.rate
    board = {
        "RATE": list(trial.rate),
        "DRIVE": "data_ready",
        "EXTERNAL_CLOCK": True,
        "ACCEL_RANGE_G": trial.accel_range_g,
        "GYRO_RANGE_DPS": trial.gyro_range_dps,
    }
    truth = (trial.t_gt, trial.q_true(), trial.movement) if trial.has_truth else (None, None, None)
    return Source(trial.name, rows * den / num, trial.write, trial.rate, *truth, board_name, board)


@dataclass
class Outcome:
    """What a run of the demo came to. frames: [(seconds, picture bytes)]."""

    result: dict
    score: scoring.Score | None
    frames: list
    console: list
    runtime: str


def run(source: Source, runtime: str, on_frame=None, on_console=None, **config) -> Outcome:
    """Boot the firmware on the simulated board moved by `source`, to the source's end."""
    frames, lines = [], []

    def event(kind, fields):
        if kind == "console":
            lines.append(fields[0])
            if on_console:
                on_console(fields[0])
        elif kind == "frame":
            frames.append((int(fields[0]) / 1e6, bytes.fromhex(fields[1])))
        if kind in ("frame", "time") and on_frame:
            on_frame(int(fields[0]) / 1e6, frames[-1][1] if frames else None)

    with tempfile.TemporaryDirectory() as folder:
        world, out = Path(folder) / "world.imu", Path(folder) / "steps"
        source.write(world)
        board = source.board
        if board.get("FILTER") == "dmp6":
            image = source.dmp_image or _stand_in(Path(folder) / "dmp.bin")
            digest = hashlib.sha256(image.read_bytes()).hexdigest()
            board = board | {"DMP_IMAGE": str(image.resolve()), "DMP_SHA256": digest}
            config["dmp_image"] = board["DMP_IMAGE"]
        config = {
            "world": str(world),
            "seconds": source.seconds,
            "frame_ms": FRAME_MS,
            "out": str(out),
            "board_name": source.board_name,
            "board": board,
        } | config
        result = simulate.run(runtime, simulate.FIRMWARE, config, event)
        rows, q29 = simulate.read_steps(out)
    return Outcome(result, _score(source, rows, q29), frames, lines, runtime)


def _stand_in(path: Path) -> Path:
    """A file that could be a DMP's image: the simulated DMP runs what it is told to."""
    path.write_bytes(random.Random(6050).randbytes(3062))
    return path


def _score(source: Source, rows, q29):
    if source.q_true is None or not len(rows):
        return None
    first = scoring.once(rows)
    num, den = source.rate
    t = rows[first] * den / num
    slack = 0.5 * den / num
    return scoring.score(
        t, q29[first] / scoring.ONE, source.t_true, source.q_true, source.movement, slack
    )


def summary(outcome: Outcome) -> list[str]:
    """What the run came to, for people."""
    r = outcome.result
    if not r["started"]:
        return [
            f"the tick had not started after {r['ended_us'] / 1e6:.1f} s: the board measures "
            "the gyro's bias first, for a second at rest. If that was time enough, see its console above"
        ]
    lines = []
    s = outcome.score
    if s and s.samples:
        north = r["axes"] == 9
        heading, total = (s.heading, s.total) if north else (s.aligned_heading, s.aligned_total)
        lines.append(
            f"{r['filter']}, error against the truth (RMSE): inclination {s.inclination:.2f} deg,"
            f" heading {heading:.2f} deg, total {total:.2f} deg"
        )
        lines.append(
            "   (heading against the true north)"
            if north
            else "   (heading after the best constant offset: six axes do not know where north is)"
        )
    elif s:
        lines.append("no truth in this span: nothing to compare with")
    if r["filter"] == "dmp6":
        lines.append(
            "   (a simulated DMP shows the true motion: this tells of the driver, not of the chip's program)"
        )
    lines.append(
        f"ticks {r['steps']} ({r['fresh']} with a fresh sample), missed {r['missed']}, exceptions {r['crashes']},"
        f" bus errors {r['errors']}, transfers cut {r['cuts']}"
    )
    if "mag_fresh" in r:
        lines.append(
            f"magnetometer samples {r['mag_fresh']}, overdue {r['mag_stale']}, bus errors {r['mag_errors']}"
        )
    heap = (
        f"0 bytes, the heap was locked in all {r['irqs']} interrupts"
        if r["heap_checked"] and not r["crashes"] and not r["uncaught"]
        else "an allocation was refused, see above"
        if r["heap_checked"]
        else "not measured: CPython cannot lock its heap (see `upright runtimes`)"
    )
    lines.append(f"allocated in the tick: {heap}")
    try:
        version = runtimes.interpreter(outcome.runtime)[1]
    except runtimes.Unavailable:
        version = "?"
    lines.append(f"ran on {outcome.runtime} {version}, {r['ticker']}")
    return lines


def compare(outcomes: list[Outcome]) -> Table:
    """What several filters made of the same motion."""
    table = Table(box=None, pad_edge=False, title="RMSE, degrees", title_justify="left")
    table.add_column("filter")
    for column in ("inclination", "heading", "total"):
        table.add_column(column, justify="right")
    for outcome in outcomes:
        s, north = outcome.score, outcome.result.get("axes") == 9
        if s is None or not s.samples:
            table.add_row(outcome.result.get("filter", "?"), "-", "-", "-")
            continue
        angles = (
            s.inclination,
            s.heading if north else s.aligned_heading,
            s.total if north else s.aligned_total,
        )
        table.add_row(outcome.result["filter"], *(f"{angle:.2f}" for angle in angles))
    return table


def show(source: Source, runtime: str, headless: bool, speed: float | None) -> Outcome:
    """Run with a live display in the terminal, or, headless, with a progress bar."""
    where = console.out
    if headless or not where.is_terminal:
        with console.progress(source.name, source.seconds, where) as at:
            outcome = run(
                source, runtime, lambda now, _: at(now), lambda line: console.say(f"board: {line}")
            )
        if outcome.frames:
            where.print(oled.panel(oled.rows_of_frame(outcome.frames[-1][1]), where.width))
        return outcome

    if speed is None:
        speed = max(1.0, source.seconds / SHOW_SECONDS)
    shown = console.bars(where)
    task = shown.add_task("", total=source.seconds)
    lines: list[str] = []
    began = time.monotonic()
    with Live(console=where, refresh_per_second=12) as view:

        def on_frame(at, picture):
            if speed:
                time.sleep(max(0.0, at / speed - (time.monotonic() - began)))
            text = f"{source.name}: {at:.1f} of {source.seconds:.0f} s, x{speed:.3g}"
            shown.update(task, completed=at, description=text)
            rows = oled.rows_of_frame(picture or bytes(1024))
            view.update(
                Group(
                    oled.panel(rows, where.width, title="128x64 OLED"),
                    shown.get_renderable(),
                    Text("\n".join(lines[-4:]), style="dim"),
                )
            )

        return run(source, runtime, on_frame, lines.append)


def save_png(outcome: Outcome, path: Path):
    """The display's last picture."""
    oled.save_png(oled.rows_of_frame(outcome.frames[-1][1]), path)


def save_gif(outcome: Outcome, path: Path):
    """All that the display showed, at the speed of the motion."""
    pictures, end = [], outcome.result["ended_us"] / 1e6
    shown = 0
    for i in range(int(end * 1000 / FRAME_MS)):
        while (
            shown + 1 < len(outcome.frames) and outcome.frames[shown + 1][0] <= i * FRAME_MS / 1e3
        ):
            shown += 1
        pictures.append(oled.rows_of_frame(outcome.frames[shown][1]))
    oled.save_gif(pictures, path, FRAME_MS)


def register(app: typer.Typer) -> None:
    """Give an app the command `demo`."""

    @app.command("demo")
    def demo_command(
        trial: Path = typer.Option(None, help="Feed this recorded trial (.npz) through the chip."),
        motion: str = typer.Option("demo", help="Synthetic motion, when there is no --trial."),
        board: str = typer.Option(
            None,
            callback=options.simulated_board,
            help="The board to simulate, a folder of boards/ (sim; with nine axes robomaster_a).",
        ),
        filters: str = typer.Option(
            None,
            help="Run it with each of these filters, a,b,... and compare (default: the board's).",
        ),
        headless: bool = typer.Option(
            False, "--headless", help="No live display: progress, the last picture, the figures."
        ),
        seconds: float = options.seconds("Simulated time (25; of a trial, all of it)."),
        speed: float = typer.Option(None, min=0, help="Times real time; 0: as fast as it goes."),
        png: Path = options.output("Save the display's last picture."),
        gif: Path = options.output("Save all that the display showed as an animation."),
        dmp_image: Path = typer.Option(
            None, exists=True, dir_okay=False, help="The DMP's image for dmp6 (a stand-in)."
        ),
        runtime: str = options.runtime(),
    ):
        """Boot the firmware on a simulated board: MPU6050, filter in a hard timer tick, OLED; how far off it was."""
        names = registry.listed(filters) if filters else [None]
        nine = next((name for name in names if name and registry.axes(name) == 9), None)
        board = board or (replay.board_for(nine) if nine else "sim")
        if trial and "dmp6" in names:
            raise Wrong("dmp6 samples by a clock of its own: it cannot follow a --trial")
        source = (
            trial_source(trial, seconds, board) if trial else motion_source(motion, seconds, board)
        )
        source.dmp_image = dmp_image
        runtime = runtime or simulate.best_runtime()
        outcomes = []
        for name in names:
            if name:
                source.board["FILTER"] = name
            outcomes.append(show(source, runtime, headless or bool(outcomes), speed))
            for line in summary(outcomes[-1]):
                console.say(line)
        if len(outcomes) > 1:
            console.show(compare(outcomes))
        for what, path, save in (("picture", png, save_png), ("animation", gif, save_gif)):
            if path:
                with console.writing(path):
                    save(outcomes[0], path)
                console.say(f"{what}: {path}")
        if any(
            not r["started"] or r["crashes"] or r["uncaught"] for r in (o.result for o in outcomes)
        ):
            raise typer.Exit(console.FAILED)
