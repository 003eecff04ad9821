# A simulated MPU6500 on SPI (or I2C): an MPU6050 with another interface, filters, offsets and rules.
# Needs a world to sample (world.py) and a bus that calls it byte by byte; knows no machine mock.
# Portable: CPython and the MicroPython unix port. RM is RM-MPU-6500A rev 2.1, PS PS-MPU-6500A rev 1.3.

from micropython import const

from chips.mpu6050 import MPU6050Chip

_SMPLRT_DIV = const(0x19)
_CONFIG = const(0x1A)
_GYRO_CONFIG = const(0x1B)
_ACCEL_CONFIG = const(0x1C)
_ACCEL_CONFIG2 = const(0x1D)
_INT_PIN_CFG = const(0x37)
_INT_STATUS = const(0x3A)
_ACCEL_XOUT_H = const(0x3B)
_EXT_SENS_DATA_23 = const(0x60)
_SIGNAL_PATH_RESET = const(0x68)
_PWR_MGMT_1 = const(0x6B)
_FIFO_R_W = const(0x74)
_XA_OFFSET_H = const(0x77)

_SLOW_HZ = const(1_000_000)  # PS 6.1: every register
_FAST_HZ = const(20_000_000)  # PS 2.3: only to read the sensor and interrupt registers
_UNDECIDED = const(32)  # SPI transactions after which somebody should have set I2C_IF_DIS

# What becomes of an SPI transaction
_ADDRESS, _READ, _WRITE, _STREAM, _DEAF, _GARBAGE = 0, 1, 2, 3, 4, 5


class MPU6500Chip(MPU6050Chip):
    """One chip on an SPI bus: spi_select and spi_transfer; or on I2C, as MPU6050Chip.

    accel_offsets   factory values of the accelerometer offset registers x y z, 15 bits (RM, registers 119 to 126)

    With who_am_i 0x68 it is an MPU6000, an MPU6050 on SPI. The other arguments are MPU6050Chip's. On SPI:
    - mode 0 or 3 (PS 6.5); in any other it neither understands nor is understood
    - an address byte, bit 7 = read, then data; a burst steps through the registers
    - 1 MHz at most, but 20 MHz to read 0x3A (INT_STATUS) to 0x60 (the sensors and EXT_SENS_DATA);
      faster, writes are lost and what is read is garbage. The FIFO is not one of these registers
    - where it does not drive the line the master reads 0xFF
    - nack_next(n): the next n transactions find no answer
    Each of these is noted in misuse, if it is the driver's fault.
    """

    def __init__(
        self, world, who_am_i=0x70, address=0x68, accel_offsets=(6144, -5120, 9216), **options
    ):
        self.accel_offsets = accel_offsets
        self._spi = False  # the access under way comes over SPI
        self._phase = _DEAF
        MPU6050Chip.__init__(self, world, address=address, who_am_i=who_am_i, **options)

    _rate_registers = (_SMPLRT_DIV, _CONFIG, _GYRO_CONFIG)

    def _power_ups(self):
        self._undecided = 0  # SPI transactions since the reset without I2C_IF_DIS
        self._spi_only = False
        self._paths_due = False  # a DEVICE_RESET over SPI waits for its SIGNAL_PATH_RESET

    def _factory_values(self):
        MPU6050Chip._factory_values(self)
        self._power_ups()
        for i in range(3 if self.family_6500 else 0):
            value = self.accel_offsets[i] << 1
            self._registers[_XA_OFFSET_H + 3 * i] = value >> 8 & 0xFF
            self._registers[_XA_OFFSET_H + 3 * i + 1] = value & 0xFF

    # Rates and sensors

    def _rate(self):
        r = self._registers
        if (
            r[_GYRO_CONFIG] & 3
        ):  # RM, registers 26 and 27: FCHOICE_B other than 0 bypasses the filter
            return 32000, 1
        return MPU6050Chip._rate(self)

    def _accel_us(self):
        # RM, register 29: 4 kHz with ACCEL_FCHOICE_B, which bypasses the accelerometer's own filter
        return 250 if self._registers[_ACCEL_CONFIG2] & 0x08 else 1000

    def _measure(self):
        words = MPU6050Chip._measure(self)
        r = self._registers
        for i in range(3 if self.family_6500 else 0):
            at = _XA_OFFSET_H + 3 * i
            offset = (r[at] << 8 | r[at + 1]) >> 1
            change = ((offset - self.accel_offsets[i] + 0x4000) & 0x7FFF) - 0x4000
            if change:
                # RM, registers 119 to 126: 0.98 mg a step, whatever the range
                lsb = 16384 >> (r[_ACCEL_CONFIG] >> 3 & 3)
                value = words[i] + change * 98 * lsb // 100_000
                words[i] = -32768 if value < -32768 else 32767 if value > 32767 else value
        return words

    # Registers

    def _get(self, register):
        if self._spi and (register == _FIFO_R_W or _ACCEL_XOUT_H <= register <= 0x48):
            self._sampled()
        return MPU6050Chip._get(self, register)

    def _set(self, register, value):
        if register == _PWR_MGMT_1 and value & 0x80:
            MPU6050Chip._set(self, register, value)
            self._paths_due = self._spi
            return
        if register == _SIGNAL_PATH_RESET and value & 7 == 7:
            self._paths_due = False
        MPU6050Chip._set(self, register, value)

    def _sampled(self):
        if self._paths_due:
            # RM, register 107, and RM-MPU-6000A 4.26: over SPI the sensors' paths want a reset of their own
            self._misused("sampling without SIGNAL_PATH_RESET after a DEVICE_RESET over SPI")
            self._paths_due = False

    def _i2c_if_dis(self, bit):
        if not self._spi:
            MPU6050Chip._i2c_if_dis(self, bit)
            return
        self._spi_only = bool(bit)

    def _user_ctrl(self, value):
        # RM, register 106: I2C_IF_DIS clears itself (and is in force all the same); the MPU6000's stays (RM-6000 4.27)
        value = MPU6050Chip._user_ctrl(self, value)
        return value & ~0x10 if self.family_6500 else value

    # SPI

    def spi_select(self, selected, now):
        """An edge of chip select."""
        self._phase = _DEAF
        self.poll(now)
        self._busy = False
        if not selected or self._gone or self._now < self._dead_until or self._refused():
            return
        self._shadow()
        self._busy = True
        self._phase = _ADDRESS
        if not self._spi_only:
            self._undecided += 1
            if self._undecided == _UNDECIDED:
                # PS 6.1: other traffic on the bus may switch it over to I2C
                self._misused("SPI in use without I2C_IF_DIS")

    def spi_transfer(self, byte, now, hz, mode):
        """One byte each way; hz: clock frequency, mode: 0..3 -> what the chip sends."""
        if self._phase == _STREAM and self._plain:
            # the bulk of all traffic, taken straight: the sensor registers
            at = self._pointer
            if at <= _EXT_SENS_DATA_23:
                self._pointer = at + 1
                return self._registers[at]
        if self._phase == _STREAM:
            self._phase = _READ
        self.poll(now)
        if self._gone or self._now < self._dead_until or self._phase == _DEAF:
            return 0xFF
        if self._phase == _ADDRESS:
            self._address(byte, hz, mode)
            return 0xFF
        answer = 0xFF
        self._spi = True
        if self._phase == _GARBAGE or not self._in_time(hz):
            # bits are taken in late or early
            answer = (self._registers[self._pointer] << 1 | byte & 1) & 0xFF ^ 0x81
        elif self._phase == _READ:
            answer = self._get(self._pointer)
        elif self._now >= self._reset_until:
            if self.log is not None:
                self.log.append((self._now, self._pointer, byte))
            self._set(self._pointer, byte)
        self._spi = False
        self._advance()
        return answer

    def _address(self, byte, hz, mode):
        self._pointer = byte & 0x7F
        if mode not in (0, 3):
            self._misused("SPI mode %d" % mode)
            self._phase = _GARBAGE
        elif byte & 0x80:
            self._phase = _READ
            plain = not self._stuck and not self._registers[_INT_PIN_CFG] & 0x10
            self._plain = plain
            if plain and hz <= _FAST_HZ and _ACCEL_XOUT_H <= self._pointer <= _EXT_SENS_DATA_23:
                self._sampled()
                self._phase = _STREAM
        else:
            self._phase = _WRITE

    def _in_time(self, hz):
        """May this register be accessed at this speed?"""
        if hz <= _SLOW_HZ:
            return True
        sensor = _INT_STATUS <= self._pointer <= _EXT_SENS_DATA_23
        if hz <= _FAST_HZ and self._phase == _READ and sensor:
            return True
        kind = "read" if self._phase == _READ else "write"
        self._misused("%s of register 0x%02x at %d Hz" % (kind, self._pointer, hz))
        return False
