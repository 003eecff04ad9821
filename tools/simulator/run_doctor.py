# The doctor's report on a simulated board at rest. Run by `upright doctor --simulated` and the tests. Argument: a JSON
# file: board_name, and what of its parts is missing (imu, mag, display: false) or another one (who_am_i).

import json
import sys

import kernel
import machine
from world import LEVEL, StillWorld

import boards


class Port:
    """The port that a board is for, as timing.py asks sys for it."""

    def __init__(self, platform):
        self.platform = platform


def main():
    with open(sys.argv[1]) as file:
        config = json.load(file)
    machine.power_on()
    world = StillWorld(LEVEL)
    world.start(0)
    kernel.advance(200000)  # so long do the chips take after power-up

    import board

    boards.wire(config.get("board_name", "sim"), board, world, config)

    from upright import timing
    from upright_app import doctor

    timing.sys = Port(getattr(board, "PLATFORM", sys.platform))
    problems = doctor.report(board)
    print("\tresult", json.dumps({"problems": problems}))


main()
