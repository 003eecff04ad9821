"""The simulated MPU6500 against its datasheet: SPI and its limits, resets, rates, what differs from the MPU6050."""

from itertools import pairwise

import kernel
import machine
import pytest
from bare_bus import COUNTS, Bus, Nack, Ramp, Spi
from chips.mpu6500 import MPU6500Chip
from world import StillWorld

SELF_TEST_X_GYRO, SELF_TEST_X_ACCEL = 0x00, 0x0D
SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, ACCEL_CONFIG2 = 0x19, 0x1A, 0x1B, 0x1C, 0x1D
FIFO_EN, INT_ENABLE, INT_STATUS, ACCEL_XOUT_H = 0x23, 0x38, 0x3A, 0x3B
SIGNAL_PATH_RESET, USER_CTRL, PWR_MGMT_1 = 0x68, 0x6A, 0x6B
FIFO_COUNTH, FIFO_R_W, WHO_AM_I, XA_OFFSET_H = 0x72, 0x74, 0x75, 0x77
I2C_IF_DIS = 0x10
WORDS = [10, -20, 4096, (-521 * 33387 // 34000) + 5182, 5, 6, -7]  # as they lie in 0x3B..0x48


def reset(bus):
    """The long one (RM, register 107; RM-MPU-6000A 4.26)."""
    bus.now += 100_000
    bus.write(PWR_MGMT_1, 0x80)
    bus.now += 100_000
    bus.write(SIGNAL_PATH_RESET, 0x07)
    bus.now += 100_000
    bus.write(USER_CTRL, I2C_IF_DIS)


def running(world=None, divider=0, dlpf=1, **options):
    """On SPI, reset and awake at +-8 g and +-2000 deg/s (the scales of StillWorld)."""
    bus = Spi(MPU6500Chip(world or StillWorld(COUNTS), **options))
    reset(bus)
    bus.write(PWR_MGMT_1, 0x01)
    bus.write(SMPLRT_DIV, divider, dlpf, 0x18, 0x10, 0x00)
    bus.now += 100_000
    return bus


# SPI


def test_it_is_identified_and_sampled_over_spi():
    bus = running()
    assert bus.read(WHO_AM_I) == 0x70
    assert bus.words()[:3] + bus.words()[4:] == WORDS[:3] + WORDS[4:]
    assert bus.chip.misuse == []


@pytest.mark.parametrize("mode, understood", [(0, True), (3, True), (1, False), (2, False)])
def test_only_modes_0_and_3_are_understood(mode, understood):
    bus = running()
    bus.write(SMPLRT_DIV, 7, mode=mode)
    assert (bus.read(SMPLRT_DIV) == 7) is understood
    assert (bus.read(WHO_AM_I, mode=mode) == 0x70) is understood
    assert (bus.chip.misuse == []) is understood


READ, WRITE = 0x80, 0


@pytest.mark.parametrize(
    "register, kind, hz, works",
    [
        (WHO_AM_I, READ, 1_000_000, True),
        (WHO_AM_I, READ, 1_312_500, False),
        (CONFIG, WRITE, 1_000_000, True),
        (CONFIG, WRITE, 1_312_500, False),
        (ACCEL_XOUT_H, WRITE, 20_000_000, False),
        (INT_STATUS, READ, 20_000_000, True),
        (ACCEL_XOUT_H + 4, READ, 20_000_000, True),
        (ACCEL_XOUT_H + 4, READ, 21_000_000, False),
        (0x60, READ, 20_000_000, True),
        (0x61, READ, 20_000_000, False),
        (FIFO_COUNTH, READ, 20_000_000, False),
        (FIFO_R_W, READ, 20_000_000, False),
    ],
)
def test_speed_limits(register, kind, hz, works):
    bus = running()
    bus.read(ACCEL_XOUT_H)
    if kind == READ:
        expected = bus.chip.register(register) if register != FIFO_R_W else 0
        assert (bus.read(register, hz=hz) == expected) is works
    else:
        bus.write(register, 3, hz=hz)
        assert (bus.chip.register(register) == 3) is works
    assert (bus.chip.misuse == []) is works


def test_a_fast_burst_that_runs_on_past_the_sensors_is_garbage_from_there():
    bus = running()
    good = bus.read(0x5E, 8)
    assert bus.chip.misuse == []
    fast = bus.read(0x5E, 8, hz=20_000_000)
    assert fast[:3] == good[:3] and fast[3:] != good[3:]
    assert bus.chip.misuse


def test_chip_select_ends_a_transaction():
    bus = running()
    chip = bus.chip
    chip.spi_select(True, bus.now)
    chip.spi_transfer(SMPLRT_DIV, bus.now, 1_000_000, 0)
    chip.spi_select(False, bus.now)
    bus.transfer(0x80 | WHO_AM_I, 0)  # an address again, not data for SMPLRT_DIV
    assert bus.read(SMPLRT_DIV) == 0
    assert bus.transfer(WHO_AM_I | 0x80, 0) == b"\xff\x70"


def test_unselected_it_does_not_listen():
    bus = running()
    bus.chip.spi_select(False, bus.now)
    assert bus.chip.spi_transfer(SMPLRT_DIV, bus.now, 1_000_000, 0) == 0xFF
    assert bus.chip.spi_transfer(9, bus.now, 1_000_000, 0) == 0xFF
    assert bus.read(SMPLRT_DIV) == 0


def test_a_burst_is_one_sample_even_when_the_next_one_comes_in_the_middle():
    world = Ramp()
    bus = running(world)
    world.start(bus.now)
    bus.now += 10_400
    data = bus.read(ACCEL_XOUT_H, 14, us_per_byte=100)
    assert {data[i : i + 2] for i in (0, 2, 4, 8, 10, 12)} == {bytes((0, 10))}
    assert bus.words()[0] == 11


def test_bursts_stay_on_the_fifo():
    bus = running()
    bus.write(FIFO_EN, 0x08)
    bus.write(USER_CTRL, 0x44 | I2C_IF_DIS)  # the MPU6500's FIFO_RESET works with FIFO_EN set
    bus.now += 1000
    assert bus.read(FIFO_COUNTH, 2) == bytes((0, 6))
    assert bus.read(FIFO_R_W, 6) == bytes((0, 10, 0xFF, 0xEC, 0x10, 0))
    assert bus.chip.misuse == []


def test_the_fifo_holds_512_bytes():
    bus = running()
    bus.write(FIFO_EN, 0x78)
    bus.write(INT_ENABLE, 0x11)
    bus.write(USER_CTRL, 0x44 | I2C_IF_DIS)
    bus.now += 42_000
    assert bus.read(FIFO_COUNTH, 2) == (504).to_bytes(2, "big")
    assert not bus.read(INT_STATUS) & 0x10
    bus.now += 1000
    assert bus.read(FIFO_COUNTH, 2) == (512).to_bytes(2, "big")
    assert bus.read(INT_STATUS) & 0x10


# Faults


def test_where_nobody_drives_the_line_the_master_reads_ff():
    bus = running()
    bus.chip.vanish()
    assert bus.read(ACCEL_XOUT_H, 4) == b"\xff" * 4
    bus.write(SMPLRT_DIV, 9)
    bus.chip.come_back()
    assert bus.read(SMPLRT_DIV) == 0
    assert bus.read(WHO_AM_I) == 0x70
    bus.chip.nack_next(2)
    assert [bus.read(WHO_AM_I) for _ in range(3)] == [0xFF, 0xFF, 0x70]
    bus.chip.stick(ACCEL_XOUT_H, 0x55)
    assert bus.read(ACCEL_XOUT_H) == 0x55


def test_a_chip_that_vanishes_in_a_burst_leaves_the_rest_high():
    bus = running()
    chip = bus.chip
    chip.spi_select(True, bus.now)
    chip.spi_transfer(0x80 | ACCEL_XOUT_H, bus.now, 20_000_000, 0)
    assert chip.spi_transfer(0, bus.now, 20_000_000, 0) == 0
    chip.vanish()
    assert chip.spi_transfer(0, bus.now, 20_000_000, 0) == 0xFF


def test_a_brown_out_is_a_reset_followed_by_silence():
    bus = running()
    bus.chip.brown_out(bus.now)
    assert bus.read(WHO_AM_I) == 0xFF
    bus.now += 100_000
    assert bus.read(WHO_AM_I) == 0x70
    assert (bus.read(PWR_MGMT_1), bus.read(ACCEL_CONFIG)) == (0x01, 0)


def test_writes_are_ignored_while_it_resets():
    bus = running()
    bus.write(PWR_MGMT_1, 0x80)
    bus.write(SMPLRT_DIV, 9)
    assert bus.read(PWR_MGMT_1) & 0x80
    bus.now += 100_000
    assert (bus.read(SMPLRT_DIV), bus.read(PWR_MGMT_1)) == (0, 0x01)


# What a driver on SPI must not forget


def test_i2c_if_dis_clears_itself_and_is_in_force_all_the_same():
    bus = running()
    assert bus.read(USER_CTRL) == 0
    for _ in range(100):
        bus.read(WHO_AM_I)
    assert bus.chip.misuse == []


def test_without_i2c_if_dis_spi_traffic_is_noted():
    bus = running()
    bus.write(USER_CTRL, 0)  # it is written away like any bit
    for _ in range(100):
        bus.read(WHO_AM_I)
    assert len(bus.chip.misuse) == 1 and "I2C_IF_DIS" in bus.chip.misuse[0]


def test_sampling_after_a_reset_without_signal_path_reset_is_noted():
    bus = running()
    bus.write(PWR_MGMT_1, 0x80)
    bus.now += 100_000
    bus.write(USER_CTRL, I2C_IF_DIS)
    bus.write(PWR_MGMT_1, 0x01)
    bus.now += 100_000
    assert bus.chip.misuse == []
    bus.words()
    assert len(bus.chip.misuse) == 1 and "SIGNAL_PATH_RESET" in bus.chip.misuse[0]
    reset(bus)
    bus.words()
    assert len(bus.chip.misuse) == 1


# The same on I2C


def test_on_i2c_it_is_an_mpu6050_of_another_identity():
    bus = Bus(MPU6500Chip(StillWorld(COUNTS)))
    bus.now += 100_000
    bus.write(PWR_MGMT_1, 0x80)
    bus.now += 100_000
    bus.write(SMPLRT_DIV, 0, 1, 0x18, 0x10)
    bus.now += 1000
    assert bus.read(WHO_AM_I) == 0x70
    assert bus.words() == running().words()
    assert bus.chip.misuse == []
    bus.write(USER_CTRL, I2C_IF_DIS)
    assert bus.chip.misuse
    with pytest.raises(Nack):
        bus.read(WHO_AM_I)


# Rates and sensors


@pytest.mark.parametrize(
    "dlpf, divider, fchoice_b, period",
    [
        (1, 0, 0, 1000),
        (6, 9, 0, 10_000),
        (0, 9, 0, 125),  # RM 4.4: the divider works with the filter only
        (7, 9, 0, 125),
        (1, 9, 1, 31.25),
        (1, 9, 2, 31.25),
    ],
)
def test_sample_rate(dlpf, divider, fchoice_b, period):
    bus = running(divider=divider, dlpf=dlpf)
    bus.write(GYRO_CONFIG, 0x18 | fchoice_b)
    bus.write(FIFO_EN, 0x80)
    bus.write(USER_CTRL, 0x44 | I2C_IF_DIS)
    bus.now += 6000
    bus.chip.poll(bus.now)
    assert abs(bus.chip.fifo_count // 2 - 6000 / period) <= 1


@pytest.mark.parametrize("bypassed, per_sample", [(0x00, 8), (0x08, 2)])
def test_the_accelerometer_runs_at_1_khz_and_at_4_without_its_filter(bypassed, per_sample):
    world = Ramp(clocked=False, rate=(8000, 1))
    bus = running(world, dlpf=0)
    bus.write(ACCEL_CONFIG2, bypassed)
    world.start(bus.now)
    seen = []
    for _ in range(64):
        bus.now += 125
        seen.append(bus.words()[0])
    steps = [b - a for a, b in pairwise(seen) if a != b]
    assert set(steps[1:-1]) == {per_sample}


def test_temperature_has_its_own_scale():
    celsius = -521 / 340 + 36.53  # what the world's word means
    assert running().words()[3] == round((celsius - 21) * 333.87)


def test_self_test_codes_and_responses_follow_the_formula():
    codes = (1, 100, 91, 128, 255, 125)
    for fs in range(4):
        bus = running(StillWorld((0, 0, 0)), trims=codes)
        assert bus.read(SELF_TEST_X_GYRO, 3) == bytes(codes[3:])
        assert bus.read(SELF_TEST_X_ACCEL, 3) == bytes(codes[:3])
        bus.write(GYRO_CONFIG, 0xE0 | fs << 3, 0xE0 | fs << 3)
        bus.now += 100_000
        words = bus.words()
        for axis in range(6):
            expected = min(2620 / 2**fs * 1.01 ** (codes[axis] - 1), 32767)
            assert abs(words[axis + axis // 3] - expected) <= 1


def test_a_broken_axis_does_not_react_to_self_test():
    bus = running(StillWorld((0, 0, 0)))
    bus.chip.broken = (1,)
    bus.write(ACCEL_CONFIG, 0xF0)
    bus.now += 1000
    words = bus.words()
    assert words[1] == 0 and words[0] > 500 and words[2] > 500


def test_accel_offsets_are_factory_values_that_a_reset_restores():
    bus = running(accel_offsets=(100, -100, 5000))
    assert bus.read(XA_OFFSET_H, 2) == (200).to_bytes(2, "big")
    assert bus.read(XA_OFFSET_H + 3, 2) == (-200 & 0xFFFF).to_bytes(2, "big")
    bus.write(XA_OFFSET_H, 0, 0)
    reset(bus)
    assert bus.read(XA_OFFSET_H, 2) == (200).to_bytes(2, "big")


def test_an_accel_offset_moves_the_output_by_0_98_mg_a_step():
    bus = running(accel_offsets=(0, 0, 0))
    bus.write(XA_OFFSET_H, *(100 << 1).to_bytes(2, "big"))
    bus.now += 1000
    assert bus.words()[0] == 10 + int(0.098 * 4096)
    assert bus.words()[1] == -20


# On a board


def test_on_the_simulated_board_with_a_chip_select_and_an_interrupt_pin():
    machine.power_on()
    kernel.advance(100_000)
    chip = MPU6500Chip(StillWorld(COUNTS), now=kernel.now())
    machine.wire_spi(5, chip, cs="PF6")
    machine.wire_pin("PB8", chip)
    spi, cs = machine.SPI(5, baudrate=1_000_000), machine.Pin("PF6", machine.Pin.OUT, value=1)

    def write(*values):
        cs(0)
        spi.write(bytes(values))
        cs(1)

    write(USER_CTRL, I2C_IF_DIS)
    write(ACCEL_CONFIG, 0x10)
    write(SMPLRT_DIV, 0, 1)
    write(INT_ENABLE, 1)
    rises = []
    machine.Pin("PB8").irq(lambda pin: rises.append(kernel.now()), machine.Pin.IRQ_RISING)
    kernel.advance(50_500)
    buffer = bytearray(7)
    buffer[0] = 0x80 | ACCEL_XOUT_H
    cs(0)
    spi.write_readinto(buffer, buffer)
    cs(1)
    assert buffer == b"\xff\0\x0a\xff\xec\x10\0"
    assert chip.misuse == []
    kernel.advance(1000)
    assert len(rises) >= 1 and machine.Pin("PB8").value() in (0, 1)


PORTABLE = """
from chips.ist8310 import IST8310Chip
from chips.mpu6500 import MPU6500Chip
from world import StillWorld

world = StillWorld((10, -20, 4096, 5, 6, -7, 100, -200, 300, -521))
chip = MPU6500Chip(world)
chip.aux.append(IST8310Chip(world, axes=("x", "-y", "z")))
now = 0


def transfer(*values):
    global now
    chip.spi_select(True, now)
    answer = []
    for value in values:
        now += 8
        answer.append(chip.spi_transfer(value, now, 1000000, 0))
    chip.spi_select(False, now)
    return answer


now += 100000
transfer(0x6A, 0x10)
transfer(0x19, 0, 1, 0x18, 0x10, 0)
transfer(0x24, 0x1D)
transfer(0x67, 0x82)
transfer(0x25, 0x8E, 2, 0x87, 0x0E, 0x0A, 0x81)
transfer(0x64, 1)
transfer(0x31, 0x0E, 0x41, 0x24, 0x89)
transfer(0x6A, 0x30)
total = 0
for k in range(300):
    now += 1000 - 22 * 8 + k % 7
    for value in transfer(*([0xBB] + [0] * 21)):
        total = (total * 31 + value) & 0xFFFFFF
chip.aux[0].vanish()
now += 3000
print(total, chip.misuse, chip.aux[0].misuse, chip.aux[0].measurements, transfer(0xB6, 0)[1])
now += 5000000
print(transfer(*([0xBB] + [0] * 21)))
transfer(0x6A, 0x10)
print(chip.misuse, chip.master.cut, chip.master.late)
"""


def test_every_runtime_sees_the_same_chip(runtime, tmp_path):
    from upright_host import runtimes

    script = tmp_path / "model.py"
    script.write_text(PORTABLE)
    here = runtimes.run("cpython", str(script), timeout=60)
    there = runtimes.run(runtime, str(script), timeout=120)
    assert here.returncode == there.returncode == 0, there.stdout + there.stderr
    assert there.stdout == here.stdout
    assert here.stdout.count("\n") == 3
