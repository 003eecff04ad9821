# What is soldered to or plugged into each simulated board: chip models on the mock's buses and pins, by the folder's
# name in boards/. Portable. A new board has its wiring here, one function.

import machine
from chips.mpu6050 import MPU6050Chip
from chips.ssd1306 import SSD1306Chip

# I2C boards: the bus of sensor and display, its pins SCL and SDA, and the pin of INT
I2C = {
    "sim": (0, 5, 4, 6),
    "pico": (0, 5, 4, 6),
    "gy87_pico": (0, 5, 4, 6),
    "mpu9250_pico": (0, 5, 4, 6),
    "pico_w": (0, 5, 4, 6),
    "pico2": (0, 5, 4, 6),
    "pico2_w": (0, 5, 4, 6),
    "esp32": (0, 22, 21, 19),
    "esp32_s3": (0, 9, 8, 4),
    "esp32_c3": (0, 7, 6, 10),
    "pyboard": (1, "X9", "X10", "X1"),
    "weact_f411_blackpill": (1, "PB6", "PB7", "PB0"),
}


_MAG_AXES = ("y", "-x", "-z")  # how the RoboMaster's magnetometer lies to the IMU


class Parts:
    """imu, mag (None where there is none), display: chip models; buses: the sensor's first, then the display's."""

    def __init__(self, imu, mag, display, buses):
        self.imu = imu
        self.mag = mag
        self.display = display
        self.buses = buses


def _i2c_sensors(name, board, world, options):
    """(IMU, the magnetometer behind it or None) of an I2C board."""
    who, axes = options.get("who_am_i"), getattr(board, "MAG_AXES", ("x", "y", "z"))
    if name == "mpu9250_pico":
        from chips.ak8963 import AK8963Chip
        from chips.mpu6500 import MPU6500Chip

        return MPU6500Chip(world, who_am_i=who or 0x71), AK8963Chip(world, axes=axes)
    imu = MPU6050Chip(world, who_am_i=who or 0x68)
    if name != "gy87_pico":
        return imu, None
    if options.get("mag_chip") == "QMC5883L":
        from chips.qmc5883l import QMC5883LChip

        return imu, QMC5883LChip(world, axes=axes)
    from chips.hmc5883l import HMC5883LChip

    return imu, HMC5883LChip(world, axes=axes)


def _i2c_board(name, board, world, options):
    """MPU6050 and SSD1306 on one bus, or the display on the next."""
    bus, scl, sda, interrupt = I2C[name]
    imu, mag = _i2c_sensors(name, board, world, options)
    if mag is not None and options.get("mag", True):
        imu.aux.append(mag)
    display = SSD1306Chip(sh1106=options.get("sh1106", False))
    if options.get("imu", True):
        machine.wire_i2c(bus, imu, scl, sda)
        if options.get("interrupt", True):
            machine.wire_pin(interrupt, imu)
    if options.get("display", True):
        shared = getattr(board, "DISPLAY_SHARES_BUS", True)
        if shared:
            machine.wire_i2c(bus, display, scl, sda)
        else:
            machine.wire_i2c(bus + 1, display)
    buses = [machine.I2C(number, timeout=0)._bus for number in (bus, bus + 1)]
    return Parts(imu, mag, display, buses)


def _robomaster_a(name, board, world, options):
    """MPU6500 on SPI5 with an IST8310 on its auxiliary bus; SSD1306 on SPI1 without chip select."""
    from chips.ist8310 import IST8310Chip
    from chips.mpu6500 import MPU6500Chip

    imu = MPU6500Chip(world, who_am_i=options.get("who_am_i") or 0x70)
    mag = IST8310Chip(world, axes=getattr(board, "MAG_AXES", _MAG_AXES))
    display = SSD1306Chip()
    if options.get("mag", True):
        imu.aux.append(mag)
        machine.wire_reset("PE2", mag)
    if options.get("imu", True):
        machine.wire_spi(5, imu, cs="PF6")
        machine.wire_pin("PB8", imu)
    if options.get("display", True):
        machine.wire_spi(1, display, dc="PB9", rst="PB10")
    return Parts(imu, mag, display, [machine.SPI(5)._bus, machine.SPI(1)._bus])


BOARDS = {"robomaster_a": _robomaster_a}
BOARDS.update({name: _i2c_board for name in I2C})


def wire(name, board, world, options):
    """Wire the simulated parts of boards/<name> -> Parts.

    board: its board.py, already imported, or None. options: who_am_i (None: the part that belongs there), and imu, mag,
    display: False where the part is missing; interrupt: False where INT is not wired; sh1106: True, the display's
    controller; mag_chip: "QMC5883L" in place of a GY-87's HMC5883L.
    """
    if name not in BOARDS:
        raise ValueError(
            "no simulated wiring for the board %r; there is %s" % (name, sorted(BOARDS))
        )
    return BOARDS[name](name, board, world, options)
