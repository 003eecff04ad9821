# The registers of a chip on an I2C or an SPI bus: the same methods on either, for a driver's tick and its set-up.
# Needs nothing but the bus object that is handed in. Runs on MicroPython >= 1.22 and under CPython with a
# `micropython` shim.

import time

import micropython

_READ = 0x80  # SPI: first bit of the address byte
_IDLE = 0xFF  # SPI: sent while reading; should the chip take it for an address, it is a read


def plain_name(register):
    return f"register 0x{register:02x}"


class Registers:
    """What a driver's set-up does with registers; a subclass moves the bytes. Every bus has, for the tick,

        read_into(register, buffer)  fill buffer from register on
        write(register, value)       one register
        write_from(buffer)           buffer[0] is the register, the others go into it and the next ones

    which raise OSError when the bus fails and allocate nothing. The methods here may allocate; they raise
    error_class with the name of the register.

    error_class  the exception class of the driver, an OSError
    name         how messages show a register: a function of its number
    """

    def __init__(self, error_class, name):
        self.error_class = error_class
        self.name = name
        self._byte = bytearray(1)

    def read_register(self, register):
        """One register's value."""
        self.read_registers(register, self._byte)
        return self._byte[0]

    def read_registers(self, register, buffer):
        """read_into() for set-up."""
        self._access(self.read_into, "reading", register, buffer)

    def write_register(self, register, value):
        """write() for set-up."""
        self._access(self.write, "writing", register, value)

    def verify_register(self, register, value, mask=0xFF):
        """Raise error_class unless the bits of mask read back as value has them."""
        found = self.read_register(register)
        if (found ^ value) & mask:
            raise self.error_class(
                f"{self.name(register)}: wrote 0x{value:02x}, read 0x{found:02x}"
            )

    def _access(self, function, verb, register, what):
        try:
            function(register, what)
            return
        except OSError as e:
            fault = e
        raise self.error_class(f"bus error ({fault}) while {verb} {self.name(register)}")


class I2CRegisters(Registers):
    """Registers of the chip at `address` on an I2C bus.

    i2c  has readfrom_mem_into and writeto; give machine.I2C a short timeout, for a stuck bus blocks the tick
         as long
    """

    def __init__(self, i2c, address, error_class=OSError, name=plain_name):
        Registers.__init__(self, error_class, name)
        self.address = address
        self.place = (i2c, address)  # what nothing else has: see ahrs.py
        self._out = bytearray(2)
        self.bind(i2c)

    def bind(self, i2c):
        """Use this bus. Its methods are looked up once, here: a call of what is stored allocates nothing."""
        self._read = i2c.readfrom_mem_into
        self._send = i2c.writeto

    # The tick. writeto of a prebuilt buffer, as writeto_mem allocates on several ports.

    @micropython.viper
    def read_into(self, register, buffer):
        self._read(self.address, register, buffer)

    @micropython.viper
    def write(self, register, value):
        out = self._out
        out[0] = register
        out[1] = value
        self._send(self.address, out)

    @micropython.viper
    def write_from(self, buffer):
        self._send(self.address, buffer)


class SPIRegisters(Registers):
    """Registers of a chip on an SPI bus of its own: bit 7 of the address byte set for a read.

    spi      has write, readinto and, for two clocks, init(baudrate=); a machine.SPI
    cs       chip select, an output pin, called with 0 and 1
    fast_hz  clock of reads of three bytes or more that lie within the registers of `fast`
    slow_hz  clock of everything else
    fast     (first, last) register that the chip lets be read at fast_hz

    find_clocks() decides whether fast_hz is used; until then the bus keeps the clock that it was made with.
    burst_hz says what came of it (0: as made).
    """

    def __init__(
        self, spi, cs, fast_hz, slow_hz, fast=(0, -1), error_class=OSError, name=plain_name
    ):
        Registers.__init__(self, error_class, name)
        self.slow_hz = slow_hz
        self.fast_hz = fast_hz
        self.burst_hz = 0  # while 0 the clock is left alone
        self._hz = 0  # what the bus runs at
        self._first, self._last = fast
        self._head = bytearray(1)
        self._out = bytearray(2)
        self._cs = cs
        self.place = (spi, cs)  # what nothing else has: see ahrs.py
        self.bind(spi)

    def bind(self, spi):
        """Use this bus. Its methods are looked up once, here: a call of what is stored allocates nothing."""
        self._send = spi.write
        self._receive = spi.readinto
        self._init = getattr(spi, "init", None)

    # The tick

    @micropython.native
    def read_into(self, register, buffer):
        n = len(buffer)
        # for a byte or two another clock does not pay
        hz = self.slow_hz
        if n > 2 and register >= self._first and register + n <= self._last + 1:
            hz = self.burst_hz
        if hz != self._hz:
            self._clock(hz)
        self._head[0] = register | _READ
        try:
            self._cs(0)
            self._send(self._head)
            self._receive(buffer, _IDLE)
        finally:
            self._cs(1)

    @micropython.native
    def write(self, register, value):
        out = self._out
        out[0] = register
        out[1] = value
        self.write_from(out)

    @micropython.native
    def write_from(self, buffer):
        if self._hz != self.slow_hz:
            self._clock(self.slow_hz)
        try:
            self._cs(0)
            self._send(buffer)
        finally:
            self._cs(1)

    # What machine.SPI.init(baudrate=) does, by the ports' sources: stm32 (machine_spi.c, spi.c) leaves
    # polarity and phase alone and takes the next lower power-of-two part of the peripheral's clock
    # (84 MHz: 656 kHz for 1 MHz, 5.25 MHz for 10 MHz, 10.5 MHz for 20 MHz); it sets up pins and
    # peripheral anew and so lets go of SCK for a moment, hence only while CS is high. rp2 sets nothing
    # but the divider, again to the next lower rate. Neither allocates. esp32 tears the whole bus down.

    @micropython.native
    def _clock(self, hz):
        if self.burst_hz:
            self._hz = 0  # unknown, should it fail
            self._init(baudrate=hz)
            self._hz = hz

    def find_clocks(self):
        """Let go of the chip and decide whether bursts get a clock of their own.

        They do where the bus changes its clock without allocating memory, in less time than that saves.
        """
        self._cs(1)
        self.burst_hz = self._hz = 0
        try:
            self._init(baudrate=self.slow_hz)
        except Exception:  # whatever a port raises where it has no such method or argument
            return
        taken = self._try_clocks()
        # a burst of 16 bytes must gain more than the way there and back costs
        gain = 128_000_000 // self.slow_hz - 128_000_000 // self.fast_hz
        if 0 <= taken <= gain:
            self.burst_hz = self.fast_hz
        else:
            self._init(baudrate=self.slow_hz)
            self.burst_hz = self.slow_hz
        self._hz = self.slow_hz

    def _try_clocks(self):
        """Microseconds for fast and back to slow without a heap, -1 if that cannot be."""
        init = self._init
        fast, slow = self.fast_hz, self.slow_hz
        now = time.ticks_us
        begun = ended = 0
        possible = True
        micropython.heap_lock()
        try:
            init(baudrate=fast)
            init(baudrate=slow)
            begun = now()
            init(baudrate=fast)
            init(baudrate=slow)
            ended = now()
        except Exception:
            possible = False
        finally:
            micropython.heap_unlock()
        return time.ticks_diff(ended, begun) if possible else -1
