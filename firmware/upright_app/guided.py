# The guided check of IMU_AXES and MAG_AXES: says what to do with the board, waits for it, and says what is wrong.
# `upright doctor --axes` runs it; on the board: from upright_app import guided; import board; guided.axes(board).
# Every port. It uses floats and allocates: not for the tick. What is judged is judged by axis_check.py.

import time

import upright
from micropython import const

from upright_app import axis_check
from upright_app.source import MICROTESLA, Source, conclude

_RATE_HZ = const(200)  # a loop in bytecode keeps up with it
_POSTURE_MS = const(60000)  # for each posture; then the check ends
_STILL_MS = const(1000)
_TUMBLE_MS = const(30000)
_STILL_DPS = const(6)


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
    print(
        "The maps will be right for what you turn now. Is the board mounted in a vehicle? Then turn the vehicle,"
    )
    print(
        "all of it: its nose, its left side. The board (PCB) alone has other axes if it is mounted turned."
    )
    try:
        source = Source(board, _RATE_HZ)
        _axes(source, south, tumble_ms, problems)
    except OSError as why:
        problems.append("sensor: %s" % why)
    return conclude(problems)


def _axes(source, south, tumble_ms, problems):
    settings = source.config
    posture = Posture(source)
    seen = []
    for number, text in enumerate(
        (
            "lay it level, top up, and let go",
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
            problems.append(
                "IMU_AXES is %s, should be %s. PCB turned or vehicle turned? That is the map of what you turned"
                % (settings.IMU_AXES, found)
            )
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
    if not MICROTESLA[0] <= strength <= MICROTESLA[1]:
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
