# MicroPython's `time` in simulated time: what time.py and utime.py are. Portable.

import kernel

_PERIOD = 1 << 30

ticks_us = kernel.ticks_us
ticks_ms = kernel.ticks_ms
ticks_cpu = kernel.ticks_us
sleep_us = kernel.sleep_us


def sleep_ms(ms):
    kernel.sleep_us(ms * 1000)


def sleep(s):
    kernel.sleep_us(int(s * 1000000))


# The built-in ones do not allocate; these may, where an intermediate is beyond 30 bits.
def ticks_diff(a, b):
    kernel.enter()
    d = ((a - b + _PERIOD // 2) & (_PERIOD - 1)) - _PERIOD // 2
    kernel.leave()
    return d


def ticks_add(t, delta):
    kernel.enter()
    t = (t + delta) & (_PERIOD - 1)
    kernel.leave()
    return t


def time():
    return kernel.now() // 1000000


def time_ns():
    return kernel.now() * 1000
