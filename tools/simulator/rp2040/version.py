"""The one version of rp2040py that the harness was tried with. Importing this refuses every other."""

import importlib.metadata

TRIED = "0.3.6"


def check():
    """Raises ImportError, saying what is installed."""
    try:
        found = importlib.metadata.version("rp2040py")
    except importlib.metadata.PackageNotFoundError:
        found = "none"
    if found != TRIED:
        raise ImportError(
            f"the emulated board needs rp2040py {TRIED}, and {found} is installed: for another version its mends"
            " (tools/simulator/rp2040/emulator.py) have to be looked through"
        )


check()
