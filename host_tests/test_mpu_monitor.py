"""The monitor of the MPU drivers: a chip that falls silent, repairs that do not hold, how long samples are withheld.
The repair of a chip that has reset itself is told in test_mpu6050.py and test_mpu6500.py."""

import kernel
import machine
import pytest
from imus import COUNTS, FRESH, RIGS
from upright.mpu6050 import HEALTH_MISMATCH, HEALTH_OK

GYRO_CONFIG, INT_ENABLE, SIGNAL_PATH_RESET, USER_CTRL, PWR_MGMT_1 = 0x1B, 0x38, 0x68, 0x6A, 0x6B
SLOTS = [0x27, 0x2A, 0x2D, 0x30, 0x34]


I2C, SPI = RIGS["MPU6050"], RIGS["MPU6500"]


def by_read(imu):
    return imu.read() & FRESH


def by_fifo(imu):
    fresh = 0
    for _ in range(imu.fifo_poll()):
        fresh += imu.fifo_next() & FRESH
    return fresh


def ticks(imu, n, deliver=by_read, us=1000):
    """n ticks -> which of them brought something fresh."""
    fresh = []
    for i in range(n):
        kernel.advance(us - kernel.now() % us)
        if deliver(imu):
            fresh.append(i)
        imu.health()
    return fresh


def writes(chip):
    return [(register, value) for _, register, value in chip.log]


# A chip that falls silent


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
@pytest.mark.parametrize("rig", [I2C, SPI])
def test_a_chip_that_takes_no_samples_any_more_is_reset_and_configured(rig, deliver):
    chip, imu = rig.running()
    if deliver is by_fifo:
        imu.fifo_enable()
    assert ticks(imu, 20, deliver)
    chip.log = []
    chip.jam()
    fresh = ticks(imu, 900, deliver)
    assert 400 < fresh[5] < 800 and len(fresh) > 100
    assert (imu.full_resets, imu.resets, imu.errors) == (1, 0, 0)
    done = writes(chip)
    assert done.count((PWR_MGMT_1, 0x80)) == 1
    assert done.count((SIGNAL_PATH_RESET, 7)) == (1 if rig.spi else 0)
    assert list(imu.counts)[:6] == list(COUNTS)[:6]
    for register, value in imu.configuration():
        assert chip.register(register) & ~0x10 == value & ~0x10
    assert chip.misuse == []


def test_it_is_not_reset_within_a_transaction_of_its_master():
    chip, imu = SPI.running()
    imu.set_rows([(0x25, 0x8E, 0xFF), (0x27, 0x87, 0xFF)])
    imu.set_user_ctrl(0x20, 0x20)
    ticks(imu, 20)
    chip.log = log = []
    chip.jam()
    assert ticks(imu, 900)[-1] == 899
    at = writes(chip).index((PWR_MGMT_1, 0x80))
    assert writes(chip)[at - 6 : at - 1] == [(slot, 0) for slot in SLOTS]
    assert log[at - 1][1:] == (USER_CTRL, 0x10) and log[at - 1][0] - log[at - 2][0] >= 5000
    assert log[at + 1][0] - log[at][0] >= 100_000
    assert chip.register(0x25) == 0x8E and chip.register(USER_CTRL) & 0x20
    assert chip.misuse == []


def test_a_chip_that_stays_silent_is_reset_again_and_nobody_waits_for_it():
    chip, imu = I2C.running()
    ticks(imu, 20)
    restart = chip._restart_clock

    def jammed():
        restart()
        chip.jam()

    chip._restart_clock = jammed
    chip.jam()
    longest = 0
    for _ in range(3000):
        kernel.advance(1000 - kernel.now() % 1000)
        begun = kernel.now()
        imu.read()
        imu.health()
        longest = max(longest, kernel.now() - begun)
    assert 4 <= imu.full_resets <= 8
    assert longest < 1500
    chip._restart_clock = restart
    assert ticks(imu, 1200)[-1] == 1199


@pytest.mark.parametrize("rate, us", [(4, 1000), (4, 250_000), (50, 1000), (1000, 700_000)])
def test_slow_samples_and_slow_polls_are_no_silence(rate, us):
    _, imu = I2C.running(rate=rate)
    ticks(imu, 3000 if us == 1000 else 20, us=us)
    assert imu.full_resets == 0


def test_neither_a_chip_asleep_nor_a_bus_that_fails_is_silence():
    chip, imu = I2C.running()
    imu.sleep()
    assert ticks(imu, 1500)[1:] == [] and imu.full_resets == 0
    imu.wake()
    assert len(ticks(imu, 20)) >= 19
    chip.vanish()
    ticks(imu, 1500)
    chip.come_back()
    assert len(ticks(imu, 600)) > 550 and imu.full_resets == 0


def test_flags_that_somebody_clears_are_no_silence():
    _, imu = I2C.running()
    for i in range(2000):
        kernel.advance(1000)
        imu.read()
        imu.counts[10] = 0
        if i % 400 == 0:
            imu.read()  # a stale one
        imu.health()
    assert imu.full_resets == 0


def test_a_repair_that_does_not_hold_three_times_ends_in_a_full_reset():
    chip, imu = I2C.running()
    ticks(imu, 20)
    chip.log = []
    chip.stick(GYRO_CONFIG, 0)
    while not imu.full_resets:
        ticks(imu, 10)
        assert imu.resets <= 4
    assert imu.resets == 4
    ticks(imu, 130)
    assert (PWR_MGMT_1, 0x80) in writes(chip)
    chip.stick(GYRO_CONFIG)
    ticks(imu, 300)
    assert imu.health() == HEALTH_OK and len(ticks(imu, 20)) == 20


def test_repairs_that_hold_do_not_add_up_to_a_full_reset():
    chip, imu = I2C.running()
    for n in range(6):
        chip.brown_out(kernel.now())
        assert ticks(imu, 200)[-1] == 199
        assert (imu.resets, imu.full_resets) == (n + 1, 0)


# A bus that did not fill the buffer


@pytest.mark.parametrize("rig", [I2C, SPI])
def test_a_transfer_that_does_not_fill_the_buffer_is_a_fault(rig):
    _, imu = rig.running()
    ticks(imu, 5)

    class Lazy:
        def readfrom_mem_into(self, address, register, buffer):
            pass

        readinto = write = writeto = init = readfrom_mem_into

    bus = machine.I2C(0) if not rig.spi else machine.SPI(5)
    before = list(imu.counts)[:10]
    for moment in range(2):
        imu.registers.bind(Lazy()) if not rig.spi else setattr(
            imu.registers, "_receive", lambda buffer, idle: None
        )
        assert [imu.read() & FRESH for _ in range(5)] == [0] * 5
        assert imu.errors == 5 * (moment + 1) and list(imu.counts)[:10] == before
        imu.registers.bind(bus)
        if moment == 0:
            while not imu.read() & FRESH:
                kernel.advance(50)
            assert not imu.read() & FRESH  # a stale one before the next round
    kernel.advance(1000)
    assert imu.read() & FRESH


# How long samples are withheld


@pytest.mark.parametrize(
    "rig, dlpf, ms",
    [(I2C, 1, 38), (I2C, 3, 50), (I2C, 6, 106), (SPI, 1, 59), (SPI, 6, 303)],
)
def test_the_gyros_start_and_four_times_the_filters_delay_are_waited_for(rig, dlpf, ms):
    chip, imu = rig.running(configure={"dlpf": dlpf})
    begun = kernel.now()
    imu.configure(dlpf=dlpf, settle=False)
    without = kernel.now() - begun
    begun = kernel.now()
    imu.configure(dlpf=dlpf)
    assert 0 <= kernel.now() - begun - without - 1000 * ms < 2000
    # and after a reset of the chip, too
    chip.brown_out(kernel.now())
    restored = None
    for _ in range(1000):
        kernel.advance(1000 - kernel.now() % 1000)
        fresh = imu.read() & FRESH
        imu.health()
        if chip.register(INT_ENABLE) and restored is None:
            restored = kernel.now()
        if fresh:
            break
    assert imu.resets == 1
    assert ms - 1 <= (kernel.now() - restored) / 1000 <= ms + 4


def test_a_mismatch_while_the_gyro_settles_starts_the_repair_anew():
    chip, imu = I2C.running(configure={"dlpf": 6})
    chip.brown_out(kernel.now())
    assert ticks(imu, 110) == []
    chip.poke(GYRO_CONFIG, 0)
    states = []
    while HEALTH_MISMATCH not in states:
        kernel.advance(1000)
        assert not imu.read() & FRESH
        states.append(imu.health())
    assert imu.resets == 2
    assert ticks(imu, 300)[-1] == 299 and list(imu.counts)[3:6] == [5, 6, -7]
