# Replays an `.imu` file through a filter and writes the attitude after every sample: 4 int32 (Q29) a row.
# Run by `upright replay` and the tests on every runtime. Argument: a JSON file, see CONFIG.
# Lines on standard output that begin with a tab are for the host: progress and the result.

import json
import sys
from array import array

import kernel
import machine
from upright import calibration, filters
from upright import tick as ticks
from world import World

import boards

CONFIG = {
    "world": "",  # the .imu file
    "filter": "mahony6",
    "gains": {},
    "board_name": "sim",  # the board whose chips it goes through
    "direct": False,  # True: counts straight into the filter; False: chip models, registers, drivers and tick
    "mag": False,  # the rows have magnetometer counts
    "rows": None,  # at most so many samples
    "out": "",
}

_PROGRESS_EVERY = 1000
_FRESH = 1
_FRESH_MAG = 2
_MAG_HZ = 160  # a little less than the IST8310 can measure with its average of 16 (6 ms each)


class Recorder:
    """Writes the attitude of every step, in blocks."""

    def __init__(self, path, filter, rows):
        self._file = open(path, "wb")
        self._filter = filter
        self._q = array("i", [0] * 4)
        self.rows = 0
        self._all = rows

    def add(self):
        self._filter.quaternion(self._q)
        self._file.write(self._q)
        self.rows += 1
        if self.rows % _PROGRESS_EVERY == 0:
            print("\tat", self.rows, self._all)

    def close(self):
        self._file.close()


def _range(allowed, wanted, what):
    for value, scale in allowed:
        if scale == wanted:
            return value
    raise ValueError("no %s range has the scale %r" % (what, wanted))


def through_chip(config, world, rows):
    """Every sample through the chip models' registers, the drivers and the tick, on the data-ready line."""
    machine.power_on()
    import board

    parts = boards.wire(config["board_name"], board, world, {})
    imu = board.sensor()
    gyro = tuple(world.gyro_scale)
    imu.configure(
        accel_range_g=32768 // world.accel_lsb_per_g,
        gyro_range_dps=_range(
            ((250, (131, 1)), (500, (131, 2)), (1000, (164, 5)), (2000, (82, 5))), gyro, "gyro"
        ),
    )
    imu.configure_interrupt()
    num, den = world.rate
    filter = filters.make(config["filter"], world.rate, imu, config["gains"])
    calibrated, counts = None, imu.counts
    if parts.mag:
        mag = board.magnetometer(imu)
        mag.configure(rate_hz=_MAG_HZ, sample_rate=world.rate)
        calibrated = calibration.Calibration(
            board.IMU_AXES, board.MAG_AXES, imu.accel_lsb_per_g, imu.gyro_scale
        )
        counts = calibrated.counts
    wanted = _FRESH | _FRESH_MAG if parts.mag else _FRESH
    flags = 0
    for _ in range(40):  # until it is started the world stands still at row 0
        kernel.advance(1000)
        flags = imu.read()
        if calibrated:
            calibrated.apply(imu.counts)
        if flags & wanted == wanted:
            break
    filter.seed(counts)
    period_us = (2000000 * den + num) // (2 * num)
    tick = ticks.Tick(
        imu, filter, period_us, phase_gain_shift=ticks.PHASE_GAIN_SHIFT_CHIP, calibration=calibrated
    )
    recorder = Recorder(config["out"], filter, rows)

    def after_tick():
        if tick.steps > recorder.rows and recorder.rows < rows:
            recorder.add()

    kernel.after_irq = after_tick
    world.start(kernel.now() + 2000)
    parts.imu.poll(kernel.now())  # from now on the trial is its sample clock
    kernel.changed()
    pin = board.data_ready_pin()
    pin.irq(tick.on_sample, trigger=machine.Pin.IRQ_RISING, hard=True)
    end = kernel.now() + 2000 + world.time_us(rows) + 1000
    while recorder.rows < rows and kernel.now() < end:
        kernel.idle()
    recorder.close()
    result = {
        "rows": recorder.rows,
        "fresh": tick.fresh,
        "missed": tick.missed,
        "crashes": tick.crashes,
        "errors": imu.errors,
        "resets": imu.resets,
        "cuts": parts.buses[0].cuts,
        "uncaught": len(kernel.uncaught),
        "error": repr(tick.error) if tick.error else None,
    }
    if parts.mag:
        result["mag_fresh"] = mag.fresh
        result["mag_errors"] = mag.errors
    return result


class Scales:
    """What a filter wants to know of a sensor."""

    def __init__(self, world):
        self.gyro_scale = tuple(world.gyro_scale)
        self.accel_lsb_per_g = world.accel_lsb_per_g


def straight(config, world, rows):
    """Counts straight into the filter, as the driver would have delivered them."""
    filter = filters.make(config["filter"], world.rate, Scales(world), config["gains"])
    counts = array("h", bytes(22))
    recorder = Recorder(config["out"], filter, rows)
    for k in range(rows):
        world.load(k, counts)
        flags = _FRESH | _FRESH_MAG if config["mag"] else _FRESH
        for i in range(6):
            if counts[i] == 32767 or counts[i] == -32768:
                flags |= 4 if i < 3 else 8
        counts[10] = flags
        if k == 0:
            filter.seed(counts)
        filter.update(counts)
        recorder.add()
    recorder.close()
    return {"rows": rows, "fresh": rows}


def main():
    config = dict(CONFIG)
    with open(sys.argv[1]) as file:
        config.update(json.load(file))
    world = World(config["world"])
    rows = world.n if config["rows"] is None else min(config["rows"], world.n)
    result = (straight if config["direct"] else through_chip)(config, world, rows)
    print("\tresult", json.dumps(result))


main()
