# The application: finds the sensor, measures its bias, starts the tick, and shows what comes out.
# Needs a board (a module as boards/<name>/board.py). Every port.

import time
from array import array

import machine
from micropython import const
from upright import calibration, filters, fixmath
from upright import settings as config
from upright import tick as ticks

from upright_app import bias, pages

_FRAME_MS = const(100)
_RATE_MS = const(1000)
_LOST_MS = const(300)  # without a fresh sample the attitude is only carried on
_RETRY_MS = const(1000)
_HEADING_MS = const(300)  # the first magnetometer sample is waited for as long
_GUARD_HZ = const(50)


class App:
    """One board's application: run() never returns.

    tick, filter, imu, mag, calibration, display, ticker are there once start() is through (mag is None on a board
    without a magnetometer); bias.known says whether the gyro's bias is.
    """

    def __init__(self, board):
        self.board = board
        self.config = config.Config(board)
        self.imu = None
        self.mag = None
        self._own_mag = None  # the same, where it is read by itself and not with the IMU's sample
        self.calibration = None
        self.filter = None
        self._in_chip = False  # sensor and filter are one object
        self.tick = None
        self.ticker = None
        self.guard = None
        self.display = None
        self.bias = bias.Bias(self)
        self.angles = array("i", [0] * 3)  # roll, pitch, yaw in millidegrees
        self.rate_hz = 0
        self._snapshot = array("i", [0] * ticks.SNAPSHOT_WORDS)
        self._bias_mdps = array("i", [0] * 3)
        self._status = array("i", [-1] * pages.STATUS_WORDS)
        self.notes = []  # what start-up could not do, for the display
        self._page = 0
        self._pages = None
        now = time.ticks_ms()
        self._frame_at = self._rate_at = self._page_at = self._fresh_at = self._mag_at = now
        self._rate_steps = 0
        self._last_fresh = self._last_mag = 0
        self._reported = 0

    # ------------------------------------------------------------------------------------ start

    def run(self):
        try:
            self.start()
        except (ValueError, TypeError) as why:
            # a setting that cannot be had: board.py has to change
            self.say("Wrong setting", str(why))
            raise
        while True:
            self.poll()
            machine.idle()

    def start(self):
        board = self.board
        print("upright on", board.NAME)
        self._open_display()
        name = self.config.FILTER
        if name is None:
            name = filters.default(hasattr(board, "magnetometer"))
        filters.check(name)
        self._in_chip = name in filters.HARDWARE
        self.say("Upright", board.NAME, "looking for", "the sensor")
        while not self._open_sensor():
            time.sleep_ms(_RETRY_MS)
        imu = self.imu
        rate = self.config.RATE
        if self.config.DRIVE != "timer" and not self.config.EXTERNAL_CLOCK:
            # every packet or data-ready edge is one step, so the chip's rate is the rate
            rate = imu.sample_rate
        if not self._in_chip:
            self._open_magnetometer()
        self._load_calibration()
        if self._in_chip:
            self.filter = imu
            self.bias.known = True  # it takes care of that itself
        else:
            self.filter = filters.make(name, rate, imu, self.config.GAINS)
            self.bias.find()
            self._seed()
        self._start_tick(rate)
        print(
            "tick: %s, every %d us, %s drive"
            % (self.ticker.what, self._period_us, self.config.DRIVE)
        )

    def _open_display(self):
        try:
            self.display = self.board.display(self.config.DISPLAY_CHUNK)
            if self.display is not None:
                self._pages = pages.Pages(self.display)
                self.display.begin()
        except OSError as why:
            # the attitude is worth having without a display; it may still appear
            print("display:", why)

    def _open_sensor(self):
        board = self.board
        try:
            imu = board.sensor()
            if self._in_chip:
                imu = filters.make_hardware(self.config.FILTER, imu, self.config)
                imu.configure()
                print("dmp: image %s, %d bytes" % (imu.version, imu.image.size))
                return self._found(imu)
            imu.configure(
                accel_range_g=self.config.ACCEL_RANGE_G,
                gyro_range_dps=self.config.GYRO_RANGE_DPS,
                dlpf=self.config.DLPF,
                sample_rate_hz=self.config.SENSOR_RATE_HZ or self.config.RATE,
            )
        except OSError as why:
            print("sensor:", why)
            self.say("No sensor", str(why))
            return False
        return self._found(imu)

    def _found(self, imu):
        print(
            "sensor: %s, %d/%d Hz, +-%d g, +-%d deg/s"
            % ((imu.chip,) + imu.sample_rate + (imu.accel_range_g, imu.gyro_range_dps))
        )
        self.imu = imu
        return True

    def _open_magnetometer(self):
        """The board's magnetometer; without it, or until it answers, the attitude comes from six axes."""
        if not hasattr(self.board, "magnetometer"):
            return
        imu, config = self.imu, self.config
        self.mag = mag = self.board.magnetometer(imu)
        self._own_mag = mag if hasattr(mag, "read") else None
        rate = config.RATE if config.EXTERNAL_CLOCK else imu.sample_rate
        if self._own_mag is None and config.DRIVE == "timer" and rate != config.RATE:
            raise ValueError(
                "the magnetometer's sample comes with one of the IMU's and none may go by unread: "
                "SENSOR_RATE_HZ has to be RATE"
            )
        try:
            mag.configure(rate_hz=config.MAG_RATE_HZ, sample_rate=rate)
            print("magnetometer: %s, %d/%d Hz" % ((mag.chip,) + mag.sample_rate))
        except OSError as why:
            print("magnetometer:", why)
            self.notes.append("no magnetometer")
            mag.attach()  # should it answer yet, the tick finds it and sets it up

    def _load_calibration(self):
        imu, config = self.imu, self.config
        self.calibration = calibration.Calibration(
            config.IMU_AXES, config.MAG_AXES, imu.accel_lsb_per_g, imu.gyro_scale
        )
        try:
            self.calibration.load(config.CALIBRATION, imu.chip, self.board.NAME)
            print("calibration:", config.CALIBRATION)
        except calibration.CalibrationError as why:
            print("calibration: %s; going on with defaults" % why)
            self.notes.append(why.title)

    @property
    def counts(self):
        """The newest sample as the filter gets it: calibrated, in the body's frame."""
        return self.imu.counts if self.calibration.identity else self.calibration.counts

    def sample(self):
        """Read a sample while no tick does -> its flags."""
        flags = self.imu.read()
        if self._own_mag is not None:
            flags = self._own_mag.read(self.imu.counts)
        if not self.calibration.identity:
            self.calibration.apply(self.imu.counts)
        return flags

    def _seed(self):
        """The attitude from a first sample, heading included where a magnetometer has one; from level when none comes
        (the tick's feedback does the rest)."""
        start = time.ticks_ms()
        passed = 0
        while passed < 2 * _HEADING_MS:
            flags = self.sample()
            passed = time.ticks_diff(time.ticks_ms(), start)
            # one sample in several has the magnetometer's: none may go by unread
            ready = self.mag is None or self.filter.AXES < 9 or flags & 2 or passed > _HEADING_MS
            if flags & 1 and ready and self.filter.seed(self.counts):
                return
            time.sleep_us(100)
        print("seed: no usable accelerometer sample, starting level")

    def _start_tick(self, rate):
        board = self.board
        num, den = self.rate = rate
        self.rate_hz = (2 * num + den) // (2 * den)  # until the first second has been counted
        self._rate_at = time.ticks_ms()
        self._period_us = (2000000 * den + num) // (2 * num)
        display = self.display if self.config.DISPLAY_SHARES_BUS else None
        fifo = self.config.DRIVE == "fifo"
        self.tick = tick = ticks.Tick(
            self.imu,
            self.filter,
            0 if fifo else self._period_us,
            display,
            self.config.DISPLAY_CHUNK,
            ticks.FOLLOW_TIMER if self.config.DRIVE == "timer" else ticks.FOLLOW_CHIP,
            None if self.calibration.identity else self.calibration,
            self._own_mag,
        )
        if display is not None:
            self._flush()  # the bus is the tick's from here on
        if self.config.DRIVE == "timer":
            self.ticker = board.make_tick(rate, tick.on_sample)
        elif fifo:
            self.imu.fifo_enable()
            self.ticker = board.make_tick(self.config.FIFO_HZ, tick.on_fifo)
        elif self.config.DRIVE == "data_ready":
            self.imu.configure_interrupt()
            self.ticker = _DataReady(board.data_ready_pin(), tick.on_sample, self._period_us)
            self.guard = board.make_tick(_GUARD_HZ, tick.on_guard)
        else:
            raise ValueError(
                'DRIVE is "timer", "data_ready" or "fifo", not %r' % (self.config.DRIVE,)
            )

    # ------------------------------------------------------------------------------------ main loop

    def poll(self):
        """One turn of the main loop: never waits."""
        now = time.ticks_ms()
        tick = self.tick
        if self.display is not None and not self.config.DISPLAY_SHARES_BUS and self.display.busy:
            self.display.flush_step(self.config.DISPLAY_CHUNK)
        if tick.fresh != self._last_fresh:
            self._last_fresh = tick.fresh
            self._fresh_at = now
        if self.mag is not None and self.mag.fresh != self._last_mag:
            self._last_mag = self.mag.fresh
            self._mag_at = now
        passed = time.ticks_diff(now, self._rate_at)
        if passed >= _RATE_MS:
            self._rate_at = now
            self.rate_hz = ((tick.steps - self._rate_steps) * 1000 + passed // 2) // passed
            self._rate_steps = tick.steps
            self._report()
            if self.config.KEEP_BIAS and hasattr(self.filter, "resting"):
                self.bias.keep()
            if self._in_chip and self.imu.needs_reload:
                self._reload()
        if time.ticks_diff(now, self._frame_at) >= _FRAME_MS:
            self._frame_at = now
            self.update_angles()
            self._draw(now)

    def update_angles(self):
        """The newest attitude into `angles`."""
        if self.tick.snapshot(self._snapshot):
            fixmath.euler(self._snapshot, self.angles, self.config.EULER)

    def _reload(self):
        """The chip has lost its program. To load it takes the bus for most of a second, so the tick has to stop."""
        self.ticker.stop()
        try:
            self.imu.reload()
            print("dmp: loaded again")
        except OSError as why:
            print("dmp:", why)
        self.tick.resume()
        self.ticker = self.board.make_tick(self.rate, self.tick.on_sample)

    def faults(self):
        """All that went wrong since the start, and was survived."""
        imu, tick = self.imu, self.tick
        n = imu.errors + imu.resets + imu.fifo_overflows + tick.missed + tick.crashes
        if self.display is not None:
            n += self.display.errors
        if self.mag is not None:
            n += self.mag.errors + self.mag.resets
        if self._in_chip:
            n += imu.misaligned + imu.stalls
        return n

    def _report(self):
        tick = self.tick
        if tick.crashes != self._reported:
            self._reported = tick.crashes
            print("tick: %d exceptions, last: %r" % (tick.crashes, tick.error))

    def _draw(self, now):
        display = self.display
        if display is None or display.busy:
            return
        seconds = self.config.PAGE_SECONDS
        if seconds and time.ticks_diff(now, self._page_at) >= seconds * 1000:
            self._page_at = now
            self._page = (self._page + 1) % pages.COUNT
        flags = 0 if self.bias.known else pages.BIAS_UNKNOWN
        if time.ticks_diff(now, self._fresh_at) >= _LOST_MS:
            flags |= pages.SENSOR_LOST
        mag_lost = self.mag is None or time.ticks_diff(now, self._mag_at) >= _LOST_MS
        if self.filter.AXES == 9 and mag_lost:
            flags |= pages.MAG_LOST
        if self._page == pages.STATUS:
            self._fill_status(mag_lost)
        self._pages.draw(
            self._page,
            self.angles,
            self.rate_hz,
            self.imu.temperature_cdeg(),
            self.faults(),
            flags,
            self._status,
        )
        display.show()

    def _fill_status(self, mag_lost):
        """What the status page shows, as far as this filter tells it."""
        filter, status = self.filter, self._status
        filter.bias_mdps(self._bias_mdps)
        for i in range(3):
            status[pages.BIAS + i] = self._bias_mdps[i]
        if hasattr(filter, "resting"):
            status[pages.REST] = 1 if filter.resting else 0
            status[pages.DOUBT] = filter.heading_uncertainty_mdeg
        if filter.AXES == 9:
            accepted = getattr(filter, "mag_accepted", True)
            status[pages.FIELD] = 0 if mag_lost else 1 if accepted else 2

    # ------------------------------------------------------------------------------------ start-up messages

    def say(self, title, *lines):
        """A message on the display while the main program owns its bus; the console has its own words."""
        if self.display is not None:
            self._pages.message(title, *lines)
            self.display.show()
            self._flush()

    def _flush(self):
        while self.display.busy:
            self.display.flush_step(self.config.DISPLAY_CHUNK)


class _DataReady:
    """The data-ready line as a tick: hard where the port has hard pin interrupts."""

    def __init__(self, pin, callback, period_us):
        self.period_us = period_us
        try:
            pin.irq(callback, trigger=machine.Pin.IRQ_RISING, hard=True)
            self.hard = True
            self.what = "data-ready pin, hard"
        except (TypeError, ValueError):
            pin.irq(callback, trigger=machine.Pin.IRQ_RISING)
            self.hard = False
            self.what = "data-ready pin, soft: ticks wait for the main program"
        self._pin = pin

    def stop(self):
        self._pin.irq(handler=None)
