# DMP images of the InvenSense MPU6050 family: as files (which there are, what they are to hold, how they are read), and
# in the chip's memory. The images are InvenSense's and not part of this library. Needs nothing; runs on
# MicroPython >= 1.22 and on hosts.

import io
from binascii import hexlify

try:
    from hashlib import sha256
except ImportError:  # a port built without it: every image is unknown there
    sha256 = None

# Registers, by their names in InvenSense's motion driver 6.12 (inv_mpu.c); not in RM-MPU-6000A
_BANK_SEL = 0x6D  # MEM_START_ADDR 0x6E follows: one write of two bytes sets both
_MEM_R_W = 0x6F
PROGRAM_START = 0x70  # PRGM_START_H: DMP_CFG_1, DMP_CFG_2

CHUNK = 16
BANK = 256
BANKS = 12
DIVIDER = 0x0216  # D_0_22: a packet every 1 + this word samples, big endian, in both images

# size in bytes: name, program start, bytes of a packet, places of accelerometer and gyro in it, step between their
# words, LSB per g, size of a word at full scale. Sources: InvenSense's motion driver 6.12 (DMP_CODE_SIZE,
# dmp_load_motion_driver_firmware, dmp_read_fifo); i2cdevlib's MPU6050_6Axis_MotionApps612 and _MotionApps20.
LAYOUTS = {
    3062: ("v6.12", 0x0400, 28, 16, 22, 2, 16384, 32767),
    1929: ("v2.0", 0x0300, 42, 28, 16, 4, 8192, 16383),
}

# SHA-256 of whole files that are known, as `sha256sum` shows it; tools/upright_host/dmp.py says what they are
KNOWN = (
    "ae42d0be801847e53e77a96ca74961d3063a21f1c0006c556b13d0e305a3c1ec",
    "e3ed21163e3933b523caeeac08ebc7fffe3101a7d40ce4273e4c12e9fa5d61e3",
    "9d24f84aad5bb3eb52b768fa0ad5e43a76da43a4aba1140084462976e8904e21",
    "205e36b31bbc864a39d4961d59318182f485cee5704c9c11264bf31314c27cb7",
    "e67e0b259586d38e2a2b5e5a9a79e80e377761d366c719977c105329164b327c",
    "15a4222864928954aff8f569eb1adc6f8f74f582c34467e0346deafb273e5064",
    "0478b3f4fca6fca39a4fe8b8e98b3917408bb4f0345f21177f9db40aff87cc84",
)


class MpuDmpError(OSError):
    """The image is not one that is known, or the DMP does not take or run it; at set-up only."""


class DmpImage:
    """A file with an image and perhaps a list behind it: examined, and then read in pieces of 16 bytes.

    source          a path, an open binary file or bytes
    known           SHA-256 of the files that are taken, as hex strings
    accept_unknown  take a file with another SHA-256

    Raises MpuDmpError when it cannot be read, is of another size, has something else behind the image
    than a list, or is not known. Afterwards: image_size, size (of the file), sha256; version, program_start, packet
    (bytes), accel_at, gyro_at, step, accel_lsb_per_g, accel_full (of the packet).
    """

    def __init__(self, source, known=KNOWN, accept_unknown=False):
        self._source = source
        file = self._open()
        try:
            self.size = size = file.seek(0, 2)
            sizes = [n for n in sorted(LAYOUTS) if n <= size]
            if not sizes:
                raise MpuDmpError(
                    "a DMP image has 3062 bytes (v6.12) or 1929 (v2.0), this file %d" % size
                )
            self.image_size = sizes[-1]
            try:
                for _ in self._records(file):
                    pass
            except ValueError as why:
                raise MpuDmpError(
                    "%d bytes are no DMP image (3062 or 1929) with a list behind it: %s"
                    % (size, why)
                )
            self.sha256 = _hash(file)
        finally:
            self._close(file)
        if not accept_unknown and self.sha256 not in known:
            raise MpuDmpError(
                "this DMP image is not known: SHA-256 %s. If it is the one that you want, name that in "
                "known, or say accept_unknown=True" % self.sha256
            )
        layout = LAYOUTS[self.image_size]
        self.version, self.program_start, self.packet, self.accel_at, self.gyro_at = layout[:5]
        self.step, self.accel_lsb_per_g, self.accel_full = layout[5:]

    def pieces(self):
        """(address, bytes) of the image, none across a bank."""
        file = self._open()
        try:
            file.seek(0)
            for address in range(0, self.image_size, CHUNK):
                yield address, file.read(min(CHUNK, self.image_size - address))
        finally:
            self._close(file)

    def patches(self):
        """(address, bytes) of the list behind the image, none across a bank."""
        file = self._open()
        try:
            for address, data in self._records(file):
                for at in range(0, len(data), CHUNK):
                    yield address + at, data[at : at + CHUNK]
        finally:
            self._close(file)

    def _records(self, file):
        file.seek(self.image_size)
        while True:
            head = file.read(3)
            if not head:
                return
            n = head[2] if len(head) == 3 else 0
            data = file.read(n or 1)
            if len(head) < 3 or len(data) < (n or 1):
                raise ValueError("it ends within a record")
            bank, at = head[0], head[1]
            if bank >= BANKS or at + n > BANK:
                raise ValueError("a record of bank %d, 0x%02x, %d bytes" % (bank, at, n))
            if n:
                yield bank << 8 | at, data

    def _open(self):
        source = self._source
        if isinstance(source, (bytes, bytearray, memoryview)):
            return io.BytesIO(source)
        if not isinstance(source, str):
            return source
        try:
            return open(source, "rb")
        except OSError as why:
            raise MpuDmpError("the DMP image %s cannot be read: %s" % (source, why))

    def _close(self, file):
        if isinstance(self._source, str):
            file.close()


class DmpMemory:
    """The DMP's memory and program start, written through a driver's registers; `advice()` ends a message."""

    def __init__(self, registers, advice):
        self._registers = registers
        self._advice = advice

    def load(self, image, divider):
        """The image, read back as a whole: memory that is smaller than it claims gives itself away. Then what follows
        it in the file, and the divider."""
        for address, data in image.pieces():
            self._put(address, data)
        for address, data in image.pieces():
            self._verify(address, data)
        for address, data in image.patches():
            self._put(address, data)
            self._verify(address, data)
        data = bytes((0, divider))
        self._put(DIVIDER, data)
        self._verify(DIVIDER, data)

    def write(self, register, data):
        """A burst; raises MpuDmpError."""
        try:
            self._registers.write_from(bytes((register,)) + data)
            return
        except OSError as e:
            fault = e
        raise MpuDmpError("bus error (%s) while writing register 0x%02x" % (fault, register))

    def _point(self, address):
        self.write(_BANK_SEL, bytes(_at(address)))

    def _put(self, address, data):
        try:
            self._point(address)
            self.write(_MEM_R_W, data)
        except MpuDmpError as e:
            raise MpuDmpError("loading the DMP's bank %d at 0x%02x: %s" % (_at(address) + (e,)))

    def _verify(self, address, data):
        found = bytearray(len(data))
        try:
            self._point(address)
            self._registers.read_into(_MEM_R_W, found)
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


def _at(address):
    return address >> 8, address & 0xFF


def _hash(file):
    if sha256 is None:
        return "unknown (no sha256 on this port)"
    h = sha256()
    file.seek(0)
    while True:
        data = file.read(64)
        if not data:
            return hexlify(h.digest()).decode()
        h.update(data)
