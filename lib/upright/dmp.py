# The Digital Motion Processor of the InvenSense MPU6050 family: loads an image that the user hands over, reads
# quaternion, accelerometer and gyro from its packets. Needs attitude.py, dmp_image.py, fixmath.py, mpu.py, mpu_fifo.py
# and mpu_monitor.py; a driver is handed in. The image is InvenSense's and not part of this library. Runs on
# MicroPython >= 1.22 and under CPython with a `micropython` shim.

import math
import time
from array import array

import micropython
from micropython import const

from upright import fixmath
from upright.attitude import Attitude
from upright.dmp_image import KNOWN, PROGRAM_START, DmpImage, DmpMemory, MpuDmpError
from upright.mpu import Mpu
from upright.mpu_fifo import Counters, Fifo
from upright.mpu_monitor import HEALTH_OK

_TEMP_OUT_H = const(0x41)
_INT_ENABLE = const(0x38)
_USER_CTRL = const(0x6A)

_DMP_EN = const(0x80)  # USER_CTRL
_FIFO_EN = const(0x40)
_DMP_RESET = const(0x08)
_READY_AND_OVERFLOW = const(0x11)  # INT_ENABLE: DATA_RDY, FIFO_OFLOW

_HEAD = const(6)  # bytes of the FIFO's buffer before the first packet, see mpu_fifo.py
_BASE_HZ = const(200)  # the images are made for this sample rate
_ORDERLY = const(4)  # packets that the start-up check wants to see
_COUNT_MASK = const(0x3FFFFFFF)
_SAME_FRACTION = const(8)  # polls in a row that find the same part of a packet: none is on its way
_HOPELESS = const(16)  # misaligned packets in a row

# Words of `state`
_PROBE = const(0)  # always -1: viper's ptr32 zero-extends on 64-bit ports
_Q = const(1)  # w x y z, body to earth, Q29
_Q30 = const(5)  # the same as the packet has it, chip to earth, Q30
_ACCEL = const(9)  # where in a packet the accelerometer stands, in bytes ...
_GYRO = const(10)
_STEP = const(11)  # ... how far apart two words of them are
_FULL = const(12)  # accelerometer words from this size on are at full scale
_TURNED = const(13)  # 1: the matrix is to be applied
_T = const(14)  # 4 x 4, Q15: from the packet's quaternion to the body's
_STATE_WORDS = const(30)

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


class MpuDmp(Attitude, Counters):
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

    # -- set-up: may wait, allocate and raise

    def __init__(
        self,
        imu,
        image,
        rate_hz=100,
        known=KNOWN,
        accept_unknown=False,
        axes=("x", "y", "z"),
        batch=4,
    ):
        self._divider = _divider(rate_hz)
        self._imu = imu
        self.monitor = imu.monitor
        self.chip = self.who_am_i = None
        self.rate = self.sample_rate = (rate_hz, 1)
        self.gyro_scale = (82, 5)
        self.accel_range_g = 2
        self.gyro_range_dps = 2000
        self.counts = imu.counts
        self.state = self._s = s = array("i", [0] * _STATE_WORDS)
        self._q = memoryview(s)[_Q : _Q + 4]
        s[_PROBE] = -1
        s[_Q] = fixmath.ONE
        s[_Q30] = 1 << 30
        self._mount = _mount(axes)
        s[_TURNED] = 0 if self._mount[0] == 32768 else 1
        self._set_yaw(32768, 0)
        self.image = image = DmpImage(image, known, accept_unknown)
        self.version = image.version
        self.fifo = Fifo(imu.registers, imu.table, imu.monitor, imu.counts)
        self.fifo.packet = self._packet = image.packet
        self.accel_lsb_per_g = image.accel_lsb_per_g
        s[_ACCEL] = image.accel_at
        s[_GYRO] = image.gyro_at
        s[_STEP] = image.step
        s[_FULL] = image.accel_full
        self.fifo.prepare(batch)
        self.remarks = ()
        self.stale = 0
        self.skipped = 0
        self.misaligned = 0
        self.stalls = 0
        self.reloads = 0
        self.needs_reload = False
        self._off = 1  # read() is to leave the FIFO alone ...
        self._loading = 0  # ... and health() the bus
        self._full = 0
        self._fraction = 0  # part of a packet that the last poll left, and how often in a row
        self._fractions = 0
        self._bad = 0  # misaligned packets in a row
        self._silent = 0
        self._resets = 0
        self._seen_ms = 0  # when the FIFO last held a packet, or was emptied
        self._silent_ms = 100 + 5000 // rate_hz

    def configure(self):
        """Set the chip up, load the image, start it, and see that it runs: 0.4 s (I2C at 400 kHz), and 5 packets.

        Raises MpuDmpError for memory that does not keep what is written (it names bank, offset and
        bytes) and for a DMP that does not run, as those of many parts sold as an MPU6050; the driver's
        own error for a chip that is absent or another one.
        """
        self._off = self._loading = 1
        try:
            self._start()
        finally:
            self._loading = 0
        self._silent = self._bad = 0
        self._seen_ms = time.ticks_ms()
        self.needs_reload = False
        self._off = 0

    def reload(self):
        """configure() once more, when needs_reload says that the memory is lost; for the main loop.

        A tick that cuts in finds nothing fresh and leaves the bus alone. Raises like configure(), and
        needs_reload stays True: try again later. Afterwards yaw starts again from 0.
        """
        self.configure()
        self.reloads = (self.reloads + 1) & _COUNT_MASK

    def _start(self):
        imu = self._imu
        imu.configure(accel_range_g=2, gyro_range_dps=2000, sample_rate_hz=_BASE_HZ)
        self.chip, self.who_am_i = imu.chip, imu.who_am_i
        two = bytearray(2)
        # packets have no temperature: it stays as it was now
        imu.registers.read_registers(_TEMP_OUT_H, two)
        self.counts[9] = ((two[0] << 8 | two[1]) ^ 0x8000) - 0x8000
        memory = DmpMemory(imu.registers, self._advice)
        memory.load(self.image, self._divider)
        self.fifo.size = imu.fifo_size
        self._full = imu.fifo_size // self._packet  # packets in a FIFO that overflows next
        start = self.image.program_start
        imu.table.set(_INT_ENABLE, _READY_AND_OVERFLOW)
        memory.write(PROGRAM_START, bytes((start >> 8, start & 0xFF)))
        imu.write_register(_USER_CTRL, imu.table.last() | _DMP_RESET)
        time.sleep_ms(50)  # as the motion driver (mpu_reset_fifo)
        imu.set_user_ctrl(_DMP_EN, _DMP_EN)
        imu.table.change_last(_FIFO_EN, _FIFO_EN)
        imu.monitor.fifo_misaligned = 1
        if not self.fifo.restart():
            raise MpuDmpError("the bus failed while the DMP was started")
        self._resets = imu.resets
        self._set_yaw(32768, 0)
        self._prove()
        if self._s[_TURNED]:
            angles = array("i", [0, 0, 0])
            self.angles(angles)
            half = math.radians(angles[2] / -2000)
            self._set_yaw(round(32768 * math.cos(half)), round(32768 * math.sin(half)))
            _turn(self._s)

    def _prove(self):
        """Wait for good packets; raises MpuDmpError with what is wrong."""
        errors = self._imu.errors
        stale, before = self.stale, None
        good = most = 0
        same = True
        wait_ms = 500 + 12_000 // self.rate[0]
        begun = time.ticks_ms()
        while time.ticks_diff(time.ticks_ms(), begun) < wait_ms and (good < _ORDERLY or same):
            time.sleep_ms(1)
            if self._fetch() & 1:
                good += 1
                packet = bytes(self.fifo.buffer[_HEAD : _HEAD + self._packet])
                same = same and before in (None, packet)
                before = packet
            most = max(most, self.fifo.level)
        self.stale = stale
        if good >= _ORDERLY and not same:
            return
        if good >= _ORDERLY:
            what = "repeats one packet for ever"
        elif good:
            what = "gave %d good packets in %d ms" % (good, wait_ms)
        elif self.misaligned or most:
            what = (
                "gives no packets of %d bytes with a unit quaternion (has the image its features set?)"
                % self._packet
            )
        else:
            what = "gave no packet in %d ms" % wait_ms
        if self._imu.errors != errors:
            what += ", with %d bus errors" % (self._imu.errors - errors)
        raise MpuDmpError("the DMP %s. %s" % (what, self._advice()))

    def _advice(self):
        imu = self._imu
        known = ", whose DMP is known not to work" if imu.who_am_i == 0x98 else ""
        return (
            "The part answers as %s (WHO_AM_I 0x%02x)%s; many that are sold as an MPU6050 have no working "
            "DMP: take a filter in software, mahony6 say" % (imu.chip, imu.who_am_i, known)
        )

    def _set_yaw(self, c, s):
        """T = L(c, 0, 0, s) R(mount), in Q15: q is turned to (yaw q) mount."""
        m0, m1, m2, m3 = self._mount
        rows = ((m0, -m1, -m2, -m3), (m1, m0, m3, -m2), (m2, -m3, m0, m1), (m3, m2, -m1, m0))
        for i in range(4):
            other = rows[3 - i]
            sign = -s if i < 2 else s
            for j in range(4):
                self._s[_T + 4 * i + j] = (c * rows[i][j] + sign * other[j] + 16384) >> 15

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
        level = max(fifo.bytes_waiting(), 0)
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

    def _need_configured(self):
        pass  # the scales are the image's

    def temperature_cdeg(self, counts=None):
        """The temperature at the time of configure() in hundredths of a degC."""
        return self._imu.temperature_cdeg()


def _divider(rate_hz):
    """What the DMP counts up to between two packets."""
    rates = [hz for hz in range(10, _BASE_HZ + 1) if _BASE_HZ % hz == 0]
    if not isinstance(rate_hz, int) or not 10 <= rate_hz <= _BASE_HZ:
        raise ValueError("rate_hz %r is not 10 to %d" % (rate_hz, _BASE_HZ))
    if rate_hz not in rates:
        lower = max([hz for hz in rates if hz < rate_hz])
        upper = min([hz for hz in rates if hz > rate_hz])
        raise ValueError(
            "rate_hz %d does not divide %d; next to it are %d and %d"
            % (rate_hz, _BASE_HZ, lower, upper)
        )
    return _BASE_HZ // rate_hz - 1


def _mount(axes):
    """The quaternion (Q15) that turns the body's vectors into the chip's. Raises ValueError."""
    rows = []
    for name in axes:
        row = [0, 0, 0]
        at = "xyz".find(name[-1:]) if len(name) == 1 or (name[:1] == "-" and len(name) == 2) else -1
        if at >= 0:
            row[at] = -1 if len(name) == 2 else 1
        rows.append(row)
    columns = [sum([abs(row[i]) for row in rows]) for i in range(3)]
    if len(rows) != 3 or columns != [1, 1, 1]:
        raise ValueError("axes %r are not x, y and z once each" % (tuple(axes),))
    (a, b, c), (d, e, f), (g, h, k) = rows
    if a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g) < 0:
        raise ValueError("axes %r mirror: turn one sign, or exchange two axes" % (tuple(axes),))
    trace = a + e + k
    # of the rotation chip to body, 4 q**2; the squares of a signed permutation are 0, 1, 2 or 4
    squares = (1 + trace, 1 + 2 * a - trace, 1 + 2 * e - trace, 1 + 2 * k - trace)
    q = [(0, 16384, 23170, 0, 32768)[n] for n in squares]
    signs = (
        (1, h - f, c - g, d - b),
        (h - f, 1, b + d, c + g),
        (c - g, b + d, 1, f + h),
        (d - b, c + g, f + h, 1),
    )[squares.index(max(squares))]
    q = [-q[i] if signs[i] < 0 else q[i] for i in range(4)]
    return q[0], -q[1], -q[2], -q[3]
