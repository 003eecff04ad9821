# Finishes an installation of Upright that was interrupted. `upright flash` knows this file by these first words (MARK
# there). It copies it to /upright.py, with a call of one of the two functions, and removes it at the end. /upright.py
# comes before lib/upright on the path, so `import upright` runs it first in any state of lib/upright. Needs no other
# file of Upright. Every port.

import os
import sys

STAGE = (
    "upright.new"  # the folder of the new files: "0", "1", ... in the order of their names below
)
SELF = "upright.py"


def finish(install, remove):
    """Put the staged files under their names, then remove what is named.

    After an interruption it starts from the beginning: every step has either been done or can be done.
    """
    is_new_main = False
    for i in range(len(install)):
        put = _put("%s/%d" % (STAGE, i), install[i])
        is_new_main |= put and install[i] == "main.py"
    for name in remove:
        _remove(name)
    try:
        os.rmdir(STAGE)
    except OSError:
        pass
    _remove(SELF)
    if __name__ == "upright":
        if is_new_main:
            _restart()  # the old one is running
        _give_way()


def refuse(names):
    """The board has no room for old and new files together, and the installation was interrupted between them. names:
    the files of Upright, for the next installation."""
    if __name__ == "upright":
        raise ImportError("an installation of Upright was cut off: run `upright flash` again")


def _put(staged, name):
    try:
        os.stat(staged)
    except OSError:
        return False  # it is in place already
    # on FAT MicroPython removes the old file first: for a moment there is none
    os.rename(staged, name)
    return True


def _remove(name):
    try:
        os.remove(name)
    except OSError:
        pass


def _restart():
    try:
        from machine import soft_reset
    except ImportError:
        return
    soft_reset()


def _give_way():
    """The program that imports this gets the package that has just been installed."""
    del sys.modules["upright"]
    package = __import__("upright")
    for name in dir(package):
        globals()[name] = getattr(package, name)
