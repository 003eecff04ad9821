"""What steps cost on the emulated Cortex-M0+: the core's cycles between the marks that a program prints."""

from rp2040.board import Board, BoardError

_PIN = 22
# USB would tell of a print some time after it. So a pin changes in its stead, and the texts follow at the end.
_RUN = """
import builtins, sys
from machine import Pin
texts, pin, say = [], Pin(%d, Pin.OUT, value=0), print
def mark(text, end=None):
    texts.append(text)
    pin.toggle()
builtins.print = mark
sys.argv[:] = ["", %r, %r]
import %s
builtins.print = say
for text in texts:
    print(text.strip())
"""


def between_marks(image, files, module, mode, n, seconds=60, on_mark=lambda at: None):
    """Import a module on a board, with (mode, n) as its arguments -> [(text, cycles before it)] of all that it prints
    behind an @, which is left out.

    files    its flash, without main.py
    seconds  emulated, after which it is given up: rp2040.BoardError
    on_mark  called with the number of marks so far
    """
    board = Board(image, files)
    at = []

    def changed(level, us):
        at.append(board.cycles)
        on_mark(len(at))

    board.boot()
    board.exec(f"from machine import Pin\nPin({_PIN}, Pin.OUT, value=0)")
    board.watch(_PIN, 0, changed)
    del at[:]  # the level that it has
    texts = board.exec(_RUN % (_PIN, mode, str(n), module), seconds).splitlines()
    if len(texts) != len(at):
        raise BoardError(f"{len(texts)} marks were printed and {len(at)} seen")
    return [(text[1:], c) for text, c in zip(texts, at, strict=True) if text.startswith("@")]
