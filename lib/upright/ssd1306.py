# Driver of SSD1306 and SH1106 OLED displays on I2C or SPI; it allocates nothing once it is set up.
# Needs canvas.py, viper, and a bus with `writeto` (I2C) or `write`
# (SPI); runs on boards, the unix port and, with the host shim, CPython. Section numbers are those
# of the SSD1306 datasheet, rev 1.1; what differs on the SH1106 is from its own, v2.3.

import time
from array import array

import micropython
from micropython import const

from upright.canvas import (  # noqa: F401 (colours and sizes are part of this module)
    BLACK,
    INVERSE,
    LARGE,
    OPAQUE,
    SMALL,
    TALL,
    WHITE,
    XOR,
    Canvas,
)

_BLOCK = const(8)  # columns of one page that are tracked and sent together
_ATTEMPTS = const(8)  # failed transfers in a row after which a frame is given up
_FIRST = const(1)  # of the set-up's pieces that flush_step() sends; 0 is for begin() alone
_DONE = const(5)
_MOST_ERRORS = const(0x1FFFFFFF)  # the counters stop here: beyond 30 bits an int would be boxed


class DisplayError(OSError):
    """The display did not take its set-up: not there, or at another address."""


@micropython.viper
def _changes(fb, sent, dirty, stride: int, pages: int, everything: int) -> int:
    """Copies the blocks that differ (or all) into `sent` and marks them in `dirty`; returns how
    many.

    A single clean block between two dirty ones is marked too: sending it is cheaper than a new
    address.
    """
    p = ptr8(fb)
    q = ptr8(sent)
    d = ptr16(dirty)
    count = 0
    i = 0
    for page in range(pages):
        mask = 0
        bit = 1
        end = i + stride
        while i < end:
            differs = everything
            for k in range(8):
                if p[i + k] != q[i + k]:
                    differs = 1
                    q[i + k] = p[i + k]
            if differs:
                mask |= bit
            bit <<= 1
            i += 8
        mask |= (mask << 1) & (mask >> 1)
        d[page] = mask
        while mask:
            count += mask & 1
            mask >>= 1
    return count


@micropython.viper
def _run(dirty, pages: int, most: int) -> int:
    """First run of at most `most` dirty blocks: page << 12 | first block << 8 | how many; or 0."""
    d = ptr16(dirty)
    for page in range(pages):
        mask = d[page]
        if mask:
            first = 0
            while mask & 1 == 0:
                mask >>= 1
                first += 1
            n = 0
            while n < most and mask & 1:
                mask >>= 1
                n += 1
            return page << 12 | first << 8 | n
    return 0


@micropython.viper
def _load(tx, sent, head, run: int, stride: int, offset: int):
    """Makes the address commands and the data of a run."""
    t = ptr8(tx)
    s = ptr8(sent)
    c = ptr8(head)
    page = run >> 12
    x = (run >> 8 & 15) << 3
    n = (run & 255) << 3
    i = page * stride + x
    x += offset
    c[1] = 0xB0 | page  # 10.1.13: page of page addressing mode
    c[2] = x & 15  # 10.1.1, 10.1.2: column, low and high nibble
    c[3] = 0x10 | x >> 4
    for k in range(n):
        t[1 + k] = s[i + k]


def _parse(panel):
    """The name of a panel -> (whether its controller is an SH1106, width, height)."""
    try:
        controller, size = panel.split()
        width, height = map(int, size.split("x"))
    except (AttributeError, ValueError):
        controller = None
    if controller not in ("SSD1306", "SH1106"):
        raise ValueError(
            'name the panel "SSD1306 128x64", "SH1106 128x64" or alike, not %r' % (panel,)
        )
    if width % _BLOCK or not 8 <= width <= 128:
        raise ValueError("display width must be a multiple of 8 up to 128, not %d" % width)
    if height % 8 or not 16 <= height <= 64:  # 10.1.11: a multiplex ratio below 16 is invalid
        raise ValueError("display height must be a multiple of 8 from 16 to 64, not %d" % height)
    return controller == "SH1106", width, height


class SSD1306(Canvas):
    """An SSD1306 or SH1106 display on I2C or SPI: a canvas, and what sends it.

    bus: machine.I2C at up to 400 kHz (8.1.5), or machine.SPI in mode 0 or 3 at up to 10 MHz (table
    13-4; SH1106: 2 MHz). panel: controller and size: "SSD1306 128x64" (also 128x32, 96x16, 72x40,
    64x48, 64x32) or "SH1106 128x64"; an SSD1315 counts as an SSD1306. address: 0x3C or 0x3D, on
    I2C. dc, rst, cs: on SPI, output pins that can be called with 0 or 1; rst and cs are None where
    the module ties them. chunk: bytes that flush_step() sends at most, a multiple of 8 up to 128.
    rotate: 0 or 180. column_offset: the controller's column of the panel's left edge at rotate=0;
    by default the panel is in the middle of the controller's 128 (SH1106: 132), 96x16 at column 0.

    Drawing goes into `buffer` at any time. show() compares it with `_sent`, what the display holds,
    and hands over the blocks of 8 columns that differ; flush_step() sends them in bounded chunks.
    Between the two `busy` is True and only the caller of flush_step() touches `_sent` and the bus,
    so that a hard interrupt may do it. The copy costs width * height / 8 bytes. A number redrawn as
    it was costs nothing on the bus, and the main loop can draw while the last frame is sent.

    With `refresh` every show() also sends one block that did not change, in turn, and after each
    full turn the set-up again: a display that lost power for a moment, or SPI data to a glitch,
    heals in at most width * height / 64 frames. A display that stops answering is found by the
    first failed transfer and is set up again as soon as it answers.

    errors: failed transfers. dropped: frames given up. lost: the display did not answer last time.
    """

    _dc = _rst = _cs = None  # on I2C

    def __init__(
        self,
        bus,
        panel="SSD1306 128x64",
        address=0x3C,
        dc=None,
        rst=None,
        cs=None,
        chunk=32,
        rotate=0,
        column_offset=None,
        contrast=0xFF,
        refresh=True,
        **unknown,
    ):
        if unknown or isinstance(bus, int):
            raise ValueError(
                'call SSD1306(bus, "SSD1306 128x64"): first the bus, then the panel\'s name; an I2C '
                "address is address=, the pins of SPI are dc=, rst=, cs="
            )
        i2c = hasattr(bus, "writeto")
        if not i2c and not hasattr(bus, "write"):
            raise ValueError("%r is neither an I2C nor an SPI bus" % (bus,))
        if not i2c and not callable(dc):
            raise ValueError("a display on SPI needs dc=, the output pin that its D/C is wired to")
        if i2c and address not in (0x3C, 0x3D):
            if not isinstance(address, int) or address >> 1 not in (0x3C, 0x3D):
                raise ValueError("display address %r must be 0x3C or 0x3D" % (address,))
            raise ValueError(
                "display address 0x%02X is the 8-bit form, as modules print it: pass 0x%02X"
                % (address, address >> 1)
            )
        sh1106, width, height = _parse(panel)
        if not isinstance(chunk, int) or chunk % _BLOCK or not 8 <= chunk <= 128:
            raise ValueError("chunk must be a multiple of 8 from 8 to 128 bytes, not %r" % (chunk,))
        if rotate not in (0, 180):
            raise ValueError("rotate must be 0 or 180, not %r" % (rotate,))
        spare = (132 if sh1106 else 128) - width
        if column_offset is None:
            # 96x16 panels are wired to the last 96 segments, which are columns 0 to 95 (u8g2,
            # u8x8_d_ssd1306_96x16.c); all others to the middle (micropython-lib, u8g2)
            column_offset = 0 if (width, height) == (96, 16) else spare >> 1
        if not 0 <= column_offset <= spare:
            raise ValueError("column_offset must be 0 to %d, not %r" % (spare, column_offset))
        super().__init__(width, height)
        self.bus = bus
        self.panel = panel
        self.address = address
        self.pages = height // 8
        self.chunk = chunk
        self.busy = False
        self.lost = False
        self.errors = 0
        self.dropped = 0
        self._write = self._write_i2c if i2c else self._write_spi
        if not i2c:
            self._dc = dc
            self._rst = rst
            self._cs = cs
        self._sent = bytearray(width * self.pages)
        self._dirty = array("H", [0] * self.pages)
        self._offset = spare - column_offset if rotate else column_offset
        self._refresh = refresh
        self._sweep = 0
        self._left = 0
        self._fails = 0
        self._everything = True
        self._resend = False
        # I2C sends a control byte first: 0x00 commands, 0x40 data (8.1.5.2); SPI leaves it out and
        # has the D/C pin
        first = 0 if i2c else 1
        self._tx = bytearray(1 + chunk)
        self._tx[0] = 0x40
        self._head = bytearray(4)
        data = memoryview(self._tx)
        self._views = [data[first : 1 + n] for n in range(0, chunk + 1, _BLOCK)]
        self._head_view = memoryview(self._head)[first:]
        pieces = self._commands(sh1106, rotate, contrast)
        self._setup = [memoryview(bytearray(piece))[first:] for piece in pieces]
        self._piece = _DONE

    def _commands(self, sh1106, rotate, contrast):
        """The set-up (10.1) in pieces of at most 8 bytes, since the tick may send them, too."""
        # Panels of fewer columns come without the resistor of the brightness current and are dim
        # without AD 30, the internal one of 30 uA (SSD1306B and SSD1315; others ignore it:
        # micropython/micropython#7411, rust-embedded-community/ssd1306#141).
        current = (0xE3, 0xE3) if sh1106 or self.width == 128 else (0xAD, 0x30)
        pump = (0xE3, 0xE3) if sh1106 else (0x8D, 0x14)
        # 128x32 and 96x16 panels are wired sequentially, the others alternate (10.1.18)
        pins = 0x02 if self.width > 2 * self.height else 0x12
        order = (0xA0, 0xC0) if rotate else (0xA1, 0xC8)
        # E3 (no operation) first: it ends a command that was cut off before its parameter
        return (
            # off; the SH1106's pump, which starts only while the display is off; no scrolling
            (0x00, 0xE3, 0xE3, 0xAE) + ((0xAD, 0x8B) if sh1106 else (0x2E,)),
            # segment and COM order; multiplex ratio; current
            (0x00, 0xE3) + order + (0xA8, self.height - 1) + current,
            # start line 0; offset 0; COM wiring; clock
            (0x00, 0x40, 0xD3, 0x00, 0xDA, pins, 0xD5, 0x50 if sh1106 else 0x80),
            # pre-charge; VCOMH level; page addressing (the SH1106 has no other)
            (0x00, 0xD9) + ((0x22, 0xDB, 0x35) if sh1106 else (0xF1, 0xDB, 0x30, 0x20, 0x02)),
            # show the RAM; charge pump (appendix: 8D 14, then AF); contrast; not inverted; on
            (0x00, 0xA4) + pump + (0x81, contrast & 255, 0xA6, 0xAF),
        )

    # -------------------------------------------------------------------------- set-up and state

    def begin(self):
        """Sets the display up, shows the buffer and lights it; to be called before any tick runs.

        Raises DisplayError when nothing answers. The application may go on all the same: show() and
        flush_step() keep trying, and set the display up when it appears.
        """
        if self._cs is not None:
            self._cs(1)
        if self._rst is not None:
            for level in (1, 0, 1):
                self._rst(level)
                time.sleep_ms(1)  # 8.9: low for at least 3 us (SH1106: 10 us)
        self.busy = False
        self.lost = False
        try:
            self._write(0, self._setup[0])
        except OSError:
            self.errors += 1
            self._absent()
        # the contents are undefined at power-up: write them before the light goes on
        self._everything = True
        last = self._setup[-1]
        light = last[-1]
        last[-1] = 0xAE
        try:
            self._finish()
        finally:
            last[-1] = light
            self._resend = True
        self._finish()

    def _finish(self):
        self.show()
        if not self.flush():
            self._absent()

    def _absent(self):
        self.lost = True
        if not hasattr(self.bus, "writeto"):
            raise DisplayError("the SPI bus of the display failed: check its pins")
        text = "no display answers at 0x{:02X} (nor at 0x{:02X}): check VCC, GND, SDA and SCL"
        try:
            self.bus.writeto(self.address ^ 1, b"\x00\xe3")  # no operation
            text = "no display answers at 0x{:02X}, but one does at 0x{:02X}: pass that as address="
        except OSError:
            pass
        raise DisplayError(text.format(self.address, self.address ^ 1))

    def contrast(self, level):
        """Brightness 0..255; takes effect with the next show()."""
        self._setup[-1][-3] = level & 255
        self._resend = True

    def invert(self, on):
        """Dark on light; takes effect with the next show()."""
        self._setup[-1][-2] = 0xA7 if on else 0xA6
        self._resend = True

    def power(self, on):
        """Display on, or asleep with its contents kept; takes effect with the next show()."""
        self._setup[-1][-1] = 0xAF if on else 0xAE
        self._resend = True

    # -------------------------------------------------------------------------- sending

    def show(self):
        """Hands what was drawn to flush_step(). False while the last frame is still being sent."""
        if self.busy:
            return False
        everything = 1 if self.lost or self._everything else 0
        self._everything = False
        if everything or self._resend:
            self._resend = False
            self._piece = _FIRST
        blocks = _changes(self.buffer, self._sent, self._dirty, self.width, self.pages, everything)
        if self._refresh:
            blocks += self._freshen()
        self._left = (blocks + _DONE - self._piece) * _BLOCK
        # last of all: from here on the sender, perhaps an interrupt, owns _sent, _dirty and the bus
        self.busy = self._left > 0
        return True

    def _freshen(self):
        """Marks the next block in turn as if it had changed; returns how many that adds, 0 or 1."""
        at = self._sweep
        page = at >> 4
        bit = 1 << (at & 15)
        at += 1
        if at & 15 >= self.width >> 3:
            at = (at | 15) + 1
        if at >> 4 >= self.pages:
            at = 0
            self._resend = True
        self._sweep = at
        if self._dirty[page] & bit:
            return 0
        self._dirty[page] |= bit
        return 1

    def flush_step(self, max_bytes):
        """Sends at most max_bytes, and `chunk`, of the frame; only for the owner of the bus.

        Returns how many bytes are still to do: 0 when done, and then `busy` is False. Allocates
        nothing and raises nothing: a failed transfer is counted, and sent again by the next call;
        after 8 in a row (1 when the last frame failed as well) the frame is given up and `lost`
        set. Bytes go in eights: below 8 nothing is sent. Bus time at 400 kHz: (n + 7) * 9 bits,
        which is 0.88 ms for n = 32 and 0.34 ms for n = 8.
        """
        if not self.busy:
            return 0
        if max_bytes < _BLOCK:
            return self._left
        try:
            if self._piece < _DONE:
                self._write(0, self._setup[self._piece])
                self._piece += 1
                self._left -= _BLOCK
            else:
                self._send(max_bytes if max_bytes < self.chunk else self.chunk)
        except OSError:
            return self._failed()
        self._fails = 0
        if self._left <= 0:
            self.lost = False
            self.busy = False
            return 0
        return self._left

    def _send(self, most):
        run = _run(self._dirty, self.pages, most >> 3)
        if run == 0:
            self._left = 0
            return
        _load(self._tx, self._sent, self._head, run, self.width, self._offset)
        self._write(0, self._head_view)
        self._write(1, self._views[run & 255])
        # only now: a chunk that failed stays marked
        self._dirty[run >> 12] &= ~(((1 << (run & 255)) - 1) << (run >> 8 & 15))
        self._left -= (run & 255) << 3

    def _failed(self):
        if self.errors < _MOST_ERRORS:
            self.errors += 1
        self._fails += 1
        if self._piece < _DONE:
            self._left += (self._piece - _FIRST) * _BLOCK
            self._piece = _FIRST  # whose no-operation ends a command that was cut in two
        if self._fails < _ATTEMPTS and not self.lost:
            return self._left
        if self.dropped < _MOST_ERRORS:
            self.dropped += 1
        self._fails = 0
        self.lost = True
        self.busy = False
        return 0

    def flush(self):
        """Sends all that show() handed over, if the main loop owns the bus. False when given up."""
        while self.flush_step(self.chunk):
            pass
        return not self.lost

    def _write_i2c(self, data, view):
        self.bus.writeto(self.address, view)

    def _write_spi(self, data, view):
        self._dc(data)
        if self._cs is None:
            self.bus.write(view)
            return
        try:
            self._cs(0)
            self.bus.write(view)
        finally:
            self._cs(1)


# micropython-lib's names: code that is moved over from there is told how to call this class
SSD1306_I2C = SSD1306_SPI = SSD1306
