# The set-up half of the DMP's driver: loading an image, starting it, judging whether it runs.
# Needs attitude.py, dmp_image.py, fixmath.py and mpu_fifo.py; a driver is handed in. Runs on
# MicroPython >= 1.22 and under CPython with a `micropython` shim.

import math
import time
from array import array

from micropython import const

from upright import fixmath
from upright.attitude import Attitude
from upright.dmp_image import DIVIDER, KNOWN, DmpImage, MpuDmpError
from upright.mpu_fifo import Counters, Fifo

# Registers, by their names in InvenSense's motion driver 6.12 (inv_mpu.c); not in RM-MPU-6000A
_BANK_SEL = const(0x6D)  # MEM_START_ADDR 0x6E follows: one write of two bytes sets both
_MEM_R_W = const(0x6F)
_PRGM_START_H = const(0x70)  # DMP_CFG_1, DMP_CFG_2
_TEMP_OUT_H = const(0x41)
_INT_ENABLE = const(0x38)
_USER_CTRL = const(0x6A)

_DMP_EN = const(0x80)  # USER_CTRL
_FIFO_EN = const(0x40)
_DMP_RESET = const(0x08)
_READY_AND_OVERFLOW = const(0x11)  # INT_ENABLE: DATA_RDY, FIFO_OFLOW

_HEAD = const(2)  # bytes of the FIFO's buffer before the first packet
_BASE_HZ = const(200)  # the images are made for this sample rate
_ORDERLY = const(4)  # packets that the start-up check wants to see
_COUNT_MASK = const(0x3FFFFFFF)

# Words of `state`; dmp.py uses the same
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


class MpuDmpSetup(Attitude, Counters):
    """What may wait, allocate and raise; dmp.MpuDmp adds what the tick calls."""

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
        self._load()
        self.fifo.size = imu.fifo_size
        self._full = imu.fifo_size // self._packet  # packets in a FIFO that overflows next
        start = self.image.program_start
        imu.table.set(_INT_ENABLE, _READY_AND_OVERFLOW)
        self._write(_PRGM_START_H, bytes((start >> 8, start & 0xFF)))
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
            self._turn()

    def _load(self):
        """The image, read back as a whole: memory that is smaller than it claims gives itself away. Then what follows
        it in the file, and the divider."""
        for address, data in self.image.pieces():
            self._write_memory(address, data)
        for address, data in self.image.pieces():
            self._verify_memory(address, data)
        for address, data in self.image.patches():
            self._write_memory(address, data)
            self._verify_memory(address, data)
        divider = bytes((0, self._divider))
        self._write_memory(DIVIDER, divider)
        self._verify_memory(DIVIDER, divider)

    def _write(self, register, data):
        """A burst; raises MpuDmpError."""
        try:
            self._imu.registers.write_from(bytes((register,)) + data)
            return
        except OSError as e:
            fault = e
        raise MpuDmpError("bus error (%s) while writing register 0x%02x" % (fault, register))

    def _point(self, address):
        self._write(_BANK_SEL, bytes((address >> 8, address & 0xFF)))

    def _write_memory(self, address, data):
        try:
            self._point(address)
            self._write(_MEM_R_W, data)
        except MpuDmpError as e:
            raise MpuDmpError("loading the DMP's bank %d at 0x%02x: %s" % (_at(address) + (e,)))

    def _verify_memory(self, address, data):
        found = bytearray(len(data))
        try:
            self._point(address)
            self._imu.registers.read_into(_MEM_R_W, found)
        except OSError as e:
            raise MpuDmpError(
                "reading back the DMP's bank %d at 0x%02x: %s" % (_at(address) + (e,))
            )
        for i in range(len(data)):
            if found[i] != data[i]:
                raise MpuDmpError(
                    "the DMP's memory, bank %d at 0x%02x: wrote 0x%02x, read 0x%02x. %s"
                    % (_at(address + i) + (data[i], found[i], self._advice()))
                )

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


def _at(address):
    return address >> 8, address & 0xFF


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
