"""What a board does before its I2C bus is made: free it, and compute its time-out."""

import machine
import pytest
from chips.mpu6050 import MPU6050Chip
from upright import i2c_bus
from upright.mpu6050 import MPU6050, MPU6050Error
from world import StillWorld


def pins():
    return [machine.Pin(n, machine.Pin.OPEN_DRAIN, value=1) for n in (5, 4)]


def sensor():
    return MPU6050(machine.I2C(0, scl=machine.Pin(5), sda=machine.Pin(4)))


@pytest.mark.parametrize("clocks", [1, 8, 9])
def test_a_chip_that_holds_sda_low_after_a_reset_of_the_board_lets_go(clocks):
    machine.wire_i2c(0, MPU6050Chip(StillWorld()), 5, 4)
    machine.hold_sda(0, 5, 4, clocks)
    with pytest.raises(MPU6050Error, match="timed out"):
        sensor().configure()
    assert i2c_bus.free(*pins())
    sensor().configure()


def test_a_line_that_stays_low_is_told():
    machine.hold_sda(0, 5, 4, 100)
    assert not i2c_bus.free(*pins())


def test_a_bus_that_nobody_holds_gets_no_clocks_but_the_stop():
    machine.hold_sda(0, 5, 4, 0)
    machine._i2c_bus(0).stuck = False
    seen = []
    machine._wire(5).listeners.append(lambda level, now: seen.append(level))
    assert i2c_bus.free(*pins()) and seen == [0, 1]


@pytest.mark.parametrize("hz, port", [(100000, "rp2"), (400000, "rp2"), (400000, "esp32")])
def test_the_longest_transfer_fits_into_the_time_out(hz, port):
    batch = 8 * (14 + 8)
    timeout = i2c_bus.timeout_us(hz, port)
    assert 9 * batch * 1000000 // hz < timeout < 9 * batch * 1000000 // hz + 20000
    assert port != "esp32" or timeout >= 20000
