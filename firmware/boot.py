# Runs first on the board: finishes an interrupted installation, and makes room for an exception raised in a hard
# interrupt, where nothing can be allocated.

import micropython

try:
    from upright_app import update

    update.finish()
except ImportError:
    pass  # copied by hand, without it

if hasattr(
    micropython, "alloc_emergency_exception_buf"
):  # built in on boards, left out of some unix ports
    micropython.alloc_emergency_exception_buf(100)
