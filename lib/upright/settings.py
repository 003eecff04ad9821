# The settings of a board: their defaults and their valid values.
# Needs calibration.py, filters.py. Every port.

from upright import calibration, filters
from upright.calibration import is_int

DEFAULTS = {
    # Sampling. RATE: steps of the filter in Hz, or (num, den) for num/den Hz, with every drive.
    "RATE": 200,
    # "timer": a timer's tick reads the newest sample. "data_ready": the chip's INT line is the tick.
    # "fifo": a timer at FIFO_HZ fetches the samples that the chip has queued. "manual": the program calls step().
    # None: "timer" where timer callbacks are hard, "fifo" where they are soft.
    "DRIVE": None,
    # The chip's sample rate with the timer drive, Hz; None: RATE. The chip may sample faster than it is read: a tick
    # then always finds a fresh sample, and the chip's filter (DLPF) prevents aliasing.
    "SENSOR_RATE_HZ": None,
    "FIFO_HZ": 50,
    # True if something else clocks the chip's samples (the simulator when it replays a trial).
    "EXTERNAL_CLOCK": False,
    "ACCEL_RANGE_G": 8,
    "GYRO_RANGE_DPS": 2000,
    "DLPF": 2,
    # How the chips are mounted: body x, y, z (forward, left, up) each as an axis of the chip, "x", "-y", ...
    "IMU_AXES": ("x", "y", "z"),
    "MAG_AXES": ("x", "y", "z"),
    # Which magnetometer magnetometers.find() looks for: "auto" or one of MAGNETOMETERS.
    "MAGNETOMETER": "auto",
    # The magnetometer's rate, if board.py has one.
    "MAG_RATE_HZ": 100,
    # Corrections and biases, see calibration.py; made by `upright calibrate`. None: no file.
    "CALIBRATION": "upright_cal.json",
    # The filter, by its name in filters.py; None: inertial9 with a magnetometer, else inertial6. GAINS: its own
    # arguments, {} for its defaults.
    "FILTER": None,
    "GAINS": {},
    "EULER": "zyx",
    # Magnetic declination of the place in degrees: positive if a compass points east of true north.
    "DECLINATION": 0,
    # For the filter "dmp6": the file with the DMP's image, which the user supplies, and its SHA-256 if the library
    # does not know the image; `upright dmp check FILE` shows it.
    "DMP_IMAGE": "dmp.bin",
    "DMP_SHA256": None,
    # Measure the gyro's bias at the start (the board must be at rest for a second).
    "MEASURE_BIAS": True,
    # Store the bias that a filter has learnt in the calibration file when the board is at rest, for the next start.
    "KEEP_BIAS": True,
    # True: the display is on the sensor's bus, and the tick writes it, DISPLAY_CHUNK bytes at a time.
    # False: it has its own bus, and the main program writes it.
    "DISPLAY_SHARES_BUS": True,
    "DISPLAY_CHUNK": 32,
    # Seconds that each page of the display is shown; 0: only the first page.
    "PAGE_SECONDS": 6,
    # The application resets the board after so many ms without a fresh sample, 1000..8000. 0: off, because no port can
    # stop a watchdog: the board would also reset at the prompt, after a Ctrl-C.
    "WATCHDOG_MS": 0,
}

MAGNETOMETERS = ("AK8963", "HMC5883L", "IST8310", "QMC5883L")
DRIVES = ("timer", "data_ready", "fifo", "manual")
FIFO_BATCH = 8  # packets that one tick of the FIFO drive fetches at most
_NO_SETTINGS = ("NAME", "PLATFORM")
_ACCEL_RANGES = (2, 4, 8, 16)
_GYRO_SCALES = {250: (131, 1), 500: (131, 2), 1000: (164, 5), 2000: (82, 5)}


def of_board(board):
    """The settings of a board module, {setting: value}.

    Raises ValueError for an unknown name in capitals, because a typing error would otherwise go unnoticed.
    """
    found = {}
    for name in dir(board):
        if not name.isupper() or name[0] == "_" or callable(getattr(board, name)):
            continue
        if name in DEFAULTS:
            found[name] = getattr(board, name)
        elif name not in _NO_SETTINGS:
            raise ValueError(
                "board.py sets %s, which is not a setting; see upright/settings.py" % name
            )
    return found


class Settings:
    """The DEFAULTS, replaced by `given`, {setting: value}, as attributes. RATE is always a pair.

    Raises ValueError for an unknown name.
    """

    def __init__(self, given):
        for name in given:
            if name not in DEFAULTS:
                raise ValueError("there is no setting %s; see upright/settings.py" % name)
        for name in DEFAULTS:
            setattr(self, name, given.get(name, DEFAULTS[name]))
        if is_int(self.RATE, 1):
            self.RATE = (self.RATE, 1)
        elif isinstance(self.RATE, list):
            self.RATE = tuple(self.RATE)

    def check(self, axes=6, drive=None, more=()):
        """Check every setting, for sensors with so many axes. drive: the drive that was chosen for DRIVE = None. more:
        lines about what else is wrong.

        Raises ValueError that lists all wrong settings, each with what to change. What depends on the chip and on the
        timer is checked later.
        """
        wrong = list(more)
        hz = "Hz as a positive int, or (num, den) for num/den Hz"
        self._demand(wrong, "RATE", _is_pair(self.RATE), hz)
        drives = self.DRIVE is None or self.DRIVE in DRIVES
        self._demand(wrong, "DRIVE", drives, ", ".join(['"%s"' % name for name in DRIVES]))
        self._demand(wrong, "FIFO_HZ", is_int(self.FIFO_HZ, 1, 1000), "Hz as an int, 1..1000")
        good = self.MAGNETOMETER == "auto" or self.MAGNETOMETER in MAGNETOMETERS
        self._demand(wrong, "MAGNETOMETER", good, '"auto", "%s"' % '", "'.join(MAGNETOMETERS))
        self._demand(wrong, "MAG_RATE_HZ", is_int(self.MAG_RATE_HZ, 1), "Hz as a positive int")
        good = self.SENSOR_RATE_HZ is None or is_int(self.SENSOR_RATE_HZ, 1)
        self._demand(wrong, "SENSOR_RATE_HZ", good, "Hz as a positive int, or None")
        good = is_int(self.ACCEL_RANGE_G, 1) and self.ACCEL_RANGE_G in _ACCEL_RANGES
        self._demand(wrong, "ACCEL_RANGE_G", good, "2, 4, 8 or 16")
        good = is_int(self.GYRO_RANGE_DPS, 1) and self.GYRO_RANGE_DPS in _GYRO_SCALES
        self._demand(wrong, "GYRO_RANGE_DPS", good, "250, 500, 1000 or 2000")
        good = self.DLPF in (None, "bypass") or is_int(self.DLPF, 0, 7)
        self._demand(wrong, "DLPF", good, "0..7; mpu.py has the bandwidths")
        self._demand(wrong, "EULER", self.EULER in ("zyx", "zxy"), '"zyx" or "zxy"')
        chunk = self.DISPLAY_CHUNK
        good = is_int(chunk, 8, 128) and chunk % 8 == 0
        self._demand(wrong, "DISPLAY_CHUNK", good, "a multiple of 8, 8..128")
        good = _is_number(self.PAGE_SECONDS, 0, 3600)
        self._demand(wrong, "PAGE_SECONDS", good, "seconds, 0..3600")
        # rp2 allows 8388 ms at most (MicroPython's docs, machine.WDT)
        good = is_int(self.WATCHDOG_MS, 0, 0) or is_int(self.WATCHDOG_MS, 1000, 8000)
        self._demand(wrong, "WATCHDOG_MS", good, "ms as an int, 1000..8000, or 0")
        self._demand(wrong, "DECLINATION", _is_number(self.DECLINATION, -180, 180), "degrees")
        good = self.CALIBRATION is None or _is_file_name(self.CALIBRATION)
        self._demand(wrong, "CALIBRATION", good, "the name of a file, or None")
        image = self.DMP_IMAGE
        good = isinstance(image, (bytes, bytearray)) or hasattr(image, "seek")
        good = good or _is_file_name(image)
        self._demand(wrong, "DMP_IMAGE", good, "the name of a file")
        digest = self.DMP_SHA256
        good = digest is None or (isinstance(digest, str) and len(digest) == 64)
        good = good and not (digest or "").strip("0123456789abcdef")
        self._demand(
            wrong, "DMP_SHA256", good, "64 hexadecimal digits as sha256sum shows them, or None"
        )
        self._demand(wrong, "GAINS", isinstance(self.GAINS, dict), "a dict")
        for name in ("EXTERNAL_CLOCK", "MEASURE_BIAS", "KEEP_BIAS", "DISPLAY_SHARES_BUS"):
            value = getattr(self, name)
            self._demand(wrong, name, value is True or value is False, "True or False")
        try:
            filters.check(self.filter_name(axes))
        except ValueError as why:
            wrong.append(str(why))
        for name in ("IMU_AXES", "MAG_AXES"):
            self._demand(wrong, name, isinstance(getattr(self, name), (tuple, list)), "three axes")
        try:
            calibration.Calibration(self.IMU_AXES, self.MAG_AXES)
        except ValueError as why:
            wrong.append(str(why))
        except TypeError:
            pass  # it has been named
        if not wrong:
            self._check_combinations(wrong, axes, drive or self.DRIVE)
        if wrong:
            raise ValueError("; ".join(wrong))

    def _check_combinations(self, wrong, axes, drive):
        num, den = self.RATE
        if drive == "fifo" and num > FIFO_BATCH * self.FIFO_HZ * den:
            wrong.append(
                "with FIFO_HZ %d the FIFO drive keeps up with %d Hz: FIFO_HZ %d, or a lower RATE"
                % (self.FIFO_HZ, FIFO_BATCH * self.FIFO_HZ, -(-num // (FIFO_BATCH * den)))
            )
        if drive == "timer" and self.SENSOR_RATE_HZ is not None and not self.EXTERNAL_CLOCK:
            if self.SENSOR_RATE_HZ * den < num:
                wrong.append(
                    "SENSOR_RATE_HZ is %d: the chip has to sample at RATE or faster"
                    % self.SENSOR_RATE_HZ
                )
        name = self.filter_name(axes)
        try:
            if name not in filters.HARDWARE:
                filters.make(name, self.RATE, _Scales(self), self.GAINS)
            elif num % den or drive not in (None, "timer"):
                wrong.append('with %s DRIVE is "timer" and RATE a whole number' % name)
        except ValueError as why:
            wrong.append(str(why))

    def filter_name(self, axes):
        return filters.default(axes == 9) if self.FILTER is None else self.FILTER

    def _demand(self, wrong, name, good, wanted):
        if not good:
            wrong.append("%s is %r, expected %s" % (name, getattr(self, name), wanted))


class _Scales:
    """The scales of a sensor, for a filter."""

    def __init__(self, settings):
        self.gyro_scale = _GYRO_SCALES[settings.GYRO_RANGE_DPS]
        self.accel_lsb_per_g = 32768 // settings.ACCEL_RANGE_G


def _is_pair(value):
    pair = isinstance(value, (tuple, list)) and len(value) == 2
    return pair and is_int(value[0], 1) and is_int(value[1], 1)


def _is_number(value, low, high):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def _is_file_name(value):
    return isinstance(value, str) and value != "" and "\0" not in value
