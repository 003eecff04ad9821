"""The simulated IST8310 against its datasheet: what it must do, and what it must not forgive."""

import kernel
import machine
import pytest
from bare_bus import Bus, Nack
from chips.ist8310 import IST8310Chip
from world import StillWorld

WAI, STAT1, DATAXL, STAT2, CNTL1, CNTL2, STR, CNTL3 = 0, 2, 3, 9, 0x0A, 0x0B, 0x0C, 0x0D
AVGCNTL, PDCNTL = 0x41, 0x42
SINGLE, DRDY, DOR = 1, 1, 2
FIELD = (100, -200, 300)


def still(field=FIELD):
    return StillWorld((0, 0, 4096, 0, 0, 0, *field))


class FieldRamp(StillWorld):
    """Row k, one a millisecond, has k in every magnetometer word."""

    def __init__(self, n=1 << 15):
        super().__init__((), (1000, 1), n=n)

    def row(self, k):
        self.set([0] * 6 + [k] * 3)
        return self._row


def configured(world=None, average=0x24, **options):
    bus = Bus(IST8310Chip(world or still(), **options))
    bus.write(AVGCNTL, average)
    bus.write(PDCNTL, 0xC0)
    return bus


def words(bus):
    data = bus.read(DATAXL, 6)
    return tuple(int.from_bytes(data[i : i + 2], "little", signed=True) for i in (0, 2, 4))


def measured(bus):
    bus.write(CNTL1, SINGLE)
    bus.now += 10_000
    return words(bus)


# Identity and reset


def test_identity_and_reset_values():
    bus = Bus(IST8310Chip(still()))
    assert bus.read(WAI) == 0x10
    assert bus.read(CNTL2) == 0x0C
    assert [bus.read(r) for r in (STAT1, STAT2, CNTL1, STR, CNTL3, PDCNTL)] == [0] * 6
    bus.write(WAI, 0x55)
    assert bus.read(WAI) == 0x10


def test_a_soft_reset_takes_its_time_and_forgets_everything():
    bus = configured()
    bus.write(CNTL1, SINGLE)
    bus.write(CNTL2, 0x01)
    with pytest.raises(Nack):
        bus.read(WAI)
    with pytest.raises(Nack):
        bus.write(AVGCNTL, 0x24)
    bus.now += 50_000  # DS 4.5: at most
    assert bus.read(CNTL2) == 0x0C  # SRST has cleared itself
    assert bus.read(PDCNTL) == 0
    assert bus.read(STAT1) == 0 and bus.chip.measurements == 0


def test_the_reset_pin_holds_it_silent():
    bus = configured()
    bus.chip.reset_pin(0, bus.now)
    bus.now += 1_000_000
    with pytest.raises(Nack):
        bus.read(WAI)
    bus.chip.reset_pin(1, bus.now)
    with pytest.raises(Nack):
        bus.read(WAI)
    bus.now += 50_000
    assert (bus.read(WAI), bus.read(PDCNTL)) == (0x10, 0)


# A measurement


@pytest.mark.parametrize("average, us", [(0x24, 6000), (0x12, 5000)])
def test_a_measurement_takes_its_time(average, us):
    bus = configured(average=average)
    bus.write(CNTL1, SINGLE)
    assert bus.read(CNTL1) == SINGLE
    bus.now += us - 1
    assert bus.read(STAT1) == 0
    bus.now += 2
    assert bus.read(STAT1) == DRDY
    assert bus.read(CNTL1) == 0  # stand-by again, by itself
    bus.now += 1_000_000
    assert bus.chip.measurements == 1


def test_fewer_averages_are_quicker():
    times = []
    for code in range(5):
        bus = configured(average=code << 3 | code)
        times.append(bus.chip.measurement_us())
    assert times == sorted(times) and len(set(times)) == 5
    assert configured(average=0x3F).chip.measurement_us() == times[0]  # DS 6.4: all others none


def test_data_are_little_endian_and_the_old_ones_until_it_is_through():
    bus = configured()
    assert measured(bus) == FIELD
    bus.chip.world.set((0,) * 6 + (-1, 2, -3))
    bus.write(CNTL1, SINGLE)
    bus.now += 5000
    assert words(bus) == FIELD
    bus.now += 5000
    assert words(bus) == (-1, 2, -3)


def test_without_a_trigger_nothing_is_measured():
    bus = configured()
    bus.now += 1_000_000
    assert words(bus) == (0, 0, 0)
    bus.write(CNTL1, 0)
    bus.now += 1_000_000
    assert bus.read(STAT1) == 0


def test_stand_by_ends_a_measurement():
    bus = configured()
    bus.write(CNTL1, SINGLE)
    bus.write(CNTL1, 0)
    bus.now += 10_000
    assert bus.chip.measurements == 0


def test_it_measures_the_world_in_the_middle_of_its_time():
    world = FieldRamp()
    bus = configured(world)
    world.start(0)
    bus.now = 100_200
    bus.write(CNTL1, SINGLE)
    bus.now += 50_000
    assert words(bus) == (103, 103, 103)  # 100.2 ms + 3 ms


@pytest.mark.parametrize("restarts, at", [(False, 6001), (True, 10_001)])
def test_a_trigger_during_a_measurement_is_lost_or_begins_it_anew(restarts, at):
    bus = configured(restarts=restarts)
    bus.write(CNTL1, SINGLE)
    bus.now += 4000
    bus.write(CNTL1, SINGLE)
    bus.now = at - 2
    assert bus.read(STAT1) == 0
    bus.now = at
    assert bus.read(STAT1) == DRDY
    bus.now = 1_000_000
    assert bus.chip.measurements == 1


def test_other_modes_are_reserved():
    bus = configured()
    bus.write(CNTL1, 0x0B)
    bus.now += 10_000
    assert bus.chip.measurements == 0 and bus.chip.misuse


def test_measuring_with_another_pulse_duration_is_noted():
    bus = Bus(IST8310Chip(still()))
    measured(bus)
    assert len(bus.chip.misuse) == 1 and "PDCNTL" in bus.chip.misuse[0]
    bus = configured()
    measured(bus)
    assert bus.chip.misuse == []


# DRDY


def ready(bus):
    bus.write(CNTL1, SINGLE)
    bus.now += 10_000
    return bus


@pytest.mark.parametrize(
    "register, clears",
    [(r, True) for r in range(DATAXL, STAT2 + 1)] + [(WAI, False), (STAT1, False), (CNTL1, False)],
)
def test_drdy_is_cleared_by_reading_data_or_stat2_only(register, clears):
    bus = ready(configured())
    bus.read(register)
    assert bus.read(STAT1) == (0 if clears else DRDY)


def test_one_burst_from_stat1_shows_drdy_once():
    bus = ready(configured())
    assert bus.read(STAT1, 7)[0] == DRDY
    assert bus.read(STAT1, 7) == bytes((0, 100, 0, 56, 255, 44, 1))


def test_a_measurement_that_nobody_read_sets_overrun_until_data_are_read():
    bus = ready(ready(configured()))
    assert bus.read(STAT1) == DRDY | DOR
    bus.read(STAT2)
    assert bus.read(STAT1) == DOR
    bus.read(DATAXL)
    assert bus.read(STAT1) == 0


def test_without_dren_there_is_no_drdy():
    bus = configured()
    bus.write(CNTL2, 0x00)
    ready(bus)
    assert bus.read(STAT1) == 0
    assert words(bus) == FIELD


def test_a_measurement_that_ends_in_the_middle_of_a_burst_tears_it_and_loses_its_drdy():
    bus = configured(FieldRamp())
    bus.chip.world.start(0)
    for _ in range(2):
        bus.now += 280_000
        bus.write(CNTL1, SINGLE)
        bus.now += 5950
        torn = bus.read(STAT1, 7, us_per_byte=23)
    old, new = (283).to_bytes(2, "little"), (569).to_bytes(2, "little")
    assert torn == b"\0" + old + new + new
    assert bus.read(STAT1) == 0


@pytest.mark.parametrize("control, idle", [(0x0C, 0), (0x08, 1)])
def test_the_pin_follows_drdy_with_its_polarity(control, idle):
    machine.power_on()
    bus = configured()
    bus.write(CNTL2, control)
    machine.wire_pin("PE3", bus.chip)
    pin = machine.Pin("PE3")
    levels = []
    pin.irq(lambda p: levels.append((p(), kernel.now())), hard=True)
    assert pin() == idle
    bus.now = kernel.now()
    bus.write(CNTL1, SINGLE)
    kernel.changed()
    kernel.advance(10_000)
    assert levels == [(1 - idle, 6000)]
    bus.now = kernel.now()
    words(bus)
    assert pin() == idle


# Values


@pytest.mark.parametrize(
    "axes, chip_words",
    [
        (("x", "y", "z"), (100, -200, 300)),
        (("x", "y", "-z"), (100, -200, -300)),
        (("-y", "x", "z"), (-200, -100, 300)),
        (("z", "-x", "y"), (200, 300, 100)),
    ],
)
def test_the_boards_axis_map_is_undone(axes, chip_words):
    bus = configured(axes=axes)
    seen = measured(bus)
    assert seen == chip_words
    body = tuple((-1 if a[0] == "-" else 1) * seen["xyz".index(a[-1])] for a in axes)
    assert body == FIELD


def test_an_axis_map_that_names_an_axis_twice_is_refused():
    with pytest.raises(ValueError):
        IST8310Chip(still(), axes=("x", "-x", "z"))


def test_14_bits_saturate():
    bus = configured(still((8191, 8192, -20_000)))
    assert measured(bus) == (8191, 8191, -8192)


def test_16_bits_are_four_times_as_fine():
    bus = configured(still((100, -200, 20_000)))
    bus.write(CNTL3, 0x50)
    assert measured(bus) == (400, -200, 32767)


@pytest.mark.parametrize("field, strong", [((1760, -1760, 1760), 0), ((1760, -1761, 1760), 8)])
def test_stat2_tells_of_a_field_above_1600_ut(field, strong):
    bus = configured(still(field))
    measured(bus)
    assert bus.read(STAT2) == strong


def test_self_test_turns_the_polarity_round():
    bus = configured()
    bus.write(STR, 0x40)
    assert measured(bus) == (-100, 200, -300)


# Faults


def test_faults_can_be_injected():
    bus = configured()
    bus.chip.nack_next(1, after=2)
    with pytest.raises(Nack):
        bus.read(WAI)
    assert bus.read(WAI) == 0x10
    bus.chip.vanish()
    with pytest.raises(Nack):
        bus.read(WAI)
    bus.chip.come_back()
    assert bus.read(AVGCNTL) == 0x24  # the wire was broken, not the supply
    bus.chip.stick(STAT1, 0)
    assert ready(bus).read(STAT1) == 0
    bus.chip.stick(STAT1)
    assert bus.read(STAT1) == DRDY
    bus.chip.poke(AVGCNTL, 0)
    assert bus.read(AVGCNTL) == 0
    bus.chip.brown_out(bus.now)
    with pytest.raises(Nack):
        bus.read(WAI)
    bus.now += 50_000
    assert (bus.read(WAI), bus.read(PDCNTL)) == (0x10, 0)


def test_writes_can_be_logged():
    bus = configured()
    bus.chip.log = []
    bus.write(AVGCNTL, 0x1B, 0xC0)
    assert bus.chip.log == [(bus.now, AVGCNTL, 0x1B), (bus.now, PDCNTL, 0xC0)]


def test_cut_off_in_mid_transaction_it_wants_a_clock_or_a_reset():
    bus = configured()
    bus.chip.bus_cut(bus.now)
    with pytest.raises(Nack):
        bus.read(WAI)
    assert bus.read(WAI) == 0x10
    bus.chip.clocks_free = False
    bus.chip.bus_cut(bus.now)
    for _ in range(5):
        with pytest.raises(Nack):
            bus.read(WAI)
    bus.chip.reset_pin(0, bus.now)
    bus.chip.reset_pin(1, bus.now)
    bus.now += 50_000
    assert bus.read(WAI) == 0x10


def test_it_works_on_a_boards_own_bus():
    machine.power_on()
    machine.wire_i2c(0, IST8310Chip(still()))
    i2c = machine.I2C(0)
    assert i2c.scan() == [0x0E]
    i2c.writeto_mem(0x0E, PDCNTL, b"\xc0")
    i2c.writeto_mem(0x0E, CNTL1, b"\x01")
    kernel.advance(6000)
    assert i2c.readfrom_mem(0x0E, STAT1, 7) == bytes((1, 100, 0, 56, 255, 44, 1))
    with pytest.raises(OSError):
        i2c.readfrom_mem(0x0C, WAI, 1)
