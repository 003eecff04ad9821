# Runs first on the board: room for an exception raised in a hard interrupt, where nothing can be allocated.

import micropython

if hasattr(
    micropython, "alloc_emergency_exception_buf"
):  # built in on boards, left out of some unix ports
    micropython.alloc_emergency_exception_buf(100)
