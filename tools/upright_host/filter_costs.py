"""What a filter of the registry costs an update, and how soon it finds up from a wrong start.

tools/simulator/bench/filter_cost.py is what runs; instructions are counted by tracing.py.
"""

import hashlib
import json
import os
import tempfile
import threading
from dataclasses import asdict, dataclass
from pathlib import Path

from upright_host import paths, runtimes, tracing

SCRIPT = paths.SIMULATOR / "bench" / "filter_cost.py"
TRACED = 32  # updates, the longest round of any filter; the magnetometer is fresh in four of them
ALLOCATIONS = 1000  # updates
TRACE_HEAP = "1M"
# those with a board's word size first: a float, say, takes other room on 64 bits
_BYTES_ON = ("unix32", "arm", "unix")


@dataclass(frozen=True)
class Cost:
    """Of one update: Thumb-2 instructions and bytes of the heap; None: not measured."""

    instructions: float | None = None
    bytes: float | None = None


class Meter:
    """Measures the filters' costs, and keeps them in the cache as long as no source changes.

    For use as a context manager; from several threads once it is entered. notes: what this machine cannot measure, a
    line each.
    """

    def __init__(self):
        self.notes: list[str] = []
        self._compiled = self._bytes_on = None
        self._lock = threading.Lock()

    def __enter__(self):
        self._folder = tempfile.TemporaryDirectory()
        versions = []
        try:
            versions.append(("arm", runtimes.interpreter("arm")[1]))
            folder = Path(self._folder.name)
            tracing.compile_for("arm", folder, SCRIPT, *paths.FIRMWARE.glob("*.py"))
            self._compiled = Path(self._folder.name)
        except (runtimes.Unavailable, tracing.TraceError) as why:
            self.notes.append(f"no instructions: runtime arm: {why}")
        for name in _BYTES_ON:
            try:
                versions.append((name, runtimes.interpreter(name)[1]))
                if bytes_of("mahony6", name, 1) is None:
                    raise runtimes.Unavailable("it does not tell what is allocated")
                self._bytes_on = name
                break
            except (runtimes.Unavailable, tracing.TraceError) as why:
                self.notes.append(f"no bytes from runtime {name}: {why}")
        self._digest = _digest(versions)
        return self

    def __exit__(self, *of):
        self._folder.cleanup()

    def cost(self, name: str) -> Cost:
        """Of a filter, by its name. Raises tracing.TraceError."""
        with self._lock:
            known = _remembered(self._digest)
        if name not in known:
            cost = Cost(
                _instructions(name, self._compiled) if self._compiled else None,
                bytes_of(name, self._bytes_on) if self._bytes_on else None,
            )
            with self._lock:
                known = _remembered(self._digest) | {name: asdict(cost)}
                _remember(self._digest, known)
        return Cost(**known[name])


def _digest(versions) -> str:
    """Of all that a cost depends on."""
    sources = [*sorted(paths.PACKAGE.glob("*.py")), SCRIPT]
    digest = hashlib.sha256(repr((versions, TRACED, TRACE_HEAP)).encode())
    for source in sources:
        digest.update(source.name.encode() + source.read_bytes())
    return digest.hexdigest()


def _memory() -> Path:
    return paths.cache() / "filter-costs.json"


def _remembered(digest: str) -> dict:
    try:
        kept = json.loads(_memory().read_text("utf-8"))
        return kept["costs"] if kept["digest"] == digest else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _remember(digest: str, costs: dict) -> None:
    made = _memory().with_suffix(f".{os.getpid()}")
    made.write_text(json.dumps({"digest": digest, "costs": costs}))
    made.replace(_memory())


def bytes_of(name: str, runtime: str, n: int = ALLOCATIONS) -> float | None:
    """Bytes that an update of this filter takes from the heap, its collector off; None where the port does not tell."""
    said = _say(runtime, "alloc", name, n).strip()
    return int(said) / n if said else None


def settling(name: str, rate, gyro_scale, accel_lsb_per_g: int, runtime: str) -> float | None:
    """Seconds of rest after which the tilt stays within 2 deg of the truth, from a start 90 deg off.

    The filter is new, at these scales, with its own parameters; its attitude is set 90 deg off about a horizontal axis
    half way between x and y; the samples are those of a level board without noise or bias. None: not within 60 s.
    Raises tracing.TraceError and runtimes.Unavailable.
    """
    scales = (f"{rate[0]}/{rate[1]}", f"{gyro_scale[0]}/{gyro_scale[1]}", accel_lsb_per_g)
    said = _say(runtime, "settle", name, *scales).strip()
    return None if said == "never" else int(said) * rate[1] / rate[0]


def _say(runtime, *arguments) -> str:
    done = runtimes.run(runtime, SCRIPT, arguments, timeout=600)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise tracing.TraceError(
            f"{' '.join(map(str, arguments[:2]))} on {runtime} failed: {' '.join(last)}"
        )
    return done.stdout


def _instructions(name: str, folder: Path) -> float:
    """Thumb-2 instructions of an update in the steady state, what surrounds it taken off."""
    state = folder / f"{name}.state"
    _say("arm", "warm", name, state)
    start, _ = runtimes.interpreter("arm")
    argv = [
        *start,
        "-X",
        f"heapsize={TRACE_HEAP}",
        folder / tracing.START,
        "trace",
        name,
        str(TRACED),
        state,
    ]
    found = tracing.per_step(tracing.marks(argv, os.environ | {"MICROPYPATH": str(folder)}))
    if not found.get("update", 0) > found.get("empty", 0):
        raise tracing.TraceError(f"qemu's log held no count of {name}")
    return found["update"] - found["empty"]
