"""`upright doctor`: what a board says of itself, its chips, its timer and its axis maps, and what to do about it.

The examination runs on the board, upright_app/doctor.py, from its RAM; here are only its beginning and its end.
"""

import ast

import typer

from upright_host import contents, device, options, paths, ram, simulate
from upright_host.console import FAILED, Wrong, say

DOCTOR = paths.SIMULATOR / "run_doctor.py"
_MARK = "\x1e"  # before the list of problems, which no console line begins with


def examine(transport, axes: bool, south: bool, on_line) -> list[str]:
    """Examine a connected board -> its problems. axes: with the guided check of IMU_AXES and MAG_AXES.

    Raises device.DeviceError when there is no board.py on it.
    """
    found = device.facts(transport)
    problems = found.problems()
    version = ".".join(map(str, found.version))
    on_line(
        f"{found.machine or found.platform}: MicroPython {version}, {found.free_bytes} bytes of file system free"
    )
    ram.load(transport, found, *(("guided", "axis_check") if axes else ("doctor",)), "source")
    try:
        wanted = contents.setting(transport.fs_readfile("board.py").decode(), "PLATFORM")
    except ValueError:
        wanted = None  # it is worked out on the board
    if wanted and wanted != found.platform:
        problems.append(f"board.py is for the port {wanted!r}, this is {found.platform!r}")
    module = "guided" if axes else "doctor"
    call = f"guided.axes(board, {south})" if axes else "doctor.report(board)"
    said = []
    lines = Lines({_MARK: lambda line: said.append(ast.literal_eval(line))}, on_line)
    # Modules stay: collected between them, they do not lie scattered over a small heap.
    transport.exec(
        f"import gc, board\ngc.collect()\nfrom upright_app import {module}\nRam.files.clear()\ngc.collect()"
    )
    transport.exec(f"print({_MARK!r} + repr({call}))", data_consumer=lines.feed)
    return problems + (said[0] if said else ["the examination did not end"])


class Lines:
    """Takes what a board prints, in whatever pieces, apart into lines. marked: {first character: called with the rest
    of such a line}; on_line is called with the others."""

    def __init__(self, marked: dict, on_line):
        self._marked, self._on_line, self._rest = marked, on_line, ""

    def feed(self, data: bytes):
        self._rest += data.replace(b"\x04", b"").decode("utf-8", "replace")
        *lines, self._rest = self._rest.split("\n")
        for line in lines:
            line = line.rstrip("\r")
            if line[:1] in self._marked:
                self._marked[line[:1]](line[1:])
            else:
                self._on_line(line)


def examine_simulated(board: str, runtime: str, on_line, **parts) -> list[str]:
    """The same of a simulated board; parts: imu, mag, display False where it is missing."""
    result = simulate.run(
        runtime,
        DOCTOR,
        {"board_name": board} | parts,
        lambda kind, fields: on_line(fields[0]) if kind == "console" else None,
    )
    return result["problems"]


def register(app: typer.Typer):
    """Add `upright doctor` to the command line."""

    @app.command("doctor")
    def doctor_command(
        port: str = typer.Option(
            None, help="The board's serial port (default: the only one there is)."
        ),
        axes: bool = typer.Option(
            False, "--axes", help="The guided two-minute check of the axis maps instead."
        ),
        south: bool = typer.Option(
            False, "--south", help="With --axes: on the southern half of the earth."
        ),
        simulated: str = typer.Option(
            None,
            callback=options.simulated_board,
            help="Examine this simulated board, a folder of boards/.",
        ),
        emulated: bool = typer.Option(
            False,
            "--emulated",
            help="Examine the emulated Pico (`upright flash pico --emulated` before).",
        ),
    ):
        """Examine a board: self-test, chips, rates, timer, heap, axis maps; and what to fix."""
        if axes and (simulated or emulated):
            raise Wrong("a simulated board cannot be turned: --axes needs a real one")
        if simulated:
            problems = examine_simulated(simulated, simulate.best_runtime(), say)
        else:
            with device.opened(port, emulated) as transport:
                problems = examine(transport, axes, south, say)
        raise typer.Exit(FAILED if problems else 0)
