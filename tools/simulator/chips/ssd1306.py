# Simulated SSD1306 and SH1106 display controllers with their panel: what the bus sends in, what a
# person would see out. Portable (CPython and MicroPython), knows no machine mock. Sections are of
# the SSD1306 datasheet, rev 1.1; for the SH1106 its datasheet, v2.3.

_PAGE, _HORIZONTAL, _VERTICAL = 2, 0, 1  # 20h, table 9-1

# Commands with parameters, and how many (table 9-1); all others are single bytes.
_COMMON = {0x81: 1, 0xA8: 1, 0xAD: 1, 0xD3: 1, 0xD5: 1, 0xD9: 1, 0xDA: 1, 0xDB: 1}
_SSD1306 = {0x20: 1, 0x21: 2, 0x22: 2, 0x26: 6, 0x27: 6, 0x29: 5, 0x2A: 5, 0xA3: 2, 0x8D: 1}


class SSD1306Chip:
    """An SSD1306 (or SH1106) and a panel of width x height pixels, as it is after power-up.

    address: 7-bit I2C address. sh1106: 132 columns, page addressing only. The panel's columns sit
    in the middle of the controller's (so a 128-column panel starts at column 2 of an SH1106), but
    those of 96x16 are the last 96 segments (u8g2, u8x8_d_ssd1306_96x16.c: column 0, and 32 when
    turned); what lies beyond is not seen. Panels wider than twice their height are wired
    sequentially, others alternating (10.1.18). Panels below 128 columns have no resistor for the
    brightness current (u8g2#1047, rust-embedded-community/ssd1306#141).

    What silicon would take wrongly, and what the datasheet forbids, is noted in `errors`, a list of
    str; nothing is forgiven. `ram` is the GDDRAM, a bytearray of 8 pages, by segment, not by column
    address. `data_bytes`, `command_bytes` and `transactions` count the traffic.
    """

    def __init__(self, address=0x3C, width=128, height=64, sh1106=False, spi_max_hz=None):
        self.address = address
        self.width = width
        self.height = height
        self.sh1106 = sh1106
        self.columns = 132 if sh1106 else 128
        # table 13-4: a clock cycle of at least 100 ns; SH1106: 500 ns over its whole supply range
        self.spi_max_hz = spi_max_hz or (2000000 if sh1106 else 10000000)
        spare = self.columns - width
        self.first_segment = spare if (width, height) == (96, 16) else spare // 2
        self.sequential = width > 2 * height
        self.int_level = 0
        self.dc = 0
        self.errors = []
        self.data_bytes = 0
        self.command_bytes = 0
        self.transactions = 0
        self.powered = True
        self._table = dict(_COMMON)
        if not sh1106:
            self._table.update(_SSD1306)
        self._skip = 0
        self._nacks = 0
        self._selected = False
        self._in_reset = False
        self._reset_at = 0
        self.power_up()

    # ---------------------------------------------------------------- power and reset

    def power_up(self):
        """Reset state, and a GDDRAM whose contents nobody may rely on."""
        self.ram = bytearray((i * 73 + (i >> 3) * 29 + 91) & 255 for i in range(8 * self.columns))
        self.reset()

    def reset(self):
        """8.5 and the reset values of table 9-1; the GDDRAM keeps its contents."""
        self.display_on = False
        self.contrast = 0x80 if self.sh1106 else 0x7F
        self.all_on = False
        self.inverse = False
        self.mode = _PAGE
        self.page = 0
        self.column = 0
        self.page_range = [0, 7]
        self.column_range = [0, self.columns - 1]
        self.start_line = 0
        self.remap = False
        self.com_reversed = False
        self.multiplex = 64
        self.offset = 0
        self.clock = 0x50 if self.sh1106 else 0x80
        self.precharge = 0x22
        self.com_pins = 0x12
        self.vcomh = 0x35 if self.sh1106 else 0x20
        # SSD1306 appendix: the pump is off; SH1106 (AD 8B): it comes on with the display
        self.pump = self.sh1106
        self.pump_running = False
        self.internal_uA = 0
        self.scrolling = False
        self._column_start = 0
        self._saved_column = None
        self._command = None
        self._arguments = []
        self._control = None
        self._expect_control = False
        self._last_control = 0
        self._reads_ram = self._dummy = False

    def vanish(self):
        """The power (or a wire) is cut: nothing answers, everything is forgotten."""
        self.powered = False
        self.display_on = False

    def come_back(self):
        """The power returns: the state after power-up."""
        self.powered = True
        self.power_up()

    def nack_next(self, n=1, after=0):
        """After `after` more I2C bytes (addresses count) the next n are refused and lost."""
        self._skip = after
        self._nacks = n

    def _nack(self):
        if not self._nacks:
            return False
        if self._skip:
            self._skip -= 1
            return False
        self._nacks -= 1
        return True

    def poll(self, now):
        """Nothing here changes of its own accord."""

    def next_event(self):
        return None

    def _wrong(self, text):
        self.errors.append(text)

    # ---------------------------------------------------------------- I2C (8.1.5)

    def i2c_start(self, read, now):
        if not self.powered or self._in_reset or self._nack():
            return False
        self.transactions += 1
        self._expect_control = not read
        self._reads_ram = read and self.sh1106 and self._last_control & 0x40 != 0
        self._dummy = True
        self._control = None
        return True

    def i2c_write(self, byte, now):
        if not self.powered or self._in_reset or self._nack():
            return False
        if self._expect_control:
            if byte & 0x3F:
                self._wrong("control byte 0x%02X: its low six bits must be 0" % byte)
            self._control = self._last_control = byte
            self._expect_control = False
            return True
        if self._control is None:
            self._wrong("byte 0x%02X outside a write" % byte)
            return False
        self._take(byte, self._control & 0x40)
        # 8.1.5.2: with Co = 1 another control byte follows each byte, with Co = 0 none until the
        # stop
        self._expect_control = bool(self._control & 0x80)
        return True

    def i2c_read(self, now):
        """The status: bit 6 is set while the display is off. An SSD1306's data cannot be read serially; an SH1106's
        can, after a control byte for data and a first byte that is none."""
        if not self.powered:
            return 0xFF
        if self._reads_ram:
            if self._dummy or self.column >= self.columns:
                self._dummy = False
                return 0
            self.column += 1
            segment = self.columns - self.column if self.remap else self.column - 1
            return self.ram[self.page * self.columns + segment]
        return 0 if self.display_on else 0x40

    def i2c_stop(self, now):
        self._control = None
        self._expect_control = False

    # ---------------------------------------------------------------- SPI (8.1.3) and the reset pin

    def spi_select(self, selected, now):
        if selected and not self._selected:
            self.transactions += 1
        self._selected = bool(selected)

    def spi_transfer(self, byte, now, hz, mode):
        """D/C is sampled with the byte's last clock. Nothing drives the answer: it reads 0xFF."""
        if not self.powered or self._in_reset or not self._selected:
            return 0xFF
        if mode not in (0, 3):
            self._wrong("SPI mode %d: data are taken on the rising edge, modes 0 and 3" % mode)
            byte = byte << 1 & 255
        if hz > self.spi_max_hz:
            self._wrong("SPI at %d Hz: at most %d Hz" % (hz, self.spi_max_hz))
            byte ^= 0x24
        self._take(byte, self.dc)
        return 0xFF

    def reset_pin(self, level, now):
        """RES#: low resets; a pulse must last 3 us (8.9; SH1106: 10 us)."""
        if not level and not self._in_reset:
            self._in_reset = True
            self._reset_at = now
        elif level and self._in_reset:
            self._in_reset = False
            if now - self._reset_at < (10 if self.sh1106 else 3):
                self._wrong("reset pulse of %d us is too short" % (now - self._reset_at))
            else:
                self.reset()

    # ---------------------------------------------------------------- bytes that arrived

    def _take(self, byte, is_data):
        if not is_data:
            self.command_bytes += 1
            self._take_command(byte)
            return
        self.data_bytes += 1
        if self._command is not None:
            self._wrong("data inside command 0x%02X" % self._command)
            self._command = None
        self._take_data(byte)

    def _take_data(self, byte):
        if self.scrolling:
            self._wrong("data while scrolling: the RAM is undefined (10.2)")
        if self.column >= self.columns:
            self._wrong("data beyond column %d" % (self.columns - 1))
            return
        # 10.1.8: the remap acts when data are written, what is in the RAM stays where it is
        segment = self.columns - 1 - self.column if self.remap else self.column
        self.ram[self.page * self.columns + segment] = byte
        if self.mode == _PAGE:
            self.column += 1
            if self.column == self.columns and not self.sh1106:
                self.column = self._column_start  # 10.1.3; the SH1106's counter stops instead
        elif self.mode == _HORIZONTAL:
            if self._next_column():
                self._next_page()
        elif self._next_page():
            self._next_column()

    def _next_column(self):
        if self.column == self.column_range[1]:
            self.column = self.column_range[0]
            return True
        self.column = (self.column + 1) % self.columns
        return False

    def _next_page(self):
        if self.page == self.page_range[1]:
            self.page = self.page_range[0]
            return True
        self.page = (self.page + 1) & 7
        return False

    def _take_command(self, byte):
        if self._command is None:
            if byte in self._table:
                self._command = byte
                self._arguments = []
            elif not self._single(byte):
                self._wrong("unknown command 0x%02X" % byte)
            return
        self._arguments.append(byte)
        if len(self._arguments) == self._table[self._command]:
            command = self._command
            self._command = None
            if not self._several(command, self._arguments):
                text = " ".join("%02X" % a for a in self._arguments)
                self._wrong("command %02X %s: invalid value" % (command, text))

    def _single(self, byte):
        if byte < 0x20:  # 10.1.1, 10.1.2
            if self.mode != _PAGE:
                self._wrong("command 0x%02X is for page addressing only" % byte)
            if byte < 0x10:
                self.column = self.column & 0xF0 | byte
            else:
                self.column = self.column & 0x0F | (byte & 15) << 4
            self._column_start = self.column
        elif 0x40 <= byte < 0x80:
            self.start_line = byte & 63
        elif byte in (0xA0, 0xA1):
            self.remap = byte == 0xA1
        elif byte in (0xA4, 0xA5):
            self.all_on = byte == 0xA5
        elif byte in (0xA6, 0xA7):
            self.inverse = byte == 0xA7
        elif byte in (0xAE, 0xAF):
            self.display_on = byte == 0xAF
            # appendix: 8D 14 and then AF; a pump that is enabled later waits for the next AF
            self.pump_running = self.pump and self.display_on
        elif 0xB0 <= byte < 0xB8:
            if self.mode != _PAGE:
                self._wrong("command 0x%02X is for page addressing only" % byte)
            self.page = byte & 7
        elif byte in (0xC0, 0xC8):
            self.com_reversed = byte == 0xC8
        elif byte == 0xE3:
            pass
        elif self.sh1106:
            return self._single_sh1106(byte)
        elif byte == 0x2E:
            self.scrolling = False
        elif byte == 0x2F:
            self.scrolling = True
        else:
            return False
        return True

    def _single_sh1106(self, byte):
        if byte == 0xE0:  # read-modify-write: EE takes the column back to here
            self._saved_column = self.column
        elif byte == 0xEE and self._saved_column is not None:
            self.column = self._saved_column
            self._saved_column = None
        elif not 0x30 <= byte <= 0x33:  # pump voltage
            return False
        return True

    def _several(self, command, arguments):
        """False when the datasheet calls the value invalid."""
        value = arguments[0]
        if command == 0x81:
            self.contrast = value
        elif command == 0xA8:  # 10.1.11: 15..63
            self.multiplex = (value & 63) + 1
            return self.multiplex >= 16
        elif command == 0xD3:
            self.offset = value & 63
        elif command == 0xD5:
            self.clock = value
        elif command == 0xD9:  # 10.1.17: both phases at least 1
            self.precharge = value
            return value & 15 != 0 and value >> 4 != 0
        elif command == 0xDA:
            self.com_pins = value
            return value & 0xCF == 0x02
        elif command == 0xDB:
            self.vcomh = value
            return self.sh1106 or value in (0x00, 0x20, 0x30)
        elif command == 0xAD and self.sh1106:  # pump: 8A off, 8B on, only while the display is off
            self.pump = value == 0x8B
            return value & 0xFE == 0x8A and not self.display_on
        elif command == 0xAD:  # SSD1306B, SSD1315: A[4] internal current, A[5] 30 uA, not 19
            self.internal_uA = (30 if value & 0x20 else 19) if value & 0x10 else 0
            return value & 0xCF == 0
        elif command == 0x8D:
            self.pump = value & 4 != 0
            if not self.pump:
                self.pump_running = False
            return value & 0x3B == 0x10
        elif command == 0x20:
            if value & 3 == 3:
                return False
            self.mode = value & 3
        elif command in (0x21, 0x22):
            return self._window(command, arguments)
        elif command in (0x26, 0x27, 0x29, 0x2A) and self.scrolling:
            return False  # 10.2.1: set up only while scrolling is off
        return True

    def _window(self, command, arguments):
        """10.1.4, 10.1.5: for horizontal and vertical addressing; moves the pointer too."""
        first, last = arguments
        top = 127 if command == 0x21 else 7
        if first > last or last > top or self.mode == _PAGE:
            return False
        if command == 0x21:
            self.column_range = [first, last]
            self.column = first
        else:
            self.page_range = [first, last]
            self.page = first
        return True

    # ---------------------------------------------------------------- what is seen

    @property
    def lit(self):
        """False: dark, whatever the RAM holds (no power, display off or no charge pump)."""
        return self.powered and self.display_on and self.pump_running

    @property
    def dim(self):
        """A small panel without the internal current has a third of its brightness, with 19 uA two thirds."""
        return self.width < 128 and not self.sh1106 and self.internal_uA < 30

    def _ram_line(self, y):
        """RAM line shown in row y of the upright panel; None: this row is not driven."""
        glass = self.height - 1 - y  # modules are mounted so that A1 C8 is upright
        # which common pin is this row of the glass wired to, and which output drives that pin?
        pin = glass if self.sequential else (glass >> 1) + 32 * (glass & 1)
        if self.com_pins & 0x20:
            pin ^= 32
        output = ((pin & 31) << 1 | pin >> 5) if self.com_pins & 0x10 else pin
        # tables 10-1, 10-2
        if self.com_reversed:
            output = self.multiplex - 1 - output
        row = (output + self.offset) & 63
        if row >= self.multiplex:
            return None
        return (row + self.start_line) & 63

    def frame(self):
        """What is seen, upright, in the format of the writer's buffer: page-major, LSB on top."""
        width = self.width
        out = bytearray(width * ((self.height + 7) >> 3))
        if not self.lit:
            return out
        flip = 1 if self.inverse else 0
        for y in range(self.height):
            line = self._ram_line(y)
            if line is None:
                continue
            at = (line >> 3) * self.columns + self.first_segment + width - 1
            o = (y >> 3) * width
            bit = 1 << (y & 7)
            shift = line & 7
            for x in range(width):
                if self.all_on or (self.ram[at - x] >> shift & 1) ^ flip:
                    out[o + x] |= bit
        return out

    def picture(self):
        """What is seen: rows from the top, each a bytearray of 0 and 1; all 0 when not lit."""
        frame = self.frame()
        rows = []
        for y in range(self.height):
            row = bytearray(self.width)
            o = (y >> 3) * self.width
            for x in range(self.width):
                row[x] = frame[o + x] >> (y & 7) & 1
            rows.append(row)
        return rows


class SH1106Chip(SSD1306Chip):
    """The same with sh1106=True."""

    def __init__(self, address=0x3C, width=128, height=64, spi_max_hz=None):
        super().__init__(address, width, height, True, spi_max_hz)
