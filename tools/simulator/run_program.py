# Runs a user's program on a simulated board: its chips are on its buses, level and at rest, with a sensor's noise.
# Run by `upright exec` and the tests on every runtime. Arguments: the board's folder in boards/, the simulated seconds
# after which it ends (- for never), the program, and what it is to find in sys.argv[1:].

import sys
import time

import kernel
import machine
import simulated_time
from world import NoisyWorld

import boards

_EPIPE = 32
_US_PER_CHARACTER = 87  # a serial line at 115200 baud


def slow_print(*values, sep=" ", end="\n", **more):
    """print, which takes its time on a board too; a loop that only prints would otherwise stand still in time."""
    text = sep.join([str(value) for value in values]) + end
    print(text, end="", **more)
    kernel.sleep_us(_US_PER_CHARACTER * len(text))


def simulate_time():
    """The rest of CPython's `time` too: the process runs nothing but the program."""
    for name in ("sleep", "time", "time_ns"):
        if getattr(time, name) is not getattr(simulated_time, name):
            setattr(time, name, getattr(simulated_time, name))


def main():
    name, seconds, path = sys.argv[1:4]
    machine.power_on()
    world = NoisyWorld()
    world.start(0)
    try:
        import board
    except ImportError:  # a program with objects of its own needs none
        board = None
    boards.wire(name, board, world, {})
    simulate_time()
    if seconds != "-":
        kernel.stop_at(int(float(seconds) * 1000000))
    sys.argv[:] = sys.argv[3:]
    # what lies beside it, as a board's root would hold it
    sys.path.insert(0, path.rsplit("/", 1)[0])
    with open(path) as file:
        code = compile(file.read(), path, "exec")
    try:
        exec(code, {"__name__": "__main__", "__file__": path, "print": slow_print})
    except kernel.PowerOff:
        pass
    except KeyboardInterrupt:
        sys.exit(130)
    except OSError as why:
        if why.args[0] != _EPIPE:  # whoever read what it printed has gone
            raise


main()
