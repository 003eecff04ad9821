"""The drivers of all magnetometers behind an MPU, in bypass and on the main bus; the search for them."""

import itertools

import compasses
import kernel
import machine
import pytest
from compasses import BEHIND, FRESH, KINDS, MAG_FRESH, gaps, still
from imus import RIGS
from upright import magnetometers, settings
from upright.ak8963 import AK8963, AK8963Error
from upright.auxiliary_bus import AuxiliaryBus
from upright.ist8310 import IST8310
from upright.magnetometers import MagnetometerNotFound
from world import StillWorld

FIELD = (99, -198, 66)  # counts of the world, 3.3 per uT: 30, -60, 20 uT
MICROTESLA = (30, -60, 20)
INT_PIN_CFG = 0x37
PLACES = ("spi", "behind", "bypass", "main bus")


class Noisy(StillWorld):
    """Two measurements that follow each other are never the same, as on a board."""

    def row(self, k):
        row = list(StillWorld.row(self, k))
        row[6] += kernel.now() // 3000 % 5 - 2
        return row


class Rig(compasses.Rig):
    def __init__(self, name, place, rate=1000, **options):
        world = Noisy((10, -20, 4096, 5, 6, -7, *FIELD, -521))
        super().__init__(name, place, world, rate, **options)


@pytest.fixture(params=[(name, place) for name in KINDS for place in PLACES], ids="-".join)
def rig(request):
    return Rig(*request.param)


# Samples


def test_every_measurement_is_delivered_once_in_microtesla(rig):
    rig.start()
    ticks = rig.run(1000)
    assert len(ticks) in (99, 100, 101)
    assert gaps(ticks) <= rig.gaps
    assert rig.mag.field() == pytest.approx(MICROTESLA, abs=0.9)
    assert rig.mag_chip.measurements - rig.mag.fresh in (0, 1, 2)
    assert (rig.mag.stale, rig.mag.saturated) == (0, 0)
    assert (rig.mag.errors, rig.mag.resets, rig.imu.resets, rig.imu.errors) == (0, 0, 0, 0)
    assert rig.chip.misuse == rig.mag_chip.misuse == []


@pytest.mark.parametrize("rate", [200, 500])
@pytest.mark.parametrize("place", ["behind", "main bus"])
@pytest.mark.parametrize("name", KINDS)
def test_other_sample_rates(name, place, rate):
    rig = Rig(name, place, rate)
    rig.start(rate_hz=100)
    assert len(rig.run(2 * rate)) in range(199, 202)
    assert (rig.mag.stale, rig.mag.errors, rig.mag.resets) == (0, 0, 0)
    assert rig.mag.sample_rate == (100, 1)


def test_another_field_is_seen_within_two_measurements(rig):
    rig.start()
    rig.world.set((0, 0, 4096, 0, 0, 0, -33, 66, 132))
    rig.run(25)
    assert rig.mag.field() == pytest.approx((-10, 20, 40), abs=0.9)


@pytest.mark.parametrize("field", [(20_000, 0, 0), (0, -20_000, 0), (0, 0, 20_000)])
def test_a_field_beyond_the_range_is_withheld_and_counted(rig, field):
    if rig.mag.chip == "IST8310" and field[2]:
        pytest.skip("its 14 bits end before the range of z: test_ist8310.py")
    rig.start()
    rig.world.set((0, 0, 4096, 0, 0, 0, *field))
    rig.run(25)
    saturated, fresh = rig.mag.saturated, rig.mag.fresh
    rig.run(300)
    assert rig.mag.saturated - saturated in (29, 30, 31)
    assert rig.mag.fresh == fresh
    assert rig.mag.stale == 0
    rig.world.set((0, 0, 4096, 0, 0, 0, *FIELD))
    assert rig.until(MAG_FRESH) < 50_000


def test_the_fifo_carries_it_too():
    for name, place in itertools.product(KINDS, BEHIND):
        machine.power_on()
        rig = Rig(name, place)
        rig.configure()
        rig.imu.fifo_enable(batch=10)
        fresh = packets = 0
        for _ in range(100):
            kernel.advance(10_000 - kernel.now() % 10_000)
            for _ in range(rig.imu.fifo_poll()):
                flags = rig.imu.fifo_next()
                packets += flags & FRESH
                fresh += flags >> 1 & 1
            rig.imu.health()
        assert packets > 950
        assert abs(fresh - packets // 10) <= 2
        assert rig.imu.fifo_overflows == rig.mag.stale == rig.imu.resets == 0


# What is special to each


@pytest.mark.parametrize("bits, scale", [(16, (20, 3)), (14, (5, 3))])
@pytest.mark.parametrize("place", ["behind", "bypass"])
def test_the_fuse_rom_corrects_the_ak8963(place, bits, scale):
    rig = Rig("AK8963", place, asa=(228, 28, 128))
    rig.mag = AK8963(AuxiliaryBus(rig.imu) if place == "behind" else rig.i2c, bits=bits)
    rig.start()
    assert rig.mag.lsb_per_uT == scale and rig.mag.adjusted
    assert list(rig.mag.gains) == [356, 156, 256]
    assert rig.mag.field() == pytest.approx(MICROTESLA, abs=1.2)


@pytest.mark.parametrize("asa", [(0, 0, 0), (255, 255, 255), (128, 0, 130)])
def test_an_ak8963_without_a_fuse_rom_is_not_corrected(asa):
    rig = Rig("AK8963", "bypass", asa=asa)
    rig.start()
    assert not rig.mag.adjusted
    assert list(rig.mag.gains) == [256] * 3


def test_the_ak8963_is_asked_for_no_more_than_it_can():
    with pytest.raises(ValueError, match="at most 1000/10 Hz"):
        Rig("AK8963", "behind").configure(rate_hz=120)
    with pytest.raises(ValueError, match="bits 12"):
        AK8963(machine.I2C(0), bits=12)


@pytest.mark.parametrize("place", PLACES)
def test_an_hmc5883l_whose_ready_flag_stays_is_read_as_well(place):
    """Two places of its datasheet differ on what clears RDY. Behind a master a measurement is then new if its data
    differ."""
    rig = Rig("HMC5883L", place, ready_stays=True)
    rig.configure()
    n = 0
    for i in range(1000):
        rig.world.set((0, 0, 4096, 0, 0, 0, *[v + i % 64 for v in FIELD]))
        n += rig.tick() >> 1 & 1
    assert n in (98, 99, 100)


def test_an_average_of_eight_takes_the_hmc5883l_longer():
    rig = Rig("HMC5883L", "behind")
    with pytest.raises(ValueError, match="at most 1000/14 Hz"):
        rig.configure(rate_hz=100, average=8)
    rig.start(rate_hz=72, average=8)
    assert gaps(rig.run(300)) == {14}
    assert rig.mag_chip.register(0x00) == 0x78


@pytest.mark.parametrize("ppm", [-80_000, -5000, 5000, 80_000])
@pytest.mark.parametrize("place", PLACES)
def test_the_qmc5883l_keeps_its_own_time(place, ppm):
    rig = Rig("QMC5883L", place, clock_ppm=ppm)
    rig.start()
    n = len(rig.run(2000))
    expected = 200 * (1_000_000 + ppm) // 1_000_000
    assert abs(n - expected) <= (2 if ppm < 10_000 else 12)
    assert (rig.mag.stale, rig.mag.saturated, rig.mag.resets) == (0, 0, 0)


@pytest.mark.parametrize(
    "rate_hz, sample_rate, chosen",
    [(100, 1000, 100), (99, 1000, 50), (200, 500, 200), (200, 200, 100)],
)
def test_the_qmc5883l_takes_the_next_lower_of_its_rates(rate_hz, sample_rate, chosen):
    rig = Rig("QMC5883L", "main bus", sample_rate)
    rig.configure(rate_hz=rate_hz)
    assert rig.mag.sample_rate == (chosen, 1)
    with pytest.raises(ValueError, match="none of its rates"):
        rig.configure(rate_hz=9)


# Identity


def test_an_absent_one_is_named_in_good_time(rig):
    rig.mag_chip.vanish()
    start = kernel.now()
    with pytest.raises(rig.error, match=rf"no {rig.mag.chip} at 0x..{rig.where} \("):
        rig.configure()
    assert kernel.now() - start < 250_000
    assert not rig.mag.present


def test_another_identity_is_refused(rig):
    register = rig.driver.IDENTITY[0] + len(rig.driver.IDENTITY[1]) - 1
    rig.mag_chip.stick(register, 0x55)
    with pytest.raises(rig.error, match=r"0x55.*another chip"):
        rig.configure()


def test_a_qmc5883l_is_no_ist8310_that_did_not_come_out_of_reset():
    rig = Rig("QMC5883L", "main bus")
    with pytest.raises(OSError, match=r"0x0d .*identity of the IST8310.*another chip"):
        IST8310(rig.i2c, 0x0D).configure()


@pytest.mark.parametrize("name", KINDS)
def test_an_address_in_the_8_bit_form_is_told(name):
    """0x3C and 0x3D, as the HMC5883L's datasheet writes them, are addresses of displays."""
    for address in KINDS[name][0].ADDRESSES:
        for form in (address << 1, address << 1 | 1):
            with pytest.raises(
                ValueError, match=f"0x{form:02x} is the 8-bit form: pass 0x{address:02x}"
            ):
                KINDS[name][0](machine.I2C(0), form)


# Bypass


@pytest.mark.parametrize("name", KINDS)
def test_bypass_is_a_setting_that_is_kept(name):
    rig = Rig(name, "bypass")
    rig.start()
    rig.run(2000)
    assert rig.imu.resets == 0
    rig.imu.configure(sample_rate_hz=1000)
    rig.imu.configure_interrupt(active_low=True)
    assert rig.chip.register(INT_PIN_CFG) == 0x82
    rig.run(200)
    assert rig.mag.present and rig.imu.resets == 0
    rig.imu.set_bypass(False)
    assert rig.chip.register(INT_PIN_CFG) == 0x80


def test_after_a_reset_of_the_imu_the_bypass_comes_back(rig):
    rig.start()
    rig.chip.brown_out(kernel.now())
    rig.run(600)
    assert rig.imu.resets == 1
    assert gaps(rig.run(300)) <= {8, 9, 10, 11, 12}
    assert rig.mag.present


def test_bypass_and_master_exclude_each_other():
    rig = Rig("HMC5883L", "behind")
    rig.imu.set_bypass()
    rig.start()
    assert not rig.imu.bypass
    with pytest.raises(OSError, match="auxiliary master is on"):
        rig.imu.set_bypass()
    with pytest.raises(ValueError, match="on I2C"):
        Rig("AK8963", "spi").imu.set_bypass()


# Faults in the tick


def test_absent_at_the_start_it_is_found_and_configured_by_the_tick(rig):
    rig.mag_chip.vanish()
    with pytest.raises(rig.error):
        rig.configure()
    rig.mag.attach()
    assert rig.run(500) == []
    assert rig.imu.counts[10] & FRESH
    assert not rig.mag.present and rig.mag.errors > 5
    rig.mag_chip.come_back()
    rig.mag_chip.misuse.clear()
    assert rig.until(MAG_FRESH) < 500_000
    register, value, _ = rig.row
    assert rig.mag_chip.register(register) == value
    assert gaps(rig.run(300)) <= rig.gaps
    assert rig.imu.resets == 0


def test_vanishing_in_flight_and_coming_back(rig):
    rig.start()
    rig.mag_chip.vanish()
    rig.run(2)
    assert rig.run(1000) == []
    assert rig.imu.counts[10] & FRESH
    assert not rig.mag.present and rig.mag.stale > 10
    rig.mag_chip.come_back()
    assert rig.until(MAG_FRESH) < 500_000
    rig.run(50)
    assert gaps(rig.run(300)) <= rig.gaps


def test_a_reset_of_the_magnetometer_alone_is_noticed_and_mended(rig):
    rig.start()
    rig.mag_chip.power_up_us = 50_000
    rig.mag_chip.brown_out(kernel.now())
    rig.run(500)
    register, value, _ = rig.row
    assert rig.mag_chip.register(register) == value
    assert gaps(rig.run(300)) <= rig.gaps
    assert rig.imu.resets == rig.imu.errors == 0


def test_a_register_that_lost_its_value_is_mended(rig):
    rig.start()
    register, value, wrong = rig.row
    rig.mag_chip._registers[register] = wrong
    rig.run(500)
    assert rig.mag_chip.register(register) == value
    assert rig.mag.resets == 1
    assert gaps(rig.run(300)) <= rig.gaps


def test_an_identity_that_reads_wrong_stops_delivery_until_it_is_right(rig):
    rig.start()
    rig.mag_chip.stick(rig.driver.IDENTITY[0], 0x11)
    rig.run(500)
    assert rig.run(300) == []
    rig.mag_chip.stick(rig.driver.IDENTITY[0])
    assert rig.until(MAG_FRESH) < 500_000


def test_one_missing_acknowledge_costs_two_measurements_at_the_most(rig):
    rig.start()
    for after in range(0, 60, 3):
        rig.mag_chip.nack_next(1, after)
        assert max(gaps(rig.run(80))) <= 34
    assert rig.mag.resets == 0


@pytest.mark.parametrize("seed", range(2))
def test_a_storm_of_missing_acknowledges_costs_measurements_and_nothing_else(rig, seed):
    rig.start()
    state = seed + 1
    for _ in range(500):
        state = state * 1103515245 + 12345 & 0x7FFFFFFF
        if state >> 16 & 3 == 0:
            rig.mag_chip.nack_next(1 + (state >> 20 & 7), after=state >> 24 & 3)
        assert rig.tick() & FRESH
    rig.mag_chip.nack_next(0)
    assert rig.mag.errors > 5
    assert rig.until(MAG_FRESH) < 500_000
    assert rig.imu.resets == rig.imu.errors == 0
    rig.run(500)
    assert gaps(rig.run(300)) <= rig.gaps


# Search


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("wanted", ["auto", "by name"])
def test_each_is_found_wherever_it_is(name, place, wanted):
    world = still(FIELD)
    chip, imu = RIGS["MPU6500" if place == "spi" else "MPU6050"].running(world)
    mag_chip = KINDS[name][1](world)
    if place == "main bus":
        machine.wire_i2c(0, mag_chip)
    else:
        chip.aux.append(mag_chip)
    mag = magnetometers.find(imu, "auto" if wanted == "auto" else name)
    assert mag.chip == name
    assert mag.own_bus == (place != "spi")
    assert imu.bypass == (place in ("behind", "bypass"))
    mag.configure(sample_rate=1000)
    assert mag.present
    assert chip.misuse == mag_chip.misuse == []


def test_where_bypass_does_not_reach_the_master_finds_it(monkeypatch):
    rig = Rig("QMC5883L", "behind")
    monkeypatch.setattr(type(rig.chip), "behind", lambda self, address: None)
    mag = magnetometers.find(rig.imu)
    assert mag.chip == "QMC5883L" and not mag.own_bus and not rig.imu.bypass


def test_what_is_there_instead_is_said():
    rig = Rig("QMC5883L", "behind")
    with pytest.raises(MagnetometerNotFound, match=r"no HMC5883L .*: QMC5883L at 0x0d$"):
        magnetometers.find(rig.imu, "HMC5883L")
    rig.mag_chip.stick(0x0D, 0x77)
    with pytest.raises(
        MagnetometerNotFound, match=r"no magnetometer .*0x0d answers register 0x0d with 0x77"
    ):
        magnetometers.find(rig.imu)
    rig.mag_chip.vanish()
    with pytest.raises(
        MagnetometerNotFound, match=r"behind it\. Looked for .*0x1e.*: nothing answers there"
    ):
        magnetometers.find(rig.imu)
    assert not rig.imu.bypass and not rig.imu.master_enabled
    assert magnetometers.find(rig.imu, "QMC5883L").own_bus and rig.imu.bypass
    with pytest.raises(ValueError, match="magnetometer 'BMM150' is not one of auto, HMC5883L"):
        magnetometers.find(rig.imu, "BMM150")


@pytest.mark.parametrize("place", ["spi", "behind"])
def test_a_named_one_that_is_silent_at_the_start_is_found_by_the_tick(place):
    rig = Rig("AK8963", place)
    rig.mag_chip.vanish()
    rig.mag = magnetometers.find(rig.imu, "AK8963")
    with pytest.raises(AK8963Error, match="no AK8963 at 0x0c"):
        rig.configure()
    rig.mag.attach()
    assert rig.run(200) == []
    rig.mag_chip.come_back()
    assert rig.until(MAG_FRESH) < 500_000


def test_the_table_of_the_search_is_the_drivers():
    assert sorted(magnetometers.NAMES) == sorted(settings.MAGNETOMETERS)
    for name, addresses, register, identity in magnetometers.CHIPS:
        driver = magnetometers.driver(name)
        assert driver.chip == name
        assert (register, identity) == driver.IDENTITY
        assert sorted(addresses) == sorted(driver.ADDRESSES)
        assert driver(machine.I2C(0))._registers.address in addresses


# On the real interpreters


@pytest.mark.parametrize("name", KINDS)
def test_the_tick_allocates_nothing(micropython_runtime, portable, name):
    lines = portable(micropython_runtime, "compass_alloc.py", name).splitlines()
    assert len(lines) == 9
    assert all(" ok 0 " in line for line in lines[:8])
    assert lines[8].endswith("found")
