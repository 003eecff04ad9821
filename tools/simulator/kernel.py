# Simulated time and interrupts: the clock, the hard and soft callbacks, and who holds the heap lock.
# Portable: CPython and the MicroPython unix port. Everything above (machine, time) and the chips' wiring stands on it.
#
# Time moves only when somebody lets it pass: a bus transfer, a sleep, an idle loop. Code itself costs nothing, unless
# `irq_cost_us` says what a hard callback takes. A hard callback runs with the heap locked, as on a board; the
# simulator's own code unlocks it on entry and locks it again on exit (enter, leave), so that only the code under
# test is held to the lock.

import micropython

_TICKS_MASK = 0x3FFFFFFF  # MicroPython's tick counters wrap at 2**30 on 32-bit boards


class PowerOff(SystemExit):
    """The simulation's end (stop_at) reached the main program."""


class Reset(SystemExit):
    """The simulated board resets; args[0] is the cause, as machine.reset_cause() gives it."""


class Irq:
    """One interrupt source: a callback that is hard (heap locked, at once) or soft (in the main program's time)."""

    def __init__(self, handler, argument, hard):
        self.handler = handler
        self.argument = argument
        self.hard = hard
        self.pending = False
        self.lost = 0  # requests that came while one was pending: real hardware has one flag only
        self.on_error = None  # called when an exception escapes a hard callback

    def request(self):
        global irqs_lost
        if self.pending:
            self.lost += 1
            irqs_lost += 1
            return
        self.pending = True
        (_hard if self.hard else _soft).append(self)

    def cancel(self):
        self.pending = False
        for queue in (_hard, _soft):
            if self in queue:
                queue.remove(self)


def reset():
    """A fresh machine: time 0, nothing scheduled."""
    global _now, _in_irq, _in_soft, _masked, _next, _sources, _hard, _soft, _stop_us, _busy
    global irq_cost_us, after_irq, uncaught, irq_count, reset_request, _locked
    global longest_irq_us, main_exception, irqs_lost
    _now = 0
    _in_irq = False
    _in_soft = False
    _masked = False
    _locked = False
    _busy = 0  # bus transfers under way
    _next = -1  # when the next source is due; -1: not known
    _sources = []  # objects with due() -> us or None, and fire(now)
    _hard = []
    _soft = []
    _stop_us = None
    irq_cost_us = 0
    after_irq = None  # the harness's observer, called after every hard callback, heap unlocked
    uncaught = []  # exceptions that escaped a hard callback
    irq_count = 0
    irqs_lost = 0  # of all of them
    longest_irq_us = 0  # of the hard callbacks
    reset_request = None
    main_exception = None  # raised in the main program at its next step: Ctrl-C


def restart():
    """The processor resets: callbacks, masks and locks are gone. Time and the wiring go on."""
    global _in_irq, _in_soft, _masked, _locked, _busy, _hard, _soft, reset_request, main_exception
    _in_irq = _in_soft = _masked = _locked = False
    _busy = 0
    _hard = []
    _soft = []
    reset_request = main_exception = None


def now():
    return _now


def in_irq():
    return _in_irq


def enter():
    """The simulator's code begins: it may allocate."""
    if _locked:
        micropython.heap_unlock()


def leave():
    if _locked:
        micropython.heap_lock()


def ticks_us():
    enter()
    t = _now & _TICKS_MASK
    leave()
    return t


def ticks_ms():
    enter()
    t = _now // 1000 & _TICKS_MASK
    leave()
    return t


def stop_at(us):
    """PowerOff is raised in the main program once this time is reached (None: never)."""
    global _stop_us
    _stop_us = us


def add_source(source):
    if source not in _sources:
        _sources.append(source)
    changed()


def sources():
    return list(_sources)


def remove_source(source):
    if source in _sources:
        _sources.remove(source)
    changed()


def changed():
    """Some source's due time may be another now."""
    global _next
    _next = -1


_FAR = 1 << 60


def next_due():
    global _next
    if _next < 0:
        _next = _FAR
        for source in _sources:
            due = source.due()
            if due is not None and due < _next:
                _next = due
    return _next


def begin_transfer():
    global _busy
    _busy += 1


def end_transfer():
    global _busy
    _busy -= 1
    if not _busy and not _in_irq:
        _main_turn()


def advance(us):
    """Let time pass. What falls due happens at its time; hard callbacks run unless one is running already."""
    advance_to(_now + us)


def advance_to(target):
    global _now, _next
    while True:
        due = next_due()
        if due > target:
            break
        if due > _now:
            _now = due
        _next = -1
        for source in list(_sources):
            at = source.due()
            if at is not None and at <= _now:
                source.fire(_now)
        if _hard and not _in_irq and not _masked:
            _run_hard()
    if target > _now:
        _now = target
    if _in_irq:
        return
    if _hard and not _masked:
        _run_hard()
    if not _busy:
        _main_turn()


def _main_turn():
    """What the main program meets between two of its steps: soft callbacks, a reset, the end of the simulation."""
    global main_exception
    _run_soft()
    if main_exception is not None and not _in_soft:
        error, main_exception = main_exception, None
        raise error
    if reset_request is not None:
        raise Reset(reset_request)
    if _stop_us is not None and _now >= _stop_us:
        raise PowerOff("simulation ended")


def sleep_us(us):
    """time.sleep_us in the main program, with soft callbacks meanwhile; in a callback it holds everything up, as on a
    board."""
    enter()
    end = _now + us
    if not _in_irq and not _in_soft and not _busy:
        while next_due() < end:
            advance_to(max(_now, next_due()))
    if _now < end:
        advance_to(end)
    leave()


def idle():
    """machine.idle: to the next event, at most a millisecond away."""
    advance_to(max(_now, min(next_due(), _now + 1000)))


def hold(on):
    """Keep hard interrupts from coming, as a program does that disables them for long."""
    global _masked
    _masked = on


def mask(on):
    """Disable or enable hard interrupts; -> the former state."""
    global _masked
    before = _masked
    _masked = on
    if not on and _hard and not _in_irq:
        _run_hard()
    return before


def _run_hard():
    global _in_irq, _locked, irq_count, longest_irq_us
    while _hard:
        if _stop_us is not None and _now >= _stop_us:
            return  # callbacks longer than their period would starve the main program for ever
        irq = _hard.pop(0)
        irq.pending = False
        irq_count += 1
        handler, argument, error = irq.handler, irq.argument, None
        _in_irq = True
        _locked = True
        began = _now
        micropython.heap_lock()
        try:
            handler(argument)
        except BaseException as e:
            error = e
        micropython.heap_unlock()
        _locked = False
        if irq_cost_us:
            advance(irq_cost_us)
        _in_irq = False
        if _now - began > longest_irq_us:
            longest_irq_us = _now - began
        if error is not None:
            uncaught.append(error)
            print("uncaught exception in a hard callback:", repr(error))
            if irq.on_error:
                irq.on_error()
        if after_irq:
            after_irq()


def _run_soft():
    global _in_soft
    if _in_soft:
        return
    _in_soft = True
    try:
        while _soft:
            irq = _soft.pop(0)
            irq.pending = False
            irq.handler(irq.argument)
    finally:
        _in_soft = False


reset()
