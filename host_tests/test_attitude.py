"""What holds for every filter: the interface, the same bits on every runtime, no allocation; and what they compute is
what they computed before."""

import json
import math
import os
import random
import zlib
from array import array
from functools import cache
from pathlib import Path

import motions
import numpy as np
import pytest
from conftest import recorded_trials
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference.mahony_float import angle_between
from samples import SOFTWARE, Scales, counts, run
from scenes import FIELD_UT, scene
from upright import filters
from upright_host import qemu, scoring, trials, words
from upright_host.simulate import best_runtime as quickest

AT_REST = array("h", [0, 0, 4096, 10, -20, 30, 66, 0, -150, 0, 3])
RECORD = Path(__file__).parent / "golden" / "histories.json"


@pytest.fixture(params=SOFTWARE)
def made(request):
    return filters.make(request.param, 200, Scales, {})


def test_it_has_the_name_it_is_made_by_and_all_that_a_filter_has(made):
    assert filters.FILTERS[made.NAME][1] == type(made).__name__
    assert (9 if "9" in made.NAME else 6) == made.AXES
    assert made.rate == (200, 1)
    assert made.gyro_scale == (82, 5) and made.accel_lsb_per_g == 4096
    q, angles, bias = array("i", [0] * 4), array("i", [0] * 3), array("i", [0] * 3)
    assert made.seed(AT_REST)
    made.set_bias(256 * 10, -256 * 20, 256 * 30)
    for _ in range(1000):
        made.update(AT_REST)
    made.quaternion(q)
    assert list(made.state[made.QUATERNION : made.QUATERNION + 4]) == list(q)
    assert np.linalg.norm(q) / scoring.ONE == pytest.approx(1, abs=1e-4)
    assert np.linalg.norm(np.array(made.quaternion_floats()) - np.array(q) / scoring.ONE) < 1e-4
    made.angles(angles)
    assert max(abs(a) for a in angles) < 100  # level, north, not turning
    made.bias(bias)
    assert np.abs(np.array(bias) / 256 - (10, -20, 30)).max() < 0.1
    made.bias_mdps(bias)
    assert np.abs(np.array(bias) / 1000 * 16.4 - (10, -20, 30)).max() < 0.1


@pytest.mark.parametrize("b", [8192 * 256, -8192 * 256, 12345, -1, 0])
def test_the_bias_reads_back(made, b):
    out = array("i", [0] * 3)
    made.set_bias(b, -b, 5)
    made.bias(out)
    assert list(out) == [b, -b, 5]
    made.bias_mdps(out)
    assert list(out)[:2] == [round(b * 1000 / 256 / 16.4), round(-b * 1000 / 256 / 16.4)]


def test_it_is_made_for_a_sensor_with_its_rate_and_scales(made):
    kind = type(made)
    twin = kind.for_sensor(Scales)
    assert (twin.rate, twin.gyro_scale, twin.accel_lsb_per_g) == ((200, 1), (82, 5), 4096)
    assert list(twin.state) == list(made.state)
    gain = {"kp": 3, "tau": 3, "q_angle": 0.1, "rest_after": 3}
    (name,) = [n for n in gain if n in _gains(kind)]
    assert list(kind.for_sensor(Scales, **{name: gain[name]}).state) != list(made.state)


def _gains(kind):
    """The names of a filter's own keyword arguments."""
    names = getattr(kind, "PARAMETERS", None)
    return names or kind.__init__.__code__.co_varnames[: kind.__init__.__code__.co_argcount]


@pytest.mark.parametrize("lsb", [0, 63, 32768, 2048.0])
@pytest.mark.parametrize("name", SOFTWARE)
def test_an_accelerometer_scale_that_cannot_be_is_refused(name, lsb):
    class Other(Scales):
        accel_lsb_per_g = lsb

    with pytest.raises(ValueError, match=r"accel_lsb_per_g is .*, expected an int, 64\.\.32767"):
        filters.make(name, 200, Other, {})


@pytest.mark.parametrize("known_s", [0.01, 1, 2.5, 100, 3600])
def test_how_well_a_bias_is_known_matters_to_filters_with_a_variance(made, known_s):
    """test_quaternion_kalman.py has that of the Kalman filter."""
    made.set_bias(100, -200, 300)
    before = list(made.state)
    made.set_bias(100, -200, 300, known_s=known_s)
    if not made.NAME.startswith(("inertial", "quaternion")):
        assert list(made.state) == before
    if not made.NAME.startswith("inertial"):
        return
    at = words.places("inertial")
    variances = [made.state[at.P + 5 * i] for i in (1, 2, 3)]
    # 0.5 deg/s / known_s**0.5, in units of 2 * bias_start_dps**2; at most 1/2, at least 2**-24
    start = made.PARAMETERS["bias_start_dps"][0]
    expected = min(1 / 2, max(2**-24, 0.25 / known_s / (2 * start**2)))
    assert [v / 2**30 for v in variances] == pytest.approx([expected] * 3, rel=1e-3)
    others = [v for i, v in enumerate(made.state[at.P : at.P + 16]) if i % 5]
    assert not any(others)


@pytest.mark.parametrize("known_s", [-1, 3601, float("nan"), "1", None])
def test_a_known_s_that_is_none_is_refused(made, known_s):
    with pytest.raises(ValueError, match=r"known_s is .*, expected seconds of rest, 0\.\.3600"):
        made.set_bias(1, 2, 3, known_s)


@pytest.mark.parametrize("b", [8192 * 256 + 1, -8192 * 256 - 1, 1.5])
def test_a_bias_that_the_numbers_cannot_hold_is_refused(made, b):
    with pytest.raises(ValueError, match=r"bias is .*, at most \+-2097152"):
        made.set_bias(0, b, 0)


@pytest.mark.parametrize("z", [0, 1, 255, -255])  # 1/16 g
def test_a_first_sample_without_gravity_is_none(made, z):
    made.set_quaternion(1, 2, 3, 4)
    short = array("h", AT_REST)
    short[2] = z
    assert made.seed(short) is False
    assert made.quaternion_floats() == (1, 0, 0, 0)


side = st.integers(-4096, 4096)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOFTWARE)
@settings(max_examples=60)
@given(side, side, side)
@example(0, 0, -4096)
@example(4096, 0, 0)
@example(-4096, 0, 0)
@example(1, 0, -4096)
def test_the_first_sample_levels_at_any_attitude(name, x, y, z):
    if math.hypot(x, y, z) < 300:
        return
    made = filters.make(name, 200, Scales, {})
    euler = name in ("euler6", "kalman6")
    assert made.seed(counts(x, y, z)) is True
    a, b, c, d = made.quaternion_floats()
    pitch = math.asin(max(-1, min(1, 2 * (a * c - b * d))))
    roll = math.atan2(2 * (a * b + c * d), 1 - 2 * (b * b + c * c))
    yaw = math.atan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d))
    off = math.degrees(pitch - math.atan2(-x, math.hypot(y, z)))
    assert abs(off) < (2e-3 if euler else 0.01)
    if math.hypot(y, z) > 40:  # roll is lost near gimbal lock
        off = math.degrees(math.remainder(roll - math.atan2(y, z), 2 * math.pi))
        assert abs(off) < (2e-5 if euler else 0.01)
        assert abs(math.degrees(yaw)) < 0.01
    # what is seeded is what the feedback asks for: the next step leaves it there
    before = list(made.state[made.QUATERNION : made.QUATERNION + 4])
    made.update(counts(x, y, z))
    after = made.state[made.QUATERNION : made.QUATERNION + 4]
    if euler:
        assert max(abs(p - q) for p, q in zip(before, after, strict=True)) <= 8
    else:
        assert angle_between(before, after) < 1e-4


@pytest.mark.parametrize("yaw", [0, 40, 120, -90, 179])
def test_the_first_sample_gives_tilt_and_with_a_magnetometer_the_heading(made, yaw):
    q = motions.quaternion_zyx(yaw, 20, -35)
    turn = motions._matrix(q[None])[0]
    row = array("h", AT_REST)
    for i in range(3):
        row[i] = round(4096 * turn[2][i])
        row[3 + i] = 0
        row[6 + i] = round((FIELD_UT @ turn)[i] / 0.3)
    angles = array("i", [0] * 3)
    for flags in (3, 1):
        row[10] = flags
        assert made.seed(row) is True
        heading = yaw if flags == 3 and made.AXES == 9 else 0
        for _ in range(2):
            made.angles(angles)
            off = (angles[2] / 1000 - heading + 180) % 360 - 180
            assert abs(off) < 0.5 and abs(angles[1] - 20000) < 300 and abs(angles[0] + 35000) < 300
            made.update(row)


def test_a_field_that_stands_upright_gives_no_heading(made):
    row = array("h", AT_REST)
    row[6] = row[7] = 0
    assert made.seed(row) is True
    assert made.quaternion_floats() == pytest.approx((1, 0, 0, 0), abs=1e-6)


@pytest.mark.parametrize(
    "bad", [(0, 0, 0), (32767, 0, 0), (-32768, 5, 5), (5, 5, -32767), (5, 5, 32767)]
)
def test_a_magnetometer_sample_that_cannot_be_turns_nothing(made, bad):
    row = array("h", AT_REST)
    row[3:6] = array("h", [0, 0, 0])
    row[10] = 1
    made.seed(row)
    row[6:9] = array("h", bad)
    row[10] = 3
    for _ in range(200):
        made.update(row)
    assert not getattr(made, "mag_accepted", False)
    angles = array("i", [0] * 3)
    made.angles(angles)
    assert abs(angles[2]) <= 1


@pytest.mark.parametrize("name", [n for n in SOFTWARE if n.startswith(("inertial", "quaternion"))])
def test_a_bias_that_was_set_is_subtracted_and_what_is_learnt_at_rest_comes_on_top(name):
    made = filters.make(name, 200, Scales, {})
    row = array("h", AT_REST)
    row[3:6] = array("h", [0, 0, 820])
    row[10] = 1
    out = array("i", [0] * 3)
    made.set_bias(0, 0, 820 * 256)  # 50 deg/s
    for _ in range(200):
        made.update(row)
    made.angles(out)
    assert abs(out[2]) < 5
    row[5] = 853  # 2.01 deg/s more
    for _ in range(200 * 15):  # it contradicts the rest before, for 12 s
        made.update(row)
    made.bias_mdps(out)
    assert out[2] == pytest.approx(853000 / 16.4, abs=50)
    saved = array("i", [0] * 3)
    made.bias(saved)
    fresh = filters.make(name, 200, Scales, {})
    fresh.set_bias(*saved)
    for _ in range(200):
        fresh.update(row)
    fresh.angles(out)
    assert abs(out[2]) < 60


def test_it_goes_on_with_the_last_turn_when_samples_are_missing(made):
    made.seed(AT_REST)
    # 50 deg/s; the accelerometer and the field disagree with the attitude, and nothing must come of it
    run(made, counts(4096, 0, 0, gz=820, mx=-66, flags=0), 200)
    angles = array("i", [0] * 3)
    made.angles(angles)
    assert list(angles) == pytest.approx([0, 0, 50000], abs=10)


def test_the_attitude_can_be_set(made):
    for q in ((0.5, 0.5, -0.5, 0.5), (3, 0, 0, 4), (1, 2, 3, -4)):
        made.set_quaternion(*q)
        expected = np.array(q) / np.linalg.norm(q)
        assert abs(np.array(made.quaternion_floats()) @ expected) > 1 - 1e-8
    with pytest.raises(ValueError):
        made.set_quaternion(0, 0, 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOFTWARE)
def test_what_it_does_not_take_is_refused(name):
    with pytest.raises(ValueError, match=name):
        filters.make(name, 200, Scales, {"no_such_gain": 1})
    for rate in (0, -200, 2.5, "200", (200, 0)):
        with pytest.raises(ValueError, match=r"rate is .*, expected a positive int or a pair"):
            filters.make(name, rate, Scales, {})
    for scale in (16.4, (82, -5)):

        class Other(Scales):
            gyro_scale = scale

        with pytest.raises(ValueError, match=r"gyro_scale is .*, expected"):
            filters.make(name, 200, Other, {})


# -- what the classic filters do alike; their feedback has a time constant of half a second, or is switched off
STRONG = {"mahony6": {"kp": 2}, "mahony9": {"kp": 2}, "euler6": {"tau": 0.5}}
FREE = {"mahony6": {"kp": 0}, "mahony9": {"kp": 0}, "euler6": {"tau": None}}


def yaw_of(filter):
    w, _, _, z = filter.quaternion_floats()
    return math.degrees(2 * math.atan2(z, w))


@pytest.mark.parametrize("name", STRONG)
def test_it_levels_from_a_wrong_start_with_its_time_constant(name):
    filter = filters.make(name, 200, Scales, STRONG[name])
    filter.set_quaternion(math.cos(0.1), math.sin(0.1), 0, 0)
    tilt = []
    out = array("i", [0] * 3)
    for _ in range(3):
        filter.angles(out)
        tilt.append(out[0])
        run(filter, counts(), 100)  # one time constant
    rel = 0.01 if name == "euler6" else 0.02
    assert tilt[1] / tilt[0] == pytest.approx(math.exp(-1), rel=rel)
    assert tilt[2] / tilt[1] == pytest.approx(math.exp(-1), rel=rel)


@pytest.mark.parametrize("name", STRONG)
def test_it_levels_from_upside_down(name):
    filter = filters.make(name, 200, Scales, STRONG[name])
    euler = name == "euler6"
    filter.set_quaternion(0 if euler else 0.001, 1, 0, 0)
    run(filter, counts(), 200 * (8 if euler else 15))
    out = array("i", [0] * 3)
    filter.angles(out)
    assert max(abs(out[0]), abs(out[1])) <= (0 if euler else 2)


@pytest.mark.parametrize("name", FREE)
def test_a_bias_is_subtracted_to_a_256th_of_a_count(name):
    """100 s at rest with the bias of 3.3 counts: without it the yaw would drift by 20 deg."""
    filter = filters.make(name, 200, Scales, FREE[name])
    bias = round(3.3 * 256)
    filter.set_bias(0, 0, bias)
    rng = random.Random(1)
    total = 0
    for _ in range(20000):
        gz = 3 + (rng.random() < 0.3)
        total += gz
        filter.update(counts(gz=gz))
    expected = (total - 20000 * bias / 256) / 16.4 / 200
    assert yaw_of(filter) == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", FREE)
@pytest.mark.parametrize("rate", [50, 200, (2000, 7), 8000])
@pytest.mark.parametrize("scale", [(131, 1), (131, 2), (164, 5), (82, 5)])
def test_the_gyro_gain_is_exact_for_fast_and_slow_turns(name, rate, scale):
    """One full turn about z at three quarters of full scale ends where it began, and single counts are not lost."""

    class Sensor(Scales):
        gyro_scale = scale

    num, den = rate if isinstance(rate, tuple) else (rate, 1)
    for gz, steps in ((24000, round(360 * scale[0] / scale[1] / 24000 * num / den)), (1, 4000)):
        filter = filters.make(name, rate, Sensor, FREE[name])
        run(filter, counts(gz=gz), steps)
        expected = gz * scale[1] / scale[0] * steps * den / num
        off = math.remainder(yaw_of(filter) - expected, 360)
        assert abs(off) < (0.002 if gz > 1 else 1e-5)


FED_BACK = {
    "mahony6": {"kp": 1, "ki": 0.5},
    "mahony9": {"kp": 1, "ki": 0.5},
    "euler6": {"tau": 1},
    "kalman6": {"q_bias": 0.003, "r_angle": 0.03},
}


@pytest.mark.parametrize("name", FED_BACK)
@pytest.mark.parametrize(
    "what, row, used",
    [
        ("stale", counts(flags=0), False),
        ("only a fresh magnetometer", counts(flags=2), False),
        ("full scale", counts(flags=5), False),
        ("zero", counts(0, 0, 0), False),
        ("62 mg", counts(0, 0, 254), False),
        ("42 mg", counts(100, -100, 100), False),
        ("1 g", counts(flags=1), True),
        ("the gyro at full scale", counts(flags=9), True),
        ("63 mg", counts(0, 0, 256), True),
    ],
)
def test_an_accelerometer_that_cannot_be_used_is_not_and_one_that_can_is(name, what, row, used):
    filter = filters.make(name, 200, Scales, FED_BACK[name])
    filter.set_quaternion(10, 1, 0, 0)
    before = filter.quaternion_floats()
    filter.update(row)
    turned = angle_between(before, filter.quaternion_floats())
    assert turned > 0.01 if used else turned < (1e-7 if name.startswith("mahony") else 1e-6)
    out = array("i", [9] * 3)
    filter.bias_mdps(out)
    if not used:
        assert list(out) == [0, 0, 0]


# -- the same bits everywhere, and the same as ever
STATES = {"mahony6": "mahony", "mahony9": "mahony", "euler6": "euler", "kalman6": "kalman"}
STATES |= dict.fromkeys(("inertial6", "inertial9"), "inertial")
STATES |= dict.fromkeys(("quaternion-kalman6", "quaternion-kalman9"), "quaternion_kalman")
# what switches on more than the defaults do
GAINS = {
    "mahony6": {"kp": 1, "ki": 0.02},
    "mahony9": {"kp": 1, "ki": 0.02},
    "euler6": {"tau": 0.7},
    "kalman6": {"q_bias": 0.003, "r_angle": 0.03},
}
RATES = ((200, 1), (2000, 7), (500, 1), (1000, 1), (90, 1), (1439, 1), (333, 1))


@cache
def pieces():
    """400 rows of each motion, and a body that is kicked."""
    out = [
        motions.render(name, rate=rate, seconds=400 * rate[1] / rate[0], seed=5)
        for name, rate in zip(motions.MOTIONS, RATES, strict=True)
    ]
    return [*out, scene(90, 10, kick=(6, (100, 30, 60)), mag_every=3)]


_EXPECTED = {}


@pytest.mark.parametrize("name", SOFTWARE)
def test_every_attitude_and_the_state_have_the_same_bits_on_every_runtime(
    filter_history, micropython_runtime, name
):
    for i, rendered in enumerate(pieces()):
        if micropython_runtime in qemu.RECIPES and i % 3 != 1:
            continue  # each piece boots the emulated board anew; three of them, the kick among these
        options = {"mag_every": (1, 2, 3, 10)[i % 4], "gains": GAINS.get(name, {})}
        options |= {"start": (1, 3, 6, 0)} if i % 2 else {"bias": (300, -200, 1)}
        if (name, i) not in _EXPECTED:
            _EXPECTED[name, i] = filter_history("cpython", rendered, name, **options)
        got, expected = (
            filter_history(micropython_runtime, rendered, name, **options),
            _EXPECTED[name, i],
        )
        assert np.array_equal(got.q29, expected.q29), rendered.name
        assert got.said == expected.said, rendered.name
        assert len(np.unique(got.q29, axis=0)) > 100


def test_nothing_is_allocated_in_10000_updates_and_conversions(portable, micropython_runtime):
    said = portable(micropython_runtime, "filter_alloc.py")
    assert said.split("\n")[:2] == ["locked: nothing allocated", "bytes allocated: 0"]


@pytest.mark.parametrize("waste", ["float", "list"])
def test_an_allocation_in_the_tick_is_caught(portable, micropython_runtime, waste):
    locked, counted = portable(micropython_runtime, "filter_alloc.py", waste).split("\n")[:2]
    assert locked == "locked: MemoryError"
    assert int(counted.split(": ")[1]) >= 8000


def hashed(filter_history, rendered, name):
    """Of the whole history of a filter's state, the words by their names: their order may change."""
    assert name in STATES, "say in STATES which table of words.py it has"
    table = words.STATES[STATES[name]]
    at = [table[word].at + i for word in sorted(table) for i in range(table[word].length)]
    got = filter_history(quickest(), rendered, name, words=at, mag_every=3)
    return f"{zlib.crc32(got.q29.tobytes() + got.words.tobytes()):08x}"


@pytest.mark.parametrize("name", SOFTWARE)
def test_every_word_of_its_state_is_what_it_has_been(filter_history, name):
    """RECORD=1 writes the hashes anew: after a change that is meant to change what a filter computes."""
    if quickest() == "cpython":
        pytest.skip("needs a MicroPython")
    known = json.loads(RECORD.read_text())
    found = {}
    for motion in ("hand", "bursts", "demo"):
        rendered = motions.render(motion, rate=(200, 1), seconds=8, accel_range_g=16, seed=3)
        found[motion] = hashed(filter_history, rendered, name)
    for beginning in ("broad_28", "tyrex_nexus5_Thibaud"):
        for path in recorded_trials(beginning):
            trial = trials.load(path)
            trial.counts = trial.counts[3000:5000]
            found[beginning] = hashed(filter_history, trial, name)
    if os.environ.get("RECORD"):
        known[name] = known.get(name, {}) | found
        RECORD.write_text(json.dumps(known, indent=1) + "\n")
    assert name in known, "a new filter: run this test once with RECORD=1 in the environment"
    assert {what: known[name][what] for what in found} == found
