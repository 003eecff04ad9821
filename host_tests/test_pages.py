"""The OLED's pages: the same pictures on every runtime as those kept, readable, in golden/.

UPDATE_GOLDEN=1 writes them anew; look at the difference before keeping it.
"""

import os
from array import array
from pathlib import Path

import machine
import pytest
from chips.ssd1306 import SSD1306Chip
from hypothesis import given, settings
from hypothesis import strategies as st
from upright import ssd1306
from upright_app import pages
from upright_host import oled, runtimes

GOLDEN = Path(__file__).parent / "golden"
SCRIPT = "pages_golden.py"


def as_text(frame: bytes, width: int) -> str:
    rows = oled.rows_of_frame(frame, width)
    return "".join("".join(".#"[v] for v in row) + "\n" for row in rows)


def pictures(printed: str) -> dict[str, str]:
    out = {}
    for line in printed.splitlines():
        name, width, digits = line.split()
        out[name] = as_text(bytes.fromhex(digits), int(width))
    return out


def test_pictures_are_those_kept(runtime, portable):
    drawn = pictures(portable(runtime, SCRIPT))
    if os.environ.get("UPDATE_GOLDEN") and runtime == "cpython":
        GOLDEN.mkdir(exist_ok=True)
        for old in GOLDEN.glob("*.txt"):
            old.unlink()
        for name, text in drawn.items():
            (GOLDEN / f"{name}.txt").write_text(text)
    kept = {path.stem: path.read_text() for path in GOLDEN.glob("*.txt")}
    assert sorted(drawn) == sorted(kept)
    for name, text in drawn.items():
        assert text == kept[name], f"{name} differs:\n{text}"


def test_one_pixel_more_is_noticed():
    name, text = next(iter(pictures("x 8 0100000000000080").items()))
    assert (name, text) == ("x", "#.......\n" + 6 * "........\n" + ".......#\n")


@pytest.fixture
def bench():
    chip = SSD1306Chip()
    machine.wire_i2c(0, chip)
    display = ssd1306.SSD1306(machine.I2C(0))
    display.begin()
    return chip, display, pages.Pages(display)


@pytest.mark.parametrize("panel", ["SSD1306 72x40", "SSD1306 64x32", "SSD1306 128x16"])
def test_a_panel_that_the_pages_do_not_fit_is_refused(panel):
    with pytest.raises(ValueError, match=f"128x64 or 128x32 pixels, not {panel.split()[1]}"):
        pages.Pages(ssd1306.SSD1306(machine.I2C(0), panel))


def draw(bench, page, angles, rate=200, temperature=2500, faults=0, flags=0):
    _chip, display, book = bench
    book.draw(page, array("i", angles), rate, temperature, faults, flags)
    return oled.rows_of_frame(display.buffer)


def horizon_height(rows, x):
    """Where the horizon crosses column x (the topmost lit pixel of that column), from the top."""
    return next(y for y in range(len(rows)) if rows[y][x])


def test_right_side_down_lifts_the_right_end_of_the_horizon(bench):
    rows = draw(bench, pages.HORIZON, (20000, 0, 0))
    assert horizon_height(rows, 80) < 27 - 10 < 27 + 10 < horizon_height(rows, 2)


def test_nose_down_lifts_the_horizon(bench):
    # in frames with y left a positive pitch is nose down
    down = horizon_height(draw(bench, pages.HORIZON, (0, 10000, 0)), 2)
    level = horizon_height(draw(bench, pages.HORIZON, (0, 0, 0)), 2)
    assert (level, down) == (27, 17)


def test_pitch_of_the_other_sign_convention(bench):
    chip, display, _book = bench
    other = (chip, display, pages.Pages(display, nose_up_positive=True))
    assert horizon_height(draw(other, pages.HORIZON, (0, -10000, 0)), 2) == 17


def test_the_heading_counts_clockwise(bench):
    _chip, display, _book = bench
    a = draw(bench, pages.HORIZON, (0, 0, 90000))  # turned left: west
    display.number(270, 98, 37, ssd1306.TALL, 4)
    assert oled.rows_of_frame(display.buffer) == a


def test_flags_show(bench):
    plain = draw(bench, pages.NUMBERS, (0, 0, 0))
    unknown = draw(bench, pages.NUMBERS, (0, 0, 0), flags=pages.BIAS_UNKNOWN)
    lost = draw(bench, pages.NUMBERS, (0, 0, 0), flags=pages.SENSOR_LOST)
    assert plain != unknown != lost != plain
    assert plain[:54] == unknown[:54]


@pytest.mark.parametrize("page", [pages.NUMBERS, pages.HORIZON])
def test_a_doubtful_yaw_is_marked_and_stays_readable(bench, page):
    plain = draw(bench, page, (0, 0, -178500))
    doubt = draw(bench, page, (0, 0, -178500), flags=pages.YAW_DOUBTFUL)
    assert plain != doubt
    for a, b in zip(plain, doubt, strict=True):
        assert not any(was and not now for was, now in zip(a, b, strict=True))  # nothing is covered


@settings(max_examples=150, deadline=None)
@given(
    st.integers(-180000, 180000),
    st.integers(-90000, 90000),
    st.integers(-180000, 180000),
    st.sampled_from((32, 64)),
)
def test_any_attitude_stays_inside_its_part_of_the_page(roll, pitch, yaw, height):
    class Nowhere:
        def writeto(self, address, data):
            pass

    display = ssd1306.SSD1306(Nowhere(), f"SSD1306 128x{height}")
    book = pages.Pages(display)
    angles = array("i", (roll, pitch, yaw))
    book.draw(pages.HORIZON, angles, 200, 2500, 0, 0)
    rows = oled.rows_of_frame(display.buffer)
    angles[0] = angles[1] = 0
    book.draw(pages.HORIZON, angles, 200, 2500, 0, 0)
    level = oled.rows_of_frame(display.buffer)
    assert rows[-8:] == level[-8:], "the status line"
    assert [row[86] for row in rows] == [row[86] for row in level], "the divider"
    assert all(not any(row[87:89]) for row in rows[: height - 10])


def test_sine_is_a_sine():
    from math import radians, sin

    for angle in range(-400000, 400001, 137):
        assert abs(pages.sine(angle) - 16384 * sin(radians(angle / 1000))) < 2.5


def test_a_message_wraps_at_words():
    assert pages.wrap("check wiring: SDA GP4, SCL GP5", 21) == ["check wiring: SDA", "GP4, SCL GP5"]
    assert pages.wrap("a" * 25, 21) == ["a" * 21, "a" * 4]
    assert pages.wrap("", 21) == [""]
    assert pages.wrap("ab " + "c" * 22, 21) == ["ab", "c" * 21, "c"]


# ---------------------------------------------------------------- pictures on the host


def checker():
    return [bytearray((x + y) & 1 for x in range(128)) for y in range(64)]


def test_terminal_form_fits_the_width():
    rows = checker()
    assert [len(line) for line in oled.terminal(rows, 80)] == [64] * 16
    assert [len(line) for line in oled.terminal(rows, 132)] == [128] * 32


def test_a_terminal_of_another_encoding_gets_characters_that_it_has():
    """With LANG=C the picture was a wall of question marks."""
    rows = checker()
    rows[:8] = [bytearray(128)] * 8
    for columns, wide in ((80, 64), (132, 128)):
        lines = oled.terminal(rows, columns, "ascii")
        assert {len(line) for line in lines} == {wide}
        assert len(set("".join(lines))) >= 2 and "?" not in "".join(lines)
    assert set("".join(oled.terminal([bytearray(128)] * 64, 80, "ascii"))) == {" "}


def test_braille_and_half_blocks_show_each_dot():
    rows = [bytearray(2) for _ in range(4)]
    assert oled.braille(rows) == ["\u2800"] and oled.half_blocks(rows) == ["  ", "  "]
    rows[3][1] = rows[0][0] = 1
    assert oled.braille(rows) == ["\u2881"]
    assert oled.half_blocks(rows) == ["\u2580 ", " \u2584"]


def test_image_shows_each_dot_with_a_gap():
    rows = checker()
    image = oled.image(rows, scale=6, margin=0).convert("RGB")
    assert image.size == (768, 384)
    assert image.getpixel((6 + 2, 2)) == oled.LIT and image.getpixel((2, 2)) != oled.LIT
    assert image.getpixel((6 + 5, 2)) != oled.LIT, "the gap"


def test_png_and_gif_are_written(tmp_path):
    from PIL import Image

    rows = checker()
    other = [bytearray(128) for _ in range(64)]
    png = Image.open(oled.save_png(rows, tmp_path / "a.png"))
    assert png.size == (128 * 6 + 36, 64 * 6 + 36)
    gif = Image.open(oled.save_gif([rows, rows, other], tmp_path / "a.gif", frame_ms=50))
    assert gif.n_frames == 2 and gif.info["duration"] == 100
    with pytest.raises(ValueError, match="no frames"):
        oled.save_gif([], tmp_path / "b.gif")


def test_a_runtime_that_draws_otherwise_fails(tmp_path):
    """The failing twin: another font, run as the pictures are, gives other pictures."""
    script = tmp_path / "twin.py"
    source = (Path(__file__).parent / "portable" / SCRIPT).read_text()
    script.write_text(source.replace("LEVEL = (0, 0, 0)", "LEVEL = (1000, 0, 0)"))
    done = runtimes.run("cpython", script)
    assert done.returncode == 0, done.stderr
    drawn = pictures(done.stdout)
    name = "horizon_level_64"
    assert drawn[name] != (GOLDEN / f"{name}.txt").read_text()
