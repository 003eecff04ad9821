# A bus for the DMP's tick, and a driver with an image on it, without a chip model: nothing here allocates once it runs.

from array import array

import micropython
from memory_chip import Watched
from upright.dmp import MpuDmp
from upright.mpu6050 import MPU6050

IMAGES = (bytes(3062), bytes(1929))


class Bus(Watched):
    """Registers that are memory, DMP memory that is too, and a FIFO of whole packets of our making."""

    def __init__(self, packet):
        Watched.__init__(self)
        self.memory = bytearray(128)
        self.memory[0x75] = 0x68
        self.dmp = bytearray(4096)
        self.at = 0
        self.packet = bytearray(packet)
        self.level = packet
        self.status = 1
        self.fail = 0
        self.seed = 1
        self.fill()

    @micropython.native
    def fill(self):
        """Another packet: a unit quaternion near (1, 0, 0, 0), turned about all axes, and any words."""
        p = self.packet
        for i in range(len(p)):
            self.seed = (self.seed * 1103 + 12345) & 0x7FFFF
            p[i] = self.seed >> 8 & 0xFF
        p[0], p[1] = 0x3F, 0xC0 | p[1] & 0x3F
        for i in (4, 8, 12):
            p[i] = 0 if p[i + 1] & 1 else 0xFF
            p[i + 1] = p[i + 1] >> 2 | (0 if p[i + 1] & 1 else 0xC0)

    def readfrom_mem_into(self, address, register, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(register)  # before the frame of what follows, which is a large one
        self._answer(register, buffer)

    @micropython.native
    def _answer(self, register, buffer):
        n = len(buffer)
        if register == 0x72:
            level = self.level if self.memory[0x6A] & 0x40 else 0
            buffer[0] = level >> 8
            buffer[1] = level & 0xFF
        elif register == 0x74:
            self.fill()
            p = self.packet
            size = len(p)
            j = 0
            for i in range(n):
                buffer[i] = p[j]
                j += 1
                if j == size:
                    j = 0
        elif register == 0x3A:
            for i in range(n):
                buffer[i] = 0
            buffer[0] = self.status
        elif register == 0x6F:
            for i in range(n):
                buffer[i] = self.dmp[self.at]
                self.at += 1
        else:
            for i in range(n):
                buffer[i] = self.memory[register + i]

    def writeto(self, address, buffer):
        if self.fail:
            raise OSError(5)
        if self.watch:
            self.look(buffer[0])
        self._take(buffer)

    def _take(self, buffer):
        register = buffer[0]
        if register == 0x6D:
            self.at = buffer[1] << 8 | buffer[2]
        elif register == 0x6F:
            for i in range(1, len(buffer)):
                self.dmp[self.at] = buffer[i]
                self.at += 1
        else:
            value = buffer[1]
            if register == 0x6B:
                value &= 0x7F
            elif register == 0x6A:
                value &= 0xF0
            self.memory[register] = value


def make(version, axes=("x", "y", "z"), rate=200):
    """(bus, dmp), configured; version: 0 for v6.12, 1 for v2.0."""
    bus = Bus((28, 42)[version])
    dmp = MpuDmp(MPU6050(bus, 0x68), IMAGES[version], rate, accept_unknown=True, axes=axes)
    dmp.configure()
    return bus, dmp


OUT = array("i", [0, 0, 0, 0])
