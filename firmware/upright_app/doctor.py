# A board's doctor: which chips answer, which rates are kept, and what does not fit board.py.
# `upright doctor` runs it; on the board: from upright_app import doctor; import board; doctor.report(board).
# Every port. It uses floats and allocates: not for the tick.

import gc
import math
import sys
import time

import upright
from micropython import const
from upright.settings import Settings, of_board

from upright_app.source import MICROTESLA, Source, conclude

_MEASURE_MS = const(500)
_BATCH = const(8)  # packets of the FIFO in one burst
_STEPS = const(50)
# Looks at all pins for the one that is INT, at this rate of samples
_LOOKS = const(8)
_LOOK_HZ = const(50)


class _Counter:
    def __init__(self):
        self.n = 0

    def count(self, _):
        self.n += 1


def _report_faults():
    """What the application has noted: no problem of now."""
    try:
        with open("upright_faults.txt") as file:
            print("faults of the last run that had any (upright_faults.txt):")
            for line in file:
                print(" ", line.rstrip())
    except OSError:
        print("faults: none kept")


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
    _report_faults()
    try:
        settings = Settings(of_board(board))
        settings.check(9 if hasattr(board, "magnetometer") else 6)
    except ValueError as why:
        problems.append(str(why))
        return conclude(problems)
    step = _measure_step(board, settings)  # first: a small heap is still whole
    gc.collect()
    display = _report_display(board, settings, problems)
    soft = _report_tick(board, settings, problems)
    try:
        source = Source(board)
    except (OSError, ValueError) as why:
        problems.append("sensor: %s. Check power, wiring and pins against the board's README" % why)
    else:
        if _report_chips(source, problems):
            source.configure(settings.RATE)
            _report_line(board, source, problems)
            _report_fifo(source, soft, problems)
            _report_step(step, settings, problems)
    if display is not None:
        _draw_frame(display)
    return conclude(problems)


def _report_display(board, settings, problems):
    """-> the display, or None."""
    try:
        display = board.display(settings.DISPLAY_CHUNK) if hasattr(board, "display") else None
        if display is None:
            print("display: none")
            return None
        display.begin()
    except (OSError, ValueError) as why:
        problems.append("display: %s. The firmware runs without it" % why)
        return None
    panel, found = getattr(display, "panel", ""), _controller(display)  # a driver of one's own
    print("display:", panel, "answers like an %s" % found if found else "written to")
    if panel and found not in (None, panel.split()[0]):
        problems.append(
            'display: board.py says "%s", but it answers like an %s: set "%s %s"'
            % (panel, found, found, panel.split()[1])
        )
    return display


def _controller(display):
    """ "SH1106": what is written to its RAM can be read over I2C. "SSD1306": it cannot (8.1.5; what comes is the
    status). None: on SPI, or a read is refused. As FlashFloppy tells them apart (src/display, oled_probe_model)."""
    bus = display.bus
    if not hasattr(bus, "readfrom_into"):
        return None
    point = b"\x80\xb0\x80\x10\x80\x00\xc0"  # page 0, column 0, data; control bytes before each
    answer, wrote = bytearray(2), None
    try:
        for mask in (0x5A, 0x3C, 0x81):
            bus.writeto(display.address, point)
            bus.readfrom_into(display.address, answer)  # the first byte is none
            if wrote not in (None, answer[1]):
                return "SSD1306"
            wrote = answer[1] ^ mask
            bus.writeto(display.address, point + bytes((wrote,)))
    except OSError:
        return None
    return "SH1106"


def _draw_frame(display):
    """Whether the panel's size and offset are right only a person sees."""
    display.fill(0)
    display.rect(0, 0, display.width, display.height)
    display.text("%dx%d" % (display.width, display.height), 4, 4)
    try:
        display.begin()
    except OSError:
        return
    print(
        "look at the display: a frame along all four edges, and its size. A side missing, or noise at one:"
    )
    print(
        "   the panel is another one, or needs column_offset=; the board's README lists the panels"
    )


def _report_tick(board, settings, problems):
    """-> whether the tick is soft, so that the FIFO keeps the time."""
    counter = _Counter()
    num, den = settings.RATE
    try:
        ticker = board.make_tick(settings.RATE, counter.count)
    except (OSError, ValueError) as why:
        problems.append("tick: %s" % why)
        return True
    time.sleep_ms(_MEASURE_MS)
    ticker.stop()
    rate = counter.n * 1000 // _MEASURE_MS
    print("tick: %s, %d Hz of %d/%d" % (ticker.what, rate, num, den))
    if not ticker.hard and settings.DRIVE == "timer":
        problems.append(
            "tick: this port or version has no hard timer callbacks, so samples are lost while the main program is "
            'busy: DRIVE = "fifo"'
        )
    if abs(rate * den - num) > 0.05 * num + 4 * den:
        problems.append("tick: %d Hz instead of %d/%d: choose a lower RATE" % (rate, num, den))
    return not ticker.hard


def _report_line(board, source, problems):
    """The INT line: it has a pulse for each sample."""
    if not hasattr(board, "data_ready_pin"):
        return
    from upright import timing

    counter = _Counter()
    needed = source.config.DRIVE == "data_ready"
    num, den = source.imu.sample_rate
    try:
        source.imu.configure_interrupt()
        pin = board.data_ready_pin()
        line = timing.DataReady(pin, counter.count, 0)
    except (OSError, ValueError, TypeError, AttributeError) as why:
        if needed:
            problems.append("INT line: %s" % why)
        return
    time.sleep_ms(_MEASURE_MS)
    line.stop()
    rate = counter.n * 1000 // _MEASURE_MS
    good = abs(rate * den - num) <= 0.1 * num + 4 * den
    remark = "" if good or needed else ' (needed only with DRIVE = "data_ready")'
    print("INT line: %d pulses/s of %d/%d%s" % (rate, num, den, remark))
    if good:
        return
    found = _pins_that_follow(source, pin)
    if found:
        print("INT line: the chip's samples are seen at", found)
    if needed:
        hint = (
            "return %s in data_ready_pin()" % found
            if found
            else "is INT wired to the pin of data_ready_pin()?"
        )
        problems.append("INT line: %d pulses/s instead of %d/%d: %s" % (rate, num, den, hint))


def _pins_that_follow(source, pin):
    """Which of the processor's pins rise with a sample and fall with read(), all the time: "Pin.cpu.E1", "" for none.

    No pin's mode is changed: what is no input by itself is not found. On stm32 every pin is one after a reset. EXT_...:
    those of a Pico W's radio chip.
    """
    cpu = getattr(type(pin), "cpu", None)
    names = [name for name in dir(cpu) if name[0] != "_" and name[:3] != "EXT"] if cpu else []
    imu = source.imu
    source.configure(_LOOK_HZ)
    imu.configure_interrupt(latch=True)
    for _ in range(_LOOKS):
        time.sleep_ms(1500 // _LOOK_HZ)
        names = [name for name in names if getattr(cpu, name).value()]
        for _ in range(3000 // _LOOK_HZ):
            if imu.read() & 1:
                break  # just now: there is time to look at them all
            time.sleep_ms(1)
        names = [name for name in names if not getattr(cpu, name).value()]
    source.configure(source.config.RATE)
    return " or ".join(["Pin.cpu." + name for name in names])


def _report_fifo(source, needed, problems):
    """Whether all that the chip queues at RATE can be fetched."""
    imu, got = source.imu, 0
    num, den = imu.sample_rate
    overflows = imu.fifo_overflows
    try:
        imu.fifo_enable(_BATCH)
        start = time.ticks_ms()
        while time.ticks_diff(time.ticks_ms(), start) < _MEASURE_MS:
            n = imu.fifo_poll()
            for _ in range(n):
                got += imu.fifo_next() & 1
            if not n:
                time.sleep_ms(1)
        imu.fifo_disable()
    except OSError as why:
        problems.append("FIFO: %s" % why)
        return
    overflows = imu.fifo_overflows - overflows
    rate = got * 1000 // _MEASURE_MS
    print("FIFO: %d packets/s of %d/%d, %d overflows" % (rate, num, den, overflows))
    needed = source.config.DRIVE == "fifo" or (needed and source.config.DRIVE is None)
    if needed and (overflows or rate * den < 0.9 * num):
        problems.append(
            "FIFO: %d packets/s instead of %d/%d: choose a lower RATE, or a faster bus"
            % (rate, num, den)
        )


def _measure_step(board, settings):
    """How long a step of the firmware's own tick takes -> (mean, longest) in us; why it cannot be had; None with the
    DMP, and without the sensor, which is examined later."""
    from upright import ahrs, filters

    if settings.filter_name(6) in filters.HARDWARE:
        return None  # the chip makes the steps
    try:
        imu = ahrs.from_board(board, drive="manual", measure_bias=False, keep_bias=False, log=None)
        imu.start()
    except OSError:
        return None
    except ValueError as why:
        return str(why)
    num, den = settings.RATE
    period, total, most = 1000000 * den // num, 0, 0
    for _ in range(_STEPS):
        began = time.ticks_us()
        imu.tick.on_sample(None)
        took = time.ticks_diff(time.ticks_us(), began)
        total += took
        most = max(most, took)
        time.sleep_us(max(period - took, 0))
    imu.stop()
    return total // _STEPS, most


def _report_step(step, settings, problems):
    if step is None:
        return
    if isinstance(step, str):
        problems.append("start: %s" % step)
        return
    num, den = settings.RATE
    period = 1000000 * den // num
    print("step: %d us, at most %d, of a period of %d" % (step + (period,)))
    if step[1] > period:
        problems.append(
            "step: up to %d us, but RATE leaves %d: RATE %d, a faster bus or a lighter filter"
            % (step[1], period, 800000 // step[1])
        )


def _report_chips(source, problems):
    """-> whether samples come."""
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
        return False
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
    if mag is not None:
        _report_magnetometer(mag, fields, square, problems)
    return True


def _report_magnetometer(mag, fields, square, problems):
    rate = fields * 1000 // _MEASURE_MS
    print("magnetometer: %s, %d/%d Hz (%d/s read)" % ((mag.chip,) + mag.sample_rate + (rate,)))
    if not fields:
        problems.append("magnetometer: it answers, but no measurement is ever fresh")
        return
    num, den = getattr(mag, "lsb_per_uT", (33, 10))
    strength = math.sqrt(square / fields) * den / num
    print("field: %d uT" % strength)
    if not MICROTESLA[0] <= strength <= MICROTESLA[1]:
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
