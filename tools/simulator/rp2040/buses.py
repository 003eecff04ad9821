"""The emulated board's buses and pins, in bus time: the chip models of tools/simulator hang on them as they are.

Made by Board.i2c, Board.spi and Board.data_ready.
"""

from rp2040 import emulator


class I2CBus:
    """One of the board's two I2C buses.

    transfers, bytes   what went over it
    cuts               transfers that the board broke off, or got between, to begin another
    log                when a list: (start us, end us, address, bytes written, bytes read, whole) of every transfer
    on_start           called with (us, address, read) after each address, the chip having answered or not
    stuck              True: a chip holds the lines low, nothing goes on
    """

    def __init__(self, board, number, sda, scl):
        self._board = board
        self.chips = {}
        self.transfers = self.bytes = self.cuts = 0
        self.log = None
        self.on_start = []
        self.bit_banged = BitBanged(board, self, sda, scl)
        self._stuck = False
        self._stretch = {}
        self._wait = 0  # us, before the next byte that is read
        self._current = None
        self._open = None  # the transfer under way, as it will stand in the log
        self._held = None  # what waits for a stuck bus
        self._what = None
        self._alarm = board.mcu.clock.create_alarm(self._go_on)
        self._block = block = emulator.I2C(board.mcu, number)
        block.on_start = self._start
        block.on_connect = self._connect
        block.on_write_byte = self._write
        block.on_read_byte = self._read
        block.on_stop = self._stop
        block.on_cut = self._cut

    def add(self, chip, stretch_us=0):
        """Put a chip model on the bus. stretch_us: it holds the clock so long before the first byte of a read."""
        self.chips[chip.address] = chip
        self._stretch[chip.address] = stretch_us
        return chip

    @property
    def stuck(self):
        return self._stuck

    @stuck.setter
    def stuck(self, on):
        self._stuck = on
        if not on and self._held:
            held, self._held = self._held, None
            self._after(*held)

    def _after(self, bits, what, stretch_us=0):
        """Call `what` when so many bits have passed."""
        if self._stuck:
            self._held = (bits, what, stretch_us)
            return
        self._what = what
        self._block.clocked = True
        self._alarm.schedule(bits * self._block.bit_ns + stretch_us * 1000)

    def _go_on(self):
        self._block.clocked = False
        if self._stuck:
            self._held = (0, self._what, 0)
        else:
            self._what()

    def _start(self, repeated):
        if not repeated or self._open is None:
            self.transfers += 1
            self._open = [self._board.now_us, None, None, 0, 0, True]
        self._after(1, self._block.complete_start)

    def _connect(self, address, mode):
        def addressed():
            now, read = self._board.now_us, bool(mode)
            chip = self.chips.get(address)
            if self._open[2] is not None and not (read and address == self._open[2]):
                self.cuts += 1  # only a read of the same chip may follow without a stop
            if self._current is not None and self._current is not chip:
                self._current.i2c_stop(now)
            ack = chip is not None and chip.i2c_start(read, now)
            self._current = chip if ack else None
            self._open[2] = address
            self._open[5] = ack
            self._wait = self._stretch[address] if ack and read else 0
            for listener in self.on_start:
                listener(now, address, read)
            self._block.complete_connect(ack)

        self._after(9, addressed)

    def _write(self, value):
        def written():
            self.bytes += 1
            self._open[3] += 1
            ack = self._current.i2c_write(value, self._board.now_us)
            self._open[5] = ack
            self._block.complete_write(ack)

        self._after(9, written)

    def _read(self, ack):
        def read():
            self.bytes += 1
            self._open[4] += 1
            self._block.complete_read(self._current.i2c_read(self._board.now_us))

        wait, self._wait = self._wait, 0
        self._after(9, read, wait)

    def _stop(self):
        def stopped():
            self._end(True)
            self._block.complete_stop()

        self._after(1, stopped)

    def _end(self, whole):
        now = self._board.now_us
        if self._current is not None:
            self._current.i2c_stop(now)
            self._current = None
        if self._open is not None and self.log is not None:
            start, _, address, written, read, ack = self._open
            self.log.append((start, now, address, written, read, ack and whole))
        self._open = None
        self._board.follow()

    def _cut(self):
        if not self._stuck:
            self.cuts += 1
        self._alarm.cancel()
        self._block.clocked = False
        self._held = None
        self._end(False)


class BitBanged:
    """The same chips when the board drives the two lines itself: SoftI2C, and what I2C.scan() and other empty writes do
    on rp2. Reads START, STOP and bits off the lines and pulls SDA low where a chip would."""

    def __init__(self, board, bus, sda, scl):
        self._board = board
        self._bus = bus
        self._pins = board.mcu.gpio[sda], board.mcu.gpio[scl]
        self._levels = (1, 1)
        self._chip = None
        self._state = None  # None: idle; "address", "write", "read"
        self._reading = False
        self._bits = self._value = 0
        for pin in self._pins:
            pin.add_listener(self._changed)

    def _pull(self, low):
        sda = self._pins[0]
        if low:
            sda.set_input_value(False)
        else:
            sda.release_input()

    def _changed(self, new, old):
        before = self._levels
        sda, scl = self._levels = tuple(emulator.level(pin.value, 1) for pin in self._pins)
        if scl and before[1]:
            if sda != before[0]:
                self._start() if not sda else self._stop()
        elif self._state and scl != before[1]:
            self._rising(sda) if scl else self._falling()

    def _start(self):
        self._state = "address"
        self._bits = self._value = 0

    def _stop(self):
        if self._chip is not None:
            self._chip.i2c_stop(self._board.now_us)
            self._chip = None
            self._board.follow()
        self._state = None
        self._pull(False)

    def _rising(self, sda):
        self._bits += 1
        if self._state != "read":
            if self._bits <= 8:
                self._value = self._value << 1 | sda
        elif self._bits == 9 and sda:
            self._state = "over"  # the board wants no more: it is its line until the stop

    def _falling(self):
        if self._state == "over":
            self._pull(False)
        elif self._bits == 8:
            self._pull(self._eighth())
        elif self._bits == 9:
            self._bits = self._value = 0
            self._pull(False)
            if self._state == "address":
                self._state = "read" if self._reading else "write"
            if self._state == "read":
                self._value = self._chip.i2c_read(self._board.now_us)
                self._pull(not self._value & 0x80)
        elif self._state == "read" and self._bits:
            self._pull(not self._value >> (7 - self._bits) & 1)

    def _eighth(self):
        """Eight bits are in, or out -> True where the chip acknowledges."""
        now = self._board.now_us
        if self._state == "read":
            return False
        if self._state == "write":
            ack = self._chip.i2c_write(self._value, now)
        else:
            self._reading = bool(self._value & 1)
            self._chip = self._bus.chips.get(self._value >> 1)
            ack = self._chip is not None and self._chip.i2c_start(self._reading, now)
        if not ack:
            self._state = "over"
        return ack


class SPIBus:
    """One of the board's two SPI buses.

    bytes    what went over it
    log      when a list: (us, SCK in Hz, mode, byte out, byte in) of every byte
    """

    def __init__(self, board, number):
        self._board = board
        self._number = number
        self._slots = []
        self.bytes = 0
        self.log = None
        self._block = board.mcu.spi[number]
        self._block.on_transmit = self._transmit
        self._alarm = board.mcu.clock.create_alarm(self._arrived)

    def chips(self):
        return [slot["chip"] for slot in self._slots]

    def add(self, chip, cs=None, dc=None, rst=None):
        """Put a chip model on the bus, with its other pins. Without cs it is always selected."""
        slot = {"chip": chip, "selected": cs is None}
        self._slots.append(slot)
        now = self._board.now_us
        if cs is None:
            chip.spi_select(True, now)
        else:
            self._board.watch(cs, 1, lambda level, us: self._select(slot, level, us))
        if dc is not None:
            self._board.watch(dc, 0, lambda level, us: setattr(chip, "dc", level))
        if rst is not None:
            self._board.watch(rst, 1, chip.reset_pin)
        return chip

    def _select(self, slot, level, now):
        slot["selected"] = not level
        slot["chip"].spi_select(not level, now)
        self._board.follow()

    def _transmit(self, value):
        self._hz, self._mode, bits = emulator.spi_clock(self._board.mcu, self._number)
        self._out = value
        self._alarm.schedule(bits * 1e9 / self._hz)

    def _arrived(self):
        now, answer = self._board.now_us, 0xFF
        for slot in self._slots:
            if slot["selected"]:
                answer &= slot["chip"].spi_transfer(self._out, now, int(self._hz), self._mode)
        self.bytes += 1
        if self.log is not None:
            self.log.append((now, int(self._hz), self._mode, self._out, answer))
        self._block.complete_transmit(answer)


class DataReady:
    """An input of the board that follows a chip's interrupt output, in the chip's own time."""

    def __init__(self, board, number, chip):
        self._board = board
        self._pin = board.mcu.gpio[number]
        self._chip = chip
        self._alarm = board.mcu.clock.create_alarm(self._due)
        self._level = None
        self.follow()

    def _due(self):
        self._chip.poll(self._board.now_us)
        self.follow()

    def follow(self):
        """The chip's level and its next change, after anything that may have moved them."""
        if self._chip.int_level != self._level:
            self._level = self._chip.int_level
            self._pin.set_input_value(bool(self._level))
        at = self._chip.next_event()
        if at is None:
            self._alarm.cancel()
        else:
            self._alarm.schedule(max(0.0, at * 1000 - self._board.mcu.clock.nanos))
