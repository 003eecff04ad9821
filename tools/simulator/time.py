# `time` in simulated time, for the unix port (a file on the path overrides the built-in there). CPython keeps its own
# `time`, to which the shim adds the same functions.

from simulated_time import *  # noqa: F403
