"""What all commands share: how they fail, what they show while they work, and the CSV files that they write.

A command raises; Commands, the class of the command line's groups, makes of that one red line on standard error and an
exit code.
"""

import contextlib
import csv
import errno

import typer
import typer.core
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

FAILED = 1  # the run did not succeed, or what was examined is not in order
WRONG = 2  # an argument, or a file that cannot be read, used or written
NOT_HERE = 3  # a runtime, a tool or a package that this machine does not have

EXIT_CODES = (
    "Exit codes: 0 done; 1 the run failed, or a fault was found; 2 a wrong argument or file; 3 a runtime, tool or"
    " package is not here."
)

_LINE_MOST = 600

out = Console()
errors = Console(stderr=True)


class Failed(RuntimeError):
    """What was run did not come to its end; the message says why."""


class Wrong(ValueError):
    """An argument or a file of which nothing can be made; the message says which and why."""


class Unavailable(Exception):
    """A runtime, a tool or a package is not available here; the message is one line that says why."""

    runtime: str | None = None  # which, if it is one

    def line(self) -> str:
        return (
            f"runtime {self.runtime} is not available here: {self}" if self.runtime else str(self)
        )


# click's, which typer has under another name in each of its versions
_UsageError = typer.BadParameter.__base__


class Commands(typer.core.TyperGroup):
    """Commands whose exceptions become a line and an exit code."""

    def make_context(self, *arguments, **more):
        with failing():
            return super().make_context(*arguments, **more)

    def invoke(self, ctx):
        with failing():
            return super().invoke(ctx)


@contextlib.contextmanager
def failing():
    """Show what is wrong with a command, a file or this machine as a line; leave with the code that belongs to it."""
    try:
        yield
    except _UsageError as why:
        if type(why).__name__ == "NoArgsIsHelpError":
            raise
        of = " ".join(["upright", *why.ctx.command_path.split()[1:]]) if why.ctx else "upright"
        said = " ".join(why.format_message().split()).rstrip(".")
        fail(f"{said}. `{of} --help` shows what there is", WRONG)
    except Unavailable as why:
        fail(why.line(), NOT_HERE)
    except Wrong as why:
        fail(str(why), WRONG)
    except OSError as why:
        if why.errno == errno.EPIPE:  # the reader of our output has gone
            raise
        fail(reason(why), WRONG)
    except Failed as why:
        fail(str(why), FAILED)


def fail(message: str, code: int):
    """Say it in red and end the command. What a damaged file brought into it neither fills nor upsets the terminal."""
    for line in message.split("\n"):
        line = "".join(c if c.isprintable() else "?" for c in line)
        if len(line) > _LINE_MOST:
            line = f"{line[: _LINE_MOST * 2 // 3]} ... {line[-_LINE_MOST // 3 :]}"
        say(line, "red", errors)
    raise typer.Exit(code) from None


@contextlib.contextmanager
def writing(path):
    """Raises Wrong where the file cannot be written."""
    try:
        yield
    except OSError as why:
        raise Wrong(f"{path} cannot be written: {why.strerror or why}") from None


def contents(path, most: int) -> bytes:
    """What is in a file that people name. Raises Wrong for more than `most` bytes, which no file of its kind has."""
    with open(path, "rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise Wrong(f"{path} has more than {most} bytes, as no file of its kind")
    return data


def show(table) -> None:
    """A table. Its numbers are not cut on a narrow terminal, and nothing is folded where there is none."""
    wanted = out.measure(table, options=out.options.update(width=1000)).maximum
    Console(width=max(out.width, min(wanted, 80) if out.is_terminal else wanted)).print(table)


def reason(why: OSError) -> str:
    """FILE: what is wrong with it."""
    if why.errno == errno.ENOENT and not why.filename:
        return "the current folder has been removed"
    return f"{why.filename}: {why.strerror}" if why.filename and why.strerror else str(why)


def say(line="", style: str | None = None, where: Console = out) -> None:
    """A line of text for people, as it is; broken between words where there is a terminal's edge."""
    where.print(line, style=style, highlight=False, markup=False, soft_wrap=not where.is_terminal)


# -- progress
def bars(where: Console | None = None) -> Progress:
    """Bars with text, percentage and time, gone when they are done, on terminals only; by default standard error."""
    # a console of its own: one may come up while another is shown
    where = where or Console(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn())
    return Progress(
        *columns, TimeElapsedColumn(), console=where, transient=True, disable=not where.is_terminal
    )


@contextlib.contextmanager
def progress(text: str, total: float | None = None, where: Console | None = None):
    """A bar while work is under way -> at(done, of=total, text=text), which moves it; from any thread."""
    with bars(where) as shown:
        task = shown.add_task(text, total=total)

        def at(done, of=None, text=None):
            shown.update(task, completed=done, total=of, description=text)

        yield at


# -- CSV
def write_csv(path, columns, rows, form: str = ".4f") -> None:
    """A line of column names, then the rows: floats in `form`, nothing for None. Raises Wrong."""
    with writing(path), open(path, "w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(columns)
        for row in rows:
            lines.writerow([_cell(value, form) for value in row])


def _cell(value, form):
    if value is None:
        return ""
    return format(value, form) if isinstance(value, float) else value
