"""What a tick costs: Thumb-2 instructions under qemu-arm, microseconds on the unix port, bytes allocated; and cycles
on the emulated RP2040.

Everything is measured beside a plain float filter in the same run, and told as a ratio to it: ratios hold on another
machine, microseconds do not. tools/simulator/bench/bench_steps.py is what runs.
"""

import os
import re
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import typer
from rich.table import Table

from upright_host import console, contents, emulated, options, paths, rp2040, runtimes, tracing
from upright_host.console import Failed, Wrong

PROGRAMS = paths.SIMULATOR / "bench"
STEPS = "bench_steps"
BESIDE = (PROGRAMS / "float_mahony.py",)  # what it imports besides lib/
LEAST_RATIO = 10  # instructions of the float filter to those of the integer one, on arm

# name in bench_steps.py: what people read
PARTS = {
    "read": "sensor read",
    "filter": "filter update",
    "filter9": "filter update, nine axes",
    "calibration": "calibration",
    "display": "display chunk, 32 bytes",
    "tick": "whole tick",
    "euler": "Euler angles",
    "float": "float, never collected",
    "collected": "float Mahony update",
}
_FLOAT = "collected"  # what the ratios are to
_AROUND = ("empty", "bus_read", "bus_write")  # measured to be subtracted
TRACE_STEPS = 32
TRACE_HEAP = "192K"  # about a Pico's
BOARD_STEPS = 16
BOARD_MHZ = 125  # of the RP2040, as MicroPython sets it
TIME_LINES = 25
_BATCH = 256  # steps in one line of `time`
SMALL_HEAP = "512K"  # objects are twice as large on 64 bits: about a board's 256 KB

DOCS = paths.ROOT / "docs" / "benchmarks.md"
_BEGIN, _END = "<!-- figures: upright bench --save -->", "<!-- end of figures -->"


@dataclass
class Figures:
    """What was measured; a part that is missing could not be."""

    instructions: dict[str, float] = field(default_factory=dict)  # a step, on arm
    microseconds: dict[str, float] = field(default_factory=dict)  # a step, on unix
    allocated: dict[str, dict[str, float]] = field(default_factory=dict)  # runtime: bytes a step
    cycles: dict[str, float] = field(default_factory=dict)  # a step, on the emulated RP2040
    not_here: list[str] = field(default_factory=list)


# ---------------------------------------------------------------------------------------- running
def command(
    runtime: str,
    mode: str,
    n: int,
    folder: Path | None = None,
    heap: str | None = None,
    filters_only: bool = False,
):
    """-> (argv, environment) of bench_steps.py. Without the simulator, whose clock is not the real one.

    folder: where tracing.compile_for() has put everything; heap: its size, for MicroPython.
    """
    if folder:
        start, _ = runtimes.interpreter(runtime)
        path = [folder]
        script = folder / tracing.START
        argv = [*start, "-X", f"heapsize={runtimes.HEAP}", str(script), mode, str(n)]
        environment = dict(os.environ)
    else:
        argv, environment = runtimes.command(runtime, PROGRAMS / f"{STEPS}.py", [mode, n])
        path = [*paths.board_path(simulated=False), PROGRAMS]
    if filters_only:
        argv.append("filters")
    if heap:
        argv[argv.index("-X") + 1] = f"heapsize={heap}"
    if runtime == "cpython":
        environment["PYTHONPATH"] = ":".join(map(str, [paths.SHIM, *path]))
    else:
        environment["MICROPYPATH"] = ":".join(map(str, path))
    return argv, environment


def say(runtime: str, mode: str, n: int, heap: str | None = None) -> list[list[str]]:
    """Run bench_steps.py to its end -> the words of its lines."""
    argv, environment = command(runtime, mode, n, heap=heap)
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=600)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise tracing.TraceError(f"{STEPS}.py {mode} on {runtime} failed: {' '.join(last)}")
    return [line.split() for line in done.stdout.splitlines()]


# ---------------------------------------------------------------------------------------- instructions
def instructions(
    n: int = TRACE_STEPS,
    on_mark: Callable[[int], None] = lambda at: None,
    filters_only: bool = False,
) -> dict[str, float]:
    """Thumb-2 instructions of each part's step on arm, with what surrounds it -> {part: instructions}.

    filters_only: just "empty", "filter" and "float", which is quicker.
    on_mark(k) is called as the k-th mark goes by. Raises Unavailable and tracing.TraceError.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        tracing.compile_for("arm", folder, PROGRAMS / f"{STEPS}.py", *BESIDE)
        argv, environment = command("arm", "trace", n, folder, TRACE_HEAP, filters_only)
        found = tracing.per_step(tracing.marks(argv, environment, on_mark))
    wanted = {"empty", "filter", "float"} if filters_only else {*PARTS, *_AROUND}
    missing = wanted - found.keys()
    if missing or not found["filter"] > 0:
        raise tracing.TraceError(
            f"qemu's log held no count of {', '.join(sorted(missing)) or 'the filter'}"
        )
    return found


def cycles(n: int = BOARD_STEPS, on_mark: Callable[[int], None] = lambda at: None):
    """Cycles of each part's step on the emulated RP2040, with what surrounds it -> {part: cycles}.

    The same program as instructions() traces, compiled for that board. Raises Unavailable and tracing.TraceError.
    """
    image, board = rp2040.image(), emulated.simulator()
    cross = emulated.mpy_cross()
    programs = (*BESIDE, PROGRAMS / f"{STEPS}.py")
    try:
        files = {
            f"{name}.mpy": emulated.compile_module(path, cross)
            for name, path in (paths.board_modules() | {p.stem: p for p in programs}).items()
        }
        marks = board.between_marks(image, files, STEPS, "trace", n, on_mark=on_mark)
    except (board.BoardError, ValueError) as why:
        raise tracing.TraceError(f"the run on rp2040 failed: {str(why).splitlines()[-1]}") from None
    return tracing.per_step(marks)


# ---------------------------------------------------------------------------------------- time, memory
def net(spent: dict[str, float], calls: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Take the loop and the stand-in bus off what a step costs. calls: {part: (reads, writes) a step}."""
    empty, read, write = (spent[part] for part in _AROUND)
    return {
        part: spent[part]
        - empty
        - calls.get(part, (0, 0))[0] * (read - empty)
        - calls.get(part, (0, 0))[1] * (write - empty)
        for part in PARTS
        if part in spent
    }


def bus_calls(runtime: str, n: int = TRACE_STEPS) -> dict[str, tuple[float, float]]:
    """Bus calls that a step makes: {part: (reads, writes)}."""
    lines = say(runtime, "calls", n)
    return {part: (int(reads) / n, int(writes) / n) for part, reads, writes in lines}


def microseconds(
    runtime: str, lines: int = TIME_LINES, heap: str | None = None
) -> dict[str, float]:
    """Microseconds of each part's step, by the real clock: the median of `lines` rounds."""
    spent: dict[str, list[float]] = {}
    for part, us in say(runtime, "time", lines, heap):
        spent.setdefault(part, []).append(int(us) / _BATCH)
    return {part: statistics.median(all_of) for part, all_of in spent.items()}


def allocated(runtime: str, n: int = TRACE_STEPS) -> dict[str, float]:
    """Bytes that each part's step takes from the heap; empty where the port does not tell."""
    return {part: int(used) / n for part, used in say(runtime, "alloc", n)}


# ---------------------------------------------------------------------------------------- all of it
def measure(progress=console.progress) -> Figures:
    """Everything that this machine can measure. progress: console.progress, or the like."""
    figures = Figures()
    marks = 4 * len({*PARTS, *_AROUND})  # qemu's: a part's begin and end, without and with steps

    def memory(runtime, at):
        figures.allocated[runtime] = allocated(runtime)

    def time(runtime, at):
        spent = net(microseconds(runtime, heap=SMALL_HEAP), bus_calls(runtime))
        # the heap is collected as it fills
        spent[_FLOAT] = spent.pop("float")
        figures.microseconds = spent

    def trace(runtime, at):
        figures.instructions = net(instructions(on_mark=at), bus_calls(runtime))

    def board(runtime, at):
        figures.cycles = net(cycles(on_mark=at), bus_calls("cpython"))

    jobs = (
        ("microseconds", "unix", time),
        ("memory", "unix32", memory),
        ("memory", "arm", memory),
        ("instructions", "arm", trace),
        ("cycles", "rp2040", board),
    )
    for what, runtime, job in jobs:
        with progress(f"{what} on {runtime}", marks) as at:
            try:
                job(runtime, at)
            except (runtimes.Unavailable, Failed, subprocess.TimeoutExpired) as why:
                figures.not_here.append(f"{what} on {runtime}: not measured: {why}")
    return figures


def rows(figures: Figures) -> Iterator[tuple[str, ...]]:
    """The table as text, its head first."""
    yield ("", "arm insns", "ratio", "unix us", "ratio", "arm bytes", "unix32 bytes")
    for part, text in PARTS.items():
        cells = [text]
        for of, form in ((figures.instructions, "{:,.0f}"), (figures.microseconds, "{:.2f}")):
            if part in of:
                cells += [form.format(of[part]), f"{of[_FLOAT] / of[part]:.1f}"]
            else:
                cells += ["-", "-"]
        for runtime in ("arm", "unix32"):
            of = figures.allocated.get(runtime)
            cells.append(f"{of['float' if part == _FLOAT else part]:,.0f}" if of else "-")
        yield tuple(cells)


BOARD_TITLE = "on the emulated RP2040: cycles and microseconds"


def board_rows(figures: Figures) -> list[tuple[str, ...]]:
    """The table of the emulated board as text, its head first; empty where there was none."""
    of = figures.cycles
    if not of:
        return []
    body = [
        (text, f"{of[part]:,.0f}", f"{of[part] / BOARD_MHZ:,.0f}", f"{of[_FLOAT] / of[part]:.1f}")
        for part, text in PARTS.items()
        if part in of
    ]
    return [("", "cycles", f"us at {BOARD_MHZ} MHz", "ratio"), *body]


def remarks(figures: Figures) -> Iterator[str]:
    """What the table says, in sentences."""
    of = figures.instructions
    if of:
        yield (
            f"arm: the integer filter takes {of[_FLOAT] / of['filter']:.1f} times fewer instructions than the float"
            f" one ({LEAST_RATIO} are asked for);"
            f" {of['float'] / of['filter']:.1f} times fewer if its garbage were never collected"
        )
    of = figures.microseconds
    if of:
        yield (f"unix: it takes {of[_FLOAT] / of['filter']:.1f} times less time")
    yield from figures.not_here


def save(figures: Figures, file: Path) -> None:
    """Replace the figures in a Markdown file, between its two marks. Raises Wrong where they are missing."""
    text = file.read_text("utf-8")
    if not re.search(f"{_BEGIN}.*{_END}", text, re.DOTALL):
        raise Wrong(f"{file} has no place for the figures: {_BEGIN} ... {_END}")
    new = [_BEGIN, "", *_markdown(rows(figures)), "", *(f"- {r}" for r in remarks(figures)), ""]
    if figures.cycles:
        title = BOARD_TITLE[0].upper() + BOARD_TITLE[1:]
        new += [f"### {title}", "", *_markdown(board_rows(figures)), ""]
    new = "\n".join([*new, _END])
    head_text, tail = text.split(_BEGIN)[0], text.split(_END)[1]
    file.write_text(head_text + new + tail, encoding="utf-8")


def _markdown(lines: Iterable[tuple[str, ...]]) -> list[str]:
    head, *body = lines
    table = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    return table + ["| " + " | ".join(row) + " |" for row in body]


def _show(title: str, lines: Iterable[tuple[str, ...]]) -> None:
    head, *body = lines
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for k, text in enumerate(head):
        table.add_column(text, justify="right" if k else "left")
    for row in body:
        table.add_row(*row)
    console.show(table)


def register(app: typer.Typer) -> None:
    """Give an app the command `bench`."""

    @app.command("bench")
    def bench_command(
        save_to: Path = typer.Option(
            None,
            "--save",
            callback=options.writable,
            help=f"Put the figures into this Markdown file ({DOCS.name} of docs/).",
        ),
    ):
        """Measure what a tick costs: instructions on arm, microseconds on unix, bytes; as ratios to a float filter."""
        figures = measure()
        _show("one step, without loop and bus", rows(figures))
        if figures.cycles:
            _show(BOARD_TITLE, board_rows(figures))
        for remark in remarks(figures):
            console.say(remark)
        table = Table(title="installed on a board, bytes", title_justify="left", box=None)
        for column in ("board", "files", "bytes", "packed"):
            table.add_column(column, justify="left" if column == "board" else "right")
        for board, *numbers in contents.sizes():
            table.add_row(board, *(f"{number:,}" for number in numbers))
        console.show(table)
        if save_to:
            save(figures, save_to)
        of = figures.instructions
        if of and of[_FLOAT] < LEAST_RATIO * of["filter"]:
            raise typer.Exit(console.FAILED)
