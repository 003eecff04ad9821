# The Digital Motion Processor of the InvenSense MPU6050 family: loads an image that the user hands over, reads
# quaternion, accelerometer and gyro from its packets. Needs dmp_image.py, dmp_setup.py, mpu.py and mpu_monitor.py; a
# driver is handed in. The image is InvenSense's and not part of this library. Runs on MicroPython >= 1.22 and, with a
# stand-in, on CPython.

import time

import micropython
from micropython import const

from upright.dmp_image import MpuDmpError
from upright.dmp_setup import MpuDmpSetup
from upright.mpu import Mpu
from upright.mpu_monitor import HEALTH_OK

_DMP_EN = const(0x80)  # USER_CTRL
_FIFO_EN = const(0x40)
_HEAD = const(2)  # bytes of the FIFO's buffer before the first packet
_COUNT_MASK = const(0x3FFFFFFF)
_SAME_FRACTION = const(8)  # polls in a row that find the same part of a packet: none is on its way
_HOPELESS = const(16)  # misaligned packets in a row

# Words of `state`, see dmp_setup.py
_PROBE = const(0)
_Q = const(1)
_Q30 = const(5)
_ACCEL = const(9)
_GYRO = const(10)
_STEP = const(11)
_FULL = const(12)
_TURNED = const(13)
_T = const(14)

_UNIT = const(1 << 26)  # squared length of a unit quaternion with its words in Q13
_LENGTH_TOLERANCE = const(1 << 20)  # 1/64 of it: 40 times what the rounding to Q13 can do


# ------------------------------------------------------------------------------------------ tick
@micropython.viper
def _parse(raw: ptr8, at: int, s: ptr32, counts: ptr16) -> int:
    """A packet at raw[at] into state and counts -> flags; -1 and nothing changed if its quaternion is none.

    The length is judged with 13 bits a word, so that four squares stay below 2**31 whatever the bytes are.
    """
    n = 0
    i = 0
    while i < 16:
        h = ((raw[at + i] << 8 | raw[at + i + 1]) ^ 0x8000) - 0x8000
        h = (h + 1) >> 1
        n += h * h
        i += 4
    n -= _UNIT
    if n > _LENGTH_TOLERANCE or n < 0 - _LENGTH_TOLERANCE:
        return -1
    i = 0
    while i < 4:
        j = at + (i << 2)
        h = ((raw[j] << 8 | raw[j + 1]) ^ 0x8000) - 0x8000
        low = raw[j + 2] << 8 | raw[j + 3]
        s[_Q30 + i] = (h << 16) + low
        s[_Q + i] = (h << 15) + ((low + 1) >> 1)
        i += 1
    flags = 1
    full = s[_FULL]
    step = s[_STEP]
    j = at + s[_ACCEL]
    i = 0
    while i < 6:
        if i == 3:
            j = at + s[_GYRO]
            full = 0x7FFF
        h = ((raw[j] << 8 | raw[j + 1]) ^ 0x8000) - 0x8000
        counts[i] = h
        if h >= full or h < 0 - full:
            flags |= 4 if i < 3 else 8
        j += step
        i += 1
    counts[10] = flags
    return flags


@micropython.viper
def _turn(s: ptr32):
    """Q = T Q30, 15 bits of the quaternion at a time: each row of T is of length 1 (Q15), the quaternion too, and so
    the sums of the high parts (14 bits) stay below 0.51 * 2**30, those of the low parts (15 bits) below 1.01 * 2**30.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    i = 0
    while i < 4:
        high = 0
        low = 0
        j = 0
        while j < 4:
            q = (s[_Q30 + j] << k >> k) >> 1
            h = (q + 16384) >> 15
            t = s[_T + (i << 2) + j] << k >> k
            high += h * t
            low += (q - (h << 15)) * t
            j += 1
        s[_Q + i] = high + ((low + 16384) >> 15)
        i += 1


@micropython.viper
def _copy(s: ptr32, at: int, out: ptr32):
    """Four words; bytecode could not without allocating: 1.0 in Q30 is no small int of a 32-bit port."""
    i = 0
    while i < 4:
        out[i] = s[at + i]
        i += 1


class MpuDmp(MpuDmpSetup):
    """The DMP of an MPU6050 or of the MPU6500 family: sensor and attitude filter in one.

    imu             the driver's object, an MPU6050, MPU6500 or MPU6500_I2C; its own read() and fifo_...()
                    are not to be used besides, nor anything attached to it
    image           the file that the user has: a path, an open binary file or bytes; see below
    rate_hz         packets per second: 10, 20, 25, 40, 50, 100 or 200
    known           SHA-256 of the files that are taken, as hex strings
    accept_unknown  take a file with another SHA-256
    axes            which axis of the chip the body's x, y and z are, "-y" for the other way round, as in
                    board.py's IMU_AXES: for the quaternion only, counts stay in the chip's frame
    batch           packets that one read() fetches at most

    The file is an image of 3062 bytes (v6.12) or 1929 (v2.0), as it is when its features are set: the
    6-axis quaternion, accelerometer and gyro are sent. Where they are not, what the vendor's software
    writes over the image follows it in the file: records of bank, offset, length and `length` bytes, as
    MotionApps 2.0 has them (a length of 0 and one byte more is its "special" record, and skipped). So
    what of an image is the vendor's comes from the user's file; the divider of the rate alone is
    written by this class. Whether the gyro in the packets is calibrated or raw is up to the image.

    Constructing reads the file but touches no bus; raises MpuDmpError for a file that is not as said,
    ValueError for a rate or an axis map that cannot be. configure() sets the chip up (+-2 g, +-2000
    deg/s, 200 Hz), loads the image, reads it back and waits until good packets come. Then in the tick,
    as with the driver alone:

        dmp = MpuDmp(MPU6050(i2c), "dmp.bin", rate_hz=100)
        dmp.configure()

        def tick(timer):
            if dmp.read() & 1:
                dmp.angles(out)
            dmp.health()

    A supply dip wipes the DMP's memory. health() finds out; needs_reload is True then and read() has
    nothing fresh until the main loop has called reload(). The tick never loads anything.

    As a filter it has what mahony.Mahony6 has. update() has nothing to do, seed() returns False: the
    DMP finds its attitude by itself. Yaw is 0 at the start of the DMP; with axes other than x, y, z it
    is 0 at the end of configure().

    Counters, wrapping at 2**30: the driver's errors, resets, fifo_overflows, fifo_resets, fifo_lost; stale
    (read() found no packet), skipped (packets that a newer one in the same batch has replaced),
    misaligned (packets that were none: the FIFO was restarted), stalls (the DMP fell silent), reloads.
    """

    NAME = "dmp6"
    AXES = 6
    error_class = MpuDmpError

    # -- the tick: nothing below allocates, waits, raises or uses a float

    @micropython.native
    def read(self):
        """Fetch what the FIFO has, the newest packet into counts and state; returns its flags (bit 0: fresh).

        At most `batch` packets in one call: after a pause several calls catch up. The words are the chip's, in
        LSB of accel_lsb_per_g and gyro_scale; the temperature (word 9) is that of configure().
        """
        if self._off:
            self.stale = (self.stale + 1) & _COUNT_MASK
            return self.monitor.not_fresh()
        return self._fetch()

    def health(self):
        """The driver's health(), one register a call; and has the DMP fallen silent, or lost its memory?

        Returns a HEALTH_ state of mpu_monitor. Sets needs_reload.
        """
        if self._loading:
            return HEALTH_OK
        imu = self._imu
        state = imu.health()
        if imu.resets != self._resets:
            self._resets = imu.resets
            # the repair that has begun is not to start a program that is gone
            imu.table.change_last(0, _DMP_EN | _FIFO_EN)
            self._lost()
        elif self._silent and not self._off:
            self.stalls = (self.stalls + 1) & _COUNT_MASK
            self._lost()
        return state

    def _turn(self):
        _turn(self._s)

    def _lost(self):
        self._off = 1
        self._silent = 0
        self.needs_reload = True

    @micropython.native
    def _fetch(self):
        fifo = self.fifo
        monitor = self.monitor
        if monitor.fifo_misaligned:
            fifo.restart()
            self._seen_ms = time.ticks_ms()
            return monitor.not_fresh()
        level = fifo.bytes_waiting()
        n = level // self._packet
        fifo.level = n
        if not n:
            return self._none()
        self._seen_ms = time.ticks_ms()
        level -= n * self._packet
        if level and n < self._full:
            return self._partial(level)
        self._fractions = 0
        if n > fifo.batch:
            n = fifo.batch
        if not fifo.drain(n, level):
            return monitor.not_fresh()
        fifo.take_all()
        flags = _parse(fifo.buffer, _HEAD + (n - 1) * self._packet, self._s, self.counts)
        if flags < 0:
            fifo.lose(n)
            self._bad += 1
            if self._bad > _HOPELESS:
                self._silent = 1
            return self._misaligned()
        self._bad = 0
        if self._s[_TURNED]:
            _turn(self._s)
        self.skipped = (self.skipped + n - 1) & _COUNT_MASK
        return flags

    def _none(self):
        self.stale = (self.stale + 1) & _COUNT_MASK
        self.monitor.doubt()
        if time.ticks_diff(time.ticks_ms(), self._seen_ms) > self._silent_ms:
            self._silent = 1
        return self.monitor.not_fresh()

    def _partial(self, fraction):
        """Part of a packet is left: one that is being written, or the first has lost its beginning. Wait for the next
        call; if it is always the same part, restart. The packets themselves would not tell: at rest and level z of the
        accelerometer reads as a quaternion's 1.0."""
        if fraction != self._fraction:
            self._fraction = fraction
            self._fractions = 0
        self._fractions += 1
        if self._fractions < _SAME_FRACTION:
            return self.monitor.not_fresh()
        self._fractions = 0
        return self._misaligned()

    def _misaligned(self):
        self.misaligned = (self.misaligned + 1) & _COUNT_MASK
        self.monitor.fifo_misaligned = 1  # the next call restarts the FIFO
        return self.monitor.not_fresh()

    # -- as a filter

    def update(self, counts):
        """Nothing to do: read() has brought the attitude with the sample."""

    def q30(self, out):
        """Copy the quaternion as the packet has it to out[0..3], an array('i'): w x y z in Q30, chip to earth."""
        _copy(self._s, _Q30, out)

    def seed(self, counts):
        """False: the DMP finds its attitude by itself."""
        return False

    def set_quaternion(self, w, x, y, z):
        """Raises ValueError: the DMP's attitude cannot be set."""
        raise ValueError("the DMP keeps its own attitude: it cannot be set")

    def set_bias(self, x, y, z, known_s=0):
        """Raises ValueError unless all are 0: the image itself removes the bias, after some seconds at rest."""
        if x or y or z:
            raise ValueError("bias is %r: the DMP removes the gyro's bias itself" % ((x, y, z),))

    def bias(self, out):
        """out[0..2] = 0: see set_bias."""
        for i in range(3):
            out[i] = 0

    bias_mdps = bias

    # floats, for programs
    accel = Mpu.accel
    gyro = Mpu.gyro
    temperature = Mpu.temperature

    def temperature_cdeg(self):
        """The temperature at the time of configure() in hundredths of a degC."""
        return self._imu.temperature_cdeg()
