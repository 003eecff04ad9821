"""The IST8310 driver behind an MPU and on a bus of its own: each measurement once, and what goes wrong."""

from array import array

import compasses
import kernel
import machine
import pytest
from chips.ist8310 import IST8310Chip
from compasses import BEHIND, FRESH, MAG_FRESH, gaps, still
from upright.auxiliary_bus import AuxiliaryBus
from upright.ist8310 import IST8310, IST8310Error
from upright.registers import I2CRegisters
from world import StillWorld

FIELD = (100, -200, 300)
WAI, STAT1, CNTL1, CNTL2, AVGCNTL, PDCNTL = 0x00, 0x02, 0x0A, 0x0B, 0x41, 0x42
SLV4_CTRL, PWR_MGMT_1 = 0x34, 0x6B


class Moving(StillWorld):
    """Another field at every microsecond that somebody looks at it, the same on all three axes."""

    def row(self, k):
        self._row[6] = self._row[7] = self._row[8] = 1 + (kernel.now() // 100) % 5000
        return self._row


class Rig(compasses.Rig):
    def __init__(self, place, world=None, rate=1000):
        super().__init__("IST8310", place, world or still(FIELD), rate)


@pytest.fixture(params=(*BEHIND, "own bus"))
def rig(request):
    return Rig(request.param)


@pytest.fixture(params=BEHIND)
def behind(request):
    return Rig(request.param)


# Set-up


def test_configure_finds_resets_and_configures_it(rig):
    rig.mag_chip.log = log = []
    start = kernel.now()
    rig.configure()
    took = kernel.now() - start
    written = {register: value for _, register, value in log if register != CNTL1}
    assert written == {CNTL2: 0x0C, AVGCNTL: 0x24, PDCNTL: 0xC0}
    assert (CNTL2, 0x01) in [(register, value) for _, register, value in log]
    assert took < rig.mag_chip.reset_us + 20_000  # its reset bit is waited for, not a fixed time
    assert rig.mag.present
    assert rig.mag.chip == "IST8310"
    assert rig.mag.lsb_per_uT == (33, 10)
    assert rig.mag.sample_rate == (100, 1)
    assert rig.chip.misuse == rig.mag_chip.misuse == []


def test_a_magnetometer_that_is_late_after_power_up_is_waited_for(rig):
    rig.mag_chip.power_up_us = 50_000
    rig.mag_chip.brown_out(kernel.now())
    rig.configure()


def test_another_chip_at_its_address_is_refused_and_shown(rig):
    rig.mag_chip.stick(WAI, 0x48)
    with pytest.raises(IST8310Error, match=rf"0x0e{rig.where} .*0x48.*0x10.*another chip"):
        rig.configure()


def test_an_identity_that_was_overwritten_is_mended_by_a_reset(rig):
    rig.mag_chip._registers[WAI] = 0x55
    rig.configure()
    assert rig.run(30)


@pytest.mark.parametrize("register", [CNTL2, AVGCNTL, PDCNTL])
def test_a_register_that_does_not_keep_its_value_is_reported(rig, register):
    rig.mag_chip.stick(register, 0x00)
    with pytest.raises(IST8310Error, match=rf"register 0x{register:02x} .* read 0x00"):
        rig.configure()


def test_a_magnetometer_stuck_in_reset_is_reported(rig):
    rig.mag_chip.stick(CNTL2, 0x01)
    with pytest.raises(IST8310Error, match="did not come out of reset"):
        rig.configure()


def test_a_chip_that_shares_an_address_is_not_said_to_be_an_ist8310(rig):
    """A QMC5883L sits at 0x0D, as an IST8310 can; its register 0x0B (SET/RESET period) keeps what is written to it."""
    rig.mag_chip.address = 0x0D
    rig.mag_chip.stick(WAI, 0x55)
    rig.mag_chip.stick(CNTL2, 0x01)
    bus = machine.I2C(1, freq=400_000) if rig.mag.own_bus else AuxiliaryBus(rig.imu)
    with pytest.raises(IST8310Error, match=rf"0x0d{rig.where} answers .*another chip"):
        IST8310(bus, 0x0D).configure()


def test_an_imu_that_sleeps_is_blamed_and_not_the_magnetometer(behind):
    behind.imu.sleep()
    with pytest.raises(IST8310Error, match="IMU awake"):
        behind.configure()


def test_a_bus_can_be_given_as_the_chips_registers():
    chip = IST8310Chip(StillWorld((0, 0, 4096, 0, 0, 0, *FIELD)))
    machine.wire_i2c(1, chip)
    mag = IST8310(I2CRegisters(machine.I2C(1, freq=400_000), 0x0E))
    mag.configure()
    assert mag.own_bus and mag.present
    chip.stick(AVGCNTL, 0)
    with pytest.raises(IST8310Error, match="register 0x41 of the IST8310"):
        mag.configure()
    with pytest.raises(TypeError, match="AuxiliaryBus"):
        IST8310(5)


@pytest.mark.parametrize(
    "sample_rate, rate_hz, average, n",
    [
        (1000, 100, 16, 10),
        (1000, 142, 16, 8),
        (1000, 143, 16, 7),
        (1000, 180, 4, 6),
        (1000, 32, 1, 32),
        ((2000, 7), 160, 16, 2),
        ((2000, 7), 100, 16, 3),
        (200, 100, 16, 2),
        (100, 100, 16, 2),  # never faster than every second sample
        (500, (100, 3), 8, 15),
    ],
)
def test_the_rate_is_the_next_lower_part_of_the_sample_rate(sample_rate, rate_hz, average, n):
    mag = Rig("behind").mag
    mag.configure(rate_hz, average, sample_rate)
    num, den = sample_rate if isinstance(sample_rate, tuple) else (sample_rate, 1)
    assert mag.sample_rate[0] * den * n == num * mag.sample_rate[1]


@pytest.mark.parametrize(
    "arguments, what",
    [
        # a trigger every 6 ms leaves no room for the two chips' clocks
        ({"rate_hz": 167}, "at most 1000/7 Hz"),
        ({"rate_hz": 250}, "at most 1000/7 Hz"),
        ({"rate_hz": 200, "average": 4}, "at most 1000/6 Hz"),
        ({"rate_hz": 31}, "a 32nd of 1000/1"),
        ({"rate_hz": 0}, "rate_hz 0"),
        ({"rate_hz": 100.0}, "rate_hz 100.0"),
        ({"average": 3}, "average 3 is not one of 1, 2, 4, 8, 16"),
        ({"sample_rate": 8000, "rate_hz": 250}, "no rate at all"),
    ],
)
def test_what_the_chip_cannot_do_is_refused(arguments, what):
    with pytest.raises(ValueError, match=what):
        Rig("behind").mag.configure(**arguments)


# Samples


@pytest.mark.parametrize("kind", ["spi", "own bus"])
@pytest.mark.parametrize("rate, n", [(500, 5), (250, 3), (200, 2), (100, 2)])
def test_other_sample_rates_of_the_imu(kind, rate, n):
    rig = Rig(kind, rate=rate)
    rig.configure(rate_hz=100)
    rig.until(MAG_FRESH)
    ticks = rig.run(300)
    assert gaps(ticks) == {n}
    assert (rig.mag.stale, rig.mag.errors, rig.mag.resets) == (0, 0, 0)
    assert rig.mag.sample_rate[0] * n == rate * rig.mag.sample_rate[1]


def test_a_program_gets_microteslas(rig):
    assert rig.mag.field() is None
    rig.configure()
    assert rig.mag.field() is None
    rig.until(MAG_FRESH)
    assert rig.mag.field() == pytest.approx((100 / 3.3, -200 / 3.3, 300 / 3.3))


def test_read_does_nothing_where_the_imu_brings_the_measurement(behind):
    behind.start()
    counts = array("h", range(11))
    assert behind.mag.read(counts) == 10
    assert list(counts) == list(range(11))


def test_between_measurements_the_words_stay_and_bit_1_is_clear(rig):
    rig.start()
    rig.world.set((0, 0, 4096, 0, 0, 0, 7, 8, 9))
    flags = rig.tick()
    assert flags & FRESH and not flags & MAG_FRESH
    assert tuple(rig.imu.counts[6:9]) == FIELD
    rig.run(25)
    assert tuple(rig.imu.counts[6:9]) == (7, 8, 9)


def test_a_field_beyond_the_range_is_withheld_and_counted(rig):
    rig.start()
    for word in range(3):
        field = [0, 0, 0]
        field[word] = -8192 if word == 2 else -5281  # z is out of 14 bits before it is out of range
        rig.world.set((0, 0, 4096, 0, 0, 0, *field))
        rig.run(20)
        saturated = rig.mag.saturated
        rig.run(100)
        if word < 2:
            assert rig.mag.saturated - saturated == 10
    rig.mag_chip._registers[0x0D] = 0x70  # 16 bits: four times as many counts
    rig.world.set((0, 0, 4096, 0, 0, 0, 0, 0, 2100))
    rig.run(20)
    saturated = rig.mag.saturated
    rig.run(100)
    assert rig.mag.saturated - saturated == 10
    assert rig.mag.stale == 0


@pytest.mark.parametrize("axis, most", [(0, 5280), (1, 5280), (2, 8250)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_range_of_each_axis_is_the_data_sheets(axis, most, sign):
    """1600 uT for x and y, 2500 uT for z (DS 4.4)."""
    rig = Rig("own bus")
    rig.configure()
    field = [0, 0, 0]
    for value, delivered in ((most, True), (most + 1, False)):
        field[axis] = sign * value
        raw = b"\x01" + array("h", field).tobytes()
        assert rig.mag.take(raw, 0, rig.imu.counts) == (MAG_FRESH if delivered else 0)
    assert rig.imu.counts[6 + axis] == sign * most
    assert rig.mag.field()[axis] == pytest.approx(
        sign * most / 3.3
    )  # of the last one that was delivered
    assert (rig.mag.fresh, rig.mag.saturated) == (1, 1)


@pytest.mark.parametrize("took", range(5500, 6121, 40))
def test_a_measurement_that_ends_at_any_moment_of_the_round_is_delivered_once_and_whole(took):
    rig = Rig("behind", Moving())
    rig.configure()
    rig.mag_chip.measure_us = took
    rig.until(MAG_FRESH)
    rig.run(20)
    seen = set()
    for _ in range(300):
        if rig.tick() & MAG_FRESH:
            x, y, z = rig.imu.counts[6:9]
            assert x == y == z  # none made of two measurements
            seen.add(x)
    assert len(seen) == 30
    assert rig.mag.stale == 0


def test_without_dren_measurements_are_still_found_by_their_data():
    """The IST8310 example that is widely copied writes CNTL2 = 0, and with it DRDY is never set."""
    rig = Rig("behind", Moving())
    rig.start()
    rig.mag_chip.poke(CNTL2, 0)
    fresh = rig.mag.fresh
    for _ in range(100):
        rig.tick(health=False)
    assert abs(rig.mag.fresh - fresh - 10) <= 1
    assert rig.mag.unflagged >= 9


def trigger_every_4_samples(rig):
    """What the widely copied example does: SLV4_CTRL = 3 with an average of 16, which needs 6 ms."""
    rig.chip.poke(SLV4_CTRL, 3)


def read_only(rig, n):
    """Ticks without health(), which would put the register right."""
    fresh = rig.mag.fresh
    stale = rig.mag.stale
    for _ in range(n):
        rig.tick(health=False)
    return rig.mag.fresh - fresh, rig.mag.stale - stale


def test_triggers_that_come_too_fast_show_as_stale(behind):
    behind.configure()
    behind.mag_chip.restarts = True  # each begins the measurement anew
    behind.until(MAG_FRESH)
    assert read_only(behind, 100) == (10, 0)
    trigger_every_4_samples(behind)
    read_only(behind, 10)
    fresh, stale = read_only(behind, 1000)
    assert (fresh, stale) == (0, 100)


def test_a_driver_that_believed_in_4_ms_would_count_every_second_one_as_stale(behind):
    behind.configure()  # it refuses rate_hz=250
    trigger_every_4_samples(behind)  # the ones in between are lost
    behind.mag._state[7] = 4  # the samples that it expects between two measurements,
    behind.mag._state[6] = 4 + 3  # and those that it waits
    read_only(behind, 20)
    fresh, stale = read_only(behind, 1000)
    assert fresh == 125 and stale == 125  # of the 250 that were asked for


def test_health_puts_the_period_right(behind):
    behind.configure()
    behind.run(20)
    trigger_every_4_samples(behind)
    behind.run(600)
    assert behind.chip.register(SLV4_CTRL) & 0x1F == 9
    assert behind.imu.resets <= 1  # where a transaction of slot 4 has not put it right before
    assert gaps(behind.run(200)) == {10}


def test_bytes_that_a_silent_magnetometer_leaves_behind_are_not_used_again(behind):
    behind.configure()
    for phase in range(12):
        behind.until(MAG_FRESH)
        for _ in range(phase):
            behind.tick()
        behind.mag_chip.vanish()
        behind.tick()
        fresh, stale = read_only(behind, 60)
        assert fresh == 0 and stale >= 4
        behind.mag_chip.come_back()
        behind.until(MAG_FRESH)


def test_a_bus_that_nobody_drives_is_no_measurement(rig):
    rig.start()
    counts = rig.imu.counts
    for status, byte in ((0xFF, 0xFF), (0x00, 0x00), (0x01 | 0x80, 0x12), (0x00, 0x00)):
        raw = bytes([status]) + bytes([byte]) * 6
        for _ in range(3):
            assert rig.mag.take(raw, 0, counts) == 0


# Faults in the tick


@pytest.mark.parametrize("both", [False, True])
def test_a_reset_of_the_imu_in_flight(rig, both):
    rig.start()
    rig.chip.log = log = []
    rig.chip.brown_out(kernel.now())
    if both:
        rig.mag_chip.brown_out(kernel.now())
    start = kernel.now()
    while rig.imu.resets == 0:
        rig.tick()
        assert kernel.now() - start < 200_000
    while not rig.tick() & FRESH:
        assert kernel.now() - start < 200_000
    rig.until(MAG_FRESH)
    assert kernel.now() - start < 500_000
    rig.run(500)
    assert rig.imu.resets == 1
    assert rig.mag.resets == both
    assert not [value for _, register, value in log if register == PWR_MGMT_1 and value & 0x80]
    assert gaps(rig.run(300)) == {10}


def test_an_identity_lost_in_flight_is_mended_by_a_soft_reset(rig):
    rig.start()
    rig.mag_chip._registers[WAI] = 0x11
    rig.run(1000)
    assert rig.mag_chip.register(WAI) == 0x10
    assert rig.mag_chip.register(PDCNTL) == 0xC0
    assert rig.mag.resets == 1
    assert gaps(rig.run(300)) == {10}


def test_while_a_register_is_wrong_nothing_is_delivered(rig):
    rig.start()
    rig.mag_chip.stick(PDCNTL, 0x00)
    while not rig.mag.resets:
        rig.tick()
    assert rig.run(1000) == []
    rig.mag_chip.stick(PDCNTL)
    assert rig.until(MAG_FRESH) < 500_000
    assert rig.mag.resets == 1  # however often it was written


def test_one_look_at_a_register_that_fails_costs_nothing(rig, monkeypatch):
    rig.start()
    write = rig.mag_chip.i2c_write
    refused = []

    def refusing(byte, now):
        """Every second time that somebody points at PDCNTL."""
        if rig.mag_chip._pointing and byte == PDCNTL:
            refused.append(now)
            if len(refused) % 2:
                return False
        return write(byte, now)

    monkeypatch.setattr(rig.mag_chip, "i2c_write", refusing)
    assert gaps(rig.run(1000)) == {10}
    assert rig.mag.errors == (len(refused) + 1) // 2 >= 5
    assert rig.mag.present


def test_health_costs_two_accesses_at_the_most(rig, monkeypatch):
    rig.mag_chip.vanish()
    with pytest.raises(IST8310Error):
        rig.configure()
    rig.mag.attach()
    accesses = []
    bus = rig.mag._registers if rig.mag.own_bus else rig.imu.registers
    read, write = bus.read_into, bus.write
    monkeypatch.setattr(bus, "read_into", lambda r, b: accesses.append(r) or read(r, b))
    monkeypatch.setattr(bus, "write", lambda r, v: accesses.append(r) or write(r, v))
    for i in range(300):
        if i == 100:
            rig.mag_chip.come_back()
        kernel.advance(1000)
        accesses.clear()
        rig.mag.health()
        assert 1 <= len(accesses) <= 2
    assert rig.mag.present


def test_configure_again_with_another_rate(behind):
    behind.configure(rate_hz=100)
    behind.run(50)
    behind.configure(rate_hz=50)
    behind.until(MAG_FRESH)
    assert gaps(behind.run(400)) == {20}
    behind.imu.configure(sample_rate_hz=1000)
    assert behind.run(50) == []
    behind.start()
    assert gaps(behind.run(300)) == {10}
    assert behind.imu.resets == 0
    assert behind.chip.misuse == []


# On a bus of its own


def test_on_a_bus_of_its_own_it_is_left_alone_while_it_measures():
    rig = Rig("own bus")
    rig.start()
    busy = []
    for _ in range(10):
        before = rig.bus.bytes
        rig.tick()
        busy.append(rig.bus.bytes - before)
    assert busy.count(0) >= 5
    assert max(busy) <= 16


def test_on_a_bus_of_its_own_a_trigger_that_was_lost_is_given_again():
    rig = Rig("own bus")
    rig.start()
    rig.mag_chip.poke(CNTL1, 0)  # stops a measurement under way
    rig.run(5)
    rig.mag_chip.poke(CNTL1, 0)
    assert rig.run(40)
    assert rig.mag.stale <= 1
