# Driver of the Honeywell HMC5883L magnetometer (GY-86, GY-87, GY-271), behind an MPU's auxiliary bus or on an I2C bus.
# Needs magnetometer.py, and auxiliary_bus.py for the one behind an MPU. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. DS is Honeywell's datasheet 900405 rev E.

from micropython import const

from upright.magnetometer import Magnetometer

_CRA = const(0x00)  # configuration register A
_CRB = const(0x01)
_MODE = const(0x02)
_DATA = const(0x03)  # X, Z, Y, each with the high byte first
_STATUS = const(0x09)
_IDENTIFICATION_A = const(0x0A)

_SINGLE = const(0x01)  # MODE: measure once, then idle
_GAIN_1_3_GA = const(0x20)  # CRB
_75_HZ = const(0x18)  # CRA; it holds for continuous measurements only

_SAMPLES_OF = {1: 0x00, 8: 0x60}  # CRA


class HMC5883LError(OSError):
    """The magnetometer is absent, another chip, or does not keep what is written to it; at set-up only."""


class HMC5883L(Magnetometer):
    """An HMC5883L on the auxiliary bus of an MPU6050, or on an I2C bus (on a GY-87: imu.set_bypass()).

        imu.configure()
        imu.set_bypass()
        mag = HMC5883L(i2c)
        mag.configure(rate_hz=100, sample_rate=200)

    Each measurement is started by itself, so that its time is known. average 8 has a third of the noise of 1 and allows
    73 Hz. The range is 130 uT; beyond it the chip delivers -4096, which is counted as saturated. It has no soft reset.

    On the GY-86 and GY-87 its axes are the MPU6050's: MAG_AXES = ("x", "y", "z"). MultiWii's def.h maps both alike but
    for the sign of the field. Magnetometer describes the rest.
    """

    chip = "HMC5883L"
    ADDRESSES = (0x1E,)
    error_class = HMC5883LError
    lsb_per_uT = (109, 10)  # DS table 9: 1090 LSB/Ga at +-1.3 Ga
    IDENTITY = (_IDENTIFICATION_A, b"H43")
    # DS: 160 Hz at most by single measurements; with eight samples to each it keeps 75 Hz
    AVERAGES = {1: 6250, 8: 13333}
    AVERAGE = 1
    STATUS = _STATUS
    SAMPLE = (_DATA, 6)
    LAYOUT = (2, 1, 6, 5, 4, 3)  # DS table 2: z comes before y
    NEVER = 0xE0
    MOST = (2047, 2047, 2047)
    START = (_MODE, _SINGLE)
    RESET_MS = 60
    HINT = "Check its supply and pull-ups. A module sold as HMC5883L mostly has a QMC5883L, at 0x0d"

    def __init__(self, bus, address=0x1E):
        Magnetometer.__init__(self, bus, address)

    def registers_for(self, average):
        return (
            (_CRA, _SAMPLES_OF[average] | _75_HZ, 0x7F),
            (_CRB, _GAIN_1_3_GA, 0xE0),
        )
