"""Instructions of a program on arm: qemu logs each one, and marks in the program's output say what they belong to.

The program prints `@begin PART N` and `@end PART N` around N steps of a part, for two different N at least.
"""

import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from upright_host import paths, runtimes
from upright_host.console import Failed

START = "run.py"  # in the folder of compile_for()

# sys.implementation._mpy >> 10 & 15, as mpy-cross spells it (py/persistentcode.h)
_ARCHITECTURES = {5: "armv7m", 6: "armv7em", 7: "armv7emsp", 8: "armv7emdp"}


class TraceError(Failed):
    """A measurement did not run to its end; the message says which, and what was said last."""


def compile_for(runtime: str, folder: Path, program: Path, *beside: Path) -> None:
    """Put lib/, a program, and what it needs beside that into a folder as .mpy, the way a board gets them; and START.

    So the trace holds no compiler, which runs to a hundred million instructions. Raises Unavailable and TraceError.
    """
    start, version = runtimes.interpreter(runtime)
    asked = [*start, "-c", "import sys; print(sys.implementation._mpy)"]
    said = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    number = int(said) >> 10 & 15
    architecture = _ARCHITECTURES.get(number)
    release = next((v for v in runtimes.MPY_CROSS_VERSIONS if v.startswith(version)), None)
    if not architecture or not release:
        raise runtimes.Unavailable(f"no mpy-cross for MicroPython {version}, architecture {number}")
    compiler = runtimes.mpy_cross(release)
    (folder / "upright").mkdir()
    sources = dict.fromkeys(paths.PACKAGE.glob("*.py"), folder / "upright")
    for source in (*sources, *beside, program):
        target = sources.get(source, folder) / f"{source.stem}.mpy"
        argv = [compiler, f"-march={architecture}", "-o", target, source]
        done = subprocess.run(argv, capture_output=True, text=True)
        if done.returncode:
            raise TraceError(f"mpy-cross does not compile {source.name}: {done.stderr.strip()}")
    (folder / START).write_text(f"import {program.stem}\n")


def marks(
    argv: list, environment: dict, on_mark: Callable[[int], None] = lambda at: None
) -> list[tuple[str, int]]:
    """Run a program as runtimes.interpreter("arm") starts it -> its marks, as count_traces has them.

    on_mark(k) is called as the k-th mark goes by. Raises TraceError.
    """
    qemu, *rest = argv
    traced = [qemu, _one_by_one(qemu), "-d", "exec,nochain", "-D", "/dev/stdout", *rest]
    found = []
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as errors,
        subprocess.Popen(traced, env=environment, stdout=subprocess.PIPE, stderr=errors) as process,
    ):
        try:
            blocks = iter(lambda: process.stdout.read1(1 << 20), b"")
            for mark in count_traces(blocks):
                found.append(mark)
                on_mark(len(found))
        except BaseException:
            process.kill()
            raise
        if process.wait():
            errors.seek(0)
            last = errors.read().strip().splitlines()[-1:]
            raise TraceError(f"the trace on arm failed: {' '.join(last)}")
    return found


def count_traces(blocks: Iterable[bytes]) -> Iterator[tuple[str, int]]:
    """Read qemu's log with the program's output in between -> (line that begins with @, instructions before it)."""
    count = 0
    rest = b"\n"
    for block in blocks:
        rest += block
        cut = rest.rfind(b"\n")
        whole, rest = rest[:cut], rest[cut:]  # the rest begins with its newline
        while (at := whole.find(b"\n@")) >= 0:
            end = whole.find(b"\n", at + 1)
            end = len(whole) if end < 0 else end
            count += whole.count(b"\nTrace ", 0, at)
            yield whole[at + 2 : end].decode(), count
            whole = whole[end:]
        count += whole.count(b"\nTrace ")


def per_step(marks: Iterable[tuple[str, int]]) -> dict[str, float]:
    """From `begin PART N` and `end PART N` with their counts: instructions a step, what is not a step's taken off."""
    begun: dict[tuple[str, str], int] = {}
    spent: dict[str, dict[int, int]] = {}
    for text, count in marks:
        what, part, n = text.split()
        if what == "begin":
            begun[part, n] = count
        else:
            spent.setdefault(part, {})[int(n)] = count - begun[part, n]
    steps = {part: (of[max(of)] - of[min(of)]) / (max(of) - min(of)) for part, of in spent.items()}
    return steps


def _one_by_one(qemu: str) -> str:
    """The option that makes a translation block of every instruction."""
    usage = subprocess.run([qemu, "-h"], capture_output=True, text=True).stdout
    return "-one-insn-per-tb" if "-one-insn-per-tb" in usage else "-singlestep"
