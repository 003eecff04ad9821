"""Runs the simulator's scripts on a runtime and follows what they say: the console, progress, pictures, the result."""

import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from upright_host import paths, runtimes
from upright_host.console import Failed

REPLAY = paths.SIMULATOR / "run_replay.py"
FIRMWARE = paths.SIMULATOR / "run_firmware.py"


class SimulationError(Failed):
    """The script did not run to its end; the message holds the last lines that it said."""


def best_runtime() -> str:
    """The quickest runtime that checks for allocation, else cpython."""
    for name in ("unix", "unix32"):
        try:
            runtimes.interpreter(name)
            return name
        except runtimes.Unavailable:
            pass
    return "cpython"


def run(runtime: str, script: Path, config: dict, on_event=None, flash: Path | None = None) -> dict:
    """Run a script of tools/simulator with its configuration; -> its result.

    flash: the folder that is the board's file system, where it keeps its calibration; None: an empty one.
    on_event(kind, fields) is called for every line: kind is "console" (fields: [line]) or the first word of a line
    that the script meant for the host ("frame", "time", "at"), with the other words in fields.
    Raises SimulationError, and runtimes.Unavailable.
    """
    result, said = None, []
    with tempfile.TemporaryDirectory() as folder:
        # In a file, since an argument of more than 255 bytes is too long for MicroPython.
        told = Path(folder) / "config"
        told.write_text(json.dumps(config))
        argv, environment = runtimes.command(
            runtime, script, [told], config.get("board_name", "sim")
        )
        with (
            open(Path(folder) / "errors", "w+", encoding="utf-8") as errors,
            subprocess.Popen(
                argv,
                env=environment,
                cwd=flash or folder,
                stdout=subprocess.PIPE,
                stderr=errors,
                encoding="utf-8",
                bufsize=1,
            ) as process,
        ):
            try:
                for line in process.stdout:
                    line = line.rstrip("\n")
                    if line.startswith("\tresult "):
                        result = json.loads(line[8:])
                    elif line.startswith("\t"):
                        kind, *fields = line[1:].split(" ")
                        if on_event:
                            on_event(kind, fields)
                    else:
                        said.append(line)
                        if on_event:
                            on_event("console", [line])
            except BaseException:
                process.kill()
                raise
            code = process.wait()
            errors.seek(0)
            tail = errors.read().strip().splitlines()[-8:]
    if code or result is None:
        lines = "\n".join(said[-4:] + tail)
        raise SimulationError(f"{script.name} on {runtime} ended with {code}:\n{lines}")
    return result


def read_attitudes(path: Path) -> np.ndarray:
    """What run_replay.py wrote: int32 (n, 4), Q29."""
    return np.fromfile(path, "<i4").reshape(-1, 4)


def read_steps(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """What run_firmware.py wrote -> (world row of each step (n,), attitudes int32 (n, 4), Q29)."""
    steps = _steps(path)
    return steps[:, 0], steps[:, 1:5]


def read_flags(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """What run_firmware.py wrote -> (time of each step in us (n,), flags of its sample (n,))."""
    steps = _steps(path)
    return steps[:, 6], steps[:, 5]


def _steps(path: Path) -> np.ndarray:
    return np.fromfile(path, "<i4").reshape(-1, 7)
