# The `micropython` module for CPython: enough for lib/ and firmware/ to be imported unchanged.
# Importing it also gives CPython viper's type names and MicroPython's additions to `time`; where a simulated
# machine (tools/simulator) is on the path, time is simulated time, else the wall clock.

import builtins
import time

_heap_locks = 0


def const(value):
    return value


def _as_it_is(value):
    return value


def viper(function):
    return function


native = viper
bytecode = viper


def heap_lock():
    """Counted only: CPython cannot refuse to allocate; the unix ports can, and do in the tests."""
    global _heap_locks
    _heap_locks += 1


def heap_unlock():
    global _heap_locks
    _heap_locks -= 1
    return _heap_locks


def heap_locked():
    return _heap_locks


def alloc_emergency_exception_buf(size):
    pass


def schedule(function, argument):
    function(argument)


def opt_level(level=0):
    return 0


for _name in ("ptr8", "ptr16", "ptr32"):
    setattr(builtins, _name, _as_it_is)
builtins.uint = lambda value: value & 0xFFFFFFFF

_TICKS_PERIOD = 1 << 30


def _wall_us():
    return time.perf_counter_ns() // 1000


def _add_to_time():
    """Give CPython's `time` the functions of MicroPython's that lib/ and firmware/ use."""
    try:
        import kernel

        now, sleep_us = kernel.now, kernel.sleep_us
    except ImportError:
        now = _wall_us

        def sleep_us(us):
            time.sleep(us / 1e6)

    def ticks_diff(a, b):
        return ((a - b + _TICKS_PERIOD // 2) & (_TICKS_PERIOD - 1)) - _TICKS_PERIOD // 2

    time.ticks_us = lambda: now() & (_TICKS_PERIOD - 1)
    time.ticks_ms = lambda: now() // 1000 & (_TICKS_PERIOD - 1)
    time.ticks_cpu = time.ticks_us
    time.ticks_diff = ticks_diff
    time.ticks_add = lambda t, delta: (t + delta) & (_TICKS_PERIOD - 1)
    time.sleep_ms = lambda ms: sleep_us(ms * 1000)
    time.sleep_us = sleep_us


_add_to_time()
