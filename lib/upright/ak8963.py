# Driver of the AKM AK8963 magnetometer, which is inside an MPU9250 and an MPU9255, or alone on an I2C bus.
# Needs magnetometer.py, and auxiliary_bus.py for the one behind an MPU. Runs on MicroPython >= 1.22 and under
# CPython with a `micropython` shim. DS is AKM's datasheet MS1356-E-02.

import time

from micropython import const

from upright.magnetometer import Magnetometer

_WIA = const(0x00)
_ST1 = const(0x02)  # then HXL..HZH, 0x03..0x08, and ST2
_CNTL1 = const(0x0A)
_CNTL2 = const(0x0B)
_ASTC = const(0x0C)
_ASAX = const(0x10)  # then ASAY and ASAZ

_POWER_DOWN = const(0x00)  # CNTL1
_SINGLE = const(0x01)  # measure once, then power-down
_FUSE_ROM = const(0x0F)
_BIT_16 = const(0x10)  # 0.15 uT per LSB; without it 0.6
_SRST = const(0x01)  # CNTL2: soft reset, clears itself
_SELF = const(0x40)  # ASTC: the field of the self-test
_HOFL = const(0x08)  # ST2: |x| + |y| + |z| is 4912 uT or more (DS, Magnetic Sensor Overflow)


class AK8963Error(OSError):
    """The magnetometer is absent, another chip, or does not keep what is written to it; at set-up only."""


class AK8963(Magnetometer):
    """An AK8963 on the auxiliary bus of an MPU9250, or on an I2C bus (in an MPU9250: imu.set_bypass()).

        imu.configure()
        mag = AK8963(AuxiliaryBus(imu))
        mag.configure(rate_hz=100)

    Each measurement is started by itself, so that its time is known; at most 109 Hz. bits is 16 (0.15 uT per LSB) or 14
    (0.6). The sensitivity of each axis is corrected by the fuse ROM, which configure() reads; adjusted is False where
    that was not possible: without a fuse ROM, or when the tick has found the chip later. address is 0x0C in an MPU9250.

    MAG_AXES in an MPU9250, in the frame of its accelerometer and gyro, is ("y", "x", "-z") (PS-MPU-9250A-01 rev 1.1,
    9.1). Magnetometer describes the rest.
    """

    chip = "AK8963"
    ADDRESSES = (0x0C,)
    error_class = AK8963Error
    IDENTITY = (_WIA, b"\x48")
    AVERAGES = {1: 9000}  # DS, Analog Circuit Characteristics: 7.2 ms, at most 9
    SAMPLE = (_ST1, 8)
    LAYOUT = (1, 2, 3, 4, 5, 6)
    NEVER = 0xFC
    OVERFLOW = (7, _HOFL)
    MOST = (32767, 32767, 32767)
    RESET = (_CNTL2, _SRST)
    RESET_MS = 100
    HINT = "Check its supply. An MPU9250 has it inside; an MPU6500, which is sold under that name, has none"

    def __init__(self, bus, address=0x0C, bits=16):
        if bits not in (14, 16):
            raise ValueError(f"bits {bits!r} is not 14 or 16")
        self._width = _BIT_16 if bits == 16 else 0
        self.lsb_per_uT = (20, 3) if bits == 16 else (5, 3)  # DS table 8.3
        self.START = (_CNTL1, _SINGLE | self._width)
        self.adjusted = False
        Magnetometer.__init__(self, bus, address)

    def registers_for(self, average):
        return ((_ASTC, 0, _SELF),)

    def adjust(self):
        """Read the fuse ROM: H * ((ASA - 128) / 256 + 1) is the field (DS, ASAX to ASAZ)."""
        registers = self._registers
        registers.write_register(_CNTL1, _POWER_DOWN)
        time.sleep_ms(1)  # DS, Operation Modes: 100 us before another mode
        registers.write_register(_CNTL1, _FUSE_ROM)
        found = [registers.read_register(_ASAX + i) for i in range(3)]
        registers.write_register(_CNTL1, _POWER_DOWN)
        time.sleep_ms(1)
        # a copy without a fuse ROM answers 0 or 255 (seen by PX4)
        self.adjusted = not any(asa in (0x00, 0xFF) for asa in found)
        for i in range(3):
            self.gains[i] = found[i] + 128 if self.adjusted else 256
