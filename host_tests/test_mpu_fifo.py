"""The FIFO mode of the MPU6050 driver: whole packets, in order, none twice, whatever happens to the
bus between them."""

from array import array
from itertools import pairwise

import kernel
import machine
import pytest
from hostile import Hostile, plans
from hypothesis import example, given, settings
from hypothesis import strategies as st
from imus import RIGS
from upright.mpu6050 import HEALTH_OK
from world import StillWorld

WORDS = (0, 1, 2, 9, 3, 4, 5)  # places in a row of the words of a packet


class Numbered(StillWorld):
    """A trial at 1 kHz whose every word tells which sample and which word it is."""

    def __init__(self):
        super().__init__((), (1000, 1), clocked=True, n=30_000)
        self._numbered = array("h", bytes(22))

    def row(self, k):
        for place, i in enumerate(WORDS):
            self._numbered[i] = (k + place * 4681) & 0x7FFF
        return self._numbered


def number(counts):
    """The sample that counts hold; fails unless all seven words are that sample's own, each in its
    place."""
    k = counts[0]
    assert [counts[i] for i in WORDS] == [(k + place * 4681) & 0x7FFF for place in range(7)]
    return k


def running(batch=8, **options):
    world = Numbered()
    chip, imu = RIGS["MPU6050"].running(world, **options)
    world.start(kernel.now())
    imu.fifo_enable(batch)
    return chip, imu


def drain(imu):
    """Numbers of the fresh samples that one poll delivers."""
    numbers = []
    for _ in range(imu.fifo_poll()):
        if imu.fifo_next() & 1:
            numbers.append(number(imu.counts))
    return numbers


def polled(imu, times, us):
    numbers = []
    for _ in range(times):
        kernel.advance(us)
        numbers += drain(imu)
    return numbers


def consecutive(numbers):
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_every_sample_is_delivered_once_and_in_order():
    chip, imu = running()
    numbers = polled(imu, 1000, 2000)
    assert consecutive(numbers) and len(numbers) > 2000
    assert (imu.fifo_overflows, imu.fifo_lost, imu.errors, imu.fifo_resets) == (0, 0, 0, 1)
    assert chip.misuse == []


@pytest.mark.parametrize("batch", [1, 3, 73])
def test_a_batch_is_no_larger_than_asked_for(batch):
    _, imu = running(batch)
    kernel.advance(30_000)
    n = imu.fifo_poll()
    assert n == batch if batch < 30 else n in (30, 31)
    assert imu.fifo_level in (30 - n, 31 - n)


def test_what_is_not_yet_taken_is_kept_and_nothing_is_fetched_on_top():
    _, imu = running()
    kernel.advance(10_000)
    assert imu.fifo_poll() == 8
    imu.fifo_next()
    first = number(imu.counts)
    bus = machine.I2C(0)._bus
    before = bus.bytes
    assert imu.fifo_poll() == 7
    assert bus.bytes == before
    assert drain(imu) == list(range(first + 1, first + 8))
    assert imu.fifo_next() == 0 and not imu.counts[10] & 1


def test_a_half_written_packet_is_left_for_the_next_poll():
    chip, imu = running(fifo_byte_us=40)
    numbers = []
    partial = 0
    for i in range(300):
        kernel.advance(1700 + i % 7 * 100)
        partial += chip.fifo_count % 14 != 0
        numbers += drain(imu)
    assert partial > 20
    assert consecutive(numbers) and imu.fifo_lost == 0


@pytest.mark.parametrize("stall_ms", [60, 74, 80, 147, 500])
def test_an_overflow_is_counted_dropped_and_left_behind(stall_ms):
    _, imu = running()
    numbers = polled(imu, 20, 2000)
    kernel.advance(stall_ms * 1000)
    numbers += polled(imu, 100, 2000)
    assert numbers == sorted(set(numbers))
    assert numbers[-1] - numbers[0] > 250 and consecutive(numbers[-100:])
    overflowed = stall_ms >= 74  # 1024 bytes hold 73 packets
    assert imu.fifo_overflows == overflowed
    assert (imu.fifo_lost >= 70) is overflowed
    assert consecutive(numbers) is not overflowed


def test_without_the_look_at_the_overflow_flag_packets_would_be_misaligned():
    _, imu = running()

    def careless(n, fraction):
        imu.registers.read_into(0x74, imu.fifo._views[n])
        imu.fifo._at, imu.fifo._pending = 2, n
        return n

    imu.fifo.drain = careless
    kernel.advance(80_000)
    with pytest.raises(AssertionError):
        drain(imu)


@pytest.mark.parametrize("transaction", range(2))
@pytest.mark.parametrize("after", [0, 1, 2])
def test_a_nack_loses_at_most_what_was_in_the_fifo(transaction, after):
    chip, imu = running()
    numbers = polled(imu, 10, 2000)
    kernel.advance(2000)
    chip.nack_next(1, after=3 * transaction + after)
    assert drain(imu) == []
    assert imu.errors == 1
    numbers += polled(imu, 20, 2000)
    assert numbers == sorted(set(numbers)) and consecutive(numbers[-20:])
    assert consecutive(numbers) is (transaction == 0)  # a failed count costs nothing
    assert bool(imu.fifo_lost) is (transaction == 1)


def test_an_overflow_that_read_has_seen_is_not_forgotten():
    _, imu = running()
    kernel.advance(90_000)
    imu.read()  # clears the flag in the chip
    numbers = polled(imu, 50, 2000)
    assert len(numbers) > 50 and consecutive(numbers)


@pytest.mark.parametrize("who", [0x68, 0x70])
def test_fifo_mode_comes_back_after_a_brown_out(who):
    chip, imu = running(who_am_i=who)
    chip.world._numbered[9] = 0
    numbers = []

    def deliver():
        for _ in range(imu.fifo_poll()):
            if imu.fifo_next() & 1:
                numbers.append(imu.counts[0])

    for i in range(200):
        kernel.advance(1000)
        if i == 50:
            chip.brown_out(kernel.now())
        deliver()
        imu.health()
    assert imu.resets == 1
    assert numbers == sorted(set(numbers)) and consecutive(numbers[-50:])
    gap = max(b - a for a, b in pairwise(numbers))
    assert 50 < gap < 150  # power-up, repair, settling
    assert imu.counts[3] == (imu.counts[0] + 4 * 4681) & 0x7FFF  # settled, at the right scale


def test_after_fifo_disable_read_delivers_again():
    chip, imu = running()
    polled(imu, 5, 2000)
    imu.fifo_disable()
    assert imu.fifo_poll() == 0
    kernel.advance(1000)
    assert imu.read() & 1
    assert (chip.register(0x23), chip.register(0x38), chip.register(0x6A)) == (0, 1, 0)


def test_self_test_and_sleep_leave_fifo_mode_whole():
    _, imu = running()
    polled(imu, 5, 2000)
    imu.self_test()
    assert consecutive(polled(imu, 20, 2000))
    imu.sleep()
    kernel.advance(100_000)
    imu.wake()
    assert consecutive(polled(imu, 20, 2000))


@pytest.mark.parametrize("batch", [0, -1, 74])
def test_a_batch_that_the_fifo_cannot_hold_is_refused(batch):
    _, imu = running()
    with pytest.raises(ValueError, match=f"batch {batch} is not 1 to 73"):
        imu.fifo_enable(batch)


def test_a_burst_cut_off_and_a_restart_that_fails_too_leave_no_half_packet_behind():
    chip, imu = running()
    bus = Hostile(chip, kernel.now() + 5000, [])
    imu.registers.bind(bus)
    kernel.advance(5000)
    before = drain(imu)
    bus.now += 5000
    kernel.advance(bus.now - kernel.now())  # the driver's clock
    bus.plan = [(0, 25, ("nack", 0)), (0, 25, ("cut", 33)), (0, 25, None)]  # taken from the end
    assert drain(imu) == []
    assert imu.errors == 2
    numbers = []
    for _ in range(20):
        bus.now += 2000
        numbers += drain(imu)
    assert before and consecutive(numbers) and numbers[0] > before[-1]
    assert 5 <= imu.fifo_lost <= 10


@given(
    plan=plans,
    byte_us=st.sampled_from([0, 7, 60]),
    batch=st.integers(1, 20),
    health=st.booleans(),
    restart_us=st.sampled_from([0, 20_000]),
    rp2=st.booleans(),
)
@example([(75_000, 0, None)] * 12, 0, 8, True, 0, False)
@example([(500, 25, ("brown", 30))] * 3, 0, 8, True, 0, False)
# dies while its FIFO count is read, and again while it is asked whether it had
@example(
    [(0, 0, ("brown", 0)), (0, 0, None), (60_000, 0, None), (0, 0, ("brown", 0))],
    0,
    1,
    False,
    20_000,
    False,
)
@settings(max_examples=120, deadline=None)
def test_no_misaligned_packet_whatever_happens_between_any_two_transactions(
    plan, byte_us, batch, health, restart_us, rp2
):
    machine.power_on()
    chip, imu = running(batch, fifo_byte_us=byte_us)
    chip.power_up_us = restart_us  # 0: a dip so short that the chip never stops answering
    bus = Hostile(chip, kernel.now(), plan, swallows=rp2)
    imu.registers.bind(bus)
    last = -1

    def step():
        nonlocal last
        for _ in range(imu.fifo_poll()):
            if imu.fifo_next() & 1:
                k = number(imu.counts)
                assert k > last
                last = k
        state = imu.health() if health else HEALTH_OK
        bus.now += 1000
        return state

    while bus.plan:
        step()
    # and afterwards it always finds back to whole, unbroken delivery
    chip.nack_next(0)
    if health:
        for _ in range(150):
            step()
        before = last
        for _ in range(50):
            step()
        assert last > before + 25
        assert step() == HEALTH_OK


# What the auxiliary bus adds to each packet


class Slave:
    """A device on the auxiliary bus whose register r holds a count of its reads, xor r: bytes of two
    reads do not go together."""

    address = 0x0E

    def __init__(self):
        self.reads = 0
        self.at = 0

    def i2c_start(self, read, now):
        self.pointing = not read
        self.reads += read
        return True

    def i2c_write(self, byte, now):
        self.at = byte
        return True

    def i2c_read(self, now):
        self.at += 1
        return (self.reads ^ self.at) & 0xFF

    def i2c_stop(self, now):
        pass

    def poll(self, now):
        pass


class Behind:
    """Checks that the bytes behind a sample are the slave's, in their places."""

    def __init__(self, length):
        self.length = length
        self.turns = []

    def take(self, raw, at, counts):
        turn = raw[at] ^ 3
        got = [raw[at + i] ^ (3 + i) for i in range(self.length)]
        assert got == [turn] * self.length
        self.turns.append(turn)
        counts[6] = turn
        return 2

    def health(self):
        return 0


def nine(length=7, batch=8, spi=True, fifo=True):
    """(chip, driver, ext): MPU6500 with a slave of `length` bytes read for every sample."""
    world = Numbered()
    chip, imu = RIGS["MPU6500" if spi else "MPU6500_I2C"].running(world)
    chip.aux.append(Slave())
    world.start(kernel.now())
    chip.world._numbered[9] = 0
    imu.set_rows([(0x24, 0x5D, 0xFF), (0x25, 0x8E, 0xFF), (0x26, 2, 0xFF)])
    imu.set_rows([(0x27, 0x80 | length, 0xFF)])
    imu.set_user_ctrl(0x20, 0x20)
    kernel.advance(5000)
    ext = Behind(length)
    imu.attach(ext, length)
    if fifo:
        imu.fifo_enable(batch)
    return chip, imu, ext


def nine_drain(imu):
    """As drain(); the temperature is not compared, as the 6500 has another scale."""
    numbers = []
    for _ in range(imu.fifo_poll()):
        flags = imu.fifo_next()
        if flags & 1:
            assert flags & 3 == 3 == imu.counts[10] & 3
            k = imu.counts[0]
            for place in (0, 1, 2, 4, 5, 6):
                assert imu.counts[WORDS[place]] == (k + place * 4681) & 0x7FFF
            numbers.append(k)
    return numbers


def nine_polled(imu, times, us=2000):
    numbers = []
    for _ in range(times):
        kernel.advance(us)
        numbers += nine_drain(imu)
    return numbers


@pytest.mark.parametrize("spi", [True, False])
@pytest.mark.parametrize("length", [1, 7, 8])
def test_bytes_of_a_slave_stay_with_their_sample(length, spi):
    chip, imu, ext = nine(length, spi=spi)
    numbers = nine_polled(imu, 200)
    assert consecutive(numbers) and len(numbers) > 390
    assert len(ext.turns) == len(numbers)
    assert [(b - a) % 256 for a, b in pairwise(ext.turns)] == [1] * (len(numbers) - 1)
    assert (imu.fifo_overflows, imu.fifo_lost, imu.errors) == (0, 0, 0)
    assert chip.misuse == []


@pytest.mark.parametrize("stall_ms", [20, 26, 60, 500])
def test_an_overflow_of_longer_packets_is_left_behind_too(stall_ms):
    _chip, imu, _ = nine()
    numbers = nine_polled(imu, 20)
    kernel.advance(stall_ms * 1000)
    numbers += nine_polled(imu, 60)
    overflowed = stall_ms >= 25  # 512 bytes hold 24 packets of 21 bytes
    assert imu.fifo_overflows == overflowed
    assert consecutive(numbers) is not overflowed
    assert numbers == sorted(set(numbers)) and consecutive(numbers[-50:])


def test_a_batch_is_bounded_by_the_longer_packets():
    _, imu, _ = nine(fifo=False)
    with pytest.raises(ValueError, match="batch 25 is not 1 to 24"):
        imu.fifo_enable(25)
    imu.fifo_enable(24)
    kernel.advance(30_000)
    nine_drain(imu)
    kernel.advance(20_000)
    assert imu.fifo_poll() in (19, 20, 21)


def test_attaching_and_detaching_in_fifo_mode_never_mixes_lengths():
    chip, imu, ext = nine(batch=24)
    numbers = nine_polled(imu, 10)
    kernel.advance(5500)
    imu.attach(None, 0)
    assert imu.fifo_poll() == 0 or imu.fifo_level < 2
    seen = len(ext.turns)
    for _ in range(20):
        kernel.advance(2000)
        for _ in range(imu.fifo_poll()):
            assert imu.fifo_next() & 3 == 1
            assert imu.counts[1] == (imu.counts[0] + 4681) & 0x7FFF
            assert imu.counts[5] == (imu.counts[0] + 6 * 4681) & 0x7FFF
            numbers.append(imu.counts[0])
    assert len(ext.turns) == seen
    kernel.advance(5500)
    imu.attach(ext, 7)
    numbers += nine_polled(imu, 20)
    assert numbers == sorted(set(numbers)) and len(numbers) > 90
    assert consecutive(numbers[-30:]) and chip.misuse == []


def test_a_batch_too_large_for_longer_packets_becomes_smaller():
    _, imu, ext = nine(fifo=False)
    imu.attach(None, 0)
    imu.fifo_enable(36)
    imu.attach(ext, 7)
    kernel.advance(23_500)
    assert len(nine_drain(imu)) in (22, 23, 24)
    assert consecutive(nine_polled(imu, 20))


@pytest.mark.parametrize("control, length", [(0x87, 6), (0x86, 7), (0x00, 7), (0x8E, 7)])
def test_packets_of_another_length_than_attach_was_told_are_never_taken_for_samples(
    control, length
):
    _chip, imu, ext = nine(fifo=False)
    ext.length = length
    imu.set_rows([(0x27, control, 0xFF)])
    imu.attach(ext, length)
    with pytest.raises(imu.error_class, match=f"does not put {14 + length} bytes into the FIFO"):
        imu.fifo_enable()
    kernel.advance(20_000)
    assert imu.fifo_poll() == 0
    imu.set_rows([(0x27, 0x80 | length, 0xFF)])
    imu.fifo_enable()
    assert consecutive(nine_polled(imu, 20))


def test_in_fifo_mode_too_attach_finds_out_that_the_length_is_wrong():
    _chip, imu, ext = nine()
    with pytest.raises(imu.error_class, match="does not put 20 bytes"):
        imu.attach(ext, 6)
    kernel.advance(20_000)
    assert imu.fifo_poll() == 0 and imu.fifo_next() == 0
    imu.attach(ext, 7)
    imu.fifo_enable()
    assert consecutive(nine_polled(imu, 20))


@pytest.mark.parametrize("spi", [True, False])
def test_fifo_mode_with_a_slave_comes_back_after_a_brown_out(spi):
    chip, imu, _ext = nine(spi=spi)
    numbers = nine_polled(imu, 25)
    chip.brown_out(kernel.now())
    for _ in range(200):
        numbers += nine_polled(imu, 1, 1000)
        imu.health()
    assert imu.resets == 1
    assert numbers == sorted(set(numbers)) and consecutive(numbers[-50:])
    assert 50 < max(b - a for a, b in pairwise(numbers)) < 150
    assert chip.misuse == []


class Loose:
    """A wire that comes loose: from now on the chip hears and says nothing for `bytes` bytes."""

    def __init__(self, chip):
        self.chip = chip
        self.real = chip.spi_transfer
        self.after = self.bytes = 0
        chip.spi_transfer = self.transfer

    def transfer(self, byte, now, hz, mode):
        if self.after:
            self.after -= 1
        elif self.bytes:
            self.bytes -= 1
            return 0xFF
        return self.real(byte, now, hz, mode)


@pytest.mark.parametrize("after", [1, 4, 5, 20, 40, 60])
@pytest.mark.parametrize("length", [1, 10, 13, 60])
def test_what_a_loose_wire_takes_from_a_packet_does_not_shift_the_next_ones(after, length):
    chip, imu, _ext = nine()
    wire = Loose(chip)
    numbers = nine_polled(imu, 20)
    # the batch that it happened in cannot know; those after it must
    kernel.advance(4000)
    wire.after, wire.bytes = after, length
    n = imu.fifo_poll()
    imu.fifo.take_all()
    wire.after = wire.bytes = 0
    numbers += nine_polled(imu, 120)
    assert n in (0, 3, 4, 5)
    assert numbers == sorted(set(numbers)) and consecutive(numbers[-50:])
