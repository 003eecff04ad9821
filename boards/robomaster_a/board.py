# RoboMaster development board A (STM32F427IIH6): MPU6500 on SPI5, IST8310 on its auxiliary bus, OLED on SPI1.
# Everything is on the board but the OLED; see README.md. lib/upright/settings.py lists every setting.

import time

from machine import SPI, Pin
from upright import ssd1306, timing
from upright.auxiliary_bus import AuxiliaryBus
from upright.ist8310 import IST8310
from upright.mpu6500 import MPU6500

NAME = "RoboMaster board A"
PLATFORM = "pyboard"  # sys.platform there
RATE = 1000
SENSOR_RATE_HZ = 1000
DRIVE = "timer"
DISPLAY_SHARES_BUS = False  # SPI1 is the OLED's alone: the main program writes it

# The frame of the MPU6500, as its data sheet draws it on the package, is the body's.
IMU_AXES = ("x", "y", "z")
# UNVERIFIED on a real board: the axis check of README.md has not been run yet. Until then trust roll and pitch, not
# yaw. The source: the vendor's own firmware for this board maps the magnetometer's words this way
# (RoboMaster/RoboRTS-Firmware, bsp/boards/drv_imu.c, mpu_get_data). It mirrors once, as required: the IST8310's frame
# is left-handed (PX4, IST8310.cpp; ArduPilot, AP_Compass_IST8310.cpp). The vendor's older example
# (RoboMaster/DevelopmentBoard-Examples, Imu) has no map at all.
MAG_AXES = ("y", "-x", "-z")

# TIM7 has no outputs, so nothing else on the board uses it; its callbacks are hard. TIM1, 2, 4, 5, 8 and 12 drive the
# servo and buzzer connectors, TIM3 the heater; MicroPython takes TIM5 for servos and TIM6 for timed ADC and DAC.
_TICK_TIMER = 7

# SPI1 and SPI5 hang on APB2 (84 MHz) behind a power of two from 2 to 256: 1 MHz becomes 656 kHz, 20 MHz becomes 10.5.
_IMU_HZ = 1000000
_OLED_HZ = 5250000  # an SSD1306 takes up to 10 MHz, an SH1106 up to 2 MHz

_imu_spi = SPI(5, baudrate=_IMU_HZ)
_imu_select = Pin("PF6", Pin.OUT, value=1)
_mag_reset = Pin("PE2", Pin.OUT, value=1)


def sensor():
    return MPU6500(_imu_spi, _imu_select)


def magnetometer(imu):
    # A reset of the processor does not reset the chip; its reset pin does, low. Then it needs up to 50 ms.
    _mag_reset(0)
    time.sleep_ms(1)
    _mag_reset(1)
    time.sleep_ms(50)
    return IST8310(AuxiliaryBus(imu))


def display(chunk):
    # the panel by name; README.md lists them
    return ssd1306.SSD1306(
        SPI(1, baudrate=_OLED_HZ),
        "SSD1306 128x64",
        dc=Pin("PB9", Pin.OUT, value=0),
        rst=Pin("PB10", Pin.OUT, value=1),
        chunk=chunk,
    )


def data_ready_pin():
    # Only for DRIVE = "data_ready". From several teams' headers; an early project of the vendor's has PE1.
    # `upright doctor` finds which one it is.
    return Pin("PB8", Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback, _TICK_TIMER)
