# Drawing into a page-format frame buffer (SSD1306, SH1106) without allocating anything. Needs
# font.py of this package and viper; runs on boards, the unix port and, with the host shim, CPython.

import sys

import micropython
from micropython import const

try:
    import framebuf
except ImportError:
    framebuf = None

from upright.font import LARGE, SMALL, TALL, columns  # noqa: F401 (sizes are part of this module)

# Colours. OPAQUE and INVERSE draw a character's whole cell, so that a number replaces the old one.
BLACK = const(0)
WHITE = const(1)
XOR = const(2)
OPAQUE = const(3)
INVERSE = const(4)

_SMALL = const(1)  # font.SMALL, for viper
_ENCODE = sys.implementation.name == "cpython"  # there a str has no buffer to point at


@micropython.viper
def _fill(fb, stride: int, height: int, x: int, y: int, w: int, h: int, colour: int):
    """A filled rectangle, clipped."""
    p = ptr8(fb)
    x1 = x + w
    y1 = y + h
    if x < 0:
        x = 0
    if y < 0:
        y = 0
    if x1 > stride:
        x1 = stride
    if y1 > height:
        y1 = height
    page = y >> 3
    while page << 3 < y1:
        top = page << 3
        mask = 255 << (y - top) if top < y else 255
        if top + 8 > y1:
            mask &= 255 >> (top + 8 - y1)
        # new = (old & keep) ^ flip
        flip = mask & 255
        keep = 255 ^ flip
        if colour == XOR:
            keep = 255
        elif colour & 1 == 0:  # BLACK, INVERSE
            flip = 0
        i = page * stride + x
        end = page * stride + x1
        while i < end:
            p[i] = (p[i] & keep) ^ flip
            i += 1
        page += 1


@micropython.viper
def _blit(fb, stride: int, height: int, cols, w: int, h: int, x: int, y: int, colour: int):
    """A picture of w little-endian 16-bit columns, h <= 16 pixels high, clipped."""
    p = ptr8(fb)
    q = ptr8(cols)
    if y <= 0 - h or y >= height:
        return
    cell = ((1 << h) - 1) << (y & 7)
    i = 0
    if x < 0:
        i = 0 - x
    if x + w > stride:
        w = stride - x
    while i < w:
        bits = ((q[2 * i] | q[2 * i + 1] << 8) << (y & 7)) & cell
        # new = (old & ~clear) ^ flip
        clear = bits
        flip = bits
        if colour == BLACK:
            flip = 0
        elif colour == XOR:
            clear = 0
        elif colour >= OPAQUE:
            clear = cell
            if colour == INVERSE:
                flip = cell ^ bits
        at = y >> 3
        o = at * stride + x + i
        while clear | flip:
            if at >= 0 and at << 3 < height:
                p[o] = (p[o] & (clear ^ 255)) ^ (flip & 255)
            clear >>= 8
            flip >>= 8
            at += 1
            o += stride
        i += 1


@micropython.viper
def _line(fb, stride: int, height: int, x0: int, y0: int, x1: int, y1: int, colour: int):
    """Bresenham, clipped pixel by pixel."""
    p = ptr8(fb)
    dx = int(abs(x1 - x0))
    dy = 0 - int(abs(y1 - y0))
    sx = -1 if x0 > x1 else 1
    sy = -1 if y0 > y1 else 1
    e = dx + dy
    left = dx if dx > 0 - dy else 0 - dy
    while left >= 0:
        if x0 >= 0 and x0 < stride and y0 >= 0 and y0 < height:
            i = (y0 >> 3) * stride + x0
            bit = 1 << (y0 & 7)
            if colour == XOR:
                p[i] = p[i] ^ bit
            elif colour & 1:
                p[i] = p[i] | bit
            else:
                p[i] = p[i] & (255 ^ bit)
        twice = 2 * e
        if twice >= dy:
            e += dy
            x0 += sx
        if twice <= dx:
            e += dx
            y0 += sy
        left -= 1


@micropython.viper
def _text(
    fb, stride: int, height: int, cols, s, n: int, utf8: int, x: int, y: int, size: int, colour: int
) -> int:
    """n characters of UTF-8, or n bytes that stand for themselves; returns the x after them."""
    p = ptr8(s)
    h = 8 if size == _SMALL else 16
    i = 0
    while n > 0:
        code = p[i]
        if code == 0:  # the end of a str in MicroPython, where some builds count bytes in len()
            return x
        i += 1
        if utf8 and code >= 0xC0:
            if code < 0xE0:
                code = (code & 31) << 6 | (p[i] & 63)
                i += 1
            else:
                i += 2
                if code >= 0xF0:
                    i += 1
                code = 0
        w = int(columns(code, size, cols))
        if x < stride:
            _blit(fb, stride, height, cols, w, h, x, y, colour)
        x += w
        n -= 1
    return x


@micropython.viper
def _digits(out, value: int, drop: int, decimals: int, sign: int, width: int) -> int:
    """value * 10**-(drop + decimals) as ASCII, the last `drop` digits rounded away; returns the
    length.

    Halves round away from zero, and what rounds to zero has no minus. What does not fit in width is
    all '#'.
    """
    p = ptr8(out)
    v = value
    if v < 0:
        v = 0 - v
    unit = 1
    while drop > 0:
        unit *= 10
        drop -= 1
    v = (v + (unit >> 1)) // unit
    mark = 43 if sign else 0
    if value < 0 and v > 0:
        mark = 45
    # backwards into the upper half, where there is room for any int
    i = 48
    places = 0
    while v > 0 or places <= decimals:
        if places == decimals and decimals > 0:
            i -= 1
            p[i] = 46
        i -= 1
        p[i] = 48 + v % 10
        v //= 10
        places += 1
    if mark:
        i -= 1
        p[i] = mark
    n = 48 - i
    if width == 0:
        width = n
    o = 0
    while o < width:
        if n > width:
            p[o] = 35
        elif o < width - n:
            p[o] = 32
        else:
            p[o] = p[48 - width + o]
        o += 1
    return width


class Canvas:
    """A width x height frame buffer and what draws into it; everything is clipped at the edges.

    buffer: bytearray of width * height / 8, page after page of 8 rows, one byte a column, LSB on
    top. framebuffer: a framebuf.FrameBuffer on the same bytes, or None where the port has none.
    Coordinates are pixels from the upper left corner, within +-8000, negative ones included.
    """

    def __init__(self, width, height):
        self.width = width
        self.height = height
        self.buffer = bytearray(width * (height // 8))
        # an attribute: with a property in its class, every store to an instance costs a search
        self.framebuffer = None
        if framebuf is not None:
            self.framebuffer = framebuf.FrameBuffer(self.buffer, width, height, framebuf.MONO_VLSB)
        self._cols = bytearray(24)
        self._ascii = bytearray(48)

    # native: default arguments without a frame on the heap, which bytecode takes beyond 11 words

    @micropython.native
    def fill(self, colour):
        """The whole display."""
        _fill(self.buffer, self.width, self.height, 0, 0, self.width, self.height, colour)

    @micropython.native
    def pixel(self, x, y, colour=WHITE):
        """One pixel; like everything here, clipped at the edges: x and y may be negative."""
        _fill(self.buffer, self.width, self.height, x, y, 1, 1, colour)

    @micropython.native
    def hline(self, x, y, w, colour=WHITE):
        """w pixels to the right from (x, y)."""
        _fill(self.buffer, self.width, self.height, x, y, w, 1, colour)

    @micropython.native
    def vline(self, x, y, h, colour=WHITE):
        """h pixels down from (x, y)."""
        _fill(self.buffer, self.width, self.height, x, y, 1, h, colour)

    @micropython.native
    def line(self, x0, y0, x1, y1, colour=WHITE):
        """Both ends included. Takes time for all of its length, off the display as well."""
        _line(self.buffer, self.width, self.height, x0, y0, x1, y1, colour)

    @micropython.native
    def fill_rect(self, x, y, w, h, colour=WHITE):
        """w x h pixels from the upper left corner (x, y)."""
        _fill(self.buffer, self.width, self.height, x, y, w, h, colour)

    @micropython.native
    def rect(self, x, y, w, h, colour=WHITE):
        """The outline of fill_rect, each pixel once (so XOR twice restores)."""
        if w < 1 or h < 1:
            return
        self.hline(x, y, w, colour)
        if h > 1:
            self.hline(x, y + h - 1, w, colour)
        self.vline(x, y + 1, h - 2, colour)
        if w > 1:
            self.vline(x + w - 1, y + 1, h - 2, colour)

    @micropython.native
    def text(self, s, x, y, size=SMALL, colour=OPAQUE):
        """A str with its upper left corner at (x, y); returns the x after it.

        Also bytes: one character a byte, 0xB0 the degree sign. size: SMALL 6x8, LARGE 12x16, TALL
        6x16. A character that the font lacks shows as ?.
        """
        n = len(s)
        utf8 = 1 if isinstance(s, str) else 0
        if _ENCODE and utf8:
            s = s.encode()
        return _text(
            self.buffer, self.width, self.height, self._cols, s, n, utf8, x, y, size, colour
        )

    @micropython.native
    def number(
        self, value, x, y, size=SMALL, width=0, decimals=0, point=0, sign=False, colour=OPAQUE
    ):
        """The int value * 10**-point, rounded to `decimals` places, without a str; returns the x
        after it.

        Example: number(-123456, 0, 0, LARGE, 6, 1, 3) shows -123456 millidegrees as "-123.5".
        value: within +-2**30. point: 0..9. decimals: 0..point. width: 0..24 characters, padded on
        the left (0: as many as it takes); a number too long for it shows as ###. sign: + before a
        number that is not negative. Halves round away from zero; what rounds to zero has no minus.
        """
        n = _digits(self._ascii, value, point - decimals, decimals, 1 if sign else 0, width)
        return _text(
            self.buffer, self.width, self.height, self._cols, self._ascii, n, 0, x, y, size, colour
        )

    def text_width(self, s, size=SMALL):
        """Pixels that text() would take."""
        return _text(self.buffer, -1, 0, self._cols, s.encode(), len(s), 1, 0, 0, size, BLACK)
