# What a chip of the MPU family measures: a world's row becomes seven words, with the ranges, the
# temperature scale and the self-test of the part. Part of the chip models; portable (CPython,
# MicroPython). RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A rev 3.4.

from micropython import const

from chips.common import Faults

_SELF_TEST_X = const(0x0D)
_GYRO_CONFIG = const(0x1B)
_ACCEL_CONFIG = const(0x1C)
_PWR_MGMT_1 = const(0x6B)
_PWR_MGMT_2 = const(0x6C)

# LSB per deg/s as a ratio, RM 4.19; LSB per g, RM 4.17
_GYRO_SCALES = ((131, 1), (131, 2), (164, 5), (82, 5))
_ACCEL_LSB = (16384, 8192, 4096, 2048)

GYRO_START_US = 30_000  # PS 6.1, zero-rate output within 1 deg/s of its final value
_GYRO_START_DPS = const(20)  # PS 6.1, initial zero-rate output tolerance
# Where in a world's row (ax ay az gx gy gz mx my mz temp) the words of 0x3B..0x48 stand
_ORDER = (0, 1, 2, 9, 3, 4, 5)
# Factory trims of some chip; those of the MPU6500 within AN-MPU-6500 self-test's limits (225 to 675
# mg, 60 deg/s)
_TRIMS = (16, 14, 18, 15, 17, 13)
_TRIMS_6500 = (98, 104, 91, 128, 131, 125)


def _scaled(value, num, den):
    """value * num / den, rounded half up and saturated like the chip's 16-bit output."""
    value = (2 * value * num + den) // (2 * den)
    return -32768 if value < -32768 else 32767 if value > 32767 else value


class Sensors(Faults):
    """The sensing side of a chip model, which has `_registers`, `_words`, `trims` and its clock."""

    def _some_trims(self):
        return _TRIMS_6500 if self.family_6500 else _TRIMS

    def _factory_values(self):
        """What is burnt in: the self-test trims (RM 4.1; RM-MPU-6500A 4.1, 4.2)."""
        r = self._registers
        for i in range(3):
            accel, gyro = self.trims[i], self.trims[3 + i]
            if self.family_6500:
                r[i] = gyro
                r[_SELF_TEST_X + i] = accel
            else:
                r[_SELF_TEST_X + i] = (accel >> 2) << 5 | gyro
                r[_SELF_TEST_X + 3] |= (accel & 3) << (4 - 2 * i)

    def _measure(self):
        """The seven words (accel x y z, temperature, gyro x y z) of the newest sample."""
        r = self._registers
        world = self.world
        us = self._sample_us
        row = world.row(self._sample_row)
        words = [row[i] for i in _ORDER]
        if not self._driven() and self._period[0] < 1000 * self._period[1]:
            row = world.row(self._row_index(us - (us - self._epoch) % self._accel_us(), 0))
            words[:3] = [row[i] for i in _ORDER[:3]]
        accel = _ACCEL_LSB[r[_ACCEL_CONFIG] >> 3 & 3]
        gyro_num, gyro_den = _GYRO_SCALES[r[_GYRO_CONFIG] >> 3 & 3]
        world_num, world_den = world.gyro_scale
        gyro_num, gyro_den = gyro_num * world_den, gyro_den * world_num
        for i in range(3):
            if accel != world.accel_lsb_per_g:
                words[i] = _scaled(words[i], accel, world.accel_lsb_per_g)
            if gyro_num != gyro_den:
                words[4 + i] = _scaled(words[4 + i], gyro_num, gyro_den)
        self._self_test(words)
        unsettled = self._wake_us + GYRO_START_US - us
        if unsettled > 0:
            num, den = _GYRO_SCALES[r[_GYRO_CONFIG] >> 3 & 3]
            for i in (4, 5, 6):
                offset = _GYRO_START_DPS * num * unsettled // (den * GYRO_START_US)
                words[i] = _scaled(words[i] + offset, 1, 1)
        if self.family_6500:
            # world rows carry the MPU6050's temperature word, raw / 340 + 36.53
            lsb, zero = (32680, 2500) if self._identity == 0x98 else (33387, 2100)
            words[3] = _scaled(100 * words[3] + 340 * (3653 - zero), lsb, 340 * 10_000)
        if world.ended(us):
            # the last row for ever; but a sensor's noise does not end with the recording
            words[3] ^= self._done * 0x9E3779B1 >> 16 & 1
        old = self._words
        standby = r[_PWR_MGMT_2]
        for i in range(3):
            if standby & (0x20 >> i):
                words[i] = old[i]
            if standby & (0x04 >> i):
                words[4 + i] = old[4 + i]
        if r[_PWR_MGMT_1] & 0x08:  # TEMP_DIS
            words[3] = old[3]
        return words

    def _self_test(self, words):
        """Add what the actuated proof masses put out."""
        r = self._registers
        accel, gyro = r[_ACCEL_CONFIG], r[_GYRO_CONFIG]
        for axis in range(3):
            if accel & (0x80 >> axis) and axis not in self.broken:
                moved = words[axis] + self._response(axis, accel >> 3 & 3)
                words[axis] = _scaled(moved, 1, 1)
            if gyro & (0x80 >> axis) and 3 + axis not in self.broken:
                moved = words[4 + axis] + self._response(3 + axis, gyro >> 3 & 3)
                words[4 + axis] = _scaled(moved, 1, 1)

    def _response(self, axis, fs):
        """LSB that self-test adds at the range fs: the factory trim, RM 4.1 (which gives it at
        +-8 g and +-250 deg/s)."""
        n = self.trims[axis]
        if self.family_6500:
            # AN-MPU-6500 self-test, of a code; without one somewhere within the absolute limits
            lsb = 2620 * 1.01 ** (n - 1) if n else 7300 if axis < 3 else 8500
            return int(lsb) >> fs
        if axis < 3:
            response = 4096 * 0.34 * (0.92 / 0.34) ** ((n - 1) / 30) if n else 0.5 * 4096
            return int(response * _ACCEL_LSB[fs] / 4096)
        response = 25 * 131 * 1.046 ** (n - 1) if n else 50 * 131
        num, den = _GYRO_SCALES[fs]
        response = int(response * num / (den * 131))
        return -response if axis == 4 else response
