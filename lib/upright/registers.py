# The registers of a chip on an I2C or an SPI bus: the same methods on either, for a driver's tick and its set-up.
# Needs only the bus object that is passed in. Runs on MicroPython >= 1.22 and under CPython with a
# `micropython` shim.

import time

import micropython

_READ = 0x80  # SPI: first bit of the address byte
_IDLE = 0xFF  # SPI: sent while reading; if the chip takes it for an address, it is a read


def plain_name(register):
    return f"register 0x{register:02x}"


def eight_bits(address):
    """The ValueError for an address in the form of data sheets and modules, with the bit for reading behind it."""
    return ValueError(f"0x{address:02x} is the 8-bit form: pass 0x{address >> 1:02x}")


class Registers:
    """Register access for a driver's set-up; a subclass transfers the bytes. For the tick every bus has

        read_into(register, buffer)  fill buffer from register on
        write(register, value)       one register
        write_from(buffer)           buffer[0] is the register; the other bytes go into it and the next ones

    They raise OSError when the bus fails, and allocate nothing. The methods here may allocate. They raise error_class
    with the name of the register.

    error_class  the exception class of the driver, an OSError
    name         a function that takes a register's number and returns its name for messages
    """

    def __init__(self, error_class, name):
        self.error_class = error_class
        self.name = name
        self._byte = bytearray(1)

    def read_register(self, register):
        """The value of one register."""
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

    i2c  has readfrom_mem_into and writeto; give machine.I2C a short timeout: a stuck bus blocks the tick
         that long
    """

    def __init__(self, i2c, address, error_class=OSError, name=plain_name):
        Registers.__init__(self, error_class, name)
        if not hasattr(i2c, "readfrom_mem_into"):
            raise TypeError(f"{i2c!r} is not an I2C bus")
        if not isinstance(address, int) or not 0x08 <= address <= 0xFF:
            raise ValueError(f"address {address!r} is not an int, 0x08 to 0x77")
        if address > 0x77:
            raise eight_bits(address)
        self.address = address
        self.bus = i2c
        self._out = bytearray(2)
        self.bind(i2c)

    @property
    def place(self):
        """What no other chip has, see ahrs.py."""
        return self.bus, self.address

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

    find_clocks() decides whether fast_hz is used. Until then the bus keeps its first clock. burst_hz is the clock of
    bursts (0: the bus's first clock).
    """

    def __init__(
        self, spi, cs, fast_hz, slow_hz, fast=(0, -1), error_class=OSError, name=plain_name
    ):
        Registers.__init__(self, error_class, name)
        if not hasattr(spi, "readinto") or not callable(cs):
            raise TypeError(f"{spi!r} and {cs!r} are not an SPI bus and a pin")
        self.slow_hz = slow_hz
        self.fast_hz = fast_hz
        self.burst_hz = 0  # 0: the clock is not changed
        self._hz = 0  # present clock
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
        # for a byte or two a change of clock costs more than it saves
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

    # What machine.SPI.init(baudrate=) does, from the ports' sources: stm32 (machine_spi.c, spi.c) keeps
    # polarity and phase and takes the next lower power-of-two part of the peripheral's clock
    # (84 MHz: 656 kHz for 1 MHz, 5.25 MHz for 10 MHz, 10.5 MHz for 20 MHz); it sets up pins and
    # peripheral again and so releases SCK for a moment; so call it only while CS is high. rp2 sets only
    # the divider, also to the next lower rate. Neither allocates. esp32 closes the whole bus.

    @micropython.native
    def _clock(self, hz):
        if self.burst_hz:
            self._hz = 0  # unknown if init() fails
            self._init(baudrate=hz)
            self._hz = hz

    def find_clocks(self):
        """Release the chip and decide whether bursts get their own clock.

        They do if the bus can change its clock without allocating, in less time than that saves.
        """
        self._cs(1)
        self.burst_hz = self._hz = 0
        try:
            self._init(baudrate=self.slow_hz)
        except Exception:  # a port without this method or argument may raise anything
            return
        taken = self._try_clocks()
        # a burst of 16 bytes must save more than both changes cost
        gain = 128_000_000 // self.slow_hz - 128_000_000 // self.fast_hz
        if 0 <= taken <= gain:
            self.burst_hz = self.fast_hz
        else:
            self._init(baudrate=self.slow_hz)
            self.burst_hz = self.slow_hz
        self._hz = self.slow_hz

    def _try_clocks(self):
        """Microseconds for a change to fast and back without heap; -1 if it allocates."""
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
