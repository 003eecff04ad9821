# The Digital Motion Processor of a simulated MPU: memory in banks, and packets from the world's motion.
# Part of the chip models; portable (CPython, MicroPython). It runs no program: it compares its memory with images
# that a test hands over, and does what these are known to do. Integers, so that its packets are the same bits on ports
# whose floats have 32 bits.

from micropython import const

_BANK_SEL = const(0x6D)
_PRGM_START_H = const(0x70)

_DMP_EN = const(0x80)  # USER_CTRL
_DIVIDER = const(0x216)  # D_0_22 of both images, 16 bits: a packet every 1 + this samples
_TILT = 50  # one part in so many of the tilt error goes in a step where the world does not know the truth
_Q = const(40)  # the attitude: 1.0 is 1 << _Q
_PI = 3454217652358  # Q40

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
            rounded = (value + (1 << _Q - 31)) >> _Q - 30  # Q30
            _put(packet, rounded + (self._noise >> 27) - 8, 4)
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
        """The world's attitude at row k, with the yaw of the DMP's start taken off; or None."""
        truth = getattr(self.chip.world, "truth", None)
        truth = truth(k) if truth is not None else None
        if truth is None:
            return None
        w, x, y, z = [v << _Q - 30 for v in truth]
        if self._yaw is None:
            self._yaw = _half_turn(w * w + x * x - y * y - z * z, 2 * (x * y + w * z))
        c, s = self._yaw
        q = c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w
        return [v >> _Q for v in q]

    def _integrate(self):
        """One step of the gyro's words, and a part of the way to level."""
        words = self.chip._words
        ax, ay, az = words[0], words[1], words[2]
        length = _root(ax * ax + ay * ay + az * az << 16)  # Q8
        if self._q is None:
            # level at once: the shortest turn that brings the accelerometer up
            up = length + (az << 8)
            self._q = _unit((up, ay << 8, -(ax << 8), 0) if up > 0 else (0, 1, 0, 0))
            return
        w, x, y, z = self._q
        chip = self.chip
        us, samples = chip._period
        if chip._driven():
            samples, us = chip.world.rate[0], chip.world.rate[1] * 1000000
        # half the angle of a sample, rad; 82/5 LSB per deg/s
        num, den = _PI * 5 * us, 360 * 82 * 1000000 * samples
        g = [words[i] * num // den for i in (4, 5, 6)]
        if length:
            ux, uy, uz = 2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z
            error = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
            # a unit of the accelerometer's counts is 1 << 8 of its length
            g = [v + ((e >> _Q - 8) // (2 * _TILT * length)) for v, e in zip(g, error)]
        square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2] >> _Q
        c, s = _series(square, 1), _series(square, 2)
        gx, gy, gz = [v * s >> _Q for v in g]
        self._q = _unit(
            (
                w * c - x * gx - y * gy - z * gz,
                w * gx + x * c + y * gz - z * gy,
                w * gy - x * gz + y * c + z * gx,
                w * gz + x * gy - y * gx + z * c,
            )
        )


def _series(square, n):
    """cos(a) with n 1, sin(a) / a with n 2, of a's square; all Q40."""
    total = term = 1 << _Q
    while term:
        term = -(term * square >> _Q) // (n * (n + 1))
        total += term
        n += 2
    return total


def _half_turn(x, y):
    """(cos, sin) in Q40 of half the angle from the x axis to (x, y)."""
    length = _root(x * x + y * y)
    half = (length + x, y) if x >= 0 else (abs(y), length - x if y >= 0 else x - length)
    size = _root(half[0] * half[0] + half[1] * half[1])
    return [(v << _Q) // size for v in half] if size else (1 << _Q, 0)


def _unit(q):
    """Scaled to length 1, Q40."""
    length = _root(sum([v * v for v in q]) << 2 * _Q)
    return [(v << 2 * _Q) // length for v in q]


def _root(value):
    """The square root, rounded down (Newton's)."""
    if value < 2:
        return value
    root = 1
    while root * root < value:
        root <<= 1
    while True:
        better = root + value // root >> 1
        if better >= root:
            return root
        root = better


def _put(packet, value, n):
    """Append n bytes, big endian."""
    value = min(max(value, -(1 << 31)), (1 << 31) - 1)
    while n:
        n -= 1
        packet.append(value >> (8 * n) & 0xFF)
