"""A board for tests of what the host does to one: MicroPython's unix port in a folder that is its file system, driven
through mpremote's interface, and able to lose power before any of its actions."""

import json
import subprocess

from mpremote.transport import Transport, TransportExecError
from upright_host import runtimes, simulate

# Runs a line of JSON (the code) in one namespace; the answer: a line of JSON [output, error or null]
_SERVER = """
import json, sys, io
space = {}
def show(*values, end="\\n", sep=" "):
    out.append(sep.join([str(v) for v in values]) + end)
space["print"] = show
while True:
    line = sys.stdin.readline()
    if not line:
        break
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


class PowerCut(Exception):
    """The board lost its power (and its program) as the test wanted it."""


class UnixBoard(Transport):
    """folder: its file system. actions_left: how many commands it still carries out; None: all."""

    def __init__(self, folder, actions_left=None):
        self.actions_left = actions_left
        self.actions = 0
        start, _ = runtimes.interpreter(simulate.best_runtime())
        self._process = subprocess.Popen(
            [*start, "-c", _SERVER],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def exec(self, command, data_consumer=None):
        if self.actions_left is not None and self.actions >= self.actions_left:
            self.close()
            raise PowerCut
        self.actions += 1
        command = command.decode() if isinstance(command, bytes) else command
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
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
