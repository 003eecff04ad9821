"""What a board does before its I2C bus is made: free it, and compute its time-out."""

import runpy

import kernel
import machine
import pytest
from chips.hmc5883l import HMC5883LChip
from chips.mpu6050 import MPU6050Chip
from upright import i2c_bus, settings
from upright.ak8963 import AK8963
from upright.auxiliary_bus import AuxiliaryBus
from upright.hmc5883l import HMC5883L
from upright.ist8310 import IST8310
from upright.mpu6050 import MPU6050, MPU6050Error
from upright.qmc5883l import QMC5883L
from upright_host import paths
from world import StillWorld

import boards


def pins():
    return [machine.Pin(n) for n in (5, 4)]


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
    magnetometer = max(
        kind.SAMPLE[1] + (kind.STATUS is not None) for kind in (AK8963, HMC5883L, IST8310, QMC5883L)
    )
    batch = settings.FIFO_BATCH * (14 + magnetometer)
    timeout = i2c_bus.timeout_us(hz, port)
    assert 9 * batch * 1000000 // hz < timeout < 9 * batch * 1000000 // hz + 20000
    assert port != "esp32" or timeout >= 20000


@pytest.mark.parametrize("hz", [100000, 400000])
def test_a_batch_of_nine_axes_comes_in_one_burst(hz):
    """With a time-out that covers 120 bytes there was no packet at all."""
    chip = MPU6050Chip(StillWorld())
    chip.aux.append(HMC5883LChip(StillWorld()))
    machine.wire_i2c(0, chip)
    imu = MPU6050(machine.I2C(0, freq=hz, timeout=i2c_bus.timeout_us(hz)))
    imu.configure(sample_rate_hz=100)
    HMC5883L(AuxiliaryBus(imu)).configure(rate_hz=25)
    imu.fifo_enable()
    kernel.advance(110_000)
    assert imu.fifo_poll() == 8
    assert imu.errors == imu.fifo_overflows == 0


def test_a_transfer_that_is_longer_than_its_time_out_fails():
    machine.wire_i2c(0, MPU6050Chip(StillWorld()))
    i2c = machine.I2C(0, freq=100000, timeout=2000)
    assert i2c.readfrom_mem(0x68, 0x3B, 14)
    with pytest.raises(OSError) as why:
        i2c.readfrom_mem(0x68, 0x3B, 30)
    assert why.value.args[0] == machine.ETIMEDOUT


@pytest.mark.parametrize("name", boards.I2C)
def test_each_board_frees_its_bus_before_it_makes_it(name):
    bus, scl, sda, _ = boards.I2C[name]
    machine.hold_sda(bus, scl, sda, 9)
    board = runpy.run_path(paths.BOARDS / name / "board.py")
    assert not machine._i2c_bus(bus).stuck
    port = board.get("PLATFORM", "")
    assert machine._i2c_bus(bus).timeout_us == i2c_bus.timeout_us(400000, port)
