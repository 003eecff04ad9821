# Boots the firmware (main.py) on the simulated board: chips on its buses, a moving world under them.
# Run by `upright demo` and the tests on every runtime. Argument: a JSON file, see CONFIG.
# Lines on standard output that begin with a tab are for the host; the rest is the board's console.

import json
import sys
from array import array
from binascii import hexlify

import kernel
import machine
from world import StillWorld, World

import boards

CONFIG = {
    "world": None,  # an .imu file; None: at rest for ever
    "board_name": "sim",  # folder in boards/
    "board": {},  # what board.py says otherwise
    "program": "main.py",  # what runs; a program of one's own calls its AHRS `imu`
    "seconds": 10,  # of simulated time
    "frame_ms": 0,  # 0: no pictures; else the display's every so many ms
    "out": None,  # a file for the state after every step, 7 int32: world row, attitude (4, Q29), flags, time in us
    "imu": True,  # False: no sensor on the bus; likewise mag and display
    "mag": True,
    "display": True,
    "who_am_i": None,  # another identity for the IMU
    "dmp_image": None,  # a file that the IMU's DMP runs when it is loaded
    "irq_cost_us": 0,  # what the tick's code takes, beside its bus time
    "twin": None,  # "main_writes_shared_bus": what the firmware must not do, to show that it would be noticed
    "faults": [],  # [at_us, "imu", "mag", "display" or "bus", method, arguments...]: what goes wrong, and when
}


class Faults:
    """Calls a simulated part's method at its time: vanish, come_back, brown_out, nack_next, ..."""

    def __init__(self, faults, parts):
        self._faults = sorted(faults)
        self._parts = parts

    def due(self):
        return self._faults[0][0] if self._faults else None

    def fire(self, now):
        fault = self._faults.pop(0)
        part, method = self._parts[fault[1]], fault[2]
        if method == "stuck":
            part.stuck = fault[3]
        else:
            getattr(part, method)(*fault[3:])


class Frames:
    """Shows the host what the display shows, every so often."""

    def __init__(self, chip, every_ms):
        self._chip = chip
        self._every = every_ms * 1000
        self._at = 0
        self._last = None

    def due(self):
        return self._at

    def fire(self, now):
        self._at += self._every
        picture = bytes(self._chip.frame())
        if picture != self._last:
            self._last = picture
            print("\tframe", now, str(hexlify(picture), "ascii"))
        else:
            print("\ttime", now)


def the_ahrs():
    """The AHRS that the program runs, or None."""
    face = sys.modules.get("upright.ahrs")
    return face.running[0] if face and face.running else None


class Recorder:
    """The attitude after every step, with the row of the world that it belongs to."""

    def __init__(self, path, world, chip):
        self._file = open(path, "wb")
        self._world = world
        self._chip = chip
        self._row = array("i", [0] * 7)
        self._q = array("i", [0] * 4)
        self._steps = 0
        self._mag = 0

    def after_irq(self):
        imu = the_ahrs()
        if imu is None or imu.tick.steps == self._steps:
            return
        self._steps = imu.tick.steps
        imu.filter.quaternion(self._q)
        self._chip.poll(kernel.now())
        self._row[0] = self._world.index_at(self._chip.sample_us)
        for i in range(4):
            self._row[1 + i] = self._q[i]
        flags = imu.counts[10]
        mag = imu.magnetometer
        if mag and mag.fresh != self._mag:
            self._mag = mag.fresh
            flags |= 2  # with the FIFO it may have come with any packet of this tick
        self._row[5] = flags
        self._row[6] = kernel.now()
        self._file.write(self._row)

    def close(self):
        self._file.close()


def main():
    config = dict(CONFIG)
    with open(sys.argv[1]) as file:
        config.update(json.load(file))
    machine.power_on()
    world = World(config["world"]) if config["world"] else StillWorld()
    world.start(0)

    import board

    for name, value in config["board"].items():
        setattr(board, name, tuple(value) if isinstance(value, list) else value)
    parts = boards.wire(config["board_name"], board, world, config)
    if config["dmp_image"]:
        with open(config["dmp_image"], "rb") as file:
            parts.imu.dmp.images.append(file.read())
    bus = parts.buses[0]
    faulty = {"imu": parts.imu, "mag": parts.mag, "display": parts.display, "bus": bus}
    kernel.add_source(Faults(config["faults"], faulty))
    if config["frame_ms"]:
        kernel.add_source(Frames(parts.display, config["frame_ms"]))
    recorder = Recorder(config["out"], world, parts.imu) if config["out"] else None
    if recorder:
        kernel.after_irq = recorder.after_irq
    kernel.irq_cost_us = config["irq_cost_us"]
    kernel.stop_at(int(config["seconds"] * 1000000))
    if config["twin"] == "main_writes_shared_bus":
        spoil_display_ownership()
    program = {"__name__": "__main__"}
    try:
        execute(config["program"], program)
    except kernel.PowerOff:
        pass
    except kernel.Reset as reset:
        print("reset, cause", reset.args[0])
    application = program.get("application")
    finish(application.imu if application else program.get("imu"), recorder, parts)


def spoil_display_ownership():
    """The main program flushes a display that is on the sensor's bus, behind the tick's back."""
    from upright_app import app

    poll = app.App.poll

    def poll_and_flush(self):
        poll(self)
        if self.imu.display.busy:
            self.imu.display.flush_step(self.imu.settings.DISPLAY_CHUNK)

    app.App.poll = poll_and_flush


def execute(name, namespace):
    """Run a file of the board's root, as the interpreter does when it starts, or of another place."""
    for folder in [""] if name.startswith("/") else sys.path:
        try:
            with open(folder + "/" + name if folder else name) as file:
                exec(compile(file.read(), name, "exec"), namespace)
                return
        except OSError:
            pass
    raise OSError("no %s on the path" % name)


def finish(imu, recorder, parts):
    buses = parts.buses
    result = {
        "ended_us": kernel.now(),
        "irqs": kernel.irq_count,
        "cuts": sum([bus.cuts for bus in buses]),
        "bus_bytes": [bus.bytes for bus in buses],
        "display_misuse": parts.display.errors,
        "uncaught": len(kernel.uncaught),
        "heap_checked": sys.implementation.name == "micropython",
        "started": False,
    }
    if imu is not None and imu.tick is not None:
        status = imu.status()
        result["started"] = True
        for name in (
            "steps",
            "fresh",
            "missed",
            "crashes",
            "errors",
            "resets",
            "full_resets",
            "fifo_overflows",
        ):
            result[name] = status[name]
        result["error"] = repr(status["error"]) if status["error"] else None
        result["step_errors"] = status["step_errors"]
        result["step_error"] = repr(status["step_error"]) if status["step_error"] else None
        result["bias_known"] = status["bias_known"]
        angles = array("i", [0] * 3)
        imu.angles_into(angles)
        result["angles_mdeg"] = list(angles)
        result["ticker"] = status["timer"]
        result["drive"] = status["drive"]
        result["faults"] = status["faults"]
        result["display_errors"] = status["display_errors"] if imu.display else None
        result["chip"] = status["sensor"]
        result["filter"] = status["filter"]
        result["axes"] = imu.filter.AXES
        mag = imu.magnetometer
        if mag:
            for name in ("fresh", "stale", "saturated", "errors", "resets"):
                result["mag_" + name] = getattr(mag, name)
    if recorder:
        recorder.close()
    print("\tresult", json.dumps(result))


main()
