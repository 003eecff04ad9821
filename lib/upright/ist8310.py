# Driver of the iSentek IST8310 magnetometer, behind an MPU's auxiliary master or on an I2C bus.
# Needs magnetometer.py, and auxiliary_bus.py for the one behind an MPU. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. DS is iSentek's datasheet, IST8310 version 1.2.

from micropython import const

from upright.magnetometer import Magnetometer

_WAI = const(0x00)
_STAT1 = const(0x02)  # then DATAXL..DATAZH, 0x03..0x08
_CNTL1 = const(0x0A)
_CNTL2 = const(0x0B)
_AVGCNTL = const(0x41)
_PDCNTL = const(0x42)

_SINGLE = const(0x01)  # CNTL1: measure once, then back to standby
_SRST = const(0x01)  # CNTL2: soft reset, clears itself
_DREN_DRP = const(0x0C)  # CNTL2: without DREN the DRDY bit stays 0 as well as the pin (DS 6.4)
_PULSE_NORMAL = const(0xC0)  # PDCNTL: required by DS 3.1.1

_AVGCNTL_OF = {1: 0x00, 2: 0x09, 4: 0x12, 8: 0x1B, 16: 0x24}  # y in bits 5:3, x and z in bits 2:0


class IST8310Error(OSError):
    """The magnetometer is absent, another chip, or does not keep what is written to it; at set-up only."""


class IST8310(Magnetometer):
    """An IST8310 on the auxiliary bus of an MPU6050 or MPU6500, or on an I2C bus.

        imu.configure()
        mag = IST8310(AuxiliaryBus(imu))
        mag.configure(rate_hz=100)

    From then on imu.read() or imu.fifo_next() also fills counts[6..8], and imu.health() checks the magnetometer. Do
    this again after imu.configure(). On a bus of its own the magnetometer is read by itself:

        mag = IST8310(i2c)
        mag.configure(rate_hz=100, sample_rate=200)

        def tick(timer):
            imu.read()
            mag.read(imu.counts)

    address is 0x0C to 0x0F by the pins CAD0 and CAD1, 0x0E when they are open. The frame is left-handed. A measurement
    takes 5 ms, and 6 ms with an average of 8 or 16. Magnetometer describes the rest.
    """

    chip = "IST8310"
    ADDRESSES = (0x0C, 0x0D, 0x0E, 0x0F)
    error_class = IST8310Error
    lsb_per_uT = (33, 10)  # DS 4.4, 14 bits
    # DS 3.1 says 5 ms for its default, an average of 4, and 6 ms for 16; for 8 the longer one
    AVERAGES = {1: 5000, 2: 5000, 4: 5000, 8: 6000, 16: 6000}
    IDENTITY = (_WAI, b"\x10")
    SAMPLE = (_STAT1, 7)
    LAYOUT = (1, 2, 3, 4, 5, 6)  # DS 6.4
    NEVER = 0xFC
    MOST = (
        5280,
        5280,
        8250,
    )  # full scale 1600 uT for x and y, 2500 uT for z (DS 4.4), times 3.3 LSB/uT
    START = (_CNTL1, _SINGLE)
    RESET = (_CNTL2, _SRST)
    RESET_MS = 60  # 50 at most (DS 4.5)
    HINT = "Check its supply, its reset pin and the pull-ups; CAD0 and CAD1 set the address, 0x0c to 0x0f"

    def __init__(self, bus, address=0x0E):
        Magnetometer.__init__(self, bus, address)

    def registers_for(self, average):
        return (
            (_CNTL2, _DREN_DRP, _DREN_DRP | _SRST),
            (_AVGCNTL, _AVGCNTL_OF[average], 0x3F),
            (_PDCNTL, _PULSE_NORMAL, 0xC0),
        )
