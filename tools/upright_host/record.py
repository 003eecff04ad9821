"""`upright record`: raw counts of a connected board into a file here, for `upright calibrate`.

upright_app/record.py does it, from the board's RAM; its rows come over the line, and the board's file system is not
written to.
"""

import base64
from pathlib import Path

import typer

from upright_host import device, doctor, options, ram
from upright_host.console import say

_DATA, _SEEK = "\x1e", "\x1d"  # before what is written to the file, and before where to write on
# On the board: a file whose other end is here
_FILE = f"""
import board
from upright_app import record
Ram.files.clear()
class Line:
    def write(self, data):
        print({_DATA!r} + binascii.b2a_base64(data).decode().strip())
    def seek(self, at):
        print({_SEEK!r} + str(at))
"""


def record(transport, path: Path, seconds: float, rate_hz: int, on_line) -> int:
    """Record on a connected board into a file -> its bytes. Ctrl-C ends it earlier. Raises device.DeviceError."""
    found = device.facts(transport)
    ram.load(transport, found, "record")
    content, at = bytearray(), 0

    def write(text):
        nonlocal at
        data = base64.b64decode(text)
        content[at : at + len(data)] = data
        at += len(data)

    def seek(text):
        nonlocal at
        at = int(text)

    lines = doctor.Lines({_DATA: write, _SEEK: seek}, on_line)
    transport.exec(_FILE)
    call = f"record.run({path.name!r}, {seconds!r}, {rate_hz!r}, board, Line())"
    try:
        transport.exec(call, data_consumer=lines.feed)
    except KeyboardInterrupt:
        transport.serial.write(b"\x03")
        transport.follow(10, data_consumer=lines.feed)
    if not content:
        raise device.DeviceError("the board recorded nothing")
    path.write_bytes(content)
    return len(content)


def register(app: typer.Typer):
    """Add `upright record` to the command line."""

    @app.command("record")
    def record_command(
        file: Path = typer.Argument(
            ..., callback=options.writable, help="The file to write, NAME.imu."
        ),
        seconds: int = typer.Option(
            60, min=1, max=100_000, help="For so long; Ctrl-C ends it earlier."
        ),
        rate: int = typer.Option(100, min=1, max=1000, help="Samples a second."),
        port: str = typer.Option(
            None, help="The board's serial port (default: the only one there is)."
        ),
        emulated: bool = typer.Option(
            False,
            "--emulated",
            help="Record on the emulated Pico (`upright flash pico --emulated` before).",
        ),
    ):
        """Record a board's raw counts, for `upright calibrate`; nothing is written to the board."""
        with device.opened(port, emulated) as transport:
            size = record(transport, file, seconds, rate, say)
        say(f"{file}: {size} bytes. Then: upright calibrate mag (or gyro, accel) {file}")
