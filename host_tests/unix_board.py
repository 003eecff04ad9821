"""A board for tests of what the host does to one: MicroPython's unix port in a folder that is its file system, driven
through mpremote's interface, and able to lose power before any of its commands and any change of its file system."""

import contextlib
import json
import subprocess

from mpremote.transport import Transport, TransportExecError
from upright_host import runtimes, simulate

POWER_CUT, SOFT_RESET = 9, 8  # what the process ends with

# `os` of a board on FAT, where a rename over a file is two steps; `left` steps, then the power fails. None: never.
_OS = """
import os as _os, sys
left, free = %r, %r
def spend():
    global left
    if left is not None:
        if not left:
            sys.exit(9)
        left -= 1
class Os:
    def __getattr__(self, name):
        return getattr(_os, name)
    def there(self, name):
        try:
            return _os.stat(name)
        except OSError:
            return None
    def rename(self, old, new):
        _os.stat(old)
        if self.there(new):
            self.remove(new)
        spend()
        _os.rename(old, new)
    def remove(self, name):
        spend()
        _os.remove(name)
    def rmdir(self, name):
        spend()
        _os.rmdir(name)
    def statvfs(self, path):
        if free is None:
            return _os.statvfs(path)
        used = sum([self.used(name) for name in _os.listdir(".")])
        return (512, 512, 0, free // 512 - used, 0, 0, 0, 0, 0, 255)
    def used(self, path):
        mode, size = _os.stat(path)[0], _os.stat(path)[6]
        if mode & 0x4000:
            return 1 + sum([self.used(path + "/" + name) for name in _os.listdir(path)])
        return (size + 511) // 512
sys.modules["os"] = Os()
"""

# The file system of a board in RAM, in place of the folder
_DISK = """
class Disk:
    def __init__(self, block, blocks):
        self.block, self.blocks, self.data = block, blocks, bytearray(block * blocks)
    def readblocks(self, n, buffer, offset=0):
        at = n * self.block + offset
        buffer[:] = self.data[at : at + len(buffer)]
    def writeblocks(self, n, buffer, offset=0):
        at = n * self.block + offset
        self.data[at : at + len(buffer)] = buffer
    def ioctl(self, op, argument):
        return {4: self.blocks, 5: self.block}.get(op, 0)
kind, block, blocks = %r
disk = Disk(block, blocks)
kind = getattr(_os, kind)
kind.mkfs(disk)
_os.mount(kind(disk), "/flash")
_os.chdir("/flash")
sys.path[:] = ["", ".frozen", "/flash/lib"]
"""

# Runs a line of JSON (the code) in one namespace; the answer: a line of JSON [output, error or null]
_SERVER = """
import builtins, json, io
space = {}
def show(*values, end="\\n", sep=" "):
    out.append(sep.join([str(v) for v in values]) + end)
builtins.print = show  # modules print as well
sys.path.append("lib")
while True:
    line = sys.stdin.readline()
    if not line:
        break
    spend()
    out = []
    error = None
    try:
        exec(json.loads(line), space)
    except Exception as e:
        text = io.StringIO()
        sys.print_exception(e, text)
        error = text.getvalue()
    sys.stdout.write(json.dumps(["".join(out), error]) + "\\n")
"""

_BOOT = """
class Machine:
    @staticmethod
    def soft_reset():
        sys.exit(8)
sys.modules["machine"] = Machine
sys.path.append("lib")
for name in ("boot.py", "main.py"):
    try:
        with open(name) as file:
            text = file.read()
    except OSError:
        continue
    exec(text, {"__name__": "__main__"})
"""


class PowerCut(Exception):
    """The board lost its power (and its program) as the test wanted it."""


class UnixBoard(Transport):
    """folder: its file system. left: how many steps it still carries out; None: all. free: bytes of its file system,
    in blocks of 512; None: many. disk: the file system ("VfsFat", bytes of a block, blocks), empty, in its place."""

    def __init__(self, folder, left=None, free=None, disk=None):
        start, _ = runtimes.interpreter(simulate.best_runtime())
        self._process = subprocess.Popen(
            [
                *start,
                *("-X", "heapsize=8M"),
                "-c",
                _OS % (left, free) + (_DISK.replace("%r", repr(disk)) if disk else "") + _SERVER,
            ],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def exec(self, command, data_consumer=None):
        command = command.decode() if isinstance(command, bytes) else command
        try:
            self._process.stdin.write(json.dumps(command) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self.close()
            raise PowerCut from None
        answer = self._process.stdout.readline()
        if not answer:
            self.close()
            raise PowerCut
        output, error = json.loads(answer)
        if error:
            raise TransportExecError(1, error)
        if data_consumer:
            data_consumer(output.encode())
        return output.encode()

    def eval(self, expression, parse=True):
        import ast

        text = self.exec(f"print(repr({expression}))").decode().strip()
        return ast.literal_eval(text) if parse else text.encode()

    def close(self):
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


def boot(folder, left=None, then=""):
    """Boot the board: boot.py, main.py, and `then` at its prompt -> subprocess.CompletedProcess."""
    start, _ = runtimes.interpreter(simulate.best_runtime())
    code = _OS % (left, None) + _BOOT + then
    while True:
        done = subprocess.run([*start, "-c", code], cwd=folder, capture_output=True, text=True)
        if done.returncode != SOFT_RESET:
            return done
