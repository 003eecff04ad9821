# Driver of the iSentek IST8310 magnetometer, behind an MPU's auxiliary master or on an I2C bus.
# Needs magnetometer.py, and auxiliary_bus.py for the one behind an MPU. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. DS is iSentek's datasheet, IST8310 version 1.2.

import micropython
from micropython import const

from upright.magnetometer import Magnetometer

_WAI = const(0x00)
_STAT1 = const(0x02)  # then DATAXL..DATAZH, 0x03..0x08
_CNTL1 = const(0x0A)
_CNTL2 = const(0x0B)
_AVGCNTL = const(0x41)
_PDCNTL = const(0x42)

_IDENTITY = const(0x10)
_SINGLE = const(0x01)  # CNTL1: measure once, then back to standby
_SRST = const(0x01)  # CNTL2: soft reset, clears itself
_DREN_DRP = const(0x0C)  # CNTL2: without DREN the DRDY bit stays 0 as well as the pin (DS 6.4)
_PULSE_NORMAL = const(0xC0)  # PDCNTL: required by DS 3.1.1
_DRDY = const(0x01)
_STAT1_RESERVED = const(0xFC)

_AVGCNTL_OF = {1: 0x00, 2: 0x09, 4: 0x12, 8: 0x1B, 16: 0x24}  # y in bits 5:3, x and z in bits 2:0

# Full scale 1600 uT for x and y, 2500 uT for z (DS 4.4), times 3.3 LSB/uT
_MOST_XY = const(5280)
_MOST_Z = const(8250)

_MAG_FRESH = const(2)
_COUNT_MASK = const(0x3FFFFFFF)

# -- words of the state: written by tools/upright_host/words.py
_FRESH = const(0)
_STALE = const(1)
_SATURATED = const(2)
_UNFLAGGED = const(3)
_STEP = const(4)
_LEFT = const(5)
_LIMIT = const(6)
_N = const(7)
_WAS_READY = const(8)
_X = const(9)
# -- end of the words
_WATCH = const(4)  # STEP, as in magnetometer.py


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
    error_class = IST8310Error
    lsb_per_uT = (33, 10)  # DS 4.4, 14 bits
    # DS 3.1 says 5 ms for its default, an average of 4, and 6 ms for 16; for 8 the longer one
    AVERAGES = {1: 5000, 2: 5000, 4: 5000, 8: 6000, 16: 6000}
    SAMPLE = (_STAT1, 7)
    START = (_CNTL1, _SINGLE)
    RESET = (_CNTL2, _SRST)
    RESET_MS = 60  # 50 at most (DS 4.5)
    HINT = "Check its supply, its reset pin and the pull-ups; CAD0 and CAD1 set the address, 0x0c to 0x0f"

    def __init__(self, bus, address=0x0E):
        Magnetometer.__init__(self, bus, address)

    def registers_for(self, average):
        return (
            (_WAI, _IDENTITY, 0xFF),
            (_CNTL2, _DREN_DRP, _DREN_DRP | _SRST),
            (_AVGCNTL, _AVGCNTL_OF[average], 0x3F),
            (_PDCNTL, _PULSE_NORMAL, 0xC0),
        )

    @micropython.viper
    def take(self, raw: ptr8, at: int, counts: ptr16) -> int:
        """Unpack STAT1 and data at raw[at..at+6]: a new measurement goes to counts[6..8].

        Returns 2 then, else 0. A measurement is new if it has DRDY (reading the data clears it, DS 6.4), unless the
        bytes equal those of the sample before: a master that gets no answer keeps them. A measurement that ends during
        a read may lose its DRDY. It is recognised by data that differ from the last ones and stay for two samples.
        """
        state = ptr32(self._state)
        kept = ptr8(self._kept)
        left = state[_LEFT] - 1
        drdy = raw[at] & _DRDY
        same = 1  # as what was used last
        still = 1  # as with the sample before
        some = 0
        i = 0
        while i < 6:
            byte = raw[at + 1 + i]
            some |= byte
            if byte != kept[i]:
                same = 0
            if byte != kept[6 + i]:
                still = 0
                kept[6 + i] = byte
            i += 1
        new = 0
        if not raw[at] & _STAT1_RESERVED:  # else it is a floating bus
            if drdy:
                if not state[_WAS_READY] or not same:
                    new = 1
            elif still and some and not same:
                new = 2
        state[_WAS_READY] = drdy
        if not new or state[_STEP] != _WATCH:
            if left <= 0:
                state[_STALE] = (state[_STALE] + 1) & _COUNT_MASK
                left = state[_N]
            state[_LEFT] = left
            return 0
        state[_LEFT] = state[_LIMIT]
        i = 0
        while i < 6:
            kept[i] = raw[at + 1 + i]
            i += 1
        if new == 2:
            state[_UNFLAGGED] = (state[_UNFLAGGED] + 1) & _COUNT_MASK
        # little endian, DS 6.4; signed by arithmetic, as CPython's array wants the number
        x = ((raw[at + 1] | raw[at + 2] << 8) ^ 0x8000) - 0x8000
        y = ((raw[at + 3] | raw[at + 4] << 8) ^ 0x8000) - 0x8000
        z = ((raw[at + 5] | raw[at + 6] << 8) ^ 0x8000) - 0x8000
        if x > _MOST_XY or x < -_MOST_XY or y > _MOST_XY or y < -_MOST_XY:
            new = 0
        if z > _MOST_Z or z < -_MOST_Z:
            new = 0
        if not new:
            state[_SATURATED] = (state[_SATURATED] + 1) & _COUNT_MASK
            return 0
        counts[6] = x
        counts[7] = y
        counts[8] = z
        state[_X] = x
        state[_X + 1] = y
        state[_X + 2] = z
        state[_FRESH] = (state[_FRESH] + 1) & _COUNT_MASK
        return _MAG_FRESH
