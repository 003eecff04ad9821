"""The errors of the source texts, as docs/methods.md lists them: each wrong, each right, and what it costs.

The formulas are stated anew here, in Python floats. What a test measures it then looks up in the rows of both pages,
English and Chinese, so that no figure there can be another than the one measured.
"""

import functools
import math
import re

import motions
import numpy as np
import pytest
from reference import mahony_float
from reference.mahony_float import Mahony9Float, MahonyFloat, angle_between
from upright_host import paths

PAGES = [paths.ROOT / "docs" / name for name in ("methods.md", "methods.zh.md")]
DEGREE = math.pi / 180
UP = (0, 0, 4096)
GYRO = 5 / 82 * DEGREE  # rad/s per count at +-2000 deg/s


def stated(error, *figures):
    """The table row of this error says each of the figures, in both languages."""
    print(f"E{error}", *figures)
    for page in PAGES:
        (row,) = re.findall(rf"^\| E{error} \|.*", page.read_text("utf-8"), re.M)
        for figure in figures:
            number = rf"(?<![\d.]){re.escape(figure)}(?!\d|\.\d)"
            assert re.search(number, row), f"{page.name}, E{error}: {figure} measured"


# -- what is right, to compare with
def about(axis, degrees):
    q = [math.cos(degrees * DEGREE / 2), 0.0, 0.0, 0.0]
    q["xyz".index(axis) + 1] = math.sin(degrees * DEGREE / 2)
    return q


def product(*turns):
    w, x, y, z = turns[0]
    for a, b, c, d in turns[1:]:
        w, x, y, z = (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        )
    return [w, x, y, z]


def matrix(q):
    """Body to earth."""
    return motions._matrix(np.array([q], float))[0]


def zyx(q):
    """Roll, pitch, yaw in degrees."""
    r = matrix(q)
    pitch = math.asin(max(-1, min(1, -r[2, 0])))
    return [v / DEGREE for v in (math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0]))]


def zxy(q):
    """Roll (about y), pitch (about x), yaw in degrees."""
    r = matrix(q)
    pitch = math.asin(max(-1, min(1, r[2, 1])))
    return [
        v / DEGREE for v in (math.atan2(-r[2, 0], r[2, 2]), pitch, math.atan2(-r[0, 1], r[1, 1]))
    ]


def tilt(q, true=(1, 0, 0, 0)):
    """Degrees between up and what q takes for it."""
    return math.degrees(math.acos(max(-1, min(1, matrix(q)[2] @ matrix(true)[2]))))


def made(kind=MahonyFloat, rate=200, kp=0.5, ki=0.0, q=(1, 0, 0, 0), limit=math.inf, **options):
    """A filter with the right formulas (MahonyFloat), or one of the wrong ones that are derived from it here."""
    filter = kind(rate, GYRO, 16384, kp, ki, limit, **options)
    filter.q = list(q)
    return filter


def fed(filter, seconds, accel=UP, dps=(0, 0, 0), mag=(0, 0, 0), flags=1):
    """Give it the same sample for so long; gyro in deg/s, any fraction of a count."""
    row = [*accel, *(v * DEGREE / GYRO for v in dps), *mag, 0, flags]
    for _ in range(round(seconds / filter.dt)):
        filter.update(row)
    return filter


# -- the step
def drift(name, rate, **options):
    """The gyro alone, without errors, over 20 s of a motion: the largest error in degrees."""
    motion = motions.render(name, rate=rate, seconds=20, errors=None)
    filter = made(rate=rate, kp=0, q=motion.q_true[0], **options)
    worst = 0
    for row, true in zip(motion.counts.tolist(), motion.q_true, strict=True):
        filter.update(row)
        worst = max(worst, angle_between(filter.q, true))
    return worst


@pytest.mark.parametrize("name", ["hand", "bursts"])
def test_1_a_q0_that_has_already_changed_spoils_the_rest_of_the_step(name):
    """At 200 Hz, beside the same first order with all four components at once."""
    first = drift(name, 200, order=1)
    in_place = drift(name, 200, order=1, in_place=True)
    assert in_place > 5 * first
    stated(1, f"{first:.2f}", f"{in_place:.1f}")


@pytest.mark.parametrize("dps", [360, 2000])
def test_2_the_first_order_turns_too_little(dps):
    """One second at 200 Hz: d - atan(d) of every half angle d is lost."""
    lost = []
    for order in (1, mahony_float.EXACT):
        filter = fed(made(kp=0, order=order), 1, dps=(0, 0, dps))
        lost.append(angle_between(filter.q, about("z", dps)))
    assert lost[1] < 1e-9
    stated(2, f"{lost[0]:.2f}")


def test_coning_drifts_with_the_closed_form_too():
    """The section on Picard's series: what no order mends."""
    slow, quick = drift("coning", 200), drift("coning", 1000)
    for page in PAGES:
        text = page.read_text("utf-8")
        for figure in (f"{slow:.1f}", f"{quick:.2f}"):
            assert re.search(rf"(?<![\d.]){figure}( deg|°)", text), f"{page.name}: {figure}"


class Unnormalised(MahonyFloat):
    def normalise(self):
        pass

    def update(self, counts):
        x, y, z = (v * self.gyro * self.dt / 2 for v in counts[3:6])
        self.q = [a + b for a, b in zip(self.q, product(self.q, [0, x, y, z]), strict=True)]


def test_3_a_quaternion_that_is_not_normalised_grows():
    """Ten turns about z at 360 deg/s, held at 30 deg of pitch: the angles of the text from what has become of it."""
    start = about("y", 30)
    q = fed(made(Unnormalised, q=start), 10, dps=(0, 0, 360)).q
    length = math.hypot(*q)
    assert length == pytest.approx((1 + math.radians(0.9) ** 2) ** 1000)
    pitch = math.degrees(math.asin(2 * (q[0] * q[2] - q[1] * q[3])))
    right = fed(made(kp=0, q=start), 10, dps=(0, 0, 360)).q
    assert zyx(right)[1] == pytest.approx(30, abs=1e-6)
    stated(3, f"{length:.2f}", f"{pitch:.0f}", "30")


class WholeMilliseconds(MahonyFloat):
    """halfT from a clock that counts milliseconds; a step is still taken at every sample."""

    samples = 0

    def update(self, counts):
        step = self.dt
        self.samples += 1
        now = [math.floor(n * step * 1000 + 1e-9) for n in (self.samples - 1, self.samples)]
        self.dt = (now[1] - now[0]) / 1000
        super().update(counts)
        self.dt = step


def test_4_a_clock_of_whole_milliseconds_stretches_single_steps():
    """At 333 Hz a step is 3 or 4 ms, at 1500 Hz every third is none: 10 s of bursts of 1000 deg/s."""
    for rate in (333, 1500):
        motion = motions.render("bursts", rate=rate, seconds=10, errors=None)
        worst = []
        for kind in (WholeMilliseconds, MahonyFloat):
            filter = made(kind, rate=rate, kp=0, q=motion.q_true[0])
            worst.append(0)
            for row, true in zip(motion.counts.tolist(), motion.q_true, strict=True):
                filter.update(row)
                worst[-1] = max(worst[-1], angle_between(filter.q, true))
        assert worst[1] < 0.02
        stated(4, f"{worst[0]:.1f}", "0.02")


def test_5_the_first_step_is_as_long_as_the_board_has_been_on():
    """last_update = 0: 3 s after power-on, at 10 deg/s."""
    late = made(kp=0, rate=1 / 3)
    fed(late, 3, dps=(0, 0, 10))
    right = fed(made(kp=0), 1 / 200, dps=(0, 0, 10))
    stated(5, f"{zyx(late.q)[2]:.0f}")
    assert zyx(right.q)[2] == pytest.approx(0.05)


# -- the feedback
class ZeroSkips(MahonyFloat):
    def error(self, counts):
        e = super().error(counts)
        return e if e and e[0] != 0 and e[1] != 0 and e[2] != 0 else None


def test_6_one_component_of_exactly_zero_switches_the_feedback_off():
    """Wrong by 30 deg of roll and nothing else: ey = ez = 0."""
    wrong = fed(made(ZeroSkips, q=about("x", 30)), 10)
    right = fed(made(q=about("x", 30)), 10)
    stated(6, f"{tilt(wrong.q):.0f}", f"{tilt(right.q):.1f}")


class NoGate(MahonyFloat):
    """a / |a| whatever |a| is, as C does it."""

    def error(self, counts):
        a = np.array(counts[0:3], float)
        with np.errstate(invalid="ignore"):
            a = a / np.sqrt(a @ a)
        return tuple(np.cross(a, matrix(self.q)[2]))


def test_7_a_length_of_zero_is_a_nan_for_ever():
    wrong, right = made(NoGate), made()
    for filter in (wrong, right):
        fed(filter, 1 / 200, accel=(0, 0, 0))
        fed(filter, 5)
    assert all(math.isnan(v) for v in wrong.q)
    assert tilt(right.q) < 1e-9


def test_7_in_free_fall_what_is_left_of_the_accelerometer_is_taken_for_up():
    """Half a second, and 20 mg of offset on x."""
    fall = (82, 0, 0)
    wrong = fed(made(NoGate), 0.5, accel=fall)
    assert tilt(fed(made(), 0.5, accel=fall).q) == 0
    stated(7, f"{tilt(wrong.q):.0f}")


class Returns(MahonyFloat):
    """if (norm == 0) return: before the gyro has been integrated."""

    def update(self, counts):
        if any(counts[0:3]):
            super().update(counts)


def test_8_to_return_at_a_length_of_zero_loses_the_gyro_as_well():
    fall = {"accel": (0, 0, 0), "dps": (0, 0, 360)}
    wrong, right = fed(made(Returns), 0.3, **fall), fed(made(), 0.3, **fall)
    assert zyx(right.q)[2] == pytest.approx(108)
    stated(8, f"{angle_between(wrong.q, right.q):.0f}")


def test_9_a_sample_that_is_not_fresh_pulls_at_the_attitude():
    """The bus fails for 2 s in a roll of 60 deg/s: the last words stand still, accelerometer and gyro."""
    wrong = fed(made(), 2, dps=(60, 0, 0))
    right = fed(made(), 2, dps=(60, 0, 0), flags=0)
    assert angle_between(right.q, about("x", 120)) < 1e-6
    stated(9, f"{angle_between(wrong.q, right.q):.0f}")


def test_10_a_magnetometer_that_has_stopped_turns_with_the_body():
    """The field's words freeze at north; the body turns by 90 deg and rests for a minute. Dip 66 deg."""
    field = tuple(round(160 * v) for v in (math.cos(66 * DEGREE), 0, -math.sin(66 * DEGREE)))
    heading = []
    for flags in (3, 1):
        filter = made(Mahony9Float)
        fed(filter, 1, dps=(0, 0, 90), mag=field, flags=flags)
        fed(filter, 60, mag=field, flags=flags)
        heading.append(zyx(filter.q)[2])
    assert heading[1] == pytest.approx(90)
    stated(10, f"{90 - heading[0]:.0f}")


class ThirdColumn(MahonyFloat):
    def error(self, counts):
        a = np.array(counts[0:3]) / np.linalg.norm(counts[0:3])
        return tuple(np.cross(a, matrix(self.q)[:, 2]))


def test_11_the_third_column_in_place_of_the_third_row_drives_the_attitude_away():
    """A degree wrong at the start: the feedback has the wrong sign, and upside down is where it comes to rest."""
    wrong = fed(made(ThirdColumn, q=about("x", 1)), 30)
    right = fed(made(q=about("x", 1)), 30)
    assert tilt(right.q) < 1e-5
    assert tilt(wrong.q) > 179.9
    stated(11, "180")


class TooLate(MahonyFloat):
    """Turns first, then adds the feedback to a rate that nobody uses any more."""

    def update(self, counts):
        super().update([*counts[0:10], 0])


def test_12_a_correction_that_comes_after_the_step_corrects_nothing():
    wrong = fed(made(TooLate, q=about("x", 30)), 60)
    right = fed(made(q=about("x", 30)), 60)
    assert tilt(right.q) < 1e-5
    stated(12, f"{tilt(wrong.q):.0f}")


@pytest.mark.parametrize("rate", [100, 1000])
def test_13_an_integral_without_the_time_depends_on_the_rate(rate):
    """A constant error of 0.1 for 1 s; exInt += ex Ki with Ki = 0.001, which at 100 Hz is ki = 0.1 rad/s^2."""
    without = sum(0.1 * 0.001 for _ in range(rate))
    right = sum(0.1 * 0.1 / rate for _ in range(rate))
    assert right == pytest.approx(0.01)
    assert without / right == pytest.approx(rate / 100)
    with_half = sum(0.1 * 0.1 / (2 * rate) for _ in range(rate))
    assert with_half / right == pytest.approx(1 / 2)
    stated(13, "10", "2")


def test_14_an_integral_without_a_limit_winds_up():
    """A start that is 170 deg wrong; kp 2, ki 1 (Ki = 0.005 a sample at 200 Hz)."""
    overshoot, most = [], []
    for limit in (math.inf, 20 * DEGREE):
        filter = made(kp=2, ki=1, q=about("x", 170), limit=limit)
        lean, peak = [], 0
        for _ in range(100):
            fed(filter, 0.1)
            lean.append(zyx(filter.q)[0])
            peak = max(peak, abs(filter.integral[0]))
        overshoot.append(-min(lean))
        most.append(math.degrees(peak))
    stated(14, f"{most[0]:.0f}", f"{overshoot[0]:.0f}", f"{most[1]:.0f}", f"{overshoot[1]:.0f}")


def test_15_a_quaternion_of_zero_never_becomes_an_attitude():
    filter = made(q=(0, 0, 0, 0))
    with pytest.raises(ZeroDivisionError):
        filter.update([*UP, 100, 200, 300, 0, 0, 0, 0, 1])
    step = product([0, 0, 0, 0], [1, 0.1, 0.2, 0.3])
    assert step == [0, 0, 0, 0]


def test_16_a_start_at_the_identity_takes_its_time():
    """A board that lies 60 deg over: until it is right to 1 deg."""
    true = about("x", 60)
    up = [round(4096 * v) for v in matrix(true)[2]]
    filter = made()
    n = 0
    while tilt(filter.q, true) > 1:
        fed(filter, 1 / 200, accel=up)
        n += 1
    stated(16, f"{n / 200:.1f}")


def test_17_the_cross_product_is_the_sine_of_the_error_across_gravity():
    for degrees in (1, 90, 179, 180):
        e = made(q=about("x", degrees)).error([*UP, 0, 0, 0, 0, 0, 0, 0, 1])
        assert math.hypot(*e) == pytest.approx(math.sin(degrees * DEGREE), abs=1e-12)
    turned = made(q=about("z", 90)).error([*UP, 0, 0, 0, 0, 0, 0, 0, 1])
    assert math.hypot(*turned) < 1e-12
    assert tilt(fed(made(q=about("x", 180)), 10).q) > 179.9


def test_18_the_proportional_part_does_not_correct_the_bias():
    """1 deg/s about x: b / kp is what is left, and an integral takes it away."""
    left = fed(made(), 60, dps=(1, 0, 0))
    gone = fed(made(ki=0.05), 120, dps=(1, 0, 0))
    assert tilt(gone.q) < 0.01
    stated(18, f"{tilt(left.q):.1f}")


# -- matrices and angles
def test_19_w_is_not_the_angle():
    w = about("z", 90)[0]
    assert 2 * math.degrees(math.acos(w)) == pytest.approx(90)
    stated(19, f"{w:.3f}")


def frame_z(degrees, sign=1):
    """C that takes earth components to those of a frame turned about z; sign -1: as the text has it."""
    c, s = math.cos(degrees * DEGREE), sign * math.sin(degrees * DEGREE)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def frame_x(degrees):
    c, s = math.cos(degrees * DEGREE), math.sin(degrees * DEGREE)
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def frame_y(degrees):
    c, s = math.cos(degrees * DEGREE), math.sin(degrees * DEGREE)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def apart(a, b):
    """Degrees between two rotation matrices."""
    return math.degrees(math.acos(max(-1, min(1, (np.trace(a.T @ b) - 1) / 2))))


def test_20_the_turn_about_z_has_the_other_sign_than_those_about_x_and_y():
    roll, pitch, yaw = 10, 20, 30
    right = frame_y(roll) @ frame_x(pitch) @ frame_z(yaw)
    q = product(about("z", yaw), about("x", pitch), about("y", roll))
    assert apart(right, matrix(q).T) < 1e-6
    wrong = frame_y(roll) @ frame_x(pitch) @ frame_z(yaw, -1)
    stated(20, f"{apart(right, wrong):.0f}")


def test_21_the_matrix_that_is_called_earth_to_body_is_body_to_earth():
    q = about("z", 30)
    w, x, y, z = q
    printed = np.array(
        [
            [x * x + w * w - z * z - y * y, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), y * y - z * z + w * w - x * x, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), z * z - y * y - x * x + w * w],
        ]
    )
    assert apart(printed, matrix(q)) < 1e-6
    stated(21, f"{apart(printed, frame_z(30)):.0f}")


def rates_right(roll, pitch, w):
    """d(roll, pitch, yaw)/dt of zyx."""
    p, q, r = w
    turn = q * math.sin(roll) + r * math.cos(roll)
    return np.array(
        [
            p + math.tan(pitch) * turn,
            q * math.cos(roll) - r * math.sin(roll),
            turn / math.cos(pitch),
        ]
    )


def rates_printed(roll, pitch, w, inverse=True, extra=True):
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    m = np.array(
        [[cp, sr * sp, cr * sp], [0, cp * cr, -sr * cp], [0, sr, cr * cp if extra else cr]]
    )
    return (np.linalg.inv(m) if inverse else m) @ w / cp


def rates_zxy(roll, pitch, w):
    """The same for the text's own matrix: pitch about x, roll about y."""
    p, q, r = w
    turn = r * math.cos(roll) - p * math.sin(roll)
    return np.array(
        [
            q - math.tan(pitch) * turn,
            p * math.cos(roll) + r * math.sin(roll),
            turn / math.cos(pitch),
        ]
    )


def off_after(rates, order):
    """Degrees off after 1 s at 30 deg/s about each axis, from roll 30, pitch 40; order: pitch's axis, then roll's."""
    of_pitch, of_roll = order
    w = np.full(3, 30 * DEGREE)
    start = product(about(of_pitch, 40), about(of_roll, 30))
    true = fed(made(kp=0, q=start), 1, dps=(30, 30, 30)).q
    angles = np.array([30, 40, 0]) * DEGREE
    for _ in range(2000):
        middle = angles + rates(angles[0], angles[1], w) / 4000
        angles = angles + rates(middle[0], middle[1], w) / 2000
    roll, pitch, yaw = angles / DEGREE
    return angle_between(
        product(about("z", yaw), about(of_pitch, pitch), about(of_roll, roll)), true
    )


def test_22_the_kinematics_have_an_inverse_and_a_cosine_too_many():
    """From roll 30, pitch 40 for 1 s at 30 deg/s about each axis."""
    assert off_after(rates_right, "yx") < 1e-3
    w = np.full(3, 30 * DEGREE)
    same = rates_printed(0.3, 0.4, w, inverse=False, extra=False)
    assert same == pytest.approx(rates_right(0.3, 0.4, w))
    without_inverse = functools.partial(rates_printed, inverse=False)
    stated(22, f"{off_after(rates_printed, 'yx'):.0f}", f"{off_after(without_inverse, 'yx'):.0f}")


def test_23_matrix_and_kinematics_are_of_two_orders():
    """The kinematics that go with the text's matrix are others: the same second with those of zyx in the order zxy."""
    assert off_after(rates_zxy, "xy") < 1e-3
    stated(23, f"{off_after(rates_right, 'xy'):.0f}")


def test_24_the_same_angles_in_another_order_are_another_attitude():
    q = product(about("z", 50), about("y", 40), about("x", 30))
    roll, pitch, yaw = zxy(q)
    assert zyx(q) == pytest.approx([30, 40, 50])
    other = product(about("z", 50), about("x", 40), about("y", 30))
    stated(24, f"{roll:.0f}", f"{pitch:.0f}", f"{yaw:.0f}", f"{angle_between(q, other):.0f}")


def test_25_roll_and_pitch_have_changed_places():
    w, x, y, z = about("x", 30)
    roll = math.degrees(math.asin(2 * (w * y - x * z)))
    pitch = math.degrees(math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y)))
    assert (roll, pitch) == (pytest.approx(0), pytest.approx(30))
    w, x, y, z = about("x", 150)
    assert math.degrees(math.asin(2 * (w * y - x * z))) == pytest.approx(0)
    assert zyx(about("x", 150))[0] == pytest.approx(150)
    stated(25, "30")


def test_26_a_yaw_of_the_opposite_sign():
    w, x, y, z = about("z", 30)
    yaw = math.degrees(math.atan2(2 * (x * y - w * z), w * w - x * x + y * y - z * z))
    assert zxy(about("z", 30))[2] == pytest.approx(30)
    stated(26, f"{-yaw:.0f}")


def test_27_counts_added_up_are_no_yaw():
    """90 deg/s for 1 s at 200 Hz: yaw += 2 gz / scale."""
    counts, scale = 90 * 16.4, 16.4
    yaw = sum(2 * counts / scale for _ in range(200))
    assert yaw == pytest.approx(36000)
    assert sum(counts / scale / 200 for _ in range(200)) == pytest.approx(90)
    # and the body's z axis does not turn as fast as the heading: once round, held at 30 deg of pitch
    body_z = 360 * matrix(about("y", 30))[2, 2]
    stated(27, "36000", f"{360 - body_z:.0f}")


def test_28_57_3_degrees_are_no_radian():
    assert math.pi * math.degrees(1) == pytest.approx(180)
    stated(28, f"{math.pi * 57.3 - 180:.3f}")


def test_29_an_arcsine_of_more_than_one_is_a_nan():
    """Normalised quaternions of single precision at 90 deg of pitch, of all headings."""
    beyond = 0
    for heading in range(1000):
        q = np.array(product(about("z", heading * 0.36), about("y", 90)), np.float32)
        q = q / np.sqrt((q * q).sum())
        w, x, y, z = q
        beyond += np.float32(2) * (w * y - x * z) > 1
    stated(29, f"{beyond / 10:.0f}")


def test_30_products_from_before_the_step_show_the_attitude_before_it():
    late = 360 / 200
    before = fed(made(kp=0), 0.5, dps=(0, 0, 360)).q
    after = fed(made(kp=0, q=before), 1 / 200, dps=(0, 0, 360)).q
    assert angle_between(before, after) == pytest.approx(late)
    stated(30, f"{late:.1f}")


def test_31_bx_is_no_heading():
    """The horizontal part of the field, level, dip 66 deg: the same at every heading."""
    field = np.array([math.cos(66 * DEGREE), 0, -math.sin(66 * DEGREE)])
    seen = set()
    for heading in range(0, 360, 15):
        m = matrix(about("z", heading)).T @ field
        hx, hy, _ = matrix(about("z", heading)) @ m
        seen.add(f"{math.hypot(hx, hy):.2f}")
    assert len(seen) == 1
    stated(31, *seen)


# -- counts
def test_32_integers_divide_to_nothing():
    for count in (-32768 + 1, -2048, 2048, 32767):
        assert int(count / 32768) * 16 == 0  # C cuts towards 0
    assert 2048 / 32768 * 16 == 1


def test_33_32768_over_the_range_is_not_the_sensitivity():
    """RM and PS give 16.4 LSB per deg/s at +-2000 deg/s: one turn."""
    turn = 360 * 16.4 / 32768 * 2000
    stated(33, f"{turn - 360:.2f}")


# -- the scalar Kalman filter
class Scalar:
    """x, P; the five equations with F = H = 1."""

    def __init__(self, x, q, r):
        self.x, self.p, self.q, self.r = x, r, q, r

    def update(self, z, wrap=False):
        p = self.p + self.q
        self.k = p / (p + self.r)
        e = z - self.x
        if wrap:
            e = (e + 180) % 360 - 180
        self.x += self.k * e
        if wrap:
            self.x = (self.x + 180) % 360 - 180
        self.p = (1 - self.k) * p
        return self.x


def settled(q, r):
    filter = Scalar(0, q, r)
    gain = 1.0  # K = P / R, and P starts at R
    for _ in range(1000):
        filter.update(0)
        gain = (gain + q / r) / (gain + q / r + 1)
        assert filter.k == pytest.approx(gain)
        assert filter.p == pytest.approx(gain * r)
    rho = q / r
    assert gain == pytest.approx((math.sqrt(rho * rho + 4 * rho) - rho) / 2)
    return gain


def test_34_ten_and_a_twentieth_filter_hardly_at_all():
    stated(34, f"{settled(10, 0.05):.3f}")


def test_35_a_smaller_r_makes_the_gain_larger_and_only_the_ratio_counts():
    assert settled(10, 0.05) == pytest.approx(settled(1, 0.005))
    assert settled(0.01, 0.05) < settled(0.01, 0.005)
    stated(35, f"{settled(0.01, 5):.3f}", f"{settled(0.01, 0.5):.2f}", f"{settled(0.01, 0.05):.2f}")


def test_36_no_r_makes_it_overshoot():
    for r in (1e-6, 1e-3, 0.05, 1, 100):
        filter = Scalar(0, 0.1, r)
        steps = [filter.update(1) for _ in range(200)]
        assert all(0 < v <= 1 for v in steps)
        assert steps == sorted(steps)


def test_37_what_is_filtered_settles_no_sooner_than_what_is_not():
    """An attitude that comes back from 30 deg with the time constant 2 s, at 200 Hz, K = 0.1."""
    filter = Scalar(30, 0.1**2 / 0.9, 1)
    raw, late = [], []
    for n in range(4000):
        raw.append(30 * math.exp(-n / 400))
        late.append(filter.update(raw[-1]))
    assert all(a >= b for a, b in zip(late, raw, strict=True))
    within = [sum(v > 1 for v in values) for values in (raw, late)]
    stated(37, f"{(within[1] - within[0]) * 5:.0f}")


def three(q, r, angles, separate):
    filters = [Scalar(0, q, r) for _ in angles]
    if not separate:
        filters = [filters[0]] * 3
    for _ in range(500):
        out = [f.update(z) for f, z in zip(filters, angles, strict=True)]
    return out


def test_38_one_state_for_three_angles_mixes_them():
    """Pitch 0, roll 0, yaw 90, filtered in turn; Q/R = 200 as in the text, and what makes K 0.1."""
    for ratio in (200, 0.1**2 / 0.9):
        assert three(ratio, 1, (0, 0, 90), True) == pytest.approx([0, 0, 90], abs=1e-6)
    pitch, _, _ = three(200, 1, (0, 0, 90), False)
    slow_pitch, _, slow_yaw = three(0.1**2 / 0.9, 1, (0, 0, 90), False)
    stated(38, f"{pitch:.2f}", f"{slow_pitch:.0f}", f"{slow_yaw:.0f}")


def test_39_an_angle_that_wraps_drags_the_filter_through_the_other_side():
    """Yaw turns at 90 deg/s through 180, 200 Hz."""
    worst = []
    for ratio in (200, 0.1**2 / 0.9):
        for wrap in (False, True):
            filter = Scalar(170, ratio, 1)
            worst.append(0)
            for n in range(200):
                z = (170 + 0.45 * n + 180) % 360 - 180
                e = filter.update(z, wrap) - z
                worst[-1] = max(worst[-1], abs((e + 180) % 360 - 180))
    assert worst[1] < 0.01 and worst[3] < 5
    stated(39, f"{worst[0]:.1f}", f"{worst[2]:.0f}")
