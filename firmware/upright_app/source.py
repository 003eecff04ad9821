# The chips of a board, read from the main program: what doctor.py and guided.py examine.
# Needs the application's board and upright. Every port. It uses floats and allocates: not for the tick.

import time

from micropython import const
from upright.settings import Settings, of_board

_POLL_US = const(500)
MICROTESLA = (20, 75)  # the earth's field, with a margin


class Source:
    """The chips of a board, read from the main program: next() gives each fresh sample once."""

    def __init__(self, board, rate_hz=None):
        """Opens the chips. Raises OSError when the sensor does not answer. mag is None without a magnetometer;
        mag_fault says why one of board.py does not work."""
        self.config = settings = Settings(of_board(board))
        self.imu = imu = board.sensor()
        self.configure(rate_hz or settings.SENSOR_RATE_HZ or settings.RATE)
        self.mag = self.mag_fault = None
        if hasattr(board, "magnetometer"):
            try:
                self.mag = board.magnetometer(imu)
                self.mag.configure(settings.MAG_RATE_HZ, sample_rate=imu.sample_rate)
            except OSError as why:
                self.mag = None
                self.mag_fault = str(why)
        self._own_mag = self.mag if self.mag is not None and self.mag.own_bus else None
        self.counts = imu.counts
        num, den = imu.sample_rate
        self._early_us = 800000 * den // num  # no other sample comes within this time
        self.seconds = 0.0  # between the last two fresh samples
        self._at = time.ticks_us()

    def configure(self, rate_hz):
        """Set the IMU up for this sample rate, Hz or (num, den)."""
        settings = self.config
        self.imu.configure(
            accel_range_g=settings.ACCEL_RANGE_G,
            gyro_range_dps=settings.GYRO_RANGE_DPS,
            dlpf=settings.DLPF,
            sample_rate_hz=rate_hz,
        )

    def poll(self):
        """-> flags of a fresh sample, or 0."""
        flags = self.imu.read()
        if not flags & 1:
            return 0
        if self._own_mag is not None:
            flags = self._own_mag.read(self.counts)
        now = time.ticks_us()
        self.seconds = time.ticks_diff(now, self._at) / 1000000
        self._at = now
        return flags

    def next(self, timeout_ms=200):
        start = time.ticks_ms()
        early = self._early_us - time.ticks_diff(time.ticks_us(), self._at)
        if 0 < early <= self._early_us:
            time.sleep_us(early)
        while time.ticks_diff(time.ticks_ms(), start) < timeout_ms:
            flags = self.poll()
            if flags:
                return flags
            time.sleep_us(_POLL_US)
        raise OSError("the sensor has stopped")


def conclude(problems):
    """Print the problems, or that there is none -> the problems."""
    for problem in problems:
        print("PROBLEM:", problem)
    if not problems:
        print("all is well")
    return problems
