"""Runs `-c CODE ARGUMENTS` as Windows would: without what only POSIX has, with a stand-in for msvcrt.

What asks for the system while it is imported (typer, numpy, subprocess) is imported before, as it would look for the
real one.
"""

import errno
import fcntl
import os
import platform
import signal
import subprocess
import sys
import sysconfig
import tempfile
import types

HERE = os.path.abspath(__file__)
GONE = ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")
GONE_FROM_OS = (
    *("chroot", "fork", "geteuid", "getuid", "killpg", "mkfifo", "mknod"),
    *("sched_getaffinity", "setsid", "statvfs"),
)
_real = fcntl


def _locking(fd, mode, count):
    """As msvcrt.locking: refuses after a while."""
    try:
        _real.flock(fd, _real.LOCK_EX | _real.LOCK_NB)
    except BlockingIOError:
        raise OSError(errno.EDEADLK, "Resource deadlock avoided") from None


def pretend():
    subprocess.run([sys.executable, "-c", ""])  # it imports what it needs
    tempfile.TemporaryDirectory().cleanup()
    sysconfig.get_config_vars()
    platform.uname()
    for name in GONE:
        sys.modules[name] = None
    for name in GONE_FROM_OS:
        if hasattr(os, name):
            delattr(os, name)
    del signal.SIGKILL
    sys.modules["msvcrt"] = types.SimpleNamespace(LK_LOCK=1, locking=_locking)
    sys.platform = "win32"


if __name__ == "__main__":
    code = sys.argv[2]
    if "upright_host" in code:
        import multiprocessing.pool  # noqa: F401

        import mpremote.transport_serial  # noqa: F401
        import numpy  # noqa: F401
        import PIL.Image  # noqa: F401
        import rich.live  # noqa: F401
        import serial.tools.list_ports  # noqa: F401
        import typer.testing  # noqa: F401

        pretend()
        from upright_host import runtimes

        runtimes._ready["cpython"] = ([sys.executable, HERE], platform.python_version())
    else:
        pretend()
    sys.argv = ["-c", *sys.argv[3:]]
    exec(code, {"__name__": "__main__"})
