"""Runs a program on an emulated board of MicroPython's qemu port, as the unix port would run it.

    run.py FIRMWARE QEMU [ARGUMENT ...] -- [-X OPTION] [-c CODE | SCRIPT [ARGUMENT ...]]

MICROPYPATH and the current folder mean what they mean to the unix port; the status, standard output and standard error
are the program's. The board has no file system: board.py, which goes to its raw prompt first, gives it the host's.
Standard library only; Linux.
"""

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

BOOT = Path(__file__).with_name("board.py")
_BEGIN = b"raw REPL; CTRL-B to exit\r\n>"
_END = b"\x04"  # behind the program's output, and behind that of a board.py that failed
_PROMPT = b"\x04>"


def main(arguments):
    split = arguments.index("--")
    firmware, *emulator = arguments[:split]
    rest = arguments[split + 1 :]
    while rest[:1] == ["-X"]:  # the heap's size is the board's
        rest = rest[2:]
    code = None
    if rest[:1] == ["-c"]:
        code, rest = rest[1], ["-c", *rest[2:]]
    folders = [folder for folder in os.environ.get("MICROPYPATH", "").split(":") if folder]
    folders.insert(0, "" if code else str(Path(rest[0]).parent.absolute()))
    boot = BOOT.read_text("utf-8") + f"\nrun({code!r}, {rest!r}, {folders!r})\n"
    with subprocess.Popen(
        [*emulator, "-kernel", firmware],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        preexec_fn=_end_with_us,
    ) as board:
        try:
            return _talk(board, boot.encode())
        except BaseException:
            board.kill()
            raise


def _end_with_us():
    """A board ends with this process, however that ends: it has no input whose end it would see."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def _talk(board, boot):
    board.stdin.write(b"\x01")
    board.stdin.flush()
    _wait_for(board, _BEGIN)
    board.stdin.write(boot + b"\x04")
    board.stdin.flush()
    _wait_for(board, b"OK")
    said, ended = b"", False
    while not ended:
        piece = os.read(board.stdout.fileno(), 1 << 16)
        said, ended, after = (said + piece).partition(_END)
        # the port writes \r\n for \n; an \r at the end may be half of that
        keep = len(said) - (said.endswith(b"\r") and not ended)
        os.write(1, said[:keep].replace(b"\r\n", b"\n"))
        said = said[keep:]
        if not piece:
            break
    # a program that has ended takes the board with it; when board.py has failed the prompt is back, behind a traceback
    while piece and not after.endswith(_PROMPT):
        piece = os.read(board.stdout.fileno(), 1 << 16)
        after += piece
    if not piece:
        return board.wait()
    board.kill()
    os.write(2, after.removesuffix(_PROMPT).replace(b"\r\n", b"\n"))
    return 1


def _wait_for(board, what):
    said = b""
    while what not in said:
        piece = os.read(board.stdout.fileno(), 1 if what == b"OK" else 4096)
        if not piece:
            raise SystemExit(
                f"the board ended with {board.wait()}: {said.decode(errors='replace')}"
            )
        said += piece


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
