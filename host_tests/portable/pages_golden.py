# Draws every picture that is kept in host_tests/golden on a simulated display and prints, a line each:
# name, width, what a person sees (page format, hex). The same lines on every runtime.

from array import array

import machine
from chips.ssd1306 import SSD1306Chip
from upright import ssd1306
from upright_app import pages

LEVEL = (0, 0, 0)


class Bench:
    """A display of one kind on a bus, with its simulated chip."""

    def __init__(self, height=64, sh1106=False):
        machine.power_on()
        self.chip = SSD1306Chip(height=height, sh1106=sh1106)
        machine.wire_i2c(0, self.chip)
        panel = "%s 128x%d" % ("SH1106" if sh1106 else "SSD1306", height)
        self.display = ssd1306.SSD1306(machine.I2C(0), panel)
        self.display.begin()
        self.pages = pages.Pages(self.display)

    def show(self, name):
        self.display.show()
        assert self.display.flush()
        assert not self.chip.errors, self.chip.errors
        frame = self.chip.frame()
        assert frame == self.display.buffer, name
        print(name, self.chip.width, "".join("%02x" % b for b in frame))

    def page(self, name, page, angles, rate=200, temperature=3652, faults=0, flags=0):
        self.pages.draw(page, array("i", angles), rate, temperature, faults, flags)
        self.show(name)

    def state(self, name, status):
        self.pages.draw(pages.STATUS, array("i", [0] * 3), 500, 3652, 3, 0, array("i", status))
        self.show(name)


def fonts(bench):
    d = bench.display
    for size, name, across, step in (
        (ssd1306.SMALL, "small", 21, 9),
        (ssd1306.TALL, "tall", 21, 16),
    ):
        codes = [chr(c) for c in range(32, 127)] + ["\u00b0"]
        sheet = 1
        while codes:
            d.fill(0)
            for y in range(0, 64 - step + 1, step):
                d.text("".join(codes[:across]), 1, y, size)
                codes = codes[across:]
            bench.show("font_%s_%d" % (name, sheet))
            sheet += 1
    d.fill(0)
    for y, text in (
        (0, "0123456789"),
        (16, "+-.\u00b0 -12.5\u00b0"),
        (32, "AaBbGgKkMm"),
        (48, "RrWwXxZz%&"),
    ):
        d.text(text, 0, y, ssd1306.LARGE)
    bench.show("font_large")


def shapes(bench):
    d = bench.display
    d.fill(0)
    d.rect(-4, -4, 40, 20)
    d.fill_rect(100, 50, 60, 60)
    for i in range(0, 64, 8):
        d.line(40, i, 90, 63 - i)
    d.text("ab", -3, 20, ssd1306.LARGE)
    d.text("clip\u00b0", 110, -3)
    d.text("xyz", 112, 44, ssd1306.LARGE, ssd1306.XOR)
    d.text("inverse", 0, 40, ssd1306.SMALL, ssd1306.INVERSE)
    d.fill_rect(0, 50, 38, 14)
    d.text("black", 2, 52, ssd1306.SMALL, ssd1306.BLACK)
    d.number(-5, 30, 59)
    bench.show("shapes")


def numbers(bench):
    d = bench.display
    d.fill(0)
    y = 0
    for value in (0, -49, -50, 999949, 999950, -123456, 1 << 29, -(1 << 29)):
        d.number(value, 0, y, ssd1306.SMALL, 9, 1, 3)
        d.number(value, 60, y, ssd1306.SMALL, 0, 0, 0, True)
        y += 8
    bench.show("numbers")


def every_page(bench, tag):
    bench.page("numbers_" + tag, pages.NUMBERS, (-123456, 7049, -49))
    bench.page(
        "numbers_widest_" + tag, pages.NUMBERS, (180000, -90000, -179999), 1000, -1250, 1234, 1
    )
    bench.page("horizon_level_" + tag, pages.HORIZON, LEVEL)
    bench.page("horizon_bank_" + tag, pages.HORIZON, (20000, -8000, -42000), 500, 2149, 7, 1)
    bench.page("horizon_dive_" + tag, pages.HORIZON, (-65000, 30000, 170000), 1000, 8500)
    bench.page("horizon_inverted_" + tag, pages.HORIZON, (-178000, -5000, 90000))
    bench.page("horizon_up_" + tag, pages.HORIZON, (3000, -89000, 0))
    bench.page("lost_" + tag, pages.NUMBERS, (1000, 2000, 3000), 200, 3652, 12, 3)
    bench.page("no_mag_" + tag, pages.NUMBERS, (1000, 2000, 3000), 1000, 3652, 12, 4)
    bench.page("neither_" + tag, pages.HORIZON, LEVEL, 1000, 3652, 12, 5)
    bench.page("doubt_" + tag, pages.NUMBERS, (1000, 2000, -178500), 200, 3652, 0, 8)
    bench.page("doubt_horizon_" + tag, pages.HORIZON, (20000, -8000, 178500), 200, 3652, 0, 8)
    bench.state("state_" + tag, (1, 1, 1199, -801, 598, 2345))
    bench.state("state_bad_field_" + tag, (0, 2, -12345, 20000, -7, 179999))
    bench.state("state_six_" + tag, (-1, -1, 0, 0, 0, -1))
    bench.pages.message(
        "No MPU6050 at 0x68", "check wiring: SDA GP4, SCL GP5, VCC 3.3 V, GND", "retrying"
    )
    bench.show("message_" + tag)


bench = Bench()
fonts(bench)
shapes(bench)
numbers(bench)
every_page(bench, "64")
every_page(Bench(32), "32")
bench = Bench(64, True)
bench.page("numbers_sh1106", pages.NUMBERS, (-123456, 7049, -49))
