"""The simulated SSD1306 and SH1106 against their datasheets: what they take, what they refuse, what is then seen."""

import pytest
from chips.ssd1306 import SH1106Chip, SSD1306Chip

LIT = bytes((0xA1, 0xC8, 0x8D, 0x14, 0xAF))  # upright, pump on, then display on


def commands(chip, *values):
    return write(chip, 0x00, values)


def data(chip, values):
    return write(chip, 0x40, values)


def write(chip, control, values):
    """One transaction -> True when every byte was acknowledged."""
    taken = chip.i2c_start(False, 0) and chip.i2c_write(control, 0)
    taken = taken and all(chip.i2c_write(value, 0) for value in values)
    chip.i2c_stop(0)
    return taken


def at(chip, page, column):
    return commands(chip, 0xB0 | page, column & 15, 0x10 | column >> 4)


def lit_chip(**options):
    """Set up and lit, its RAM all 0."""
    chip = SSD1306Chip(**options)
    chip.ram = bytearray(len(chip.ram))
    commands(chip, 0xA8, chip.height - 1, 0xDA, 0x02 if chip.sequential else 0x12, *LIT)
    assert chip.errors == []
    return chip


def pixels(chip):
    """The lit pixels of the picture as (x, y)."""
    return {(x, y) for y, row in enumerate(chip.picture()) for x, v in enumerate(row) if v}


# ---------------------------------------------------------------- reset state and light


def test_reset_values():
    chip = SSD1306Chip()
    assert not chip.display_on and not chip.lit
    assert chip.contrast == 0x7F and chip.precharge == 0x22 and chip.vcomh == 0x20
    assert chip.multiplex == 64 and chip.com_pins == 0x12 and chip.clock == 0x80
    assert not chip.remap and not chip.com_reversed and not chip.pump
    assert SH1106Chip().contrast == 0x80


def test_ram_is_undefined_at_power_up():
    assert len(set(SSD1306Chip().ram)) > 100


def test_dark_until_pump_and_display_are_on():
    chip = SSD1306Chip()
    commands(chip, 0xA5)
    assert not any(chip.frame())
    commands(chip, 0xAF)
    assert not chip.lit, "no charge pump"
    commands(chip, 0x8D, 0x14)
    assert not chip.lit, "the pump starts with the next AF"
    commands(chip, 0xAF)
    assert chip.lit and set(chip.frame()) == {0xFF}
    commands(chip, 0xAE)
    assert not chip.lit
    assert chip.errors == []


def test_sh1106_pump_comes_on_with_the_display():
    chip = SH1106Chip()
    commands(chip, 0xAF)
    assert chip.lit
    commands(chip, 0xAD, 0x8B)
    assert chip.errors, "only while the display is off"


def test_status_shows_whether_the_display_is_off():
    chip = SSD1306Chip()
    assert chip.i2c_start(True, 0)
    assert chip.i2c_read(0) & 0x40
    commands(chip, 0x8D, 0x14, 0xAF)
    assert chip.i2c_read(0) & 0x40 == 0


# ---------------------------------------------------------------- control bytes and commands


def test_control_byte_with_continuation_is_followed_by_another():
    chip = lit_chip()
    chip.i2c_start(False, 0)
    for byte in (0x80, 0xB2, 0x80, 0x03, 0x80, 0x10, 0x40, 0xAA, 0x55):
        assert chip.i2c_write(byte, 0)
    chip.i2c_stop(0)
    assert chip.ram[2 * 128 + 127 - 3] == 0xAA and chip.ram[2 * 128 + 127 - 4] == 0x55
    assert chip.errors == []


def test_control_byte_with_stray_bits_is_an_error():
    chip = SSD1306Chip()
    write(chip, 0x41, (1,))
    assert chip.errors


def test_parameters_are_kept_over_a_stop():
    chip = SSD1306Chip()
    commands(chip, 0x81)
    commands(chip, 0xE3)
    assert chip.contrast == 0xE3 and chip.errors == []


def test_data_inside_a_command_is_an_error():
    chip = SSD1306Chip()
    commands(chip, 0x81)
    data(chip, (1,))
    assert chip.errors


# 21 10 20 is invalid in page addressing
UNKNOWN = "30 B8 AD8B AD40 2003 A80E D920 DA11 DB40 8D24 211020 2000212010 2000B0 200005"


@pytest.mark.parametrize("values", UNKNOWN.split())
def test_what_the_ssd1306_does_not_know_is_an_error(values):
    chip = SSD1306Chip()
    assert commands(chip, *bytes.fromhex(values)), "the bus takes it"
    assert chip.errors


@pytest.mark.parametrize("value", [0x20, 0x21, 0x22, 0x8D, 0x2E, 0x26])
def test_the_sh1106_has_no_addressing_modes_and_no_8d(value):
    chip = SH1106Chip()
    commands(chip, value)
    assert chip.errors


def test_every_command_of_the_datasheet_is_known():
    chip = SSD1306Chip()
    commands(chip, *range(0x20), 0x20, 0, 0x21, 0, 127, 0x22, 0, 7, 0x26, 0, 0, 0, 7, 0, 0xFF, 0x2E)
    commands(
        chip, 0x20, 1, 0x20, 2, *range(0x40, 0x80), 0x81, 0, 0xA0, 0xA1, 0xA3, 0, 64, 0xA4, 0xA5
    )
    commands(chip, 0xA6, 0xA7, 0xA8, 63, 0xAE, 0xAF, *range(0xB0, 0xB8), 0xC0, 0xC8, 0xD3, 63)
    commands(
        chip, 0xAD, 0x30, 0xD5, 0x80, 0xD9, 0xF1, 0xDA, 0x32, 0xDB, 0x30, 0xE3, 0x29, 0, 0, 0, 7, 1
    )
    assert chip.errors == []


# ---------------------------------------------------------------- addressing


def test_page_addressing_wraps_to_the_start_column_of_the_same_page():
    chip = lit_chip()
    at(chip, 1, 126)
    data(chip, (1, 2, 3))
    assert [chip.ram[128 + 127 - c] for c in (126, 127)] == [3, 2]


def test_sh1106_column_counter_stops_at_the_end():
    chip = SH1106Chip()
    at(chip, 1, 131)
    data(chip, (7,))
    assert chip.errors == []
    before = bytes(chip.ram)
    data(chip, (8,))
    assert chip.errors and chip.ram == before


def test_horizontal_addressing_fills_the_window_row_by_row():
    chip = lit_chip()
    commands(chip, 0xA0, 0x20, 0x00, 0x21, 5, 6, 0x22, 2, 3)
    data(chip, (1, 2, 3, 4, 9))
    assert (chip.ram[2 * 128 + 5], chip.ram[2 * 128 + 6]) == (9, 2)
    assert (chip.ram[3 * 128 + 5], chip.ram[3 * 128 + 6]) == (3, 4)


def test_vertical_addressing_fills_the_window_column_by_column():
    chip = lit_chip()
    commands(chip, 0xA0, 0x20, 0x01, 0x21, 5, 6, 0x22, 2, 3)
    data(chip, (1, 2, 3, 4))
    assert (chip.ram[2 * 128 + 5], chip.ram[3 * 128 + 5]) == (1, 2)
    assert (chip.ram[2 * 128 + 6], chip.ram[3 * 128 + 6]) == (3, 4)


@pytest.mark.parametrize(
    ("width", "height", "sh1106", "first"),
    [(128, 64, True, 2), (72, 40, False, 28), (64, 48, False, 32), (96, 16, False, 0)],
)
def test_only_the_columns_of_the_glass_are_seen(width, height, sh1106, first):
    chip = SSD1306Chip(width=width, height=height, sh1106=sh1106)
    chip.ram = bytearray(len(chip.ram))
    pump = () if sh1106 else (0x8D, 0x14)
    wiring = (0xDA, 0x02 if chip.sequential else 0x12)
    commands(chip, 0xA8, height - 1, *wiring, 0xA1, 0xC8, *pump, 0xAF)
    last = first + width - 1
    for column in (*range(max(first - 2, 0), first + 1), *range(last, min(last + 3, chip.columns))):
        at(chip, 0, column)
        data(chip, (1,))
    assert pixels(chip) == {(0, 0), (width - 1, 0)} and chip.errors == []


# ---------------------------------------------------------------- what is seen


def one_pixel(chip, *setting):
    """A pixel at page 1, column 10, bit 2: (10, 10) where nothing else is set."""
    commands(chip, *setting)
    at(chip, 1, 10)
    data(chip, (4,))
    return pixels(chip)


def test_upright_with_remap_and_reversed_scan():
    assert one_pixel(lit_chip()) == {(10, 10)}


@pytest.mark.parametrize(
    ("setting", "seen"),
    [
        ((0xA0, 0xC0), {(117, 53)}),
        ((0xA0,), {(117, 10)}),
        ((0xC0,), {(10, 53)}),
        ((0x40 + 8,), {(10, 2)}),
        ((0xD3, 60), {(10, 14)}),
        ((0xA8, 15), {(10, 58)}),  # 16 rows from the bottom: row 10 of them
    ],
)
def test_orientation_start_line_offset_and_multiplex(setting, seen):
    assert one_pixel(lit_chip(), *setting) == seen


def test_remap_acts_on_what_is_written_later():
    chip = lit_chip()
    assert one_pixel(chip) == {(10, 10)}
    commands(chip, 0xA0)
    assert pixels(chip) == {(10, 10)}


def test_the_wrong_com_wiring_spoils_the_picture():
    assert one_pixel(lit_chip(), 0xDA, 0x02) != {(10, 10)}
    low = lit_chip(height=32)
    assert one_pixel(low) == {(10, 10)}
    assert one_pixel(low, 0xDA, 0x12) != {(10, 10)}


def test_inverse_and_all_on():
    chip = lit_chip()
    assert len(one_pixel(chip, 0xA7)) == 128 * 64 - 1
    commands(chip, 0xA5)
    assert len(pixels(chip)) == 128 * 64
    commands(chip, 0xA4, 0xA6)
    assert pixels(chip) == {(10, 10)}


# ---------------------------------------------------------------- SPI and reset


def spi(chip, dc, values, hz=10_000_000, mode=0):
    chip.dc = dc
    for value in values:
        chip.spi_transfer(value, 0, hz, mode)


def test_spi_takes_commands_and_data_by_the_dc_pin_while_selected():
    chip = SSD1306Chip()
    spi(chip, 0, (0xB1, 0x05, 0x10))
    assert chip.page == 0, "not selected"
    chip.spi_select(True, 0)
    spi(chip, 0, (0xB1, 0x05, 0x10))
    spi(chip, 1, (0x77,), mode=3)
    assert chip.ram[128 + 5] == 0x77 and chip.errors == []


@pytest.mark.parametrize("how", [{"hz": 10_500_000}, {"mode": 1}, {"mode": 2}])
def test_spi_too_fast_or_on_the_wrong_edge_is_an_error_and_garbage(how):
    chip = SSD1306Chip()
    chip.spi_select(True, 0)
    spi(chip, 1, (0x77,), **how)
    assert chip.errors and chip.ram[0] != 0x77


def test_sh1106_spi_is_slower():
    chip = SH1106Chip()
    chip.spi_select(True, 0)
    spi(chip, 0, (0xE3,), hz=2_000_000)
    assert chip.errors == []
    spi(chip, 0, (0xE3,), hz=4_000_000)
    assert chip.errors


def test_reset_needs_3_us_and_keeps_the_ram():
    chip = lit_chip()
    chip.ram[5] = 99
    chip.reset_pin(0, 100)
    assert not write(chip, 0x00, (0xE3,)), "deaf during reset"
    chip.reset_pin(1, 103)
    assert not chip.display_on and chip.ram[5] == 99 and chip.errors == []
    commands(chip, *LIT)
    chip.reset_pin(0, 200)
    chip.reset_pin(1, 202)
    assert chip.errors and chip.display_on, "too short a pulse does nothing good"


# ---------------------------------------------------------------- faults


def test_nack_next_refuses_so_many_bytes_and_does_not_take_them():
    chip = SSD1306Chip()
    chip.nack_next()
    assert not commands(chip, 0x81, 0x11)
    chip.nack_next(2, after=2)
    assert not commands(chip, 0x81, 0x11)
    assert chip.contrast == 0x7F
    assert not commands(chip, 0x81, 0x11)
    assert commands(chip, 0x81, 0x11)
    assert chip.contrast == 0x11 and chip.errors == []


def test_power_that_was_away_loses_everything():
    chip = lit_chip()
    chip.vanish()
    assert not commands(chip, 0xE3) and not chip.lit
    chip.come_back()
    assert commands(chip, 0xE3) and not chip.lit and len(set(chip.ram)) > 100
