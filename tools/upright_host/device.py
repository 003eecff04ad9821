"""A MicroPython board at the other end of a serial line: what it is, its files, its restart.

Stands on mpremote's transports; whatever has their interface will do (the emulated board has one of its own).
"""

import ast
import contextlib
import os
import re
import stat
import sys
import time
from dataclasses import dataclass

from upright_host.console import Failed, Wrong

LEAST_VERSION = (1, 22)
_AFTER_LAST_S = 0.5  # a picture of the display is written meanwhile
# sys.implementation._mpy >> 10 & 15 (MicroPython's docs, reference/mpyfiles; flags of the architecture stand above)
_ARCHITECTURES = (
    *("", "x86", "x64", "armv6", "armv6m", "armv7m", "armv7em", "armv7emsp", "armv7emdp"),
    *("xtensa", "xtensawin", "rv32imc", "rv64imc"),
)
_QUESTIONS = """
import sys, os
def _has(code):
    try:
        exec(code)
        return True
    except Exception:
        return False
def _frozen():
    path = sys.path[:]
    sys.path[:] = ['.frozen']
    try:
        return getattr(__import__('upright'), '__version__', '?')
    except ImportError:
        return ''
    finally:
        sys.path[:] = path
        sys.modules.pop('upright', None)
_m = getattr(sys.implementation, '_mpy', 0)
_s = os.statvfs(os.getcwd())
print(repr((sys.platform, getattr(sys.implementation, '_machine', ''), tuple(sys.implementation.version[:3]), _m,
 _has('@micropython.viper\\ndef f():\\n pass'), _has('import pyb\\npyb.Timer'), _has('import machine\\nmachine.Timer'),
 _has('import framebuf'), _s[0] * _s[3],
 _has('import deflate'), _frozen())))
"""


# At the prompt nobody feeds the firmware's watchdog, which no port can stop
_FEED = """
def _feeding():
    import machine
    watchdog = machine.WDT(timeout={ms})
    for number in (-1, 3):
        try:
            return machine.Timer(
                number, period=500, mode=machine.Timer.PERIODIC, callback=lambda timer: watchdog.feed()
            )
        except (TypeError, ValueError):
            pass
_fed = _feeding()
"""


class DeviceError(Failed):
    """No board, another board than was asked for, or one that cannot do what is needed; says what to do."""


@dataclass
class Facts:
    """What a board says of itself."""

    platform: str
    machine: str
    version: tuple
    mpy_version: int
    mpy_sub_version: int
    architecture: str
    viper: bool
    pyb_timer: bool
    machine_timer: bool
    framebuf: bool
    free_bytes: int
    deflate: bool = False
    frozen: str = ""  # the version of Upright that is in the firmware, "" when there is none

    def problems(self) -> list[str]:
        """What keeps Upright from running there."""
        found = []
        if self.version[:2] < LEAST_VERSION:
            have, need = (".".join(map(str, v)) for v in (self.version, LEAST_VERSION))
            found.append(f"MicroPython {have} is too old: {need} or newer is needed")
        if not self.viper:
            found.append(
                "this build of MicroPython has no viper code emitter, which the filters need"
            )
        if not self.pyb_timer and not self.machine_timer:
            found.append("this build of MicroPython has no timer")
        return found


def ports() -> list:
    """Serial ports that a board may be on: (device, description), USB ones only."""
    from serial.tools import list_ports

    return [
        (port.device, f"{port.description}, {port.manufacturer or '?'}")
        for port in sorted(list_ports.comports())
        if port.vid is not None
    ]


def pick_port(wanted: str | None) -> str:
    """The port that was asked for, or the only one there is. Raises DeviceError with the candidates."""
    if wanted:
        return wanted
    found = ports()
    if not found:
        raise DeviceError(
            "no board found on USB. Is the cable one with data lines? Does the board run MicroPython (see its README in"
            " boards/)? A container or virtual machine has to be given the port. --port names one outright"
        )
    if len(found) > 1:
        listed = "\n".join(f"  --port {device}   {what}" for device, what in found)
        raise DeviceError(f"several boards found; say which:\n{listed}")
    return found[0][0]


def connect(port: str):
    """A mpremote transport to the board on a port, its program stopped and the raw REPL entered.

    Raises Wrong where there is no such port, DeviceError where it cannot be used.
    """
    from mpremote.transport import TransportError
    from mpremote.transport_serial import SerialTransport

    if "://" not in port:  # else one of pyserial's addresses, as rfc2217://HOST:PORT
        _look_at(port)
    try:
        transport = SerialTransport(port)
    except (TransportError, OSError, ValueError) as why:
        raise DeviceError(
            f"{port} cannot be opened ({why}). Is another program (a terminal, an editor) using it?"
        ) from why
    try:
        transport.enter_raw_repl(soft_reset=True)
    except (TransportError, OSError) as why:
        transport.close()
        raise DeviceError(
            f"{port} is there, but MicroPython's prompt does not answer ({why}). Press the board's reset and try again."
            " Does the board run MicroPython (see its README in boards/)?"
        ) from why
    return transport


def _look_at(port: str) -> None:
    """Refuse a port that is not there, or not for this user: pyserial says the same of both."""
    found = [device for device, _ in ports()]
    listed = f"there is {', '.join(found)}" if found else "no board is on USB"
    if os.name == "nt":
        if port.upper() not in {device.upper() for device in _all_ports()}:
            raise Wrong(f"there is no port {port}; {listed}")
        return
    try:
        about = os.stat(port)
    except OSError as why:
        raise Wrong(f"there is no port {port} ({why.strerror}); {listed}") from None
    if not stat.S_ISCHR(about.st_mode):
        raise Wrong(f"{port} is no serial port; {listed}")
    if not os.access(port, os.R_OK | os.W_OK):
        raise DeviceError(f"{port}: permission denied. {_group_hint(about.st_gid)}")


def _all_ports() -> list[str]:
    from serial.tools import list_ports

    return [port.device for port in list_ports.comports()]


def _group_hint(gid: int) -> str:
    """How an ordinary user gets at a port of this group."""
    if sys.platform != "linux":
        return "It belongs to another user"
    import grp

    try:
        group = grp.getgrgid(gid).gr_name
    except KeyError:
        group = "dialout"
    if group == "root":  # its udev rule gives it to nobody: the usual group will not do
        return "It belongs to root alone: a udev rule has to give it to your group"
    return (
        f"Your user is not in the group {group}: `sudo usermod -aG {group} $USER`, then log out and in again"
        f" (or, for this terminal, `newgrp {group}`)"
    )


@contextlib.contextmanager
def opened(port: str | None, emulated: bool = False):
    """A transport to the emulated Pico, or to the board on a port: this one, or the only one. Raises DeviceError."""
    from mpremote.transport import TransportError
    from serial import SerialException

    if emulated and port:
        raise Wrong("the emulated board has no port: --port or --emulated, not both")
    if emulated:
        from upright_host import emulated as pico

        transport = pico.connect()
    else:
        transport = connect(pick_port(port))
    try:
        _feed_watchdog(transport)
        yield transport
    except TransportError as why:
        raise DeviceError(_in_a_line(str(why))) from None
    except SerialException as why:
        raise DeviceError(f"the line to the board broke off ({why}). Is it plugged in?") from None
    finally:
        with contextlib.suppress(SerialException):
            transport.close()


def _feed_watchdog(transport) -> None:
    """Where board.py has a watchdog: feed it from a timer until the board is restarted."""
    try:
        text = transport.fs_readfile("board.py").decode("utf-8", "replace")
    except OSError:
        return
    found = re.search(r"^WATCHDOG_MS *= *([1-9]\d*)", text, re.M)
    if found:
        transport.exec(_FEED.format(ms=found[1]))


def _in_a_line(said: str) -> str:
    """A traceback of the board's, if it is one: what was raised, and where."""
    lines = said.strip().splitlines() or ["the board refused a command, and does not say why"]
    at = re.findall(r'File "(.*?)", line (\d+)', said)
    if "Traceback" not in lines[0] or not at:
        return " ".join(lines)
    return f"on the board, in {at[-1][0]}, line {at[-1][1]}: {lines[-1].strip()}"


def facts(transport) -> Facts:
    """Ask a board what it is."""
    answer = ast.literal_eval(transport.exec(_QUESTIONS).decode().strip().splitlines()[-1])
    platform, machine, version, mpy, viper, pyb, timer, framebuf, free, deflate, frozen = answer
    index = mpy >> 10 & 15
    architecture = _ARCHITECTURES[index] if index < len(_ARCHITECTURES) else f"number {index}"
    return Facts(
        platform, machine, version, mpy & 0xFF, mpy >> 8 & 3, architecture, viper, pyb, timer,
        framebuf, free, deflate, frozen,
    )  # fmt: skip


def space(transport) -> tuple[int, int]:
    """(bytes of a block, bytes that are free) of a board's file system."""
    transport.exec("import os")
    status = transport.eval("os.statvfs(os.getcwd())")
    return status[0], status[0] * status[3]


def restart(transport, seconds: float, on_line, is_last=lambda line: False) -> bool:
    """Soft-reset the board and pass on what it prints for a while, line by line -> whether is_last(line) was true of
    one, half a second after which it ends.

    A transport whose board does not live in the host's time has a `clock` of its own.
    """
    line, clock = transport.serial, getattr(transport, "clock", time)
    transport.exit_raw_repl()
    line.write(b"\x04")
    end, rest, done = clock.monotonic() + seconds, b"", False

    def take(text):
        nonlocal done, end
        text = text.decode("utf-8", "replace").rstrip("\r")
        on_line(text)
        if not done and is_last(text):
            done, end = True, clock.monotonic() + _AFTER_LAST_S

    while clock.monotonic() < end:
        clock.sleep(0.02)
        rest += line.read(line.inWaiting() or 0)
        *whole, rest = rest.split(b"\n")
        for text in whole:
            take(text)
    if rest:
        take(rest)
    return done
