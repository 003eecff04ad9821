"""Samples that are none, although the bus is well and DATA_RDY is set: a word that has fallen to 0, a burst whose
end is missing, the same sample again and again. What a turntable gives is ordinary."""

import faults
import kernel
import pytest
from imus import FRESH, RIGS
from test_mpu_clone import by_fifo, by_read, ticks
from world import NoisyWorld

TURN = (1500, -2000, 3200, 3000, -4000, 5900)  # counts; all of them far from 0
DATA = 0x3B
PARTS = ["MPU6050", "MPU6500"]


class TurningWorld(NoisyWorld):
    """TURN with a sensor's noise."""

    def row(self, k):
        row = NoisyWorld.row(self, k)
        for i in range(6):
            row[i] = TURN[i] + k * (i + 3) % 11
        return row


def turning(name, deliver=by_read):
    world = TurningWorld()
    world.start(0)
    chip, imu = RIGS[name].running(world)
    if deliver is by_fifo:
        imu.fifo_enable(1)
    assert sum(ticks(imu, 100, deliver)) >= 99
    return chip, imu


def dies(chip, axis, word=0):
    faults.FAULTS["stuck_axis"][0](None, chip, axis, word)


def lives(chip, axis):
    faults.FAULTS["stuck_axis"][1](None, chip, axis)


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
@pytest.mark.parametrize("axis", range(6))
def test_a_word_that_falls_to_zero_and_stays_there_is_no_sample_from_the_first_on(axis, deliver):
    chip, imu = turning("MPU6050", deliver)
    if deliver is by_read:
        dies(chip, axis)
    else:  # it stands in the packets
        row = chip.world.row

        def dead(k):
            found = row(k)
            found[axis] = 0
            return found

        chip.world.row = dead
        ticks(imu, 2, deliver)
    before = list(imu.counts)[:10]
    assert sum(ticks(imu, 150, deliver)) == 0
    assert list(imu.counts)[:10] == before, "the filter coasts with these"
    assert (imu.full_resets, imu.errors) == (0, 0)
    ticks(imu, 250, deliver)
    assert imu.full_resets == 1
    if deliver is by_read:
        lives(chip, axis)
    else:
        chip.world.row = row
    assert sum(ticks(imu, 600, deliver)[300:]) >= 295
    assert imu.resets == 0


def test_a_word_that_passes_zero_is_a_sample():
    """A jump that lands on 0 costs the one sample, and a small step to 0 none."""
    chip, imu = turning("MPU6050")
    row = chip.world.row
    values = iter([0, -2, 0, 1, 0, 200, 0, -200, 0] + [5900] * 100)

    def swings(k):
        found = row(k)
        found[5] = next(values)
        return found

    chip.world.row = swings
    assert [bool(fresh) for fresh in ticks(imu, 9)] == [False] + [True] * 8
    assert sum(ticks(imu, 50)) == 50
    assert (imu.errors, imu.full_resets) == (0, 0)


def test_a_simulator_without_noise_may_stop_at_once():
    chip, imu = RIGS["MPU6050"].running(TURN)
    ticks(imu, 100)
    chip.world.set((0, 0, 4096, 0, 0, 0))
    assert sum(ticks(imu, 500)) == 500


class Vanishes:
    """The chip falls silent at that time: a source of kernel.py."""

    def __init__(self, chip, at):
        self.chip, self.at = chip, at
        kernel.add_source(self)

    def due(self):
        return self.at

    def fire(self, now):
        self.chip.vanish()
        self.at = None
        kernel.changed()


@pytest.mark.parametrize("name", PARTS)
def test_a_burst_whose_end_is_missing_is_no_sample(name):
    """The master reads 0xff where nobody drives the bus, and nothing tells it."""
    chip, imu = turning(name)
    begun = kernel.now()
    imu.read()
    took = kernel.now() - begun
    cut = 0
    for after in range(0, took + 50, 5):
        ticks(imu, 5)
        errors = imu.errors
        kernel.advance(1000 - kernel.now() % 1000)
        vanishes = Vanishes(chip, kernel.now() + after)
        flags = imu.read() & FRESH
        kernel.remove_source(vanishes)
        cut += not flags
        if flags:
            for i in range(6):
                assert abs(imu.counts[i] - TURN[i]) < 300, "what one byte may hide"
        else:
            assert imu.errors == errors + 1
        chip.come_back()
        assert sum(ticks(imu, 5)) >= 4
    assert cut > took // 8
    assert (imu.resets, imu.full_resets) == (0, 0)


@pytest.mark.parametrize("deliver", [by_read, by_fifo])
def test_words_that_end_in_0xff_are_samples_while_the_chip_answers(deliver):
    chip, imu = turning("MPU6050", deliver)
    row = chip.world.row

    def ends(k):
        found = row(k)
        found[5] = -1 if k & 1 else 0x17FF
        return found

    chip.world.row = ends
    assert sum(ticks(imu, 100, deliver)) == 100
    assert imu.errors == 0


@pytest.mark.parametrize("name", PARTS)
def test_the_same_sample_is_left_out_before_the_chip_is_reset(name):
    chip, imu = turning(name)
    faults.FAULTS["frozen"][0](None, chip)
    fresh = ticks(imu, 250)
    assert 55 <= sum(fresh) <= 70
    assert imu.full_resets == 0
    ticks(imu, 100)
    assert imu.full_resets == 1
