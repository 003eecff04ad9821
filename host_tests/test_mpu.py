"""What every IMU driver does, on I2C and on SPI: set-up, samples, faults that it must survive, self-test."""

import kernel
import machine
import pytest
from imus import COUNTS, CS, FRESH, RIGS, tick
from upright.mpu_monitor import HEALTH_BUS_ERROR

GYRO_CONFIG, USER_CTRL, PWR_MGMT_1 = 0x1B, 0x6A, 0x6B


@pytest.fixture(params=RIGS)
def rig(request):
    return RIGS[request.param]


# -- set-up
def test_constructing_touches_no_bus(rig):
    chip = rig.wired()
    chip.log = []
    before = rig.bus()._bus.bytes
    rig.driver()
    assert rig.bus()._bus.bytes == before and kernel.now() == 0 and chip.log == []


def test_a_chip_that_is_late_after_power_up_is_waited_for(rig):
    chip = rig.wired()
    chip.power_up_us = 90_000
    chip.brown_out(0)
    rig.driver().configure()


def test_an_unknown_identity_can_be_insisted_on(rig):
    rig.wired(who_am_i=0x42)
    with pytest.raises(rig.error, match=r"0x42.*0x68.*accept_unknown"):
        rig.driver().configure()
    imu = rig.driver(accept_unknown=True)
    imu.configure()
    assert (imu.chip, imu.who_am_i) == ("unknown (0x42)", 0x42)
    assert imu.fifo_size == 512  # the smallest of the family
    assert imu.family_6500 or not rig.spi
    assert tick(imu) & FRESH


@pytest.mark.parametrize(
    "name, who, chip, fifo",
    [
        ("MPU6050", 0x68, "MPU6050", 1024),
        *[
            (name, who, chip, 512)
            for name in ("MPU6050", "MPU6500", "MPU6500_I2C")
            for who, chip in (
                *((0x70, "MPU6500"), (0x71, "MPU9250")),
                *((0x73, "MPU9255"), (0x98, "ICM-20689")),
            )
        ],
    ],
)
def test_the_identity_decides_name_fifo_and_temperature(name, who, chip, fifo):
    model, imu = RIGS[name].running(who_am_i=who)
    assert (imu.chip, imu.who_am_i, imu.fifo_size) == (chip, who, fifo)
    assert tick(imu) & FRESH
    assert abs(imu.temperature_cdeg() - 3500) <= 1  # -521 / 340 + 36.53
    assert imu.gyro_scale == (82, 5)
    assert model.misuse == []


def test_a_chip_stuck_in_reset_is_reported(rig):
    chip = rig.wired()
    chip.reset_us = 10**9
    said = "on SPI did not come out of reset" if rig.spi else "did not come out of reset"
    with pytest.raises(rig.error, match=said):
        rig.driver().configure()


@pytest.mark.parametrize(
    "register, name, value", [(GYRO_CONFIG, "GYRO_CONFIG", 0x18), (0x19, "SMPLRT_DIV", 0)]
)
def test_a_register_that_does_not_keep_its_value_is_reported(rig, register, name, value):
    chip = rig.wired()
    chip.stick(register, 0x7E)
    said = rf"{name} \(0x{register:02x}\): wrote 0x{value:02x}, read 0x7e"
    with pytest.raises(rig.error, match=said):
        rig.driver().configure()


def test_nothing_is_done_that_the_datasheets_forbid(rig):
    chip, imu = rig.running()
    tick(imu)
    imu.configure_interrupt(latch=True)
    imu.fifo_enable()
    for _ in range(20):
        kernel.advance(2000)
        for _ in range(imu.fifo_poll()):
            imu.fifo_next()
        imu.health()
    imu.self_test()
    imu.sleep()
    imu.wake()
    imu.fifo_disable()
    imu.configure(accel_range_g=2, sample_rate_hz=200)
    tick(imu)
    assert chip.misuse == []
    assert chip.register(PWR_MGMT_1) & 0x07 == 1  # clocked by the gyro
    assert not rig.spi or machine.Pin(CS).value()


# -- samples
def test_a_sample_lands_in_counts_in_the_common_order(rig):
    _, imu = rig.running()
    assert tick(imu) == FRESH
    temperature = COUNTS[9] if rig is RIGS["MPU6050"] else imu.counts[9]
    assert list(imu.counts) == [*COUNTS[:9], temperature, FRESH]


def test_a_sample_is_fresh_once(rig):
    _, imu = rig.running(rate=200)
    start = kernel.now()
    fresh = [tick(imu) & FRESH for _ in range(50)]
    assert abs(sum(fresh) - (kernel.now() - start) / 5000) <= 1
    assert imu.stale == 50 - sum(fresh)
    same = 10 if rig is RIGS["MPU6050"] else 9  # the 6500 has another scale of the temperature
    assert list(imu.counts)[:same] == list(COUNTS)[:same]


@pytest.mark.parametrize("raw", [-32768, -521, -1, 0, 1, 340, 32767])
def test_temperature_is_exact_to_a_hundredth(rig, raw):
    _, imu = rig.running()
    tick(imu)
    imu.counts[9] = raw
    lsb, at_0 = (340, 36.53) if rig is RIGS["MPU6050"] else (333.87, 21)
    assert abs(imu.temperature_cdeg() - (raw / lsb + at_0) * 100) <= 0.5001


# -- faults in the tick
def test_a_chip_that_stops_answering_is_counted_and_comes_back_by_itself(rig):
    chip, imu = rig.running()
    tick(imu)
    good = list(imu.counts)[:10]
    chip.vanish()
    for _ in range(50):
        assert tick(imu) == 0
        assert imu.health() == HEALTH_BUS_ERROR
    assert list(imu.counts) == [*good, 0]
    assert imu.errors == 100 and imu.resets == 0
    chip.come_back()
    assert tick(imu) == FRESH and list(imu.counts)[:10] == good


class Failing:
    """A bus, every transfer of which raises `error` when there is one."""

    def __init__(self, bus):
        self.bus = bus
        self.error = None

    def done(self):
        if self.error:
            raise self.error

    def init(self, baudrate):
        self.bus.init(baudrate=baudrate)

    def write(self, buffer):
        self.bus.write(buffer)
        self.done()

    def readinto(self, buffer, write=0):
        self.bus.readinto(buffer, write)
        self.done()

    def readfrom_mem_into(self, address, register, buffer):
        self.bus.readfrom_mem_into(address, register, buffer)
        self.done()

    def writeto(self, address, buffer):
        self.bus.writeto(address, buffer)
        self.done()


@pytest.mark.parametrize("error", [OSError(5), OSError(19), OSError(110), OSError("custom")])
def test_any_bus_error_is_survived_whatever_the_port_calls_it(rig, error):
    rig.wired()
    bus = Failing(rig.bus())
    imu = rig.driver(bus)
    imu.configure(sample_rate_hz=1000)
    bus.error = error
    imu.monitor.errors = (1 << 30) - 2
    assert [imu.read(), imu.health(), imu.read()] == [0, HEALTH_BUS_ERROR, 0]
    assert imu.errors == 1  # the counter wraps within a small int
    assert not rig.spi or machine.Pin(CS).value()
    bus.error = None
    assert tick(imu) == FRESH


def test_other_errors_are_not_hidden_and_the_chip_is_let_go(rig):
    rig.wired()
    bus = Failing(rig.bus())
    imu = rig.driver(bus)
    imu.configure(sample_rate_hz=1000)
    bus.error = TypeError()
    with pytest.raises(TypeError):
        imu.read()
    with pytest.raises(TypeError):
        imu.registers.write(PWR_MGMT_1, 1)
    assert not rig.spi or machine.Pin(CS).value()


# -- self-test
def test_self_test_passes_on_a_sound_chip_and_restores_the_configuration(rig):
    chip, imu = rig.running(configure={"gyro_range_dps": 500, "accel_range_g": 4}, rate=200)
    passed, changes = imu.self_test()
    assert passed is True
    assert all(abs(change) <= 2 for change in changes)
    for register, value in imu.configuration():
        shown = 0xEF if register == USER_CTRL and rig.spi else 0xFF  # I2C_IF_DIS clears itself
        assert chip.register(register) == value & shown
    assert tick(imu, 5000) & FRESH and chip.misuse == []


@pytest.mark.parametrize("axis", range(6))
def test_self_test_fails_for_the_axis_that_does_not_react(rig, axis):
    chip, imu = rig.running()
    chip.broken = (axis,)
    passed, changes = imu.self_test()
    assert passed is False and changes[axis] == -1000
    assert all(abs(changes[i]) <= 2 for i in range(6) if i != axis)
