# The host's files for an emulated board of MicroPython's qemu port, which has none of its own: a file system whose
# calls qemu carries out (semihosting: Arm, "Semihosting for AArch32 and AArch64"; RISC-V has the same calls). Then the
# program itself. This file goes to the board over the raw prompt; run.py adds a line that calls run().

import io
import os
import sys
from array import array

_OPEN, _CLOSE, _WRITE, _READ, _SEEK, _LENGTH, _REMOVE, _RENAME = 1, 2, 5, 6, 10, 12, 14, 15
_EXIT = 0x20  # SYS_EXIT_EXTENDED
_APPLICATION_EXIT = 0x20026  # its reason ADP_Stopped_ApplicationExit
_MODES = ("r", "rb", "r+", "r+b", "w", "wb", "w+", "w+b", "a", "ab", "a+", "a+b")
_CONSOLE = ":tt"  # to be opened for appending: standard error
_ENOENT = 2
_EIO = 5

# call(operation, block): a semihosting call; its block of arguments is an array('i').
# point(block, offset, buffer): write the buffer's address, which is no small int, into a block.
_THUMB = """
@micropython.asm_thumb
def call(r0, r1):
    data(2, 0xBEAB)  # bkpt 0xab

@micropython.asm_thumb
def point(r0, r1, r2):
    add(r0, r0, r1)
    str(r2, [r0, 0])
    mov(r0, 0)
"""
_RV32 = """
@micropython.asm_rv32
def call(a0, a1):
    data(4, 0x01F01013, 0x00100073, 0x40705013)  # slli zero, zero, 31; ebreak; srai zero, zero, 7

@micropython.asm_rv32
def point(a0, a1, a2):
    add(a0, a0, a1)
    sw(a2, 0(a0))
    li(a0, 0)
"""
_code = {}
exec(_RV32 if "virt" in sys.implementation._machine else _THUMB, _code)
call, point = _code["call"], _code["point"]


def _named(operation, name, *words):
    name = name.encode() + b"\0"
    block = array("i", (0,) + words + (len(name) - 1,))
    point(block, 0, name)
    return call(operation, block)


class HostFile(io.IOBase):
    def __init__(self, name, mode):
        handle = _named(_OPEN, name, _MODES.index(mode.replace("t", "")))
        if handle < 0:
            raise OSError(_ENOENT)
        self._block = array("i", (handle, 0, 0))
        self._at = self._size = 0
        self._buffer = None  # the last one; bytes of its items are in _item
        if "w" not in mode and name != _CONSOLE:
            self._size = call(_LENGTH, self._block)
            if "a" in mode:
                self.seek(0, 2)

    def _transfer(self, operation, buffer):
        """-> how many bytes it moved."""
        if buffer is not self._buffer:
            self._buffer = buffer
            self._item = len(bytes(memoryview(buffer)[:1]))
        n = len(buffer) * self._item
        block = self._block
        point(block, 4, buffer)
        block[2] = n
        n -= call(operation, block)
        self._at += n
        return n

    def readinto(self, buffer):
        return self._transfer(_READ, buffer)

    def write(self, buffer):
        if isinstance(buffer, str):
            buffer = buffer.encode()
        return self._transfer(_WRITE, buffer)

    def read(self, n=-1):
        if n < 0:
            n = max(self._size - self._at, 0)
        buffer = bytearray(n)
        return bytes(memoryview(buffer)[: self._transfer(_READ, buffer)])

    def seek(self, offset, whence=0):
        at = offset
        if whence:
            at += self._at if whence == 1 else max(self._size, self._at)
        self._block[1] = at
        call(_SEEK, self._block)
        self._at = at
        return at

    def tell(self):
        return self._at

    def flush(self):
        pass

    def ioctl(self, request, argument):
        if request == 4:  # close
            call(_CLOSE, self._block)
        elif request == 11:  # the size of a buffer for importing
            return 255
        return 0

    def close(self):
        self.ioctl(4, 0)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


class HostFiles:
    def mount(self, readonly, mkfs):
        pass

    def umount(self):
        pass

    def chdir(self, path):
        pass

    def getcwd(self):
        return ""

    def open(self, path, mode):
        if "b" in mode or "r" not in mode:
            return HostFile(path, mode)
        with HostFile(path, "rb") as file:
            return io.StringIO(file.read().decode())

    def stat(self, path):
        size, kind = 0, 0x4000
        try:
            HostFile(path + "/.", "rb").close()  # a folder?
        except OSError:
            kind = 0x8000
            with HostFile(path, "rb") as file:
                size = file.seek(0, 2)
        return (kind, 0, 0, 0, 0, 0, size, 0, 0, 0)

    def statvfs(self, path):
        return (4096, 4096, 1 << 16, 1 << 16, 1 << 16, 0, 0, 0, 0, 255)

    def remove(self, path):
        if _named(_REMOVE, path):
            raise OSError(_ENOENT)

    def rename(self, old, new):
        old, new = old.encode() + b"\0", new.encode() + b"\0"
        block = array("i", (0, len(old) - 1, 0, len(new) - 1))
        point(block, 0, old)
        point(block, 8, new)
        if call(_RENAME, block):
            raise OSError(_ENOENT)


class Clock:
    """`time`, which this port lacks. It allocates nothing, as the others' does not. Each question takes 20 us."""

    now = 0  # us, below 2**29, so that no sum is beyond 30 bits

    @staticmethod
    def sleep_us(us):
        Clock.now = Clock.now + us & 0x1FFFFFFF

    @staticmethod
    def sleep_ms(ms):
        Clock.sleep_us(1000 * ms)

    @staticmethod
    def ticks_us():
        Clock.now = Clock.now + 20 & 0x1FFFFFFF
        return Clock.now

    ticks_cpu = ticks_us

    @staticmethod
    def ticks_ms():
        return Clock.ticks_us() // 1000

    @staticmethod
    def ticks_add(t, delta):
        return t + delta & 0x1FFFFFFF

    @staticmethod
    def ticks_diff(a, b):
        d = a - b & 0x1FFFFFFF
        return d - 0x20000000 if d > 0x0FFFFFFF else d


def run(code, arguments, folders):
    os.mount(HostFiles(), "/")
    os.chdir("/")
    sys.path[:] = folders
    sys.argv[:] = arguments
    sys.modules["utime"] = Clock
    try:
        import time  # noqa: F401 (the simulator's)
    except ImportError:
        sys.modules["time"] = Clock
    scope = {"__name__": "__main__", "__file__": arguments[0]}
    status = 0
    try:
        if code is None:
            execfile(arguments[0], scope)  # noqa: F821
        else:
            exec(code, scope)
    except SystemExit as why:
        status = why.args[0] if why.args else 0
        if not isinstance(status, int):
            print(status)
            status = 1
    except BaseException as error:
        status = 1
        with HostFile(_CONSOLE, "a") as errors:
            sys.print_exception(error, errors)
    print("\x04", end="")
    call(_EXIT, array("i", (_APPLICATION_EXIT, status)))
