# board.py of a Raspberry Pi Pico with nine axes on SPI0: MPU6500, an IST8310 on its auxiliary bus, no display. For the
# emulated board; needs MicroPython 1.26 or newer.

from machine import SPI, Pin
from upright import timing
from upright.auxiliary_bus import AuxiliaryBus
from upright.ist8310 import IST8310
from upright.mpu6500 import MPU6500

NAME = "Pico with SPI"
PLATFORM = "rp2"
FILTER = "mahony9"
RATE = 100
MAG_RATE_HZ = 50
SENSOR_RATE_HZ = 100  # none of the magnetometer's samples may go by unread
MAG_AXES = ("y", "-x", "-z")
MEASURE_BIAS = False
DISPLAY_SHARES_BUS = False

_spi = SPI(0, baudrate=1000000, sck=Pin(18), mosi=Pin(19), miso=Pin(16))
_select = Pin(17, Pin.OUT, value=1)


def sensor():
    return MPU6500(_spi, _select)


def magnetometer(imu):
    return IST8310(AuxiliaryBus(imu))


def display(chunk):
    return None


def data_ready_pin():
    return Pin(6, Pin.IN)


def make_tick(rate, callback):
    return timing.make_tick(rate, callback)
