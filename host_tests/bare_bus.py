"""One simulated chip on a bus without a machine around it: whole transfers, at a time that only the test moves."""

from world import StillWorld

ACCEL_XOUT_H = 0x3B
COUNTS = (10, -20, 4096, 5, 6, -7, 0, 0, 0, -521)


class Nack(Exception):
    pass


class Bus:
    """Whole transfers on one chip, at a time that only the test moves."""

    def __init__(self, chip):
        self.chip = chip
        self.now = 0

    def write(self, register, *values):
        self._address(False)
        for byte in (register, *values):
            self._acknowledged(self.chip.i2c_write(byte, self.now))
        self.chip.i2c_stop(self.now)

    def read(self, register, n=1, us_per_byte=0):
        self._address(False)
        self._acknowledged(self.chip.i2c_write(register, self.now))
        self._address(True)
        data = bytearray()
        for _ in range(n):
            data.append(self.chip.i2c_read(self.now))
            self.now += us_per_byte
        self.chip.i2c_stop(self.now)
        return data[0] if n == 1 else bytes(data)

    def words(self):
        data = self.read(ACCEL_XOUT_H, 14)
        return [int.from_bytes(data[i : i + 2], "big", signed=True) for i in range(0, 14, 2)]

    def _address(self, read):
        self._acknowledged(self.chip.i2c_start(read, self.now))

    def _acknowledged(self, ack):
        if not ack:
            self.chip.i2c_stop(self.now)
            raise Nack


class Spi:
    """Whole transactions on one chip, at a time that only the test moves."""

    def __init__(self, chip, hz=1_000_000, mode=0):
        self.chip = chip
        self.now = 0
        self.hz = hz
        self.mode = mode

    def transfer(self, *values, hz=None, mode=None, us_per_byte=0):
        hz, mode = hz or self.hz, self.mode if mode is None else mode
        self.chip.spi_select(True, self.now)
        answer = bytearray()
        for value in values:
            self.now += us_per_byte
            answer.append(self.chip.spi_transfer(value, self.now, hz, mode))
        self.chip.spi_select(False, self.now)
        return bytes(answer)

    def write(self, register, *values, **options):
        self.transfer(register, *values, **options)

    def read(self, register, n=1, **options):
        data = self.transfer(0x80 | register, *bytes(n), **options)[1:]
        return data[0] if n == 1 else data

    def words(self):
        data = self.read(ACCEL_XOUT_H, 14)
        return [int.from_bytes(data[i : i + 2], "big", signed=True) for i in range(0, 14, 2)]


class Ramp(StillWorld):
    """Row k holds k in every word; `clocked` rows at 1 kHz."""

    def __init__(self, n=1 << 20, clocked=True, rate=(1000, 1)):
        super().__init__((), rate, clocked=clocked, n=n)

    def row(self, k):
        self.set([k % 32768] * 10)
        return self._row
