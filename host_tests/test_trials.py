"""Recorded trials: what is one is loaded exactly, what is none is refused with its reason."""

import io
import json
import math
import warnings
from fractions import Fraction

import motions
import numpy as np
import pytest
import world
from hypothesis import example, given, settings
from hypothesis import strategies as st
from upright_host import scoring, trials

N, EVERY = 43, 4
HEADER = {
    "name": "made up",
    "rate_hz": 2000 / 7,
    "gt_every": EVERY,
    "gyr_dps_per_lsb": 1 / 16.4,
    "acc_mps2_per_lsb": 9.80665 / 2048,
    "mag_uT_per_lsb": 0.3,
}


def arrays(**changes):
    """The arrays of a good trial; None takes one away."""
    rng = np.random.default_rng(1)
    m = -(-N // EVERY)
    q = rng.standard_normal((m, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    q[2] = np.nan
    made = {
        name: rng.integers(-32768, 32768, (N, 3)).astype("i2") for name in ("gyr", "acc", "mag")
    }
    made["gyr"][5] = 32767, -32768, 0
    made["q_gt"] = q.astype("f4")
    made["movement"] = np.packbits(np.arange(m) >= 2)
    made.update(changes)
    return {name: array for name, array in made.items() if array is not None}


def save(path, header=None, **changes):
    text = json.dumps({k: v for k, v in {**HEADER, **(header or {})}.items() if v is not None})
    made = {"header": np.frombuffer(text.encode(), np.uint8), **arrays(**changes)}
    np.savez_compressed(path, **{k: v for k, v in made.items() if v is not None})
    return path


def whole():
    out = io.BytesIO()
    save(out)
    return out.getvalue()


WHOLE = whole()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "trial.npz"


def test_a_trial_is_loaded_exactly(path):
    made = arrays()
    t = trials.load(save(path))
    assert (t.name, t.n, t.rate) == ("made up", N, (2000, 7))
    assert (t.accel_lsb_per_g, t.accel_range_g) == (2048, 16)
    assert (t.gyro_scale, t.gyro_range_dps) == ((82, 5), 2000)
    assert (t.mag_uT_per_lsb, t.gt_every) == (0.3, EVERY)
    assert t.seconds == pytest.approx(N * 7 / 2000)
    assert t.counts.dtype == np.int16 and t.counts.shape == (N, 11)
    for name, first in (("acc", 0), ("gyr", 3), ("mag", 6)):
        assert (t.counts[:, first : first + 3] == made[name]).all()  # saturated counts and all
    assert t.counts[0, 9] / 340 + 36.53 == pytest.approx(25, abs=0.01)
    assert not t.counts[:, 10].any()
    assert np.array_equal(t.q_gt, made["q_gt"].astype(float), equal_nan=True)
    assert t.movement.tolist() == [False] * 2 + [True] * 9
    assert t.t_gt == pytest.approx(np.arange(11) * 4 * 7 / 2000)
    assert t.has_truth


@pytest.mark.parametrize(
    "rate_hz, exact",
    [
        (200, (200, 1)),
        (285.7142857142857, (2000, 7)),
        (1000 / 3, (1000, 3)),
        (62.5, (125, 2)),
    ],
)
def test_a_rate_becomes_the_exact_ratio(rate_hz, exact, path):
    assert trials.load(save(path, {"rate_hz": rate_hz})).rate == exact


@given(rate_hz=st.floats(1, 8000))
@example(rate_hz=200.00004)
@example(rate_hz=1 + 4e-10)
def test_a_rate_is_never_off_by_more_than_a_billionth(rate_hz, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "rate.npz"
    num, den = trials.load(save(path, {"rate_hz": rate_hz})).rate
    assert math.gcd(num, den) == 1
    assert abs(Fraction(num, den) - Fraction(rate_hz)) <= Fraction(rate_hz) / 10**9


@pytest.mark.parametrize("g, lsb", [(2, 16384), (4, 8192), (8, 4096), (16, 2048)])
def test_every_accel_range_is_known(g, lsb, path):
    scale = float(np.float32(9.80665 / lsb))
    t = trials.load(save(path, {"acc_mps2_per_lsb": scale}))
    assert (t.accel_lsb_per_g, t.accel_range_g) == (lsb, g)


@pytest.mark.parametrize(
    "dps, scale", [(250, (131, 1)), (500, (131, 2)), (1000, (164, 5)), (2000, (82, 5))]
)
def test_every_gyro_range_is_known(dps, scale, path):
    t = trials.load(save(path, {"gyr_dps_per_lsb": scale[1] / scale[0]}))
    assert (t.gyro_scale, t.gyro_range_dps) == (scale, dps)


def test_truth_turns_from_east_north_up_to_north_west_up(path):
    # sensor x to the north: in east-north-up a quarter turn about up, in north-west-up none
    half = math.sqrt(0.5)
    assert trials.enu_to_nwu([[half, 0, 0, half]]) == pytest.approx(np.array([[1, 0, 0, 0]]))
    # sensor x to the east: in north-west-up a quarter turn to the right
    assert trials.enu_to_nwu([[1, 0, 0, 0]]) == pytest.approx(np.array([[half, 0, 0, -half]]))
    t = trials.load(save(path))
    q = t.q_true()
    assert np.isnan(q[2]).all()
    known = np.isfinite(q[:, 0])
    v = np.array([0.0, 1, 2, 3])

    def turned(q):
        return motions.multiply(motions.multiply(q, v), q * [1, -1, -1, -1])[:, 1:]

    east, north, up = turned(t.q_gt[known]).T
    assert turned(q[known]) == pytest.approx(np.stack([north, -east, up], 1), abs=1e-5)


def test_a_trial_without_magnetometer_or_truth_is_still_a_trial(path):
    t = trials.load(save(path, {"mag_uT_per_lsb": None}, mag=None))
    assert t.mag_uT_per_lsb is None and not t.counts[:, 6:9].any() and t.has_truth
    t = trials.load(save(path, {"gt_every": None}, q_gt=None, movement=None))
    assert t.q_gt is None and not t.has_truth
    nothing = np.full((11, 4), np.nan, "f4")
    assert not trials.load(save(path, q_gt=nothing)).has_truth
    assert not trials.load(save(path, movement=np.zeros(2, "u1"))).has_truth


def test_a_truth_of_any_bits_is_read_or_refused_without_a_warning(path):
    """Found by the million inputs: a signalling NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        signalling = np.full((11, 4), 0x7F800001, "u4").view("f4")
        assert not trials.load(save(path, q_gt=signalling)).has_truth
        for dtype, value in (("f8", 1e200), ("f4", np.inf)):
            with pytest.raises(trials.TrialError, match="no unit quaternions"):
                trials.load(save(path, q_gt=np.full((11, 4), value, dtype)))


def test_a_trial_is_replayed_by_the_world_sample_by_sample(path, tmp_path):
    t = trials.load(save(path))
    assert t.write(tmp_path / "t.imu") == N
    w = world.World(tmp_path / "t.imu")
    assert (w.rate, w.n, w.clocked, w.name) == ((2000, 7), N, True, "made up")
    assert (w.accel_lsb_per_g, w.gyro_scale) == (2048, (82, 5))
    assert all(list(w.row(k)) == list(t.counts[k]) for k in range(N))


def test_the_first_seconds_are_the_samples_before_that_time(path, tmp_path):
    t = trials.load(save(path))
    # samples at 0, 3.5, 7 ms ...
    assert [t.rows(s) for s in (1e-6, 0.0035, 0.0036, 0.007, 0.1, 99, None)] == [
        *(1, 1, 2, 2, 29, N, N)
    ]
    assert t.write(tmp_path / "t.imu", seconds=0.1) == 29
    assert world.World(tmp_path / "t.imu").n == 29
    for wrong in (0, -1, math.nan):
        with pytest.raises(ValueError, match="not a positive length"):
            t.rows(wrong)


def test_a_missing_file_and_a_folder_are_told_apart(path, tmp_path):
    with pytest.raises(trials.TrialError, match=r"trial\.npz: no such file"):
        trials.load(path)
    with pytest.raises(trials.TrialError, match="is a folder"):
        trials.load(tmp_path)


@pytest.mark.parametrize("content", [b"", b"t,q0\n0,1\n", b"\x93NUMPY\x01\x00", b"\0" * 100])
def test_what_is_no_archive_is_refused(content, path):
    path.write_bytes(content)
    with pytest.raises(trials.TrialError, match=r"not an \.npz archive: it starts with"):
        trials.load(path)


@settings(max_examples=200)
@given(length=st.integers(0, len(WHOLE) - 1))
def test_an_archive_cut_anywhere_is_refused(length, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "cut.npz"
    path.write_bytes(WHOLE[:length])
    with pytest.raises(trials.TrialError, match=r"truncated or damaged|not an \.npz"):
        trials.load(path)


@settings(max_examples=300)
@given(at=st.integers(0, len(WHOLE) - 1), flip=st.integers(1, 255))
def test_an_archive_with_a_wrong_byte_is_refused_or_of_no_consequence(at, flip, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "wrong.npz"
    path.write_bytes(WHOLE)
    good = trials.load(path)
    wrong = bytearray(WHOLE)
    wrong[at] ^= flip
    path.write_bytes(wrong)
    try:
        found = trials.load(path)
    except trials.TrialError:
        return
    assert (found.counts[:, :6] == good.counts[:, :6]).all() and found.rate == good.rate


@pytest.mark.parametrize("name", ["gyr", "acc", "header"])
def test_a_missing_array_is_named(name, path):
    with np.load(save(path)) as archive:
        made = {key: archive[key] for key in archive.files if key != name}
    np.savez(path, **made)
    with pytest.raises(trials.TrialError, match=f"not a trial: it lacks {name}"):
        trials.load(path)


SHORT = np.zeros((N - 1, 3), "i2")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"gyr": np.zeros((N, 3), "f4")}, "gyr is float32, expected int16"),
        ({"acc": np.zeros((N, 3), "i4")}, "acc is int32, expected int16"),
        ({"gyr": np.zeros((N, 2), "i2")}, "gyr has the shape"),
        ({"gyr": np.zeros(N, "i2")}, "gyr has the shape"),
        ({"acc": SHORT}, rf"acc has the shape \({N - 1}, 3\), expected \({N}, 3\)"),
        ({"mag": SHORT}, "mag has the shape"),
        ({"gyr": SHORT[:0], "acc": SHORT[:0], "mag": SHORT[:0]}, "no samples"),
        ({"gyr": np.array([[None] * 3] * N)}, "damaged"),
        ({"q_gt": np.zeros((N, 4), "f4")}, rf"q_gt is float32 \({N}, 4\), expected"),
        ({"q_gt": np.zeros((11, 4), "i4")}, "q_gt is int32"),
        ({"q_gt": np.zeros((11, 4), "f4")}, "no unit quaternions"),
        ({"q_gt": np.full((11, 4), np.inf, "f4")}, "no unit quaternions"),
        ({"movement": None}, "has q_gt but lacks movement"),
        ({"movement": np.zeros(3, "u1")}, "movement is uint8"),
        ({"movement": np.zeros(2, "i2")}, "movement is int16"),
    ],
)
def test_an_array_of_the_wrong_kind_is_named(changes, message, path):
    with pytest.raises(trials.TrialError, match=message):
        trials.load(save(path, **changes))


@pytest.mark.parametrize(
    "header, message",
    [
        (np.frombuffer(b"rate=200", np.uint8), "header is not JSON"),
        (np.frombuffer(b"\xff\xfe{}", np.uint8), "header is not JSON"),
        (np.frombuffer(b"[" * 100000, np.uint8), "header is not JSON"),
        (np.frombuffer(b"[1]", np.uint8), "header is a list, expected an object"),
        (np.array("{}"), "header is <U2"),
        (np.zeros((2, 2), np.uint8), "header is uint8"),
    ],
)
def test_a_header_that_is_no_json_object_is_refused(header, message, path):
    made = arrays()
    np.savez(path, header=header, **made)
    with pytest.raises(trials.TrialError, match=message):
        trials.load(path)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"rate_hz": None}, "lacks rate_hz"),
        ({"gyr_dps_per_lsb": None}, "lacks gyr_dps_per_lsb"),
        ({"acc_mps2_per_lsb": None}, "lacks acc_mps2_per_lsb"),
        ({"mag_uT_per_lsb": None}, "lacks mag_uT_per_lsb"),
        ({"gt_every": None}, "lacks gt_every"),
        ({"rate_hz": "200"}, "rate_hz is '200', expected a number"),
        ({"rate_hz": True}, "rate_hz is True, expected a number"),
        ({"rate_hz": 0}, "rate_hz is 0, expected a positive"),
        ({"rate_hz": math.nan}, "expected a positive"),
        ({"rate_hz": math.inf}, "expected a positive"),
        ({"rate_hz": 0.5}, "not within 1 and 8000"),
        ({"rate_hz": 9000}, "not within 1 and 8000"),
        ({"gt_every": 2.5}, "gt_every is 2.5, expected a whole number"),
        ({"gyr_dps_per_lsb": 0.07}, "0.07 is 14.2857 LSB per deg/s, which no range.*131, 65.5"),
        ({"gyr_dps_per_lsb": -1}, "expected a positive"),
        ({"acc_mps2_per_lsb": 9.81 / 2048}, "no range of an MPU6050 gives .16384, 8192"),
        ({"acc_mps2_per_lsb": 1e-320}, "no range of an MPU6050"),
    ],
)
def test_a_wrong_number_in_the_header_is_named(change, message, path):
    trials.load(save(path))
    with pytest.raises(trials.TrialError, match=message):
        trials.load(save(path, change))


def test_the_data_folder_is_the_one_that_upright_data_names(tmp_path, monkeypatch):
    monkeypatch.setenv("UPRIGHT_DATA", str(tmp_path))
    assert trials.find_data() == tmp_path
    assert trials.trial_files() == []
    save(tmp_path / "b.npz"), save(tmp_path / "a.npz")
    assert [path.name for path in trials.trial_files()] == ["a.npz", "b.npz"]
    monkeypatch.setenv("UPRIGHT_DATA", "")
    assert trials.find_data() is None and trials.trial_files() == []
    monkeypatch.setenv("UPRIGHT_DATA", str(tmp_path / "none"))
    with pytest.raises(trials.TrialError, match="UPRIGHT_DATA names no folder"):
        trials.find_data()


def test_without_upright_data_the_folder_beside_the_project_serves(tmp_path, monkeypatch):
    monkeypatch.delenv("UPRIGHT_DATA", raising=False)
    monkeypatch.setattr(trials.paths, "ROOT", tmp_path / "project")
    (tmp_path / "project").mkdir()
    assert trials.find_data() is None
    beside = trials.paths.ROOT / trials.BESIDE
    beside.mkdir(parents=True)
    assert trials.find_data() == beside.resolve()


def test_every_recorded_trial_loads_and_its_truth_scores_perfectly_against_itself(
    tmp_path, recorded
):
    t = trials.load(recorded)
    assert t.has_truth and t.n > 1000
    # gravity as the truth has it is what the accelerometer shows on average
    q = t.q_true()[t.movement & np.isfinite(t.q_gt[:, 0])]
    acc = t.counts[:: t.gt_every, :3][t.movement & np.isfinite(t.q_gt[:, 0])]
    up = motions.multiply(
        motions.multiply(q, np.insert(acc.astype(float), 0, 0, 1)), q * [1, -1, -1, -1]
    )[:, 1:].mean(0)
    assert up[2] / t.accel_lsb_per_g == pytest.approx(1, abs=0.05)
    assert np.abs(up[:2] / t.accel_lsb_per_g).max() < 0.05
    every = scoring.score(t.t_gt, np.where(np.isnan(t.q_gt), 1, t.q_true()), t.t_gt, t.q_true())
    assert max(every.inclination, every.heading, every.total) < 1e-5 and every.coverage == 1
    rows = t.write(tmp_path / "t.imu", seconds=1)
    assert list(world.World(tmp_path / "t.imu").row(rows - 1)) == list(t.counts[rows - 1])
