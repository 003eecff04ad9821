"""Runs a module of the application on a board from its RAM: nothing is written to its file system.

The compiled modules go over the raw prompt into a file system that is a dictionary, mounted for as long as the session
lasts. Modules of lib/upright that the board lacks go with them.
"""

import base64

from upright_host import contents, device, flash, packages, paths, runtimes

_PLACE = "/upright_ram"
_CHUNK = 512

# On the board: a file system that holds `files`, {"/name": [pieces of bytes]}. MicroPython's docs, reference/filesystem
_MOUNT = """
import binascii, io, os, sys
class RamFile(io.IOBase):
    def __init__(self, pieces):
        self.pieces, self.piece, self.at = pieces, 0, 0
    def ioctl(self, request, argument):
        return 0 if request == 4 else -1
    def readinto(self, buffer):
        n = 0
        while n < len(buffer) and self.piece < len(self.pieces):
            part = self.pieces[self.piece]
            k = min(len(buffer) - n, len(part) - self.at)
            buffer[n : n + k] = part[self.at : self.at + k]
            n += k
            self.at += k
            if self.at == len(part):
                self.piece, self.at = self.piece + 1, 0
        return n
class Ram:
    files = {}
    def mount(self, readonly, mkfs):
        pass
    def umount(self):
        pass
    def stat(self, path):
        path = "/" + path.strip("/")
        if path in self.files:
            return (0x8000, 0, 0, 0, 0, 0, sum(map(len, self.files[path])), 0, 0, 0)
        if any(name.startswith(path + "/") for name in self.files):
            return (0x4000, 0, 0, 0, 0, 0, 0, 0, 0, 0)
        raise OSError(2)
    def open(self, path, mode):
        return RamFile(self.files["/" + path.strip("/")])
os.mount(Ram(), PLACE)
sys.path.insert(0, PLACE)
def put(name, data):
    Ram.files.setdefault(name, []).append(binascii.a2b_base64(data))
""".replace("PLACE", repr(_PLACE))


def load(transport, facts: device.Facts, *names: str):
    """Make modules of the application importable, with what they and board.py need. Raises device.DeviceError.

    names: of upright_app, every one of them that is wanted.
    """
    try:
        text = transport.fs_readfile("board.py").decode()
        needed = packages.imports(contents.parse(text))
    except (OSError, ValueError, SyntaxError) as why:
        raise device.DeviceError(
            f"no board.py on the board that can be read ({why}): `upright flash BOARD` first"
        ) from None
    for name in names:
        needed |= packages.imports(packages.tree(paths.APPLICATION / f"{name}.py"))
    needed |= {"__init__"}
    if "doctor" in names:  # it runs the self-test
        needed |= {*contents.BY_HAND}
    needed = contents.with_imports(needed)
    missing = [] if facts.frozen else _missing(transport, needed)
    files = {f"/upright_app/{name}": paths.APPLICATION / f"{name}.py" for name in names}
    # a package is in one place: beside one that is on the board, modules come under their own names
    whole = "__init__" in missing
    for name in missing:
        files[f"/upright/{name}" if whole else f"/{name}"] = paths.PACKAGE / f"{name}.py"
    try:
        compiler = contents.find_compiler(facts)
    except (device.DeviceError, runtimes.Unavailable):
        compiler = None  # the sources do as well
        contents.check_own_compiler(facts)
    transport.exec(_MOUNT)
    for name, path in files.items():
        if compiler:
            data, form = contents.compile_module(compiler, facts.architecture, path), ".mpy"
        else:
            data, form = path.read_bytes(), ".py"
        for at in range(0, len(data), _CHUNK):
            piece = base64.b64encode(data[at : at + _CHUNK]).decode()
            transport.exec(f"put({name + form!r}, {piece!r})")
    if not whole:
        for name in missing:
            transport.exec(f"sys.modules['upright.{name}'] = __import__({name!r})")
    transport.exec("Ram.files = {n: f for n, f in Ram.files.items() if n.count('/') > 1}")


def _missing(transport, needed: set[str]) -> list[str]:
    """Those of these modules of lib/upright that are not on the board, each behind those that it imports."""
    forms = ("mpy", "py", "z")
    found = flash.look(transport, [f"lib/upright/{n}.{f}" for n in needed for f in forms])
    missing = {n for n in needed if not any(found[f"lib/upright/{n}.{f}"][0] for f in forms)}
    first = {name: contents.with_imports({name}, late=False) & missing for name in missing}
    return sorted(missing, key=lambda name: (len(first[name]), name))
