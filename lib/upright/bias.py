# The gyro's bias: measured at the start or read from the calibration file, and stored there when a filter has learnt
# it. Needs an AHRS, whose sensor, filter, calibration and settings it uses. Every port.

import time
from array import array

from micropython import const

# The filter's bias is stored after so long at rest
_KEEP_AFTER_S = const(10)
_KEEP_EVERY_S = const(600)  # at least between two writes of the flash
_KEEP_MDPS = const(20)  # and a change

# At rest: the most that gyro and accelerometer of an MPU6050 may change in a window, and the largest bias (PS 6.1:
# zero-rate output +-20 deg/s).
_REST_GYRO_DPS = const(3)
_REST_ACCEL_MG = const(120)
_BIAS_MOST_DPS = const(20)
_REST_WINDOW_MS = const(1000)
_REST_TRIES = const(4)
_REST_READS_HZ = const(200)  # at least, with the slowest bus

# How well a bias is known, in seconds of rest: one that was measured just now, and one of another day, when the chip
# was colder or warmer.
_MEASURED_S = const(100)
_STORED_S = const(10)


class Bias:
    """The gyro's bias of an AHRS's filter. known: it was measured, stored, or learnt."""

    def __init__(self, ahrs):
        self.known = False
        self._ahrs = ahrs
        self._rested_s = 0
        self._kept_s = _KEEP_EVERY_S  # since the last write
        self._learnt = array("i", [0] * 3)

    def find(self):
        """Give the filter a first value: the stored bias, or a measured one, or none."""
        ahrs = self._ahrs
        # a filter that learns the bias takes a first value if there is one, but start() does not wait long for it
        learns = hasattr(ahrs.filter, "resting")
        if not learns or not self._use_stored():
            if ahrs.settings.MEASURE_BIAS:
                ahrs.say("Keep still", "measuring the", "gyro's bias", *ahrs.notes)
                self.known = self._measure(1 if learns else _REST_TRIES)
            if not self.known and not learns and not self._use_stored():
                ahrs.log("bias: going on without (marked B? on the display)")

    def _use_stored(self):
        """The gyro's bias of the calibration file -> False when there is none."""
        ahrs = self._ahrs
        bias = ahrs.calibration.gyro_bias()
        if bias is None:
            return False
        ahrs.filter.set_bias(*bias, _STORED_S)
        self.known = True
        ahrs.log("bias: from", ahrs.settings.CALIBRATION)
        return True

    def keep(self, seconds=1):
        """Call this every few seconds. It stores the learnt bias in the calibration file, only at rest and rarely: on
        most boards a write to the flash blocks everything for some hundredths of a second."""
        ahrs = self._ahrs
        self._kept_s += seconds
        if not ahrs.status()["at_rest"]:  # a sensor that is gone does not rest
            self._rested_s = 0
            return
        self.known = True
        before = self._rested_s
        self._rested_s += seconds
        if not before < _KEEP_AFTER_S <= self._rested_s or self._kept_s < _KEEP_EVERY_S:
            return
        ahrs.filter.bias(self._learnt)
        num, den = ahrs.sensor.gyro_scale
        known = ahrs.calibration.gyro_bias()
        if known is not None:
            change = max([abs(self._learnt[i] - known[i]) for i in range(3)])
            if change * 1000 * den < _KEEP_MDPS * 256 * num:
                return
        self._kept_s = 0
        path = ahrs.settings.CALIBRATION
        try:
            x, y, z = self._learnt
            ahrs.calibration.save_gyro_bias(path, x, y, z, ahrs.sensor.chip, ahrs.board)
            ahrs.log("bias: kept in", path)
        except (OSError, ValueError) as why:
            ahrs.log("bias: not kept:", why)

    def _measure(self, tries):
        """Set the bias to the mean of the gyro over a window at rest. Returns False if the board was never at rest."""
        ahrs = self._ahrs
        sensor = ahrs.sensor
        counts = ahrs.counts
        num, den = sensor.gyro_scale
        gyro_most = _REST_GYRO_DPS * num // den
        bias_most = _BIAS_MOST_DPS * num // den
        accel_most = sensor.accel_lsb_per_g * _REST_ACCEL_MG // 1000
        settings = ahrs.settings
        rate_num, rate_den = settings.RATE if settings.EXTERNAL_CLOCK else sensor.sample_rate
        # half of what the chip and this loop can deliver
        enough = min(rate_num // rate_den, _REST_READS_HZ) * _REST_WINDOW_MS // 2000
        for k in range(tries):
            low = array("h", [32767] * 6)
            high = array("h", [-32768] * 6)
            total = [0] * 6
            n = 0
            start = time.ticks_ms()
            while time.ticks_diff(time.ticks_ms(), start) < _REST_WINDOW_MS:
                if ahrs.sample() & 1:
                    n += 1
                    for i in range(6):
                        c = counts[i]
                        total[i] += c
                        low[i] = min(low[i], c)
                        high[i] = max(high[i], c)
                time.sleep_ms(2)
            if n < enough:
                ahrs.log("bias: only %d samples in %d ms" % (n, _REST_WINDOW_MS))
                continue
            spread = [high[i] - low[i] for i in range(6)]
            mean = [(2 * 256 * t + n) // (2 * n) for t in total[3:]]  # in 1/256 count
            if (
                max(spread[:3]) <= accel_most
                and max(spread[3:]) <= gyro_most
                and max(abs(m) for m in mean) <= 256 * bias_most
            ):
                ahrs.filter.set_bias(*mean, _MEASURED_S)
                ahrs.log("bias: %s mdeg/s" % ([m * 1000 * den // (256 * num) for m in mean],))
                return True
            if k + 1 < tries:
                ahrs.say("Keep still", "it moves;", "trying again", *ahrs.notes)
        ahrs.log("bias: never at rest")
        return False
