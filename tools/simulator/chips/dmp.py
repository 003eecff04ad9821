# The Digital Motion Processor of a simulated MPU: memory in banks, and packets from the world's motion.
# Part of the chip models; portable (CPython, MicroPython). It runs no program: it compares its memory with images
# that a test hands over, and does what these are known to do. Floats, as models may.

import math

from micropython import const

_BANK_SEL = const(0x6D)
_PRGM_START_H = const(0x70)

_DMP_EN = const(0x80)  # USER_CTRL
_DIVIDER = const(0x216)  # D_0_22 of both images, 16 bits: a packet every 1 + this samples
_TILT = 0.02  # of the tilt error that one step takes off where the world does not know the truth
_UNIT = 1 << 30

# bytes of the image: program start, bytes of a packet
LAYOUTS = {3062: (0x0400, 28), 1929: (0x0300, 42)}


class Dmp:
    """The DMP of one chip: `chip.dmp`.

    images   list: the files (image and, perhaps, a list of records behind it) that it runs, as bytes
    dead     None: in order. "silent": takes an image and does nothing. "frozen": repeats its first
             packet. "zero": packets of zeros. "small": memory whose bank numbers mean nothing
    memory   bytearray; reading and writing over the bus steps through it within a bank

    It runs while USER_CTRL says so, the program start is the image's, and memory holds one of `images`, whatever the
    divider of the rate; else it puts nothing into the FIFO. The attitude in its packets is the
    world's truth where the world has that (truth(k)), yaw 0 when the DMP starts; elsewhere the gyro
    words integrated, and levelled by the accelerometer's.
    """

    def __init__(self, chip, size, dead=None):
        self.chip = chip
        self.images = []
        self.dead = dead
        self.packets = 0
        self._size = size
        self.reset()

    def reset(self):
        """Power-on reset. What memory holds then is not documented; not an image, in any case."""
        self.memory = bytearray(self._size)
        self._at = 0
        self._wrapped = False
        self.layout = None  # of the image that runs
        self.stop()

    def stop(self):
        self.running = False
        self.length = 0

    # The bus

    def point(self, register, value):
        """BANK_SEL or MEM_START_ADDR was written."""
        self._wrapped = False
        if register == _BANK_SEL:
            self._at = (0 if self.dead == "small" else value & 0x1F) << 8 | self._at & 0xFF
        else:
            self._at = self._at & ~0xFF | value

    def read(self):
        self._accessed()
        value = self.memory[self._at] if self._at < self._size else 0
        self._step()
        return value

    def write(self, value):
        self._accessed()
        if self.chip.awake:
            if self._at < self._size:
                self.memory[self._at] = value
            else:
                self.chip._misused("DMP memory beyond its end")
        else:
            self.chip._misused("DMP memory written asleep")
        if self.running:
            self._look()
        self._step()

    def _accessed(self):
        if self._wrapped:
            self.chip._misused("DMP memory accessed across a bank")

    def _step(self):
        self._wrapped = self._at & 0xFF == 0xFF
        self._at = self._at & ~0xFF | (self._at + 1) & 0xFF

    def poke(self, address, value):
        """Change a byte of memory behind everybody's back."""
        self.memory[address] = value
        if self.running:
            self._look()

    # The program

    def control(self, value):
        """USER_CTRL was written."""
        if not value & _DMP_EN:
            self.stop()
        elif not self.running or value & 0x08:
            self._look()
            if self.running:
                self._start()

    def _look(self):
        """Does memory hold one of the images?"""
        self.stop()
        r = self.chip._registers
        start = r[_PRGM_START_H] << 8 | r[_PRGM_START_H + 1]
        for file in self.images:
            size = 3062 if len(file) >= 3062 else 1929
            if LAYOUTS[size][0] == start and self._holds(file, size):
                self.layout = size
                self.length = LAYOUTS[size][1]
                self.running = self.dead in (None, "frozen", "zero")

    def _holds(self, file, size):
        wanted = bytearray(file[:size])
        at = size
        while at < len(file):
            n = file[at + 2]
            if n:
                to = file[at] << 8 | file[at + 1]
                if to + n > len(wanted):
                    wanted.extend(bytes(to + n - len(wanted)))
                wanted[to : to + n] = file[at + 3 : at + 3 + n]
            at += 3 + (n or 1)
        found = bytearray(self.memory[: len(wanted)])
        for i in (_DIVIDER, _DIVIDER + 1):
            wanted[i] = found[i] = 0
        return wanted == found

    def _start(self):
        self._count = 0
        self._first = None
        self._noise = 1
        self._q = None  # from the gyro
        self._yaw = None  # taken off the truth

    # Samples

    def sample(self, k):
        """A sample of the chip, row k of the world, its words in chip._words -> a packet, or None."""
        truth = self._truth(k)
        if truth is None:
            self._integrate()
        self._count += 1
        memory = self.memory
        if self._count <= (memory[_DIVIDER] << 8 | memory[_DIVIDER + 1]):
            return None
        self._count = 0
        self.packets += 1
        if self.dead == "zero":
            return bytearray(self.length)
        packet = self._packet(self._q if truth is None else truth)
        if self.dead == "frozen":
            self._first = self._first or packet
            packet = bytearray(self._first)
        return packet

    def _packet(self, q):
        packet = bytearray()
        for value in q:
            # nothing on a chip stands still to the last bit
            self._noise = (self._noise * 1103515245 + 12345) & 0x7FFFFFFF
            _put(
                packet,
                int(value * _UNIT + (0.5 if value > 0 else -0.5)) + (self._noise >> 27) - 8,
                4,
            )
        words = self.chip._words
        if self.layout == 3062:
            for i in (0, 1, 2, 4, 5, 6):
                _put(packet, words[i], 2)
            return packet
        for i in (4, 5, 6):
            _put(packet, words[i] << 16, 4)
        for i in (0, 1, 2):
            _put(packet, words[i] >> 1 << 16, 4)  # 1 g is 8192
        packet.extend(b"\x00\x00")
        return packet

    def _truth(self, k):
        """The world's attitude at row k as floats, with the yaw of the DMP's start taken off; or None."""
        truth = getattr(self.chip.world, "truth", None)
        truth = truth(k) if truth is not None else None
        if truth is None:
            return None
        w, x, y, z = [v / _UNIT for v in truth]
        if self._yaw is None:
            half = math.atan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z) / 2
            self._yaw = math.cos(half), math.sin(half)
        c, s = self._yaw
        return c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w

    def _integrate(self):
        """One step of the gyro's words, and a part of the way to level."""
        words = self.chip._words
        ax, ay, az = words[0], words[1], words[2]
        length = math.sqrt(ax * ax + ay * ay + az * az)
        if self._q is None:
            # level at once: the shortest turn that brings the accelerometer up
            q = (length + az, ay, -ax, 0.0) if length + az > 0 else (0.0, 1.0, 0.0, 0.0)
            self._q = _unit(q)
            return
        w, x, y, z = self._q
        chip = self.chip
        us, samples = chip._period
        if chip._driven():
            samples, us = chip.world.rate[0], chip.world.rate[1] * 1_000_000
        # half the angle of a sample, rad; 82/5 LSB per deg/s
        scale = math.pi / 360 * 5 / 82 * us / samples / 1e6
        gx, gy, gz = words[4] * scale, words[5] * scale, words[6] * scale
        if length:
            ux, uy, uz = 2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z
            gain = _TILT / 2 / length
            gx += (ay * uz - az * uy) * gain
            gy += (az * ux - ax * uz) * gain
            gz += (ax * uy - ay * ux) * gain
        angle = math.sqrt(gx * gx + gy * gy + gz * gz)
        c, s = math.cos(angle), math.sin(angle) / angle if angle else 1.0
        gx, gy, gz = gx * s, gy * s, gz * s
        self._q = _unit(
            (
                w * c - x * gx - y * gy - z * gz,
                w * gx + x * c + y * gz - z * gy,
                w * gy - x * gz + y * c + z * gx,
                w * gz + x * gy - y * gx + z * c,
            )
        )


def _unit(q):
    length = math.sqrt(sum([v * v for v in q]))
    return tuple([v / length for v in q])


def _put(packet, value, n):
    """Append n bytes, big endian."""
    value = min(max(value, -(1 << 31)), (1 << 31) - 1)
    while n:
        n -= 1
        packet.append(value >> (8 * n) & 0xFF)
