"""The .imu file and the clock of its rows: read alike on every runtime; nothing else accepted."""

import json
from array import array

import numpy as np
import pytest
import world
from hypothesis import given, settings
from hypothesis import strategies as st

COUNTS = [[100 * k + i - 500 for i in range(11)] for k in range(9)]
DATA = array("h", [v for row in COUNTS for v in row]).tobytes()
FIELDS = {"rate": (2000, 7), "accel_lsb_per_g": 2048, "gyro_scale": (82, 5), "clocked": True}


def write(path, **changes):
    world.write_imu(path, DATA, "nine rows", **{**FIELDS, **changes})
    return path


@pytest.fixture
def imu(tmp_path):
    return write(tmp_path / "nine.imu")


def rewrite(path, **changes):
    """Change fields of the header; None takes one away."""
    line, data = path.read_bytes().split(b"\n", 1)
    fields = {**json.loads(line), **changes}
    fields = {key: value for key, value in fields.items() if value is not None}
    path.write_bytes(json.dumps(fields).encode() + b"\n" + data)
    return path


def test_a_file_reads_back_as_it_was_written(imu):
    w = world.World(imu)
    assert (w.rate, w.n, w.clocked, w.name) == ((2000, 7), 9, True, "nine rows")
    assert (w.accel_lsb_per_g, w.gyro_scale) == (2048, (82, 5))
    assert [list(w.row(k)) for k in range(9)] == COUNTS
    assert world.World(write(imu, clocked=False)).clocked is False


def test_rows_come_right_in_any_order_and_are_clamped(imu):
    w = world.World(imu)
    for k in (8, 0, 0, 1, 5, 4, 5, 6, 8, 8, 2):
        assert list(w.row(k)) == COUNTS[k]
    assert list(w.row(9)) == list(w.row(10**6)) == COUNTS[8]
    assert list(w.row(-1)) == COUNTS[0]


def test_load_copies_into_the_callers_array(imu):
    w = world.World(imu)
    out = array("h", [7] * 12)
    w.load(3, out)
    w.row(4)
    assert list(out) == [*COUNTS[3], 7]


@given(
    num=st.integers(1, 2_000_000),
    den=st.integers(1, 10_000),
    k=st.integers(0, 10**6),
    inside=st.integers(0, 10**6),
)
def test_index_is_the_newest_row_that_exists(num, den, k, inside):
    w = world.StillWorld(rate=(num, den), n=2 * 10**6)
    assert w.time_us(k) == k * 1000000 * den // num
    us = w.time_us(k) + inside
    newest = w.index(us)
    assert w.time_us(newest) <= us
    assert newest == w.n - 1 or w.time_us(newest + 1) > us


def test_a_world_stands_at_row_0_until_it_is_started(imu):
    w = world.World(imu)
    assert w.start_us is None
    assert w.index_at(10**9) == 0 and not w.ended(10**9)
    w.start(1000)
    assert w.start_us == 1000
    assert [w.index_at(t) for t in (0, 1000, 4499, 4500, 8000, 10**9)] == [0, 0, 0, 1, 2, 8]


def test_a_world_ends_with_the_period_of_its_last_row(imu):
    w = world.World(imu)
    w.start(1000)
    assert not w.ended(1000 + 9 * 3500 - 1)
    assert w.ended(1000 + 9 * 3500)


def test_a_still_world_never_changes_unless_it_is_told_to():
    w = world.StillWorld()
    w.start(0)
    assert list(w.row(0)) == list(w.row(77)) == [0, 0, 4096] + [0] * 8
    assert w.index_at(10**9) == 0 and not w.ended(10**12)
    w.set((1, -2))
    assert list(w.row(0)) == [1, -2] + [0] * 9
    out = array("h", [9] * 11)
    w.load(0, out)
    assert out == w.row(0)


def test_every_runtime_reads_the_same_rows(runtime, portable, tmp_path):
    path = tmp_path / "long.imu"
    words = array("h", [(i * i * 31 + i // 7) % 65536 - 32768 for i in range(11 * 3001)])
    world.write_imu(path, words.tobytes(), "long", **FIELDS)
    here = portable("cpython", "world_dump.py", path)
    assert "rate (2000, 7) rows 3001" in here
    assert "times that do not lead back 0" in here
    assert "3000 10500000 " + " ".join(str(v) for v in words[-11:]) in here
    assert portable(runtime, "world_dump.py", path) == here


@settings(max_examples=60)
@given(part=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere_is_refused(part, tmp_path_factory):
    path = write(tmp_path_factory.mktemp("cut") / "cut.imu")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ValueError, match=r"truncated|not an \.imu file"):
        world.World(path)


def test_a_truncated_file_says_what_was_expected_and_found(imu):
    whole = imu.read_bytes()
    imu.write_bytes(whole[:-1])
    message = f"truncated: expected {len(whole)} bytes for its 9 rows, found {len(whole) - 1}"
    with pytest.raises(ValueError, match=message):
        world.World(imu)
    imu.write_bytes(whole + b"\0")
    with pytest.raises(ValueError, match="too long: expected"):
        world.World(imu)


@pytest.mark.parametrize(
    "start",
    [b"", b"\n", b"PK\x03\x04\n", b"[1, 2]\n", b"5\n", b"\xff\xfe\n", b"{}\n", b"[" * 1000 + b"\n"],
)
def test_a_foreign_file_is_refused(start, imu):
    imu.write_bytes(start + DATA)
    with pytest.raises(ValueError, match=r"not an \.imu file: expected"):
        world.World(imu)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"format": "other"}, "not an .imu file"),
        ({"version": 2}, "version 2 but expected is 1"),
        ({"version": None}, "version None but expected is 1"),
        ({"rate": None}, "lacks a field"),
        ({"rate": [200]}, "lacks a field"),
        ({"rate": [200, 0]}, "lacks a field"),
        ({"rows": 0}, "lacks a field"),
        ({"rows": "9"}, "lacks a field"),
        ({"gyro_scale": [16.4, 1]}, "lacks a field"),
        ({"accel_lsb_per_g": -1}, "lacks a field"),
        ({"clocked": 1}, "lacks a field"),
        ({"name": 5}, "lacks a field"),
        ({"rows": 10}, "truncated"),
        ({"rows": 8}, "too long"),
    ],
)
def test_a_wrong_header_is_refused(change, message, imu):
    world.World(rewrite(imu, name="still good"))
    with pytest.raises(ValueError, match=message):
        world.World(rewrite(imu, **change))


def test_a_file_that_shrinks_while_it_is_read_is_an_error_and_no_stale_row(tmp_path):
    path = tmp_path / "big.imu"
    row = array("h", range(11)).tobytes()
    world.write_imu(path, row + bytes(22 * 4999), "big", **FIELDS)
    w = world.World(path)
    assert list(w.row(0)) == list(range(11))
    with open(path, "r+b") as file:
        file.truncate(path.stat().st_size - 22 * 1000 - 10)  # in the middle of row 3999
    with pytest.raises(OSError):
        w.row(3999)
    assert list(w.row(0)) == list(range(11))
    assert list(w.row(1)) == [0] * 11


def test_data_that_are_not_whole_rows_are_not_written(tmp_path):
    for data in (b"", DATA[:-1]):
        with pytest.raises(ValueError, match="whole rows"):
            world.write_imu(tmp_path / "x.imu", data, "x", **FIELDS)
    with pytest.raises(ValueError, match="at most 1024 fit"):
        world.write_imu(tmp_path / "x.imu", DATA, "x" * 1000, **FIELDS)
    assert not (tmp_path / "x.imu").exists()
    with pytest.raises(ValueError, match="not positive"):
        world.StillWorld(rate=(0, 1))


def test_a_board_at_rest_has_a_sensors_noise_the_same_each_time():
    still = world.NoisyWorld()
    rows = np.array([list(still.row(k)) for k in range(4000)])
    level = np.array([*world.LEVEL, 0])
    assert abs(rows.mean(0) - level).max() < 1
    noise = rows.std(0)
    assert noise[:3] == pytest.approx(16.4, rel=0.05)  # 4 mg
    assert noise[3:6] == pytest.approx(0.87, rel=0.05)  # 0.05 deg/s
    assert noise[6:9] == pytest.approx(1.1, rel=0.05)
    assert not noise[9:].any()
    together = np.corrcoef(np.hstack([rows[1:, :9], rows[:-1, :9]]).T) - np.eye(18)
    assert abs(together).max() < 0.1
    again = world.NoisyWorld()
    out = array("h", [0] * 11)
    again.load(1234, out)
    assert list(out) == rows[1234].tolist()
