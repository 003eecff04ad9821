# Finishes an installation that was cut off: the new files are on the board in full, some not yet under their names.
# Runs at every boot, before anything else is imported. `upright flash` writes the journal. Every port.

import json
import os

JOURNAL = (
    "update.json"  # {"install": [names that lie here with .new behind them], "remove": [names]}
)
NEW = ".new"


def finish():
    """Put what the journal names in place -> False when there is no journal.

    Done again from the start after any interruption: every step either has been done or can be.
    """
    try:
        with open(JOURNAL) as file:
            steps = json.load(file)
    except (OSError, ValueError):
        return False
    for name in steps["install"]:
        _install(name)
    for name in steps["remove"]:
        _remove(name)
    _remove(JOURNAL)
    return True


def _install(name):
    try:
        os.stat(name + NEW)
    except OSError:
        return  # it is in place already
    try:
        os.rename(name + NEW, name)
    except OSError:
        # FAT does not rename over a file
        os.remove(name)
        os.rename(name + NEW, name)


def _remove(name):
    try:
        os.remove(name)
    except OSError:
        pass
