# The settings of a board and what they are when board.py does not say. Every port.

DEFAULTS = {
    # Sampling. RATE: steps of the filter in Hz, or (num, den) for num/den Hz.
    "RATE": 200,
    # "timer": a timer's tick reads the newest sample; "data_ready": the chip's INT line is the tick;
    # "fifo": a timer at FIFO_HZ fetches the samples that the chip has queued.
    "DRIVE": "timer",
    # Of the chip, Hz; None: as RATE. With the timer drive the chip may sample faster than it is read: a tick then
    # never comes too early for a fresh sample, and its filter (DLPF) keeps the rest from aliasing.
    "SENSOR_RATE_HZ": None,
    "FIFO_HZ": 50,
    # True where something else clocks the chip's samples (the simulator replaying a trial).
    "EXTERNAL_CLOCK": False,
    "ACCEL_RANGE_G": 8,
    "GYRO_RANGE_DPS": 2000,
    "DLPF": 2,
    # How the chips sit on the board: body x, y, z (forward, left, up) each as an axis of the chip, "x", "-y", ...
    "IMU_AXES": ("x", "y", "z"),
    "MAG_AXES": ("x", "y", "z"),
    # Of the magnetometer, where board.py has one.
    "MAG_RATE_HZ": 100,
    # Corrections and biases, see calibration.py; made by `upright calibrate`.
    "CALIBRATION": "calibration.json",
    # The filter by its name in filters.py; None: inertial9 where board.py has a magnetometer, else inertial6. And its
    # own arguments, where its defaults are not wanted.
    "FILTER": None,
    "GAINS": {},
    "EULER": "zyx",
    # For the filter "dmp6": the file with the DMP's image, which the user has to have, and its SHA-256 where the
    # library does not know it; `upright dmp check FILE` shows it.
    "DMP_IMAGE": "dmp.bin",
    "DMP_SHA256": None,
    # Measure the gyro's bias at the start (the board has to lie still for a second).
    "MEASURE_BIAS": True,
    # A filter that learns the gyro's bias: write it into the calibration file when the board rests, for the next start.
    "KEEP_BIAS": True,
    # True: the display is on the sensor's bus, so the tick writes it, DISPLAY_CHUNK bytes at a time.
    # False: it has a bus of its own and the main program writes it.
    "DISPLAY_SHARES_BUS": True,
    "DISPLAY_CHUNK": 32,
    # Seconds between the display's pages; 0: only the first.
    "PAGE_SECONDS": 6,
}


class Config:
    """DEFAULTS, with what the board module says otherwise, as attributes.

    Raises ValueError for a name in capitals that no setting has: a slip of the pen would otherwise go unnoticed.
    """

    def __init__(self, board):
        for name in dir(board):
            setting = name.isupper() and name[0] != "_" and not callable(getattr(board, name))
            if setting and name not in ("NAME", "PLATFORM") and name not in DEFAULTS:
                raise ValueError("board.py sets %s, which is no setting; see config.py" % name)
        for name in DEFAULTS:
            setattr(self, name, getattr(board, name, DEFAULTS[name]))
        if isinstance(self.RATE, int):
            self.RATE = (self.RATE, 1)
