"""The DMP's driver: images, loading, start-up check, packets, faults; the same on every runtime."""

import hashlib
import io
import math
import random
from array import array
from pathlib import Path

import kernel
import machine
import motions
import numpy as np
import overflow
import pytest
from chips.mpu6050 import MPU6050Chip
from dmp_images import IMAGES, LIST, V20, V612, running, ticks, wired
from hostile import Hostile, plans
from hypothesis import given, settings
from hypothesis import strategies as st
from upright import dmp as mpu_dmp
from upright.dmp import MpuDmp, MpuDmpError
from upright.mpu6050 import MPU6050, MPU6050Error
from upright.mpu_monitor import HEALTH_OK
from world import StillWorld, World

LIB = Path(__file__).resolve().parents[1] / "lib" / "upright"
ONE = 1 << 30
FRESH = 1


def quaternion(dmp):
    out = array("i", [0, 0, 0, 0])
    dmp.quaternion(out)
    return np.array(out) / 2**29


def angle(p, q):
    """Degrees between two attitudes."""
    e = motions.multiply(np.array(p) * [1, -1, -1, -1], np.array(q))
    return math.degrees(2 * math.atan2(np.linalg.norm(e[1:]), abs(e[0])))


# -- the file


@pytest.mark.parametrize("size", [0, 1, 1928, 3061, 4000])
def test_a_file_of_another_size_is_refused(size):
    _, imu = wired()
    with pytest.raises(MpuDmpError, match=rf"3062.*1929|{size} bytes are no DMP image"):
        MpuDmp(imu, bytes(range(256)) * 16 + bytes(size) if size == 4000 else V612[:size])


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_an_unknown_image_is_refused_with_its_hash_and_taken_when_that_is_named(image):
    _, imu = wired()
    digest = hashlib.sha256(image).hexdigest()
    with pytest.raises(MpuDmpError, match=rf"not known: SHA-256 {digest}.*accept_unknown=True"):
        MpuDmp(imu, image)
    assert MpuDmp(imu, image, known=(digest,)).image.sha256 == digest
    flipped = bytearray(image)
    flipped[1000] ^= 1
    with pytest.raises(MpuDmpError, match="not known"):
        MpuDmp(imu, bytes(flipped), known=(digest,))


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_constructing_touches_no_bus(image):
    chip, imu = wired(image)
    chip.log = []
    MpuDmp(imu, image, accept_unknown=True)
    assert kernel.now() == 0 and chip.log == []


def test_the_layout_follows_from_the_size():
    _, imu = wired()
    first = MpuDmp(imu, V612, accept_unknown=True)
    second = MpuDmp(imu, V20 + LIST, accept_unknown=True)
    assert (first.version, first.image.program_start, first.image.packet) == ("v6.12", 0x400, 28)
    assert (second.version, second.image.program_start, second.image.packet) == ("v2.0", 0x300, 42)
    assert (first.accel_lsb_per_g, second.accel_lsb_per_g) == (16384, 8192)
    assert first.gyro_scale == second.gyro_scale == (82, 5)


@pytest.mark.parametrize(
    "behind, what",
    [
        (b"\x01", "ends within a record"),
        (b"\x01\x00\x04abc", "ends within a record"),
        (b"\x00\x00\x00", "ends within a record"),
        (b"\x0c\x00\x01a", "bank 12"),
        (b"\x01\xff\x02ab", "bank 1, 0xff, 2 bytes"),
    ],
)
def test_a_list_that_is_none_is_refused(behind, what):
    _, imu = wired()
    with pytest.raises(MpuDmpError, match=f"no DMP image.*{what}"):
        MpuDmp(imu, V20 + LIST + behind, accept_unknown=True)


@pytest.mark.parametrize("kind", ["bytes", "path", "file"])
def test_bytes_a_path_and_an_open_file_load_alike(kind, tmp_path):
    path = tmp_path / "dmp.bin"
    path.write_bytes(V20 + LIST)
    chip, imu = wired(V20 + LIST)
    source = {"bytes": V20 + LIST, "path": str(path), "file": io.BytesIO(V20 + LIST)}[kind]
    dmp = MpuDmp(imu, source, accept_unknown=True)
    dmp.configure()
    assert chip.dmp.running
    dmp.reload()
    assert chip.dmp.running and dmp.reloads == 1


def test_a_file_that_is_not_there_is_named():
    _, imu = wired()
    with pytest.raises(MpuDmpError, match=r"nowhere\.bin cannot be read"):
        MpuDmp(imu, "nowhere.bin")


# -- loading


@pytest.mark.parametrize("spi", [False, True], ids=["I2C", "SPI"])
@pytest.mark.parametrize("image", [V612, V612 + LIST, V20, V20 + LIST], ids=range(4))
def test_an_image_is_loaded_and_runs(image, spi):
    chip, dmp = running(image, spi)
    assert chip.dmp.running and chip.misuse == []
    size = dmp.image.image_size
    wanted = bytearray(image[:size])
    if len(image) > size:
        wanted[0x37B:0x37E] = b"\x01\x02\x03"
        wanted[0x786] = 0xFE
    wanted[0x216:0x218] = b"\x00\x01"  # 100 Hz
    assert chip.dmp.memory[:size] == wanted
    assert (chip.register(0x70) << 8 | chip.register(0x71)) == dmp.image.program_start
    assert chip.register(0x6A) & 0xC0 == 0xC0  # DMP and FIFO on
    assert (chip.register(0x19), chip.register(0x1B), chip.register(0x1C)) == (4, 0x18, 0)
    assert sum(flag & 1 for flag in ticks(dmp, 200)) > 90
    assert (dmp.errors, dmp.misaligned, dmp.needs_reload) == (0, 0, False)


def test_memory_is_written_in_pieces_that_never_cross_a_bank():
    chip, imu = wired()
    chip.log = []
    MpuDmp(imu, V612, accept_unknown=True).configure()
    at = bank = None
    written = bytearray(3072)
    for _, register, value in chip.log:
        if register == 0x6D:
            bank = value
        elif register == 0x6E:
            at = value
        elif register == 0x6F:
            assert at < 256
            written[bank << 8 | at] = value
            at += 1
    assert written[:0x216] == V612[:0x216] and written[0x218:3062] == V612[0x218:]


@pytest.mark.parametrize("address, bank, at", [(0, 0, 0), (0x20F, 2, 0x0F), (3061, 11, 0xF5)])
def test_memory_that_does_not_keep_a_byte_is_named(address, bank, at):
    chip, imu = wired()

    def write(value):
        keep = chip.dmp._at == address
        Dmp.write(chip.dmp, value ^ 0x10 if keep else value)

    Dmp = type(chip.dmp)
    chip.dmp.write = write
    wrote = V612[address]
    message = rf"bank {bank} at 0x{at:02x}: wrote 0x{wrote:02x}, read 0x{wrote ^ 16:02x}.*mahony6"
    with pytest.raises(MpuDmpError, match=message):
        MpuDmp(imu, V612, accept_unknown=True).configure()


def test_memory_smaller_than_it_claims_gives_itself_away():
    _, imu = wired(dmp_dead="small")
    with pytest.raises(MpuDmpError, match=r"memory, bank 0 at 0x0[0-9a-f]: wrote"):
        MpuDmp(imu, V612, accept_unknown=True).configure()


def acknowledges(chip):
    """How many acknowledges of the chip a whole configure() takes."""
    count = [0]
    real = chip._refused
    chip._refused = lambda: count.__setitem__(0, count[0] + 1) or real()
    return count


@pytest.mark.parametrize("part", [0.2, 0.5, 0.9])
def test_a_nack_in_the_middle_of_the_load_is_an_error_that_names_the_place(part):
    chip, imu = wired()
    count = acknowledges(chip)
    MpuDmp(imu, V612, accept_unknown=True).configure()
    dmp = MpuDmp(imu, V612, accept_unknown=True)
    chip.nack_next(1, after=int(part * count[0]))
    with pytest.raises(
        MpuDmpError, match=r"(loading|reading back) the DMP's bank \d+ at 0x.*EIO|5"
    ):
        dmp.configure()
    assert not dmp.read() & FRESH and dmp.health() == HEALTH_OK
    dmp.configure()  # nothing stays behind
    assert chip.dmp.running and sum(f & 1 for f in ticks(dmp, 100)) > 40


def test_a_chip_that_is_not_there_is_the_drivers_own_error():
    machine.wire_i2c(0, MPU6050Chip(StillWorld(), address=0x69))
    dmp = MpuDmp(MPU6050(machine.I2C(0), 0x68), V612, accept_unknown=True)
    with pytest.raises(MPU6050Error, match="no MPU6050 at 0x68"):
        dmp.configure()


# -- does it run?


def refused(dead=None, image=V612, **options):
    _, imu = wired(V612, dmp_dead=dead, **options)
    with pytest.raises(MpuDmpError) as caught:
        MpuDmp(imu, image, accept_unknown=True).configure()
    assert "take a filter in software" in str(caught.value)
    return str(caught.value)


def test_a_dmp_that_gives_nothing_is_found_out():
    assert "gave no packet in" in refused("silent")
    assert kernel.now() < 1_500_000


def test_packets_that_never_change_are_found_out():
    assert "repeats one packet for ever" in refused("frozen")


def test_packets_of_zeros_are_found_out():
    assert "gives no packets of 28 bytes with a unit quaternion" in refused("zero")


def test_the_part_that_answers_0x98_is_named():
    message = refused(who_am_i=0x98)
    assert "ICM-20689 (WHO_AM_I 0x98), whose DMP is known not to work" in message


def test_an_image_that_this_dmp_does_not_run_is_found_out():
    """One byte of the user's file is wrong, and that was accepted: memory reads back well, but nothing comes."""
    flipped = bytearray(V612)
    flipped[2000] ^= 0x40
    assert "gave no packet in" in refused(image=bytes(flipped))


def test_the_same_parts_run_when_nothing_is_broken():
    chip, imu = wired(who_am_i=0x70)
    MpuDmp(imu, V612, accept_unknown=True).configure()
    assert chip.dmp.running


# -- rates


@pytest.mark.parametrize("spi", [False, True], ids=["I2C", "SPI"])
@pytest.mark.parametrize("rate", [10, 20, 25, 40, 50, 100, 200])
def test_every_rate_gives_so_many_packets(rate, spi):
    chip, dmp = running(V612, spi, rate_hz=rate)
    assert dmp.sample_rate == dmp.rate == (rate, 1)
    chip.dmp.packets = 0
    begun = kernel.now()
    flags = ticks(dmp, 2400, 1000)
    packets = rate * (kernel.now() - begun) / 1e6
    assert abs(chip.dmp.packets - packets) <= 1
    assert abs(sum(f & 1 for f in flags) - packets) <= 1
    assert dmp.skipped + dmp.misaligned + dmp.errors + dmp.stalls == 0


@pytest.mark.parametrize(
    "rate, message",
    [
        (30, "30 does not divide 200; next to it are 25 and 40"),
        (150, "next to it are 100 and 200"),
        (400, "400 is not 10 to 200"),
        (9, "9 is not 10 to 200"),
        (8, "8 is not"),
        (0, "0 is not"),
        (100.0, "100.0 is not"),
        ("fast", "'fast' is not"),
    ],
)
def test_a_rate_that_cannot_be_is_refused(rate, message):
    _, imu = wired()
    with pytest.raises(ValueError, match=message):
        MpuDmp(imu, V612, rate, accept_unknown=True)


# -- packets


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_words_of_a_packet_are_the_chips(image):
    world = StillWorld((500, -600, 700, 10, -20, 30, 0, 0, 0, -521))
    _, dmp = running(image, world=world)
    ticks(dmp, 3, 10_000)
    per_g = dmp.accel_lsb_per_g // 4096
    assert list(dmp.counts)[:6] == [500 * per_g, -600 * per_g, 700 * per_g, 10, -20, 30]
    assert dmp.counts[10] == FRESH
    assert dmp.counts[9] == -521 and dmp.temperature_cdeg() == 3500


@pytest.mark.parametrize(
    "counts, flags",
    [
        ((0, 0, 8191), 1),
        ((0, 0, 8192), 5),
        ((-8192, 0, 0), 5),
        ((0, 0, 4096, 32767), 9),
        ((0, 0, 4096, 0, -32768, 0), 9),
        ((0, 9000, 4096, 0, 0, -32768), 13),
    ],
)
@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_full_scale_is_flagged(image, counts, flags):
    _, dmp = running(image, world=StillWorld(counts))
    assert ticks(dmp, 4, 10_000)[-1] == flags == dmp.counts[10]


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_the_quaternion_is_the_packets_in_q30_and_in_q29(image):
    chip, dmp = running(image)
    ticks(dmp, 10)
    raw = bytes(dmp.fifo.buffer[6 : 6 + dmp.image.packet])
    wanted = [int.from_bytes(raw[i : i + 4], "big", signed=True) for i in (0, 4, 8, 12)]
    q30, q29 = array("i", [0] * 4), array("i", [0] * 4)
    dmp.q30(q30)
    dmp.quaternion(q29)
    assert list(q30) == wanted
    assert list(q29) == [(v + 1) >> 1 for v in wanted]
    assert list(dmp.state[dmp.QUATERNION : dmp.QUATERNION + 4]) == list(q29)
    assert sum(v * v for v in dmp.quaternion_floats()) == pytest.approx(1)
    assert chip.misuse == []


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
@pytest.mark.parametrize("spi", [False, True], ids=["I2C", "SPI"])
def test_the_attitude_is_the_worlds_true_one(image, spi, tmp_path):
    rendered = motions.render("hand", rate=(200, 1), seconds=12, errors=None, accel_range_g=2)
    rendered.write(tmp_path / "world.imu", truth=True)
    chip, dmp = running(image, spi, World(str(tmp_path / "world.imu")))
    rows = []
    sample = chip.dmp.sample

    def noted(k):
        packet = sample(k)
        if packet:
            rows.append(k)
        return packet

    chip.dmp.sample = noted
    start = None
    fresh = 0
    for _ in range(1100):
        kernel.advance(10_000)
        if dmp.read() & FRESH:
            behind = chip.fifo_count // dmp.image.packet  # what came in during the burst
            q, truth = quaternion(dmp), rendered.q_true[rows[-1 - behind]]
            if start is None:
                start = motions.multiply(truth, q * [1, -1, -1, -1])
            assert angle(motions.multiply(start, q), truth) < 0.0001
            fresh += 1
    assert fresh > 1000
    # the DMP begins with yaw 0: all that is between the two is a turn about up
    assert abs(start[1]) + abs(start[2]) < 1e-6


def test_without_a_truth_the_attitude_is_still_level():
    _, dmp = running(world=StillWorld((0, 2896, 2896)))
    ticks(dmp, 10)
    angles = array("i", [0, 0, 0])
    dmp.angles(angles)
    assert abs(angles[0] - 45_000) < 20 and abs(angles[1]) < 20


# -- axes of the board

MAPS = [
    (x, y, z)
    for x in ("x", "-x", "y", "-y", "z", "-z")
    for y in ("x", "-x", "y", "-y", "z", "-z")
    for z in ("x", "-x", "y", "-y", "z", "-z")
]


def matrix(axes):
    m = np.zeros((3, 3))
    for i, name in enumerate(axes):
        m[i, "xyz".index(name[-1])] = -1 if name[0] == "-" else 1
    return m


def test_every_map_that_does_not_mirror_is_taken_and_no_other():
    _, imu = wired()
    taken = 0
    for axes in MAPS:
        if round(np.linalg.det(matrix(axes))) == 1:
            MpuDmp(imu, V612, accept_unknown=True, axes=axes)
            taken += 1
        else:
            with pytest.raises(ValueError, match=r"mirror|once each"):
                MpuDmp(imu, V612, accept_unknown=True, axes=axes)
    assert taken == 24
    for axes in (("x", "y"), ("x", "y", "w"), ("xx", "y", "z"), ("x", "y", "")):
        with pytest.raises(ValueError, match="once each"):
            MpuDmp(imu, V612, accept_unknown=True, axes=axes)


@pytest.mark.parametrize(
    "axes", [axes for axes in MAPS if round(np.linalg.det(matrix(axes))) == 1], ids="".join
)
def test_the_quaternion_is_the_bodys_whatever_the_map(axes):
    """Up as the body sees it is up as the chip sees it, through the map; and yaw begins at 0."""
    up = np.array([1000.0, 2000, 3000])
    _, dmp = running(axes=axes, world=StillWorld(tuple(int(v) for v in up)))
    angles = array("i", [0, 0, 0])
    dmp.angles(angles)
    if axes != ("x", "y", "z"):
        assert abs(angles[2]) < 5
    ticks(dmp, 5)
    w, x, y, z = quaternion(dmp)
    assert math.sqrt(w * w + x * x + y * y + z * z) == pytest.approx(1, abs=1e-4)
    seen = [2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z]
    wanted = matrix(axes) @ up / np.linalg.norm(up)
    assert np.abs(np.array(seen) - wanted).max() < 2e-4
    assert list(dmp.counts)[:3] == [4000, 8000, 12000]  # counts stay the chip's


def test_the_body_turns_as_the_chip_does_through_the_map():
    """Yaw of a turn about up, with the chip on its side."""
    axes = ("z", "y", "-x")  # the chip's -x is up
    world = StillWorld((-4096, 0, 0, -16 * 90, 0, 0))
    _, dmp = running(axes=axes, world=world)
    before, after = array("i", [0, 0, 0]), array("i", [0, 0, 0])
    ticks(dmp, 2, 10_000)
    dmp.angles(before)
    begun = kernel.now()
    ticks(dmp, 50, 10_000)
    dmp.angles(after)
    turned = (after[2] - before[2]) % 360_000
    assert turned / 1000 == pytest.approx(16 * 90 / 16.4 * (kernel.now() - begun) / 1e6, abs=2)


# -- faults


def test_a_slow_reader_gets_the_newest_and_the_others_are_counted():
    chip, dmp = running(rate_hz=200)
    ticks(dmp, 20)
    before = chip.dmp.packets
    skipped = dmp.skipped
    flags = ticks(dmp, 50, 15_000)
    assert all(f & 1 for f in flags)
    new = chip.dmp.packets - before
    assert dmp.skipped - skipped == pytest.approx(new - 50, abs=1) and new > 140
    assert dmp.fifo_overflows == dmp.misaligned == 0


def test_after_a_pause_several_calls_catch_up():
    _, dmp = running(rate_hz=200, batch=4)
    ticks(dmp, 20)
    kernel.advance(100_000)
    levels = []
    while True:
        assert dmp.read() & 1
        levels.append(dmp.fifo_level)
        if not dmp.fifo_level:
            break
    assert levels[0] > 10 and len(levels) in (5, 6)


@pytest.mark.parametrize("spi", [False, True], ids=["I2C", "SPI"])
@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_an_overflow_is_counted_and_left_behind(image, spi):
    chip, dmp = running(image, spi, rate_hz=200)
    ticks(dmp, 20)
    kernel.advance(500_000)
    chip.poll(kernel.now())
    assert chip.fifo_count == chip.fifo.size
    flags = ticks(dmp, 40)
    assert not flags[0] & 1 and dmp.fifo_overflows == 1 and dmp.fifo_lost >= 10
    assert sum(f & 1 for f in flags[2:]) > 30
    assert dmp.errors == dmp.stalls == 0 and not dmp.needs_reload


class Slipped:
    """Bytes that go astray between the FIFO and the driver."""

    def __init__(self, chip):
        self.chip = chip

    def lose(self, n):
        self.chip.poll(kernel.now())
        for _ in range(n):
            self.chip.fifo.pop()


@pytest.mark.parametrize("lost", [1, 2, 3, 4, 8, 12, 14, 16, 22, 27])
@pytest.mark.parametrize("counts", [(900, -2300, 3100, 500, -700, 300), (0, 0, 4096)], ids=range(2))
@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_a_boundary_that_has_shifted_gives_no_wrong_packet_and_is_mended(image, counts, lost):
    """Nothing tells of it but the count. At rest and level a packet shifted by 12 bytes of 28 would pass: z of the
    accelerometer is 1.0 of a quaternion."""
    chip, dmp = running(image, world=StillWorld(counts))
    ticks(dmp, 20)
    good = quaternion(dmp)
    kernel.advance(50_000)
    Slipped(chip).lose(lost)
    fresh = 0
    for _ in range(60):
        fresh += ticks(dmp, 1)[0] & 1
        now = quaternion(dmp)
        assert angle(now, good) < 8  # it turns, 50 deg/s; it does not jump
        good = now
    assert dmp.misaligned >= 1 and dmp.fifo_resets >= 2 and fresh >= 15
    assert not dmp.needs_reload


def test_without_waiting_for_the_rest_of_a_packet_a_shifted_one_would_pass():
    chip, dmp = running(world=StillWorld((0, 0, 4096)))
    ticks(dmp, 20)
    dmp._partial = lambda fraction: (
        dmp.fifo.drain(1, 0) and mpu_dmp._parse(dmp.fifo.buffer, 2, dmp.state, dmp.counts)
    )
    kernel.advance(50_000)
    Slipped(chip).lose(12)
    good = quaternion(dmp)
    assert ticks(dmp, 1)[0] & 1 and angle(quaternion(dmp), good) > 90


def test_an_overflow_whose_flag_somebody_has_cleared_is_left_behind_too():
    chip, dmp = running(rate_hz=200, world=StillWorld((0, 0, 4096)))
    ticks(dmp, 20)
    good = quaternion(dmp)
    kernel.advance(500_000)
    dmp._imu.read_register(0x3A)
    chip.nack_next(0)
    resets = dmp.fifo_resets
    flags = []
    for _ in range(40):
        flags += ticks(dmp, 1)
        assert angle(quaternion(dmp), good) < 0.1
    assert dmp.fifo_resets == resets + 1 and sum(f & 1 for f in flags) > 30


@given(
    plan=plans,
    byte_us=st.sampled_from([0, 7, 30]),
    version=st.sampled_from(sorted(IMAGES)),
    health=st.booleans(),
    restart_us=st.sampled_from([0, 20_000]),
)
@settings(max_examples=40, deadline=None)
def test_no_wrong_packet_whatever_happens_between_any_two_transactions(
    plan, byte_us, version, health, restart_us
):
    """At rest and level, where a shifted packet looks best."""
    machine.power_on()
    image = IMAGES[version]
    chip, dmp = running(
        image, world=StillWorld((0, 0, 4096)), chip={"fifo_byte_us": byte_us}, rate_hz=200
    )
    chip.power_up_us = restart_us
    bus = Hostile(chip, kernel.now(), plan)
    dmp._imu.registers.bind(bus)
    wanted = [0, 0, dmp.accel_lsb_per_g, 0, 0, 0]

    def step():
        flags = dmp.read()
        if flags & 1:
            assert list(dmp.counts)[:6] == wanted
            assert np.abs(quaternion(dmp) - [1, 0, 0, 0]).max() < 1e-4
        if health:
            dmp.health()
        bus.now += 1000
        return flags & 1

    while bus.plan:
        step()
    # and afterwards it always finds back, if need be with the main loop's help
    chip.nack_next(0)
    for _ in range(100):
        step()
    kernel.advance(max(0, bus.now - kernel.now()))
    dmp._imu.registers.bind(machine.I2C(0))
    if dmp.needs_reload or not chip.dmp.running:
        dmp.reload()
    # at another pace than the packets': never twice within the writing of one
    assert sum(f & 1 for f in ticks(dmp, 60, 3700)) > 20


def test_a_packet_that_comes_byte_by_byte_is_waited_for():
    chip, dmp = running(chip={"fifo_byte_us": 60})
    partial = 0
    for i in range(300):
        kernel.advance(4000 + i % 11 * 300)
        partial += chip.fifo_count % 28 != 0
        dmp.read()
        dmp.health()
    assert partial > 10 and dmp.misaligned == dmp.fifo_lost == 0


@pytest.mark.parametrize("after", range(9))
def test_a_nack_is_counted_and_survived(after):
    chip, dmp = running(rate_hz=200)
    ticks(dmp, 20)
    kernel.advance(10_000)
    chip.nack_next(1, after=after)
    for _ in range(3):
        dmp.read()
    assert dmp.errors == 1 and dmp.counts[10] in (0, 1)
    flags = ticks(dmp, 40)
    assert sum(f & 1 for f in flags) > 35 and dmp.errors == 1
    assert dmp.misaligned <= 1 and not dmp.needs_reload


def test_a_bus_that_fails_for_a_while_costs_no_more_than_that():
    chip, dmp = running(rate_hz=200)
    ticks(dmp, 20)
    chip.vanish()
    flags = ticks(dmp, 100)
    assert not any(f & 1 for f in flags) and dmp.errors >= 100
    chip.come_back()
    flags = ticks(dmp, 200)
    if dmp.needs_reload:  # it was silent for long
        dmp.reload()
        flags = ticks(dmp, 200)
    assert sum(f & 1 for f in flags) > 150


@pytest.mark.parametrize("spi", [False, True], ids=["I2C", "SPI"])
@pytest.mark.parametrize("restart_us", [0, 20_000])
def test_a_brown_out_wipes_the_memory_and_the_main_loop_loads_it_again(spi, restart_us):
    chip, dmp = running(spi=spi)
    ticks(dmp, 50)
    chip.power_up_us = restart_us
    chip.brown_out(kernel.now())
    chip.log = []
    flags = ticks(dmp, 200)
    assert dmp.needs_reload and dmp.resets + dmp.stalls >= 1
    assert not any(f & 1 for f in flags[20:])
    assert not [r for _, r, _ in chip.log if 0x6D <= r <= 0x71]  # the tick loads nothing
    assert not chip.register(0x6A) & 0x80  # and does not start a program that is gone
    dmp.reload()
    assert not dmp.needs_reload and dmp.reloads == 1 and chip.dmp.running
    flags = ticks(dmp, 200)
    assert sum(f & 1 for f in flags) > 90 and not dmp.needs_reload
    assert dmp.health() == HEALTH_OK


def test_memory_that_changes_while_it_runs_silences_it_and_is_found_out():
    chip, dmp = running()
    ticks(dmp, 50)
    chip.dmp.poke(1234, chip.dmp.memory[1234] ^ 1)
    ticks(dmp, 100)
    assert dmp.needs_reload and dmp.stalls == 1 and dmp.resets == 0
    dmp.reload()
    assert sum(f & 1 for f in ticks(dmp, 100)) > 45


def test_a_long_pause_of_the_tick_is_no_stall():
    _, dmp = running()
    ticks(dmp, 20)
    kernel.advance(5_000_000)
    dmp.health()
    flags = ticks(dmp, 100)
    assert dmp.stalls == 0 and not dmp.needs_reload and sum(f & 1 for f in flags) > 40


def test_a_reload_that_fails_can_be_tried_again():
    chip, dmp = running()
    chip.brown_out(kernel.now())
    ticks(dmp, 50)
    chip.vanish()
    with pytest.raises(OSError):
        dmp.reload()
    assert dmp.needs_reload and not dmp.read() & 1
    chip.come_back()
    dmp.reload()
    assert sum(f & 1 for f in ticks(dmp, 100)) > 45


def test_a_tick_that_cuts_into_a_reload_leaves_the_bus_alone():
    chip, dmp = running()
    real = dmp._imu.registers.write_from
    seen = []

    def cut(buffer):
        before = machine.I2C(0)._bus.bytes
        seen.append((dmp.read() & 1, dmp.health(), machine.I2C(0)._bus.bytes - before))
        real(buffer)

    dmp._imu.registers.write_from = cut
    dmp.reload()
    assert len(seen) > 300 and set(seen) == {(0, HEALTH_OK, 0)}
    assert chip.dmp.running


# -- as a filter


def test_it_has_the_filters_interface():
    _, dmp = running()
    out = array("i", [9, 9, 9])
    assert (dmp.NAME, dmp.AXES, dmp.seed(dmp.counts)) == ("dmp6", 6, False)
    dmp.set_bias(0, 0, 0)
    for f in (dmp.bias, dmp.bias_mdps):
        f(out)
        assert list(out) == [0, 0, 0]
    with pytest.raises(ValueError, match=r"bias is \(1, 0, 0\): the DMP removes"):
        dmp.set_bias(1, 0, 0)
    with pytest.raises(ValueError, match="cannot be set"):
        dmp.set_quaternion(1, 0, 0, 0)
    before = list(dmp.state)
    dmp.update(dmp.counts)
    assert list(dmp.state) == before


@pytest.mark.parametrize("batch", [0, 19, "many"])
def test_a_batch_that_the_fifo_cannot_hold_is_refused(batch):
    _, imu = wired()
    with pytest.raises(ValueError, match="is not 1 to 18"):
        MpuDmp(imu, V612, accept_unknown=True, batch=batch)


# -- 32 bits


@pytest.fixture(scope="module")
def checked():
    """(watch, modules) with checked viper functions; at the end nothing may have gone unexercised."""
    watch = overflow.Watch()
    names = ("fixmath.py", "mpu_monitor.py", "mpu_fifo.py", "dmp.py")
    return watch, overflow.loaded([LIB / name for name in names], watch)


def packet_of(words, size, fill):
    packet = bytearray(b"".join(v.to_bytes(4, "big", signed=True) for v in words))
    packet += bytes(fill() for _ in range(size - 16))
    assert len(packet) == size
    return packet


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
@pytest.mark.parametrize("axes", [("x", "y", "z"), ("z", "-y", "x"), ("y", "z", "x")], ids="".join)
def test_no_intermediate_leaves_32_bits_whatever_is_in_a_packet(checked, image, axes):
    watch, modules = checked
    dmp = modules["dmp"].MpuDmp(MPU6050(machine.I2C(0)), image, accept_unknown=True, axes=axes)
    rng = random.Random(3)
    good = 0
    for k in range(600):
        v = [rng.choice((rng.gauss(0, 1), 0, -1, 1)) for _ in range(4)]
        if not any(v):
            v[k % 4] = 1
        r = math.sqrt(sum(x * x for x in v)) * rng.choice((0.993, 0.9999, 1, 1.0001, 1.007))
        words = [min(max(round(x / r * ONE), -2 * ONE), 2 * ONE - 1) for x in v]
        if k % 3 == 0:  # nonsense
            words = [rng.choice((-2 * ONE, 2 * ONE - 1, rng.randint(-ONE, ONE))) for _ in range(4)]
        elif k % 3 == 1:  # the largest remainders
            words = [(w >> 16 << 16) + rng.choice((0x7FFF, 0x8000, 0xFFFF, 0)) for w in words]
        c = math.cos(k), math.sin(k)
        dmp._set_yaw(*(round(32768 * x) for x in c))
        raw = packet_of(words, dmp.image.packet, lambda: rng.choice((0, 0x7F, 0x80, 0xFF)))
        before = list(dmp.state)
        flags = modules["dmp"]._parse(raw, 0, dmp.state, dmp.counts)
        length = sum((w / ONE) ** 2 for w in words)
        assert (flags >= 0) is (abs(length - 1) < 1 / 64) or abs(abs(length - 1) - 1 / 64) < 1e-3
        if flags < 0:
            assert list(dmp.state) == before  # nothing of it is taken
            continue
        good += 1
        modules["dmp"]._turn(dmp._s)
        q = [w / 2**29 for w in dmp.state[1:5]]
        assert math.sqrt(sum(x * x for x in q)) == pytest.approx(math.sqrt(length), abs=2e-4)
    assert good > 300
    assert {"dmp._parse", "dmp._turn"} <= watch.called


def test_an_unjudged_packet_would_overflow(checked):
    """The twin: _turn is safe only with what _parse has let through."""
    _, modules = checked
    dmp = modules["dmp"].MpuDmp(
        MPU6050(machine.I2C(0)), V612, accept_unknown=True, axes=("z", "-y", "x")
    )
    for i in range(4):
        dmp.state[5 + i] = 2 * ONE - 1 if dmp.state[14 + i] > 0 else -2 * ONE
    for i in range(16):
        dmp.state[14 + i] = 32768 if dmp.state[14 + i] > 0 else -32768
    dmp.state[5:9] = array("i", [2 * ONE - 1 if t > 0 else -2 * ONE for t in dmp.state[14:18]])
    with pytest.raises(overflow.Overflow):
        modules["dmp"]._turn(dmp._s)


# -- every runtime


def test_the_story_is_the_same_on_every_runtime(portable, micropython_runtime):
    assert portable(micropython_runtime, "dmp_story.py") == portable("cpython", "dmp_story.py")


def test_packets_have_the_same_bits_on_every_runtime(portable, micropython_runtime):
    assert portable(micropython_runtime, "dmp_history.py") == portable("cpython", "dmp_history.py")


def test_the_tick_allocates_nothing(portable, micropython_runtime):
    out = portable(micropython_runtime, "dmp_alloc.py")
    assert out.count(": ok 0 ") == 8 and out.count("found") == 2
