"""The driver on parts that are not quite an MPU6050, and on ports that do not report what a bus did: mpu_clone.py and
the bus of machine.py have the habits."""

from itertools import pairwise

import kernel
import machine
import pytest
from chips.mpu6500 import MPU6500Chip
from chips.mpu_clone import MPU6050Clone
from imus import COUNTS, FRESH, RIGS, Rig
from upright import mpu_parts
from upright.mpu6050 import HEALTH_OK, MPU6050, MPU6050Error
from upright.mpu6500 import MPU6500, MPU6500Error
from world import NoisyWorld

CLONE = Rig(MPU6050, MPU6050Clone)
I2C = RIGS["MPU6050"]
WHO_AM_I, CONFIG, INT_ENABLE = 0x75, 0x1A, 0x38


def noisy():
    world = NoisyWorld()
    world.start(0)
    return world


def by_read(imu):
    return imu.read() & FRESH


def by_fifo(imu):
    fresh = 0
    for _ in range(imu.fifo_poll()):
        fresh += imu.fifo_next() & FRESH
    return fresh


def ticks(imu, n, deliver=by_read, us=1000):
    """n ticks -> the fresh samples of each."""
    fresh = []
    for _ in range(n):
        kernel.advance(us - kernel.now() % us)
        fresh.append(deliver(imu))
        imu.health()
    return fresh


# ------------------------------------------------------------------------------- the same sample for ever


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
@pytest.mark.parametrize("rate, most_ms", [(1000, 300), (200, 320), (50, 480)])
def test_the_same_sample_for_ever_is_no_sample_after_a_while_and_the_chip_is_reset(
    deliver, rate, most_ms
):
    chip, imu = CLONE.running(noisy(), rate)
    if deliver is by_fifo:
        imu.fifo_enable(1)
    ticks(imu, 80, deliver, 1000000 // rate)
    assert imu.full_resets == 0
    chip.freeze()
    begun = kernel.now()
    while not imu.monitor.impossible:
        ticks(imu, 1, deliver, 1000000 // rate)
    assert (kernel.now() - begun) / 1000 <= most_ms
    assert sum(ticks(imu, 2 * rate, deliver, 1000000 // rate)) == 0, "still the same"
    assert imu.full_resets >= 1
    chip.freeze(False)
    assert sum(ticks(imu, 2 * rate, deliver, 1000000 // rate)) > rate
    assert imu.errors == 0


def test_a_chip_that_has_never_varied_is_a_simulator_and_used_as_it_is():
    _, imu = I2C.running()
    assert sum(ticks(imu, 2000)) == 2000
    assert (imu.monitor.impossible, imu.full_resets) == (0, 0)


def test_a_chance_pair_of_equal_samples_is_used():
    world = noisy()
    _, imu = CLONE.running(world)
    row = world.row
    world.row = lambda k: row(k // 2)
    assert sum(ticks(imu, 2000)) >= 1999 and imu.monitor.impossible == 0


def test_a_chip_that_answers_zeros_gives_no_sample_and_is_reset():
    chip, imu = CLONE.running(noisy())
    ticks(imu, 100)
    before = list(imu.counts)[:10]
    chip.zeros()
    assert sum(ticks(imu, 1000)) == 0 and list(imu.counts)[:10] == before
    assert imu.full_resets + imu.errors > 0
    chip.zeros(False)
    assert sum(ticks(imu, 1000)) > 500


# ------------------------------------------------------------------------------- how it says that it has sampled


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
def test_a_part_that_never_sets_data_ready_is_read_by_time_and_says_so(deliver):
    _, imu = CLONE.running(noisy(), data_ready="never")
    assert any("going by time" in remark for remark in imu.remarks)
    if deliver is by_fifo:
        imu.fifo_enable()
    assert sum(ticks(imu, 1000, deliver)) >= 995
    assert (imu.errors, imu.resets, imu.full_resets) == (0, 0, 0)


def test_by_time_a_sample_is_fresh_once():
    _, imu = CLONE.running(noisy(), rate=100, data_ready="never")
    assert 99 <= sum(ticks(imu, 1000)) <= 101 * 2


def test_by_time_too_zeros_and_frozen_data_are_found():
    chip, imu = CLONE.running(noisy(), data_ready="never")
    ticks(imu, 100)
    chip.freeze()
    assert sum(ticks(imu, 1000)[400:]) == 0 and imu.full_resets > 0
    chip.freeze(False)
    assert sum(ticks(imu, 1000)[600:]) > 300
    chip.zeros()
    assert sum(ticks(imu, 1000)) == 0


def test_a_simulator_without_data_ready_whose_samples_stand_still_is_used_and_named():
    chip, imu = CLONE.running(data_ready="never")
    assert any("never vary" in remark for remark in imu.remarks)
    for k in range(100):  # somebody moves its sliders
        chip.world.set((k, 0, 4096))
        ticks(imu, 5)
    assert sum(ticks(imu, 1000)) > 990 and imu.full_resets == 0


def test_a_chip_that_does_not_sample_is_not_taken_for_one_without_data_ready():
    chip = I2C.wired()
    restart = chip._restart_clock
    chip._restart_clock = lambda: (restart(), chip.jam())
    imu = I2C.driver()
    imu.configure()
    assert imu.remarks == [] and sum(ticks(imu, 500)) == 0 and imu.full_resets > 0


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
@pytest.mark.parametrize("family", [False, True])
def test_where_data_ready_proves_nothing_no_wrong_sample_is_fresh_after_a_reset(deliver, family):
    chip, imu = CLONE.running(noisy(), data_ready="always", family_6500=family)
    assert any("without INT_ENABLE" in remark for remark in imu.remarks)
    if deliver is by_fifo:
        imu.fifo_enable()
    assert sum(ticks(imu, 100, deliver)) >= 98
    chip.power_up_us = 0
    chip.brown_out()
    fresh = 0
    for _ in range(400):
        fresh += ticks(imu, 1, deliver)[0]
        assert abs(imu.counts[2] - 4096) < 100, "at the range of a reset chip, 16384 is 1 g"
    assert imu.resets == 1 and fresh > 200


# ------------------------------------------------------------------------------- what the part has


def test_a_common_clone_is_known_and_its_fifo_is_the_smallest_of_the_family():
    _, imu = CLONE.running(noisy())
    assert (imu.chip, imu.fifo_size, imu.family_6500) == ("MPU6050 clone (0x72)", 512, False)
    imu.fifo_enable()
    assert sum(ticks(imu, 1000, by_fifo)) >= 995


@pytest.mark.parametrize("like_6500, celsius", [(False, 36.53), (True, 21)])
def test_an_unknown_part_is_what_it_is_like_after_its_reset(like_6500, celsius):
    CLONE.wired(noisy(), who_am_i=0x42, family_6500=like_6500)
    imu = CLONE.driver(accept_unknown=True)
    imu.configure()
    assert (imu.family_6500, imu.fifo_size) == (like_6500, 512)
    assert imu.temperature_cdeg(0) == round(100 * celsius)


def test_a_fifo_smaller_than_believed_is_not_waited_for():
    _, imu = CLONE.running(noisy(), who_am_i=0x68)
    assert imu.fifo_size == 1024
    imu.fifo_enable()
    kernel.advance(200_000)
    polls = [by_fifo(imu) for _ in range(10)]
    assert imu.fifo_resets >= 2, polls
    assert sum(ticks(imu, 100, by_fifo)) > 90


def test_a_clone_without_accel_config2_is_set_up_all_the_same_and_says_so():
    _, imu = CLONE.running(noisy(), who_am_i=0x70, family_6500=True, accel_config2=False)
    assert any("ACCEL_CONFIG2" in remark for remark in imu.remarks)
    assert sum(ticks(imu, 100)) >= 99
    with pytest.raises(ValueError, match="accel_dlpf: dlpf sets both"):
        imu.configure(accel_dlpf=3)


@pytest.mark.parametrize(
    "who, says, advised",
    [
        (0x19, "MPU6886", True),
        (0x12, "ICM-20602", True),
        (0x47, "ICM-42688-P, which has other registers", False),
        (0x00, "held low.*supply", False),
        (0xFF, "nobody drives.*supply", False),
        (0x42, "known are 0x68", True),
    ],
)
@pytest.mark.parametrize("spi", [False, True])
def test_a_part_that_is_not_known_is_named_with_what_to_do(who, says, advised, spi):
    rig = Rig(MPU6500, MPU6500Chip, spi=True) if spi else CLONE
    if spi and who in (0, 0xFF):
        pytest.skip("on SPI that is a floating bus: test_mpu6500.py")
    rig.wired(who_am_i=who)
    with pytest.raises((MPU6050Error, MPU6500Error), match=says) as caught:
        rig.driver().configure()
    assert ("accept_unknown" in str(caught.value)) is advised


@pytest.mark.parametrize("who", [0x00, 0xFF])
def test_no_identity_at_all_cannot_be_insisted_on(who):
    CLONE.wired(who_am_i=who)
    with pytest.raises(MPU6050Error, match="no part has"):
        CLONE.driver(accept_unknown=True).configure()


def test_every_known_part_has_a_name_and_a_size():
    for name, family, size, temperature in mpu_parts.PARTS.values():
        assert name and size in (512, 1024) and (family is None) == (temperature is None)


# ------------------------------------------------------------------------------- what a port does not report


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
def test_a_read_that_rp2_swallowed_begins_no_repair_and_gives_no_sample_twice(deliver):
    chip, imu = I2C.running(noisy())
    if deliver is by_fifo:
        imu.fifo_enable()
    machine._i2c_bus(0).swallows = True
    ticks(imu, 50, deliver)
    seen = []
    for k in range(300):
        kernel.advance(1000 - kernel.now() % 1000)
        # the k-th acknowledge of the next transfers is refused, once
        chip.nack_next(1, after=1 + 2 * (k % 5))
        for _ in range(imu.fifo_poll() if deliver is by_fifo else 1):
            flags = imu.fifo_next() if deliver is by_fifo else imu.read()
            if flags & FRESH:
                seen.append(tuple(imu.counts[:7]))
        imu.health()
        chip.nack_next(0)
    assert imu.resets == 0 and imu.full_resets == 0
    assert imu.errors > 50, "each one is a fault"
    assert all(a != b for a, b in pairwise(seen))
    assert ticks(imu, 20, deliver)[-1]
    assert imu.health() == HEALTH_OK


def test_a_swallowed_read_is_told_from_a_reset_of_the_chip():
    chip, imu = I2C.running(noisy())
    machine._i2c_bus(0).swallows = True
    for _ in range(60):  # every row of the table, each after another value in the buffer
        chip.nack_next(1, after=1)
        imu.health()
        chip.nack_next(0)
        imu.health()
    assert imu.resets == 0 and imu.errors == 60
    chip.poke(CONFIG, 0)
    ticks(imu, 30)
    assert imu.resets == 1


def test_a_fifo_reset_that_rp2_swallowed_is_done_again():
    chip, imu = I2C.running(noisy())
    imu.fifo_enable()
    machine._i2c_bus(0).swallows = True
    ticks(imu, 20, by_fifo)
    kernel.advance(90_000)
    resets = imu.fifo_resets
    imu.monitor.fifo_misaligned = 1
    chip.nack_next(1, after=3 + 2)  # the value of the second write
    imu.fifo_poll()
    chip.nack_next(0)
    assert imu.fifo_resets == resets and imu.monitor.fifo_misaligned
    assert sum(ticks(imu, 50, by_fifo)) > 30
    assert abs(imu.counts[2] - 4096) < 100


def test_a_bus_that_times_out_is_not_called_nobody_there():
    I2C.wired()
    machine._i2c_bus(0).stuck = True
    with pytest.raises(MPU6050Error, match=r"timed out.*held low.*pull-up"):
        I2C.driver().configure()


@pytest.mark.parametrize("address", [0xD0, 0xD1, 0xD2, 0x78])
def test_an_address_as_modules_print_it_is_answered_with_the_one_that_is_meant(address):
    with pytest.raises(ValueError, match=rf"8-bit form.*0x{address >> 1:02x}"):
        MPU6050(I2C.bus(), address=address)


def test_the_words_of_a_sample_on_a_clone_are_those_of_the_chip():
    _, imu = CLONE.running()
    ticks(imu, 3)
    assert list(imu.counts)[:6] == list(COUNTS)[:6]
