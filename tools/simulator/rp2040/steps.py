"""What the tick on the emulated board leaves behind at each step, read out of the board's memory without its noticing;
and recorded samples replayed through it.
"""

import ast
import re
from array import array

from rp2040.board import Board, BoardError

# The words of the tick's state (lib/upright/tick.py) that are looked at. The newest set is that of the lowest bit of
# the first word.
_SEQUENCE, _STEPS, _SETS, _SET_WORDS = 0, 3, 6, 15
_SET_STEPS = 5  # of a set, whose first words are the quaternion
# Run on the board behind the making of a Tick: where its words are
TELL_PLACES = """
import uctypes

def tell_places(tick):
    words = (tick._state, tick._counts, tick._filter.state)
    print("words at", [(uctypes.addressof(w), len(w)) for w in words])
"""
# Behind board.py: the application's own tick says it
TELL = (
    TELL_PLACES
    + """
from upright import tick

def _tell(self, *args, **named):
    _made(self, *args, **named)
    tell_places(self)

_made, tick.Tick.__init__ = tick.Tick.__init__, _tell
"""
)


class Steps:
    """The history of a tick whose first act is to address the IMU: each step is noted as the next one begins.

    history      of each step: (its number from 1, row of the world that its sample was, counts, quaternion w x y z Q29)
    first_state  the filter's state, a copy of the whole array, before the first step that was seen
    """

    def __init__(self, board, bus, imu, world):
        self._board = board
        self._bus = bus
        self._imu = imu
        self._world = world
        self._places = None
        self._row = 0
        self.history = []
        self.first_state = None

    def begin(self):
        """From now on; the board has said where the words are."""
        said = re.findall(r"words at (\[.*?\])", self._board.console)[-1]
        self._places = ast.literal_eval(said)
        self._row = self._world.index_at(self._imu.sample_us)
        self._bus.on_start.append(self._begins)

    def end(self):
        """No further step is looked at."""
        self._bus.on_start.remove(self._begins)

    def words(self, which, kind="i"):
        """0: the tick's state, 1: the counts (kind "h"), 2: the filter's state, as they are now."""
        at, n = self._places[which]
        return array(kind, self._board.peek(at, n * array(kind).itemsize))

    def _begins(self, now, address, read):
        if address == self._imu.address and not read:
            self.look()
            self._row = self._world.index_at(self._imu.sample_us)

    def look(self):
        """Note the newest step, unless it is being written."""
        state = self.words(0)
        if self.first_state is None:
            self.first_state = self.words(2)
        newest = state[_SETS + _SET_WORDS * (state[_SEQUENCE] & 1) :][:_SET_WORDS]
        number = newest[_SET_STEPS]
        complete = state[_STEPS] == number
        if number and complete and (not self.history or self.history[-1][0] != number):
            step = (number, self._row, self.words(1, "h"), list(newest[:4]))
            self.history.append(step)


# As run_replay.py of tools/simulator does it
_SENSOR = (
    TELL_PLACES
    + """
import time
import board
from upright import filters
from upright import tick
from machine import Pin
imu = board.sensor()
imu.configure(accel_range_g=%(accel_range_g)d, gyro_range_dps=%(gyro_range_dps)d)
imu.configure_interrupt()
filter = filters.make(%(filter)r, %(rate)r, imu, %(gains)r)
calibrated, counts, wanted = None, imu.counts, 1
"""
)
_MAGNETOMETER = """
from upright import calibration
from upright.auxiliary_bus import AuxiliaryBus
from upright.ist8310 import IST8310
mag = IST8310(AuxiliaryBus(imu))
mag.configure(rate_hz=160, sample_rate=%(rate)r)
calibrated = calibration.Calibration(("x", "y", "z"), %(mag_axes)r, imu.accel_lsb_per_g, imu.gyro_scale)
counts, wanted = calibrated.counts, 3
"""
_TICK = """
for _ in range(40):
    time.sleep_ms(1)
    flags = imu.read()
    if calibrated:
        calibrated.apply(imu.counts)
    if flags & wanted == wanted:
        break
filter.seed(counts)
tick = tick.Tick(
    imu, filter, %(period_us)d, phase_gain_shift=tick.PHASE_GAIN_SHIFT_CHIP, calibration=calibrated
)
tell_places(tick)
"""
_GYRO_RANGES = {(131, 1): 250, (131, 2): 500, (164, 5): 1000, (82, 5): 2000}


def replay(
    image, files, chip, filter="mahony6", rows=None, gains=None, on_progress=None, mag_axes=None
):
    """Recorded samples through the chip's registers, the driver, and the tick in the data-ready line's hard interrupt.

    files     the project on a board without main.py
    chip      an IMU's model that answers on I2C; its world is a recorded trial (clocked), whose row k is chip sample k
    mag_axes  MAG_AXES of the IST8310 on its auxiliary bus; None: there is none
    -> (quaternions Q29, one list of four a row; what went wrong, by name). The same numbers as run_replay.py's.
    """
    world = chip.world
    rows = world.n if rows is None else min(rows, world.n)
    num, den = world.rate
    board = Board(image, files)
    bus = board.i2c(0, sda=4, scl=5)
    bus.add(chip)
    board.data_ready(6, chip)
    steps = Steps(board, bus, chip, world)
    board.boot()
    settings = {
        "accel_range_g": 32768 // world.accel_lsb_per_g,
        "gyro_range_dps": _GYRO_RANGES[tuple(world.gyro_scale)],
        "filter": filter,
        "rate": (num, den),
        "gains": gains or {},
        "period_us": (2000000 * den + num) // (2 * num),
        "mag_axes": mag_axes,
    }
    parts = (_SENSOR, _MAGNETOMETER, _TICK) if mag_axes else (_SENSOR, _TICK)
    board.exec("".join(parts) % settings)
    steps.begin()
    board.start(world, 20_000)  # until then the interrupt has to be set
    board.exec("Pin(6, Pin.IN).irq(tick.on_sample, trigger=Pin.IRQ_RISING, hard=True)")
    if board.now_us >= world.start_us:
        raise BoardError("the trial began before the board was ready for it")
    while len(steps.history) < rows - 1:
        before = len(steps.history)
        board.run(0.1 + 2 * den / num)
        if len(steps.history) == before:
            raise BoardError(f"no further step after {before} of {rows}")
        if on_progress:
            on_progress(min(len(steps.history), rows), rows)
    patience = 40
    while len(steps.history) < rows and patience:  # the last tick, which no other follows
        board.run(den / num / 20)
        patience -= 1
        steps.look()
    steps.end()
    names = ("missed", "crashes", "imu errors", "imu resets", "fresh", "steps")
    counters = board.eval(
        "(tick.missed, tick.crashes, imu.errors, imu.resets, tick.fresh, tick.steps)"
    )
    faults = dict(zip(names, counters, strict=True))
    faults["stale"] = faults.pop("steps") - faults.pop("fresh")
    faults["cuts"] = bus.cuts
    faults["missing"] = rows - len(steps.history[:rows])
    return [step[3] for step in steps.history[:rows]], faults
