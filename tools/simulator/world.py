# The moving world that a simulated IMU samples: rows of sensor counts out of an `.imu` file, with
# their own clock. Needs only the standard modules array and json. Runs on CPython and MicroPython.

import json
from array import array

FORMAT = "upright-imu"
VERSION = 1
WORDS = 11  # ax ay az gx gy gz mx my mz temp flags
ROW_BYTES = 2 * WORDS
TRUTH_BYTES = 16
_HEADER_MAX = 1024  # bytes, the newline included


class _Clock:
    """Rows at a rate of num/den Hz, counted from a start that may come later.

    All times are whole microseconds. Until `start` has been called the world stands still at row 0.
    """

    def __init__(self, rate, n):
        num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
        if num <= 0 or den <= 0:
            raise _error("a rate of", num, "/", den, "Hz is not positive")
        self.rate = (num, den)
        self.n = n
        self.start_us = None
        # microseconds per row as the reduced ratio _us/_rows: products stay small ints for longer
        a, b = 1000000 * den, num
        while b:
            a, b = b, a % b
        self._us = 1000000 * den // a
        self._rows = num // a

    def time_us(self, k):
        """Microseconds after the start at which row k exists, rounded down."""
        return k * self._us // self._rows

    def index(self, us):
        """The newest row that exists `us` microseconds after the start, clamped to 0..n-1.

        index(time_us(k)) == k for every row, and index(time_us(k) - 1) == k - 1.
        """
        if us < 0:
            return 0
        # time_us rounds down, so row k is there when k*_us < (us + 1)*_rows
        k = ((us + 1) * self._rows - 1) // self._us
        return k if k < self.n else self.n - 1

    def start(self, now):
        """Row 0 exists at `now` (absolute microseconds); the rows follow from there."""
        self.start_us = now

    def index_at(self, now):
        """The newest row at the absolute time `now`; 0 until the world has been started."""
        return 0 if self.start_us is None else self.index(now - self.start_us)

    def ended(self, now):
        """True once the last row's own period is over at the absolute time `now`."""
        return self.start_us is not None and now - self.start_us >= self.time_us(self.n)


class World(_Clock):
    """A motion or a recorded trial replayed from an `.imu` file.

    The file is one line of JSON (see `header_line`), a newline, then `rows` rows of eleven
    little-endian int16 in the order ax ay az gx gy gz mx my mz temp flags; then, where the header has
    `truth_every`, the true attitude at every so many-th row from the first on: little-endian int32,
    w x y z, Q30, sensor to earth (x north, y west, z up), all 0 where it is not known. The runtimes
    are all little-endian and read it as it lies.

    rate              (num, den): rows per second
    n                 number of rows
    clocked           True: a recorded trial whose row k is the chip's sample k;
                      False: the chip samples at its own times
    accel_lsb_per_g   int
    gyro_scale        (num, den) LSB per deg/s
    name              of the motion or trial
    start_us          absolute microseconds of row 0, None until `start`

    Raises OSError when the file cannot be opened, ValueError when it is not a whole `.imu` file of
    this version.
    """

    def __init__(self, path):
        self._file = open(path, "rb")
        try:
            header, self._base = _read_header(self._file, path)
        except ValueError:
            self._file.close()
            raise
        _Clock.__init__(self, tuple(header["rate"]), header["rows"])
        self.clocked = header["clocked"]
        self.accel_lsb_per_g = header["accel_lsb_per_g"]
        self.gyro_scale = tuple(header["gyro_scale"])
        self.name = header["name"]
        self._truth_every = header.get("truth_every", 0)
        self._truth = array("i", bytes(TRUTH_BYTES))
        self._row = array("h", bytes(ROW_BYTES))
        self._at = -1  # the row that _row holds
        self._next = -1  # the row at which the file stands

    def row(self, k):
        """Row k, clamped to 0..n-1: the same array('h') of 11 words, valid until the next call.

        Allocates nothing. Rows read in order cost no seek; reading ahead is left to the file object
        (CPython) or the system underneath, which is as quick as a cache of blocks in here would be.
        """
        if k >= self.n:
            k = self.n - 1
        if k < 0:
            k = 0
        if k != self._at:
            if k != self._next:
                self._file.seek(self._base + k * ROW_BYTES)
            self._at = self._next = -1  # nothing is known if the read fails
            if self._file.readinto(self._row) != ROW_BYTES:
                raise OSError(5)  # EIO: the file has been cut since it was opened
            self._at = k
            self._next = k + 1
        return self._row

    def truth(self, k):
        """The newest known attitude at row k: an array('i') of w x y z in Q30, valid until the next call; or None."""
        every = self._truth_every
        if not every:
            return None
        k = min(max(k, 0), self.n - 1) // every
        self._next = -1
        self._file.seek(self._base + self.n * ROW_BYTES + k * TRUTH_BYTES)
        if self._file.readinto(self._truth) != TRUTH_BYTES:
            raise OSError(5)
        return self._truth if any(self._truth) else None

    def load(self, k, out):
        """Copy row k into out[0..10], the caller's own array('h')."""
        row = self.row(k)
        for i in range(WORDS):
            out[i] = row[i]

    def close(self):
        self._file.close()


class StillWorld(_Clock):
    """One constant row for ever, without a file: for tests, and for a board that lies on the table.

    counts: up to 11 ints in the counts order, the missing ones are 0; by default level and at rest
    at +-8 g. The other arguments are World's attributes.
    """

    def __init__(
        self,
        counts=(0, 0, 4096),
        rate=(200, 1),
        accel_lsb_per_g=4096,
        gyro_scale=(82, 5),
        clocked=False,
        n=1,
    ):
        _Clock.__init__(self, rate, n)
        self.clocked = clocked
        self.accel_lsb_per_g = accel_lsb_per_g
        self.gyro_scale = gyro_scale
        self.name = "still"
        self._row = array("h", bytes(ROW_BYTES))
        self.set(counts)

    def set(self, counts):
        """Change the row from now on."""
        for i in range(WORDS):
            self._row[i] = counts[i] if i < len(counts) else 0

    def row(self, k):
        return self._row

    def load(self, k, out):
        for i in range(WORDS):
            out[i] = self._row[i]

    def ended(self, now):
        return False

    def close(self):
        pass


# level and at rest at +-8 g, heading north in a field of 49 uT that dips by 60 degrees into the ground; 25 degC
LEVEL = (0, 0, 4096, 0, 0, 0, 82, 0, -141, -3920)
# Parts of the sum of four random bytes (its standard deviation is 148) that are a sensor's noise: 4 mg and 0.05 deg/s
# rms (PS-MPU-6000A 6.1, 6.2, at about 100 Hz), and one count of the magnetometer
_NOISE = (9, 9, 9, 180, 180, 180, 140, 140, 140)


class NoisyWorld(StillWorld):
    """A board at rest and level whose samples have a sensor's noise; the same noise each time."""

    def __init__(self):
        StillWorld.__init__(self, LEVEL, rate=(1000, 1), n=1 << 30)
        self._at = -1

    def row(self, k):
        if k != self._at:
            self._at = k
            x = (k + 1) * 0x9E3779B1 & 0xFFFFFFFF
            for i in range(9):
                x ^= x << 13 & 0xFFFFFFFF  # Marsaglia's xorshift
                x ^= x >> 17
                x ^= x << 5 & 0xFFFFFFFF
                noise = (x & 255) + (x >> 8 & 255) + (x >> 16 & 255) + (x >> 24) - 510
                self._row[i] = LEVEL[i] + (noise + _NOISE[i] // 2) // _NOISE[i]
        return self._row

    def load(self, k, out):
        self.row(k)
        StillWorld.load(self, k, out)


def header_line(name, rate, rows, accel_lsb_per_g, gyro_scale, clocked, truth_every=0):
    """The first line of an `.imu` file as bytes, newline included. ValueError when too long."""
    fields = {
        "format": FORMAT,
        "version": VERSION,
        "name": name,
        "rate": [int(v) for v in rate],
        "rows": int(rows),
        "accel_lsb_per_g": int(accel_lsb_per_g),
        "gyro_scale": [int(v) for v in gyro_scale],
        "clocked": bool(clocked),
    }
    if truth_every:
        fields["truth_every"] = int(truth_every)
    line = json.dumps(fields).encode() + b"\n"
    if len(line) > _HEADER_MAX:
        raise _error("an .imu header of", len(line), "bytes; at most", _HEADER_MAX, "fit")
    return line


def write_imu(
    path, data, name, rate, accel_lsb_per_g, gyro_scale, clocked, truth=b"", truth_every=0
):
    """Write an `.imu` file. data: bytes, 22 a row, little-endian int16 in the counts order.

    truth: bytes, 16 for every truth_every-th row from the first on, little-endian int32, w x y z in
    Q30; all 0 where it is not known. Raises ValueError when data are not whole rows or there is none,
    and for a truth of another length; OSError as `open` does.
    """
    rows = len(data) // ROW_BYTES
    if rows < 1 or len(data) != rows * ROW_BYTES:
        raise _error(len(data), "bytes are not whole rows of", ROW_BYTES, "bytes")
    if len(truth) != _truth_bytes(rows, truth_every):
        raise _error(len(truth), "bytes of truth for", rows, "rows, every", truth_every)
    line = header_line(name, rate, rows, accel_lsb_per_g, gyro_scale, clocked, truth_every)
    with open(path, "wb") as out:
        out.write(line)
        out.write(data)
        out.write(truth)


def _truth_bytes(rows, every):
    return (rows + every - 1) // every * TRUTH_BYTES if every else 0


def _error(*words):
    return ValueError(" ".join(str(word) for word in words))


def _read_header(file, path):
    """(fields, offset of row 0) of an open `.imu` file; ValueError: what was expected and found."""
    head = file.read(_HEADER_MAX)
    end = head.find(b"\n")
    fields = _parse(head[:end]) if end >= 0 else None
    if fields is None or fields.get("format") != FORMAT:
        wanted = "is not an .imu file: expected a first line of JSON with the format " + FORMAT
        raise _error(path, wanted + ", found", repr(head[:24]))
    if fields.get("version") != VERSION:
        raise _error(path, "has .imu version", fields.get("version"), "but expected is", VERSION)
    if not _complete(fields):
        raise _error(path, "lacks a field in its .imu header or has a wrong one:", fields)
    expected = end + 1 + fields["rows"] * ROW_BYTES
    expected += _truth_bytes(fields["rows"], fields.get("truth_every", 0))
    found = file.seek(0, 2)
    if found != expected:
        what = "is truncated" if found < expected else "is too long"
        rows = "bytes for its " + str(fields["rows"]) + " rows, found"
        raise _error(path, what + ": expected", expected, rows, found)
    return fields, end + 1


def _parse(line):
    """The dict that a line of JSON holds, or None."""
    try:
        fields = json.loads(line.decode())
    except (ValueError, RuntimeError):  # RuntimeError: nested too deeply
        return None
    return fields if isinstance(fields, dict) else None


def _complete(fields):
    for key in ("rate", "gyro_scale"):
        pair = fields.get(key)
        if not isinstance(pair, list) or len(pair) != 2:
            return False
        if not _positive(pair[0]) or not _positive(pair[1]):
            return False
    return (
        _positive(fields.get("rows"))
        and _positive(fields.get("accel_lsb_per_g"))
        and isinstance(fields.get("clocked"), bool)
        and isinstance(fields.get("name"), str)
        and _positive(fields.get("truth_every", 1))
    )


def _positive(value):
    return isinstance(value, int) and value > 0
