# What the OLED shows: numbers, an artificial horizon, a status line below both, and messages. Needs
# a display of upright.ssd1306, 128x64 or 128x32; runs in the main loop on every runtime. draw()
# allocates nothing and takes integers only; message() is for start-up and may allocate.

from array import array

import micropython
from micropython import const
from upright.ssd1306 import BLACK, INVERSE, LARGE, SMALL, TALL, WHITE

COUNT = const(3)  # pages that draw() knows
NUMBERS = const(0)
HORIZON = const(1)
STATUS = const(2)

# words of the status page, array('i')
REST = const(0)  # 1: at rest, 0: moving, -1: the filter does not say
FIELD = const(1)  # 1: used, 2: rejected, 0: no field, -1: six axes
BIAS = const(2)  # 3: the gyro's, millidegrees/s
DOUBT = const(5)  # how far the heading may be off, millidegrees; -1: the filter does not say
STATUS_WORDS = const(6)

# flags of draw()
BIAS_UNKNOWN = const(1)  # the gyro's bias was not measured: the yaw drifts
SENSOR_LOST = const(2)  # no fresh sample: the angles are old
MAG_LOST = const(4)  # a nine-axis filter has no magnetometer now: the yaw drifts
YAW_DOUBTFUL = const(8)  # the yaw may be off by more than YAW_DOUBT_MDEG
YAW_DOUBT_MDEG = const(20000)

_PANEL = const(42)  # columns right of the horizon, for the figures
_LADDER = const(10)  # degrees between the rungs of the pitch ladder
_Q = const(14)  # of sines, and of the geometry worked out from them
_HALF = const(8192)

# sin of 0..90 degrees, Q14, and one more for the interpolation at 90
# fmt: off
_SINE = array("h", (
    0, 286, 572, 857, 1143, 1428, 1713, 1997, 2280, 2563, 2845, 3126, 3406,
    3686, 3964, 4240, 4516, 4790, 5063, 5334, 5604, 5872, 6138, 6402, 6664, 6924,
    7182, 7438, 7692, 7943, 8192, 8438, 8682, 8923, 9162, 9397, 9630, 9860, 10087,
    10311, 10531, 10749, 10963, 11174, 11381, 11585, 11786, 11982, 12176, 12365, 12551, 12733,
    12911, 13085, 13255, 13421, 13583, 13741, 13894, 14044, 14189, 14330, 14466, 14598, 14726,
    14849, 14968, 15082, 15191, 15296, 15396, 15491, 15582, 15668, 15749, 15826, 15897, 15964,
    16026, 16083, 16135, 16182, 16225, 16262, 16294, 16322, 16344, 16362, 16374, 16382, 16384,
    16384,
))
# fmt: on


@micropython.viper
def sine(angle: int) -> int:
    """sin of millidegrees, any angle within +-2**30, as Q14, within 3 LSB."""
    table = ptr16(_SINE)
    angle %= 360000
    negative = 0
    if angle >= 180000:
        angle -= 180000
        negative = 1
    if angle > 90000:
        angle = 180000 - angle
    i = angle // 1000
    s = table[i] + ((table[i + 1] - table[i]) * (angle % 1000) + 500) // 1000
    if negative:
        s = 0 - s
    return s


@micropython.viper
def _ground(fb, stride: int, size: int, sin: int, cos: int, offset: int):
    """Dots below the horizon in a window of size >> 8 columns and size & 255 rows, at the top left.

    A pixel (x, y) from the window's middle is below it where x * sin + y * cos > offset, all Q14.
    The dots stay where they are while the horizon moves, so that few bytes change from frame to
    frame.
    """
    p = ptr8(fb)
    w = size >> 8
    h = size & 255
    offset += 32768  # two pixels clear of the line
    y = 0
    while y < h:
        x = y & 2
        below = (x - (w >> 1)) * sin + (y - (h >> 1)) * cos - offset
        i = (y >> 3) * stride
        bit = 1 << (y & 7)
        while x < w:
            if below > 0:
                p[i + x] = p[i + x] | bit
            below += 4 * sin
            x += 4
        y += 2


class Pages:
    """The pages on one display.

    nose_up_positive: which way the pitch counts. In this project's frames (x forward, y left, z up)
    a positive pitch is nose down, so False.
    """

    def __init__(self, display, nose_up_positive=False):
        if display.width != 128 or display.height not in (32, 64):
            size = (display.width, display.height)
            raise ValueError("the firmware's pages need 128x64 or 128x32 pixels, not %dx%d" % size)
        self._display = display
        self._low = display.height < 64
        self._nose_sign = 1 if nose_up_positive else -1
        self._window = display.width - _PANEL  # columns of the horizon
        self._rows = display.height - (8 if self._low else 9)  # and its rows

    @micropython.native
    def draw(self, page, angles, rate_hz, temperature, faults, flags, status=None):
        """Draws a page into the display's buffer; the caller then calls display.show().

        page: NUMBERS, HORIZON, or STATUS, which needs `status`, an array('i') of STATUS_WORDS. angles:
        array('i') of roll, pitch, yaw in millidegrees, within +-180000. rate_hz: samples per second.
        temperature: centidegrees Celsius. faults: a count.
        flags: BIAS_UNKNOWN, SENSOR_LOST, MAG_LOST, YAW_DOUBTFUL.
        """
        self._display.fill(BLACK)
        if page == STATUS:
            self._draw_state(status)
        elif page == HORIZON:
            self._draw_horizon(angles, flags)
        elif self._low:
            self._draw_numbers_low(angles, flags)
        else:
            self._draw_numbers(angles, flags)
        self._draw_status(rate_hz, temperature, faults, flags)

    @micropython.native
    def _draw_status(self, rate_hz, temperature, faults, flags):
        d = self._display
        y = d.height - 8
        if flags & SENSOR_LOST:
            d.fill_rect(0, y - 1, d.width, 9, WHITE)
            d.text("SENSOR LOST", 1, y, SMALL, BLACK)
            d.text("F", 90, y, SMALL, BLACK)
            d.number(faults if faults < 999 else 999, 96, y, SMALL, 0, 0, 0, False, BLACK)
        else:
            x = d.number(rate_hz if rate_hz < 9999 else 9999, 0, y, SMALL, 4)
            d.text("Hz", x, y)
            x = d.number(temperature, 41, y, SMALL, 5, 1, 2)
            d.text("°C", x, y)
            d.text("F", 90, y)
            d.number(faults if faults < 999 else 999, 96, y)
        if flags & (BIAS_UNKNOWN | MAG_LOST):
            d.fill_rect(115, y, 13, 8, WHITE)
            unknown = "B?" if not flags & MAG_LOST else "BM" if flags & BIAS_UNKNOWN else "M?"
            d.text(unknown, 116, y, SMALL, BLACK)

    # -------------------------------------------------------------------------- numbers

    @micropython.native
    def _draw_numbers(self, angles, flags):
        self._large("ROLL", angles[0], 1)
        self._large("PITCH", angles[1], 19)
        self._large("YAW?" if flags & YAW_DOUBTFUL else "YAW", angles[2], 37)
        self._display.hline(0, 54, self._display.width)

    @micropython.native
    def _large(self, name, angle, y):
        d = self._display
        d.text(name, 2, y + 7)
        d.text("°", d.number(angle, 55, y, LARGE, 6, 1, 3) + 1, y, LARGE)

    @micropython.native
    def _draw_numbers_low(self, angles, flags):
        self._column("ROLL", angles[0], 0, 12)
        self._column("PITCH", angles[1], 45, 6)
        if flags & YAW_DOUBTFUL:
            self._column("YAW?", angles[2], 90, 12)
        else:
            self._column("YAW", angles[2], 90, 18)

    @micropython.native
    def _column(self, name, angle, x, indent):
        d = self._display
        d.text(name, x + indent, 0)
        d.number(angle, x, 8, TALL, 6, 1, 3)

    # -------------------------------------------------------------------------- horizon

    @micropython.native
    def _draw_horizon(self, angles, flags):
        """Seen along the body's x axis; a positive roll (right side down) lifts the right end."""
        d = self._display
        sin = sine(angles[0])
        cos = sine(angles[0] + 90000)
        nose = angles[1] * self._nose_sign  # millidegrees up
        # one pixel a degree
        window = self._window << 8 | self._rows
        _ground(d.buffer, d.width, window, sin, cos, nose * 2048 // 125)
        self._rung(0, self._window, nose, sin, cos)
        degree = nose // 1000 // _LADDER * _LADDER - 20
        while degree <= nose // 1000 + 30:
            if degree != 0 and -90 <= degree <= 90:
                self._rung(degree, 8 if degree % 20 else 14, nose, sin, cos)
            degree += _LADDER
        self._draw_symbol()
        self._draw_figures(angles)
        if flags & YAW_DOUBTFUL:  # where a sign would stand
            x = self._window + 9
            d.text("?", x, 16 if self._low else 45)

    @micropython.native
    def _rung(self, degree, half, nose, sin, cos):
        """A line 2 * half pixels long at this elevation."""
        up = degree * 1000 - nose
        # Q14, rounded once here and shifted below; up / 1000 pixels along (-sin, -cos)
        x = ((self._window >> 1) << _Q) + _HALF - up * (sin >> 4) // 1000 * 16
        y = ((self._rows >> 1) << _Q) + _HALF - up * (cos >> 4) // 1000 * 16
        sin *= half
        cos *= half
        self._display.line((x - cos) >> _Q, (y + sin) >> _Q, (x + cos) >> _Q, (y - sin) >> _Q)

    @micropython.native
    def _draw_symbol(self):
        """The body: two wings and a dot that stay in the middle, on a black edge."""
        d = self._display
        x = self._window >> 1
        y = self._rows >> 1
        d.fill_rect(x - 24, y - 2, 18, 5, BLACK)
        d.fill_rect(x + 7, y - 2, 18, 5, BLACK)
        d.fill_rect(x - 2, y - 2, 5, 5, BLACK)
        d.fill_rect(x - 23, y - 1, 16, 3)
        d.fill_rect(x + 8, y - 1, 16, 3)
        d.fill_rect(x - 1, y - 1, 3, 3)

    @micropython.native
    def _draw_figures(self, angles):
        """Roll, pitch and heading in whole degrees; covers what was drawn there."""
        d = self._display
        x = self._window
        d.fill_rect(x, 0, _PANEL, d.height, BLACK)
        d.fill_rect(0, self._rows, d.width, d.height, BLACK)
        d.vline(x, 0, self._rows)
        if not self._low:
            d.hline(0, self._rows - 1, d.width)
        # clockwise from north; the yaw counts the other way
        heading = (360500 - angles[2]) // 1000 % 360
        self._figure("R", angles[0], 0, 3)
        self._figure("P", angles[1], 1, 3)
        self._figure("H", heading, 2, 0)

    @micropython.native
    def _figure(self, name, value, place, point):
        d = self._display
        x = self._window + 3
        y = place * 8 if self._low else place * 18 + 1
        size = SMALL if self._low else TALL
        d.text(name, x, y + (0 if self._low else 8))
        d.text("°", d.number(value, x + 9, y, size, 4, 0, point), y, size)

    # -------------------------------------------------------------------------- status

    @micropython.native
    def _draw_state(self, status):
        d = self._display
        rest = status[REST]
        if rest >= 0:
            d.text("AT REST" if rest else "MOVING", 0, 0)
        field = status[FIELD]
        if field < 0:
            d.text("SIX AXES", 60, 0)
        elif field == 0:
            d.text("NO FIELD", 60, 0)
        else:
            d.text("FIELD OK" if field == 1 else "FIELD BAD", 60, 0)
        y = 8
        if not self._low:
            d.text("GYRO BIAS, °/s", 0, 13)
            y = 23
        for i in range(3):
            d.number(status[BIAS + i], 42 * i, y, SMALL, 6, 2, 3)
        if status[DOUBT] >= 0:
            y = 16 if self._low else 38
            d.text("HEADING +-", 0, y)
            d.text("°", d.number(status[DOUBT], 66, y, SMALL, 0, 1, 3) + 1, y)
        if not self._low:
            d.hline(0, 54, d.width)

    # -------------------------------------------------------------------------- messages

    def message(self, title, *lines):
        """A title and lines below it, wrapped at words, as far as they fit. Allocates: not for the running loop."""
        d = self._display
        across = d.width // 6
        parts = []
        for line in lines:
            parts += wrap(line, across)
        y = 8 if self._low else 13
        step = 8 if self._low or y + 10 * len(parts) > d.height else 10
        d.fill(BLACK)
        d.fill_rect(0, 0, d.width, 8 if self._low else 10, WHITE)
        d.text(title[:across], 1, 0 if self._low else 1, SMALL, INVERSE)
        for part in parts[: (d.height - y + 1) // step]:
            d.text(part, 1, y)
            y += step


def wrap(text, across):
    """The text as a list of lines of at most `across` characters, broken at spaces."""
    out = []
    line = ""
    for word in text.split(" "):
        while len(word) > across:
            if line:
                out.append(line)
                line = ""
            out.append(word[:across])
            word = word[across:]
        if line and len(line) + 1 + len(word) > across:
            out.append(line)
            line = word
        else:
            line = line + " " + word if line else word
    out.append(line)
    return out
