"""What both filters that average in the earth frame do: their shared kernels, start and recovery, what they refuse."""

import math
import random
import re
from array import array

import motions
import numpy as np
import pytest
import test_inertial
import test_quaternion_kalman
import translate
from histories import ONE, SCALE, SCALES, angles_between
from samples import SOFTWARE, Scales, counts, run
from scenes import PACES, all_axes, as_start, errors, pushes, scene
from upright import earth_kernels, filters
from upright.inertial import Inertial9
from upright.quaternion_kalman import QuaternionKalman9
from upright_host import words
from upright_host.simulate import best_runtime as quickest

AT = words.places("inertial")
STILL = 1  # of DECIDED, in both
KINDS = {"inertial": Inertial9, "quaternion-kalman": QuaternionKalman9}
TWINS = {"inertial": test_inertial, "quaternion-kalman": test_quaternion_kalman}
LARGEST_BIAS = {"inertial": {"bias_limit_dps": 25}, "quaternion-kalman": {"bias_start": 10}}


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def history(filter_history, kind):
    """history(rendered, axes, **options) -> History of all its rows, with `decided`."""

    def run(rendered, axes=9, **options):
        options["words"] = [words.places(kind.replace("-", "_")).DECIDED]
        got = filter_history(quickest(), rendered, f"{kind}{axes}", **options)
        got.decided = got.words[:, 0]
        return got

    return run


# -- parameters at their limits
@pytest.mark.skipif(not translate.GCC, reason=translate.NO_GCC)
def test_no_parameter_at_its_limit_shifts_by_a_negative_count_or_leaves_32_bits(kind):
    rng = np.random.default_rng(5)
    rows = rng.integers(-32768, 32768, (400, 11)).astype(np.int16)
    rows[200:, :9] = (3, -4, 64, 9, -7, 5, 60, 10, -150)  # at rest
    rows[:, 10] = 3
    limits = {name: limits[1:] for name, limits in KINDS[kind].PARAMETERS.items()}
    for name in limits:
        for value in (*limits[name], *((0.000001,) if limits[name][0] == 0 else ())):
            given = {name: value}
            if name == "bias_start" and value < 1:  # which must be 20 times this
                given["bias_walk"] = value / 20
            elif kind != "inertial" and name == "bias_walk" and value:
                given["bias_start"] = max(0.5, 20 * value)
            for rate, fsr, lsb in ((50, 250, 64), (100, 2000, 2048), (1439, 250, 32767)):
                run = translate.make(f"{kind}9", (rate, 1), SCALES[fsr], lsb, **given)
                run.run(rows, every=0)
                found = [str(place) for place in run.overflows()]
                assert not found, (given, rate, fsr, lsb)


def test_a_magnetometer_at_full_scale_is_no_heading_to_start_with():
    for name in SOFTWARE:
        filter = filters.make(name, 200, Scales, {})
        for axis in range(3):
            for value in (32767, -32768):
                row = counts(flags=3)
                row[6 + axis] = value
                assert filter.seed(row)
                assert yaw_of(filter) == 0, (name, axis, value)


def yaw_of(filter):
    out = array("i", [0] * 3)
    filter.angles(out)
    return out[2]


# -- the kernels
def new_state():
    s = array("i", [0] * AT.size)
    s[AT.PROBE] = -1
    return s


def test_the_rows_and_the_force_are_those_of_the_attitude():
    rng = np.random.default_rng(1)
    for _ in range(200):
        q = rng.standard_normal(4)
        q /= np.linalg.norm(q)
        s = new_state()
        s[AT.NINE] = 1
        s[AT.Q : AT.Q + 4] = array("i", [round(v * ONE) for v in q])
        accel, mag = rng.integers(-32766, 32767, 3), rng.integers(-32766, 32767, 3)
        counts = array("h", [*accel.tolist(), 0, 0, 0, *mag.tolist(), 0, 3])
        earth_kernels.to_earth(s, counts)
        rows = motions._matrix(q[None])[0]
        assert np.abs(np.array(s[AT.R : AT.R + 9]).reshape(3, 3) / 32768 - rows).max() < 1e-4
        earth_kernels.to_earth(s, counts)  # they are summed over the block
        assert np.abs(np.array(s[AT.FS : AT.FS + 3]) / 512 - 2 * rows @ accel).max() < 12
        assert s[AT.MN] == 2
        assert np.abs(np.array(s[AT.MS : AT.MS + 3]) / 512 - 2 * rows @ mag).max() < 12


def test_the_heading_is_the_arc_tangent_of_the_mean_field():
    rng = random.Random(2)
    for _ in range(300):
        n = rng.randint(1, 32)
        field = [rng.randint(-20000, 20000) for _ in range(3)]
        s = new_state()
        s[AT.MS : AT.MN + 1] = array("i", [v * n << 9 for v in field] + [n])
        s[AT.SINCE] = 3
        earth_kernels.compass(s, AT.MS, round(math.pi * 2**28))
        north, west, up = field
        off = s[AT.HEADING] / 2**28 - math.atan2(-west, north)
        assert abs(math.remainder(off, 2 * math.pi)) < 3e-6 + 1e-4 / max(math.hypot(north, west), 1)
        across = math.hypot(north, west)
        assert s[AT.NOW] / 2**13 == pytest.approx(across, rel=1e-4, abs=0.01)
        assert s[AT.NOW + 1] / 2**13 == up
        assert (s[AT.J], s[AT.SINCE]) == (4, 0)
        assert list(s[AT.MS : AT.MN + 1]) == [0] * 4
    earth_kernels.compass(s, AT.MS, round(math.pi * 2**28))
    assert (s[AT.J], s[AT.SINCE]) == (0, 1)  # no sample, no heading


def test_the_low_passes_take_the_mean_first_and_then_a_quarter_of_a_second():
    s = new_state()
    s[AT.REST_K] = 4096
    low1, low2 = np.zeros(6), np.zeros(6)
    rng = np.random.default_rng(3)
    for k in range(1, 40):
        now = rng.integers(-2000, 2000, 6)
        s[AT.IN : AT.IN + 6] = array("i", (now << 12).tolist())
        earth_kernels.low_pass(s, AT.IN + 3)
        gain = max(1 / k, 1 / 8)
        low1 += gain * (now - low1)
        low2 += gain * (low1 - low2)
        assert np.abs(np.array(s[AT.LOW2 : AT.LOW2 + 6]) / 4096 - low2).max() < 0.5
        away = np.minimum(np.abs(now - low2), 2048) ** 2
        expected = [away[:3].sum() * 64, away[3:].sum() * 64]
        assert list(s[AT.AWAY : AT.AWAY + 2]) == pytest.approx(expected, rel=0.01)


# -- start and recovery
@pytest.mark.parametrize("rate, mag_every", [*PACES, (1000, 10)])
@pytest.mark.parametrize("degrees", [90, 150, 170])
def test_a_wrong_start_is_level_within_half_a_second(history, rate, mag_every, degrees):
    rendered = scene(rate, 4, bias_dps=(0, 0, 0), mag_every=mag_every)
    for axis in ((1, 0, 0), (0, 1, 0), (-0.5, 0.5, 0.7)):
        got = history(rendered, start=as_start(axis, degrees))
        inclination, heading = errors(got.q, rendered)
        assert inclination[int(0.5 * rate) :].max() < 2, axis
        assert abs(heading[-1]) < 8, axis
        assert inclination[0] > 20  # it was wrong


@pytest.mark.parametrize("rate, mag_every", PACES)
def test_a_bias_at_rest_is_found_within_three_seconds(history, rate, mag_every):
    bias = (5, -5, 5)
    got = history(scene(rate, 3, bias_dps=bias, mag_every=mag_every))
    assert np.abs(got.bias_dps[-1] - bias).max() < 0.1
    assert np.abs(got.bias_dps[rate] - bias).max() > 1  # and after one it was not known


@pytest.mark.parametrize("rate, mag_every", PACES)
@pytest.mark.parametrize("axes", [9, 6])
def test_a_bias_is_found_while_everything_turns_from_the_first_second(
    history, kind, rate, mag_every, axes
):
    bias = (4, -4, 4)
    got = history(scene(rate, 60, all_axes, pushes, bias, mag_every=mag_every), axes)
    off = np.abs(got.bias_dps[-1] - bias).max()
    assert off < {"inertial": 1, "quaternion-kalman": 0.2}[kind]
    assert not (got.decided[5 * rate :] & STILL).all()


@pytest.mark.slow
@pytest.mark.parametrize("rate, mag_every", PACES)
@pytest.mark.parametrize(
    "kick", [(90, 0, 0), (0, -90, 0), (0, 0, 90), (0, 0, -40), (52, 52, 52)], ids=str
)
def test_a_kick_at_rest_is_forgotten(history, kind, rate, mag_every, kick):
    rendered = scene(rate, 50, kick=(25, kick), mag_every=mag_every)
    got = history(rendered)
    inclination, heading = errors(got.q, rendered)
    at = 25 * rate
    assert max(inclination[at + 1], abs(heading[at + 1])) > 35  # it was one
    assert inclination[at + 4 * rate :].max() < 3
    # a long disagreement restarts the heading, not a short one: the gyro of inertial has seen nothing of a turn
    late = 20 if kind == "inertial" else 10
    assert np.abs(heading[at + late * rate :]).max() < 5
    assert np.abs(got.bias_dps[-1] - (1.2, -0.8, 0.6)).max() < 0.1


def test_swings_cancel_before_they_count_as_tilt(history):
    """0.5 g to and fro at 1.5 Hz, no rotation: the classic filter would follow by degrees."""

    def swing(t):
        return np.outer(np.sin(2 * np.pi * 1.5 * t) * (t > 10), (0.5, 0, 0))

    rendered = scene(200, 30, accel=swing)
    inclination, _ = errors(history(rendered).q, rendered)
    assert inclination[10 * 200 :].max() < 1.2


@pytest.mark.parametrize("range_g, rate", [(8, 200), (16, 1000), (4, 90)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_axis_that_stays_at_full_scale_is_no_gravity(history, range_g, rate, axis):
    rendered = scene(rate, 12, all_axes, range_g=range_g)
    broken = scene(rate, 12, all_axes, range_g=range_g)
    first, last = 8 * rate, 8 * rate + rate // 2
    broken.counts[first:last, axis] = 32767
    broken.counts[first:last, 10] |= 4
    usual, _ = errors(history(rendered).q, rendered)
    tilt, _ = errors(history(broken).q, rendered)
    assert np.abs(tilt - usual)[first:].max() < 0.7


@pytest.mark.parametrize("range_g, g, hz", [(2, 2, 5), (2, 2, 1.5), (8, 10, 3), (8, 15, 8)])
def test_a_shake_beyond_full_scale_cancels_as_a_shake_within_it(history, kind, range_g, g, hz):
    """Left out, what is cut off would tilt by up to 70 deg: the rest of the shake shows the opposite."""

    def shake(t):
        return np.outer(np.sin(2 * np.pi * hz * t) * (t > 5), np.array((0.5, 0.33, 0.83)) * g)

    rendered = scene(200, 25, all_axes, shake, range_g=range_g)
    assert (rendered.counts[:, 10] & 4 > 0).mean() > 0.1
    tilt, _ = errors(history(rendered).q, rendered)
    assert tilt[2000:].max() < (14 if hz == 8 else 3) * (1 if kind == "inertial" else 2)


def test_with_an_axis_at_full_scale_the_kernel_agrees_with_the_twin(history, kind):
    rng = np.random.default_rng(3)
    rendered = scene(200, 10, all_axes, range_g=2)
    for first in rng.integers(200, 1900, 25):
        n = int(rng.choice([1, 5, 40, 110, 150]))  # 102 are 0.5 s
        axis, word = int(rng.integers(3)), int(rng.choice([32767, -32768]))
        rendered.counts[first : first + n, axis] = word
        rendered.counts[first : first + n, 10] |= 4
    done = history(rendered)
    twin, _ = TWINS[kind].twin_history(rendered, done.decided)
    assert angles_between(done.q, twin).max() < 0.3


def test_a_turntable_from_power_on_is_taken_for_a_bias(history):
    """The known limit."""
    rendered = scene(200, 20, lambda t: np.outer(t >= 0, (0, 0, 3.0)), bias_dps=(0, 0, 0))
    assert history(rendered, 6).bias_dps[-1, 2] == pytest.approx(3, abs=0.1)


@pytest.mark.parametrize("rest", [5, 10, 30])
def test_a_turntable_after_a_rest_is_when_it_has_lasted_as_long_and_never_with_nine_axes(
    filter_history, rest
):
    """12 s at most: six axes cannot tell it from a bias that has changed."""

    def bias(name, seconds):
        rendered = scene(
            200, seconds, lambda t: np.outer(t > rest, (0, 0, 3.0)), bias_dps=(0, 0, 0)
        )
        return filter_history(quickest(), rendered, name).bias_dps[:, 2]

    waited = min(rest, 12)
    six = bias("inertial6", rest + waited + 5)
    assert np.abs(six[: int(200 * (rest + 0.6 * waited))]).max() < 0.2
    assert six[-1] == pytest.approx(3, abs=0.1)
    assert np.abs(bias("inertial9", rest + 60)).max() < 0.2


@pytest.mark.skipif(not translate.GCC, reason=translate.NO_GCC)
@pytest.mark.parametrize("rate, mag_every", PACES)
@pytest.mark.parametrize("dps", [0.5, 1, 2, 3])
def test_a_magnetometer_tells_minutes_of_a_turntable_from_a_bias(rate, mag_every, dps):
    """A wait follows the other, and the noise of none may decide."""
    rendered = scene(rate, 310, lambda t: np.outer(t > 10, (0, 0, dps)), mag_every=mag_every)
    run = translate.make("inertial9", rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g)
    run.filter.seed(array("h", rendered.counts[0].tolist()))
    _, heading = errors(run.attitudes(rendered.counts), rendered)
    assert np.abs(heading[10 * rate :]).max() < 1.5


@pytest.mark.parametrize("known_s, most_deg", [(100, 2), (10, 8)])
def test_a_bias_that_is_known_from_the_start_keeps_the_yaw_of_six_axes(
    filter_history, known_s, most_deg
):
    """Set to 0.05 deg/s, as a measurement is; the body turns on all axes from the first second on and never rests."""
    rendered = scene(200, 60, all_axes, pushes, (2, -3, 2.5))
    bias = [round((b + 0.05) * 16.4 * 256) for b in (2, -3, 2.5)]

    def drift(*known):
        got = filter_history(quickest(), rendered, "inertial6", bias=[*bias, *known])
        _, heading = errors(got.q, rendered)
        return np.abs(heading - heading[0]).max()

    drifts = drift(known_s), drift()
    print(drifts)
    assert drifts[0] < min(most_deg, drifts[1] / 2)


def test_no_constant_shrinks_with_the_rate(history, kind):
    """The same 40 s at 90 and at 1000 Hz: the same errors, the same bias, at the same times."""
    bias = (2, -3, 1)
    found = {}
    for rate in (90, 1000):
        got = history(scene(rate, 40, all_axes, pushes, bias))
        found[rate] = got.bias_dps[10 * rate :: 10 * rate] - bias
    apart = np.abs(found[90] - found[1000]).max()
    assert apart < {"inertial": 0.15, "quaternion-kalman": 0.2}[kind]
    if kind == "inertial":
        assert np.abs(found[1000][0]).max() > 0.3  # it was not there yet


# -- interface
def test_it_coasts_on_the_last_gyro_words_without_feedback(kind):
    filter = KINDS[kind](200, SCALE, 4096)
    run(filter, counts(flags=3), 200 * 4)
    before = list(filter.state)
    run(filter, counts(4096, 0, 0, gz=820, mx=-66, flags=2), 200)  # they disagree
    out = array("i", [0] * 3)
    filter.angles(out)
    assert list(out) == pytest.approx([0, 0, 50000], abs=30)
    # nothing but the attitude and its remainders has changed, and the time since the last sample
    at = words.places(kind.replace("-", "_"))
    held = slice(at.G, at.GAP if kind == "inertial" else None)
    assert list(filter.state)[held] == before[held]


def test_what_it_says_of_itself(kind):
    filter = KINDS[kind](200, SCALE, 4096)
    inertial = kind == "inertial"
    assert (filter.resting, filter.mag_accepted) == (False, False)
    if inertial:
        assert filter.heading_uncertainty_mdeg == 180000
        assert filter.tilt_confidence == 1000
    row = counts(flags=3)
    filter.seed(row)
    run(filter, row, 200)
    assert not filter.resting
    run(filter, row, 400)
    assert filter.resting and filter.mag_accepted
    if inertial:
        assert filter.tilt_confidence > 990
        run(filter, row, 200 * 12)  # now the field is known
        assert filter.heading_uncertainty_mdeg < 6000
    run(filter, counts(mx=0, my=400, flags=3), 200)
    assert not filter.mag_accepted
    near = filter.heading_uncertainty_mdeg
    rng = random.Random(1)
    for _ in range(600):
        filter.update(counts(*(rng.randint(-9000, 9000) for _ in range(3)), gx=400, flags=1))
    assert not filter.resting and not filter.mag_accepted
    if inertial:
        assert filter.tilt_confidence < 400
        assert filter.heading_uncertainty_mdeg > near


# -- what is refused
@pytest.mark.parametrize("rate", [90, 100, (200, 1), (2000, 7), 500, 1000, (1000, 11)])
@pytest.mark.parametrize("fsr", [250, 500, 1000, 2000])
def test_every_rate_from_90_to_1000_hz_will_do(kind, rate, fsr):
    assert KINDS[kind](rate, SCALES[fsr], 2048, **LARGEST_BIAS[kind]).rate[0]


@pytest.mark.parametrize("rate", [19, 1440, 8000, 0, -200, (200, 0), 200.5, "200", None])
def test_a_rate_that_the_numbers_cannot_hold_is_refused(kind, rate):
    with pytest.raises(ValueError, match=r"rate is .*, expected"):
        KINDS[kind](rate, SCALES[250], 2048)


@pytest.mark.parametrize("fsr", [250, 500])
def test_a_loop_of_20_hz_will_do_for_inertial_at_500_deg_s(fsr):
    assert Inertial9(20, SCALES[fsr], 2048).rate == (20, 1)


def test_a_gyro_too_fine_for_the_rest_detector_is_refused(kind):
    with pytest.raises(ValueError, match="gyro_scale is 1000/1, too fine"):
        KINDS[kind](200, (1000, 1), 2048, rest_gyro_dps=10)


def test_a_step_that_could_turn_by_too_much_is_refused(kind):
    slow, least, most = {"inertial": (60, 60, 70), "quaternion-kalman": (50, 50, 60)}[kind]
    said = rf"rate is {slow} Hz, expected (\d+)..1439 Hz at 82/5"
    with pytest.raises(ValueError, match=said) as caught:
        KINDS[kind](slow, SCALE, 2048)
    low = int(re.search(said, str(caught.value)).group(1))
    assert KINDS[kind](low, SCALE, 2048) and least < low <= most
    with pytest.raises(ValueError):
        KINDS[kind](low - 1, SCALE, 2048)


@pytest.mark.parametrize(
    "name, parameters, said",
    [
        ("inertial", {"tau_fast": 0.1}, "tau_fast is 0.1, expected 0.5..30"),
        ("inertial", {"field_tolerance": 0.9}, "field_tolerance is 0.9"),
        ("inertial", {"bias_limit_dps": "6"}, "bias_limit_dps is '6', expected a number"),
        ("inertial", {"tau": 3}, "no parameter 'tau'; there are .*rest_after"),
        ("quaternion-kalman", {"gyro_noise": 0}, r"gyro_noise is 0, expected 0.001\.\.1"),
        ("quaternion-kalman", {"mag_noise": 0.3}, r"mag_noise is 0.3, expected 0.01\.\.0.2"),
        ("quaternion-kalman", {"bias_start": "6"}, "bias_start is '6', expected a number"),
        (
            "quaternion-kalman",
            {"bias_walk": 0.1, "bias_start": 1},
            "bias_walk is 0.1, expected no more than 1/20",
        ),
        ("quaternion-kalman", {"tau": 3}, "no parameter 'tau'; there are .*rest_after"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused(name, parameters, said):
    with pytest.raises((ValueError, TypeError), match=said):
        KINDS[name](200, SCALE, 2048, **parameters)
