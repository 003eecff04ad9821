# A mock of MicroPython's `machine` in simulated time: I2C, SPI, Pin, Timer, WDT, resets. Portable: CPython, unix port.
# It behaves as the rp2 port does, with bus time for every byte. Two transfers that meet on one bus spoil each other
# (counted in `cuts`), as they do on a board. Simulated chips are attached with the wire_... functions at the end.

import sys

import kernel
import simulated_time

sys.modules["utime"] = simulated_time  # a file of that name would not override the unix port's

EIO = 5
ETIMEDOUT = 110

PWRON_RESET = 1
WDT_RESET = 3
SOFT_RESET = 5


# ---------------------------------------------------------------- buses
class _Bus:
    """What is on the wires: the chips, and whether a transfer is under way."""

    def __init__(self):
        self.chips = []
        self.busy = False
        self.cuts = 0  # transfers that began while another was under way
        self.spoilt = False
        self.stuck = False  # SDA or SCL is held low: every transfer times out
        self.clocks = 0  # until a slave lets go of SDA, see hold_sda()
        self.swallows = (
            False  # as rp2 may: a written byte that is refused ends the transfer without an error
        )
        self.raises = (
            None  # an exception that the next transfer in an interrupt raises: Ctrl-C, a full heap
        )
        self.timeout_us = 0  # the longest that it was given
        self.failed = {}  # transfers that ended with an error, by address
        self.transfers = 0
        self.bytes = 0

    def begin(self):
        if self.busy:
            self.cuts += 1
            self.spoilt = True
            raise OSError(EIO)
        if self.raises is not None and kernel.in_irq():
            error, self.raises = self.raises, None
            raise error
        self.busy = True
        self.spoilt = False
        self.transfers += 1
        kernel.begin_transfer()

    def end(self):
        self.busy = False
        kernel.changed()  # an access may have moved a chip's next event
        kernel.end_transfer()
        if self.spoilt:
            raise OSError(EIO)


class _Clock:
    """Passes bus time: all at once while nothing else is due, else step by step with what falls due between."""

    def __init__(self, unit_ns):
        self.unit_ns = unit_ns
        self.reset()

    def reset(self):
        self.start = kernel.now()
        self.units = 0
        self.quiet_until = kernel.next_due()

    def step(self, units):
        self.units += units
        at = self.start + self.units * self.unit_ns // 1000
        if at >= self.quiet_until:
            kernel.advance_to(max(at, kernel.now()))
            self.quiet_until = kernel.next_due()
        return at

    def finish(self, units):
        self.units += units
        at = self.start + -(-self.units * self.unit_ns // 1000)
        kernel.advance_to(max(at, kernel.now()))


class _Swallowed(Exception):
    """A byte was refused, and the port does not tell."""


def _timeout_us(us):
    """What the port makes of a bus's time-out. stm32 rounds up to ms (machine_i2c.c). esp32 counts ticks of 10 ms and
    rounds down, so a shorter one lets no transfer pass (IDF 5.5.2)."""
    if port == "stm32":
        return -(-us // 1000) * 1000
    if port == "esp32":
        return us // 10000 * 10000
    return us


class SoftI2C:
    """Bit-banged I2C on two pins; the bus is the one that these pins were wired to."""

    def __init__(self, scl, sda, *, freq=400000, timeout=50000):
        self._attach(_bus_of_pins(_number(scl), _number(sda)), freq, timeout)

    def _attach(self, bus, freq, timeout):
        self._bus = bus
        self._timeout = timeout
        bus.timeout_us = max(bus.timeout_us, _timeout_us(timeout))
        self._freq = freq
        self._clock = _Clock(1000000000 // freq)

    def __repr__(self):
        name = type(self).__name__
        return "%s(%d, freq=%d, timeout=%d)" % (name, id(self._bus), self._freq, self._timeout)

    def scan(self):
        found = []
        for address in range(0x08, 0x78):
            try:
                self._transfer(address, None, b"", None)
                found.append(address)
            except OSError:
                pass
        return found

    def writeto(self, addr, buf, stop=True):
        kernel.enter()
        try:
            self._transfer(addr, None, buf, None)
        finally:
            kernel.leave()
        return len(buf)

    def readfrom_into(self, addr, buf, stop=True):
        kernel.enter()
        try:
            self._transfer(addr, None, None, buf)
        finally:
            kernel.leave()

    def readfrom(self, addr, nbytes, stop=True):
        buf = bytearray(nbytes)  # allocates, as on a board: not for a hard callback
        self.readfrom_into(addr, buf)
        return bytes(buf)

    def readfrom_mem_into(self, addr, memaddr, buf, *, addrsize=8):
        kernel.enter()
        try:
            self._transfer(addr, memaddr, None, buf)
        finally:
            kernel.leave()

    def readfrom_mem(self, addr, memaddr, nbytes, *, addrsize=8):
        buf = bytearray(nbytes)
        self.readfrom_mem_into(addr, memaddr, buf)
        return bytes(buf)

    def writeto_mem(self, addr, memaddr, buf, *, addrsize=8):
        both = bytes([memaddr]) + bytes(buf)  # allocates, as on several ports
        self.writeto(addr, both)

    def _transfer(self, address, register, out, into):
        bus = self._bus
        bus.begin()
        try:
            self._carry_out(bus, address, register, out, into)
        except _Swallowed:
            pass
        except OSError:
            bus.failed[address] = bus.failed.get(address, 0) + 1
            raise
        finally:
            bus.end()

    def _carry_out(self, bus, address, register, out, into):
        clock = self._clock
        clock.reset()
        timeout = _timeout_us(self._timeout)
        if bus.stuck or not timeout:
            kernel.advance(timeout)
            raise OSError(ETIMEDOUT)
        chip = None
        for candidate in bus.chips:
            if candidate.address == address:
                chip = candidate
        if chip is None:
            chip = _behind(bus.chips, address)
        at = clock.step(10)
        reading = register is None and out is None
        if chip is None or not chip.i2c_start(reading, at):
            clock.finish(1)
            raise OSError(EIO)
        if register is not None:
            self._put(chip, clock, register)
        if out is not None:
            for value in out:
                self._put(chip, clock, value)
        if into is not None:
            if register is not None and not chip.i2c_start(True, clock.step(10)):
                raise OSError(EIO)
            end = clock.start + timeout
            if port == "stm32":
                end += 10000000  # it waits so long for each byte
            for i in range(len(into)):
                at = clock.step(9)
                if at > end:
                    chip.i2c_stop(at)
                    raise OSError(ETIMEDOUT)
                into[i] = chip.i2c_read(at)
            bus.bytes += len(into)
        chip.i2c_stop(clock.step(1))
        clock.finish(0)

    def _put(self, chip, clock, value):
        at = clock.step(9)
        self._bus.bytes += 1
        if not chip.i2c_write(value, at):
            chip.i2c_stop(at)
            clock.finish(1)
            raise _Swallowed if self._bus.swallows else OSError(EIO)


def _behind(chips, address):
    """A chip that another one lets through from its auxiliary bus, or None."""
    for candidate in chips:
        if hasattr(candidate, "behind"):
            chip = candidate.behind(address)
            if chip is not None:
                return chip
    return None


class I2C(SoftI2C):
    def __init__(self, id, *, scl=None, sda=None, freq=400000, timeout=50000):
        bus = _i2c_bus(id)
        if scl is not None:
            _i2c_pins[(_number(scl), _number(sda))] = bus
        self._attach(bus, freq, timeout)


class SoftSPI:
    MSB = 0
    LSB = 1

    def __init__(
        self,
        baudrate=500000,
        *,
        polarity=0,
        phase=0,
        bits=8,
        firstbit=0,
        sck=None,
        mosi=None,
        miso=None,
    ):
        self._bus = _spi_bus(("pins", _number(sck), _number(mosi)))
        self._clock = _Clock(0)
        self._hz = self._polarity = self._phase = 0
        self.init(baudrate, polarity=polarity, phase=phase)

    def __repr__(self):
        return "%s(%d, baudrate=%d)" % (type(self).__name__, id(self._bus), self._hz)

    def init(self, baudrate=None, *, polarity=None, phase=None, bits=8, firstbit=0):
        # allocates nothing, as on boards: a driver finds out by calling it with the heap locked
        if baudrate is not None:
            self._hz = baudrate
            self._clock.unit_ns = 1000000000 // baudrate
        if polarity is not None:
            self._polarity = polarity
        if phase is not None:
            self._phase = phase

    def deinit(self):
        pass

    def write(self, buf):
        kernel.enter()
        try:
            self._exchange(buf, None)
        finally:
            kernel.leave()

    def readinto(self, buf, write=0):
        kernel.enter()
        try:
            self._exchange(bytes([write]) * len(buf), buf)
        finally:
            kernel.leave()

    def read(self, nbytes, write=0):
        buf = bytearray(nbytes)
        self.readinto(buf, write)
        return bytes(buf)

    def write_readinto(self, write_buf, read_buf):
        if len(write_buf) != len(read_buf):
            raise ValueError("buffers must be the same length")
        kernel.enter()
        try:
            self._exchange(write_buf, read_buf)
        finally:
            kernel.leave()

    def _exchange(self, out, into):
        bus = self._bus
        bus.begin()
        try:
            clock = self._clock
            clock.reset()
            mode = self._polarity << 1 | self._phase
            for i in range(len(out)):
                at = clock.step(8)
                answer = 0xFF
                for chip in bus.chips:
                    if chip.selected:
                        answer &= chip.device.spi_transfer(out[i], at, self._hz, mode)
                if into is not None:
                    into[i] = answer
            bus.bytes += len(out)
            clock.finish(0)
        finally:
            bus.end()


class SPI(SoftSPI):
    def __init__(
        self,
        id,
        baudrate=1000000,
        *,
        polarity=0,
        phase=0,
        bits=8,
        firstbit=0,
        sck=None,
        mosi=None,
        miso=None,
    ):
        self._bus = _spi_bus(id)
        self._clock = _Clock(0)
        self._hz = self._polarity = self._phase = 0
        self.init(baudrate, polarity=polarity, phase=phase)


# ---------------------------------------------------------------- pins
class _Wire:
    """The state of one pin, shared by every Pin object of that number."""

    def __init__(self):
        self.level = 0
        self.held = None  # a bus whose SDA it is, while a slave holds that low
        self.chip = None  # a chip that drives it
        self.listeners = []  # called with (level, now) when the board drives it
        self.irq = None
        self.trigger = 0
        self.cut = False  # the wire is: edges are lost

    def due(self):
        # only an interrupt has to see an edge when it comes: whoever reads the pin gets the level of that moment
        return self.chip.next_event() if self.irq else None

    def fire(self, now):
        self.chip.poll(now)
        self.follow()

    def follow(self):
        self.set(self.chip.int_level)

    def set(self, level):
        if level == self.level:
            return
        self.level = level
        edge = Pin.IRQ_RISING if level else Pin.IRQ_FALLING
        if self.irq and self.trigger & edge and not self.cut:
            self.irq.request()


class Pin:
    IN = 0
    OUT = 1
    OPEN_DRAIN = 2
    PULL_UP = 1
    PULL_DOWN = 2
    IRQ_FALLING = 4
    IRQ_RISING = 8

    def __init__(self, id, mode=-1, pull=-1, value=None):
        self.id = id
        self._wire = _wire(id)
        if value is not None:
            self.value(value)

    def init(self, mode=-1, pull=-1, value=None):
        if value is not None:
            self.value(value)

    def value(self, x=None):
        kernel.enter()
        try:
            wire = self._wire
            if x is None:
                if wire.chip:
                    wire.chip.poll(kernel.now())
                    wire.follow()
                return 0 if wire.held and wire.held.stuck else wire.level
            level = 1 if x else 0
            if level != wire.level:
                wire.set(level)
                for listener in wire.listeners:
                    listener(level, kernel.now())
        finally:
            kernel.leave()

    def __call__(self, x=None):
        return self.value(x)

    def on(self):
        self.value(1)

    def off(self):
        self.value(0)

    high = on
    low = off

    def toggle(self):
        self.value(not self._wire.level)

    def irq(self, handler=None, trigger=4 | 8, hard=False):
        wire = self._wire
        if wire.irq:
            wire.irq.cancel()
            wire.irq = None
        if wire.chip:
            wire.fire(kernel.now())  # what came before is no edge for this handler
            kernel.changed()
        wire.irq = kernel.Irq(handler, self, hard) if handler else None
        wire.trigger = trigger
        return wire.irq


# ---------------------------------------------------------------- timers
class Timer:
    """As on rp2 from MicroPython 1.26 on: any number of them, `hard` honoured, microsecond resolution from `freq`. The
    numbers 0 to 3 are esp32's, whose callbacks are soft only."""

    ONE_SHOT = 0
    PERIODIC = 1
    silent = False  # True: no timer of the board calls
    dropped = 0  # calls that did not come for that

    def __init__(self, id=-1, **options):
        if not -1 <= id <= 3:
            raise ValueError("Timer doesn't exist")
        self._soft_only = id >= 0
        self._irq = None
        if options:
            self.init(**options)

    def init(self, *, mode=1, period=-1, freq=None, tick_hz=1000, callback=None, hard=False):
        self.deinit()
        if hard and self._soft_only:
            raise ValueError("hard Timers are not implemented")
        if freq is not None:
            self._period = int(1000000 / freq)
        elif period >= 0:
            self._period = period * 1000000 // tick_hz
        else:
            raise ValueError("period or freq")
        if self._period < 1:
            self._period = 1
        self._periodic = mode == Timer.PERIODIC
        self._irq = kernel.Irq(callback, self, hard)
        self._irq.on_error = self.deinit
        self._at = kernel.now() + self._period
        kernel.add_source(self)

    def deinit(self):
        if self._irq:
            self._irq.cancel()
            self._irq = None
            kernel.remove_source(self)

    @property
    def lost(self):
        """Ticks that came while the one before was still waiting."""
        return self._irq.lost if self._irq else 0

    def due(self):
        return self._at

    def fire(self, now):
        irq = self._irq
        if self._periodic:
            self._at += self._period
            kernel.changed()
        else:
            kernel.remove_source(self)
        if Timer.silent:
            Timer.dropped += 1
        elif irq.handler:
            irq.request()


class WDT:
    def __init__(self, id=0, timeout=5000):
        self._timeout = timeout * 1000
        self.feed()
        kernel.add_source(self)

    def feed(self):
        self._at = kernel.now() + self._timeout
        kernel.changed()

    def due(self):
        return self._at

    def fire(self, now):
        self._at = now + (1 << 40)
        kernel.reset_request = WDT_RESET


# ---------------------------------------------------------------- the board itself
def unique_id():
    return b"\xe6\x60SIMUL1"


def freq(hz=None):
    return 125000000


def reset_cause():
    return _cause


def reset():
    raise kernel.Reset(PWRON_RESET)


def soft_reset():
    raise kernel.Reset(SOFT_RESET)


def idle():
    kernel.idle()


def lightsleep(ms=0):
    kernel.sleep_us(ms * 1000)


def disable_irq():
    return kernel.mask(True)


def enable_irq(state=False):
    kernel.mask(state)


# ---------------------------------------------------------------- wiring, for the harness
class _Selected:
    """An SPI chip and its chip select."""

    def __init__(self, device):
        self.device = device
        self.selected = False

    def select(self, level, now):
        self.selected = not level
        self.device.spi_select(self.selected, now)


def wire_i2c(bus_id, chip, scl=None, sda=None):
    """Put a chip model on an I2C bus (and name the pins, for SoftI2C). -> the bus, with its counters."""
    bus = _i2c_bus(bus_id)
    bus.chips.append(chip)
    if scl is not None:
        _i2c_pins[(scl, sda)] = bus
    return bus


def wire_spi(bus_id, chip, cs=None, dc=None, rst=None):
    """Put a chip model on an SPI bus. Without cs it is always selected."""
    bus = _spi_bus(bus_id)
    slot = _Selected(chip)
    bus.chips.append(slot)
    if cs is None:
        slot.select(0, kernel.now())
    else:
        wire = _wire(cs)
        wire.level = 1
        wire.listeners.append(slot.select)
    if dc is not None:

        def set_dc(level, now):
            chip.dc = level

        _wire(dc).listeners.append(set_dc)
    if rst is not None:
        wire_reset(rst, chip)
    return bus


def wire_pin(pin, chip):
    """A pin follows the chip's interrupt output."""
    wire = _wire(pin)
    wire.chip = chip
    wire.level = chip.int_level
    kernel.add_source(wire)


def wire_reset(pin, chip):
    """A pin is the chip's reset input."""
    _wire(pin).listeners.append(chip.reset_pin)


def hold_sda(bus_id, scl, sda, clocks=9):
    """A chip that a reset of the board has cut off in a read holds SDA low, until it has seen so many clocks."""
    bus = _i2c_bus(bus_id)
    bus.stuck = True
    bus.clocks = clocks
    _wire(scl).level = _wire(sda).level = 1
    _wire(sda).held = bus

    def clocked(level, now):
        if level and bus.clocks:
            bus.clocks -= 1
            bus.stuck = bus.clocks > 0

    _wire(scl).listeners.append(clocked)


def power_on(cause=PWRON_RESET, like="rp2"):
    """A fresh board: no wiring, time 0. like: the port whose habits its buses have, "rp2", "esp32" or "stm32"."""
    global _i2c, _i2c_pins, _spi, _wires, _cause, port
    kernel.reset()
    port = like
    Timer.silent = False
    Timer.dropped = 0
    _i2c = {}
    _i2c_pins = {}
    _spi = {}
    _wires = {}
    _cause = cause


def restart(cause):
    """The processor resets; the chips, their state and their wiring stay."""
    global _cause
    kernel.restart()
    _cause = cause
    for source in kernel.sources():
        if isinstance(source, (Timer, WDT)):
            kernel.remove_source(source)
    for wire in _wires.values():
        wire.irq = None
    for buses in (_i2c, _spi):
        for bus in buses.values():
            bus.busy = bus.spoilt = False


def wires():
    """The state of each pin that is in use."""
    return list(_wires.values())


def _number(pin):
    return pin.id if isinstance(pin, Pin) else pin


def _i2c_bus(id):
    if id not in _i2c:
        _i2c[id] = _Bus()
    return _i2c[id]


def _bus_of_pins(scl, sda):
    if (scl, sda) not in _i2c_pins:
        _i2c_pins[(scl, sda)] = _Bus()  # nothing is wired there: every address is a NACK
    return _i2c_pins[(scl, sda)]


def _spi_bus(id):
    if id not in _spi:
        _spi[id] = _Bus()
    return _spi[id]


def _wire(id):
    if id not in _wires:
        _wires[id] = _Wire()
    return _wires[id]


power_on()
