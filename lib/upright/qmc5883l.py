# Driver of the QST QMC5883L magnetometer (GY-271, newer GY-87), behind an MPU's auxiliary bus or on an I2C bus.
# Needs magnetometer.py, and auxiliary_bus.py for the one behind an MPU. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. DS is QST's datasheet 13-52-04 rev A.

from micropython import const

from upright.magnetometer import Magnetometer

_DATA = const(0x00)  # X, Y, Z, each with the low byte first
_STATUS = const(0x06)
_CONTROL_1 = const(0x09)
_CONTROL_2 = const(0x0A)
_SET_RESET_PERIOD = const(0x0B)
_CHIP_ID = const(0x0D)

_CONTINUOUS = const(0x01)  # CONTROL_1
_RANGE_8_GA = const(0x10)
_INT_ENB = const(0x01)  # CONTROL_2: no interrupt pin
_SOFT_RST = const(0x80)
_OVL = const(0x02)  # STATUS: an axis is out of range

_OVERSAMPLING = {512: 0x00, 256: 0x40, 128: 0x80, 64: 0xC0}  # CONTROL_1


class QMC5883LError(OSError):
    """The magnetometer is absent, another chip, or does not keep what is written to it; at set-up only."""


class QMC5883L(Magnetometer):
    """A QMC5883L on the auxiliary bus of an MPU6050, or on an I2C bus (on a GY-87: imu.set_bypass()).

        mag = QMC5883L(i2c)
        mag.configure(rate_hz=100, sample_rate=200)

    It has no single measurement: it measures by its own clock, at 10, 50, 100 or 200 Hz. average is its over-sample
    ratio: 512, 256, 128 or 64. The range is 800 uT.

    Its axes lie as an HMC5883L's in the same place (ArduPilot's pull request 31874): MAG_AXES = ("x", "y", "z") on a
    GY-87. Magnetometer describes the rest.
    """

    chip = "QMC5883L"
    ADDRESSES = (0x0D,)
    error_class = QMC5883LError
    lsb_per_uT = (30, 1)  # DS table 2: 3000 LSB/Ga at +-8 Ga
    IDENTITY = (_CHIP_ID, b"\xff")
    AVERAGES = {512: 0, 256: 0, 128: 0, 64: 0}
    STATUS = _STATUS
    SAMPLE = (_DATA, 6)
    LAYOUT = (1, 2, 3, 4, 5, 6)
    NEVER = 0xF8
    OVERFLOW = (0, _OVL)
    MOST = (32767, 32767, 32767)
    RATES = {10: 0x00, 50: 0x04, 100: 0x08, 200: 0x0C}  # CONTROL_1
    RESET = (_CONTROL_2, _SOFT_RST)
    RESET_MS = 60
    HINT = "Check its supply and pull-ups. An HMC5883L answers at 0x1e"

    def __init__(self, bus, address=0x0D):
        Magnetometer.__init__(self, bus, address)

    def registers_for(self, average):
        # the mode last: it starts the measurements
        control = _OVERSAMPLING[average] | _RANGE_8_GA | self.RATES[self.rate] | _CONTINUOUS
        return (
            (_SET_RESET_PERIOD, 0x01, 0xFF),  # DS 9.2.5 recommends it
            (_CONTROL_2, _INT_ENB, 0xC1),
            (_CONTROL_1, control, 0xFF),
        )
