"""`upright faults`: what can break on a desk, done to the firmware on a simulated board, and held to bounds.

A plan is data: tools/simulator/faults.py has the faults. The firmware runs twice in the same world, with the plan and
without it, and judge() compares both runs.
"""

import json
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from upright_host import console, library, options, paths, scoring, simulate
from upright_host.console import Wrong

SECOND = 1_000_000
# The bounds, and docs/reliability.md
TRANSIENT_US = SECOND  # a fault of up to so long
SETTLED_US = 2 * SECOND  # is forgotten so long after its end
OFF_DEG = 1.0  # of an unfaulted run
RESUMED_US = 200_000  # after a chip's reset, until samples come again
SHOWN_US = 500_000  # until a permanent fault is shown
PERIODS = 2  # and one time-out of the bus: the longest tick
# After these the chip is at its reset values.
RESETS = ("brown_out", "unplugged")
# While these last there is no sample that could be used.
BLIND = ("silent", "unplugged", "low", "swallow", "zeros", "frozen", "swapped")
_MOTIONS = ("spin", "demo", "static")


@dataclass
class Case:
    """A plan and the board that it happens to. seconds: simulated; they end 2 s after the last fault at least."""

    name: str
    faults: list
    seconds: float = 8
    board_name: str = "sim"
    board: dict = field(default_factory=dict)
    motion: str = "spin"
    options: dict = field(default_factory=dict)  # others of run_firmware.py
    flash: dict = field(default_factory=dict)  # {name: text} of the board's file system
    text: str = ""  # what it stands for

    def config(self):
        return self.options | {
            "board_name": self.board_name,
            "board": self.board,
            "seconds": self.seconds,
            "frame_ms": 100,
        }


@dataclass
class Run:
    """What a run left: the result, the console, for each step its time in us, its flags, its attitude."""

    result: dict
    lines: list
    times: np.ndarray
    flags: np.ndarray
    q: np.ndarray


def world(name: str, seconds: float, path: Path) -> Path:
    """The .imu file of a motion."""
    motions = library.simulator("motions")
    motions.render(name, rate=(1000, 1), seconds=seconds).write(path, truth=True)
    return path


def run(case: Case, runtime: str, world: Path, faulty: bool = True) -> Run:
    """Run the firmware once; faulty False: without the plan."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        flash = Path(folder) / "flash"
        flash.mkdir()
        for name, text in case.flash.items():
            (flash / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        out = Path(folder) / "steps"
        config = case.config() | {"world": str(world), "out": str(out)}
        config["faults"] = case.faults if faulty else []
        result = simulate.run(
            runtime,
            simulate.FIRMWARE,
            config,
            lambda kind, fields: lines.append(fields[0]) if kind == "console" else None,
            flash,
        )
        times, flags = simulate.read_flags(out)
        _, q = simulate.read_steps(out)
    return Run(result, lines, times, flags, q / scoring.ONE)


def ends(faults: list) -> list:
    """[(begin, end or None)] of the faults in their order; a moment ends when it begins."""
    library.simulator("kernel")
    momentary = {name for name, (_, end, _) in library.simulator("faults").FAULTS.items() if end is None}
    return [
        (at, at if name in momentary else None if lasts is None else at + lasts)
        for at, _, name, lasts, *_ in sorted(faults, key=lambda fault: fault[0])
    ]


def judge(case: Case, run: Run, clean: Run) -> list[str]:
    """The bounds that the run broke, a line for each."""
    broken = []

    def demand(good, text):
        if not good:
            broken.append(text)

    result, faults = run.result, sorted(case.faults, key=lambda fault: fault[0])
    demand(result["started"], "it never started")
    if not result["started"]:
        return broken
    raised = [fault[4] for fault in faults if fault[2] == "raise"]
    wanted = sum(name != "KeyboardInterrupt" for name in raised)
    whole = not result["board_resets"] and not any(fault[2].startswith("raise") for fault in faults)
    if whole:  # else the counters began anew
        demand(
            result["crashes"] == wanted, f"{result['crashes']} crashes of the tick: {result['error']}"
        )
    demand(result["uncaught"] == 0, f"{result['uncaught']} exceptions left a hard callback")
    demand(result["cuts"] == 0, f"{result['cuts']} transfers were cut")
    most = PERIODS * result["period_us"] + result["timeout_us"]
    demand(
        result["longest_tick_us"] <= most, f"a tick took {result['longest_tick_us']} us of {most}"
    )
    spans = ends(faults)
    for i, (begin, end) in enumerate(spans):
        following = spans[i + 1][0] if i + 1 < len(spans) else case.seconds * SECOND
        _, on, name, *_ = faults[i]
        if end is None:
            _judge_permanent(name, on, begin, result, demand)
        elif end - begin <= TRANSIENT_US:
            _judge_transient(case, run, clean, (begin, end, following), name, on, demand)
    return broken


def _judge_permanent(name, on, begin, result, demand):
    flag = {"imu": "sensor_lost", "bus": "sensor_lost", "mag": "magnetometer_lost"}.get(on)
    if flag is None or name not in BLIND:
        return
    shown = [at - begin for at, what, value in result["changes"] if what == flag and value]
    shown = [us for us in shown if us >= 0]
    demand(shown and shown[0] <= SHOWN_US, f"{name}: {flag} was shown after {shown[:1]} us")


def _judge_transient(case, run, clean, span, name, on, demand):
    begin, end, following = span
    if on == "imu" and name in RESETS:
        fresh = run.times[(run.flags & 1 > 0) & (run.times > end)]
        waited = fresh[0] - end if len(fresh) else None
        demand(
            waited is not None and waited <= RESUMED_US,
            f"{name}: samples came again after {waited} us",
        )
    since = end + SETTLED_US
    if since < following:
        inclination, yaw = differences(run, clean, since, following)
        if inclination is None:
            demand(False, f"{name}: no step is left to compare after {since / SECOND} s")
            return
        demand(inclination <= OFF_DEG, f"{name}: the inclination is {inclination:.2f} deg off")
        if case.motion != "demo":
            demand(yaw <= OFF_DEG, f"{name}: the yaw is {yaw:.2f} deg off")


def differences(run: Run, clean: Run, since, until):
    """The largest differences between both runs in that time, degrees: (inclination, yaw); None: nothing to compare."""
    pick = (run.times >= since) & (run.times < until)
    if not pick.any() or not len(clean.times):
        return None, None
    times, q = run.times[pick], run.q[pick]
    near = np.clip(np.searchsorted(clean.times, times), 1, len(clean.times) - 1)
    near -= times - clean.times[near - 1] < clean.times[near] - times
    # a step apart is the motion of a step: only those that are close in time
    close = abs(clean.times[near] - times) <= 1000
    if not close.any():
        return None, None
    a, b = q[close], clean.q[near[close]]
    tilt = np.arccos(np.clip((_up(a) * _up(b)).sum(1), -1, 1))
    w, x, y, z = _times_conjugate(a, b).T
    yaw = 2 * np.arctan2(z, w)
    yaw = abs((yaw + np.pi) % (2 * np.pi) - np.pi)
    return float(np.degrees(tilt.max())), float(np.degrees(yaw.max()))


def _up(q):
    w, x, y, z = q.T
    return np.stack(
        [2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z], 1
    )


def _times_conjugate(a, b):
    """a b*, the rotation in the earth frame from b's attitude to a's."""
    w, x, y, z = a.T
    p, r, s, t = b.T
    return np.stack(
        [
            w * p + x * r + y * s + z * t,
            -w * r + x * p - y * t + z * s,
            -w * s + x * t + y * p - z * r,
            -w * t - x * s + y * r + z * p,
        ],
        1,
    )
