"""The simulated AK8963, HMC5883L and QMC5883L against their datasheets: what they do, and what they do not forgive."""

import pytest
from bare_bus import Bus, Nack
from chips.ak8963 import AK8963Chip
from chips.hmc5883l import HMC5883LChip
from chips.qmc5883l import QMC5883LChip
from world import StillWorld

FIELD = (99, -198, 66)  # 3.3 counts per uT: 30, -60, 20 uT
STRONG = (33 * 500, 0, 0)  # 5000 uT


def still(field=FIELD):
    return StillWorld((0, 0, 4096, 0, 0, 0, *field))


def words(data, order):
    return tuple(int.from_bytes(data[i : i + 2], order, signed=True) for i in (0, 2, 4))


# AK8963


def ak(**options):
    return Bus(AK8963Chip(still(), **{"asa": (128, 128, 128)} | options))


def test_ak8963_measures_once_and_powers_down():
    bus = ak()
    assert (bus.read(0x00), bus.read(0x01)) == (0x48, 0x9A)
    bus.write(0x0A, 0x11)
    bus.now += 7100
    assert bus.read(0x02) == 0
    bus.now += 200
    assert (bus.read(0x02), bus.read(0x0A)) == (0x01, 0x10)
    assert words(bus.read(0x03, 6), "little") == (200, -400, 133)  # 0.15 uT
    assert bus.read(0x02) == 0  # read: no longer ready
    assert bus.read(0x09) == 0x10  # BITM
    bus.now += 50_000
    assert bus.chip.measurements == 1


def test_ak8963_in_14_bits_has_a_quarter_of_the_counts():
    bus = ak()
    bus.write(0x0A, 0x01)
    bus.now += 10_000
    assert words(bus.read(0x03, 6), "little") == (50, -100, 33)


def test_ak8963_keeps_its_data_until_st2_is_read():
    bus = ak()
    bus.write(0x0A, 0x16)  # continuous, 100 Hz
    bus.now += 10_000
    bus.read(0x03, 6)
    bus.chip.world.set((0, 0, 4096, 0, 0, 0, 0, 0, 0))
    bus.now += 50_000
    assert words(bus.read(0x03, 6), "little") == (200, -400, 133)
    bus.read(0x09)
    bus.now += 10_000
    assert bus.read(0x02) == 0x01
    assert words(bus.read(0x03, 6), "little") == (0, 0, 0)


@pytest.mark.parametrize("mode, count", [(0x12, 8), (0x16, 100)])
def test_ak8963_has_two_rates_and_says_what_was_skipped(mode, count):
    bus = ak()
    bus.write(0x0A, mode)
    bus.now += 1_000_000
    assert bus.read(0x02) == 0x03  # DOR
    assert abs(bus.chip.measurements - count) <= 1


def test_ak8963_overflow_is_a_bit_of_st2():
    bus = ak()
    bus.chip.world.set((0, 0, 4096, 0, 0, 0, *STRONG))
    bus.write(0x0A, 0x11)
    bus.now += 10_000
    assert bus.read(0x09) == 0x18


def test_ak8963_shows_its_fuse_rom_in_that_mode_only_and_delivers_what_it_corrects():
    bus = ak(asa=(176, 178, 165))
    assert list(bus.read(0x10, 3)) == [0, 0, 0]
    bus.write(0x0A, 0x0F)
    assert list(bus.read(0x10, 3)) == [176, 178, 165]
    bus.write(0x0A, 0x00)
    bus.now += 100
    bus.write(0x0A, 0x11)
    bus.now += 10_000
    raw = words(bus.read(0x03, 6), "little")
    assert raw == (168, -335, 116)
    for h, asa, field in zip(raw, (176, 178, 165), (200, -400, 133), strict=True):
        assert h * ((asa - 128) / 256 + 1) == pytest.approx(field, abs=1)
    assert bus.chip.misuse == []


def test_ak8963_goes_from_mode_to_mode_by_power_down():
    bus = ak()
    bus.write(0x0A, 0x0F)
    bus.write(0x0A, 0x16)
    assert "not by power-down" in bus.chip.misuse[0]
    bus.write(0x0A, 0x00)
    bus.now += 50
    bus.write(0x0A, 0x16)
    assert "100 us" in bus.chip.misuse[-1]


# HMC5883L


def hmc(**options):
    return Bus(HMC5883LChip(still(), **options))


def test_hmc5883l_measures_once_x_z_y_with_the_high_byte_first():
    bus = hmc()
    assert bus.read(0x0A, 3) == b"H43"
    assert (bus.read(0x00), bus.read(0x01)) == (0x10, 0x20)
    bus.write(0x02, 0x01)
    bus.now += 5900
    assert bus.read(0x09) == 0
    bus.now += 200
    assert bus.read(0x09) == 0x01
    assert words(bus.read(0x03, 6), "big") == (327, 218, -654)  # 1090 LSB/Ga
    assert (bus.read(0x02), bus.read(0x09)) == (0x03, 0)  # idle; read: no longer ready
    bus.now += 100_000
    assert bus.chip.measurements == 1


def test_hmc5883l_by_table_17_stays_ready():
    bus = hmc(ready_stays=True)
    bus.write(0x02, 0x01)
    bus.now += 10_000
    bus.read(0x03, 6)
    assert bus.read(0x09) == 0x01
    bus.write(0x02, 0x01)
    assert bus.read(0x09) == 0


def test_hmc5883l_overflow_is_minus_4096():
    bus = hmc()
    bus.chip.world.set((0, 0, 4096, 0, 0, 0, 0, 650, 0))  # 197 uT: beyond 1.3 Ga
    bus.write(0x02, 0x01)
    bus.now += 10_000
    assert words(bus.read(0x03, 6), "big") == (0, 0, -4096)


def test_hmc5883l_takes_a_gain_from_the_second_measurement_on():
    bus = hmc()
    bus.write(0x01, 0xE0)  # 230 LSB/Ga
    seen = []
    for _ in range(2):
        bus.write(0x02, 0x01)
        bus.now += 10_000
        seen.append(words(bus.read(0x03, 6), "big")[0])
    assert seen == [327, 69]


def test_hmc5883l_data_that_are_half_read_are_locked():
    bus = hmc()
    bus.write(0x00, 0x18)
    bus.write(0x02, 0x00)  # continuous, 75 Hz
    bus.now += 20_000
    bus.read(0x03, 2)
    assert bus.read(0x09) & 0x02
    bus.chip.world.set((0, 0, 4096, 0, 0, 0, 0, 0, 0))
    bus.now += 50_000
    assert words(bus.read(0x03, 6), "big")[0] == 327
    bus.now += 50_000
    assert words(bus.read(0x03, 6), "big") == (0, 0, 0)


def test_hmc5883l_pointer_stays_in_the_data():
    bus = hmc()
    bus.write(0x02, 0x01)
    bus.now += 10_000
    data = bus.read(0x03, 12)
    assert data[:6] == data[6:]
    assert bus.read(0x0C, 2) == b"3\x10"


# QMC5883L


def qmc(control=0x19, **options):
    bus = Bus(QMC5883LChip(still(), **options))
    bus.write(0x0B, 0x01)
    bus.write(0x09, control)
    return bus


def test_qmc5883l_measures_by_itself_until_stand_by():
    bus = qmc()  # 8 Ga, 100 Hz
    assert bus.read(0x0D) == 0xFF
    bus.now += 10_100
    assert bus.read(0x06) == 0x01
    assert words(bus.read(0x00, 6), "little") == (900, -1800, 600)
    assert bus.read(0x06) == 0
    bus.now += 20_000
    assert bus.read(0x06) == 0x05  # DOR: one was skipped
    bus.write(0x09, 0x18)
    before = bus.chip.measurements
    bus.now += 100_000
    bus.read(0x06)
    assert bus.chip.measurements == before


@pytest.mark.parametrize("control, hz", [(0x01, 10), (0x05, 50), (0x09, 100), (0x0D, 200)])
def test_qmc5883l_has_four_rates_and_at_2_gauss_four_times_the_counts(control, hz):
    bus = qmc(control)
    bus.now += 1_001_000
    assert words(bus.read(0x00, 6), "little") == (3600, -7200, 2400)
    assert bus.chip.measurements == hz


def test_qmc5883l_overflow_is_a_bit_of_the_status():
    bus = qmc()
    bus.chip.world.set((0, 0, 4096, 0, 0, 0, *STRONG))
    bus.now += 10_100
    assert bus.read(0x06) == 0x03
    bus.chip.world.set((0, 0, 4096, 0, 0, 0, *FIELD))
    bus.read(0x00, 6)
    bus.now += 10_000
    assert bus.read(0x06) == 0x01


def test_qmc5883l_rolls_over_from_the_status_to_the_data():
    bus = qmc()
    bus.write(0x0A, 0x41)
    bus.now += 10_100
    data = bus.read(0x06, 7)
    assert data[0] == 0x01 and words(data[1:], "little") == (900, -1800, 600)


def test_qmc5883l_wants_its_set_reset_period_and_forgets_it_at_a_soft_reset():
    bus = qmc()
    assert bus.chip.misuse == []
    bus.write(0x0A, 0x80)
    with pytest.raises(Nack):
        bus.read(0x0D)
    bus.now += 1000
    assert [bus.read(register) for register in (0x09, 0x0A, 0x0B)] == [0, 0, 0]
    bus.write(0x09, 0x19)
    assert "SET/RESET" in bus.chip.misuse[0]
