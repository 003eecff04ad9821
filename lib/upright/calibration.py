# Calibration of counts: offset, matrix and axis map for every sample, and the file that keeps them.
# Needs fixmath.py, the viper emitter, json, binascii.crc32 and os. apply() may run in a hard interrupt: it allocates
# nothing, raises nothing and uses no float. docs/calibration.md has the formula and the file's format.
#
# All set-up is in integers, so that a board with single-precision floats gets the same bits.

import json
import os
from array import array
from binascii import crc32

import micropython
from micropython import const

from upright.fixmath import ratio

FORMAT = "upright-calibration"
VERSION = 1

_NEW = ".new"  # suffix of a file until it is complete
_ENOENT = const(2)
_EEXIST = const(17)
_SIZE_MAX = const(2048)  # bytes; a real one has about 400

# Bounds of what a file may hold. With them no intermediate of apply() reaches 2**31: an offset is at
# most 20000 counts (0.5 g at 32767 LSB/g is less), so |M raw| <= 2 * 32768 and |M offset| <= 2 * 20000
# counts, Q14: 1.73e9 with all rounding.
# udeg/s; more than the zero-rate output of any part (PS 6.1: 20 deg/s)
_BIAS_MOST = const(60000000)
_ACCEL_OFFSET_MOST = const(500000)  # ug
_MAG_OFFSET_MOST = const(20000000)  # 1/1000 count
_ROW_MOST = const(2000000)  # ppm: sum of the magnitudes in a row of a matrix
# ppm: with a smaller determinant the matrix would amplify noise
_DET_LEAST = const(50000)

_UNIT = (1000000, 0, 0, 0, 1000000, 0, 0, 0, 1000000)
_ROWS = ((1000000, 0, 0), (0, 1000000, 0), (0, 0, 1000000))
_UP_LEAST = const(707107)  # cos 45 deg: the tilt of a trim
_OPTIONAL = ("up_ppm",)  # fields that a file may leave out
_ZERO = (0, 0, 0)

# the words of apply()
_PROBE = const(0)  # always -1: ptr32 zero-extends where a word is 64 bits, see fixmath.py
# accelerometer, gyro, magnetometer: 3 rows of a matrix with axis map and trim, 3 words Q14; constant, Q14, 8192 for
# rounding
_M = const(1)
_GYRO = const(37)  # 3 times the word of body x, y, z, and 1 if its sign is turned
# 3 with a trim, which needs the gyro's matrix; else 6: the gyro's words are only reordered
_STRIDE = const(43)
_WORDS = const(44)


class CalibrationError(ValueError):
    """A calibration that cannot be used.

    kind   "missing": no such file; "corrupt": not a whole file, or a value that cannot be right;
           "foreign": another format or version, or made for another chip or board
    title  a short form for a small display, at most 16 characters

    The message names the file, what was expected and what was found.
    """

    _TITLES = {
        "missing": "No calibration",
        "corrupt": "Bad calibration",
        "foreign": "Not this board's",
    }

    def __init__(self, kind, text):
        super().__init__(text)
        self.kind = kind
        self.title = self._TITLES[kind]


class Calibration:
    """Turns a driver's counts, in the chip's frames, into calibrated counts in the body frame.

        counts = axis map (matrix (raw - offset)), rounded, saturated at int16

    for the accelerometer and the magnetometer. The gyro gets its axis map only: its bias goes into the filter, which
    takes it in 1/256 count, see gyro_bias(). The trim of a tilted mounting turns the body frame of all three, see
    set_level().

    imu_axes         body x, y, z (forward, left, up) as axes of the IMU: "x", "-y", ...
    mag_axes         the same for the magnetometer; it may mirror, because some magnetometers have a left-handed frame
    accel_lsb_per_g  int, 64..32767
    gyro_scale       (num, den): LSB per deg/s

    counts    array('h') of 11 words ax ay az gx gy gz mx my mz temp flags: what the filter gets
    identity  True if apply() would only copy
    fields    the contents of its file, see check()

    A new object has no corrections: only the axis maps are applied until load() or set(). Raises ValueError for axes
    that are not three different ones, an IMU map that mirrors, and scales out of range.
    """

    def __init__(
        self,
        imu_axes=("x", "y", "z"),
        mag_axes=("x", "y", "z"),
        accel_lsb_per_g=4096,
        gyro_scale=(82, 5),
    ):
        self._imu_axes, mirrors = _axes(imu_axes, "imu_axes")
        if mirrors:
            raise ValueError(
                "imu_axes %r mirror: turn one sign, or exchange two axes" % (tuple(imu_axes),)
            )
        self._mag_axes, _ = _axes(mag_axes, "mag_axes")
        if not is_int(accel_lsb_per_g, 64, 32767):
            raise ValueError(
                "accel_lsb_per_g is %r, expected an int, 64..32767" % (accel_lsb_per_g,)
            )
        num, den = gyro_scale
        if not is_int(num, 1, 1 << 20) or not is_int(den, 1, 1 << 20):
            raise ValueError("gyro_scale is %r, expected (num, den) LSB per deg/s" % (gyro_scale,))
        self.accel_lsb_per_g = accel_lsb_per_g
        self.gyro_scale = (num, den)
        self.counts = array("h", [0] * 11)
        self._s = array("i", [0] * _WORDS)
        self._use(blank())

    # -- tick
    @micropython.viper
    def apply(self, raw):
        """Calibrate one sample, array('h') of 11 words in the chips' frames, into counts.

        Flags (word 10) and temperature are copied. Accelerometer and gyro are calibrated if bit 0 of the flags is set,
        the magnetometer if bit 1 is set. Other words keep their values.
        """
        r = ptr16(raw)
        out = ptr16(self.counts)
        s = ptr32(self._s)
        k = 0
        if s[_PROBE] > 0:
            k = 32
        flags = r[10]
        stride = s[_STRIDE]
        at = 0  # the accelerometer's words, the gyro's with a trim, the magnetometer's
        while at < 9:
            bit = 1
            if at == 6:
                bit = 2
            if flags & bit:
                x = ((r[at] & 0xFFFF) ^ 0x8000) - 0x8000
                y = ((r[at + 1] & 0xFFFF) ^ 0x8000) - 0x8000
                z = ((r[at + 2] & 0xFFFF) ^ 0x8000) - 0x8000
                m = _M + (at << 2)
                i = at
                while i < at + 3:
                    v = x * (s[m] << k >> k) + y * (s[m + 1] << k >> k)
                    v = (v + z * (s[m + 2] << k >> k) + (s[m + 3] << k >> k)) >> 14
                    if v > 32767:
                        v = 32767
                    elif v < 0 - 32768:
                        v = 0 - 32768
                    out[i] = v
                    m += 4
                    i += 1
            at += stride
        if flags & 1 and stride == 6:
            i = 0
            while i < 3:
                v = ((r[s[_GYRO + i]] & 0xFFFF) ^ 0x8000) - 0x8000
                if s[_GYRO + 3 + i]:
                    v = 0 - v
                    if v > 32767:
                        v = 32767
                out[3 + i] = v
                i += 1
        out[9] = r[9]
        out[10] = flags

    # -- set-up: allocates
    def load(self, path, chip=None, board=None):
        """Load the corrections from a file that was made for this chip and board (None: any).

        Raises CalibrationError; then only the axis maps are applied.
        """
        self._use(blank())
        self._use(read(path, chip, board))

    def set(self, fields):
        """Use corrections: a dict as in check(). Absent keys mean no correction.

        Raises CalibrationError; then only the axis maps are applied.
        """
        self._use(blank())
        whole = blank()
        whole.update(fields)
        check(whole)
        self._use(whole)

    def save(self, path, chip=None, board=None):
        """Write the corrections to a file, for this chip and board if they are given; see write()."""
        fields = dict(self.fields)
        if chip is not None:
            fields["chip"] = chip
        if board is not None:
            fields["board"] = board
        write(path, fields)
        self.fields = fields

    def gyro_bias(self):
        """The gyro's bias in the body frame, 3 ints in 1/256 count for a filter's set_bias, or None."""
        bias = self.fields["gyro_bias_udps"]
        if bias is None:
            return None
        num, den = self.gyro_scale
        body = [sign * bias[i] for i, sign in self._imu_axes]
        body = [_dot(row, body, 1000000) for row in self._trim]
        return tuple([ratio(b * 256 * num, 1000000 * den) for b in body])

    def save_gyro_bias(self, path, x, y, z, chip=None, board=None):
        """Store a new gyro bias, in 1/256 count in the body frame, in a file. The rest of the file stays.

        A missing file is created. Raises CalibrationError for a corrupt or foreign file and for a bias beyond 60 deg/s,
        OSError when it cannot be written. Then the file is unchanged.
        """
        num, den = self.gyro_scale
        bias = [0, 0, 0]
        for i in range(3):
            axis, sign = self._imu_axes[i]
            body = _dot([row[i] for row in self._trim], (x, y, z), 1000)  # 1/256000 count
            bias[axis] = sign * ratio(body * 1000 * den, 256 * num)
        _put(path, "gyro_bias_udps", bias, chip, board)
        self.fields["gyro_bias_udps"] = bias

    def set_level(self, up):
        """Trim: make the present position level.

        up: the direction of up in that position, 3 ints, 1e-6 of a unit vector, in the frame of the axis map without a
        trim. Raises CalibrationError beyond 45 degrees: change the axis map then.
        """
        fields = dict(self.fields)
        fields["up_ppm"] = list(up)
        check(fields)
        self._use(fields)

    def save_level(self, path, chip=None, board=None):
        """Store the trim in a file, like save_gyro_bias()."""
        _put(path, "up_ppm", self.fields["up_ppm"], chip, board)

    def _use(self, fields):
        """Fold scales, axis maps, trim and checked corrections into the words of apply()."""
        s = array("i", [0] * _WORDS)
        s[_PROBE] = -1
        up = fields.get("up_ppm")
        trim = _level(up) if up else _ROWS
        accel = fields["accel"] or {"offset_ug": _ZERO, "matrix_ppm": _UNIT}
        mag = fields["mag"] or {"offset_mlsb": _ZERO, "matrix_ppm": _UNIT}
        lsb = self.accel_lsb_per_g
        _fold(s, _M, trim, self._imu_axes, accel["matrix_ppm"], accel["offset_ug"], lsb, 1000000)
        _fold(s, _M + 12, trim, self._imu_axes, _UNIT, _ZERO, 1, 1)
        _fold(s, _M + 24, trim, self._mag_axes, mag["matrix_ppm"], mag["offset_mlsb"], 1, 1000)
        same = not up
        s[_STRIDE] = 3 if up else 6
        for i in range(3):
            axis, sign = self._imu_axes[i]
            s[_GYRO + i] = 3 + axis
            s[_GYRO + 3 + i] = 1 if sign < 0 else 0
            same = same and axis == i and sign > 0
        for at in (_M, _M + 24):
            for i in range(12):
                same = same and s[at + i] == (8192 if i & 3 == 3 else 16384 if i % 5 == 0 else 0)
        self.identity = same
        self.fields = fields
        self._trim = trim
        for i in range(_WORDS):
            self._s[i] = s[i]


# ------------------------------------------------------------------------------------------ the file
def blank(chip=None, board=None):
    """The fields of a calibration without corrections."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "chip": chip,
        "board": board,
        "gyro_bias_udps": None,
        "accel": None,
        "mag": None,
    }


def check(fields, where="calibration"):
    """Raise CalibrationError unless `fields` is a dict of a calibration, without its checksum:

    format, version  FORMAT and VERSION
    chip, board      names, or None for any
    gyro_bias_udps   3 ints, 1e-6 deg/s, each within +-60 deg/s; or None
    accel            {"offset_ug": 3 ints, 1e-6 g, within +-0.5 g; "matrix_ppm": 9 ints, row by row};
                     or None
    mag              {"offset_mlsb": 3 ints, 1/1000 count, within +-20000 counts; "matrix_ppm"}; or None
    up_ppm           the trim, absent without one: 3 ints, 1e-6, the unit vector that points up when the
                     body is level, within 45 degrees of z, in the frame of the axis map

    All but up_ppm are in the chip's own frame. The magnitudes in a row of a matrix add up to 2 at most, and its
    determinant is 0.05 or more.
    """
    _check_shape(fields, where)
    _check_bounds(fields, where)


def read(path, chip=None, board=None):
    """Read the fields of a calibration file that was made for this chip and board (None: any).

    If the power failed while the file was replaced, this reads the new file under its temporary name.
    Raises CalibrationError.
    """
    try:
        data = _contents(path)
    except OSError as why:
        if why.errno != _ENOENT:
            raise CalibrationError("corrupt", "%s cannot be read: %s" % (path, why))
        fields = _interrupted(path)
        if fields is None:
            raise CalibrationError("missing", "%s: there is no such file" % path)
    else:
        fields = _parse(path, data)
    for key, wanted in (("chip", chip), ("board", board)):
        found = fields[key]
        if wanted is not None and found is not None and found != wanted:
            raise CalibrationError(
                "foreign", "%s was made for the %s %s, this is %s" % (path, key, found, wanted)
            )
    return fields


def write(path, fields):
    """Write the fields as a calibration file, replacing one that is there.

    After a power failure read() finds the old file or the new one. Raises CalibrationError for fields that read()
    would refuse, OSError when the file cannot be written.
    """
    check(fields)
    body = _text(fields)
    # An interrupted replacement has left only the new file: it must not be overwritten
    if not _exists(path) and _interrupted(path) is not None:
        os.rename(path + _NEW, path)
    with open(path + _NEW, "wb") as file:
        file.write(body)
        file.write(b' "checksum": "%08x"\n}\n' % crc32(body))
        file.flush()
        if hasattr(os, "fsync"):
            os.fsync(file.fileno())
    if hasattr(os, "sync"):
        os.sync()
    try:
        os.rename(path + _NEW, path)
    except OSError as why:
        if why.errno != _EEXIST:
            raise
        os.remove(path)  # a file system, like FAT, that cannot replace a file
        os.rename(path + _NEW, path)


def _put(path, name, value, chip, board):
    """Write one field of a file; the rest stays. A missing file is created."""
    try:
        fields = read(path, chip, board)
    except CalibrationError as why:
        if why.kind != "missing":
            raise
        fields = blank(chip, board)
    fields[name] = value
    write(path, fields)


def _exists(path):
    try:
        os.stat(path)
        return True
    except OSError:
        return False


def _contents(path):
    # piece by piece: a small heap may not have _SIZE_MAX in one
    data = b""
    with open(path, "rb") as file:
        while len(data) <= _SIZE_MAX:
            piece = file.read(256)
            if not piece:
                break
            data += piece
    return data


def _interrupted(path):
    """The fields of a complete file that still has its temporary name, or None."""
    try:
        return _parse(path + _NEW, _contents(path + _NEW))
    except (OSError, CalibrationError):
        return None


def _parse(path, data):
    if len(data) > _SIZE_MAX:
        raise CalibrationError("corrupt", "%s has more than %d bytes" % (path, _SIZE_MAX))
    try:
        fields = json.loads(data.decode())
    except (ValueError, RuntimeError):  # RuntimeError: nested too deeply
        raise CalibrationError("corrupt", "%s is not JSON: empty, cut off or overwritten" % path)
    if not isinstance(fields, dict) or fields.get("format") != FORMAT:
        raise CalibrationError("foreign", "%s is not of the format %s" % (path, FORMAT))
    if fields.get("version") != VERSION:
        raise CalibrationError(
            "foreign",
            "%s has the version %r, expected %d" % (path, fields.get("version"), VERSION),
        )
    found = fields.pop("checksum", None)
    _check_shape(fields, path)
    try:
        body = _text(fields)
    except ValueError:  # a name with half of a surrogate pair, which a host does not encode
        raise CalibrationError("corrupt", "%s: chip or board is no text" % path)
    wanted = "%08x" % crc32(body)
    if found != wanted:
        raise CalibrationError(
            "corrupt", "%s: checksum is %s, its contents give %s" % (path, found, wanted)
        )
    _check_bounds(fields, path)
    return fields


def _text(fields):
    """The file up to its checksum, as bytes: what the checksum covers, in one order on every port."""
    lines = ["{"]
    lines.append(' "format": "%s",' % FORMAT)
    lines.append(' "version": %d,' % VERSION)
    for key in ("chip", "board"):
        lines.append(' "%s": %s,' % (key, "null" if fields[key] is None else '"%s"' % fields[key]))
    lines.append(' "gyro_bias_udps": %s,' % _numbers(fields["gyro_bias_udps"]))
    for key, offset in (("accel", "offset_ug"), ("mag", "offset_mlsb")):
        part = fields[key]
        text = "null"
        if part is not None:
            text = '{"%s": %s, "matrix_ppm": %s}' % (
                offset,
                _numbers(part[offset]),
                _numbers(part["matrix_ppm"]),
            )
        lines.append(' "%s": %s,' % (key, text))
    if "up_ppm" in fields:
        lines.append(' "up_ppm": %s,' % _numbers(fields["up_ppm"]))
    lines.append("")
    return "\n".join(lines).encode()


def _numbers(values):
    return "null" if values is None else "[" + ", ".join(["%d" % v for v in values]) + "]"


# ------------------------------------------------------------------------------------------ checks
def _check_shape(fields, where):
    if not isinstance(fields, dict):
        raise CalibrationError("corrupt", "%s is not a dict" % where)
    if fields.get("format") != FORMAT or fields.get("version") != VERSION:
        raise CalibrationError("foreign", "%s is not %s %d" % (where, FORMAT, VERSION))
    _check_keys(fields, blank(), where, _OPTIONAL)
    for key in ("chip", "board"):
        name = fields[key]
        if name is not None and not _is_name(name):
            _wrong(where, key, name, "a name or null")
    bias = fields["gyro_bias_udps"]
    if bias is not None:
        _check_numbers(bias, 3, where, "gyro_bias_udps")
    if "up_ppm" in fields:
        _check_numbers(fields["up_ppm"], 3, where, "up_ppm")
    for key, offset in (("accel", "offset_ug"), ("mag", "offset_mlsb")):
        part = fields[key]
        if part is not None:
            if not isinstance(part, dict):
                _wrong(where, key, part, "an object or null")
            _check_keys(part, (offset, "matrix_ppm"), "%s: %s" % (where, key))
            _check_numbers(part[offset], 3, where, "%s.%s" % (key, offset))
            _check_numbers(part["matrix_ppm"], 9, where, "%s.matrix_ppm" % key)


def _check_bounds(fields, where):
    if fields["gyro_bias_udps"] is not None:
        _check_most(fields["gyro_bias_udps"], _BIAS_MOST, where, "gyro_bias_udps")
    if fields["accel"] is not None:
        offset, matrix = fields["accel"]["offset_ug"], fields["accel"]["matrix_ppm"]
        _check_most(offset, _ACCEL_OFFSET_MOST, where, "accel.offset_ug")
        _check_matrix(matrix, where, "accel.matrix_ppm")
    if fields["mag"] is not None:
        offset, matrix = fields["mag"]["offset_mlsb"], fields["mag"]["matrix_ppm"]
        _check_most(offset, _MAG_OFFSET_MOST, where, "mag.offset_mlsb")
        _check_matrix(matrix, where, "mag.matrix_ppm")
    if "up_ppm" in fields:
        _check_level(fields, where)


def _check_keys(part, keys, where, more=()):
    for key in keys:
        if key not in part:
            raise CalibrationError("corrupt", "%s lacks %s" % (where, key))
    for key in part:
        if key not in keys and key not in more:
            raise CalibrationError("corrupt", "%s has an unknown field, %s" % (where, key))


def _check_numbers(values, n, where, name):
    if not isinstance(values, (list, tuple)) or len(values) != n:
        _wrong(where, name, values, "%d integers" % n)
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int):
            _wrong(where, name, values, "%d integers" % n)


def _check_most(values, most, where, name):
    for value in values:
        if not -most <= value <= most:
            _wrong(where, name, values, "each within +-%d" % most)


def _check_matrix(m, where, name):
    for i in (0, 3, 6):
        if abs(m[i]) + abs(m[i + 1]) + abs(m[i + 2]) > _ROW_MOST:
            _wrong(where, name, m, "rows whose magnitudes add up to %d at the most" % _ROW_MOST)
    det = m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6])
    det += m[2] * (m[3] * m[7] - m[4] * m[6])
    if det < _DET_LEAST * 1000000 * 1000000:
        _wrong(where, name, m, "a matrix that is neither singular nor mirrors")


def _check_level(fields, where):
    up = fields["up_ppm"]
    length = sum([u * u for u in up])
    if not 998 <= length // 1000000000 <= 1002 or up[2] < _UP_LEAST:
        _wrong(where, "up_ppm", up, "a unit vector within 45 deg of z; turn IMU_AXES instead")
    # a row of the trim has magnitudes of up to 1.71 in all: what it makes of a matrix keeps the bound of a row
    turned = max([sum([abs(x) for x in row]) for row in _level(up)])
    for key in ("accel", "mag"):
        m = _UNIT if fields[key] is None else fields[key]["matrix_ppm"]
        largest = max([sum([abs(x) for x in m[i : i + 3]]) for i in (0, 3, 6)])
        if turned * largest // 1000000 > _ROW_MOST:
            _wrong(where, "up_ppm", up, "less tilt with this %s.matrix_ppm" % key)


def _wrong(where, name, value, wanted):
    raise CalibrationError("corrupt", "%s: %s is %r, expected %s" % (where, name, value, wanted))


def _is_name(name):
    if not isinstance(name, str) or not 0 < len(name) <= 80:
        return False
    for character in name:
        if ord(character) < 32 or character in '"\\':
            return False
    return True


def is_int(value, low, high=1 << 30):
    """Is it an int, not a bool, from low to high?"""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


# ------------------------------------------------------------------------------------------ numbers
def _axes(axes, name):
    """([(index, sign), ...] of the body's axes, whether they mirror)."""
    found = []
    for axis in axes:
        text = axis[1:] if isinstance(axis, str) and axis[:1] in ("-", "+") else axis
        if text not in ("x", "y", "z"):
            raise ValueError('%s: %r is not "x", "-x", "y", "-y", "z" or "-z"' % (name, axis))
        found.append(("xyz".index(text), -1 if axis[0] == "-" else 1))
    if sorted([i for i, _ in found]) != [0, 1, 2]:
        raise ValueError("%s are %r, expected x, y and z once each" % (name, tuple(axes)))
    (i, a), (j, b), (_, c) = found
    even = (j - i) % 3 == 1
    return found, a * b * c != (1 if even else -1)


def _level(up):
    """The rows, in ppm, of the shortest turn that takes the unit vector `up` to z."""
    a, b, c = up
    d = 1000000 + c
    return (
        (1000000 - ratio(a * a, d), -ratio(a * b, d), -a),
        (-ratio(a * b, d), 1000000 - ratio(b * b, d), -b),
        (a, b, c),
    )


def _dot(row, vector, den):
    """row . vector / den, rounded."""
    return ratio(row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2], den)


def _fold(s, at, trim, axes, matrix_ppm, offset, num, den):
    """12 words at s[at]: for each body axis a row of the matrix in Q14, and -row . offset.

    offset * num / den are counts. The constant is computed with the rounded row, so a raw value near the offset is
    exact whatever the rounding.
    """
    for i in range(3):
        c = 0
        for j in range(3):
            column = [sign * matrix_ppm[3 * axis + j] for axis, sign in axes]
            m = ratio(_dot(trim[i], column, 1000000) * 16384, 1000000)
            s[at + 4 * i + j] = m
            c -= m * offset[j]
        s[at + 4 * i + 3] = ratio(c * num, den) + 8192
