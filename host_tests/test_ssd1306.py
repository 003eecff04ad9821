"""The OLED driver: drawing against a naive reference, numbers against Python's, and the way to the glass."""

import re
import sys
from decimal import ROUND_HALF_UP, Decimal

import machine
import pytest
from chips.ssd1306 import SSD1306Chip
from conftest import require
from hypothesis import given, settings
from hypothesis import strategies as st
from upright import ssd1306
from upright.ssd1306 import BLACK, INVERSE, LARGE, OPAQUE, SMALL, TALL, WHITE, XOR
from upright_host import oled, paths

QUICK = settings(max_examples=150, deadline=None)
COLOURS = st.sampled_from((BLACK, WHITE, XOR))
PLACES = st.integers(-70, 150)
SIZES = st.sampled_from((SMALL, LARGE, TALL))


class ChipBus:
    """The shortest way from the driver to the chip: an I2C bus that counts."""

    def __init__(self, chip):
        self.chip = chip
        self.sent = 0  # data bytes, without control bytes
        self.longest = 0
        self.first_light = None  # what was seen when it was lit for the first time

    def writeto(self, address, data):
        chip = self.chip
        if data[0] == 0x40:
            self.sent += len(data) - 1
        self.longest = max(self.longest, len(data) - 1)
        try:
            if address != chip.address or not chip.i2c_start(False, 0):
                raise OSError(5)
            for byte in data:
                if not chip.i2c_write(byte, 0):
                    raise OSError(5)
        finally:
            chip.i2c_stop(0)
        if chip.lit and self.first_light is None:
            self.first_light = chip.frame()


def bench(panel="SSD1306 128x64", begin=True, chip_address=0x3C, **options):
    controller, size = panel.split()
    width, height = map(int, size.split("x"))
    chip = SSD1306Chip(chip_address, width, height, controller == "SH1106")
    bus = ChipBus(chip)
    display = ssd1306.SSD1306(bus, panel, **options)
    if begin:
        display.begin()
    return chip, bus, display


def send(d):
    d.show()
    return d.flush()


def canvas():
    return ssd1306.Canvas(128, 64)


def rows(display):
    return oled.rows_of_frame(display.buffer, display.width)


# ---------------------------------------------------------------- drawing


class Reference:
    """Pixel by pixel, in a dict as large as it needs to be."""

    def __init__(self):
        self.lit = set()

    def pixel(self, x, y, colour):
        if colour == BLACK or (colour == XOR and (x, y) in self.lit):
            self.lit.discard((x, y))
        else:
            self.lit.add((x, y))

    def fill_rect(self, x, y, w, h, colour):
        for i in range(x, x + w):
            for j in range(y, y + h):
                self.pixel(i, j, colour)

    def rect(self, x, y, w, h, colour):
        edge = {(i, j) for i in range(x, x + w) for j in range(y, y + h)}
        edge -= {(i, j) for i in range(x + 1, x + w - 1) for j in range(y + 1, y + h - 1)}
        for i, j in edge:
            self.pixel(i, j, colour)

    def rows(self, width=128, height=64):
        return [bytearray((x, y) in self.lit for x in range(width)) for y in range(height)]


SHAPES = st.sampled_from(("fill_rect", "rect"))
RECTANGLES = st.tuples(SHAPES, PLACES, PLACES, st.integers(0, 160), st.integers(0, 80), COLOURS)


@QUICK
@given(st.lists(RECTANGLES, max_size=4))
def test_rectangles_are_those_of_the_reference_and_clipped(shapes):
    d, reference = canvas(), Reference()
    for name, *arguments in shapes:
        getattr(d, name)(*arguments)
        getattr(reference, name)(*arguments)
    assert rows(d) == reference.rows()


@QUICK
@given(PLACES, PLACES, st.integers(0, 160), COLOURS)
def test_lines_along_the_axes_and_pixels_are_rectangles(x, y, n, colour):
    d, reference = canvas(), canvas()
    d.hline(x, y, n, colour)
    d.vline(y, x, n, colour)
    d.pixel(y, y, colour)
    reference.fill_rect(x, y, n, 1, colour)
    reference.fill_rect(y, x, 1, n, colour)
    reference.fill_rect(y, y, 1, 1, colour)
    assert d.buffer == reference.buffer


@QUICK
@given(PLACES, PLACES, PLACES, PLACES)
def test_a_line_stays_within_half_a_pixel_of_the_true_one(x0, y0, x1, y1):
    d = canvas()
    d.line(x0, y0, x1, y1)
    long = max(abs(x1 - x0), abs(y1 - y0))
    wanted = set()
    for i in range(long + 1):
        # along the longer axis one pixel a step, the other coordinate rounded
        x = x0 + (x1 - x0) * i / long if long else x0
        y = y0 + (y1 - y0) * i / long if long else y0
        wanted.add((x, y))
    lit = {(x, y) for y, row in enumerate(rows(d)) for x, v in enumerate(row) if v}
    inside = {(x, y) for x, y in wanted if -0.5 <= x <= 127.5 and -0.5 <= y <= 63.5}
    assert len(lit) >= len({p for p in wanted if 0 <= p[0] <= 127 and 0 <= p[1] <= 63})
    for x, y in lit:
        assert any(abs(x - a) <= 0.5 and abs(y - b) <= 0.5 for a, b in inside)


def test_a_far_line_crosses_the_display():
    d = canvas()
    d.line(-8000, 32, 8000, 32)
    assert rows(d)[32] == bytearray([1] * 128) and sum(map(sum, rows(d))) == 128


@QUICK
@given(
    st.text(st.characters(min_codepoint=32, max_codepoint=126) | st.just("\u00b0"), max_size=8),
    PLACES,
    PLACES,
    SIZES,
    st.sampled_from((BLACK, WHITE, XOR, OPAQUE, INVERSE)),
    st.booleans(),
)
def test_text_is_the_same_picture_anywhere_and_clipped(text, x, y, size, colour, light):
    """Drawn in the middle of a large reference made of single characters at (0, 0)."""
    d, reference = canvas(), Reference()
    if light:
        d.fill(WHITE)
        reference.fill_rect(0, 0, 128, 64, WHITE)
    end = d.text(text, x, y, size, colour)
    at = x
    for character in text:
        cell = canvas()
        w = cell.text(character, 0, 0, size, WHITE)
        h = 8 if size == SMALL else 16
        glyph = rows(cell)
        for i in range(w):
            for j in range(h):
                lit = glyph[j][i]
                if colour == OPAQUE:
                    reference.pixel(at + i, y + j, WHITE if lit else BLACK)
                elif colour == INVERSE:
                    reference.pixel(at + i, y + j, BLACK if lit else WHITE)
                elif lit:
                    reference.pixel(at + i, y + j, colour)
        at += w
    assert end == at == x + d.text_width(text, size)
    assert rows(d) == reference.rows()


def test_every_character_has_a_picture_of_its_own():
    for size in (SMALL, LARGE, TALL):
        seen = {}
        for character in [*map(chr, range(32, 127)), "\u00b0"]:
            d = canvas()
            d.text(character, 0, 0, size)
            seen.setdefault(bytes(d.buffer), []).append(character)
        assert [group for group in seen.values() if len(group) > 1] == []


@pytest.mark.parametrize("strange", ["\t", "\u007f", "\u00e9", "\u20ac", "\U0001f600"])
def test_a_character_that_the_font_lacks_is_a_question_mark(strange):
    d, reference = canvas(), canvas()
    d.text(strange + "1", 0, 0)
    reference.text("?1", 0, 0)
    assert d.buffer == reference.buffer


def test_text_takes_bytes_one_character_each():
    d, reference = canvas(), canvas()
    d.text(b"5\xb0", 0, 0)
    reference.text("5\u00b0", 0, 0)
    assert d.buffer == reference.buffer
    assert d.text("5\u00b0".encode(), 0, 0) == 18, "three bytes"


# ---------------------------------------------------------------- framebuf, and another driver

# as micropython-lib's: a module of this name whose class has this signature
ANOTHER = """
import framebuf
class SSD1306_I2C(framebuf.FrameBuffer):
    def __init__(self, width, height, i2c, addr=0x3C, external_vcc=False):
        self.width = width
        super().__init__(bytearray(width * height // 8), width, height, framebuf.MONO_VLSB)
"""


def test_framebuf_draws_into_our_buffer_with_another_ssd1306_beside_it(
    micropython_runtime, portable, tmp_path
):
    (tmp_path / "ssd1306.py").write_text(ANOTHER)
    printed = portable(micropython_runtime, "framebuffer.py", str(tmp_path))
    assert printed.split("\n")[:3] == ["128 64 shown", "72 40 shown", "128"]


def test_without_framebuf_there_is_none():
    assert canvas().framebuffer is None


# ---------------------------------------------------------------- numbers


def as_python_formats(value, width, decimals, point, sign):
    """The same number by Python's own means, halves away from zero, no minus zero."""
    step = Decimal(1).scaleb(-decimals)
    rounded = Decimal(value).scaleb(-point).quantize(step, ROUND_HALF_UP)
    if rounded == 0:
        rounded = abs(rounded)
    text = format(rounded, f"{'+' if sign else ''}{width or ''}.{decimals}f")
    return text if len(text) <= width or not width else "#" * width


@settings(max_examples=500, deadline=None)
@given(
    st.integers(-(2**30), 2**30) | st.integers(-2000, 2000),
    st.integers(0, 24),
    st.integers(0, 9),
    st.data(),
    st.booleans(),
    SIZES,
)
def test_numbers_are_as_python_formats_them(value, width, point, data, sign, size):
    decimals = data.draw(st.integers(0, point))
    d, reference = ssd1306.Canvas(128, 16), ssd1306.Canvas(128, 16)
    end = d.number(value, 0, 0, size, width, decimals, point, sign)
    text = as_python_formats(value, width, decimals, point, sign)
    assert reference.text(text, 0, 0, size) == end, text
    assert d.buffer == reference.buffer, text


def test_millidegrees_with_one_decimal():
    for value, text in zip(
        (-123456, -49, -50, 49, 50, 999949, 999950),
        ("-123.5", "0.0", "-0.1", "0.0", "0.1", "999.9", "1000.0"),
        strict=True,
    ):
        d, reference = canvas(), canvas()
        d.number(value, 3, 5, SMALL, 0, 1, 3)
        reference.text(text, 3, 5)
        assert d.buffer == reference.buffer, text


# ---------------------------------------------------------------- set-up


def drawn(d):
    """The display with something at its corners, sent."""
    d.text("Wy\u00b0", 1, 1, LARGE)
    d.fill_rect(d.width - 3, d.height - 2, 3, 2)
    assert send(d)
    return rows(d)


# column of the left edge, COM wiring (micropython-lib's ssd1306.py; u8g2's u8x8_d_ssd1306_*.c and u8x8_d_sh1106_*.c)
PANELS = {
    "SSD1306 128x64": (0, 0x12),
    "SSD1306 128x32": (0, 0x02),
    "SSD1306 96x16": (0, 0x02),
    "SSD1306 72x40": (28, 0x12),
    "SSD1306 64x48": (32, 0x12),
    "SSD1306 64x32": (32, 0x12),
    "SH1106 128x64": (2, 0x12),
    "SH1106 128x32": (2, 0x02),
    "SSD1306 16x16": (56, 0x12),
}


@pytest.mark.parametrize("options", [{}, {"rotate": 180}, {"chunk": 128}, {"chunk": 8}], ids=str)
@pytest.mark.parametrize("panel", PANELS)
def test_every_panel_shows_the_buffer(panel, options):
    chip, bus, d = bench(panel, **options)
    assert chip.lit and not chip.dim and not any(bus.first_light), "cleared before it was lit"
    buffer = drawn(d)
    seen = chip.picture()
    if "rotate" in options:
        seen = [row[::-1] for row in seen[::-1]]
    assert seen == buffer and chip.errors == []
    assert chip.com_pins == PANELS[panel][1]


@pytest.mark.parametrize("panel", PANELS)
def test_a_panel_elsewhere_than_it_is_wired_shows_a_part(panel):
    column, _pins = PANELS[panel]
    right = bench(panel, column_offset=column)[::2]
    assert drawn(right[1]) == right[0].picture()
    wrong = column + 8 if column < 8 else column - 8
    spare = (132 if panel.startswith("SH") else 128) - right[1].width
    if wrong <= spare:
        chip, _bus, d = bench(panel, column_offset=wrong)
        assert drawn(d) != chip.picture()


def test_a_1_3_inch_sh1106_taken_for_an_ssd1306_is_shifted_by_two_columns_with_noise_at_the_edge():
    chip = SSD1306Chip(sh1106=True)
    d = ssd1306.SSD1306(ChipBus(chip))
    d.begin()
    buffer, seen = drawn(d), chip.picture()
    assert chip.errors and [row[:126] for row in seen] == [row[2:] for row in buffer]
    assert any(row[126] for row in seen) and any(row[127] for row in seen)


def test_a_small_panel_without_the_internal_current_is_dim():
    """The failing twin: the set-up of a large panel on the same controller."""
    chip = SSD1306Chip(width=72, height=40)
    ssd1306.SSD1306(ChipBus(chip), "SSD1306 128x64").begin()
    assert chip.lit and chip.dim


@pytest.mark.parametrize(
    ("panel", "hz", "wires"),
    [
        ("SSD1306 128x64", 10_000_000, {"dc": 6, "rst": 7, "cs": 5}),
        ("SSD1306 128x64", 1_000_000, {"dc": 6}),
        ("SH1106 128x64", 2_000_000, {"dc": 6, "rst": 7, "cs": 5}),
    ],
)
def test_spi_through_the_machine_with_and_without_reset_and_chip_select(panel, hz, wires):
    chip = SSD1306Chip(sh1106=panel.startswith("SH1106"))
    machine.wire_spi(1, chip, **wires)
    pins = {name: machine.Pin(n, machine.Pin.OUT) for name, n in wires.items()}
    d = ssd1306.SSD1306(machine.SPI(1, baudrate=hz), panel, **pins)
    chip.page_range = [1, 2]  # no command of the set-up changes that
    d.begin()
    assert (chip.page_range == [0, 7]) == ("rst" in wires)
    assert drawn(d) == chip.picture() and chip.lit and chip.errors == []


def test_i2c_through_the_machine_takes_the_time_that_the_docstring_says():
    import kernel

    chip = SSD1306Chip()
    machine.wire_i2c(0, chip)
    d = ssd1306.SSD1306(machine.I2C(0, freq=400_000), refresh=False)
    d.begin()
    d.fill(1)
    d.show()
    before = kernel.now()
    d.flush_step(32)
    took = kernel.now() - before
    assert 39 * 9 * 2.5 <= took <= 39 * 9 * 2.5 + 60


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"panel": "SSD1306 130x64"}, "width"),
        ({"panel": "SSD1306 136x64"}, "width"),
        ({"panel": "SSD1306 128x12"}, "height"),
        ({"panel": "SSD1306 128x8"}, "height"),
        ({"panel": "SSD1306 128x72"}, "height"),
        ({"panel": "SSD1322 256x64"}, "SH1106 128x64.*SSD1322 256x64"),
        ({"panel": "128x64"}, "name the panel"),
        ({"panel": "SSD1306 128"}, "name the panel"),
        ({"panel": None}, "name the panel"),
        ({"chunk": 0}, "chunk"),
        ({"chunk": 33}, "chunk"),
        ({"chunk": "a"}, "chunk must be .*'a'"),
        ({"chunk": 32.0}, "chunk"),
        ({"rotate": 90}, "rotate"),
        ({"column_offset": 1}, "column_offset must be 0 to 0"),
        ({"panel": "SH1106 128x64", "column_offset": 5}, "0 to 4"),
        ({"address": 0x78}, "0x78 is the 8-bit form.*pass 0x3C"),
        ({"address": 0x7A}, "0x7A is the 8-bit form.*pass 0x3D"),
        ({"address": 0x79}, "0x79 is the 8-bit form.*pass 0x3C"),
        ({"address": 0x68}, "0x3C or 0x3D"),
        ({"address": None}, "None must be 0x3C or 0x3D"),
        ({"address": "0x3C"}, "'0x3C' must be 0x3C or 0x3D"),
        ({"width": 128}, 'call SSD1306\\(bus, "SSD1306 128x64"\\)'),
        ({"addr": 0x3C}, "address="),
    ],
)
def test_what_cannot_be_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        ssd1306.SSD1306(ChipBus(None), **options)


@pytest.mark.parametrize("name", ["SSD1306", "SSD1306_I2C", "SSD1306_SPI"])
def test_a_call_as_of_micropython_libs_driver_is_told_how_it_is_here(name):
    bus = ChipBus(None)
    for arguments in ((128, 64, bus), (128, 64, bus, 0x3C), (128, 64, bus, None, None, None)):
        with pytest.raises(ValueError, match=r'SSD1306\(bus, "SSD1306 128x64"\).*first the bus'):
            getattr(ssd1306, name)(*arguments)
    with pytest.raises(ValueError, match="dc=, the output pin that its D/C is wired to"):
        getattr(ssd1306, name)(machine.SPI(1))
    with pytest.raises(ValueError, match="dc=, the output pin that its D/C is wired to"):
        getattr(ssd1306, name)(machine.SPI(1), dc=9)
    with pytest.raises(ValueError, match="None is neither an I2C nor an SPI bus"):
        getattr(ssd1306, name)(None)


@pytest.mark.parametrize("address", [0x3C, 0x3D])
def test_an_absent_display_is_a_clear_error(address):
    chip, _bus, d = bench(begin=False, address=address)
    chip.vanish()
    text = f"no display answers at 0x{address:02X} .nor at 0x{address ^ 1:02X}.: check VCC"
    with pytest.raises(ssd1306.DisplayError, match=text) as why:
        d.begin()
    assert isinstance(why.value, OSError)
    assert d.lost and not d.busy and d.errors == 1


def test_a_display_at_the_other_address_is_named():
    chip, _bus, d = bench(begin=False, chip_address=0x3D)
    with pytest.raises(ssd1306.DisplayError, match=r"0x3C, but one does at 0x3D: pass .* address="):
        d.begin()
    assert chip.errors == []


@pytest.mark.parametrize("after", range(0, 40, 3))
def test_a_display_that_is_lost_during_set_up_is_an_error(after):
    chip, _bus, d = bench(begin=False)
    chip.nack_next(100, after=after)
    with pytest.raises(ssd1306.DisplayError):
        d.begin()


def test_a_display_that_appears_later_is_set_up_by_itself():
    chip, _bus, d = bench(begin=False)
    chip.vanish()
    with pytest.raises(ssd1306.DisplayError):
        d.begin()
    d.text("late", 0, 0)
    for _ in range(3):
        assert d.show() and not d.flush()
    chip.come_back()
    assert d.show() and d.flush()
    assert chip.lit and chip.picture() == rows(d) and not d.lost


def test_the_example_of_the_documents_shows_its_number():
    chip = SSD1306Chip()
    machine.wire_i2c(0, chip)
    (code,) = re.findall(r"```python\n(.*?)```", (paths.ROOT / "docs/display.md").read_text(), re.S)
    names = {}
    exec(code, names)
    d = canvas()
    d.text("hello", 0, 0)
    d.text(" -123.5", 0, 16, LARGE)
    assert chip.frame() == d.buffer == names["display"].buffer


# ---------------------------------------------------------------- contrast, inverse, power


def test_contrast_inverse_and_power_come_with_the_next_frame():
    chip, _bus, d = bench(contrast=0x20)
    assert chip.contrast == 0x20
    d.contrast(300)
    d.invert(True)
    assert chip.contrast == 0x20, "nothing on the bus before show()"
    send(d)
    assert chip.contrast == 300 & 255 and chip.inverse and chip.lit
    d.power(False)
    send(d)
    assert not chip.lit
    d.power(True)
    d.invert(False)
    send(d)
    assert chip.lit and not chip.inverse and chip.errors == []


# ---------------------------------------------------------------- flushing


def test_what_did_not_change_is_not_sent():
    _chip, bus, d = bench(refresh=False)
    d.number(1234, 0, 0, LARGE, 6, 1, 3)
    send(d)
    before = bus.sent
    d.fill(0)
    d.number(1234, 0, 0, LARGE, 6, 1, 3)
    assert d.show() and not d.busy
    assert bus.sent == before
    d.number(1334, 0, 0, LARGE, 6, 1, 3)
    send(d)
    assert 0 < bus.sent - before <= 48, "one digit of two pages"


@QUICK
@given(st.integers(0, 300), st.sampled_from((8, 16, 32, 64, 128)))
def test_a_step_never_sends_more_than_it_may(limit, chunk):
    _chip, bus, d = bench(chunk=chunk)
    for x in range(0, 128, 5):
        d.vline(x, 0, 64)
    d.contrast(1)
    d.show()
    left = d._left
    for _ in range(400):
        if not d.busy:
            break
        bus.sent = bus.longest = 0
        new = d.flush_step(limit)
        assert bus.sent <= limit and bus.longest <= max(min(limit, chunk), 8)
        assert new <= left - (8 if limit >= 8 else 0)
        left = new
    assert d.busy == (limit < 8)
    assert left == 0 or limit < 8


DRAWINGS = st.one_of(
    RECTANGLES,
    st.tuples(st.just("text"), st.text("0123ab\u00b0", max_size=6), PLACES, PLACES, SIZES),
    st.tuples(st.just("line"), PLACES, PLACES, PLACES, PLACES, COLOURS),
)
STEPS = st.lists(
    st.one_of(
        DRAWINGS,
        st.tuples(st.just("show")),
        st.tuples(st.just("flush_step"), st.integers(0, 64)),
        st.tuples(st.just("nack"), st.integers(1, 12), st.integers(0, 60)),
        st.tuples(st.just("brown-out")),
        st.tuples(st.just("contrast"), st.integers(0, 255)),
    ),
    max_size=40,
)


@settings(max_examples=200, deadline=None)
@given(STEPS, st.sampled_from(("SSD1306 128x64", "SH1106 128x64")), st.sampled_from((8, 32)))
def test_whatever_happens_the_display_comes_to_show_the_buffer(steps, panel, chunk):
    chip, _bus, d = bench(panel, chunk=chunk)
    for name, *arguments in steps:
        if name == "nack":
            chip.nack_next(arguments[0], after=arguments[1])
        elif name == "brown-out":
            chip.vanish()
            d.fill_rect(0, 0, 9, 9, XOR)
            send(d)
            chip.come_back()
        else:
            getattr(d, name)(*arguments)
    chip.nack_next(0)
    # the frame under way, then the buffer; when a frame was given up, once more to be set up again
    for _ in range(3):
        d.flush()
        assert d.show()
    d.flush()
    assert not d.busy and not d.lost
    assert chip.lit and chip.picture() == rows(d)
    assert bytes(d._sent) == bytes(d.buffer)


def test_failures_are_counted_and_the_frame_given_up_at_last():
    chip, _bus, d = bench()
    d.fill(1)
    d.show()
    left = d.flush_step(32)
    chip.nack_next(3)
    assert [d.flush_step(32) for _ in range(3)] == [left] * 3, "sent again, not skipped"
    assert (d.errors, d.dropped, d.lost) == (3, 0, False)
    assert d.flush() and chip.picture() == rows(d)
    d.contrast(9)
    d.show()
    whole = d.flush_step(8) + 8
    chip.nack_next()
    assert d.flush_step(8) == whole and d.flush(), "the set-up from its start"
    chip.vanish()
    d.fill(0)
    d.show()
    calls = 0
    while d.flush_step(32):
        calls += 1
    assert calls == 7 and not d.busy
    assert (d.errors, d.dropped, d.lost) == (12, 1, True)
    d.show()
    assert d.flush_step(32) == 0 and d.errors == 13, "one attempt a frame while it is away"


def test_a_short_loss_of_power_between_frames_heals():
    chip, _bus, d = bench()
    d.text("still here", 0, 0)
    send(d)
    chip.vanish()
    chip.come_back()  # it answers again before anyone noticed
    frames = 0
    while not (chip.lit and chip.picture() == rows(d)):
        send(d)
        frames += 1
        assert frames <= 2 * 128, "one turn over the blocks and one for what came before"
    assert d.errors == 0


def test_without_refresh_it_does_not():
    """The failing twin."""
    chip, _bus, d = bench(refresh=False)
    chip.vanish()
    chip.come_back()
    for _ in range(300):
        send(d)
    assert not chip.lit


def test_an_interrupt_that_flushes_may_come_anywhere_in_show_and_drawing():
    """flush_step() called between any two lines of the main program, as a hard tick does."""
    lines = None
    at = 0
    while lines is None or at < lines:
        chip, _bus, d = bench("SSD1306 16x16", chunk=8)
        d.fill_rect(0, 0, 16, 9)
        d.show()
        d.flush_step(8)
        lines = interrupt_after(at, d)
        d.flush()
        assert send(d) and chip.picture() == rows(d), f"interrupted at line {at}"
        assert bytes(d._sent) == bytes(d.buffer) and d.errors == 0
        at += 1
    assert lines > 100


def interrupt_after(count, d):
    """Draw and show, with two steps of a flush after so many lines -> lines in all."""
    seen = 0

    def line(frame, event, argument):
        nonlocal seen
        if event == "line":
            if seen == count:
                sys.settrace(None)
                d.flush_step(16)
                d.flush_step(16)
                sys.settrace(call)
            seen += 1
        return line

    def call(frame, event, argument):
        return line if frame.f_code.co_filename.endswith(("ssd1306.py", "canvas.py")) else None

    sys.settrace(call)
    try:
        d.show()
        d.text("%", 3, 3)
        d.show()
        d.line(0, 0, 15, 15, XOR)
    finally:
        sys.settrace(None)
    return seen


def test_drawing_while_a_frame_is_sent_does_not_reach_the_display():
    chip, _bus, d = bench(chunk=8)
    d.fill(1)
    d.show()
    shown = bytes(d.buffer)
    while d.flush_step(8):
        d.fill_rect(0, 0, 60, 60, XOR)
        assert not d.show(), "not before the last frame is out"
    assert chip.frame() == shown


# ---------------------------------------------------------------- allocation


def results(printed):
    """name -> the words after it."""
    return {line.split()[0]: line.split()[1:] for line in printed.splitlines()}


def test_ten_thousand_pieces_allocate_nothing(micropython_runtime, portable):
    seen = results(portable(micropython_runtime, "ssd1306_alloc.py"))
    assert sorted(seen) == ["i2c-free", "i2c-locked", "spi-locked"]
    for name, words in seen.items():
        assert words[0] == "frames" and words[2:4] == ["bytes", "0"], name
    assert seen["i2c-locked"][-1] == "True", "with failed transfers among them"


@pytest.mark.parametrize("name", ["unix", "unix32"])
@pytest.mark.parametrize("twin", ["slice", "format"])
def test_what_allocates_is_noticed(name, portable, twin):
    seen = results(portable(require(name), "ssd1306_alloc.py", twin))
    assert seen["i2c-locked"] == ["ALLOCATES"]
    assert int(seen["i2c-free"][3]) > 0
