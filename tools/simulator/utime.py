# `utime` in simulated time, for CPython. On MicroPython the name asks for the built-in one, so machine.py puts the
# simulated one in its place.

from simulated_time import *  # noqa: F403
