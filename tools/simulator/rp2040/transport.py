"""The emulated Pico as mpremote sees a board: what `upright flash` and `upright doctor` do to one over USB, they do
here, at the same raw prompt. Only files travel packed, since it takes the emulator half a millisecond to take a byte.
"""

import ast
import base64
import zlib
from pathlib import Path

from chips.mpu6050 import MPU6050Chip
from chips.ssd1306 import SSD1306Chip
from mpremote.transport import Transport, TransportError, TransportExecError
from world import StillWorld

from rp2040 import files
from rp2040.board import Board, BoardError

_RAW = b"raw REPL; CTRL-B to exit\r\n>"
_SIZE = files.BLOCK * files.BLOCKS
_WINDOW_BITS = 12  # of the packed files: what unpacking takes of the board's heap, 4 KiB
_CHUNK = 4096
_COMMAND_S = 60  # emulated, for one command to end


def pico(image: Path, flash: bytes | dict | None = None) -> Board:
    """-> a Pico, not booted yet, wired as boards/pico says (MPU6050 and SSD1306 on I2C0, data ready on GP6), at rest.

    flash: what is in its file system, as flash_memory gave it or by name; None: nothing.
    """
    named = flash if isinstance(flash, dict) else None
    board = Board(image, named)
    if flash is not None and named is None:
        board.mcu.flash[files.START : files.START + _SIZE] = flash
    bus = board.i2c(0, sda=4, scl=5)
    imu = bus.add(MPU6050Chip(StillWorld()))
    board.display = bus.add(SSD1306Chip())
    board.data_ready(6, imu)
    return board


def flash_memory(board: Board) -> bytes:
    """-> the part of its flash that holds the file system, as it is this very moment."""
    return bytes(board.mcu.flash[files.START : files.START + _SIZE])


class EmulatedTransport(Transport):
    """A board at its prompt, its program stopped.

    board  booted here
    keep   a file that takes the place of the board's flash: read by whoever made the board, written by close()
    """

    def __init__(self, board: Board, keep: Path | None = None):
        self.board = board
        self.clock = Clock(board)
        self.serial = Serial(board)
        self._keep = keep
        board.boot(10)
        self.enter_raw_repl()

    def enter_raw_repl(self, soft_reset=True):
        self.serial.write(b"\r\x03")
        self._wait(b"\r\x01", _RAW)
        if soft_reset:
            self._wait(b"\x04", _RAW)

    def exit_raw_repl(self):
        self.serial.write(b"\r\x02")

    def _wait(self, keys, text):
        start = len(self.serial.said)
        self.serial.write(keys)
        try:
            self.board.run_until(lambda: self.serial.said.find(text, start) >= 0, 10, "raw prompt")
        except BoardError as why:
            raise TransportError(str(why)) from None

    def exec(self, command, data_consumer=None):
        command = command if isinstance(command, bytes) else command.encode()
        said = self.serial.said
        start = told = len(said) + len(b"OK")

        def done():
            nonlocal told
            end = said.find(b"\x04", start)
            if data_consumer and told < (until := len(said) if end < 0 else end):
                data_consumer(bytes(said[told:until]))
                told = until
            # output, 04, errors, 04, the next prompt
            return end >= 0 and said.find(b"\x04>", end + 1) >= 0

        self.serial.write(command + b"\x04")
        try:
            self.board.run_until(done, _COMMAND_S, "end of a command")
        except BoardError as why:
            raise TransportError(str(why)) from None
        if said[start - 2 : start] != b"OK":
            raise TransportError(f"the raw prompt answered {bytes(said[start - 2 : start + 80])!r}")
        output, errors = bytes(said[start:]).split(b"\x04")[:2]
        if errors:
            raise TransportExecError(1, errors.decode())
        return output

    def eval(self, expression, parse=True):
        text = self.exec(f"print(repr({expression}))").strip()
        return ast.literal_eval(text.decode()) if parse else text

    def fs_writefile(self, dest, data, chunk_size=_CHUNK, progress_callback=None):
        """As Transport's, packed on the way."""
        self.exec(
            f"import binascii, deflate, io\nf = open({dest!r}, 'wb')\n"
            "def w(packed):\n"
            "    with deflate.DeflateIO(io.BytesIO(binascii.a2b_base64(packed)), deflate.ZLIB) as d:\n"
            "        f.write(d.read())\n"
        )
        for at in range(0, len(data), chunk_size):
            packer = zlib.compressobj(9, zlib.DEFLATED, _WINDOW_BITS)
            packed = packer.compress(data[at : at + chunk_size]) + packer.flush()
            self.exec(b"w('%s')" % base64.b64encode(packed))
            if progress_callback:
                progress_callback(min(at + chunk_size, len(data)), len(data))
        self.exec("f.close()")

    def close(self):
        """The power is gone; the flash stays."""
        if self._keep:
            new = self._keep.with_name(self._keep.name + ".new")
            new.write_bytes(flash_memory(self.board))
            new.replace(self._keep)


def connect(image: Path, keep: Path) -> EmulatedTransport:
    """-> a Pico whose flash is in the file `keep` between one connection and the next; an empty one at first."""
    memory = keep.read_bytes() if keep.exists() else None
    return EmulatedTransport(pico(image, memory), keep)


class Clock:
    """The board's own seconds, for what waits for it."""

    def __init__(self, board):
        self._board = board

    def monotonic(self):
        return self._board.now_us / 1e6

    def sleep(self, seconds):
        self._board.run(seconds)


class Serial:
    """The board's line, as a serial port is used. said: all that came over it."""

    def __init__(self, board):
        self._board = board
        self.said = board._console
        self._read = 0

    def write(self, data):
        self._read = len(self.said)
        self._board.send(data)

    def inWaiting(self):
        return len(self.said) - self._read

    def read(self, size):
        start, self._read = self._read, min(self._read + size, len(self.said))
        return bytes(self.said[start : self._read])
