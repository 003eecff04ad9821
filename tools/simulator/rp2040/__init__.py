"""An emulated Raspberry Pi Pico: MicroPython's own firmware on an RP2040, with the chip models of the simulator on it.

Needs the packages rp2040py (the emulator, of exactly the version that is mended here) and littlefs-python. Runs under
CPython, in emulated time only: two runs are the same to the cycle. A second of busy code takes ten seconds or more.

    board = Board(image, files)              image: a UF2 file; files: {path: bytes} of its flash
    bus = board.i2c(0, sda=4, scl=5)
    bus.add(MPU6050Chip(world))
    board.boot()
    board.run(seconds=2)
    print(board.console, board.exec("print(1)"))
"""

import rp2040.version  # noqa: F401 (first: it refuses what was not tried)
from rp2040.board import Board, BoardError
from rp2040.cycles import between_marks
from rp2040.files import flash_image
from rp2040.steps import TELL, Steps, replay

__all__ = [
    "TELL",
    "Board",
    "BoardError",
    "Steps",
    "between_marks",
    "flash_image",
    "replay",
]
