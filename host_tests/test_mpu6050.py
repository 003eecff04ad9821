"""The MPU6050 driver on a simulated bus: set-up, samples, faults that it must survive, repair."""

import kernel
import machine
import pytest
from imus import ACCEL_FULL, COUNTS, FRESH, GYRO_FULL, RIGS, tick
from upright.mpu6050 import (
    HEALTH_BUS_ERROR,
    HEALTH_MISMATCH,
    HEALTH_OK,
    HEALTH_REPAIRING,
    MPU6050,
    MPU6050Error,
)

GYRO_CONFIG, ACCEL_CONFIG, INT_ENABLE = 0x1B, 0x1C, 0x38
USER_CTRL, PWR_MGMT_1, WHO_AM_I = 0x6A, 0x6B, 0x75


wired, driver, running = (getattr(RIGS["MPU6050"], name) for name in ("wired", "driver", "running"))


# Set-up


def test_an_absent_chip_is_named_with_what_was_tried():
    with pytest.raises(MPU6050Error, match=r"0x68.*0x69 either.*pull-ups"):
        driver().configure()
    assert kernel.now() < 1_000_000


def test_a_chip_on_the_other_address_is_pointed_out():
    wired(address=0x69)
    with pytest.raises(MPU6050Error, match=r"chip at 0x69 answers with 0x68\. AD0"):
        driver().configure()
    driver(address=0x69).configure()


def test_without_an_address_a_chip_that_is_late_after_power_up_is_waited_for():
    chip = wired()
    chip.power_up_us = 90_000
    chip.brown_out(0)
    driver(address=None).configure()


class Clock:
    """A DS3231 on its address: it answers every register."""

    def __init__(self, address=0x68):
        self.address = address

    def i2c_start(self, read, now):
        return True

    def i2c_write(self, byte, now):
        return True

    def i2c_read(self, now):
        return 0x17

    def i2c_stop(self, now):
        pass

    def poll(self, now):
        pass


@pytest.mark.parametrize("address", [0x68, 0x69])
@pytest.mark.parametrize("clock", [False, True])
def test_without_an_address_the_chip_is_found_at_either(address, clock):
    wired(address=address)
    if clock:
        machine.wire_i2c(0, Clock(0x68 + 0x69 - address))
    imu = MPU6050(machine.I2C(0))
    imu.configure()
    assert imu.registers.address == address and tick(imu) & FRESH


def test_without_an_address_two_chips_are_refused_and_both_named():
    wired()
    wired(address=0x69, who_am_i=0x70)
    with pytest.raises(
        MPU6050Error, match=r"0x68 answers .* 0x68 and 0x69 with 0x70.*address=0x69"
    ):
        driver(address=None).configure()
    driver(address=0x69).configure()


def test_without_an_address_nobody_and_a_stranger_are_told():
    with pytest.raises(MPU6050Error, match=r"no MPU6050 at 0x68 or 0x69.*pull-ups"):
        driver(address=None).configure()
    machine.wire_i2c(0, Clock(0x69))
    with pytest.raises(MPU6050Error, match=r"WHO_AM_I .* 0x17 at 0x69.*DS3231.*accept_unknown"):
        driver(address=None).configure()
    assert kernel.now() < 1_000_000


def test_an_unknown_identity_is_refused_and_shown():
    wired(who_am_i=0x42)
    with pytest.raises(MPU6050Error, match=r"0x42.*0x68.*DS3231.*accept_unknown"):
        driver().configure()


def test_a_bus_fault_at_set_up_names_the_register():
    chip = wired()
    imu = driver()
    imu.begin()
    chip.nack_next(1, after=3 * 6)
    with pytest.raises(MPU6050Error, match="while writing GYRO_CONFIG"):
        imu.configure()


# Configuration


@pytest.mark.parametrize("g, lsb", [(2, 16384), (4, 8192), (8, 4096), (16, 2048)])
@pytest.mark.parametrize("dps, scale", [(250, 131), (500, 65.5), (1000, 32.8), (2000, 16.4)])
def test_ranges_give_exact_scales(g, lsb, dps, scale):
    _, imu = running(
        (0, 0, 2048, 82, 0, 0), configure={"accel_range_g": g, "gyro_range_dps": dps}
    )  # half a g, 5 deg/s
    assert imu.accel_lsb_per_g == lsb
    assert imu.gyro_scale[0] / imu.gyro_scale[1] == scale
    assert tick(imu) & FRESH
    assert imu.counts[2] == lsb // 2
    assert imu.counts[3] == round(5 * scale)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"accel_range_g": 3}, "accel_range_g 3 is not one of 2, 4, 8, 16"),
        ({"gyro_range_dps": 300}, "gyro_range_dps 300 is not one of 250, 500, 1000, 2000"),
        ({"dlpf": 7}, "dlpf 7 is not one of 0, 1, 2, 3, 4, 5, 6"),
        ({"dlpf": "42"}, "dlpf '42' is not"),
        ({"sample_rate_hz": 0}, "sample_rate_hz 0"),
        ({"sample_rate_hz": 200.0}, "sample_rate_hz 200.0"),
        ({"sample_rate_hz": (200, 0)}, "sample_rate_hz"),
        ({"sample_rate_hz": 300}, "300/1 is not 1000 .* 1000/4 and 1000/3"),
        ({"sample_rate_hz": 3}, "3/1 is not 1000"),
        ({"sample_rate_hz": 9000}, "9000/1 is not 8000"),
        ({"sample_rate_hz": 2000, "dlpf": 1}, "2000/1 is not 1000"),
        ({"sample_rate_hz": (2000, 7)}, "2000/7 is not 1000"),
    ],
)
def test_a_setting_that_the_chip_does_not_have_is_refused_by_name(options, message):
    wired()
    with pytest.raises(ValueError, match=message):
        driver().configure(**options)


@pytest.mark.parametrize(
    "asked, dlpf, actual",
    [
        (1000, None, (1000, 1)),
        (200, 3, (200, 1)),
        (4, None, (4, 1)),
        (143, None, (1000, 7)),
        ((2000, 7), 0, (2000, 7)),
        (8000, 0, (8000, 1)),
        ((400, 2), None, (200, 1)),
    ],
)
def test_the_actual_rate_is_an_exact_ratio(asked, dlpf, actual):
    chip, imu = running(rate=asked, configure={"dlpf": dlpf})
    assert imu.sample_rate == actual
    chip.poll(kernel.now())
    assert abs(chip.next_event() - kernel.now()) <= 1_000_000 * actual[1] // actual[0] + 50


@pytest.mark.parametrize(
    "rate, dlpf, bandwidth",
    [(1000, 1, 188), (200, 2, 98), (100, 3, 42), (20, 5, 10), (4, 6, 5), (2000, 0, 256)],
)
def test_the_filter_follows_the_rate_when_none_is_asked_for(rate, dlpf, bandwidth):
    _, imu = running(rate=rate)
    assert (imu.dlpf, imu.bandwidth_hz) == (dlpf, bandwidth)


def test_a_6500_has_no_divider_without_its_filter():
    wired(who_am_i=0x70)
    with pytest.raises(ValueError, match="dlpf 0 of this MPU6500 runs at 8000 Hz only"):
        driver().configure(dlpf=0, sample_rate_hz=1000)


@pytest.mark.parametrize("who, kept", [(0x70, 3), (0x68, 0)])
def test_a_6500_gets_its_accelerometer_filter_set(who, kept):
    chip, _ = running(rate=100, who_am_i=who)
    assert chip.register(0x1D) == kept


@pytest.mark.parametrize(
    "options, value",
    [
        ({}, 0x00),
        ({"active_low": True}, 0x80),
        ({"open_drain": True}, 0x40),
        ({"latch": True}, 0x20),
    ],
)
def test_the_interrupt_pin_is_set_up_as_asked(options, value):
    chip, imu = running()
    imu.configure_interrupt(**options)
    assert chip.register(0x37) == value


def test_every_sample_pulses_the_interrupt_pin():
    chip, imu = running()
    machine.wire_pin(22, chip)
    flags = []
    machine.Pin(22, machine.Pin.IN).irq(
        lambda pin: flags.append(imu.read()), machine.Pin.IRQ_RISING, hard=True
    )
    kernel.advance(20_500)
    assert len(flags) in (20, 21) and set(flags) == {FRESH}


def test_nothing_works_before_configure():
    wired()
    for method in ("sleep", "wake", "fifo_enable", "self_test", "configure_interrupt"):
        with pytest.raises(MPU6050Error, match="configure"):
            getattr(driver(), method)()


# Samples


def test_a_sleeping_chip_gives_no_fresh_sample():
    chip, imu = running()
    imu.sleep()
    assert chip.register(PWR_MGMT_1) == 0x41
    tick(imu)
    assert not any(tick(imu) & FRESH for _ in range(20))
    assert imu.health() == HEALTH_OK  # asleep on purpose
    imu.wake()
    assert tick(imu) & FRESH
    assert list(imu.counts)[3:6] == [5, 6, -7]  # and the gyro has settled


@pytest.mark.parametrize(
    "axis, value, flag",
    [
        (0, 32767, ACCEL_FULL),
        (1, -32768, ACCEL_FULL),
        (2, 32766, 0),
        (2, -32767, 0),
        (3, -32768, GYRO_FULL),
        (5, 32767, GYRO_FULL),
        (9, 32767, 0),
    ],
)
def test_an_axis_at_full_scale_is_flagged(axis, value, flag):
    counts = list(COUNTS)
    counts[axis] = value
    _, imu = running(counts)
    assert tick(imu) == FRESH | flag
    assert imu.counts[10] == FRESH | flag


def test_a_program_gets_g_and_degrees_per_second_and_celsius():
    _, imu = running((4096, -2048, 1024, 164, -82, 41, 0, 0, 0, -521))
    tick(imu)
    assert imu.accel() == (1.0, -0.5, 0.25)
    assert imu.gyro() == pytest.approx((10, -5, 2.5))
    assert imu.temperature() == pytest.approx(35, abs=0.01)


def test_after_configure_a_program_gets_a_sample_and_before_it_a_reason():
    _, imu = running((4096, -2048, 1024, 164, -82, 41, 0, 0, 0, -521))
    assert imu.accel() == (1.0, -0.5, 0.25)
    assert not imu.counts[10] & 1  # it is no fresh one for a tick
    for reading in (driver().accel, driver().gyro):
        with pytest.raises(MPU6050Error, match="configure"):
            reading()


# with


def test_with_lets_the_chip_sleep_in_the_end_and_leaves_its_configuration():
    chip = wired()
    with driver() as imu:
        imu.configure(sample_rate_hz=1000)
        imu.fifo_enable()
        kernel.advance(3000)
        assert imu.fifo_poll() == 3
    assert chip.register(PWR_MGMT_1) & 0x40 and chip.register(USER_CTRL) == 0
    tick(imu)
    assert not tick(imu) & FRESH
    imu.wake()
    assert tick(imu) & FRESH and list(imu.counts)[:10] == list(COUNTS)


@pytest.mark.parametrize("configured", [True, False])
def test_with_a_bus_that_fails_the_programs_own_exception_is_the_one_that_comes_out(configured):
    chip = wired()
    with pytest.raises(KeyboardInterrupt), driver() as imu:
        if configured:
            imu.configure()
        chip.vanish()
        raise KeyboardInterrupt
    chip.come_back()
    with pytest.raises(MPU6050Error, match="bus error"), driver() as imu:
        imu.configure()
        chip.vanish()


# Faults in the tick


@pytest.mark.parametrize("after", [0, 1, 2])
def test_a_nack_anywhere_in_a_burst_costs_one_sample(after):
    chip, imu = running()
    chip.nack_next(1, after=after)
    assert not tick(imu) & FRESH
    assert imu.errors == 1
    assert tick(imu) & FRESH


# Health and repair


def test_health_reads_one_register_a_call_and_all_of_them_in_turn():
    _, imu = running()
    read = []
    real = machine.I2C(0).readfrom_mem_into

    class Spy:
        def readfrom_mem_into(self, address, register, buffer):
            read.append((register, len(buffer)))
            real(address, register, buffer)

        def writeto(self, address, buffer):
            raise AssertionError

    imu.registers.bind(Spy())
    rows = imu.configuration()
    assert {imu.health() for _ in range(2 * len(rows))} == {HEALTH_OK}
    assert read == [(register, 1) for register, _ in rows] * 2


@pytest.mark.parametrize("row", range(10))
def test_any_changed_register_is_found_within_one_round(row):
    chip, imu = running()
    register, value = imu.configuration()[row]
    chip.poke(register, value ^ 0x20)
    states = [imu.health() for _ in range(len(imu.configuration()))]
    assert states.count(HEALTH_MISMATCH) == 1
    for _ in range(imu.monitor.repair_calls()):
        imu.health()
    assert chip.register(register) == value
    assert imu.health() == HEALTH_OK and imu.resets == 1


def survive(chip, imu, deliver, ticks=200):
    """Tick through a brown-out; -> (health calls from the first answer after it to OK, fresh counts
    seen)."""
    chip.brown_out(kernel.now())
    calls = 0
    seen = []
    repaired = False
    for _ in range(ticks):
        kernel.advance(1000)
        seen += deliver()
        state = imu.health()
        if state == HEALTH_MISMATCH:
            calls = 0
        calls += 1
        repaired = repaired or (state == HEALTH_OK and imu.resets > 0)
        if not repaired:
            worst = calls
    assert repaired
    return worst, seen


@pytest.mark.parametrize("who", [0x68, 0x70])
def test_a_brown_out_is_repaired_in_the_promised_calls_and_no_wrong_sample_is_fresh(who):
    chip, imu = running(who_am_i=who)
    tick(imu)
    chip.log = log = []
    good = list(imu.counts)

    def deliver():
        return [list(imu.counts)] if imu.read() & FRESH else []

    calls, seen = survive(chip, imu, deliver)
    assert imu.resets == 1
    assert calls <= imu.monitor.repair_calls()
    assert seen and all(counts == good for counts in seen)  # neither another scale nor start-up
    assert not any(register == PWR_MGMT_1 and value & 0x80 for _, register, value in log)
    assert [(register, chip.register(register)) for register, _ in imu.configuration()] == (
        imu.configuration()
    )


def test_samples_are_withheld_until_the_gyro_has_settled():
    chip, imu = running()
    chip.brown_out(kernel.now())
    woken = None
    while True:
        kernel.advance(1000)
        fresh = imu.read() & FRESH
        imu.health()
        if woken is None and chip.awake:
            woken = kernel.now()
        if fresh:
            break
    assert 30_000 <= kernel.now() - woken <= 100_000


def test_a_second_brown_out_during_the_repair_starts_it_anew():
    chip, imu = running()
    chip.brown_out(kernel.now())
    kernel.advance(25_000)
    imu.read()
    while imu.health() != HEALTH_MISMATCH:
        pass
    for _ in range(6):
        assert imu.health() == HEALTH_REPAIRING
    chip.brown_out(kernel.now())
    for _ in range(300):
        tick(imu)
        imu.health()
    assert imu.resets >= 1 and imu.health() == HEALTH_OK
    assert tick(imu) == FRESH and list(imu.counts)[:10] == list(COUNTS)


def test_a_bus_error_during_the_repair_only_delays_it():
    chip, imu = running()
    chip.brown_out(kernel.now())
    kernel.advance(25_000)
    imu.read()
    assert imu.health() == HEALTH_MISMATCH
    chip.nack_next(3)
    assert [imu.health() for _ in range(3)] == [HEALTH_BUS_ERROR] * 3
    for _ in range(100):
        tick(imu)
        imu.health()
    assert tick(imu) == FRESH


def test_slow_samples_do_not_keep_health_from_the_other_registers():
    chip, imu = running(rate=50)
    chip.poke(GYRO_CONFIG, 0)
    states = []
    for _ in range(3 * len(imu.configuration())):
        tick(imu)
        states.append(imu.health())
    assert HEALTH_MISMATCH in states


# Self-test


@pytest.mark.parametrize("codes", [(1,) * 6, (31,) * 6, (2, 9, 20, 5, 12, 30)])
def test_self_test_knows_every_trim(codes):
    _, imu = running(trims=codes)
    assert imu.self_test()[0] is True


def test_a_missing_trim_is_reported_as_such():
    _, imu = running(trims=(0, 14, 18, 15, 0, 13))
    passed, changes = imu.self_test()
    assert passed is True
    assert changes[0] is None and changes[4] is None


def test_without_any_trim_there_is_no_verdict():
    _, imu = running(trims=(0,) * 6)
    assert imu.self_test() == (None, (None,) * 6)


# Allocation


def test_nothing_in_the_tick_allocates(micropython_runtime, portable):
    lines = portable(micropython_runtime, "mpu_alloc.py", "mpu6050").splitlines()
    assert len(lines) == 8
    assert sum(": ok 0 fresh" in line for line in lines) == 6
    assert sum(line.endswith("found") for line in lines) == 2


def test_a_burst_that_nobody_drove_is_a_fault_and_no_sample():
    """All ones: what the bus reads as when the chip dies after it was addressed."""
    chip, imu = running()
    tick(imu)
    before = list(imu.counts[:10])
    chip.stick(0x3A, 0xFF)
    assert tick(imu) & 1 == 0
    assert imu.errors == 1
    assert list(imu.counts[:10]) == before
