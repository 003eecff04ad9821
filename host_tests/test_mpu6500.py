"""The MPU6500 driver on simulated SPI and I2C: set-up, clocks, samples, faults, repair, self-test."""

from pathlib import Path

import kernel
import machine
import micropython
import pytest
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from imus import COUNTS, CS, FRESH, MAG, RIGS, tick
from upright.mpu6050 import MPU6050
from upright.mpu6500 import (
    HEALTH_BUS_ERROR,
    HEALTH_MISMATCH,
    HEALTH_OK,
    HEALTH_REPAIRING,
    MPU6500_I2C,
    MPU6500Error,
)
from upright.mpu_monitor import VERIFY
from upright_host import runtimes
from world import StillWorld

PORTABLE = Path(__file__).parent / "portable"

CONFIG, GYRO_CONFIG, ACCEL_CONFIG2 = 0x1A, 0x1B, 0x1D
USER_CTRL, PWR_MGMT_1, WHO_AM_I = 0x6A, 0x6B, 0x75


wired, driver, running = (getattr(RIGS["MPU6500"], name) for name in ("wired", "driver", "running"))


def selected():
    return machine.Pin(CS).value() == 0


class Line:
    """An SPI device that answers every byte with the same: a line that nothing drives."""

    def __init__(self, level):
        self.level = level
        self.edges = []

    def spi_select(self, selected, now):
        self.edges.append(selected)

    def spi_transfer(self, byte, now, hz, mode):
        return self.level


# Set-up


@pytest.mark.parametrize("level", [0x00, 0xFF])
def test_nobody_there_is_told_with_what_to_check(level):
    machine.wire_spi(5, Line(level), cs=CS)
    with pytest.raises(
        MPU6500Error, match=rf"no MPU6500 on SPI.*0x{level:02x}.*supply.*CS.*MISO.*mode 0 or 3"
    ):
        driver().configure()
    assert kernel.now() < 1_000_000 and not selected()


@pytest.mark.parametrize("polarity, phase", [(0, 0), (1, 1)])
def test_both_of_the_chips_modes_work(polarity, phase):
    chip = wired()
    imu = driver(machine.SPI(5, 1_000_000, polarity=polarity, phase=phase))
    imu.configure()
    assert tick(imu) == FRESH and list(imu.counts) == [*COUNTS[:9], imu.counts[9], FRESH]
    assert chip.misuse == []


@pytest.mark.parametrize("polarity, phase", [(0, 1), (1, 0)])
def test_a_wrong_mode_is_among_what_the_message_asks_to_check(polarity, phase):
    wired()
    with pytest.raises(MPU6500Error, match="mode"):
        driver(machine.SPI(5, 1_000_000, polarity=polarity, phase=phase)).configure()


def test_an_unknown_identity_is_refused_and_shown():
    wired(who_am_i=0x42)
    with pytest.raises(MPU6500Error, match=r"0x42 on SPI; known are 0x68, 0x70.*accept_unknown"):
        driver().configure()


def test_an_mpu6050_on_spi_is_an_mpu6000_and_works():
    chip, imu = running(who_am_i=0x68)
    assert (imu.chip, imu.fifo_size, imu.family_6500) == ("MPU6000", 1024, False)
    assert tick(imu) & FRESH and list(imu.counts)[:6] == list(COUNTS)[:6]
    assert abs(imu.temperature_cdeg() - 3500) <= 1
    imu.fifo_enable()
    fresh = 0
    for _ in range(100):
        kernel.advance(2000)
        for _ in range(imu.fifo_poll()):
            fresh += imu.fifo_next() & FRESH
        assert imu.health() == HEALTH_OK
    assert fresh > 190 and (imu.errors, imu.resets, chip.misuse) == (0, 0, [])


def test_the_reset_is_the_long_one_and_i2c_is_off_from_its_first_write():
    chip = wired()
    chip.log = log = []
    driver().begin()
    writes = [(register, value) for _, register, value in log]
    assert writes[:4] == [(0x6A, 0x10), (0x6B, 0x80), (0x6A, 0x10), (0x68, 0x07)]
    times = [at for at, _, _ in log]
    assert times[2] - times[1] >= 100_000 and kernel.now() - times[3] >= 100_000


def test_a_master_left_running_is_switched_off_before_the_reset():
    chip = wired()
    chip.poke(0x27, 0x87)
    chip.poke(USER_CTRL, 0x30)
    chip.log = log = []
    driver().begin()
    writes = [(register, value) for _, register, value in log]
    assert writes[:5] == [(0x27, 0), (0x2A, 0), (0x2D, 0), (0x30, 0), (0x34, 0)]
    assert writes[5:7] == [(0x6A, 0x10), (0x6B, 0x80)]
    assert log[5][0] - log[4][0] >= 5000


# Clocks


class Spy:
    """The bus of the mock, and at which clock each register was accessed."""

    def __init__(self, spi):
        self.spi = spi
        self.clocks = {}
        self.inits = 0
        self.modes = set()

    def init(self, baudrate):
        self.inits += 1
        assert not selected()
        self.spi.init(baudrate=baudrate)

    def write(self, buffer):
        assert selected()
        kind = "read" if buffer[0] & 0x80 else "write"
        self.clocks.setdefault((kind, buffer[0] & 0x7F), set()).add(self.spi._hz)
        self.modes.add((self.spi._polarity, self.spi._phase))
        self.spi.write(buffer)

    def readinto(self, buffer, write=0):
        self.spi.readinto(buffer, write)


def exercise(imu):
    imu.configure()
    for _ in range(30):
        tick(imu)
        imu.health()
    imu.fifo_enable()
    kernel.advance(5000)
    assert imu.fifo_poll() == 5 or imu.fifo_poll()
    imu.self_test()


def test_only_sensor_bursts_are_fast():
    chip = wired()
    spy = Spy(machine.SPI(5, 400_000, polarity=1, phase=1))
    imu = driver(bus=spy)
    exercise(imu)
    assert imu.burst_hz == 10_000_000
    assert spy.clocks.pop(("read", 0x3A)) >= {10_000_000}
    assert all(clocks == {1_000_000} for clocks in spy.clocks.values())
    assert ("read", 0x74) in spy.clocks and ("write", PWR_MGMT_1) in spy.clocks
    assert spy.modes == {(1, 1)}  # kept through every init
    assert chip.misuse == []


def test_the_clock_is_changed_only_when_it_has_to_be():
    spy = Spy(machine.SPI(5))
    _chip, imu = running(bus=spy)
    tick(imu)
    before = spy.inits
    for _ in range(100):
        tick(imu)
    assert spy.inits == before
    imu.health()
    imu.health()
    tick(imu)
    assert spy.inits == before + 2


def test_asked_clocks_are_used():
    chip = wired()
    spy = Spy(machine.SPI(5))
    imu = driver(bus=spy, fast_hz=20_000_000, slow_hz=500_000)
    imu.configure()
    tick(imu)
    assert spy.clocks[("read", 0x3A)] == {20_000_000}
    assert spy.clocks[("read", WHO_AM_I)] == {500_000}
    assert chip.misuse == []


@pytest.mark.parametrize(
    "clocks",
    [
        {"slow_hz": 1_000_001},
        {"slow_hz": 0},
        {"fast_hz": 20_000_001},
        {"fast_hz": 999_999},
    ],
)
def test_a_clock_that_the_chip_cannot_take_is_refused(clocks):
    with pytest.raises(ValueError, match=next(iter(clocks))):
        driver(**clocks)


class AllocatingInit(Spy):
    """A port whose init() takes memory: not in an interrupt."""

    def init(self, baudrate):
        if micropython.heap_locked():
            raise MemoryError
        Spy.init(self, baudrate)


class SlowInit(Spy):
    """A port that builds the whole bus anew."""

    def init(self, baudrate):
        kernel.advance(150)
        Spy.init(self, baudrate)


class NoInit(Spy):
    """A bus that stays as it was made."""

    def init(self, baudrate):
        raise NotImplementedError


class OtherInit(Spy):
    def init(self, mode, rate):
        raise AssertionError


@pytest.mark.parametrize(
    "kind, made_with, burst, used",
    [
        (AllocatingInit, 8_000_000, 1_000_000, 1_000_000),
        (SlowInit, 8_000_000, 1_000_000, 1_000_000),
        (NoInit, 800_000, 0, 800_000),
        (OtherInit, 800_000, 0, 800_000),
    ],
)
def test_a_bus_that_cannot_change_its_clock_in_the_tick_runs_at_one_safe_clock(
    kind, made_with, burst, used
):
    """That is the one that it was made with where it cannot be clocked at all."""
    chip = wired()
    spy = kind(machine.SPI(5, made_with))
    imu = driver(bus=spy)
    exercise(imu)
    assert imu.burst_hz == burst
    assert all(clocks == {used} for clocks in spy.clocks.values())
    assert chip.misuse == [] and not micropython.heap_locked()


def test_without_the_second_clock_the_chip_would_be_misused():
    chip, imu = running()
    imu.registers.slow_hz = 10_000_000
    imu.health()
    assert any("10000000 Hz" in what for what in chip.misuse)


# Filters and rates


@pytest.mark.parametrize(
    "rate, options, config, fchoice, accel, bandwidth, accel_bandwidth",
    [
        (1000, {}, 1, 0, 1, 184, 184),
        (200, {}, 2, 0, 2, 92, 92),
        (100, {"accel_dlpf": 5}, 3, 0, 5, 41, 10),
        (1000, {"dlpf": 2, "accel_dlpf": "bypass"}, 2, 0, 8, 92, 1130),
        (8000, {"dlpf": 0}, 0, 0, 0, 250, 460),
        (8000, {"dlpf": 7}, 7, 0, 7, 3600, 460),
        (32000, {"dlpf": "bypass"}, 0, 1, 8, 8800, 1130),
        (32000, {"dlpf": "bypass", "accel_dlpf": 1}, 0, 1, 1, 8800, 184),
    ],
)
def test_filters_are_set_as_asked(
    rate, options, config, fchoice, accel, bandwidth, accel_bandwidth
):
    chip, imu = running(rate=rate, configure=options)
    assert chip.register(CONFIG) == config
    assert chip.register(GYRO_CONFIG) & 3 == fchoice
    assert chip.register(ACCEL_CONFIG2) == accel
    assert (imu.bandwidth_hz, imu.accel_bandwidth_hz) == (bandwidth, accel_bandwidth)
    assert imu.sample_rate == (rate, 1)
    chip.poll(kernel.now())
    assert abs(chip.next_event() - kernel.now()) <= 1_000_000 // rate + 50
    assert tick(imu, 10_000) & FRESH and chip.misuse == []


@pytest.mark.parametrize(
    "options, message",
    [
        ({"dlpf": 8}, "dlpf 8 is not one of 0, 1, 2, 3, 4, 5, 6, 7, bypass"),
        ({"dlpf": "wide"}, "dlpf 'wide' is not"),
        ({"accel_dlpf": 9}, "accel_dlpf 9 is not one of"),
        ({"dlpf": 0}, "dlpf 0 of this MPU6500 runs at 8000 Hz only"),
        ({"dlpf": 7, "sample_rate_hz": 4000}, "dlpf 7 of this MPU6500 runs at 8000 Hz only"),
        ({"dlpf": "bypass", "sample_rate_hz": 8000}, "dlpf bypass of .* runs at 32000 Hz only"),
        ({"sample_rate_hz": 2000}, "dlpf 0 of this MPU6500 runs at 8000"),
        ({"sample_rate_hz": 300}, "300/1 is not 1000"),
    ],
)
def test_a_setting_that_the_chip_does_not_have_is_refused_by_name(options, message):
    wired()
    with pytest.raises(ValueError, match=message):
        driver().configure(**options)


def test_a_fifo_that_nobody_can_empty_is_refused():
    _, imu = running(rate=32000, configure={"dlpf": "bypass"})
    with pytest.raises(ValueError, match="32000"):
        imu.fifo_enable()


# Samples


# Faults in the tick


class Fault:
    """A wire between driver and chip: MISO at `level`, when it is not None."""

    def __init__(self, spi):
        self.spi = spi
        self.level = None
        self.error = None

    def init(self, baudrate):
        self.spi.init(baudrate=baudrate)

    def write(self, buffer):
        self.spi.write(buffer)
        if self.error:
            raise self.error

    def readinto(self, buffer, write=0):
        self.spi.readinto(buffer, write)
        if self.level is not None:
            for i in range(len(buffer)):
                buffer[i] = self.level


@pytest.mark.parametrize("level", [0x00, 0xFF])
def test_a_miso_that_sticks_is_counted_and_no_sample_comes_of_it(level):
    wire = Fault(machine.SPI(5))
    chip, imu = running(bus=wire)
    tick(imu)
    good = list(imu.counts)[:10]
    wire.level = level
    states = set()
    for _ in range(50):
        assert tick(imu) == 0
        states.add(imu.health())
    assert list(imu.counts) == [*good, 0]
    assert states == {HEALTH_BUS_ERROR}  # the line, not the chip
    assert imu.errors >= 50 and imu.resets == 0
    wire.level = None
    assert tick(imu) == FRESH
    for _ in range(60):
        assert imu.health() == HEALTH_OK
    assert chip.misuse == []


def test_a_clock_that_could_not_be_changed_is_set_again_before_the_next_access():
    spy = Spy(machine.SPI(5))
    chip, imu = running(bus=spy)
    real = spy.init
    imu.health()

    def refuse(baudrate):
        raise OSError(5)

    spy.init = refuse
    imu.registers.bind(spy)
    assert imu.read() == 0 and imu.errors == 1
    spy.init = real
    imu.registers.bind(spy)
    assert tick(imu) == FRESH and imu.health() == HEALTH_OK
    assert chip.misuse == []


# Health and repair


def quiet_ticks(imu, n):
    fresh = 0
    for _ in range(n):
        fresh += tick(imu) & FRESH
        imu.health()
    return fresh


@pytest.mark.parametrize("us, ticks", [(1000, 200), (5000, 40)])
def test_a_reset_in_flight_is_repaired_without_another_and_samples_are_back_in_200_ms(us, ticks):
    chip, imu = running(rate=1_000_000 // us, configure={"accel_range_g": 4})
    imu.set_rows([(0x25, 0x8E, 0xFF), (0x26, 0x02, 0xFF), (0x34, 9, 0x1F)])
    imu.set_user_ctrl(0x20, 0x20)
    tick(imu, us)
    good = list(imu.counts)[:10]
    chip.log = log = []
    chip.brown_out(kernel.now())
    back = None
    for i in range(ticks):
        if tick(imu, us) & FRESH:
            back = i if back is None else back
            assert list(imu.counts)[:10] == good  # neither another scale nor start-up
        imu.health()
    assert back is not None and back * us < 200_000
    assert imu.resets == 1
    writes = [(register, value) for _, register, value in log]
    assert not any(register == PWR_MGMT_1 and value & 0x80 for register, value in writes)
    # first I2C off, then the clock, the master's rows before the master
    assert writes[:2] == [(USER_CTRL, 0x10), (PWR_MGMT_1, 1)]
    assert writes[-4:] == [(0x25, 0x8E), (0x26, 0x02), (0x34, 9), (USER_CTRL, 0x30)]
    assert chip.misuse == []


@pytest.mark.parametrize("who", [0x70, 0x98])
def test_samples_are_withheld_until_the_gyro_has_settled(who):
    chip, imu = running(who_am_i=who)
    chip.brown_out(kernel.now())
    written = None
    while True:
        kernel.advance(1000)
        fresh = imu.read() & FRESH
        if imu.health() == HEALTH_REPAIRING and written is None and imu.monitor.state == VERIFY:
            written = kernel.now()
        if fresh:
            break
    assert 35_000 <= kernel.now() - written <= 100_000


def test_a_changed_register_of_others_is_found_and_put_right():
    chip, imu = running()
    imu.set_rows([(0x25, 0x8E, 0xFF), (0x34, 9, 0x1F)])
    chip.poke(0x25, 0x0C)
    states = [imu.health() for _ in range(len(imu.configuration()))]
    assert states.count(HEALTH_MISMATCH) == 1
    for _ in range(imu.monitor.repair_calls()):
        imu.health()
    assert chip.register(0x25) == 0x8E and imu.resets == 1


def test_bits_that_the_mask_leaves_out_are_nobodys_business():
    chip, imu = running()
    imu.set_rows([(0x34, 9, 0x1F)])
    chip._registers[0x34] |= 0x80  # a transaction under way
    assert {imu.health() for _ in range(30)} == {HEALTH_OK}
    chip._registers[0x34] = 8
    assert HEALTH_MISMATCH in {imu.health() for _ in range(30)}


def test_set_rows_changes_a_row_in_place_and_puts_a_new_one_before_user_ctrl():
    chip, imu = running()
    before = imu.configuration()
    calls = imu.monitor.repair_calls()
    imu.set_rows([(0x67, 0x81, 0xFF), (0x19, 1, 0xFF)])
    after = imu.configuration()
    assert after == [(0x19, 1) if row[0] == 0x19 else row for row in before[:-1]] + [
        (0x67, 0x81),
        before[-1],
    ]
    assert imu.monitor.repair_calls() == calls + 2
    assert chip.register(0x67) == 0x81
    imu.set_rows([(0x67, 0x82, 0xFF)])
    assert len(imu.configuration()) == len(after) and chip.register(0x67) == 0x82
    imu.configure()
    assert imu.configuration() == before and imu.monitor.repair_calls() == calls


def test_a_row_that_does_not_hold_is_reported_by_its_name():
    chip, imu = running()
    chip.stick(0x25, 0x11)
    with pytest.raises(MPU6500Error, match=r"I2C_SLV0_ADDR \(0x25\): wrote 0x8e, read 0x11"):
        imu.set_rows([(0x25, 0x8E, 0xFF)])


def test_single_registers_can_be_read_and_written():
    chip, imu = running()
    imu.write_register(0x63, 0x5A)
    assert imu.read_register(0x63) == 0x5A == chip.register(0x63)
    wire = Fault(machine.SPI(5))
    imu.registers.bind(wire)
    wire.error = OSError(5)
    with pytest.raises(imu.error_class, match=r"reading WHO_AM_I \(0x75\)"):
        imu.read_register(WHO_AM_I)


# What comes behind the sample


class Ext:
    def __init__(self, answer=MAG):
        self.answer = answer
        self.seen = []
        self.looks = 0

    def take(self, raw, at, counts):
        self.seen.append(bytes(raw[at : at + 7]))
        if self.answer:
            counts[6] = raw[at]
            counts[7] = raw[at + 6]
        return self.answer

    def health(self):
        self.looks += 1
        return 0


def attached(length=7, **options):
    chip, imu = running(**options)
    chip.master._ext[:8] = chip.master._complete[:8] = bytes(range(0x31, 0x39))
    chip.master._changed = True
    ext = Ext()
    imu.attach(ext, length)
    return chip, imu, ext


def test_its_bytes_come_in_the_same_burst():
    _chip, imu, ext = attached()
    bus = machine.SPI(5)._bus
    kernel.advance(1000)
    before = bus.bytes
    assert imu.read() == FRESH | MAG
    assert bus.bytes - before == 1 + 15 + 7
    assert ext.seen == [bytes(range(0x31, 0x38))]
    assert list(imu.counts)[6:8] == [0x31, 0x37] and imu.counts[10] == FRESH | MAG


def test_without_a_fresh_magnetometer_the_words_stay_and_bit_1_is_clear():
    _chip, imu, ext = attached()
    tick(imu)
    words = list(imu.counts)[6:9]
    ext.answer = 0
    assert tick(imu) == FRESH
    assert list(imu.counts)[6:9] == words and imu.counts[10] == FRESH


def test_a_stale_sample_gives_ext_nothing_and_clears_both_bits():
    chip, imu, ext = attached(rate=100)
    tick(imu, 10_000)
    n = len(ext.seen)
    assert n == 1 and imu.counts[10] == FRESH | MAG
    assert imu.read() == 0 and imu.counts[10] == 0
    chip.vanish()
    assert tick(imu) == 0
    assert len(ext.seen) == n


def test_ext_gets_every_second_look_that_finds_the_chip_in_order():
    chip, imu, ext = attached()
    tick(imu)
    states = [imu.health() for _ in range(40)]
    assert set(states) == {HEALTH_OK} and ext.looks == 20
    chip.poke(GYRO_CONFIG, 0)
    while imu.health() != HEALTH_MISMATCH:
        pass
    looks = ext.looks
    while imu.health() != HEALTH_OK:
        pass
    assert ext.looks - looks <= 1


def test_slow_samples_keep_neither_ext_nor_the_registers_from_their_turn():
    chip, imu, ext = attached(rate=20)
    chip.poke(GYRO_CONFIG, 0)
    states = []
    for _ in range(4 * len(imu.configuration()) + 4):
        tick(imu)
        states.append(imu.health())
    assert HEALTH_MISMATCH in states and ext.looks >= 5


def test_detached_it_is_left_alone():
    _chip, imu, ext = attached()
    imu.attach(None, 0)
    assert tick(imu) == FRESH and imu.health() == HEALTH_OK and imu.health() == HEALTH_OK
    assert ext.seen == [] and ext.looks == 0
    imu.attach(ext, 7)
    imu.configure()
    assert tick(imu) == FRESH and ext.seen == []


@pytest.mark.parametrize("length", [-1, 25])
def test_a_length_that_the_chip_does_not_have_is_refused(length):
    _, imu = running()
    with pytest.raises(ValueError, match="length"):
        imu.attach(Ext(), length)


@pytest.mark.parametrize("length", [0, 1, 24])
def test_every_length_is_read_and_none_too_fast(length):
    chip, imu, ext = attached(length)
    ext.answer = 0
    assert tick(imu) == FRESH and len(ext.seen) == 1
    assert chip.misuse == []


# Self-test


@pytest.mark.parametrize("options", [{"trims": (1,) * 6}, {"trims": (120,) * 6}])
def test_self_test_knows_every_trim(options):
    chip, imu = running(configure={"gyro_range_dps": 500, "accel_range_g": 4}, rate=200, **options)
    passed, changes = imu.self_test()
    assert passed is True
    assert all(abs(change) <= 2 for change in changes)
    for register, value in imu.configuration():
        assert chip.register(register) == value & (0xEF if register == USER_CTRL else 0xFF)
    assert tick(imu, 5000) & FRESH and chip.misuse == []


@pytest.mark.parametrize("axis", range(6))
def test_without_a_factory_value_absolute_limits_decide(axis):
    trims = [98, 104, 91, 128, 131, 125]
    trims[axis] = 0
    chip, imu = running(trims=tuple(trims))
    passed, changes = imu.self_test()
    assert passed is True and changes[axis] is None
    chip.broken = (axis,)
    assert imu.self_test()[0] is False


@pytest.mark.parametrize(
    "axis, codes, good",
    [
        (0, (138, 98), True),  # 1.01 ** 40 = 1.489
        (0, (140, 98), False),
        (0, (98, 167), True),  # 1.01 ** -69 = 0.503
        (0, (98, 169), False),
        (3, (98, 167), True),
        (3, (98, 169), False),
        (3, (169, 98), True),  # no upper limit
    ],
)
def test_the_limits_are_those_of_the_application_note(axis, codes, good):
    """codes: what the mass answers with, and what the factory wrote down."""
    actual, factory = codes
    trims = [98] * 6
    trims[axis] = actual
    chip, imu = running(trims=tuple(trims))
    chip._registers[(0x0D if axis < 3 else 0x00) + axis % 3] = factory
    assert imu.self_test()[0] is good


@pytest.mark.parametrize("dps, good", [(19, True), (-19, True), (21, False), (-21, False)])
def test_self_test_fails_for_a_gyro_that_is_far_off_at_rest(dps, good):
    counts = list(COUNTS)
    counts[4] = round(dps * 16.4)
    _, imu = running(tuple(counts))
    assert imu.self_test()[0] is good


def test_self_test_leaves_the_fifo_whole():
    _chip, imu = running()
    imu.fifo_enable()
    imu.self_test()
    kernel.advance(3000)
    imu.fifo_poll()
    kernel.advance(4500)
    assert imu.fifo_poll() in (4, 5)
    assert imu.fifo_next() & FRESH and imu.counts[2] == 4096


# On I2C


def on_i2c(cls, who=0x70, chip_class=MPU6050Chip, **options):
    chip = chip_class(StillWorld(COUNTS), who_am_i=who)
    machine.wire_i2c(0, chip)
    return chip, cls(machine.I2C(0, freq=400_000), **options)


@pytest.mark.parametrize("chip_class", [MPU6050Chip, MPU6500Chip])
def test_the_same_part_works_on_i2c(chip_class):
    chip, imu = on_i2c(MPU6500_I2C, chip_class=chip_class)
    imu.configure()
    assert imu.chip == "MPU6500" and tick(imu) == FRESH
    assert chip.misuse == [] and chip.register(USER_CTRL) == 0
    assert imu.self_test()[0] is True


@pytest.mark.parametrize("cls", [MPU6050, MPU6500_I2C])
def test_on_i2c_the_self_test_follows_the_identity(cls):
    chip, imu = on_i2c(cls)
    imu.configure()
    passed, changes = imu.self_test()
    assert passed is True and all(abs(change) <= 2 for change in changes)
    chip.broken = (4,)
    passed, changes = imu.self_test()
    assert passed is False and changes[4] == -1000


def test_on_i2c_too_an_mpu6050_is_refused_by_name():
    _, imu = on_i2c(MPU6500_I2C, 0x68)
    with pytest.raises(MPU6500Error, match=r"0x68 is an MPU6050.*use MPU6050"):
        imu.configure()


def test_on_i2c_an_absent_or_unknown_chip_is_told_in_its_own_name():
    with pytest.raises(MPU6500Error, match="no MPU6500 at 0x68"):
        MPU6500_I2C(machine.I2C(0)).configure()
    _, imu = on_i2c(MPU6500_I2C, 0x42)
    with pytest.raises(MPU6500Error, match=r"0x42.*accept_unknown=True uses it as an MPU6500"):
        imu.configure()
    _, imu = on_i2c(MPU6500_I2C, 0x42, accept_unknown=True, address=0x68)
    imu.configure()
    assert imu.family_6500 and imu.fifo_size == 512


# Allocation


def test_nothing_in_the_tick_allocates(micropython_runtime, portable):
    lines = portable(micropython_runtime, "mpu_alloc.py", "mpu6500").splitlines()
    assert len(lines) == 11
    assert sum(": ok 0 fresh" in line for line in lines) == 6
    assert sum(line.endswith(("found", "Hz: ok")) for line in lines) == 5


# The same everywhere


@pytest.fixture(scope="module")
def story():
    """What CPython tells."""
    done = runtimes.run("cpython", PORTABLE / "mpu6500_story.py", [], timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_story_has_every_kind_of_trouble_in_it(story):
    assert story.endswith("(False, (0, 0, 0, -1000, 0, 0)) []\n")
    last = story.splitlines()[-2].split("] ")[1].split()
    errors, stale, resets, overflows = (int(word) for word in last[:4])
    assert errors >= 20 and stale >= 1 and resets == 1 and overflows == 1


def test_every_runtime_tells_the_same_story(micropython_runtime, portable, story):
    assert portable(micropython_runtime, "mpu6500_story.py") == story
