# Chips that are nothing but memory, on an I2C or an SPI bus, for the scripts beside this one: no call allocates, unless
# it raises. Needs a MicroPython.

import gc


class Watched:
    """A bus whose methods call look(register) while `watch` is set; peak: the most memory seen taken."""

    def __init__(self):
        self.watch = False
        self.peak = 0
        self.looks = bytearray(256)

    def look(self, register):
        # twice for every register: asking takes long, as it counts the whole heap
        if self.looks[register] > 1:
            return
        self.looks[register] += 1
        taken = gc.mem_alloc()
        if taken > self.peak:
            self.peak = taken


class Chip(Watched):
    """An IMU. fail: nobody is on the bus; status: what INT_STATUS says; level: the bytes in the FIFO."""

    def __init__(self, who_am_i=0x68, level=3 * 14):
        Watched.__init__(self)
        self.memory = bytearray(128)
        self.memory[0x75] = who_am_i
        self.status = 1
        self.level = level
        self.fail = 0
        self.word = 0

    def answer(self, register, buffer):
        if register == 0x72:
            level = self.level if self.memory[0x6A] & 0x40 else 0  # USER_CTRL.FIFO_EN
            buffer[0] = level >> 8
            buffer[1] = level & 0xFF
        elif register == 0x74 or len(buffer) > 2:
            buffer[0] = self.status
            buffer[1] = self.word = (self.word + 37) & 0xFF
            buffer[8] = self.word
        elif register == 0x3A:
            buffer[0] = self.status
        else:
            for i in range(len(buffer)):
                buffer[i] = self.memory[register + i]

    def take(self, register, value):
        if register == 0x6B:
            value &= 0x7F  # the resets are done at once
        elif register == 0x6A:
            value &= 0xF8
        self.memory[register] = value

    # as an I2C bus

    def readfrom_mem_into(self, address, register, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(register)
        self.answer(register, buffer)

    def writeto(self, address, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(buffer[0])
        self.take(buffer[0], buffer[1])


class SPIChip(Chip):
    """On SPI, and its own chip select. dead: nobody drives MISO; too_fast: accesses above their register's clock."""

    def __init__(self, level):
        Chip.__init__(self, 0x70, level)
        self.dead = 0
        self.register = 0
        self.hz = 0
        self.inits = 0
        self.too_fast = 0
        self.selected = 0

    def __call__(self, level):
        self.selected = not level

    def init(self, baudrate):
        self.hz = baudrate
        self.inits = (self.inits + 1) & 0xFFFF

    def write(self, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(buffer[0])
        self.register = buffer[0] & 0x7F
        if len(buffer) > 1:
            self.too_fast += self.hz > 1_000_000
            self.take(buffer[0], buffer[1] & 0xEF if buffer[0] == 0x6A else buffer[1])

    def readinto(self, buffer, write=0):
        register = self.register
        self.too_fast += self.hz > 1_000_000 and not 0x3A <= register < 0x61
        if self.dead:
            for i in range(len(buffer)):
                buffer[i] = 0xFF
        else:
            self.answer(register, buffer)
