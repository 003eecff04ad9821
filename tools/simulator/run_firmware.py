# Boots the firmware (main.py) on the simulated board: chips on its buses, a moving world under them.
# Run by `upright demo` and the tests on every runtime. Argument: a JSON file, see CONFIG.
# Lines on standard output that begin with a tab are for the host; the rest is the board's console.

import json
import sys
from array import array
from binascii import hexlify

import faults
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
    "mag_chip": None,  # another magnetometer, see boards.py
    "dmp_image": None,  # a file that the IMU's DMP runs when it is loaded
    "irq_cost_us": 0,  # what the tick's code takes, beside its bus time
    "twin": None,  # "main_writes_shared_bus": what the firmware must not do, to show that it would be noticed
    "faults": [],  # what goes wrong, and when: faults.py
    "like": "rp2",  # the port whose habits the buses have
    "begin_us": 0,  # what the clock says at the start
    "reset_cause": None,  # of this start; None: power-on
}


class Frames:
    """Shows the host what the display shows, every so often."""

    def __init__(self, chip, every_ms):
        self._chip = chip
        self._every = every_ms * 1000
        self._at = self._start = kernel.now()
        self._last = None

    def due(self):
        return self._at

    def fire(self, now):
        self._at += self._every
        picture = bytes(self._chip.frame())
        if picture != self._last:
            self._last = picture
            print("\tframe", now - self._start, str(hexlify(picture), "ascii"))
        else:
            print("\ttime", now - self._start)


def the_ahrs():
    """The AHRS that the program runs, or None."""
    face = sys.modules.get("upright.ahrs")
    return face.running[0] if face and face.running else None


class Recorder:
    """The attitude after every step, with the row of the world that it belongs to."""

    def __init__(self, path, world, chip):
        self._start = kernel.now()
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
        self._row[6] = kernel.now() - self._start
        self._file.write(self._row)

    def close(self):
        self._file.close()


class Watch:
    """When a flag of status() changes, as the program sees it: changes is a list of [us, name, value]."""

    NAMES = ("sensor_lost", "magnetometer_lost")

    def __init__(self):
        self.changes = []
        self._start = kernel.now()
        self._seen = {}

    def attach(self):
        from upright import ahrs

        status = ahrs.AHRS.status
        watch = self

        def watched(self):
            found = status(self)
            for name in watch.NAMES:
                if found[name] != watch._seen.get(name, False):
                    watch._seen[name] = found[name]
                    watch.changes.append([kernel.now() - watch._start, name, found[name]])
            return found

        ahrs.AHRS.status = watched


def load_board(config):
    import board

    for name, value in config["board"].items():
        setattr(board, name, tuple(value) if isinstance(value, list) else value)
    return board


def forget_modules():
    """A reset empties the RAM."""
    for name in list(sys.modules):
        if name == "board" or name.split(".")[0] in ("upright", "upright_app"):
            del sys.modules[name]


def main():
    config = dict(CONFIG)
    with open(sys.argv[1]) as file:
        config.update(json.load(file))
    machine.power_on(config["reset_cause"] or machine.PWRON_RESET, config["like"])
    if config["begin_us"]:
        kernel.advance(config["begin_us"])
    start = kernel.now()
    world = World(config["world"]) if config["world"] else StillWorld()
    world.start(start)
    parts = boards.wire(config["board_name"], load_board(config), world, config)
    if config["dmp_image"]:
        with open(config["dmp_image"], "rb") as file:
            parts.imu.dmp.images.append(file.read())
    faulty = {"imu": parts.imu, "mag": parts.mag, "display": parts.display, "bus": parts.buses[0]}
    plan = faults.Plan(config["faults"], faulty, start)
    if config["faults"]:
        kernel.add_source(plan)
        plan.guard_disk()
    if config["frame_ms"]:
        kernel.add_source(Frames(parts.display, config["frame_ms"]))
    recorder = Recorder(config["out"], world, parts.imu) if config["out"] else None
    if recorder:
        kernel.after_irq = recorder.after_irq
    kernel.irq_cost_us = config["irq_cost_us"]
    kernel.stop_at(start + int(config["seconds"] * 1000000))
    watch = Watch()
    ends = {"resets": 0, "interrupts": 0}
    fresh = True  # the modules have just been loaded
    while True:
        if fresh:
            prepare(config, plan, watch)
        fresh = False
        program = {"__name__": "__main__"}
        try:
            execute(config["program"], program)
            break
        except kernel.PowerOff:
            break
        except kernel.Reset as reset:
            ends["resets"] += 1
            print("reset, cause", reset.args[0])
            machine.restart(reset.args[0])
            forget_modules()
            load_board(config)
            fresh = True
        except KeyboardInterrupt:
            if not config["faults"]:
                raise
            ends["interrupts"] += 1
            print("KeyboardInterrupt")  # and somebody starts it again at the prompt
    application = program.get("application")
    result = finish(application.imu if application else program.get("imu"), recorder, parts)
    result["ended_us"] = kernel.now() - start
    result["board_resets"] = ends["resets"]
    result["interrupts"] = ends["interrupts"]
    result["changes"] = watch.changes
    print("\tresult", json.dumps(result))


def prepare(config, plan, watch):
    """What a run changes in the firmware, after each reset of the board."""
    if config["twin"] == "main_writes_shared_bus":
        spoil_display_ownership()
    if not config["faults"]:
        return
    watch.attach()
    import upright
    from upright_app import app

    poll = app.App.poll
    from_board = upright.from_board

    def poll_or_hang(self):
        plan.wait()
        poll(self)

    def with_control(**settings):
        return from_board(on_step=plan.on_step, **settings)

    app.App.poll = poll_or_hang
    if any([entry[2] == "raise_in_on_step" for entry in config["faults"]]):
        upright.from_board = with_control


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
        "irqs": kernel.irq_count,
        "cuts": sum([bus.cuts for bus in buses]),
        "bus_bytes": [bus.bytes for bus in buses],
        "display_misuse": parts.display.errors,
        "uncaught": len(kernel.uncaught),
        "longest_tick_us": kernel.longest_irq_us,
        "timeout_us": max([bus.timeout_us for bus in buses]),
        "failed": {str(address): n for bus in buses for address, n in bus.failed.items()},
        "ticks_lost": machine.Timer.dropped + kernel.irqs_lost,
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
        result["period_us"] = (
            1000000 // imu.settings.FIFO_HZ if status["drive"] == "fifo" else imu.period_us
        )
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
    return result


main()
