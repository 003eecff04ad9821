"""The command line `upright`: its commands by group, and those two that belong to no other module."""

import os
import subprocess
import sys
from pathlib import Path

import typer
from rich.table import Table

from upright_host import (
    __version__,
    bench,
    calibrate,
    compare,
    console,
    demo,
    dmp,
    doctor,
    faults,
    flash,
    new_board,
    options,
    packages,
    record,
    replay,
    rp2040,
    runtimes,
    score,
    simulate,
    tune,
)

_LARGEST_PROGRAM = 1 << 20  # bytes
_LARGEST_IMAGE = 16 << 20  # an .uf2 has twice the bytes of the flash

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    cls=console.Commands,
    epilog=console.EXIT_CODES,
)


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
    """Attitude (roll, pitch, yaw) for MicroPython: install, examine, simulate, replay, score."""


for module in (
    flash,
    doctor,
    record,
    new_board,
    dmp,
    calibrate,
    replay,
    score,
    compare,
    demo,
    faults,
    tune,
    bench,
    packages,
):
    module.register(app)


@app.command(
    "exec", context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False}
)
def exec_file(
    file: Path = typer.Argument(..., help="The program.", exists=True, dir_okay=False),
    args: list[str] = typer.Argument(None, help="What it finds in sys.argv[1:]."),
    runtime: str = options.runtime(),
    board: str = typer.Option("sim", callback=options.simulated_board, help="A folder of boards/."),
    seconds: float = options.seconds("Stop it after so much simulated time (default: never)."),
):
    """Run a MicroPython program on a simulated board: its chips on its buses, level, at rest, with a sensor's noise.

    Options of this command stand before FILE. Ctrl-C ends the program.
    """
    try:
        console.contents(file, _LARGEST_PROGRAM).decode()
    except UnicodeDecodeError as why:
        raise console.Wrong(f"{file} is no program: {why}") from None
    runtime = runtime or simulate.best_runtime()
    argv, environment = runtimes.program(runtime, file, args or (), board, seconds)
    with calibrate.untouched():
        code = subprocess.run(argv, env=environment).returncode
    raise typer.Exit(code)


@app.command("runtimes")
def list_runtimes(
    names: list[str] = typer.Argument(None, help="Only these (default: all)."),
    image: Path = typer.Option(
        None, help="Take this RPI_PICO firmware (.uf2) for rp2040 instead of building one."
    ),
):
    """Obtain and list the interpreters that the portable code is tested on, and the emulated board's firmware."""
    if image:
        try:
            console.contents(image, _LARGEST_IMAGE)
            rp2040.take(image)
        except runtimes.Unavailable as why:
            raise console.Wrong(str(why)) from None
    unknown = set(names or ()) - set(runtimes.LISTED)
    if unknown:
        raise console.Wrong(
            f"unknown runtime {', '.join(sorted(unknown))}; there are {', '.join(runtimes.LISTED)}"
        )
    names = names or runtimes.LISTED
    runtimes.obtain_all(names)
    table = Table(box=None, pad_edge=False)
    for column in ("runtime", "version", "what"):
        table.add_column(column)
    for name in names:
        try:
            _, version = runtimes.interpreter(name)
            table.add_row(name, version, runtimes.what(name))
        except runtimes.Unavailable as why:
            table.add_row(name, "-", f"not here: {why}")
    console.show(table)


# The groups of `upright --help`, in their order
_GROUPS = {
    "Your board": ("flash", "doctor", "record", "board", "dmp"),
    "Your data": ("calibrate", "replay", "score", "compare"),
    "Study, without a board": ("demo", "faults", "exec", "tune"),
    "Maintain Upright": ("bench", "packages", "runtimes"),
}
for command in (*app.registered_commands, *app.registered_groups):
    (command.rich_help_panel,) = (
        group for group, names in _GROUPS.items() if command.name in names
    )
app.registered_commands.sort(key=lambda command: list(_GROUPS).index(command.rich_help_panel))


def main():
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started us
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        stream = getattr(sys, name)
        stream.reconfigure(errors="replace")  # Windows: a pipe does not take the display's dots
    app()


if __name__ == "__main__":
    sys.exit(main())
