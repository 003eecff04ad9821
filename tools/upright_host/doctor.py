"""`upright doctor`: what a board says of itself, its chips, its timer and its axis maps, and what to do about it.

The examination runs on the board, upright_app/doctor.py; here are only its beginning and its end.
"""

import ast

import typer
from mpremote.transport import TransportError
from rich.console import Console

from upright_host import contents, device, paths, runtimes, simulate

DOCTOR = paths.SIMULATOR / "run_doctor.py"
_MARK = "\x1e"  # before the list of problems, which no console line begins with


def examine(transport, axes: bool, south: bool, on_line) -> list[str]:
    """Examine a connected board -> its problems. axes: with the guided check of IMU_AXES and MAG_AXES.

    Raises device.DeviceError when the firmware is not on it.
    """
    found = device.facts(transport)
    problems = found.problems()
    version = ".".join(map(str, found.version))
    on_line(
        f"{found.machine or found.platform}: MicroPython {version}, {found.free_bytes} bytes of file system free"
    )
    for name in ("board.py", "lib/upright_app/doctor.mpy"):
        if not transport.fs_exists(name) and not transport.fs_exists(name.replace(".mpy", ".py")):
            raise device.DeviceError(f"{name} is not on the board: `upright flash BOARD` first")
    wanted = contents.setting(transport.fs_readfile("board.py").decode(), "PLATFORM")
    if wanted and wanted != found.platform:
        problems.append(f"board.py is for the port {wanted!r}, this is {found.platform!r}")
    call = f"doctor.axes(board, {south})" if axes else "doctor.report(board)"
    rest = ""
    said = []

    def consume(data: bytes):
        nonlocal rest
        rest += data.replace(b"\x04", b"").decode("utf-8", "replace")
        *lines, rest = rest.split("\n")
        for line in lines:
            if line.startswith(_MARK):
                said.append(ast.literal_eval(line[1:]))
            else:
                on_line(line.rstrip("\r"))

    transport.exec(
        f"import board\nfrom upright_app import doctor\nprint({_MARK!r} + repr({call}))",
        data_consumer=consume,
    )
    return problems + (said[0] if said else ["the examination did not end"])


def examine_simulated(board: str, runtime: str, on_line, **parts) -> list[str]:
    """The same of a simulated board; parts: imu, mag, display False where it is missing."""
    result = simulate.run(
        runtime,
        DOCTOR,
        {"board_name": paths.known_board(board)} | parts,
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
            False, help="The guided two-minute check of the axis maps instead."
        ),
        south: bool = typer.Option(False, help="With --axes: on the southern half of the earth."),
        simulated: str = typer.Option(
            None, help="Examine this simulated board, a folder of boards/."
        ),
        emulated: bool = typer.Option(
            False, help="Examine the emulated Pico (`upright flash pico --emulated` before)."
        ),
    ):
        """Examine a board with the firmware on it: chips, rates, timer, heap, axis maps; and what to fix."""
        console = Console()

        def say(line):
            console.print(line, highlight=False, markup=False)

        try:
            if axes and (simulated or emulated):
                raise device.DeviceError("nobody turns a simulated board: --axes needs a real one")
            if simulated:
                problems = examine_simulated(simulated, simulate.best_runtime(), say)
            else:
                transport = device.open_board(port, emulated)
                try:
                    problems = examine(transport, axes, south, say)
                finally:
                    transport.close()
        except (
            device.DeviceError,
            TransportError,
            simulate.SimulationError,
            runtimes.Unavailable,
        ) as why:
            console.print(str(why), style="red", highlight=False, markup=False)
            raise typer.Exit(1) from None
        raise typer.Exit(1 if problems else 0)
