"""`upright faults`: what can break on a desk, done to the firmware on a simulated board, and held to bounds.

A plan is data: tools/simulator/faults.py has the faults. The firmware runs twice in the same world, with the plan and
without it, and judge() compares both runs.
"""

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from upright_host import console, library, options, scoring, simulate
from upright_host.console import Wrong
from upright_host.fault_plans import PLANS, SECOND, Case

# The bounds, and docs/reliability.md
TRANSIENT_US = SECOND  # a fault of up to so long
SETTLED_US = 2 * SECOND  # is forgotten so long after its end
OFF_DEG = 1.0  # of an unfaulted run
RESUMED_US = 200_000  # after a chip's reset, until samples come again
SHOWN_US = 500_000  # until a permanent fault is shown
PERIODS = 2  # and one time-out of the bus: the longest tick
# After these the chip is at its reset values.
RESETS = ("brown_out", "unplugged")
# After these it is reset, and so samples at other times, within a step.
RESET = (*RESETS, "jam", "flip", "zeros", "frozen", "stuck_axis")
# While these last there is no sample that could be used.
BLIND = ("silent", "unplugged", "low", "swallow", "zeros", "frozen", "swapped")
STEADY = ("spin", "static")  # motions
SPIN_DPS = 360


@dataclass
class Run:
    """What a run left: the result, the console, for each step its time in us, its flags, its attitude."""

    result: dict
    lines: list
    times: np.ndarray
    flags: np.ndarray
    q: np.ndarray


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
    momentary = {
        name for name, (_, end, _) in library.simulator("faults").FAULTS.items() if end is None
    }
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
    wanted = sum(
        name not in ("KeyboardInterrupt", "OSError") for name in raised
    )  # the latter is a bus error
    # a new start counts anew, and its yaw begins at 0
    whole = not result["board_resets"] + result["interrupts"]
    whole = whole and not any(fault[2] == "raise_in_main" for fault in faults)
    if whole:
        demand(
            result["crashes"] == wanted,
            f"{result['crashes']} crashes of the tick: {result['error']}",
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
            _judge_transient(case, run, clean, (begin, end, following), name, on, whole, demand)
    return broken


def _judge_permanent(name, on, begin, result, demand):
    flag = {"imu": "sensor_lost", "bus": "sensor_lost", "mag": "magnetometer_lost"}.get(on)
    if flag is None or name not in BLIND:
        return
    shown = [at - begin for at, what, value in result["changes"] if what == flag and value]
    shown = [us for us in shown if us >= 0]
    demand(shown and shown[0] <= SHOWN_US, f"{name}: {flag} was shown after {shown[:1]} us")


def _judge_transient(case, run, clean, span, name, on, whole, demand):
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
        tilt, yaw = differences(run, clean, since, following)
        if not len(tilt):
            demand(False, f"{name}: no step is left to compare after {since / SECOND} s")
            return
        demand(tilt.max() <= OFF_DEG, f"{name}: the inclination is {tilt.max():.2f} deg off")
        _, before = differences(run, clean, begin - SECOND // 5, begin)
        if case.motion in STEADY and whole and len(before):
            # nothing brings a yaw back: what an earlier fault has left is not this one's
            off = abs((yaw - before[-1] + 180) % 360 - 180).max()
            most = OFF_DEG
            if name in RESET:
                most += SPIN_DPS * run.result["period_us"] / SECOND
            demand(off <= most, f"{name}: the yaw is {off:.2f} deg off")


def differences(run: Run, clean: Run, since, until):
    """How far apart both runs are at each step of that time, degrees: (inclination, yaw)."""
    last = clean.times[-1] if len(clean.times) else 0
    pick = (run.times >= since) & (run.times < min(until, last))
    if not pick.any():
        return np.empty(0), np.empty(0)
    times, q = run.times[pick], run.q[pick]
    # the clean run at these times, between two of its steps
    at = np.clip(np.searchsorted(clean.times, times), 1, len(clean.times) - 1)
    before, after = clean.q[at - 1], clean.q[at]
    after = np.where(((before * after).sum(1) < 0)[:, None], -after, after)
    span = np.maximum(clean.times[at] - clean.times[at - 1], 1)
    part = ((times - clean.times[at - 1]) / span)[:, None]
    there = before + part * (after - before)
    there /= np.linalg.norm(there, axis=1)[:, None]
    tilt = np.arccos(np.clip((_up(q) * _up(there)).sum(1), -1, 1))
    w, _, _, z = _times_conjugate(q, there).T
    return np.degrees(tilt), np.degrees(2 * np.arctan2(z, w))


def _up(q):
    w, x, y, z = q.T
    return np.stack([2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z], 1)


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


class Rig:
    """Runs cases on a runtime and judges them. folder: for the worlds. A run without faults serves all of its kind."""

    def __init__(self, runtime: str, folder: Path):
        self._runtime, self._folder, self._clean = runtime, folder, {}

    def world(self, case: Case) -> Path:
        path = self._folder / f"{case.motion}-{case.seconds}.imu"
        if not path.exists():
            motions = library.simulator("motions")
            errors = motions.DEFAULT_ERRORS
            if case.motion in STEADY:
                # nothing for the filter to learn about the vertical: a yaw that differs is the fault's
                x, y, _ = errors.gyro_bias_dps
                errors = replace(errors, gyro_bias_dps=(x, y, 0), gyro_scale_error=(0, 0, 0))
            motions.render(case.motion, rate=(1000, 1), seconds=case.seconds, errors=errors).write(
                path
            )
        return path

    def clean(self, case: Case) -> Run:
        """The run without the faults."""
        key = repr((case.config(), case.motion, case.flash))
        if key not in self._clean:
            self._clean[key] = run(case, self._runtime, self.world(case), False)
        return self._clean[key]

    def examine(self, case: Case) -> tuple[Run, list[str]]:
        """-> the run with its faults, and the bounds that it broke."""
        faulty = run(case, self._runtime, self.world(case))
        return faulty, judge(case, faulty, self.clean(case))


_LARGEST_PLAN = 1 << 20  # bytes
_COUNTERS = "missed crashes step_errors errors resets full_resets fifo_overflows display_errors"


def _counted(result) -> str:
    """The counters that are not 0."""
    names = [*_COUNTERS.split(), "mag_errors", "mag_resets", "interrupts", "board_resets"]
    return ", ".join(f"{name} {result[name]}" for name in names if result.get(name))


def _cases(names, file) -> list[Case]:
    if file:
        try:
            faults = json.loads(console.contents(file, _LARGEST_PLAN))
            library.simulator("faults").check(faults)
        except RecursionError:
            raise Wrong(f"{file}: too deep") from None
        except (OSError, ValueError) as why:
            raise Wrong(str(why) if isinstance(why, Wrong) else f"{file}: {why}") from None
        if any(on == "mag" for _, on, *_ in faults):
            raise Wrong(f"{file}: the simulated board has no mag")
        last = max((begin if end is None else end for begin, end in ends(faults)), default=0)
        return [Case(file.name, faults, seconds=max(8, last / SECOND + 4))]
    unknown = [name for name in names or () if name not in PLANS]
    if unknown:
        raise Wrong(f"no plan {', '.join(unknown)}; `upright faults --list` names them")
    return [PLANS[name] for name in names or PLANS]


def register(app: typer.Typer) -> None:
    """Give an app the command `faults`."""

    @app.command("faults")
    def faults_command(
        names: list[str] = typer.Argument(None, help="Plans by their name (default: all)."),
        file: Path = typer.Option(
            None, help="A plan of your own: JSON, a list of [at_us, on, fault, for_us, value...]."
        ),
        show: bool = typer.Option(False, "--list", help="Name the plans and stop."),
        runtime: str = options.runtime(),
    ):
        """Break the simulated board in every known way while the firmware runs, and hold it to bounds."""
        cases = _cases(names, file)
        if show:
            table = Table(box=None, pad_edge=False)
            for column in ("plan", "what happens", "as data"):
                table.add_column(column)
            for case in cases:
                table.add_row(case.name, case.text, json.dumps(case.faults))
            console.show(table)
            return
        runtime = runtime or simulate.best_runtime()
        failed = 0
        with tempfile.TemporaryDirectory() as folder:
            rig = Rig(runtime, Path(folder))
            for case in cases:
                faulty, broken = rig.examine(case)
                verdict = "BROKEN" if broken else "ok"
                failed += bool(broken)
                console.say(
                    f"{verdict:<7}{case.name}: {_counted(faulty.result) or 'nothing counted'}"
                )
                for line in broken:
                    console.say(f"       {line}")
        console.say(f"{len(cases)} plans on {runtime}, {failed} broke a bound")
        if failed:
            raise typer.Exit(console.FAILED)
