# A plan of faults, carried out on a simulated board while its firmware runs. A plan is a list of
# [at_us, on, fault, for_us, value...]: at this time, on this part, this fault, this long (None: for ever, and for those
# that are a moment). FAULTS below is the list of what there is. Portable: CPython and the MicroPython unix port.

import builtins

import kernel
import machine

_DATA = 0x3B  # ACCEL_XOUT_H, then 14 bytes
_DATA_BYTES = 14
_AXES = (0, 2, 4, 8, 10, 12)  # accel x y z, gyro x y z behind it
EXCEPTIONS = {
    "KeyboardInterrupt": KeyboardInterrupt,
    "MemoryError": MemoryError,
    "OSError": OSError,
    "ValueError": ValueError,
}
ENOSPC = 28
EROFS = 30


# Each fault is begin(board, part, *value) and, where it lasts, end(board, part, *value).


def _nack(board, part, n=1, after=0):
    part.nack_next(n, after)


def _silent(board, part):
    part.vanish()


def _heard(board, part):
    part.come_back()


def _plugged_in(board, part):
    part.come_back()
    power = getattr(part, "brown_out", None) or part.power_up
    power()


def _swapped(board, part, identity):
    part._identity = identity
    _plugged_in(board, part)


def _flip(board, part, register, bits):
    part.poke(register, part.register(register) ^ bits)


def _zeros(board, part):
    for i in range(_DATA_BYTES):
        part.stick(_DATA + i, 0)


def _frozen(board, part):
    for i in range(_DATA_BYTES):
        part.stick(_DATA + i, part.register(_DATA + i))


def _thawed(board, part):
    for i in range(_DATA_BYTES):
        part.stick(_DATA + i)


def _stuck_axis(board, part, axis, word=0x7FFF):
    part.stick(_DATA + _AXES[axis], word >> 8)
    part.stick(_DATA + _AXES[axis] + 1, word & 0xFF)


def _loose_axis(board, part, axis, word=0x7FFF):
    part.stick(_DATA + _AXES[axis])
    part.stick(_DATA + _AXES[axis] + 1)


def _overflow(board, part):
    for _ in range(part.fifo.size + 1):
        if part.fifo.push(0, part._fifo_stops()):
            part._fifo_overflow()


def _magnet(board, part, x, y, z):
    part.disturbance = (x, y, z)


def _no_magnet(board, part, *_):
    part.disturbance = (0, 0, 0)


def _low(board, part, line="sda"):
    part.stuck = line


def _released(board, part, line="sda"):
    part.stuck = False


def _swallow(board, part):
    part.swallows = True


def _tell(board, part):
    part.swallows = False


def _raise_in_tick(board, part, name):
    part.raises = EXCEPTIONS[name]


def _raise_in_main(board, part, name):
    kernel.main_exception = EXCEPTIONS[name]("a fault")


def _raise_in_on_step(board, part, name):
    board.on_step_raises = EXCEPTIONS[name]


def _cut_edges(board, part):
    for wire in machine.wires():
        wire.cut = True


def _mend_edges(board, part):
    for wire in machine.wires():
        wire.cut = False


def _mask(board, part):
    kernel.hold(True)


def _unmask(board, part):
    kernel.hold(False)


def _stop_timers(board, part):
    machine.Timer.silent = True


def _start_timers(board, part):
    machine.Timer.silent = False


def _hang(board, part):
    board.hangs = True


def _unhang(board, part):
    board.hangs = False


def _disk_full(board, part):
    board.disk_error = ENOSPC


def _read_only(board, part):
    board.disk_error = EROFS


def _disk_well(board, part):
    board.disk_error = 0


# name: (begin, end, the parts that it can be on)
_CHIPS = "imu mag display"
FAULTS = {
    "nack": (_nack, None, _CHIPS),
    "silent": (_silent, _heard, _CHIPS),
    "unplugged": (_silent, _plugged_in, _CHIPS),
    "swapped": (_silent, _swapped, "imu"),
    "brown_out": (lambda board, part: part.brown_out(), None, "imu mag"),
    "jam": (lambda board, part: part.jam(), None, "imu"),
    "flip": (_flip, None, "imu mag"),
    "zeros": (_zeros, _thawed, "imu"),
    "frozen": (_frozen, _thawed, "imu"),
    "stuck_axis": (_stuck_axis, _loose_axis, "imu"),
    "overflow": (_overflow, None, "imu"),
    "magnet": (_magnet, _no_magnet, "mag"),
    "low": (_low, _released, "bus"),
    "swallow": (_swallow, _tell, "bus"),
    "raise": (_raise_in_tick, None, "bus"),
    "raise_in_main": (_raise_in_main, None, "board"),
    "raise_in_on_step": (_raise_in_on_step, None, "board"),
    "edges": (_cut_edges, _mend_edges, "board"),
    "masked": (_mask, _unmask, "board"),
    "no_ticks": (_stop_timers, _start_timers, "board"),
    "hang": (_hang, _unhang, "board"),
    "disk_full": (_disk_full, _disk_well, "board"),
    "read_only": (_read_only, _disk_well, "board"),
}

# The values of those that take some: how many at least, then for each its least and most, or its names
_NAMES = tuple(EXCEPTIONS)
_VALUES = {
    "nack": (0, (1, 10000), (0, 10000)),
    "swapped": (1, (0, 0xFF)),
    "flip": (2, (0, 0x7F), (0, 0xFF)),
    "stuck_axis": (1, (0, 5), (0, 0xFFFF)),
    "magnet": (3, (-32768, 32767), (-32768, 32767), (-32768, 32767)),
    "low": (0, ("sda", "scl")),
    "raise": (1, _NAMES),
    "raise_in_main": (1, _NAMES),
    "raise_in_on_step": (1, _NAMES),
}
_MOST_US = 10**12


def _is_us(value, least=0):
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= _MOST_US


def _check_values(entry):
    least, *kinds = _VALUES.get(entry[2], (0,))
    values = entry[4:]
    if not least <= len(values) <= len(kinds):
        raise ValueError("%r: it takes %d to %d values" % (entry, least, len(kinds)))
    for value, kind in zip(values, kinds):
        if isinstance(kind[0], str):
            if value not in kind:
                raise ValueError("%r: %r is not one of %s" % (entry, value, ", ".join(kind)))
        elif not isinstance(value, int) or not kind[0] <= value <= kind[1]:
            raise ValueError("%r: %r is no int from %d to %d" % (entry, value, kind[0], kind[1]))


def check(plan):
    """Raise ValueError for an entry that is none, with what is wrong."""
    if not isinstance(plan, list):
        raise ValueError("a plan is a list of [at_us, on, fault, for_us, value...]")
    for entry in plan:
        if not isinstance(entry, list) or len(entry) < 4:
            raise ValueError("%r is not [at_us, on, fault, for_us, value...]" % (entry,))
        at, on, name, lasts = entry[:4]
        if not isinstance(name, str) or name not in FAULTS:
            raise ValueError("no fault %r; there are %s" % (name, ", ".join(sorted(FAULTS))))
        if not isinstance(on, str) or on not in FAULTS[name][2].split():
            raise ValueError("%s can be on %s, not on %r" % (name, FAULTS[name][2], on))
        if not _is_us(at) or not (lasts is None or _is_us(lasts, 1)):
            raise ValueError("%r: at_us and for_us are whole microseconds" % (entry,))
        if name == "swapped" and lasts is None:
            raise ValueError("%r: another chip comes after for_us" % (entry,))
        _check_values(entry)


class Plan:
    """The plan as a source of kernel.py. parts: {name: chip model, bus, or None}; start_us: when its time 0
    is."""

    def __init__(self, plan, parts, start_us=0):
        check(plan)
        self.on_step_raises = None
        self.hangs = False
        self.disk_error = 0
        self._due = []  # (at, number, function, part, values)
        for number, entry in enumerate(plan):
            at, on, name, lasts = entry[:4]
            at += start_us
            begin, end, _ = FAULTS[name]
            part = parts.get(on)
            if part is None and on != "board":
                raise ValueError("this board has no %s" % on)
            values = entry[4:]
            # swapped: the value is for its end
            first = [] if name == "swapped" else values
            self._due.append((at, 2 * number, begin, part, first))
            if end is not None and lasts is not None:
                self._due.append((at + lasts, 2 * number + 1, end, part, values))
        self._due.sort(key=lambda item: item[:2])

    def due(self):
        return self._due[0][0] if self._due else None

    def fire(self, now):
        _, _, function, part, values = self._due.pop(0)
        function(self, part, *values)
        kernel.changed()

    def on_step(self, imu):
        """The program's control loop."""
        if self.on_step_raises is not None:
            error, self.on_step_raises = self.on_step_raises, None
            raise error

    def wait(self):
        """The main program passes here; it hangs as long as it is to hang."""
        while self.hangs:
            kernel.advance(1000)

    def guard_disk(self):
        """Writes fail while the disk is full or read-only."""
        real = builtins.open

        def guarded(path, mode="r", *more, **options):
            if self.disk_error and ("w" in mode or "a" in mode or "+" in mode):
                raise OSError(self.disk_error)
            return real(path, mode, *more, **options)

        builtins.open = guarded
