# The self-tests of the MPU6050 and of the MPU6500 family; imported when one is run.
# Needs mpu_fifo.py; a driver is handed in. Runs on MicroPython >= 1.22 and under CPython with a `micropython` shim.
# RM is RM-MPU-6000A rev 4.2, AN AN-MPU-9250A-03 rev 1.0, whose test the MPU6500 shares.

import time
from array import array

from upright.mpu_fifo import make_buffer, unpack

_SMPLRT_DIV = 0x19
_CONFIG = 0x1A
_GYRO_CONFIG = 0x1B
_ACCEL_CONFIG = 0x1C
_ACCEL_CONFIG2 = 0x1D
_FIFO_EN = 0x23
_INT_STATUS = 0x3A
_PWR_MGMT_1 = 0x6B
# The head of a buffer, see mpu_fifo.py
_HEAD = 6
_ODD = 2
_STATUS = 5
_ODD_TAKEN = 4
_ALL_AXES = 0xE0  # XG_ST, YG_ST, ZG_ST and XA_ST, YA_ST, ZA_ST
_PRECISION = 16  # trims are in LSB times 2**16


def run(imu):
    """(passed, changes), as Mpu.self_test() returns them, of a configured driver that has stopped FIFO and master."""
    passed, changes = _test_6500(imu) if imu.family_6500 else _test_6050(imu)
    return passed, tuple(changes)


def _test_6050(imu):
    codes = _codes(imu, 0x0D, 4)
    trims = []
    for i in range(3):
        # RM 4.1: five bits, three of them beside the gyro's and two in SELF_TEST_A
        n = codes[i] >> 3 & 0x1C | codes[3] >> (4 - 2 * i) & 3
        # 4096 * 0.34 * (0.92 / 0.34) ** ((n - 1) / 30); (46 / 17) ** (1 / 30) = 1.0337375617
        trims.append(_trim(13926400, 10337375617, 10**10, n) // 10000)
    for i in range(3):
        trim = _trim(25 * 131, 1046, 1000, codes[i] & 0x1F)
        trims.append(-trim if i == 1 else trim)
    # RM 4.1: at +-8 g and +-250 deg/s
    rest, moved, samples = _responses(imu, 0x10, 64)
    changes = _changes(rest, moved, samples, trims)
    known = [change for change in changes if change is not None]
    # PS-MPU-6000A rev 3.4, 6.1 and 6.2: change from factory trim within 14 %
    passed = all(-140 <= change <= 140 for change in known) if known else None
    return passed, changes


def _test_6500(imu):
    # AN 3: (2620 / 2**FS) * 1.01**(code - 1), FS = 0
    trims = [_trim(2620, 101, 100, n) for n in _codes(imu, 0x0D, 3) + _codes(imu, 0x00, 3)]
    # AN 3: at +-2 g and +-250 deg/s, filters of 92 Hz
    rest, moved, samples = _responses(imu, 0x00, 200)
    changes = _changes(rest, moved, samples, trims)
    passed = True
    for i in range(6):
        response = (moved[i] - rest[i]) // samples
        if i < 3:
            # AN 3.1: ratio 0.5 to 1.5; without a trim 225 to 675 mg, at 16384 LSB per g
            good = 3686 <= abs(response) <= 11059
            if changes[i] is not None:
                good = -500 <= changes[i] <= 500
        else:
            # AN 3.1: ratio above 0.5; without a trim 60 deg/s, at 131 LSB per deg/s
            good = abs(response) >= 60 * 131
            if changes[i] is not None:
                good = changes[i] > -500
            # and the offset within 20 deg/s
            good = good and abs(rest[i]) <= 20 * 131 * samples
        passed = passed and good
    return passed, changes


def _codes(imu, register, n):
    codes = bytearray(n)
    for i in range(n):
        codes[i] = imu.read_register(register + i)
    return codes


def _trim(first, num, den, code):
    """first * (num / den)**(code - 1) in LSB times 2**16, 0 for the code 0: no trim."""
    if not code:
        return 0
    return (first * num ** (code - 1) << _PRECISION) // den ** (code - 1)


def _changes(rest, moved, samples, trims):
    """Change of the response from factory trim per axis, rounded to per mille; None without one."""
    changes = []
    for i in range(6):
        trim = samples * trims[i]
        if trim:
            off = ((moved[i] - rest[i]) << _PRECISION) - trim
            changes.append((2000 * off + trim) // (2 * trim))
        else:
            changes.append(None)
    return changes


def _responses(imu, ranges, samples):
    """Sums of `samples` at rest and of as many with the actuators on; ranges: bits of ACCEL_CONFIG."""
    steps = ((_FIFO_EN, 0), (_SMPLRT_DIV, 0), (_CONFIG, 2), (_PWR_MGMT_1, 1))
    for register, value in steps:
        imu.write_register(register, value)
    if imu.family_6500:
        imu.write_register(_ACCEL_CONFIG2, 2)
    rest = _sums(imu, 0, ranges, samples)
    return rest, _sums(imu, _ALL_AXES, ranges, samples), samples


def _sums(imu, actuators, ranges, samples):
    imu.write_register(_GYRO_CONFIG, actuators)
    imu.write_register(_ACCEL_CONFIG, actuators | ranges)
    time.sleep_ms(50)  # the filters (92 Hz) and the proof masses come to rest; AN 3 asks for 20 ms
    sums = [0] * 6
    counts = array("h", bytes(22))
    raw = make_buffer(14)
    burst = memoryview(raw)[_STATUS:]
    for _ in range(samples):
        # a sample a millisecond; a chip that gives none is not waited for without end
        for _ in range(20):
            time.sleep_ms(1)
            imu.registers.read_registers(_INT_STATUS, burst)
            if raw[_STATUS] & 1:
                break
        else:
            raise imu.error_class("no sample in 20 ms during the self-test")
        raw[_STATUS] = 1  # not what else INT_STATUS said
        raw[_ODD] = _ODD_TAKEN
        unpack(raw, _HEAD, counts)
        for i in range(6):
            sums[i] += counts[i]
    return sums
