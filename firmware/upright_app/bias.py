# The gyro's bias: measured or taken from the calibration file at the start, and kept there when a filter has learnt it.
# Part of the application (app.py). Every port.

import time
from array import array

from micropython import const

# So long at rest, and what the filter has learnt of the bias is worth keeping
_KEEP_AFTER_S = const(10)
_KEEP_EVERY_S = const(600)  # at least between two writes of the flash
_KEEP_MDPS = const(20)  # and a change

# At rest: what the gyro and accelerometer of an MPU6050 may move in a window, and how far a bias may lie (PS 6.1:
# zero-rate output +-20 deg/s).
_REST_GYRO_DPS = const(3)
_REST_ACCEL_MG = const(120)
_BIAS_MOST_DPS = const(20)
_REST_WINDOW_MS = const(1000)
_REST_TRIES = const(4)
_REST_READS_HZ = const(200)  # at least, with the slowest bus


class Bias:
    """The gyro's bias of an application's filter; known: it was measured, stored, or learnt."""

    def __init__(self, app):
        self.known = False
        self._app = app
        self._rested_s = 0
        self._kept_s = _KEEP_EVERY_S  # since the last write
        self._learnt = array("i", [0] * 3)

    def find(self):
        """A first value: the stored one, or one that is measured, or none."""
        app = self._app
        # a filter that learns the bias by itself wants a first value, but nobody has to wait for it
        learns = hasattr(app.filter, "resting")
        if not learns or not self._use_stored():
            if app.config.MEASURE_BIAS:
                app.say("Keep still", "measuring the", "gyro's bias", *app.notes)
                self.known = self._measure(1 if learns else _REST_TRIES)
            if not self.known and not learns and not self._use_stored():
                print("bias: going on without (marked B? on the display)")

    def _use_stored(self):
        """The gyro's bias of the calibration file -> False when there is none."""
        app = self._app
        bias = app.calibration.gyro_bias()
        if bias is None:
            return False
        app.filter.set_bias(*bias)
        self.known = True
        print("bias: from", app.config.CALIBRATION)
        return True

    def keep(self):
        """Once a second: what the filter has learnt of the bias into the calibration file, at rest and seldom, since a
        write of the flash holds up everything for some hundredths of a second on most boards."""
        app = self._app
        self._kept_s += 1
        if not app.filter.resting:
            self._rested_s = 0
            return
        self.known = True
        self._rested_s += 1
        if self._rested_s != _KEEP_AFTER_S or self._kept_s < _KEEP_EVERY_S:
            return
        app.filter.bias(self._learnt)
        num, den = app.imu.gyro_scale
        known = app.calibration.gyro_bias()
        if known is not None:
            change = max([abs(self._learnt[i] - known[i]) for i in range(3)])
            if change * 1000 * den < _KEEP_MDPS * 256 * num:
                return
        self._kept_s = 0
        try:
            x, y, z = self._learnt
            app.calibration.save_gyro_bias(
                app.config.CALIBRATION, x, y, z, app.imu.chip, app.board.NAME
            )
            print("bias: kept in", app.config.CALIBRATION)
        except (OSError, ValueError) as why:
            print("bias: not kept:", why)

    def _measure(self, tries):
        """Mean of the gyro over a window at rest -> True; False when it never rested."""
        app = self._app
        imu = app.imu
        counts = app.counts
        num, den = imu.gyro_scale
        gyro_most = _REST_GYRO_DPS * num // den
        bias_most = _BIAS_MOST_DPS * num // den
        accel_most = imu.accel_lsb_per_g * _REST_ACCEL_MG // 1000
        rate_num, rate_den = app.config.RATE if app.config.EXTERNAL_CLOCK else imu.sample_rate
        # half of what the chip and this loop can give
        enough = min(rate_num // rate_den, _REST_READS_HZ) * _REST_WINDOW_MS // 2000
        for k in range(tries):
            low = array("h", [32767] * 6)
            high = array("h", [-32768] * 6)
            total = [0] * 6
            n = 0
            start = time.ticks_ms()
            while time.ticks_diff(time.ticks_ms(), start) < _REST_WINDOW_MS:
                if app.sample() & 1:
                    n += 1
                    for i in range(6):
                        c = counts[i]
                        total[i] += c
                        low[i] = min(low[i], c)
                        high[i] = max(high[i], c)
                time.sleep_ms(2)
            if n < enough:
                print("bias: only %d samples in %d ms" % (n, _REST_WINDOW_MS))
                continue
            spread = [high[i] - low[i] for i in range(6)]
            mean = [(2 * 256 * t + n) // (2 * n) for t in total[3:]]  # in 1/256 count
            if (
                max(spread[:3]) <= accel_most
                and max(spread[3:]) <= gyro_most
                and max(abs(m) for m in mean) <= 256 * bias_most
            ):
                app.filter.set_bias(*mean)
                print("bias: %s mdeg/s" % ([m * 1000 * den // (256 * num) for m in mean],))
                return True
            if k + 1 < tries:
                app.say("Keep still", "it moves;", "trying again", *app.notes)
        print("bias: never at rest")
        return False
