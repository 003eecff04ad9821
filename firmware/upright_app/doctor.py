# A board's doctor: which chips answer, which rates are kept, and whether the axis maps in board.py are right.
# `upright doctor` runs it; on the board: from upright_app import doctor; import board; doctor.report(board).
# Every port. It uses floats and allocates: not for the tick. The functions that judge take samples, not chips.

import gc
import math
import sys
import time

import upright
from micropython import const
from upright.settings import Settings, of_board

from upright_app import axis_check

_RATE_HZ = const(200)  # of the axis check: a loop in bytecode keeps up with it
_POLL_US = const(500)
_MEASURE_MS = const(500)
_POSTURE_MS = const(60000)  # for each posture; then the check ends
_STILL_MS = const(1000)
_TUMBLE_MS = const(30000)
_STILL_DPS = const(6)
_MICROTESLA = (20, 75)  # the earth's field, with a margin


# ------------------------------------------------------------------------------------------ samples of a board


class Source:
    """The chips of a board, read from the main program: next() gives each fresh sample once."""

    def __init__(self, board, rate_hz=None):
        """Opens the chips. Raises OSError when the sensor does not answer. mag is None without a magnetometer;
        mag_fault says why one of board.py does not work."""
        self.config = settings = Settings(of_board(board))
        self.imu = imu = board.sensor()
        imu.configure(
            accel_range_g=settings.ACCEL_RANGE_G,
            gyro_range_dps=settings.GYRO_RANGE_DPS,
            dlpf=settings.DLPF,
            sample_rate_hz=rate_hz or settings.SENSOR_RATE_HZ or settings.RATE,
        )
        self.mag = self.mag_fault = None
        if hasattr(board, "magnetometer"):
            try:
                self.mag = board.magnetometer(imu)
                self.mag.configure(rate_hz=settings.MAG_RATE_HZ)
            except OSError as why:
                self.mag = None
                self.mag_fault = str(why)
        self._own_mag = self.mag if self.mag is not None and self.mag.own_bus else None
        self.counts = imu.counts
        num, den = imu.sample_rate
        self._early_us = 800000 * den // num  # no other sample comes within this time
        self.seconds = 0.0  # between the last two fresh samples
        self._at = time.ticks_us()

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


class Posture:
    """Waits until the board lies still, and holds the mean of its samples then."""

    def __init__(self, source):
        self._source = source
        self._num, self._den = source.imu.gyro_scale
        self.accel = [0.0] * 3
        self.gyro = [0.0] * 3
        self.field = None

    def wait(self, wanted):
        """wanted(axis) -> bool: is this axis (index, sign), pointing up, the posture? True when it has been held."""
        source, counts = self._source, self._source.counts
        lsb_per_g = source.imu.accel_lsb_per_g
        start = time.ticks_ms()
        while time.ticks_diff(time.ticks_ms(), start) < _POSTURE_MS:
            total = [0] * 9
            n = fields = 0
            first = None
            since = time.ticks_ms()
            while time.ticks_diff(time.ticks_ms(), since) < _STILL_MS:
                flags = source.next()
                if first is None:
                    first = [counts[3 + i] for i in range(3)]
                # the gyro has a bias: at rest means that its reading does not change
                if (
                    max(abs(counts[3 + i] - first[i]) for i in range(3))
                    > _STILL_DPS * self._num // self._den
                ):
                    n = 0
                    break
                n += 1
                for i in range(6):
                    total[i] += counts[i]
                if flags & 2:
                    fields += 1
                    for i in range(6, 9):
                        total[i] += counts[i]
            if not n:
                continue
            self.accel = [x / n for x in total[:3]]
            self.gyro = [x / n for x in total[3:6]]
            self.field = [x / fields for x in total[6:]] if fields else None
            axis = axis_check.up_axis(self.accel, lsb_per_g)
            if axis is not None and wanted(axis):
                return axis
        return None


# ------------------------------------------------------------------------------------------ the check of the axes


def axes(board, south=False, tumble_ms=_TUMBLE_MS):
    """The two-minute check of IMU_AXES and MAG_AXES: says what to do, waits for it, and says what is wrong.

    Nothing has to be typed: each step goes on when the board lies still in its position. Returns the list of problems.
    """
    upright.stop()
    problems = []
    try:
        source = Source(board, _RATE_HZ)
        _axes(source, south, tumble_ms, problems)
    except OSError as why:
        problems.append("sensor: %s" % why)
    _conclude(problems)
    return problems


def _axes(source, south, tumble_ms, problems):
    settings = source.config
    posture = Posture(source)
    seen = []
    for number, text in enumerate(
        (
            "lay the board level, face up, and let go",
            "stand it up, nose (x) to the sky, and hold still",
            "put it on its right side, left side (y) to the sky, and hold still",
        )
    ):
        print("%d. %s" % (number + 1, text))
        axis = posture.wait(lambda axis: all(axis[0] != other[0] for other in seen))
        if axis is None:
            problems.append("step %d: not seen within %d s" % (number + 1, _POSTURE_MS // 1000))
            return
        seen.append(axis)
        if number == 0:
            bias = posture.gyro
        print("   up is the chip's %s" % axis_check.names([axis]))
    found = settings.IMU_AXES
    try:
        found = axis_check.imu_axes(*seen)
        if tuple(found) != tuple(settings.IMU_AXES):
            problems.append("IMU_AXES is %s, should be %s" % (settings.IMU_AXES, found))
    except ValueError as why:
        problems.append("%s; do the check again" % why)
        return
    verdict = None
    if source.mag is not None:
        verdict = _tumble(source, found, bias, south, tumble_ms)
        _judge_map(source, verdict, problems)
    elif source.mag_fault:
        problems.append("magnetometer: %s" % source.mag_fault)
    _quarter(source, posture, found, verdict, seen[0], problems)


def _tumble(source, found, bias, south, tumble_ms):
    print("4. turn it over and over, slowly, about all its axes, for %d s" % (tumble_ms // 1000))
    tumble = axis_check.Tumble(source.imu.gyro_scale, source.imu.accel_lsb_per_g, found, bias)
    start = told = time.ticks_ms()
    while time.ticks_diff(time.ticks_ms(), start) < tumble_ms:
        source.next()
        tumble.add(source.counts, source.seconds)
        if time.ticks_diff(time.ticks_ms(), told) >= 5000:
            told = time.ticks_ms()
            print("   %d turns" % tumble.n)
    return tumble.result(south)


def _judge_map(source, verdict, problems):
    if verdict.problem:
        problems.append("magnetometer: " + verdict.problem)
    if verdict.axes is None:
        return
    num, den = getattr(source.mag, "lsb_per_uT", (33, 10))
    strength = verdict.strength * den / num
    print(
        "   field %d uT, %d deg into the ground, offset %s counts; unexplained %.2f, next map %.2f"
        % (
            strength,
            verdict.dip_deg,
            [round(x) for x in verdict.offset],
            verdict.score,
            verdict.second,
        )
    )
    if tuple(verdict.axes) != tuple(source.config.MAG_AXES):
        problems.append("MAG_AXES is %s, should be %s" % (source.config.MAG_AXES, verdict.axes))
    if not _MICROTESLA[0] <= strength <= _MICROTESLA[1]:
        problems.append("the field is %d uT: iron or a magnet near, or the wrong scale" % strength)


def _quarter(source, posture, found, verdict, level, problems):
    print(
        "5. lay it level, then turn it level by a quarter to the left (seen from above), and let go"
    )
    if posture.wait(lambda axis: axis == level) is None:
        problems.append("step 5: not level within %d s" % (_POSTURE_MS // 1000))
        return
    bias, before = posture.gyro, posture.field
    print("   now turn")
    num, den = source.imu.gyro_scale
    map_ = axis_check.parse(found)
    turned = 0.0
    quiet = start = time.ticks_ms()
    while time.ticks_diff(time.ticks_ms(), start) < _POSTURE_MS:
        source.next()
        rate = axis_check.mapped(
            [(source.counts[3 + i] - bias[i]) * den / num for i in range(3)], map_
        )
        turned += rate[2] * source.seconds
        if max(abs(x) for x in rate) > _STILL_DPS or abs(turned) < 20:
            quiet = time.ticks_ms()
        if time.ticks_diff(time.ticks_ms(), quiet) >= _STILL_MS:
            break
    needle = None
    if verdict is not None and verdict.axes is not None and before is not None:
        posture.wait(lambda axis: axis == level)
        if posture.field is not None:
            needle = axis_check.needle_turn(before, posture.field, verdict.axes, verdict.offset)
    print("   gyro %d deg, field %s deg" % (turned, "-" if needle is None else round(needle)))
    problems += axis_check.judge_turn(turned, needle)


# ------------------------------------------------------------------------------------------ the report


class _Counter:
    def __init__(self):
        self.n = 0

    def count(self, _):
        self.n += 1


def report(board):
    """Print which chips answer, which rates are kept, how much memory is free. Returns the list of problems, each with
    what to do."""
    upright.stop()
    problems = []
    version = ".".join([str(x) for x in sys.implementation.version[:3]])
    print("%s, %s %s on %s" % (board.NAME, sys.implementation.name, version, sys.platform))
    gc.collect()
    if hasattr(gc, "mem_free"):
        print("heap: %d bytes free" % gc.mem_free())
    try:
        settings = Settings(of_board(board))
        settings.check(9 if hasattr(board, "magnetometer") else 6)
    except ValueError as why:
        problems.append(str(why))
        _conclude(problems)
        return problems
    _report_display(board, settings, problems)
    _report_tick(board, settings, problems)
    try:
        source = Source(board)
    except (OSError, ValueError) as why:
        problems.append("sensor: %s. Check power, wiring and pins against the board's README" % why)
    else:
        _report_chips(source, problems)
    _conclude(problems)
    return problems


def _report_display(board, settings, problems):
    try:
        display = board.display(settings.DISPLAY_CHUNK)
        if display is not None:
            display.begin()
        print("display: %s" % ("none" if display is None else "written to"))
    except (OSError, ValueError) as why:
        problems.append("display: %s. The firmware runs without it" % why)


def _report_tick(board, settings, problems):
    counter = _Counter()
    num, den = settings.RATE
    try:
        ticker = board.make_tick(settings.RATE, counter.count)
    except (OSError, ValueError) as why:
        problems.append("tick: %s" % why)
        return
    time.sleep_ms(_MEASURE_MS)
    ticker.stop()
    rate = counter.n * 1000 // _MEASURE_MS
    print("tick: %s, %d Hz of %d/%d" % (ticker.what, rate, num, den))
    if not ticker.hard:
        problems.append(
            "tick: this port or version has no hard timer callbacks; samples wait for the main program"
        )
    if abs(rate * den - num) > 0.05 * num + 4 * den:
        problems.append("tick: %d Hz instead of %d/%d: choose a lower RATE" % (rate, num, den))


def _report_chips(source, problems):
    imu, mag = source.imu, source.mag
    fresh = fields = 0
    square = 0.0
    total = [0] * 3
    errors = imu.errors
    start = time.ticks_ms()
    while time.ticks_diff(time.ticks_ms(), start) < _MEASURE_MS:
        flags = source.poll()
        if not flags:
            continue
        fresh += 1
        for i in range(3):
            total[i] += source.counts[i]
        if flags & 2:
            fields += 1
            square += sum([source.counts[6 + i] * source.counts[6 + i] for i in range(3)])
    print(
        "sensor: %s, %d/%d Hz (%d fresh samples/s read), %.1f degC"
        % (
            (imu.chip,)
            + imu.sample_rate
            + (fresh * 1000 // _MEASURE_MS, imu.temperature_cdeg() / 100)
        )
    )
    if not fresh:
        problems.append("sensor: it answers, but no sample is ever fresh")
        return
    if imu.errors != errors:
        problems.append(
            "sensor: %d bus errors: shorter wires, a slower bus" % (imu.errors - errors)
        )
    g = math.sqrt(sum([(x / fresh / imu.accel_lsb_per_g) ** 2 for x in total]))
    print("at rest: %.2f g" % g)
    if not 0.9 < g < 1.1:
        problems.append("sensor: %.2f g; keep the board still, or calibrate" % g)
    _report_self_test(imu, problems)
    if source.mag_fault:
        problems.append("magnetometer: %s. The attitude comes from six axes" % source.mag_fault)
    if mag is None:
        return
    rate = fields * 1000 // _MEASURE_MS
    print("magnetometer: %s, %d/%d Hz (%d/s read)" % ((mag.chip,) + mag.sample_rate + (rate,)))
    if not fields:
        problems.append("magnetometer: it answers, but no measurement is ever fresh")
        return
    num, den = getattr(mag, "lsb_per_uT", (33, 10))
    strength = math.sqrt(square / fields) * den / num
    print("field: %d uT" % strength)
    if not _MICROTESLA[0] <= strength <= _MICROTESLA[1]:
        problems.append(
            "field: %d uT is not the earth's: move away from iron, calibrate" % strength
        )


def _report_self_test(imu, problems):
    try:
        passed, changes = imu.self_test()
    except (OSError, ValueError) as why:
        problems.append("self-test: %s" % why)
        return
    print(
        "self-test: %s"
        % ("passed" if passed else "failed" if passed is False else "the chip has no factory trims")
    )
    if passed is False:
        problems.append(
            "self-test: accel x y z, gyro x y z answer %s per mille off the factory's trim: a damaged chip, "
            "or a copy with trims that mean nothing" % (changes,)
        )


def _conclude(problems):
    for problem in problems:
        print("PROBLEM:", problem)
    if not problems:
        print("all is well")
