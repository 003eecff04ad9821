# AHRS: sensor, calibration, filter and tick as one object that a program holds; attitude and heading in degrees.
# Needs bias.py, black_box.py, calibration.py, filters.py and the module of its filter, reading.py, settings.py,
# tick.py, timing.py, trim.py. Every port. Set-up and readings may allocate and use floats; what the tick runs may not.

import time
from array import array

import micropython
from micropython import const

from upright import calibration as calibrations
from upright import filters
from upright import tick as ticks
from upright.bias import Bias
from upright.black_box import BlackBox
from upright.reading import Reading
from upright.settings import DEFAULTS, FIFO_BATCH, Settings, of_board

_RATE_MS = const(1000)  # between two checks of the rate, the bias, the DMP
_LOST_MS = const(300)  # so long without a fresh sample: the sensor is lost
_HEADING_MS = const(300)  # start() waits so long for the first magnetometer sample
_GUARD_HZ = const(50)
_STILL_DPS = const(3)  # at most, for level()
_STILL_G = 0.2
_TRIAL_STEPS = const(16)

# The counters of status() that add up to its `faults`
_FAULTS = (
    "missed crashes step_errors errors resets full_resets fifo_overflows display_errors "
    "magnetometer_errors magnetometer_resets misaligned stalls"
)

running = []  # every AHRS whose tick runs


def stop():
    """Stop every AHRS. After that only the main program uses a bus."""
    for ahrs in list(running):
        ahrs.stop()


def from_board(module, **settings):
    """An AHRS of the sensors and settings of a board's module (docs/new-board.md), not started.

    settings: those of AHRS; they replace the board's.
    """
    options = {
        "magnetometer": getattr(module, "magnetometer", None),
        "timer": getattr(module, "make_tick", None),
        "display": getattr(module, "display", None),
        "data_ready": getattr(module, "data_ready_pin", None),
        "board": getattr(module, "NAME", None),
    }
    if not hasattr(module, "sensor"):
        raise ValueError("board.py has no sensor(), which returns the driver of the IMU")
    found = of_board(module)
    for name in found:
        if name != "MAGNETOMETER":  # the board's own function knows it
            options[name.lower()] = found[name]
    options.update(settings)
    return AHRS(module.sensor(), **options)


class AHRS:
    """The attitude of a sensor, computed step by step in an interrupt, and read in degrees.

    sensor        a driver: MPU6050(i2c), MPU6500(spi, select), ...
    rate          steps per second: int, or (num, den) for num/den Hz
    filter        its name in filters.py; None: inertial9 with a magnetometer, else inertial6
    magnetometer  a driver; a function that takes the sensor's driver and returns one; or what to look for beside the
                  sensor: "auto", or a name as in magnetometers.py
    drive         "timer", "fifo", "data_ready" or "manual"; None: timer where timers are hard, else fifo
    timer         None: the best timer of the port; a timer's number; or a make_tick(rate, callback) as in timing.py
    calibration   the name of the calibration file, see calibration.py; None: no corrections
    display       a driver, or a function that takes display_chunk and returns one. With display_shares_bus it is on the
                  sensor's bus, and the tick sends what its show() has marked as ready
    on_step       called with this object in the tick after each step, for control loops. The rules of a hard interrupt
                  hold for it: it must not allocate or take long. Its exceptions are counted, see status()
    data_ready    for the drive of that name: the pin of the sensor's INT line, or a function that returns it
    board         the board's name; a calibration file of another board is refused
    say           called with a title and short lines when a person has to wait or to do something
    log           called like print with what was found; None: silent

    All other settings of settings.py in lower case: accel_range_g=4, imu_axes=("y", "-x", "z"), euler="zxy", ...

    The constructor touches no bus. start() finds, configures and calibrates the sensor and starts the tick. stop() ends
    it. `with` does both. sensor, magnetometer, calibration, filter, tick, ticker and display may be read.

    A KeyboardInterrupt during the tick does not stop the tick: the next call from the program raises it.
    """

    def __init__(
        self,
        sensor,
        rate=200,
        filter=None,
        magnetometer=None,
        drive=None,
        timer=None,
        calibration=DEFAULTS["CALIBRATION"],
        display=None,
        on_step=None,
        data_ready=None,
        board=None,
        say=None,
        log=print,
        **settings,
    ):
        if callable(sensor) or not hasattr(sensor, "configure"):  # callable: the class itself
            raise TypeError("the sensor is a driver, as in AHRS(MPU6050(i2c)), not %r" % (sensor,))
        if on_step is not None and not callable(on_step):
            raise TypeError("on_step is a function, not %r" % (on_step,))
        given = {"RATE": rate, "FILTER": filter, "DRIVE": drive, "CALIBRATION": calibration}
        if isinstance(magnetometer, str):
            given["MAGNETOMETER"] = magnetometer
        for name in settings:
            given[name.upper()] = settings[name]
        self.settings = Settings(given)
        self.board = board
        self.drive = drive
        self.say = say or _nothing
        self.log = log or _nothing
        self._driver = self.sensor = sensor
        self._magnetometer = magnetometer
        self.magnetometer = None
        self._own_mag = None  # the same, where it is on a bus of its own
        self._data_ready = data_ready
        self._timer = timer
        self._on_step = on_step
        self.display = display(self.settings.DISPLAY_CHUNK) if callable(display) else display
        self._display_found = False
        self._filter_in_sensor = False  # sensor and filter are one object
        self.calibration = None
        self.filter = None
        self.tick = None
        self.ticker = None
        self._guard = None
        self.bias = Bias(self)
        self.black_box = BlackBox(_FAULTS.split())
        self.notes = []  # what start() could not do, in a few words each
        # what is taken from the yaw, and from the yaw with its full turns, millidegrees
        self.yaw_zero = (0, 0)
        self.rate_hz = 0

    # ------------------------------------------------------------------------------------ start and stop

    def start(self):
        """Find, configure and calibrate the sensor, take the attitude from its first sample, start the tick.

        All settings are checked before any chip is touched. Raises ValueError for wrong ones, with what to change, and
        the driver's OSError when the sensor does not answer. A running AHRS is stopped first.
        """
        self.stop()
        settings = self.settings
        axes = 6 if self._magnetometer is None else 9
        settings.check(axes, more=self._wrong_parts())
        neighbours = self._neighbours()
        self.drive = self._choose_drive(neighbours)
        settings.check(axes, self.drive)
        for other in neighbours:
            other._hold()
        try:
            self._set_up(settings.filter_name(axes))
            running.append(self)
            _run_together(neighbours + [self])
            what = self.ticker.what if self.ticker else "calls of step()"
            self.log("tick: %s, every %d us, %s drive" % (what, self.period_us, self.drive))
        except BaseException:
            if self in running:
                running.remove(self)
                self._hold()
            if neighbours:
                _run_together(neighbours)
            raise
        return self

    def stop(self):
        """Stop the tick. The bus belongs to the program again. The last attitude stays."""
        if self not in running:
            return
        self._hold()
        running.remove(self)
        bus = _place(self)[0]
        neighbours = [other for other in running if bus is not None and _place(other)[0] == bus]
        if neighbours:
            _run_together(neighbours)

    def __enter__(self):
        return self if self in running else self.start()

    def __exit__(self, *_):
        self.stop()

    def _neighbours(self):
        """The running AHRS on the same bus. One of the same chip is stopped: an earlier program has left it running."""
        bus, chip = _place(self)
        # a driver without an address takes the only chip of the bus
        search = getattr(getattr(self._driver, "port", None), "searches", False)
        found = []
        for other in list(running):
            if bus is not None and _place(other)[0] == bus:
                if search or _place(other)[1] == chip:
                    other.stop()
                else:
                    found.append(other)
        return found

    def _wrong_parts(self):
        """What cannot be used of the objects and functions that were handed over, a line for each."""
        wrong = []

        def demand(name, part, has, wanted):
            if not all([hasattr(part, method) for method in has.split()]):
                wrong.append("%s is %r, expected %s" % (name, part, wanted))

        mag, timer = self._magnetometer, self._timer
        if mag is not None and not callable(mag) and not isinstance(mag, str):
            demand("magnetometer", mag, "configure own_bus", "a driver or a function")
        if self.display is not None:
            demand("display", self.display, "begin flush_step", "one of upright/ssd1306.py")
        if timer is not None and not callable(timer) and not isinstance(timer, int):
            wrong.append("timer is %r, expected its number or a make_tick()" % (timer,))
        functions = {"say": self.say, "log": self.log}
        for name in functions:
            if functions[name] is not None and not callable(functions[name]):
                wrong.append("%s is %r, expected a function" % (name, functions[name]))
        if self.settings.DRIVE == "data_ready":
            demand("data_ready", self._pin(), "irq", "the pin that INT is on")
        return wrong

    def _pin(self):
        pin = self._data_ready
        return pin() if callable(pin) and not hasattr(pin, "irq") else pin

    def _choose_drive(self, neighbours):
        """Choose the drive, and check its timer: one is made for a moment."""
        settings = self.settings
        drive = settings.DRIVE
        if neighbours:
            first = neighbours[0]
            drive = drive or first.drive
            same = drive == first.drive and drive != "data_ready"
            if drive == "fifo":
                same = same and settings.FIFO_HZ == first.settings.FIFO_HZ
            else:
                same = same and settings.RATE == first.settings.RATE
            if not same:
                raise ValueError(
                    'two sensors on one bus share one tick: the same DRIVE ("timer" or "fifo") and the same RATE'
                )
            return drive
        if drive is None:
            probe = self._make_tick(settings.FIFO_HZ, _nothing)
            probe.stop()
            soft = not probe.hard and settings.filter_name(6) not in filters.HARDWARE
            drive = "fifo" if soft else "timer"
        if drive != "manual":
            rates = {"timer": settings.RATE, "fifo": settings.FIFO_HZ, "data_ready": _GUARD_HZ}
            self._make_tick(rates[drive], _nothing).stop()
        return drive

    def _make_tick(self, rate, callback):
        if callable(self._timer):
            ticker = self._timer(rate, callback)
            if not hasattr(ticker, "what"):
                raise ValueError("make_tick() returned %r, expected a Ticker" % (ticker,))
            return ticker
        from upright import timing

        return timing.make_tick(rate, callback, self._timer)

    def _hold(self):
        if self.tick is not None:
            self.tick.hold()
        for name in ("ticker", "_guard"):
            ticker = getattr(self, name)
            if ticker is not None:
                ticker.stop()
                setattr(self, name, None)

    # ------------------------------------------------------------------------------------ set-up

    def _set_up(self, name):
        settings = self.settings
        self.notes = []
        self.bias.known = False
        self._filter_name = name
        self._filter_in_sensor = name in filters.HARDWARE
        self._open_display()
        self.say("Upright", self.board or "", "looking for", "the sensor")
        self._open_sensor()
        sensor = self.sensor
        # every packet or data-ready edge is one step, so the chip's rate is the rate
        chips_rate = self.drive in ("fifo", "data_ready") and not settings.EXTERNAL_CLOCK
        self.rate = rate = sensor.sample_rate if chips_rate else settings.RATE
        num, den = rate
        self.period_us = (2000000 * den + num) // (2 * num)
        self.rate_hz = (2 * num + den) // (2 * den)  # until the first second has been counted
        self.magnetometer = self._own_mag = None
        if not self._filter_in_sensor:
            self._open_magnetometer()
        self._load_calibration()
        if self._filter_in_sensor:
            self.filter = sensor
            self.bias.known = True  # the sensor corrects it itself
        else:
            self.filter = filters.make(name, rate, sensor, settings.GAINS)
            if self.filter.AXES == 9 and self.magnetometer is None:
                self.log("filter: %s without a magnetometer: it has no heading" % name)
            self.bias.find()
            self._seed()
        self._make_step()
        now = time.ticks_ms()
        self._looked_at = self._fresh_at = self._mag_at = now
        self._steps = self._last_fresh = self._last_mag = 0

    def _open_display(self):
        if self.display is None or self._display_found:
            return
        try:
            self.display.begin()
            self._display_found = True
        except OSError as why:
            # the attitude is useful without a display, which may still appear
            self.log("display:", why)

    def _open_sensor(self):
        settings = self.settings
        self.sensor = sensor = self._driver
        if self._filter_in_sensor:
            self.sensor = sensor = filters.make_hardware(self._filter_name, sensor, settings)
            sensor.configure()
            self.log("dmp: image %s, %d bytes" % (sensor.version, sensor.image.size))
        else:
            # SENSOR_RATE_HZ is for the timer drive, and for a chip whose clock is not its own
            own_rate = self.drive in ("timer", "manual") or settings.EXTERNAL_CLOCK
            faster = settings.SENSOR_RATE_HZ if own_rate else None
            sensor.configure(
                accel_range_g=settings.ACCEL_RANGE_G,
                gyro_range_dps=settings.GYRO_RANGE_DPS,
                dlpf=settings.DLPF,
                sample_rate_hz=faster or settings.RATE,
            )
        self.log(
            "sensor: %s, %d/%d Hz, +-%d g, +-%d deg/s"
            % ((sensor.chip,) + sensor.sample_rate + (sensor.accel_range_g, sensor.gyro_range_dps)),
            *sensor.remarks,
        )

    def _open_magnetometer(self):
        """Configure the magnetometer. Until it answers, the attitude comes from six axes."""
        mag = self._magnetometer
        if mag is None:
            return
        sensor, settings = self.sensor, self.settings
        try:
            if isinstance(mag, str):
                find = __import__("upright.magnetometers", None, None, ("find",)).find
                mag = find(sensor, mag)
            elif callable(mag):
                mag = mag(sensor)
        except OSError as why:
            self.log("magnetometer:", why)
            self.notes.append("no magnetometer")
            return
        if not hasattr(mag, "own_bus"):
            raise ValueError("magnetometer() returned %r, expected a driver" % (mag,))
        self.magnetometer = mag
        self._own_mag = mag if mag.own_bus else None
        rate = settings.RATE if settings.EXTERNAL_CLOCK else sensor.sample_rate
        if self._own_mag is not None:  # it is read by each step, with the FIFO by each tick
            rate = (settings.FIFO_HZ, 1) if self.drive == "fifo" else self.rate
            self._mag_us = 1000000 * rate[1] // rate[0]
            self._mag_due = time.ticks_us()
        elif self.drive == "timer" and rate != settings.RATE:
            raise ValueError(
                "each magnetometer sample comes with one of the IMU's, so all of these must be read: "
                "set SENSOR_RATE_HZ to RATE"
            )
        try:
            mag.configure(rate_hz=settings.MAG_RATE_HZ, sample_rate=rate)
            self.log("magnetometer: %s, %d/%d Hz" % ((mag.chip,) + mag.sample_rate))
        except OSError as why:
            self.log("magnetometer:", why)
            self.notes.append("no magnetometer")
            mag.attach()  # if it answers later, the tick finds it and sets it up

    def _load_calibration(self):
        sensor, settings = self.sensor, self.settings
        self.calibration = calibrations.Calibration(
            settings.IMU_AXES, settings.MAG_AXES, sensor.accel_lsb_per_g, sensor.gyro_scale
        )
        if settings.CALIBRATION is None:
            return
        try:
            self.calibration.load(settings.CALIBRATION, sensor.chip, self.board)
            self.log("calibration:", settings.CALIBRATION)
        except calibrations.CalibrationError as why:
            if why.kind == "missing":
                self.log("calibration: none yet (%s); that is fine" % settings.CALIBRATION)
            else:
                self.log("calibration: %s; going on without" % why)
            self.notes.append(why.title)

    @property
    def counts(self):
        """The newest sample as the filter gets it: calibrated, in the body frame."""
        return self.sensor.counts if self.calibration.identity else self.calibration.counts

    def sample(self):
        """Read a sample while the tick is stopped. Returns its flags."""
        flags = self.sensor.read()
        if self._own_mag is not None:
            now = time.ticks_us()
            if time.ticks_diff(now, self._mag_due) >= 0:  # it counts on the rate of the steps
                self._mag_due = time.ticks_add(now, self._mag_us)
                flags = self._own_mag.read(self.sensor.counts)
        if not self.calibration.identity:
            self.calibration.apply(self.sensor.counts)
        return flags

    def _seed(self):
        """Take the attitude from a first sample, with the heading if a magnetometer has one. Without a sample it starts
        level, and the tick's feedback corrects it."""
        start = time.ticks_ms()
        passed = 0
        read_us = None
        while passed < 2 * _HEADING_MS:
            began = time.ticks_us()
            flags = self.sample()
            took = time.ticks_diff(time.ticks_us(), began)
            read_us = took if read_us is None else min(took, read_us)
            passed = time.ticks_diff(time.ticks_ms(), start)
            # only one in several samples has the magnetometer's: read them all
            ready = self.magnetometer is None or self.filter.AXES < 9 or flags & 2
            ready = ready or passed > _HEADING_MS
            # an axis at full scale is no gravity
            if flags & 5 == 1 and ready and self.filter.seed(self.counts):
                self._demand_time(read_us)
                return
            time.sleep_us(100)
        self.log("seed: no usable accelerometer sample, starting level")

    def _demand_time(self, read_us):
        """Raise ValueError if a step is longer than its period: read_us on the bus, and the filter, timed on a twin."""
        twin = filters.make(self._filter_name, self.rate, self.sensor, self.settings.GAINS)
        best = None
        for _ in range(2):
            began = time.ticks_us()
            for _ in range(_TRIAL_STEPS):
                twin.update(self.counts)
            took = time.ticks_diff(time.ticks_us(), began) // _TRIAL_STEPS
            best = took if best is None else min(took, best)
        step_us = read_us + best
        if step_us > self.period_us:
            raise ValueError(
                "a step takes %d us (%d of them the bus), RATE leaves %d: RATE %d at most, a faster bus or a "
                "lighter filter" % (step_us, read_us, self.period_us, 1000000 // step_us)
            )

    def _make_step(self):
        display = self.display if self.settings.DISPLAY_SHARES_BUS else None
        self.tick = tick = ticks.Tick(
            self.sensor,
            self.filter,
            0 if self.drive == "fifo" else self.period_us,
            display,
            self.settings.DISPLAY_CHUNK,
            ticks.PHASE_GAIN_SHIFT_CHIP
            if self.drive == "data_ready"
            else ticks.PHASE_GAIN_SHIFT_TIMER,
            None if self.calibration.identity else self.calibration,
            self._own_mag,
            self._on_step,
            self,
            self.black_box,
        )
        self.black_box.watch(self._counters())
        tick.seeded()
        if display is not None and self._display_found:
            while display.busy:  # from here on the tick owns the bus
                display.flush_step(self.settings.DISPLAY_CHUNK)
        if self.drive == "fifo":
            self.sensor.fifo_enable(FIFO_BATCH)
        elif self.drive == "data_ready":
            self.sensor.configure_interrupt()

    def _counters(self):
        """Where each counter of faults is: {name: (object, attribute)}."""
        found = {
            name: (self.sensor, name) for name in _FAULTS.split() if hasattr(self.sensor, name)
        }
        for name in ("missed", "crashes", "step_errors"):
            found[name] = (self.tick, name)
        for part, name in ((self.display, "display"), (self.magnetometer, "magnetometer")):
            for attribute in ("errors", "resets"):
                if hasattr(part, attribute):
                    found[name + "_" + attribute] = (part, attribute)
        return found

    # ------------------------------------------------------------------------------------ for programs

    def angles(self, order=None):
        """(roll, pitch, yaw) of the newest step in degrees; order: "zyx" or "zxy", None: the setting EULER."""
        return self.reading().angles(order)

    def quaternion(self):
        """(w, x, y, z): turns body vectors into the earth frame (x north, y west, z up)."""
        return self.reading().quaternion()

    def rates(self):
        """Angular rates about body x, y, z in deg/s, without the gyro's bias."""
        return self.reading().rates()

    def acceleration(self):
        """What the accelerometer measures along body x, y, z in g."""
        return self.reading().acceleration()

    def linear_acceleration(self, frame="body"):
        """The same without gravity; frame: "body" or "earth"."""
        return self.reading().linear_acceleration(frame)

    def heading(self):
        """Degrees clockwise from true north, 0..360; None with six axes or no magnetometer."""
        return self.reading().heading()

    def turns(self):
        """The yaw with its full turns, in turns to the left."""
        return self.reading().turns()

    def temperature(self):
        """Temperature of the sensor chip in degC."""
        return self.reading().temperature()

    def reading(self):
        """A Reading: all of the above, of one step."""
        self._attend()
        return Reading(self)

    def wait(self, timeout_ms=1000):
        """Wait for the next step; returns its Reading. Raises OSError when none comes."""
        steps = self._attend()
        start = time.ticks_ms()
        while self.tick.steps == steps:
            if time.ticks_diff(time.ticks_ms(), start) > timeout_ms:
                raise OSError("no step for %d ms: %s" % (timeout_ms, self._why()))
            time.sleep_us(200)
        return self.reading()

    async def next(self, timeout_ms=1000):
        """The same for asyncio: `reading = await imu.next()`."""
        import asyncio

        steps = self._attend()
        start = time.ticks_ms()
        while self.tick.steps == steps:
            if time.ticks_diff(time.ticks_ms(), start) > timeout_ms:
                raise OSError("no step for %d ms: %s" % (timeout_ms, self._why()))
            await asyncio.sleep_ms(1)
        return self.reading()

    def step(self):
        """Do one step, with the manual drive: call it once a period. The filter coasts through late calls."""
        if self.drive != "manual" or self not in running:
            raise RuntimeError('step() is for the "manual" drive, and started')
        self.tick.on_sample(None)
        self._attend()

    def zero_yaw(self):
        """Count the yaw from the present direction. heading() stays relative to north."""
        reading = self.reading()
        self.yaw_zero = (0, 0)
        yaw = reading.unwrapped_mdeg()
        self.yaw_zero = ((yaw + 180000) % 360000 - 180000, yaw)

    def level(self, save=True):
        """Make the present position level: the trim of a tilted mounting, up to 45 degrees. `save` stores it in the
        calibration file. Hold the body at rest: the tick is stopped meanwhile, and the filter settles anew.

        Raises ValueError while the body moves, without samples, and for more tilt.
        """
        if self._filter_in_sensor:
            raise ValueError(
                "the DMP's attitude cannot be trimmed: use IMU_AXES, or another filter"
            )
        reading = self.reading()
        if self.status()["sensor_lost"] and not reading.flags & 1:
            raise ValueError("level() needs samples, and the sensor gives none")
        moves = max([abs(rate) for rate in reading.rates()]) > _STILL_DPS
        # and the filter has settled: what it calls down is where gravity is, as far as a sensor's offsets go
        if moves or max([abs(a) for a in reading.linear_acceleration()]) > _STILL_G:
            raise ValueError("level() is for a body at rest: hold it still")
        together = [other for other in running if other.ticker is self.ticker]
        for other in together:
            other._hold()
        try:
            from upright import trim

            trim.level(self.filter, self.calibration)
            self.tick.calibrate(self.calibration)
            self.calibration.apply(self.sensor.counts)
            self.tick.seeded()
            if save and self.settings.CALIBRATION is not None:
                path = self.settings.CALIBRATION
                self.calibration.save_level(path, self.sensor.chip, self.board)
        finally:
            if self in running:
                _run_together(together)

    def status(self):
        """A dict of names, flags and counters; docs/face.md explains each."""
        self._attend()
        sensor, mag, tick, filter = self.sensor, self.magnetometer, self.tick, self.filter
        doubt = getattr(filter, "heading_uncertainty_mdeg", None)
        lost = time.ticks_diff(time.ticks_ms(), self._fresh_at) >= _LOST_MS
        mag_lost = mag is None or time.ticks_diff(time.ticks_ms(), self._mag_at) >= _LOST_MS
        bias = array("i", [0] * 3)
        filter.bias_mdps(bias)
        found = {
            "running": self in running,
            "drive": self.drive,
            "timer": self.ticker.what if self.ticker else None,
            "sensor": sensor.chip,
            "magnetometer": mag.chip if mag else None,
            "filter": filter.NAME,
            "rate_hz": self.rate_hz,
            "steps": tick.steps,
            "fresh": tick.fresh,
            "sensor_lost": lost,
            "magnetometer_lost": filter.AXES == 9 and mag_lost,
            "bias_known": self.bias.known,
            "bias_dps": tuple([b / 1000 for b in bias]),
            "at_rest": getattr(filter, "resting", None) and not lost,
            "field_accepted": None
            if filter.AXES < 9
            else not mag_lost and getattr(filter, "mag_accepted", True),
            "heading_uncertainty": None if doubt is None else doubt / 1000,
            "clipped": getattr(filter, "clipped", None),
            "missed": tick.missed,
            "crashes": tick.crashes,
            "error": tick.error,
            "step_errors": tick.step_errors,
            "step_error": tick.step_error,
            "errors": sensor.errors,
            "resets": sensor.resets,
            "full_resets": getattr(sensor, "full_resets", 0),
            "fifo_overflows": sensor.fifo_overflows,
            "display_errors": self.display.errors if self.display else 0,
        }
        if mag is not None:
            found["magnetometer_errors"] = mag.errors
            found["magnetometer_resets"] = mag.resets
        if self._filter_in_sensor:
            found["misaligned"] = sensor.misaligned
            found["stalls"] = sensor.stalls
        found["faults"] = sum([found[name] for name in _FAULTS.split() if name in found])
        return found

    def faults(self):
        """The last 32 faults, oldest first, also of former starts: a list of (counter of status(), how many, seconds
        since the first of them, seconds since the last)."""
        self.black_box.look()
        return self.black_box.entries()

    def refresh_display(self):
        """Send a chunk to a display on its own bus, from the main loop as often as possible. Returns whether more is
        left; False without a display."""
        self._attend()
        display = self.display
        if display is None:
            return False
        if display.busy and not self.settings.DISPLAY_SHARES_BUS:
            display.flush_step(self.settings.DISPLAY_CHUNK)
        return display.busy

    def _attend(self):
        """Every call from the program does this: it raises an interrupt that came during the tick, measures the rate,
        and checks bias and DMP now and then. Returns the number of steps."""
        tick = self._started()
        if tick.interrupt is not None:
            interrupt, tick.interrupt = tick.interrupt, None
            raise interrupt
        now = time.ticks_ms()
        if tick.fresh != self._last_fresh:
            self._last_fresh = tick.fresh
            self._fresh_at = now
        mag = self.magnetometer
        if mag is not None and mag.fresh != self._last_mag:
            self._last_mag = mag.fresh
            self._mag_at = now
        passed = time.ticks_diff(now, self._looked_at)
        if passed >= _RATE_MS and self in running:
            self._looked_at = now
            steps = tick.steps
            self.rate_hz = ((steps - self._steps) * 1000 + passed // 2) // passed
            self._steps = steps
            if (
                self.settings.KEEP_BIAS
                and self.settings.CALIBRATION
                and hasattr(self.filter, "resting")
            ):
                self.bias.keep((passed + 500) // 1000)
            self.black_box.look()  # the display's and the magnetometer's; all others the tick notes at once
            if self._filter_in_sensor and self.sensor.needs_reload:
                self._reload()
        return tick.steps

    def _reload(self):
        """Load the DMP's program again. It takes the bus for most of a second, so the tick is stopped."""
        together = [other for other in running if other.ticker is self.ticker]
        for other in together:
            other._hold()
        try:
            self.sensor.reload()
            self.log("dmp: loaded again")
        except OSError as why:
            self.log("dmp:", why)
        _run_together(together)

    def _why(self):
        if self not in running:
            return "it is stopped"
        if self.drive == "manual":
            return "the program calls step()"
        return (
            "the data-ready line is silent" if self.drive == "data_ready" else "the timer is silent"
        )

    # ------------------------------------------------------------------------------------ for interrupts too
    # On every core, from a hard interrupt or from on_step: nothing below allocates, waits or uses a float. They answer
    # False when the tick left no whole step within 100 tries; then `out` is not to be used. Before start() they raise
    # RuntimeError.

    @micropython.native
    def snapshot(self, out):
        """Copy the newest step as integers into out, array('i') of tick.SNAPSHOT_WORDS; tick.py names the words."""
        return self._started().snapshot(out)

    @micropython.native
    def angles_into(self, out):
        """Roll, pitch, yaw in millidegrees into out, array('i') of 3, in the order of the setting EULER."""
        whole = self._started().angles_into(out, self.settings.EULER)
        zero = self.yaw_zero[0]
        if zero != 0:
            out[2] = (out[2] - zero + 180000) % 360000 - 180000
        return whole

    @micropython.native
    def rates_into(self, out):
        """Angular rates about body x, y, z, without the bias, in millidegrees/s into out, array('i') of 3."""
        return self._started().rates_into(out)

    @micropython.native
    def _started(self):
        tick = self.tick
        if tick is None:
            raise RuntimeError("not started: start() comes first")
        return tick


# ------------------------------------------------------------------------------------ one tick for one bus


class _Together:
    """The ticks of several sensors on one bus, one after the other."""

    def __init__(self, callbacks):
        self._callbacks = callbacks
        self.on_tick = self._on_tick

    @micropython.native
    def _on_tick(self, source):
        for callback in self._callbacks:
            callback(source)


def _run_together(members):
    """Start the ticks of these AHRS, all on one bus. Their tickers are stopped."""
    first = members[0]
    for member in members:
        member.tick.resume()
    if first.drive == "manual":
        return
    if first.drive == "data_ready":
        from upright import timing

        first.ticker = timing.DataReady(first._pin(), first.tick.on_sample, first.period_us)
        first._guard = first._make_tick(_GUARD_HZ, first.tick.on_guard)
        return
    fifo = first.drive == "fifo"
    callbacks = [member.tick.on_fifo if fifo else member.tick.on_sample for member in members]
    callback = callbacks[0] if len(callbacks) == 1 else _Together(callbacks).on_tick
    ticker = first._make_tick(first.settings.FIFO_HZ if fifo else first.rate, callback)
    for member in members:
        member.ticker = ticker


def _place(ahrs):
    """(bus, chip) of the sensor, as text: a port prints two objects of one bus alike, and those of two buses
    differently.

    (None, None) if the driver does not say.
    """
    registers = getattr(ahrs._driver, "registers", None)
    return [repr(part) for part in registers.place] if hasattr(registers, "place") else (None, None)


def _nothing(*_):
    pass
