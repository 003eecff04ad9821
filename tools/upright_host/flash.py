"""Installs Upright on a board: compiled for its processor, only what changed, verified, and never half.

The new files are staged in a folder first. When all are there and right, one rename puts /upright.py in place
(firmware/upright_app/installation.py), which names them: that is the moment from which the installation holds. It then
puts each in its place, and goes. Whatever interrupts this, the board has the old files, or the new ones as soon as
main.py or another program says `import upright`.

What an installation changes or removes was put there by one (RECORD has its hash) or is kept as NAME.bak (--force).
"""

import ast
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import typer
from mpremote.transport import TransportExecError

from upright_host import __version__, console, contents, device, oled, options, paths
from upright_host.console import Wrong, progress, say

RECORD = "upright.json"  # on the board: what was installed, {"version": , "files": {name: sha256}}
STAGE, SELF = "upright.new", "upright.py"  # as in upright_app/installation.py
MARK = "# Finishes an installation of Upright"  # its first line begins so
BACKUP = ".bak"
SPARE = 8192  # bytes that an installation leaves free: calibration, the user's own files
FOLDER = "folder"  # in place of a hash
# A user's own, if it is not what was installed: kept, and the rest is installed all the same
KEPT = ("main.py", "board.py")
# What a new board's main.py holds (MicroPython's ports/stm32/factoryreset.c): nobody's program
FACTORY = hashlib.sha256(b"# main.py -- put your code here!\r\n").hexdigest()
# In the root they are imported before what lies in /lib
SHADOWS = tuple(p + form for p in ("upright", "upright_app") for form in ("", ".py", ".mpy"))
# Stands in for main.py while that is replaced
BOOT = b"""# Put here by `upright flash` for as long as it replaces main.py
try:
    import upright
except ImportError:
    pass
"""
FOLDERS = ("lib", "lib/upright", "lib/upright_app")
JOURNAL = "update.json"  # of older versions
OLD_CALIBRATION, CALIBRATION = "calibration.json", "upright_cal.json"

# On the board: prints hash (None without a file) and size of each file
_LOOK = """
import os
{hashing}
_b = memoryview(bytearray(1024))
for _name in {names!r}:
    try:
        _s = os.stat(_name)
    except OSError:
        print(None, 0)
        continue
    if _s[0] & 0x4000:
        print({folder!r}, 0)
        continue
    _h = {sha}
    with open(_name, 'rb') as _f:
        while _h:
            _n = _f.readinto(_b)
            if not _n:
                break
            _h.update(_b[:_n])
    print(binascii.hexlify(_h.digest()).decode() if _h else '?', _s[6])
"""
_COPY = """
with open({a!r}, 'rb') as _f:
    with open({b!r}, 'wb') as _g:
        while True:
            _d = _f.read(512)
            if not _d:
                break
            _g.write(_d)
"""
# Closed before it runs: it removes itself
FINISH = f"""
with open({SELF!r}) as _f:
    _text = _f.read()
exec(_text, {{"__name__": "finish"}})
"""
_FINISH_OLDER = """
import os
for _name in {install!r}:
    try:
        os.stat(_name + '.new')
        try:
            os.remove(_name)
        except OSError:
            pass
        os.rename(_name + '.new', _name)
    except OSError:
        pass
for _name in {remove!r}:
    try:
        os.remove(_name)
    except OSError:
        pass
"""
# Files of the stage that was left by an installation that never came to hold
_CLEAR = """
import os
try:
    for _f in os.listdir({stage!r}):
        if _f.isdigit() or _f in ('boot.py', {own!r}):
            os.remove({stage!r} + '/' + _f)
    os.rmdir({stage!r})
except OSError:
    pass
"""


@dataclass
class Plan:
    """What an installation does.

    install  {name: content}; remove: names; record: what RECORD is to hold
    same     how many files are as they should be
    kept     of the user's, left as they are: (name, why)
    blocked  of the user's, in the way: (name, why and what to do); then nothing is done
    backup   names that are copied to NAME.bak first (a folder: renamed)
    found    {name: (hash or None or FOLDER, bytes)} of what the board has
    """

    install: dict = field(default_factory=dict)
    remove: list = field(default_factory=list)
    record: dict = field(default_factory=dict)
    same: int = 0
    kept: list = field(default_factory=list)
    blocked: list = field(default_factory=list)
    backup: list = field(default_factory=list)
    found: dict = field(default_factory=dict)


def plan(transport, files: dict[str, bytes], force: bool = False) -> Plan:
    """Compare the board's files with what they are to be. Nothing is changed by it but an older installation that was
    cut off: that is finished first."""
    ours = _finish(transport)
    recorded = _read_record(transport)
    others = {n: _other_form(n) for n in files if n not in KEPT and n.endswith(("py", "mpy"))}
    root = [f.name for f in transport.fs_listdir("") if not f.st_mode & 0x4000]
    programs = [name for name in root if name.endswith(".py") and name not in SHADOWS]
    names = [*files, *others.values(), *recorded, *SHADOWS, *programs]
    names += [RECORD, "boot.py", OLD_CALIBRATION, CALIBRATION, *FOLDERS, STAGE]
    found = look(transport, list(dict.fromkeys(names)))
    made = Plan(found=found)

    def state(name):
        """None: there is none; True: an installation put it there; else why it is the user's."""
        digest = found[name][0]
        if digest is None:
            return None
        if name in ours or (digest == recorded.get(name) and digest != FOLDER):
            return True
        if name == "boot.py" and digest == hashlib.sha256(BOOT).hexdigest():
            return True
        return "changed since it was installed" if name in recorded else "not installed by Upright"

    def in_the_way(name, why):
        if force:
            made.backup.append(name)
        else:
            made.blocked.append((name, why))
        return force

    for name, content in files.items():
        digest = hashlib.sha256(content).hexdigest()
        is_ours = state(name)
        if found[name][0] == digest:
            made.same += 1
        elif is_ours in (None, True) or (name == "main.py" and found[name][0] == FACTORY):
            made.install[name] = content
        elif name in KEPT and not force:
            made.kept.append((name, is_ours))
        elif in_the_way(name, is_ours):
            made.install[name] = content
    for name in (*FOLDERS, STAGE):
        if found[name][0] not in (None, FOLDER):
            made.blocked.append((name, "a file where a folder is needed; rename it"))
    if found[RECORD][0] == FOLDER:
        in_the_way(RECORD, "a folder where a file is needed")
    # a .py is imported before a .mpy of its name, and a file in the root before one in /lib
    for name in [*others.values(), *SHADOWS]:
        is_ours = state(name)
        if name in files or is_ours is None:
            continue
        what = others_of(name, files)
        free = is_ours is True or in_the_way(
            name, f"{is_ours}, and would be imported instead of {what}"
        )
        if free and name != SELF:  # that one is replaced by ours, and goes with it
            made.remove.append(name)
    for name in {**recorded, "boot.py": ""}:
        if name not in files and name not in made.remove and state(name) is True:
            made.remove.append(name)
        elif name in recorded and name not in {*files, *others.values()} and state(name):
            made.kept.append(
                (name, "no longer part of Upright, but changed since it was installed")
            )
    _check_programs(
        transport, made, [n for n in programs if isinstance(state(n), str)], programs, force
    )
    is_older = any(PurePosixPath(n).stem in contents.MOVED for n in _flat(recorded))
    if (
        is_older
        and found[CALIBRATION][0] is None
        and found[OLD_CALIBRATION][0] not in (None, FOLDER)
    ):
        made.install[CALIBRATION] = bytes(transport.fs_readfile(OLD_CALIBRATION))
    kept = {name for name, _ in made.kept}
    installed = {n: hashlib.sha256(c).hexdigest() for n, c in files.items() if n not in kept}
    made.record = {"version": __version__, "files": installed}
    return made


def others_of(name: str, files: dict) -> str:
    """What a file stands in the way of, for people."""
    other = _other_form(name)
    return other if other in files else f"lib/{PurePosixPath(name).stem}"


def _other_form(name: str) -> str:
    """The file that stands for the same module."""
    stem, _, form = name.rpartition(".")
    return f"{stem}.{'py' if form == 'mpy' else 'mpy'}"


def _check_programs(transport, made: Plan, own: list[str], root: list[str], force: bool):
    """The user's programs that would no longer start: lines to change, instead of an ImportError at the next boot."""
    gone = {PurePosixPath(name).stem for name in _flat(made.remove)}
    gone = {n for n in gone & contents.MOVED.keys() if f"{n}.py" not in {*root} - {*made.remove}}
    for name in own:
        if name in made.install or (name != "board.py" and not gone):
            continue
        text = transport.fs_readfile(name).decode("utf-8", "replace")
        lines = contents.lines_to_change(text, gone, name == "board.py")
        if lines and not (force and name != "board.py"):
            todo = "not made for this version. Change it, or replace it by ours (--force):"
            if name != "board.py":
                todo = "it imports what has moved. Change it, or let it fail (--force):"
            made.blocked.append((name, "\n    ".join([todo, *lines])))


def _flat(names) -> list[str]:
    """Those in the root and in /lib, where older installations had their modules."""
    return [name for name in names if str(PurePosixPath(name).parent) in (".", "lib")]


def _finish(transport) -> set[str]:
    """Finish an earlier installation that was cut off -> names of files that are ours whatever their hash."""
    _finish_older(transport)
    try:
        text = transport.fs_readfile(SELF).decode()
        call = contents.parse(text).body[-1].value
        names = {*ast.literal_eval(call.args[0]), SELF}
        what = call.func.id
    except (OSError, ValueError, SyntaxError, IndexError, AttributeError, TypeError):
        return set()  # there is none, or it is the user's
    if not text.startswith(MARK):
        return set()
    try:
        transport.exec(FINISH)
    except TransportExecError as why:
        last = str(why).strip().splitlines()[-1]
        raise device.DeviceError(
            f"an installation was cut off, and cannot be finished: {last}. Is something of your own in the way? "
            f"If not, remove /{SELF} and /{STAGE} from the board, and install again"
        ) from None
    return names if what == "refuse" else set()


def _finish_older(transport):
    """The same for older versions. Their journal: {"install": [names of what lies at NAME.new], "remove": [names]}."""
    try:
        journal = json.loads(transport.fs_readfile(JOURNAL))
        install, remove = (
            [n for n in journal[key] if _is_plain(n)] for key in ("install", "remove")
        )
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return
    transport.exec(_FINISH_OLDER.format(install=install, remove=[*remove, JOURNAL]))


# ------------------------------------------------------------------------------------------ carrying it out


class Work:
    """What a plan takes of a board.

    files     {name: content} of all that is sent; order: their names; remove: names
    stand_in  whether a boot.py stands in for main.py meanwhile
    beside    whether there is room for the new files beside the old ones; shortage: why there is none at all, or None
    """

    def __init__(self, transport, plan: Plan):
        transport.exec(_CLEAR.format(stage=STAGE, own=SELF))
        self.files = files = plan.install | {RECORD: json.dumps(plan.record).encode()}
        self.remove = remove = list(plan.remove)
        # main.py first, then whatever boots is new. Where the file system cannot replace it in one step it is missing
        # for a moment: a boot.py stands in, unless the user has one.
        self.order = sorted(files, key=lambda name: (name != "main.py", name == RECORD))
        is_replaced = "main.py" in files and plan.found["main.py"][0]
        self.stand_in = is_replaced and (plan.found["boot.py"][0] is None or "boot.py" in remove)
        if self.stand_in and "boot.py" not in remove:
            remove.append("boot.py")
        block, free = device.space(transport)

        def room(sizes):
            return sum(-(-size // block) * block for size in sizes)

        backup = [plan.found[name][1] for name in plan.backup]
        need = room([*map(len, files.values()), *backup]) + _room_of_folders(plan, files, block)
        freed = room(plan.found.get(name, (None, 0))[1] for name in {*files, *remove, SELF})
        # meanwhile: the file that puts the others in place, and the folder of the staged ones
        for_now = room([len(_in_front(f"finish({self.order!r}, {remove!r})")), 32 * len(files)])
        for_now += 2 * block
        self.beside = need + for_now <= free
        self.shortage = None
        if need + SPARE > free + freed or need + for_now > free + freed:
            self.shortage = (
                f"{need} bytes and {SPARE} to spare do not fit: {free} are free on the board and {freed} "
                "would become so"
            )


def execute(transport, plan: Plan, on_progress=None) -> bool:
    """Carry a plan out -> False where old and new had no room together. on_progress(name, bytes done, bytes in all).

    Raises device.DeviceError, before anything is changed, where it cannot be done at all.
    """
    if plan.blocked:
        listed = "\n".join(f"{name}: {why}" for name, why in plan.blocked)
        raise device.DeviceError(
            f"nothing was changed. In the way:\n{listed}\n"
            "Rename or remove it, or let --force do so (it keeps a copy, NAME.bak)"
        )
    work = Work(transport, plan)
    if work.shortage:
        raise device.DeviceError(
            f"{work.shortage}. Nothing was changed. Remove files of your own, or freeze Upright into the firmware "
            "(README.md of the board)"
        )
    files, order, remove, staged = work.files, work.order, work.remove, work.beside
    _make_folders(transport, [*files, f"{STAGE}/{SELF}"])
    _back_up(transport, plan)
    if staged:
        sent = {f"{STAGE}/{i}": files[name] for i, name in enumerate(order)}
        _send(transport, sent, dict(zip(sent, order, strict=True)), on_progress)
        if work.stand_in:
            _send(transport, {f"{STAGE}/boot.py": BOOT}, {}, None)
            transport.exec(f"import os\nos.rename('{STAGE}/boot.py', 'boot.py')")
        _put_in_front(transport, f"finish({order!r}, {remove!r})")
        transport.exec(FINISH)
    else:
        _put_in_front(transport, f"refuse({sorted({*order, *remove})!r})")
        for name in [*(n for n in order if n != RECORD), *remove]:
            transport.exec(f"import os\ntry:\n    os.remove({name!r})\nexcept OSError:\n    pass")
        _send(transport, {name: files[name] for name in order}, {}, on_progress)
        transport.exec(f"import os\nos.remove({SELF!r})\n" + _CLEAR.format(stage=STAGE, own=SELF))
    return staged


def _room_of_folders(plan: Plan, files, block: int) -> int:
    """Bytes that folders take, at most. A new one is a block on FAT, two on littlefs, whose blocks are larger; a new
    file's entry, with a long name, is 96 bytes on FAT."""
    new = sum(plan.found.get(name, (None,))[0] is None for name in _folders(files))
    entries = sum(96 * (plan.found.get(name, (None,))[0] is None) for name in files)
    return new * block * (1 if block < 4096 else 2) + -(-entries // block) * block


def _folders(files) -> list[str]:
    found = {str(parent) for name in files for parent in PurePosixPath(name).parents}
    return sorted(found - {"."})


def _make_folders(transport, names):
    for folder in _folders(names):
        if not transport.fs_exists(folder):
            transport.fs_mkdir(folder)


def _back_up(transport, plan: Plan):
    for name in plan.backup:
        copy, n = name + BACKUP, 1
        while transport.fs_exists(copy):
            n += 1
            copy = f"{name}{BACKUP}{n}"
        if plan.found[name][0] == FOLDER:
            transport.exec(f"import os\nos.rename({name!r}, {copy!r})")
        else:
            transport.exec(_COPY.format(a=name, b=copy))


def _send(transport, files: dict[str, bytes], called: dict[str, str], on_progress):
    """Write files and look whether they are what was sent. called: what people know them by."""
    total, done = sum(map(len, files.values())), 0
    for name, content in files.items():
        start, title = done, called.get(name, name)

        def written(part, _, title=title, start=start):
            if on_progress:
                on_progress(title, start + part, total)

        transport.fs_writefile(name, content, progress_callback=written)
        done += len(content)
        if transport.fs_hashfile(name, "sha256") != hashlib.sha256(content).digest():
            raise device.DeviceError(
                f"{title}: what the board holds is not what was sent; try again"
            )


def _in_front(call: str) -> bytes:
    return (paths.APPLICATION / "installation.py").read_bytes() + f"\n\n{call}\n".encode()


def _put_in_front(transport, call: str):
    """Put /upright.py in place, which `import upright` finds before lib/upright."""
    staged = f"{STAGE}/{SELF}"
    _send(transport, {staged: _in_front(call)}, {}, None)
    # it may be there already: from an installation that was cut off, or the user's, of which there is a copy
    transport.exec(
        f"import os\ntry:\n    os.remove({SELF!r})\nexcept OSError:\n    pass\n"
        f"os.rename({staged!r}, {SELF!r})"
    )


def _read_record(transport) -> dict[str, str]:
    """{name: hash} of what was installed: only what an installation can have written, names within its own folders."""
    try:
        files = json.loads(transport.fs_readfile(RECORD))["files"].items()
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}
    return {name: digest for name, digest in files if _is_plain(name) and isinstance(digest, str)}


def _is_plain(name) -> bool:
    """Is it the name of a file below the board's root: "lib/upright/tick.mpy", but not "/sd/x" or "../x"?"""
    path = PurePosixPath(name) if isinstance(name, str) else PurePosixPath("/")
    return bool(path.parts) and not {"/", ".."} & {*path.parts} and str(path) == name


def look(transport, names: list[str]) -> dict[str, tuple[str | None, int]]:
    """(SHA-256, bytes) of each file on the board, (None, 0) where there is none, (FOLDER, 0) of a folder. One command
    for all: each costs a round trip."""
    try:
        said = transport.exec(
            _LOOK.format(
                names=names,
                folder=FOLDER,
                hashing="import hashlib, binascii",
                sha="hashlib.sha256()",
            )
        ).decode()
    except TransportExecError:  # no hashlib there
        said = transport.exec(_LOOK.format(names=names, folder=FOLDER, hashing="", sha="None"))
        said = said.decode()
    found = {}
    for name, line in zip(names, said.strip().splitlines(), strict=True):
        digest, size = line.split()
        if digest == "?":
            digest = transport.fs_hashfile(name, "sha256").hex()
        found[name] = (None if digest == "None" else digest, int(size))
    return found


# ------------------------------------------------------------------------------------------ the command


def run(transport, board: str, source: bool, force: bool, everything: bool = False) -> bool:
    """Install on a connected board, with progress -> whether anything was changed. Raises device.DeviceError."""
    found = device.facts(transport)
    version = ".".join(map(str, found.version))
    say(f"{found.machine or found.platform}: MicroPython {version}, {found.architecture}")
    problems = found.problems()
    if problems:
        raise device.DeviceError("; ".join(problems))
    wanted = contents.platform(board)
    if wanted and wanted != found.platform:
        raise device.DeviceError(
            f"boards/{board} is for MicroPython's port {wanted!r}; this board runs {found.platform!r}"
        )
    if found.platform not in contents.known_ports():
        say(
            f"Upright knows no timer of MicroPython's port {found.platform!r}: board.py needs a make_tick() of its own,"
            ' or DRIVE = "data_ready" or "manual"'
        )
    if found.frozen:
        say(f"Upright {found.frozen} is frozen into this firmware, and is what will run")
    files = contents.board_files(board, found, source, _own(transport), everything)
    steps = plan(transport, files, force)
    if found.deflate and not source and Work(transport, steps).shortage:
        say("packed, as there is no room for the modules as they are")
        files = contents.board_files(board, found, False, _own(transport), everything, small=True)
        steps = plan(transport, files, force)
    for name, why in steps.kept:
        can = " (--force replaces it, and keeps a copy as NAME.bak)" if name in KEPT else ""
        say(f"{name}: {why}: kept as it is{can}")
    size = sum(map(len, steps.install.values()))
    say(
        f"{steps.same} files are as they should be, {len(steps.install)} to copy ({size} bytes), "
        f"{len(steps.remove)} to remove"
    )
    if not (steps.install or steps.remove or steps.blocked or steps.backup):
        return False
    with progress("copying") as at:
        staged = execute(transport, steps, lambda name, done, total: at(done, total, name))
    say("verified by hash and put in place")
    for name in steps.backup:
        say(f"{name}: the one that was there is {name}{BACKUP} now")
    if not staged:
        say("(in the place of the old files, since there was no room beside them)")
    return True


def show_start(transport, seconds: float | None, emulated: bool = False) -> None:
    """Restart the board and show what it says, for so long; without a time until the tick runs, or until it had time
    enough."""
    say("restarting:")
    told = seconds is not None
    runs = device.restart(
        transport,
        seconds if told else 6 if emulated else 10,
        lambda line: say("  " + line),
        lambda line: line.startswith("tick: ") and not told,
    )
    if runs and emulated:
        console.out.print(
            oled.panel(transport.board.display.picture(), console.out.width, title="128x64 OLED")
        )
    if runs:
        say(
            "It works: the tick runs, and the display shows roll, pitch and yaw."
            f" `upright doctor{' --emulated' if emulated else ''}` examines the board"
        )
    elif not told:
        say(
            "No tick yet. The lines above say why (a main.py of your own may say nothing); `upright doctor` examines"
            " the board"
        )


def _own(transport) -> str:
    """The text of the user's board.py and main.py that are on the board, where they are Python."""
    texts = []
    for name in KEPT:
        try:
            text = transport.fs_readfile(name).decode()
            contents.parse(text)
            texts.append(text)
        except (OSError, ValueError, SyntaxError):
            pass
    return "\n".join(texts)


def register(app: typer.Typer):
    """Add `upright flash` to the command line."""

    @app.command("flash")
    def flash_command(
        board: str = typer.Argument(..., help="The board, a folder of boards/."),
        port: str = typer.Option(None, help="Its serial port (default: the only one there is)."),
        source: bool = typer.Option(
            False, "--source", help="Install sources, not compiled modules."
        ),
        everything: bool = typer.Option(
            False,
            "--all",
            help="Install every module, not only those that the board's settings need.",
        ),
        force: bool = typer.Option(
            False,
            "--force",
            help="Replace files of your own that are in the way; a copy stays as NAME.bak.",
        ),
        seconds: float = options.seconds(
            "Show what the board says after its restart for so long (default: until its tick runs)."
        ),
        emulated: bool = typer.Option(
            False,
            "--emulated",
            help="Install on an emulated Pico, whose flash is kept between the runs.",
        ),
    ):
        """Install the firmware on a board over USB: compiled for it, only what changed, verified, never half."""
        paths.known_board(board)
        if board == "sim":
            raise Wrong(
                "sim is the simulated board of `upright demo`: name the board that you have"
            )
        if emulated and board != "pico":
            raise Wrong(f"the emulated board is a Pico, not {board}")
        with device.opened(port, emulated) as transport:
            run(transport, board, source, force, everything)
            show_start(transport, seconds, emulated)
