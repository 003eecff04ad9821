"""The plans that `upright faults` and the tests run: every fault of tools/simulator/faults.py, where it hurts."""

from dataclasses import dataclass, field

SECOND = 1_000_000


@dataclass
class Case:
    """A plan and the board that it happens to. seconds: simulated; they end 2 s after the last fault at least."""

    name: str
    faults: list
    seconds: float = 8
    board_name: str = "sim"
    board: dict = field(default_factory=dict)
    motion: str = "spin"
    options: dict = field(default_factory=dict)  # others of run_firmware.py
    flash: dict = field(default_factory=dict)  # {name: text} of the board's file system
    text: str = ""  # what it stands for

    def config(self):
        return self.options | {
            "board_name": self.board_name,
            "board": self.board,
            "seconds": self.seconds,
            "frame_ms": 100,
        }


_T = 4 * SECOND  # the firmware has long started
_FIFO = {"DRIVE": "fifo"}
_EDGES = {"DRIVE": "data_ready"}
_NINE = {"board_name": "robomaster_a"}
_HALF = SECOND // 2


def _one(name, on, fault, lasts, *value, text="", **more):
    return Case(name, [[_T, on, fault, lasts, *value]], text=text, **more)


_MOMENTS = [
    _one("nack", "imu", "nack", None, text="one byte is refused"),
    _one("nack-burst", "imu", "nack", None, 20, text="20 in a row"),
    _one("nack-late", "imu", "nack", None, 1, 1, text="the register byte is refused"),
    Case(
        "nack-swallowed",
        [[_T, "bus", "swallow", SECOND], [_T + 1000, "imu", "nack", None, 40, 1]],
        text="as rp2: a refused register byte is not reported",
    ),
    _one("brown-out", "imu", "brown_out", None, text="the chip resets"),
    Case(
        "brown-out-in-burst",
        [[_T + 200, "imu", "brown_out", None]],
        text="the chip resets within a read",
    ),
    _one("brown-out-fifo", "imu", "brown_out", None, board=_FIFO),
    _one("brown-out-edges", "imu", "brown_out", None, board=_EDGES),
    _one("jam", "imu", "jam", None, text="it answers and samples no more"),
    _one("jam-fifo", "imu", "jam", None, board=_FIFO),
    _one("jam-edges", "imu", "jam", None, board=_EDGES),
    _one(
        "flip-range", "imu", "flip", None, 0x1B, 0x08, motion="static", text="a bit of GYRO_CONFIG"
    ),
    _one("flip-sleep", "imu", "flip", None, 0x6B, 0x40, text="the chip sleeps"),
    _one("flip-clock", "imu", "flip", None, 0x1A, 0x07, text="a bit of CONFIG"),
    _one("overflow", "imu", "overflow", None, board=_FIFO, text="the FIFO overflows"),
    _one("tick-raises", "bus", "raise", None, "ValueError", text="an exception in the tick"),
    _one("tick-no-heap", "bus", "raise", None, "MemoryError", text="an allocation in the tick"),
    _one("tick-ctrl-c", "bus", "raise", None, "KeyboardInterrupt", text="Ctrl-C in the tick"),
    _one(
        "on-step-raises", "board", "raise_in_on_step", None, "ValueError", text="the control loop"
    ),
    _one("on-step-ctrl-c", "board", "raise_in_on_step", None, "KeyboardInterrupt"),
    _one("main-raises", "board", "raise_in_main", None, "OSError", text="the main loop"),
]
_TRANSIENTS = [
    _one("silent", "imu", "silent", SECOND, text="a wire is off for a second"),
    _one("unplugged", "imu", "unplugged", SECOND, text="and its supply"),
    _one("zeros", "imu", "zeros", _HALF, text="all data are 0"),
    _one("frozen", "imu", "frozen", _HALF, text="the same sample again and again"),
    _one(
        "axis-full",
        "imu",
        "stuck_axis",
        _HALF,
        0,
        0x7FFF,
        text="accelerometer x saturated",
    ),
    _one("axis-stuck", "imu", "stuck_axis", _HALF, 5, 0, text="gyro z gives 0"),
    _one("sda-low", "bus", "low", SECOND, "sda", text="every transfer times out"),
    _one("scl-low", "bus", "low", SECOND, "scl"),
    _one("sda-low-stm32", "bus", "low", SECOND, "sda", options={"like": "stm32"}),
    _one("sda-low-fifo", "bus", "low", SECOND, "sda", board=_FIFO),
    _one("silent-fifo", "imu", "silent", SECOND, board=_FIFO),
    _one("silent-edges", "imu", "silent", SECOND, board=_EDGES),
    _one("edges-lost", "board", "edges", SECOND, board=_EDGES, text="INT's wire is off"),
    _one("unplugged-fifo", "imu", "unplugged", SECOND, board=_FIFO),
    _one("unplugged-edges", "imu", "unplugged", SECOND, board=_EDGES),
    _one("masked-fifo", "board", "masked", _HALF, board=_FIFO),
    _one("masked-edges", "board", "masked", _HALF, board=_EDGES),
    _one("masked", "board", "masked", 50_000, text="interrupts are off for 50 ms"),
    _one("masked-long", "board", "masked", _HALF, text="for half a second"),
    _one("no-ticks", "board", "no_ticks", 50_000, text="the timer does not call"),
    _one("display-silent", "display", "silent", SECOND),
    _one("display-unplugged", "display", "unplugged", SECOND),
    _one("display-nack", "display", "nack", None, 3),
    _one("magnetometer-silent", "mag", "silent", SECOND, **_NINE),
    _one("magnetometer-unplugged", "mag", "unplugged", SECOND, **_NINE),
    _one("magnet", "mag", "magnet", SECOND, 900, 300, 0, **_NINE, text="a magnet beside it"),
    _one("nine-axes-brown-out", "imu", "brown_out", None, **_NINE),
    _one("hang", "board", "hang", SECOND, text="the main program hangs for a second"),
    _one("disk-full", "board", "disk_full", SECOND),
    _one("read-only", "board", "read_only", SECOND),
]
_PERMANENT = [
    _one("gone", "imu", "silent", None, text="unplugged for good"),
    _one("gone-fifo", "imu", "silent", None, board=_FIFO),
    _one("gone-edges", "imu", "silent", None, board=_EDGES),
    _one("sda-low-for-ever", "bus", "low", None, "sda"),
    _one("another-chip", "imu", "swapped", SECOND // 5, 0x70, text="an MPU6500 in its place"),
    _one("zeros-for-ever", "imu", "zeros", None),
    _one("frozen-for-ever", "imu", "frozen", None),
    _one("magnetometer-gone", "mag", "silent", None, **_NINE),
    _one("nine-axes-gone", "imu", "silent", None, **_NINE),
    _one("display-gone", "display", "silent", None),
]
_STARTS = [
    Case(
        "ticks-wrap", [], options={"begin_us": (1 << 30) * 1000 - _T}, text="ticks_us and ticks_ms"
    ),
    Case("calibration-corrupt", [], flash={"upright_cal.json": '{"format": "upr'}),
    Case("calibration-empty", [], flash={"upright_cal.json": ""}),
    Case("calibration-no-text", [], flash={"upright_cal.json": b"\xff\x00\xfe"}),
    Case("read-only-for-ever", [[0, "board", "read_only", None]], motion="static", seconds=16),
    Case("full-for-ever", [[0, "board", "disk_full", None]], motion="static", seconds=16),
]
PLANS = {case.name: case for case in _MOMENTS + _TRANSIENTS + _PERMANENT + _STARTS}
