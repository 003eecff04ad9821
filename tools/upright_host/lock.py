"""One process at a time: a file as a lock, let go by the system when its process ends. Standard library only."""

import contextlib
import errno

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
    import msvcrt


@contextlib.contextmanager
def held(path):
    """Wait until no other process holds this file, which is made when missing, and hold it."""
    with open(path, "wb") as file:
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_EX)
        else:
            _wait_on_windows(file)
        yield


def _wait_on_windows(file):
    while True:
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)
            return
        except OSError as why:
            if why.errno != errno.EDEADLK:  # that is: not let go within 10 s
                raise
