"""The simulated chips' DMP: memory in banks, what it runs and what not, and its packets."""

import math

import kernel
import motions
import numpy as np
import pytest
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from dmp_images import IMAGES, LIST, V20, V612
from world import StillWorld, World, write_imu

BANK_SEL, MEM_R_W, START, USER_CTRL = 0x6D, 0x6F, 0x70, 0x6A
STARTS = {3062: 0x0400, 1929: 0x0300}


def write(chip, register, *data):
    now = kernel.now()
    assert chip.i2c_start(False, now) and chip.i2c_write(register, now)
    for byte in data:
        assert chip.i2c_write(byte, now)
    chip.i2c_stop(now)


def read(chip, register, n):
    now = kernel.now()
    assert chip.i2c_start(False, now) and chip.i2c_write(register, now)
    assert chip.i2c_start(True, now)
    data = bytes(chip.i2c_read(now) for _ in range(n))
    chip.i2c_stop(now)
    return data


def put(chip, address, data):
    write(chip, BANK_SEL, address >> 8, address & 0xFF)
    write(chip, MEM_R_W, *data)


def get(chip, address, n):
    write(chip, BANK_SEL, address >> 8, address & 0xFF)
    return read(chip, MEM_R_W, n)


def load(chip, image):
    size = 3062 if len(image) >= 3062 else 1929
    for at in range(0, size, 16):
        put(chip, at, image[at : min(at + 16, size)])
    at = size
    while at < len(image):
        bank, offset, n = image[at : at + 3]
        if n:
            put(chip, bank << 8 | offset, image[at + 3 : at + 3 + n])
        at += 3 + (n or 1)
    write(chip, START, STARTS[size] >> 8, STARTS[size] & 0xFF)


def loaded(image=V612, kind=MPU6050Chip, world=None, divider=0, **options):
    """An awake chip at 200 Hz with an image in its memory, neither DMP nor FIFO on."""
    chip = kind(world or StillWorld((0, 0, 4096)), **options)
    chip.dmp.images.append(image)
    write(chip, 0x6B, 1)
    write(chip, 0x1A, 2)
    write(chip, 0x19, 4)
    load(chip, image)
    put(chip, 0x216, (divider >> 8, divider & 0xFF))
    kernel.advance(60_000)  # the gyro settles
    return chip


def after(chip, us, user_ctrl=0xC0):
    """Bytes in the FIFO after so long with the DMP running."""
    write(chip, USER_CTRL, user_ctrl & 0x80)
    write(chip, USER_CTRL, user_ctrl & 0x80 | 0x04)
    write(chip, USER_CTRL, user_ctrl)
    kernel.advance(us)
    high, low = read(chip, 0x72, 2)
    return high << 8 | low


# -- memory


@pytest.mark.parametrize("kind", [MPU6050Chip, MPU6500Chip])
def test_memory_keeps_what_is_written_in_every_bank(kind):
    chip = kind(StillWorld())
    write(chip, 0x6B, 1)
    for bank in range(12):
        put(chip, bank << 8, bytes((i * 7 + bank * 31) & 255 for i in range(256)))
    for bank in range(12):
        assert get(chip, bank << 8, 256) == bytes((i * 7 + bank * 31) & 255 for i in range(256))
    assert get(chip, 0x345, 3) == bytes((i * 7 + 93) & 255 for i in (0x45, 0x46, 0x47))
    assert chip.misuse == []


def test_an_access_across_a_bank_stays_in_it_and_is_misuse():
    chip = MPU6050Chip(StillWorld())
    write(chip, 0x6B, 1)
    put(chip, 0x1FF, b"\x01")
    assert chip.misuse == []
    put(chip, 0x1FF, b"\x05\x06")
    assert get(chip, 0x1FF, 1) == b"\x05" and get(chip, 0x100, 1) == b"\x06"
    assert get(chip, 0x200, 1) == b"\x00"
    assert chip.misuse == ["DMP memory accessed across a bank"]


def test_memory_beyond_its_end_and_asleep_is_misuse():
    chip = MPU6050Chip(StillWorld())
    put(chip, 0, b"\x01")
    assert chip.misuse == ["DMP memory written asleep"] and get(chip, 0, 1) == b"\x00"
    write(chip, 0x6B, 1)
    put(chip, 0xC00, b"\x01")
    assert chip.misuse[-1] == "DMP memory beyond its end" and get(chip, 0xC00, 1) == b"\x00"


def test_a_reset_wipes_memory_and_stops_the_dmp():
    for reset in ("register", "brown-out"):
        chip = loaded()
        assert after(chip, 100_000)
        if reset == "register":
            write(chip, 0x6B, 0x80)
        else:
            chip.brown_out(kernel.now())
        kernel.advance(50_000)
        assert not chip.dmp.running and not any(chip.dmp.memory)


# -- what it runs


@pytest.mark.parametrize("image", [V612, V612 + LIST, V20, V20 + LIST], ids=range(4))
@pytest.mark.parametrize("kind", [MPU6050Chip, MPU6500Chip])
def test_an_image_that_it_was_given_runs(image, kind):
    chip = loaded(image, kind)
    length = 28 if len(image) >= 3062 else 42
    assert after(chip, 27_000) == 5 * length


def test_an_image_that_it_was_not_given_does_not_run():
    chip = loaded()
    chip.dmp.images.clear()
    assert after(chip, 500_000) == 0
    chip.dmp.images += [V20, V612[:-1] + b"?"]
    assert after(chip, 500_000) == 0


@pytest.mark.parametrize("at", [0, 0x215, 0x218, 1700, 3061])
def test_one_wrong_byte_is_enough_for_silence(at):
    chip = loaded()
    chip.dmp.poke(at, V612[at] ^ 1)
    assert after(chip, 500_000) == 0
    chip.dmp.poke(at, V612[at])
    assert after(chip, 27_000) == 140


def test_a_list_that_is_missing_is_enough_too():
    chip = loaded(V20)
    chip.dmp.images[:] = [V20 + LIST]
    assert after(chip, 500_000) == 0


def test_another_program_start_is_silence():
    chip = loaded()
    write(chip, START, 3, 0)
    assert after(chip, 500_000) == 0


@pytest.mark.parametrize("user_ctrl, expected", [(0xC0, 140), (0x40, 0), (0x80, 0), (0x00, 0)])
def test_both_the_dmp_and_the_fifo_have_to_be_on(user_ctrl, expected):
    assert after(loaded(), 27_000, user_ctrl) == expected


def test_memory_that_changes_stops_it_at_once():
    chip = loaded()
    assert after(chip, 27_000) == 140
    put(chip, 1700, bytes((V612[1700] ^ 1,)))
    kernel.advance(100_000)
    assert read(chip, 0x72, 2) == b"\x00\x8c"


@pytest.mark.parametrize("divider, packets", [(0, 200), (1, 100), (4, 40), (19, 10)])
def test_the_divider_sets_the_rate(divider, packets):
    chip = loaded(divider=divider)
    after(chip, 1_000_000)
    assert chip.dmp.packets == packets


def test_it_rides_on_the_sample_rate():
    chip = loaded()
    write(chip, 0x19, 9)
    after(chip, 1_000_000)
    assert chip.dmp.packets == 100


# -- packets


def packets_of(chip, length, n):
    data = read(chip, 0x74, length * n)
    return [data[i * length : (i + 1) * length] for i in range(n)]


def words(packet, at, n, step):
    return [
        int.from_bytes(packet[at + i * step : at + i * step + 2], "big", signed=True)
        for i in range(n)
    ]


def q_of(packet):
    return np.array(
        [int.from_bytes(packet[i : i + 4], "big", signed=True) / 2**30 for i in (0, 4, 8, 12)]
    )


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_a_packet_has_quaternion_accel_and_gyro_in_their_places(image):
    chip = loaded(image, world=StillWorld((500, -600, 700, 10, -20, 30)))
    write(chip, 0x1B, 0x18)
    length = 28 if image is V612 else 42
    after(chip, 27_000)
    for packet in packets_of(chip, length, 5):
        if image is V612:
            assert words(packet, 16, 3, 2) == [2000, -2400, 2800]
            assert words(packet, 22, 3, 2) == [10, -20, 30]
        else:
            assert words(packet, 16, 3, 4) == [10, -20, 30]
            assert words(packet, 28, 3, 4) == [1000, -1200, 1400]
        assert np.linalg.norm(q_of(packet)) == pytest.approx(1, abs=1e-7)


def test_no_two_packets_are_the_same():
    chip = loaded()
    after(chip, 82_000)
    packets = packets_of(chip, 28, 16)
    assert len(set(packets)) == 16


def angle(p, q):
    e = motions.multiply(np.array(p) * [1, -1, -1, -1], np.array(q))
    return math.degrees(2 * math.atan2(np.linalg.norm(e[1:]), abs(e[0])))


@pytest.mark.parametrize("truth", [True, False])
def test_the_attitude_follows_the_world(truth, tmp_path):
    """With a truth to the last bit, from the gyro's words as well as these go."""
    rendered = motions.render("slow", seconds=20, errors=None)
    path = tmp_path / "world.imu"
    rendered.write(path, truth=truth)
    world = World(str(path))
    chip = loaded(world=world)
    write(chip, 0x1B, 0x18)
    world.start(kernel.now())
    after(chip, 1)
    start = None
    worst = 0
    for _ in range(350):
        kernel.advance(50_000)
        high, low = read(chip, 0x72, 2)
        n = (high << 8 | low) // 28
        q = q_of(packets_of(chip, 28, n)[-1])
        true = rendered.q_true[chip._sample_row]
        if start is None:
            start = motions.multiply(true, q * [1, -1, -1, -1])
        worst = max(worst, angle(motions.multiply(start, q), true))
    assert worst < (1e-4 if truth else 1)
    assert world.truth(0) is None or truth


def test_an_overflow_shifts_the_boundary_as_any_fifos():
    chip = loaded(world=StillWorld((0, 3000, 3000)))
    write(chip, 0x38, 0x10)
    assert after(chip, 1_000_000) == 1024
    assert read(chip, 0x3A, 1)[0] & 0x10
    packets = packets_of(chip, 28, 36)  # 1024 is no multiple of 28
    assert not any(np.linalg.norm(q_of(p)) == pytest.approx(1, abs=0.001) for p in packets)


@pytest.mark.parametrize("dead", ["silent", "frozen", "zero", "small"])
def test_a_broken_dmp_is_broken_in_its_own_way(dead):
    chip = loaded(dmp_dead=dead)
    count = after(chip, 52_000)
    if dead in ("silent", "small"):
        assert count == 0
        assert (get(chip, 0, 16) == V612[:16]) is (dead == "silent")
    else:
        packets = packets_of(chip, 28, 10)
        assert len(set(packets)) == 1 and any(packets[0]) is (dead == "frozen")


def test_the_part_0x98_has_a_dmp_that_does_not_run():
    assert after(loaded(who_am_i=0x98), 500_000) == 0
    assert after(loaded(who_am_i=0x70), 27_000) == 140


# -- the truth in a world's file


def test_a_world_without_a_truth_is_as_it_was(tmp_path):
    rendered = motions.render("hand", seconds=1)
    rendered.write(tmp_path / "a.imu")
    rendered.write(tmp_path / "b.imu", truth=True)
    a, b = (tmp_path / "a.imu").read_bytes(), (tmp_path / "b.imu").read_bytes()
    assert b"truth" not in a and len(b) - len(a) == 16 * rendered.n + len(b', "truth_every": 1')
    world = World(str(tmp_path / "b.imu"))
    before = list(world.row(10))
    got = np.array(world.truth(7)) / 2**30
    assert np.abs(got - rendered.q_true[7]).max() < 1e-9
    assert list(world.row(10)) == before and list(world.row(11)) == rendered.counts[11].tolist()
    assert World(str(tmp_path / "a.imu")).truth(0) is None


def test_a_truth_at_every_third_row_and_one_that_is_unknown(tmp_path):
    truth = np.array([[1, 2, 3, 4], [0, 0, 0, 0], [5, 6, 7, 8]], "<i4")
    path = tmp_path / "w.imu"
    write_imu(path, bytes(22 * 8), "w", (200, 1), 4096, (82, 5), False, truth.tobytes(), 3)
    world = World(str(path))
    assert [world.truth(k) and list(world.truth(k)) for k in (0, 2, 3, 5, 6, 7, 99)] == [
        [1, 2, 3, 4],
        [1, 2, 3, 4],
        None,
        None,
        [5, 6, 7, 8],
        [5, 6, 7, 8],
        [5, 6, 7, 8],
    ]


@pytest.mark.parametrize("length, every", [(0, 1), (16, 0), (16 * 7, 1), (16 * 8 + 1, 1)])
def test_a_truth_of_another_length_is_refused(length, every, tmp_path):
    args = ("w", (200, 1), 4096, (82, 5), False)
    with pytest.raises(ValueError, match=f"{length} bytes of truth for 8 rows"):
        write_imu(tmp_path / "w.imu", bytes(22 * 8), *args, bytes(length), every)


def test_a_file_cut_within_its_truth_is_refused(tmp_path):
    path = tmp_path / "w.imu"
    motions.render("static", seconds=1).write(path, truth=True)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match="truncated"):
        World(str(path))
