"""The simulated MPU6050 against its datasheet: what it must do, and what it must not forgive."""

from itertools import pairwise

import pytest
from bare_bus import COUNTS, Bus, Nack, Ramp
from chips.mpu6050 import MPU6050Chip
from world import StillWorld

SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG = 0x19, 0x1A, 0x1B, 0x1C
FIFO_EN, INT_PIN_CFG, INT_ENABLE, INT_STATUS = 0x23, 0x37, 0x38, 0x3A
ACCEL_XOUT_H, USER_CTRL, PWR_MGMT_1, PWR_MGMT_2 = 0x3B, 0x6A, 0x6B, 0x6C
FIFO_COUNTH, FIFO_COUNTL, FIFO_R_W, WHO_AM_I = 0x72, 0x73, 0x74, 0x75
WORDS = [10, -20, 4096, -521, 5, 6, -7]  # as they lie in 0x3B..0x48


def running(world=None, divider=0, dlpf=1, settled=True, **options):
    """A chip that is awake on the gyro clock at +-8 g and +-2000 deg/s (the scales of
    StillWorld)."""
    bus = Bus(MPU6050Chip(world or StillWorld(COUNTS), **options))
    bus.write(PWR_MGMT_1, 0x01)
    bus.write(SMPLRT_DIV, divider, dlpf, 0x18, 0x10)
    if settled:
        bus.now += 100_000
    return bus


# Reset and identity


def test_registers_start_at_their_reset_values():
    bus = Bus(MPU6050Chip(StillWorld(), trims=(0,) * 6))
    for register in range(0x76):
        expected = {PWR_MGMT_1: 0x40, WHO_AM_I: 0x68}.get(register, 0)
        assert bus.read(register) == expected, hex(register)


def test_a_6500_wakes_up_running_and_a_6050_asleep():
    awake, asleep = (Bus(MPU6050Chip(StillWorld(COUNTS), who_am_i=who)) for who in (0x70, 0x68))
    assert awake.read(PWR_MGMT_1) == 0x01
    awake.now = asleep.now = 100_000
    assert awake.words()[0] != 0
    assert asleep.words() == [0] * 7


def test_device_reset_clears_the_registers_and_ignores_writes_until_it_is_done():
    bus = running()
    bus.write(PWR_MGMT_1, 0x80)
    assert bus.read(GYRO_CONFIG) == 0
    assert bus.read(PWR_MGMT_1) & 0x80
    bus.write(GYRO_CONFIG, 0x18)
    bus.now += 100_000
    assert bus.read(PWR_MGMT_1) == 0x40
    assert bus.read(GYRO_CONFIG) == 0
    bus.write(GYRO_CONFIG, 0x18)
    assert bus.read(GYRO_CONFIG) == 0x18


def test_a_brown_out_is_a_reset_followed_by_silence():
    bus = running()
    bus.chip.brown_out(bus.now)
    with pytest.raises(Nack):
        bus.read(WHO_AM_I)
    bus.now += 100_000
    assert bus.read(PWR_MGMT_1) == 0x40
    assert bus.read(GYRO_CONFIG) == 0


def test_read_only_registers_keep_their_value():
    bus = running()
    for register in (WHO_AM_I, INT_STATUS, ACCEL_XOUT_H, FIFO_COUNTH):
        before = bus.read(register)
        bus.write(register, before ^ 0xFF)
        assert bus.read(register) == before


# Sampling


def test_samples_come_unchanged_at_the_worlds_own_scales():
    assert running().words() == WORDS


@pytest.mark.parametrize("fs, scale", [(0, 131), (1, 65.5), (2, 32.8), (3, 16.4)])
def test_gyro_counts_follow_the_range(fs, scale):
    bus = running(StillWorld((0, 0, 0, 164, -328, 0)))  # 10 and -20 deg/s
    bus.write(GYRO_CONFIG, fs << 3)
    bus.now += 1000
    assert bus.words()[4:6] == [round(10 * scale), round(-20 * scale)]


@pytest.mark.parametrize("fs, lsb", [(0, 16384), (1, 8192), (2, 4096), (3, 2048)])
def test_accel_counts_follow_the_range(fs, lsb):
    bus = running(StillWorld((4096, -2048, 0)))
    bus.write(ACCEL_CONFIG, fs << 3)
    bus.now += 1000
    assert bus.words()[:2] == [lsb, -lsb // 2]


def test_what_exceeds_the_range_saturates():
    bus = running(StillWorld((32767, -32768, 0, 30000, -30000)))
    bus.write(GYRO_CONFIG, 0, 0)
    bus.now += 1000
    assert bus.words()[:2] == [32767, -32768]
    assert bus.words()[4:6] == [32767, -32768]


def test_a_sample_keeps_the_scale_it_was_taken_with():
    bus = running(StillWorld((4096, 0, 0)))
    assert bus.words()[0] == 4096
    bus.write(ACCEL_CONFIG, 0)
    assert bus.words()[0] == 4096
    bus.now += 1000
    assert bus.words()[0] == 16384


def test_asleep_the_sensor_registers_stand_still():
    world = StillWorld(COUNTS)
    bus = running(world)
    bus.write(PWR_MGMT_1, 0x41)
    world.set((1, 2, 3))
    bus.now += 100_000
    assert bus.words() == WORDS
    bus.write(PWR_MGMT_1, 0x01)
    bus.now += 100_000
    assert bus.words() == [1, 2, 3, 0, 0, 0, 0]


def test_an_axis_in_standby_and_a_disabled_thermometer_stand_still():
    world = StillWorld(COUNTS)
    bus = running(world)
    bus.words()
    bus.write(PWR_MGMT_1, 0x09)
    bus.write(PWR_MGMT_2, 0x21)
    world.set((1, 2, 3, 4, 5, 6, 0, 0, 0, 9))
    bus.now += 100_000
    assert bus.words() == [10, 2, 3, -521, 4, 5, -7]


def test_the_gyro_is_not_settled_for_30_ms_after_waking():
    bus = running(settled=False)
    bus.now += 5000
    assert abs(bus.words()[4] - 5) > 100
    bus.now += 30_000
    assert bus.words()[4:] == [5, 6, -7]


def test_a_burst_is_one_sample_even_when_the_next_one_comes_in_the_middle():
    world = Ramp()
    bus = running(world)
    world.start(bus.now)
    bus.now += 10_500
    data = bus.read(ACCEL_XOUT_H, 14, us_per_byte=100)
    assert {data[i : i + 2] for i in range(0, 14, 2)} == {bytes((0, 10))}
    assert bus.words()[0] == 11


def test_the_6500_has_a_temperature_scale_of_its_own():
    celsius = -521 / 340 + 36.53  # what the world's word means
    assert running().words()[3] == -521
    assert running(who_am_i=0x70).words()[3] == round((celsius - 21) * 333.87)
    assert running(who_am_i=0x98).words()[3] == round((celsius - 25) * 326.8)


@pytest.mark.parametrize(
    "dlpf, divider, who, period",
    [
        (1, 0, 0x68, 1000),
        (6, 9, 0x68, 10_000),
        (0, 0, 0x68, 125),
        (7, 7, 0x68, 1000),
        (0, 79, 0x68, 10_000),
        (0, 79, 0x70, 125),  # RM-MPU-6500A 4.4: no divider without the filter
        (1, 9, 0x70, 10_000),
    ],
)
def test_sample_rate_is_the_gyro_rate_over_the_divider(dlpf, divider, who, period):
    bus = running(divider=divider, dlpf=dlpf, who_am_i=who)
    bus.write(INT_ENABLE, 0x01)
    bus.chip.poll(bus.now)
    assert bus.chip.next_event() - bus.now <= max(period, 50)
    times = []
    while len(times) < 5:
        bus.now = bus.chip.next_event()
        bus.chip.poll(bus.now)
        if bus.chip.int_level:
            times.append(bus.now)
    assert [b - a for a, b in pairwise(times)] == [period] * 4


def test_the_accelerometer_stays_at_1_khz_when_the_gyro_runs_at_8():
    world = Ramp(clocked=False, rate=(8000, 1))
    bus = running(world, dlpf=0)
    world.start(bus.now)
    seen = []
    for _ in range(32):
        bus.now += 125
        words = bus.words()
        seen.append((words[0], words[4]))
    assert len({accel for accel, _ in seen}) in (4, 5)
    assert len({gyro for _, gyro in seen}) == 32


@pytest.mark.parametrize("ppm", [-10_000, 0, 10_000])
def test_the_chips_clock_may_be_off(ppm):
    bus = running(clock_ppm=ppm)
    bus.write(FIFO_EN, 0x80)
    bus.write(USER_CTRL, 0x40)
    bus.now += 400_000
    bus.chip.poll(bus.now)
    assert abs(bus.chip.fifo_count // 2 - (400 + 400 * ppm // 1_000_000)) <= 1


def test_without_the_gyro_clock_the_internal_oscillator_is_off_by_more():
    bus = running(oscillator_ppm=20_000)
    bus.write(PWR_MGMT_1, 0x00)
    bus.write(FIFO_EN, 0x80)
    bus.write(USER_CTRL, 0x40)
    bus.now += 400_000
    bus.chip.poll(bus.now)
    assert bus.chip.fifo_count // 2 == 408


def test_a_recorded_trial_drives_the_sample_clock():
    world = Ramp(n=5)
    bus = running(world, divider=9)
    assert bus.words()[0] == 0  # not started: row 0
    bus.write(FIFO_EN, 0x08)
    bus.write(USER_CTRL, 0x44)
    bus.write(USER_CTRL, 0x04)
    bus.write(USER_CTRL, 0x40)
    world.start(bus.now + 300)
    bus.now += 1_000_000
    n = int.from_bytes(bus.read(FIFO_COUNTH, 2), "big")
    data = bus.read(FIFO_R_W, n)
    samples = [data[i + 1] for i in range(0, n, 6)]
    assert samples[-5:] == [0, 1, 2, 3, 4]  # each row once, and nothing after the last
    assert set(samples[:-5]) <= {0}


# Interrupts


def test_data_ready_is_set_by_a_sample_and_cleared_by_reading_it():
    bus = running()
    bus.write(INT_ENABLE, 0x01)
    assert bus.read(INT_STATUS) == 0
    bus.now += 1000
    assert bus.read(ACCEL_XOUT_H) == 0
    assert bus.read(INT_STATUS) == 1
    assert bus.read(INT_STATUS) == 0


def test_data_ready_needs_its_enable_bit():
    bus = running()
    bus.now += 5000
    assert bus.read(INT_STATUS) == 0


def test_with_int_rd_clear_any_read_clears_the_status():
    bus = running()
    bus.write(INT_PIN_CFG, 0x10)
    bus.write(INT_ENABLE, 0x01)
    bus.now += 1000
    bus.read(WHO_AM_I)
    assert bus.read(INT_STATUS) == 0


@pytest.mark.parametrize("config, active", [(0x00, 1), (0x80, 0)])
def test_the_interrupt_pin_gives_a_pulse_of_50_us(config, active):
    bus = running()
    bus.write(INT_PIN_CFG, config, 0x01)
    assert bus.chip.int_level == 1 - active
    rise = bus.chip.next_event()
    bus.chip.poll(rise)
    assert bus.chip.int_level == active
    assert bus.chip.next_event() == rise + 50
    bus.chip.poll(rise + 50)
    assert bus.chip.int_level == 1 - active
    assert bus.chip.next_event() == rise + 1000


def test_a_latched_interrupt_stays_until_the_status_is_read():
    bus = running()
    bus.write(INT_PIN_CFG, 0x20, 0x01)
    bus.now = bus.chip.next_event() + 500
    bus.chip.poll(bus.now)
    assert bus.chip.int_level == 1
    assert bus.chip.next_event() is None
    bus.read(INT_STATUS)
    assert bus.chip.int_level == 0
    assert bus.chip.next_event() > bus.now


def test_no_event_is_announced_while_nothing_can_happen():
    bus = running()
    assert bus.chip.next_event() is None
    bus.write(INT_ENABLE, 0x01)
    bus.write(PWR_MGMT_1, 0x41)
    assert bus.chip.next_event() is None


# FIFO


def fifo(bus, enable=0xF8, interrupts=0x11):
    bus.write(FIFO_EN, enable)
    bus.write(INT_ENABLE, interrupts)
    bus.write(USER_CTRL, 0x00)
    bus.write(USER_CTRL, 0x04)
    bus.write(USER_CTRL, 0x40)
    bus.read(INT_STATUS)


def test_packets_are_in_register_order():
    bus = running()
    fifo(bus)
    bus.now += 2000
    assert bus.read(FIFO_COUNTH, 2) == bytes((0, 28))
    data = bus.read(FIFO_R_W, 28)
    assert data[:14] == data[14:] == b"".join(w.to_bytes(2, "big", signed=True) for w in WORDS)


def test_only_enabled_sensors_go_into_the_fifo():
    bus = running()
    fifo(bus, enable=0x48)  # accel and gyro x
    bus.now += 1000
    data = bus.read(FIFO_R_W, bus.read(FIFO_COUNTH, 2)[1])
    assert data == b"".join(w.to_bytes(2, "big", signed=True) for w in (10, -20, 4096, 5))


def test_an_empty_fifo_repeats_its_last_byte():
    bus = running()
    fifo(bus)
    bus.now += 1000
    last = bus.read(FIFO_R_W, 14)[-1]
    assert bus.read(FIFO_R_W, 3) == bytes((last,)) * 3


def test_the_low_count_byte_stands_still_until_the_high_one_is_read():
    bus = running()
    fifo(bus)
    bus.now += 1000
    assert bus.read(FIFO_COUNTL) == 0
    assert bus.read(FIFO_COUNTH, 2) == bytes((0, 14))
    bus.now += 1000
    assert bus.read(FIFO_COUNTL) == 14


@pytest.mark.parametrize("who, size", [(0x68, 1024), (0x70, 512)])
def test_an_overflow_loses_the_oldest_bytes_and_shifts_the_boundary(who, size):
    world = Ramp()
    bus = running(world, who_am_i=who)
    fifo(bus, enable=0x78)  # 12 bytes: no temperature, which the parts scale differently
    fits = size // 12
    world.start(bus.now + 1000)
    bus.now += fits * 1000
    assert not bus.read(INT_STATUS) & 0x10
    bus.now += 1000
    assert bus.read(INT_STATUS) & 0x10
    assert int.from_bytes(bus.read(FIFO_COUNTH, 2), "big") == size
    data = bus.read(FIFO_R_W, size)
    stream = b"".join(k.to_bytes(2, "big") * 6 for k in range(fits + 1))
    assert data == stream[-size:]
    assert (len(stream) - size) % 12  # so it does not begin with a packet


def test_a_long_gap_leaves_what_a_short_step_would_have_left():
    worlds = [Ramp(), Ramp()]
    short, long = (running(w) for w in worlds)
    for bus, world in zip((short, long), worlds, strict=True):
        fifo(bus)
        world.start(bus.now)
    for _ in range(500):
        short.now += 1000
        short.chip.poll(short.now)
    long.now += 500_000
    assert short.read(INT_STATUS) == long.read(INT_STATUS)
    assert short.read(FIFO_R_W, 1024) == long.read(FIFO_R_W, 1024)


def test_in_fifo_mode_1_a_full_fifo_of_a_6500_keeps_the_oldest():
    bus = running(Ramp(), dlpf=0x41, who_am_i=0x70)
    fifo(bus, enable=0x78)
    bus.chip.world.start(bus.now)
    bus.now += 1_000_000
    assert bus.read(INT_STATUS) & 0x10
    assert bus.read(FIFO_R_W, 24) == bytes(12) + b"\0\1" * 6


def test_overflow_is_not_flagged_unless_enabled():
    bus = running()
    fifo(bus, interrupts=0x01)
    bus.now += 200_000
    assert bus.read(INT_STATUS) == 0x01


@pytest.mark.parametrize("who, left", [(0x68, 14), (0x70, 0)])
def test_fifo_reset_of_a_6050_needs_fifo_en_off(who, left):
    bus = running(who_am_i=who)
    fifo(bus)
    bus.now += 1000
    bus.write(USER_CTRL, 0x44)
    assert bus.chip.fifo_count == left
    assert bus.read(USER_CTRL) == 0x40  # the reset bit clears itself
    assert bool(bus.chip.misuse) is (who == 0x68)
    bus.write(USER_CTRL, 0x00)
    bus.write(USER_CTRL, 0x04)
    assert bus.chip.fifo_count == 0


def test_a_packet_can_be_caught_half_written():
    bus = running(fifo_byte_us=10)
    fifo(bus)
    bus.write(INT_ENABLE, 0x01)
    bus.now = bus.chip.next_event() + 55
    assert bus.read(FIFO_COUNTH, 2)[1] == 6
    bus.now += 100
    assert bus.read(FIFO_COUNTH, 2)[1] == 14


def test_a_disabled_fifo_fills_no_further():
    bus = running()
    fifo(bus)
    bus.now += 2000
    bus.write(USER_CTRL, 0x00)
    bus.now += 5000
    assert int.from_bytes(bus.read(FIFO_COUNTH, 2), "big") == 28


# The bus


def test_a_burst_steps_through_registers_but_stays_on_the_fifo():
    bus = running()
    assert bus.read(SMPLRT_DIV, 4) == bytes((0, 1, 0x18, 0x10))
    fifo(bus)
    bus.now += 1000
    assert bus.read(FIFO_R_W, 2) == bytes((0, 10))


def test_faults_can_be_injected():
    bus = running()
    bus.chip.nack_next(1, after=2)  # address and register pass, the repeated start does not
    with pytest.raises(Nack):
        bus.read(WHO_AM_I)
    assert bus.read(WHO_AM_I) == 0x68
    bus.chip.vanish()
    with pytest.raises(Nack):
        bus.read(WHO_AM_I)
    bus.chip.come_back()
    bus.chip.stick(WHO_AM_I, 0xFF)
    assert bus.read(WHO_AM_I) == 0xFF
    bus.chip.stick(WHO_AM_I)
    assert bus.read(WHO_AM_I) == 0x68


def test_setting_i2c_if_dis_is_recorded_and_silences_a_6500():
    old, new = running(), running(who_am_i=0x70)
    for bus in (old, new):
        bus.write(USER_CTRL, 0x10)
        assert bus.chip.misuse
    assert old.read(WHO_AM_I) == 0x68
    with pytest.raises(Nack):
        new.read(WHO_AM_I)


def test_writes_can_be_logged():
    bus = running()
    bus.chip.log = []
    bus.write(SMPLRT_DIV, 4, 2)
    assert bus.chip.log == [(bus.now, SMPLRT_DIV, 4), (bus.now, CONFIG, 2)]


# Self-test


def responses(bus):
    bus.write(GYRO_CONFIG, 0x00, 0x10)
    bus.now += 50_000
    rest = bus.words()
    bus.write(GYRO_CONFIG, 0xE0, 0xF0)
    bus.now += 50_000
    return [b - a for a, b in zip(rest, bus.words(), strict=True)]


def test_self_test_moves_each_axis_by_its_factory_trim():
    bus = running(trims=(1, 31, 11, 1, 2, 31))
    ax, ay, az, temperature, gx, gy, gz = responses(bus)
    assert (ax, ay) == (int(4096 * 0.34), int(4096 * 0.92))
    assert az == int(4096 * 0.34 * (0.92 / 0.34) ** (1 / 3))
    assert temperature == 0
    assert (gx, gy, gz) == (25 * 131, -int(25 * 131 * 1.046), int(25 * 131 * 1.046**30))


def test_trims_lie_in_their_registers_as_the_map_says():
    bus = running(trims=(0b10110, 0b01001, 0b11101, 3, 17, 31))
    data = bus.read(0x0D, 4)
    assert [b & 0x1F for b in data[:3]] == [3, 17, 31]
    assert [b >> 5 for b in data[:3]] == [0b101, 0b010, 0b111]
    assert data[3] == 0b10_01_01


def test_a_broken_axis_does_not_react_to_self_test():
    bus = running()
    bus.chip.broken = (1, 5)
    moved = responses(bus)
    assert moved[1] == moved[6] == 0
    assert all(moved[i] for i in (0, 2, 4, 5))
