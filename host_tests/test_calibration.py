"""The calibration: right within a count, within 32 bits, the same everywhere; and its file: whole, or refused."""

import io
import itertools
import json
import math
import random
from array import array
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from zlib import crc32

import overflow
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from upright import calibration
from upright.calibration import Calibration, CalibrationError

SOURCE = Path(calibration.__file__)
UNIT = [1000000, 0, 0, 0, 1000000, 0, 0, 0, 1000000]
CORNERS = (-32768, 32767)


def sample(accel=(0, 0, 0), gyro=(0, 0, 0), mag=(0, 0, 0), temp=0, flags=3):
    return array("h", [*accel, *gyro, *mag, temp, flags])


def applied(c, **words):
    c.apply(sample(**words))
    return list(c.counts)


def accel(matrix=UNIT, offset=(0, 0, 0)):
    return {"offset_ug": list(offset), "matrix_ppm": list(matrix)}


def mag(matrix=UNIT, offset=(0, 0, 0)):
    return {"offset_mlsb": list(offset), "matrix_ppm": list(matrix)}


# ---------------------------------------------------------------------------------------- apply
def all_axes(right_handed=None):
    for order in itertools.permutations("xyz"):
        for signs in itertools.product((1, -1), repeat=3):
            swaps = sum(a > b for a, b in itertools.combinations(order, 2))
            hand = (-1) ** swaps * signs[0] * signs[1] * signs[2]
            if right_handed is None or (hand == 1) == right_handed:
                yield tuple(("-" if s < 0 else "") + a for a, s in zip(order, signs, strict=True))


def mapped(axes, words):
    """The axis map by hand, saturated."""
    got = [dict(zip("xyz", words, strict=True))[a[-1]] * (-1 if a[0] == "-" else 1) for a in axes]
    return [min(v, 32767) for v in got]


def test_a_pure_axis_map_is_exact_for_every_map_and_saturates():
    rows = [(1, -2, 3), (-32768, 32767, -32768), (12345, -20000, 0)]
    for axes in all_axes(right_handed=True):
        c = Calibration(axes, ("x", "z", "y"))
        for row in rows:
            got = applied(c, accel=row, gyro=row, mag=row, temp=-77)
            assert got[:3] == got[3:6] == mapped(axes, row)
            assert got[6:9] == [row[0], row[2], row[1]]
            assert got[9:] == [-77, 3]
    for axes in all_axes():
        c = Calibration(mag_axes=axes)
        for row in rows:
            assert applied(c, mag=row)[6:9] == mapped(axes, row)


@pytest.mark.parametrize("axes", list(all_axes(right_handed=False)))
def test_an_imu_map_that_mirrors_is_refused_a_magnetometers_is_not(axes):
    with pytest.raises(ValueError, match="mirror"):
        Calibration(axes)
    Calibration(mag_axes=axes)


@pytest.mark.parametrize(
    "arguments, said",
    [
        ((("x", "y", "y"),), "imu_axes are .* once each"),
        ((("x", "y"),), "once each"),
        ((("x", "y", "z", "x"),), "once each"),
        ((("x", "y", "w"),), "'w' is not"),
        ((("x", "y", ""),), "'' is not"),
        ((("x", "y", "--z"),), "'--z' is not"),
        ((("x", "y", 3),), "3 is not"),
        ((("x", "y", "z"), ("x", "x", "z")), "mag_axes are"),
        ((("x", "y", "z"), ("x", "y", "z"), 0), "accel_lsb_per_g is 0"),
        ((("x", "y", "z"), ("x", "y", "z"), 4096.0), "accel_lsb_per_g"),
        ((("x", "y", "z"), ("x", "y", "z"), 40000), "accel_lsb_per_g"),
        ((("x", "y", "z"), ("x", "y", "z"), 4096, (16.4, 1)), "gyro_scale"),
        ((("x", "y", "z"), ("x", "y", "z"), 4096, (0, 1)), "gyro_scale"),
    ],
)
def test_a_set_up_that_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        Calibration(*arguments)


def test_only_what_is_fresh_is_taken_over():
    c = Calibration(("y", "-x", "z"))
    first = applied(c, accel=(1, 2, 3), gyro=(4, 5, 6), mag=(7, 8, 9), temp=10, flags=3)
    assert first == [2, -1, 3, 5, -4, 6, 7, 8, 9, 10, 3]
    new = {"accel": (11, 12, 13), "gyro": (14, 15, 16), "mag": (17, 18, 19)}
    assert applied(c, **new, temp=20, flags=0) == [*first[:9], 20, 0]
    assert applied(c, **new, temp=21, flags=2) == [*first[:6], 17, 18, 19, 21, 2]
    assert applied(c, **new, temp=22, flags=13) == [12, -11, 13, 15, -14, 16, 17, 18, 19, 22, 13]


def test_identity_says_whether_anything_would_change():
    assert Calibration().identity
    assert not Calibration(("y", "-x", "z")).identity
    assert not Calibration(mag_axes=("x", "y", "-z")).identity
    c = Calibration()
    for fields, same in (
        ({"accel": accel(offset=(0, 0, 1000))}, False),
        ({"mag": mag([*UNIT[:8], 990000])}, False),
        ({"mag": mag(offset=(0, 1, 0))}, False),
        ({"gyro_bias_udps": [1, 2, 3]}, True),
        ({"mag": mag(), "accel": accel()}, True),
    ):
        c.set(fields)
        assert c.identity is same


def test_the_formula_by_hand():
    c = Calibration(("y", "-x", "z"), ("x", "y", "-z"), 16384)
    c.set(
        {
            "accel": accel([1010000, 0, 0, 0, 990000, 0, 0, 0, 1000000], (10000, -20000, 0)),
            "mag": mag([1000000, 100000, 0, 100000, 1000000, 0, 0, 0, 900000], (50300, 0, 10000)),
        }
    )
    got = applied(c, accel=(1000, 2000, 16384), mag=(150, 200, 110))
    assert got[0] == round((2000 + 327.68) * 0.99)
    assert got[1] == -round((1000 - 163.84) * 1.01)
    assert got[2] == 16384
    assert got[6:9] == [round(99.7 + 20), round(9.97 + 200), -90]


@st.composite
def matrices(draw):
    """Nine ppm that the file accepts: rows within 2, not singular, not mirrored."""
    near = draw(st.booleans())
    entry = st.integers(-90000, 90000) if near else st.integers(-600000, 600000)
    diagonal = st.integers(800000, 1200000) if near else st.integers(400000, 2000000)
    rows = [[draw(diagonal if i == j else entry) for j in range(3)] for i in range(3)]
    for row in rows:
        size = sum(map(abs, row))
        if size > 2000000:
            row[:] = [int(v * 2000000 / size) for v in row]
    flat = [v for row in rows for v in row]
    try:
        calibration._check_matrix(flat, "", "")
    except CalibrationError:
        return UNIT
    return flat


def triple(most):
    return st.tuples(*[st.one_of(st.integers(-most, most), st.sampled_from((-most, most)))] * 3)


WORDS = st.tuples(*[st.one_of(st.integers(-32768, 32767), st.sampled_from(CORNERS))] * 3)
SMALL = st.tuples(*[st.integers(-4000, 4000)] * 3)


def exact(matrix_ppm, offset, axes, raw):
    """Three Fractions: axis map (matrix (raw - offset))."""
    d = [r - o for r, o in zip(raw, offset, strict=True)]
    turned = [
        sum(Fraction(matrix_ppm[3 * i + j], 10**6) * d[j] for j in range(3)) for i in range(3)
    ]
    at = dict(zip("xyz", turned, strict=True))
    return [at[a[-1]] * (-1 if a[0] == "-" else 1) for a in axes], sum(map(abs, d))


def assert_near(got, wanted, most):
    for g, w in zip(got, wanted, strict=True):
        clipped = max(-32768, min(32767, w))
        assert abs(g - clipped) <= most


@settings(max_examples=200)
@given(
    matrix=matrices(),
    offset=triple(20000000),
    axes=st.sampled_from(list(all_axes())),
    raw=WORDS,
    small=SMALL,
)
def test_the_magnetometer_is_the_formula_rounded(matrix, offset, axes, raw, small):
    """Within a count; where the field is over 16000 counts a matrix in Q14 costs up to 5 counts more."""
    c = Calibration(mag_axes=axes)
    c.set({"mag": mag(matrix, offset)})
    counts = [Fraction(o, 1000) for o in offset]
    wanted, size = exact(matrix, counts, axes, raw)
    # half a count of rounding, the constant's own, and half a Q14 bit in each element of the matrix
    assert_near(
        applied(c, mag=raw)[6:9], wanted, Fraction(1, 2) + Fraction(1, 2**14) + size / 2**15
    )
    # a field of up to 4000 counts around the offset, as magnetometers have
    raw = [max(-32768, min(32767, round(o) + s)) for o, s in zip(counts, small, strict=True)]
    wanted, size = exact(matrix, counts, axes, raw)
    assert_near(applied(c, mag=raw)[6:9], wanted, 1)


@settings(max_examples=200)
@given(
    matrix=matrices(),
    offset=triple(500000),
    axes=st.sampled_from(list(all_axes(right_handed=True))),
    lsb=st.sampled_from((2048, 4096, 8192, 16384, 32767)),
    raw=WORDS,
)
def test_the_accelerometer_is_the_formula_rounded(matrix, offset, axes, lsb, raw):
    c = Calibration(axes, accel_lsb_per_g=lsb)
    c.set({"accel": accel(matrix, offset)})
    wanted, size = exact(matrix, [Fraction(o * lsb, 10**6) for o in offset], axes, raw)
    got = applied(c, accel=raw, gyro=raw)
    assert_near(got[:3], wanted, Fraction(1, 2) + Fraction(1, 2**14) + size / 2**15)
    assert got[3:6] == mapped(axes, raw)


# ---------------------------------------------------------------------------------------- 32 bits
def worst(rng):
    """A matrix with full rows of random signs, as the file accepts it."""
    while True:
        m = []
        for i in range(3):
            big = rng.choice((2000000, 1000002, 700000))
            rest = (2000000 - big) // 2
            row = [rng.choice((-1, 1)) * rest for _ in range(3)]
            row[i] = big
            m += row
        try:
            calibration._check_matrix(m, "", "")
            return m
        except CalibrationError:
            pass


def exercise(module, rng, n=300):
    for _ in range(n):
        axes = rng.choice(list(all_axes(right_handed=True)))
        c = module.Calibration(axes, rng.choice(list(all_axes())), rng.choice((64, 16384, 32767)))
        c.set(
            {
                "accel": accel(worst(rng), [rng.choice((-1, 1)) * 500000 for _ in range(3)]),
                "mag": mag(worst(rng), [rng.choice((-1, 1)) * 20000000 for _ in range(3)]),
            }
        )
        for corner in itertools.product(CORNERS, repeat=3):
            c.apply(sample(corner, corner, corner, rng.choice(CORNERS), rng.choice((0, 1, 2, 3))))


def test_nothing_leaves_32_bits_at_the_corners_of_what_is_accepted():
    watch = overflow.Watch()
    module = overflow.load("calibration_checked", SOURCE.read_text(), watch)
    exercise(module, random.Random(1))
    assert watch.missed() == []
    assert watch.functions == {"calibration_checked.apply"}
    assert max(site.used for site in watch.sites) > 0.7  # the bounds are not wasteful either


def test_without_its_bounds_it_would(monkeypatch):
    watch = overflow.Watch()
    module = overflow.load("calibration_checked", SOURCE.read_text(), watch)
    module._MAG_OFFSET_MOST = 40000000
    c = module.Calibration()
    c.set({"mag": mag([2000000, 0, 0, 0, 2000000, 0, 0, 0, 2000000], (40000000, 0, 0))})
    with pytest.raises(overflow.Overflow):
        c.apply(sample(mag=(-32768, 0, 0)))


def test_what_is_beyond_16_bits_is_their_last_number():
    c = Calibration()
    c.set({"mag": mag([2000000, 0, 0, 0, 2000000, 0, 0, 0, 2000000])})
    c.apply(sample(mag=(-32768, 32767, -16385)))
    assert list(c.counts[6:9]) == [-32768, 32767, -32768]


@pytest.mark.parametrize(("ppm", "taken"), [(51000, True), (49000, False)])
def test_a_matrix_may_flatten_an_axis_to_a_twentieth(ppm, taken):
    fields = {"accel": accel([1000000, 0, 0, 0, 1000000, 0, 0, 0, ppm])}
    if taken:
        Calibration().set(fields)
    else:
        with pytest.raises(calibration.CalibrationError, match="singular"):
            Calibration().set(fields)


# ---------------------------------------------------------------------------------------- gyro bias
@pytest.mark.parametrize("scale", [(131, 1), (131, 2), (164, 5), (82, 5)])
def test_the_bias_comes_in_256ths_of_a_count_in_the_bodys_frame(scale):
    c = Calibration(("-y", "x", "z"), gyro_scale=scale)
    assert c.gyro_bias() is None
    c.set({"gyro_bias_udps": [1500000, -2000000, 3]})
    lsb = scale[0] / scale[1]
    assert c.gyro_bias() == (round(2 * 256 * lsb), round(1.5 * 256 * lsb), 0)
    c.set({"gyro_bias_udps": [60000000, -60000000, 0]})
    assert max(c.gyro_bias()) <= 8192 * 256  # what set_bias takes


def test_a_learnt_bias_goes_into_the_file_and_the_rest_stays(tmp_path):
    path = str(tmp_path / "c.json")
    c = Calibration(("-y", "x", "z"), gyro_scale=(131, 1))
    c.set({"mag": mag(offset=(1, 2, 3)), "gyro_bias_udps": [7, 8, 9]})
    c.save(path, "MPU6050", "my board")
    c.save_gyro_bias(path, 256 * 131, -512 * 131, 5, "MPU6050", "my board")
    fields = calibration.read(path)
    assert fields["gyro_bias_udps"] == [-2000000, -1000000, round(5e6 / 256 / 131)]
    assert fields["mag"] == mag(offset=(1, 2, 3))
    assert (fields["chip"], fields["board"]) == ("MPU6050", "my board")
    assert c.gyro_bias() == (256 * 131, -512 * 131, 5)
    again = Calibration(("-y", "x", "z"), gyro_scale=(131, 1))
    again.load(path, "MPU6050", "my board")
    assert again.gyro_bias() == (256 * 131, -512 * 131, 5)


def test_a_learnt_bias_begins_a_file_where_there_is_none(tmp_path):
    path = str(tmp_path / "c.json")
    Calibration().save_gyro_bias(path, 1, 2, 3, "MPU6500", None)
    fields = calibration.read(path, "MPU6500", "any board")
    assert fields["gyro_bias_udps"] and not fields["mag"]


def test_a_learnt_bias_spoils_no_file_that_it_does_not_understand(tmp_path):
    path = tmp_path / "c.json"
    path.write_text("{}")
    with pytest.raises(CalibrationError):
        Calibration().save_gyro_bias(str(path), 1, 2, 3)
    assert path.read_text() == "{}"
    calibration.write(str(path), calibration.blank("MPU6500"))
    with pytest.raises(CalibrationError, match="MPU6500, this is MPU6050"):
        Calibration().save_gyro_bias(str(path), 1, 2, 3, "MPU6050")
    with pytest.raises(CalibrationError, match="gyro_bias_udps"):
        Calibration().save_gyro_bias(str(path), 1 << 22, 2, 3)
    assert calibration.read(str(path))["gyro_bias_udps"] is None


# ---------------------------------------------------------------------------------------- the file
WHOLE = {
    **calibration.blank("MPU6500", "board A"),
    "gyro_bias_udps": [1, -2, 3],
    "accel": accel(offset=(10, 20, 30)),
    "mag": mag(offset=(-1, -2, -3)),
}


def with_checksum(fields):
    """The file's text with the checksum that belongs to it, valid or not."""
    body = calibration._text(fields)
    return body + b' "checksum": "%08x"\n}\n' % crc32(body)


def test_what_is_written_is_read_again(tmp_path):
    path = str(tmp_path / "c.json")
    for fields in (WHOLE, calibration.blank(), {**calibration.blank(), "mag": mag()}):
        calibration.write(path, fields)
        assert calibration.read(path) == fields
        assert json.loads(Path(path).read_text())["version"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


def test_the_order_and_the_spacing_of_a_file_do_not_matter(tmp_path):
    path = tmp_path / "c.json"
    fields = json.loads(with_checksum(WHOLE))
    path.write_text(json.dumps(dict(reversed(fields.items())), indent=7))
    assert calibration.read(str(path)) == WHOLE


def test_a_file_for_any_chip_and_board_fits_every_one(tmp_path):
    path = str(tmp_path / "c.json")
    calibration.write(path, calibration.blank())
    calibration.read(path, "MPU6050", "x")
    calibration.write(path, WHOLE)
    calibration.read(path)
    calibration.read(path, "MPU6500", "board A")


def changed(key, value):
    return {**WHOLE, key: value}


def without(key):
    return {k: v for k, v in WHOLE.items() if k != key}


SINGULAR = [1000000, 500000, 0, 1000000, 500000, 0, 0, 0, 1000000]
MIRRORING = [-1000000, 0, 0, 0, 1000000, 0, 0, 0, 1000000]
WIDE = [1500000, 500001, 0, 0, 1000000, 0, 0, 0, 1000000]

REFUSED = {
    "empty": (b"", "corrupt", "not JSON"),
    "cut": (with_checksum(WHOLE)[:-3], "corrupt", "not JSON"),
    "cut in half": (with_checksum(WHOLE)[:200], "corrupt", "not JSON"),
    "binary": (bytes(range(256)), "corrupt", "not JSON"),
    "deep": (b"[" * 2000, "corrupt", "not JSON"),
    "long": (with_checksum(WHOLE) + b" " * 2048, "corrupt", "more than 2048 bytes"),
    "a list": (b"[]", "foreign", "not of the format"),
    "another object": (b'{"format": "upright-imu", "version": 1}', "foreign", "not of the format"),
    "newer": (with_checksum(WHOLE).replace(b'n": 1', b'n": 2'), "foreign", "version 2, expected 1"),
    "a digit": (with_checksum(WHOLE).replace(b"-2, 3", b"-2, 4"), "corrupt", "checksum is"),
    "checksum": (with_checksum(WHOLE)[:-5] + b'"}', "corrupt", "checksum is"),
    "no checksum": (json.dumps(WHOLE), "corrupt", "checksum is None"),
    "missing part": (json.dumps(without("mag")), "corrupt", "lacks mag"),
    "unknown part": (json.dumps(changed("mug", 1)), "corrupt", "unknown field, mug"),
    "a text": (json.dumps(changed("mag", "x")), "corrupt", "mag is 'x'"),
    "no offset": (json.dumps(changed("mag", {"matrix_ppm": UNIT})), "corrupt", "mag lacks offset_mlsb"),
    "more in it": (json.dumps(changed("mag", {**mag(), "x": 1})), "corrupt", "unknown field, x"),
    "floats": (json.dumps(changed("gyro_bias_udps", [1, 2, 3.0])), "corrupt", "3 integers"),
    "booleans": (json.dumps(changed("gyro_bias_udps", [1, 2, True])), "corrupt", "3 integers"),
    "two": (json.dumps(changed("gyro_bias_udps", [1, 2])), "corrupt", "3 integers"),
    "eight": (json.dumps(changed("accel", accel(UNIT[1:]))), "corrupt", "9 integers"),
    "a number as chip": (json.dumps(changed("chip", 6500)), "corrupt", "chip is 6500"),
    "a quote in the name": (json.dumps(changed("board", 'a"b')), "corrupt", "board is"),
    "bias": (with_checksum(changed("gyro_bias_udps", [0, 60000001, 0])), "corrupt", r"gyro_bias_udps .*60000000$"),
    "accel offset": (with_checksum(changed("accel", accel(offset=(0, 0, -500001)))), "corrupt", "accel.offset_ug"),
    "mag offset": (with_checksum(changed("mag", mag(offset=(20000001, 0, 0)))), "corrupt", "mag.offset_mlsb"),
    "huge": (with_checksum(changed("mag", mag(offset=(10**99, 0, 0)))), "corrupt", "mag.offset_mlsb"),
    "row": (with_checksum(changed("mag", mag(WIDE))), "corrupt", "mag.matrix_ppm .* rows"),
    "singular": (with_checksum(changed("mag", mag(SINGULAR))), "corrupt", "mag.matrix_ppm .* singular"),
    "zero": (with_checksum(changed("accel", accel([0] * 9))), "corrupt", "accel.matrix_ppm .* singular"),
    "mirror": (with_checksum(changed("accel", accel(MIRRORING))), "corrupt", "nor mirrors"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_cannot_be_right_is_refused_with_the_reason_and_nothing_is_applied(
    name, tmp_path
):
    text, kind, said = REFUSED[name]
    path = tmp_path / "c.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    c = Calibration(("y", "-x", "z"))
    before = list(c._s)
    c.set(WHOLE)
    assert list(c._s) != before
    with pytest.raises(CalibrationError, match=said) as caught:
        c.load(str(path))
    assert caught.value.kind == kind
    assert "c.json" in str(caught.value)
    assert 0 < len(caught.value.title) <= 16
    assert list(c._s) == before  # the axis maps only
    assert c.gyro_bias() is None and c.fields == calibration.blank()


@pytest.mark.parametrize(
    "chip, board, said",
    [
        ("MPU6050", "board A", "made for the chip MPU6500, this is MPU6050"),
        ("MPU6500", "board B", "made for the board board A, this is board B"),
    ],
)
def test_a_file_of_another_chip_or_board_is_foreign(chip, board, said, tmp_path):
    path = str(tmp_path / "c.json")
    calibration.write(path, WHOLE)
    c = Calibration()
    with pytest.raises(CalibrationError, match=said) as caught:
        c.load(path, chip, board)
    assert caught.value.kind == "foreign"
    assert len(caught.value.title) <= 16
    assert c.identity and c.gyro_bias() is None


def test_a_file_that_is_missing_or_unreadable_says_so(tmp_path):
    with pytest.raises(CalibrationError, match="no such file") as caught:
        Calibration().load(str(tmp_path / "c.json"))
    assert caught.value.kind == "missing"
    with pytest.raises(CalibrationError, match="cannot be read") as caught:
        Calibration().load(str(tmp_path))
    assert caught.value.kind == "corrupt"


@pytest.mark.parametrize(
    "fields", [changed("mag", mag(SINGULAR)), changed("board", "a\nb"), {}, []]
)
def test_nothing_is_written_that_would_be_refused(fields, tmp_path):
    with pytest.raises(CalibrationError):
        calibration.write(str(tmp_path / "c.json"), fields)
    assert not list(tmp_path.iterdir())


@settings(max_examples=100)
@given(st.data())
def test_no_damage_to_a_file_goes_unnoticed(data):
    """One byte changed anywhere: refused, or nothing but its spacing was hit."""
    text = bytearray(with_checksum(WHOLE))
    text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    try:
        fields = calibration._parse("x", bytes(text))
    except CalibrationError:
        return
    assert fields == WHOLE


# ---------------------------------------------------------------------------------------- power failures
class PowerFailure(Exception):
    pass


class Disk:
    """A file system whose power fails before the step of that number; what was not synced is then cut in half."""

    piece = None  # bytes that are written in a step; None: half of what is to be written

    def __init__(self, files, replaces, fails_at=None, syncs=True):
        self.files = dict(files)
        self.replaces = replaces
        self.left = fails_at
        self.unsynced = set()
        self.os = SimpleNamespace(rename=self.rename, remove=self.remove, stat=self.stat)
        if syncs:
            self.os.fsync = self.unsynced.discard

    def step(self):
        if self.left == 0:
            for name in self.unsynced & set(self.files):
                self.files[name] = self.files[name][: len(self.files[name]) // 2]
            raise PowerFailure
        if self.left is not None:
            self.left -= 1

    def open(self, name, mode):
        if mode == "rb":
            if name not in self.files:
                raise OSError(2, "ENOENT")
            return io.BytesIO(self.files[name])
        self.step()
        self.files[name] = b""
        return Written(self, name)

    def stat(self, name):
        if name not in self.files:
            raise OSError(2, "ENOENT")

    def rename(self, old, new):
        self.step()
        if old not in self.files:
            raise OSError(2, "ENOENT")
        if new in self.files and not self.replaces:
            raise OSError(17, "EEXIST")
        self.files[new] = self.files.pop(old)
        if old in self.unsynced:
            self.unsynced.add(new)
        self.unsynced.discard(old)

    def remove(self, name):
        self.step()
        del self.files[name]


class Written:
    def __init__(self, disk, name):
        self.disk, self.name = disk, name

    def write(self, data):
        size = self.disk.piece or max(1, len(data) // 2)
        for part in [data[i : i + size] for i in range(0, len(data), size)]:
            self.disk.unsynced.add(self.name)
            self.disk.step()
            self.disk.files[self.name] += part

    def flush(self):
        self.disk.step()

    def fileno(self):
        return self.name

    def __enter__(self):
        return self

    def __exit__(self, *why):
        if not hasattr(self.disk.os, "fsync"):
            self.disk.unsynced.discard(self.name)  # a board's file systems: closed is synced


OLD, NEW = changed("mag", None), changed("accel", None)
HALF = with_checksum(OLD)[:99]
STARTS = {
    "nothing": ({}, None),
    "a half new one": ({"c.new": HALF}, None),
    "a file": ({"c": with_checksum(OLD)}, OLD),
    "a file and a half new one": ({"c": with_checksum(OLD), "c.new": HALF}, OLD),
    "a file and a whole new one": ({"c": with_checksum(OLD), "c.new": with_checksum(WHOLE)}, OLD),
    "only the new one": ({"c.new": with_checksum(OLD)}, OLD),
}


def on(disk, monkeypatch, work):
    monkeypatch.setattr(calibration, "os", disk.os)
    monkeypatch.setattr(calibration, "open", disk.open, raising=False)
    return work()


def found(files, monkeypatch):
    """What load() finds after the power has come back."""

    def read():
        try:
            return calibration.read("c")
        except CalibrationError as why:
            assert why.kind == "missing", why
            return None

    return on(Disk(files, True), monkeypatch, read)


def interruptions(files, replaces, syncs, monkeypatch, write):
    """The files after a failure at every step of writing NEW in turn; the last one came through."""
    for at in range(100):
        disk = Disk(files, replaces, at, syncs)
        try:
            on(disk, monkeypatch, write)
        except PowerFailure:
            yield disk.files, False
        else:
            yield disk.files, True
            return


@pytest.mark.parametrize("syncs", [True, False], ids=["fsync", "close"])
@pytest.mark.parametrize("replaces", [True, False], ids=["replacing", "fat"])
@pytest.mark.parametrize("start", STARTS)
def test_whenever_the_power_fails_the_old_or_the_new_file_is_found(
    start, replaces, syncs, monkeypatch
):
    """And when it fails again during the next attempt, too."""
    files, old = STARTS[start]
    assert found(files, monkeypatch) == old
    n = 0

    def write():
        calibration.write("c", NEW)

    for after, through in interruptions(files, replaces, syncs, monkeypatch, write):
        n += 1
        first = found(after, monkeypatch)
        assert first == NEW if through else first in (old, NEW)
        if through:
            assert set(after) == {"c"}
            break
        for again, done in interruptions(after, replaces, syncs, monkeypatch, write):
            second = found(again, monkeypatch)
            assert second == NEW if done else second in (first, NEW)
    assert n > 6


@pytest.mark.parametrize("replaces", [True, False], ids=["replacing", "fat"])
@pytest.mark.parametrize("start", ["a file", "only the new one"])
def test_the_power_may_fail_at_every_byte_of_a_write(start, replaces, monkeypatch):
    monkeypatch.setattr(Disk, "piece", 1)
    files, old = STARTS[start]
    wanted = len(with_checksum(NEW))
    tried = 0
    while True:
        disk = Disk(files, replaces, tried, False)
        try:
            on(disk, monkeypatch, lambda: calibration.write("c", NEW))
            break
        except PowerFailure:
            assert found(disk.files, monkeypatch) in (old, NEW)
        tried += 1
    assert tried > wanted
    assert found(disk.files, monkeypatch) == NEW


def test_a_writer_that_is_not_careful_is_found_out(monkeypatch):
    def write():
        with calibration.open("c", "wb") as file:
            file.write(with_checksum(NEW))

    with pytest.raises(AssertionError):
        for after, _ in interruptions(STARTS["a file"][0], True, True, monkeypatch, write):
            assert found(after, monkeypatch) in (OLD, NEW)


def test_an_error_of_the_file_system_is_told_and_leaves_the_old_file(monkeypatch):
    disk = Disk(STARTS["a file"][0], True)

    def rename(old, new):
        raise OSError(28, "ENOSPC")

    disk.os.rename = rename
    with pytest.raises(OSError, match="ENOSPC"):
        on(disk, monkeypatch, lambda: calibration.write("c", NEW))
    assert found(disk.files, monkeypatch) == OLD


# ---------------------------------------------------------------------------------------- runtimes
def test_the_same_bits_files_and_refusals_on_every_runtime(runtime, portable, tmp_path):
    file = tmp_path / "c.json"
    said = portable(runtime, "calibration_steps.py", "same", file)
    assert len(said.splitlines()) > 40 and "accepted" not in said
    if runtime != "cpython":
        assert said == portable("cpython", "calibration_steps.py", "same", file)


def test_apply_allocates_nothing(micropython_runtime, portable):
    assert portable(micropython_runtime, "calibration_steps.py", "alloc") == "refused 0 grown 0\n"


def test_an_allocation_in_apply_would_be_caught(micropython_runtime, portable):
    said = portable(micropython_runtime, "calibration_steps.py", "alloc", "float")
    assert said.startswith("refused 1 grown ") and not said.endswith(" 0\n")


# The trim of a tilted mounting


def up_ppm(roll, pitch):
    r, p = math.radians(roll), math.radians(pitch)
    up = (-math.sin(p), math.sin(r) * math.cos(p), math.cos(r) * math.cos(p))
    return [round(1e6 * u) for u in up]


def trimmed(roll, pitch, axes=("x", "y", "z"), **fields):
    cal = Calibration(axes, axes, 4096, (82, 5))
    if fields:
        cal.set(fields)
    cal.set_level(up_ppm(roll, pitch))
    return cal


@pytest.mark.parametrize("axes", [("x", "y", "z"), ("y", "-x", "z")])
def test_a_trim_turns_all_three_sensors_alike(axes):
    """What lay along the trim's up is along z; the angles between vectors, and their lengths, stay."""
    cal = trimmed(20, -12, axes)
    body = [u * 4096 / 1e6 for u in up_ppm(20, -12)]
    chip = [0.0] * 3
    for value, axis in zip(body, axes, strict=True):
        chip["xyz".index(axis[-1])] = -value if axis[0] == "-" else value
    up = [round(c) for c in chip]
    for other in ((4000, 0, 0), (0, -4000, 100), (1000, 2000, 3000)):
        cal.apply(array("h", [*up, *other, *up, 7, 3]))
        accel, gyro, mag = cal.counts[0:3], cal.counts[3:6], cal.counts[6:9]
        assert list(accel) == list(mag) == pytest.approx([0, 0, 4096], abs=2)
        dot = sum(a * b for a, b in zip(accel, gyro, strict=True))
        was = sum(a * b for a, b in zip(up, other, strict=True))
        assert dot / 4096 == pytest.approx(was / 4096, abs=4)
        assert math.hypot(*gyro) == pytest.approx(math.hypot(*other), abs=2)
        assert (cal.counts[9], cal.counts[10]) == (7, 3)


def test_a_trim_keeps_what_is_not_fresh_and_saturates():
    cal = trimmed(30, 30)
    cal.apply(array("h", [100, 200, 300, 400, 500, 600, 700, 800, 900, 1, 3]))
    before = list(cal.counts)
    cal.apply(array("h", [1, 1, 1, 1, 1, 1, 1, 1, 1, 5, 0]))
    assert list(cal.counts[:9]) == before[:9]
    cal.apply(array("h", [-32768] * 9 + [0, 3]))
    assert min(cal.counts[:9]) == -32768
    cal.apply(array("h", [32767] * 9 + [0, 3]))
    assert max(cal.counts[:9]) == 32767


def test_the_bias_of_a_trimmed_body_is_stored_in_the_chips_frame(tmp_path):
    path = str(tmp_path / "c.json")
    cal = trimmed(20, -12, ("y", "-x", "z"), gyro_bias_udps=[1000000, -2000000, 3000000])
    body = cal.gyro_bias()
    assert math.hypot(*body) == pytest.approx(math.hypot(1, 2, 3) * 256 * 16.4, abs=2)
    cal.save_gyro_bias(path, *body)
    assert calibration.read(path)["gyro_bias_udps"] == pytest.approx(
        [1000000, -2000000, 3000000], abs=300
    )


def test_a_trim_is_in_a_file_only_where_there_is_one(tmp_path):
    path = str(tmp_path / "c.json")
    calibration.write(path, calibration.blank())
    assert "up_ppm" not in calibration.read(path)
    cal = trimmed(20, -12)
    cal.save_level(path)
    again = Calibration(accel_lsb_per_g=4096)
    again.load(path)
    assert again.fields["up_ppm"] == up_ppm(20, -12)
    assert not again.identity


@pytest.mark.parametrize(
    "up", [[0, 0, 500000], [900000, 0, 435889], [0, 0, -1000000], [0, 0], [0.0, 0.0, 1e6]]
)
def test_what_is_no_trim_is_refused(up):
    with pytest.raises(CalibrationError, match="up_ppm"):
        Calibration().set_level(up)


def test_a_trim_that_would_leave_32_bits_with_its_matrix_is_refused():
    matrix = {"offset_ug": [0, 0, 0], "matrix_ppm": [1900000, 0, 0, 0, 10**6, 0, 0, 0, 10**6]}
    with pytest.raises(CalibrationError, match=r"less tilt with this accel\.matrix_ppm"):
        trimmed(30, 30, accel=matrix)


def test_a_file_is_on_the_medium_before_it_takes_the_place_of_the_old_one(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(calibration.os, "sync", lambda: done.append("sync"), raising=False)
    rename = calibration.os.rename
    monkeypatch.setattr(
        calibration.os, "rename", lambda *names: (done.append("rename"), rename(*names))
    )
    calibration.write(str(tmp_path / "cal.json"), calibration.blank())
    assert done == ["sync", "rename"]
