# Driver of the InvenSense MPU6050 on I2C, and of the parts that are sold under its name.
# Needs an I2C object (machine.I2C or alike) and mpu_common.py. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A rev 3.4.

import time
from array import array

import micropython
from micropython import const
from mpu_common import (  # noqa: F401  the health states are part of this module's face
    HEALTH_BUS_ERROR,
    HEALTH_MISMATCH,
    HEALTH_OK,
    HEALTH_REPAIRING,
    MpuBase,
    unpack,
)

_SELF_TEST_X = const(0x0D)
_SMPLRT_DIV = const(0x19)
_CONFIG = const(0x1A)
_GYRO_CONFIG = const(0x1B)
_ACCEL_CONFIG = const(0x1C)
_FIFO_EN = const(0x23)
_INT_STATUS = const(0x3A)
_USER_CTRL = const(0x6A)
_PWR_MGMT_1 = const(0x6B)
_WHO_AM_I = const(0x75)

_DEVICE_RESET = const(0x80)

# Temperature in hundredths of a degC as (raw * a + b / 2) // b + c
_T_6050 = (5, 17, 3653)  # raw / 340 + 36.53, RM 4.18
_T_6500 = (10000, 33387, 2100)  # raw / 333.87 + 21, RM-MPU-6500A, TEMP_OUT
_T_20689 = (1000, 3268, 2500)  # raw / 326.8 + 25, DS-000143

# WHO_AM_I: name, of the MPU6500 family, bytes of FIFO, temperature.
# The identity decides, not the print on the board: modules sold as "MPU6050" carry any of these.
_PARTS = {
    0x68: ("MPU6050", False, 1024, _T_6050),
    0x70: ("MPU6500", True, 512, _T_6500),
    0x71: ("MPU9250", True, 512, _T_6500),
    0x73: ("MPU9255", True, 512, _T_6500),
    0x74: ("MPU6515", True, 512, _T_6500),
    0x75: ("MPU6500 clone (0x75)", True, 512, _T_6500),
    0x78: ("MPU6880", True, 512, _T_6500),
    0x98: ("ICM-20689", True, 512, _T_20689),
}

_SELF_TEST_LIMIT = const(140)  # per mille, PS 6.1 and 6.2: change from factory trim within 14 %
_SELF_TEST_SAMPLES = const(64)


class MPU6050Error(OSError):
    """The chip is absent, another one, or does not keep what is written to it; at set-up only."""


class MPU6050(MpuBase):
    """An MPU6050 on an I2C bus.

    i2c             has readfrom_mem_into and writeto; give machine.I2C a short timeout, for a stuck
                    bus blocks the tick as long
    address         0x68 with AD0 low, 0x69 with AD0 high
    accept_unknown  take a part whose identity is not in the table for an MPU6050

    Constructing touches no bus. configure() finds, resets and starts the chip; then, in a timer's
    or a pin's interrupt, read() fills counts (ax ay az gx gy gz mx my mz temp flags), health() looks
    after the configuration, and fifo_poll() with fifo_next() take the place of read() in FIFO mode:

        imu = MPU6050(i2c)
        imu.configure(accel_range_g=8, gyro_range_dps=2000, sample_rate_hz=200)

        def tick(timer):
            if imu.read() & 1:
                ...  # a new sample in imu.counts
            imu.health()

    Counters, wrapping at 2**30: errors (bus faults), stale (read() found nothing new), resets (of
    the chip by itself), fifo_overflows, fifo_resets, fifo_lost (packets, as far as they could be
    counted). chip is the part's name, who_am_i its identity.
    """

    _error = MPU6050Error

    def __init__(self, i2c, address=0x68, accept_unknown=False):
        MpuBase.__init__(self)
        self._i2c = i2c
        self._address = address
        self._accept_unknown = accept_unknown
        self._out = bytearray(2)

    # The bus, in the tick too: writeto of a prebuilt buffer, as writeto_mem allocates on several ports

    @micropython.native
    def _read_into(self, register, buffer):
        self._i2c.readfrom_mem_into(self._address, register, buffer)

    @micropython.native
    def _write(self, register, value):
        out = self._out
        out[0] = register
        out[1] = value
        self._i2c.writeto(self._address, out)

    # Set-up

    def _begin(self):
        self._identify()
        for _ in range(3):
            try:
                # a bus master left running would be cut off in mid-transfer by the reset
                self._write(_USER_CTRL, 0)
                self._write(_PWR_MGMT_1, _DEVICE_RESET)
                break
            except OSError:
                # perhaps the chip let go of the bus as it reset: once more is safe
                time.sleep_ms(1)
        time.sleep_ms(100)  # what the register map asks for after DEVICE_RESET
        for _ in range(10):
            try:
                self._read_into(_PWR_MGMT_1, self._one)
                if not self._one[0] & _DEVICE_RESET:
                    break
            except OSError:
                pass
            # late after a slow supply ramp: the family's registers may take another 100 ms
            time.sleep_ms(10)
        else:
            raise MPU6050Error(f"chip at 0x{self._address:02x} did not come out of reset")
        self._identify()

    def _identify(self):
        who = None
        for _ in range(11):
            who = self._who_is_at(self._address)
            if who is not None:
                break
            time.sleep_ms(10)  # just powered up, the chip may take 100 ms to answer
        if who is None:
            raise MPU6050Error(self._absent())
        part = _PARTS.get(who)
        if part is None:
            if not self._accept_unknown:
                known = ", ".join(f"0x{k:02x}" for k in sorted(_PARTS))
                raise MPU6050Error(
                    f"0x{self._address:02x} answers WHO_AM_I (0x75) with 0x{who:02x}; known are "
                    f"{known}. A DS1307 or DS3231 clock has the same address. "
                    "accept_unknown=True uses it as an MPU6050"
                )
            part = (f"unknown (0x{who:02x})", False, 1024, _T_6050)
        self.who_am_i = who
        self.chip, self.family_6500, self.fifo_size, self._temperature = part

    def _who_is_at(self, address):
        try:
            self._i2c.readfrom_mem_into(address, _WHO_AM_I, self._one)
        except OSError:
            return None
        return self._one[0]

    def _absent(self):
        other = 0x69 if self._address == 0x68 else 0x68
        who = self._who_is_at(other)
        if who is None:
            hint = f"none at 0x{other:02x} either. Check supply, SDA, SCL and their pull-ups"
        else:
            hint = f"0x{other:02x} answers, with 0x{who:02x}. AD0 sets the address: low 0x68, high 0x69"
        return f"no MPU6050 at 0x{self._address:02x}; {hint} (WHO_AM_I: no answer to 11 reads in 0.1 s)"

    def self_test(self):
        """Compare how the chip reacts to its self-test actuators with the factory trims.

        To be run at rest; takes 0.4 s. Returns (passed, changes): six ints for accel x y z and gyro
        x y z, the change from factory trim in per mille, or None where the part carries no trim;
        passed is True when all are within 14 % (PS 6.1, 6.2), None when there is no trim at all.

        Done at +-8 g and +-250 deg/s as RM 4.1 asks; afterwards the configuration is as before.
        Raises MPU6050Error for a bus fault, and for parts of the MPU6500 family, whose trims differ.
        """
        self._need_configured()
        if self.family_6500:
            raise MPU6050Error(f"self-test of {self.chip} is not supported by this class")
        trims = self._trims()
        steps = ((_USER_CTRL, 0), (_FIFO_EN, 0), (_SMPLRT_DIV, 0), (_CONFIG, 2), (_PWR_MGMT_1, 1))
        try:
            for register, value in steps:
                self._set_up_write(register, value)
            rest = self._average(0x00)
            moved = self._average(0xE0)
        finally:
            self._apply()
            if self._fifo_on:
                self._dirty = 1
                self._pending = 0
            self._settle()
        changes = []
        passed = None
        for i in range(6):
            if trims[i]:
                # response and trim are in LSB, the trim times 2**16
                trim = _SELF_TEST_SAMPLES * trims[i]
                change = (2000 * (((moved[i] - rest[i]) << 16) - trim) + trim) // (2 * trim)
                changes.append(change)
                passed = passed is not False and -_SELF_TEST_LIMIT <= change <= _SELF_TEST_LIMIT
            else:
                changes.append(None)
        return passed, tuple(changes)

    def _trims(self):
        """Expected responses in LSB times 2**16, 0 where there is no trim (RM 4.1)."""
        codes = bytearray(4)
        self._set_up_read(_SELF_TEST_X, codes)
        trims = []
        for i in range(3):
            n = codes[i] >> 3 & 0x1C | codes[3] >> (4 - 2 * i) & 3
            # 4096 * 0.34 * (0.92 / 0.34) ** ((n - 1) / 30); (46 / 17) ** (1 / 30) = 1.0337375617
            k = max(n - 1, 0)
            trims.append((139264 * 10337375617**k << 16) // (100 * 10 ** (10 * k)) if n else 0)
        for i in range(3):
            n = codes[i] & 0x1F
            k = max(n - 1, 0)
            trim = (25 * 131 * 1046**k << 16) // 1000**k if n else 0
            trims.append(-trim if i == 1 else trim)
        return trims

    def _average(self, actuators):
        """Sums of 64 samples at +-8 g and +-250 deg/s, with the actuators on that the bits name."""
        self._set_up_write(_GYRO_CONFIG, actuators)
        self._set_up_write(_ACCEL_CONFIG, actuators | 0x10)
        time.sleep_ms(50)  # the filter (98 Hz) and the proof masses come to rest
        sums = [0] * 6
        counts = array("h", bytes(22))
        for _ in range(_SELF_TEST_SAMPLES):
            # a sample a millisecond; a chip that gives none is not waited for without end
            for _ in range(20):
                time.sleep_ms(1)
                self._set_up_read(_INT_STATUS, self._raw)
                if self._raw[0] & 1:
                    break
            else:
                raise MPU6050Error("no sample in 20 ms during the self-test")
            unpack(self._raw, 1, counts)
            for i in range(6):
                sums[i] += counts[i]
        return sums
