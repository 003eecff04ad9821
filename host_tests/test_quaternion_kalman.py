"""The quaternion Kalman filter: as its float twin, the same bits everywhere, and variances that mean something."""

import math
import random
from array import array

import motions
import numpy as np
import overflow
import pytest
from conftest import recorded_trials
from histories import ONE, SCALE, SCALES, angles_between, follow, rows_of
from reference import quaternion_kalman_float
from reference.inertial_float import start
from samples import counts, run
from scenes import all_axes, as_start, errors, pushes, scene
from upright.quaternion_kalman import QuaternionKalman6, QuaternionKalman9
from upright_host import paths, scoring, trials, words
from upright_host.simulate import best_runtime as quickest

LIB = paths.PACKAGE
AT = words.places("quaternion_kalman")
APART_DEG = 0.1
PACES = [(90, 1), (200, 3), (500, 10)]
UPPER = [(i, j) for i in range(8) for j in range(i, 8)]


@pytest.fixture
def history(filter_history):
    """history(rendered, axes, mag_every, cov=False, **options) -> History of all its rows, with `decided`.

    cov: a row is a block, and there are P (n, 8, 8) in rad, rad/s and g s, and sigma (n, 8).
    """

    def run(rendered, axes=9, mag_every=1, cov=False, runtime=None, **options):
        options |= {"mag_every": mag_every, "words": [AT.DECIDED]}
        if cov:
            options["words"] += range(AT.P, AT.P + 36)
            options["only"] = [AT.PHASE, 0]
        name = f"quaternion-kalman{axes}"
        got = filter_history(runtime or quickest(), rendered, name, **options)
        got.decided = got.words[:, 0]
        if cov:
            num, den = rendered.rate
            filter = QuaternionKalman9(rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g)
            c = filter.state[AT.C] + 15
            T = got.T = (1 << filter.state[AT.BLOCK]) * den / num
            unit = np.array([2.0**-15] * 3 + [2.0**-c / T] * 3 + [2.0**-10 * T] * 2)
            got.P = np.empty((len(got.words), 8, 8))
            for k, (i, j) in enumerate(UPPER):
                got.P[:, i, j] = got.P[:, j, i] = got.words[:, 1 + k] * unit[i] * unit[j]
            got.sigma = np.sqrt(np.einsum("nii->ni", got.P))
        return got

    return run


def twin_history(rendered, decided, axes=9, mag_every=1, first=None):
    """The float twin with the decisions of the integer run: (attitudes (n, 4), the twin)."""
    rows = rows_of(rendered, mag_every)
    num, den = rendered.rate
    scale = rendered.gyro_scale[0] / rendered.gyro_scale[1]
    twin = quaternion_kalman_float.QuaternionKalmanFloat(
        num / den, scale, rendered.accel_lsb_per_g, axes
    )
    if first is None:
        # without a magnetometer sample the filter knows no heading, and nor must the twin
        blind = axes == 9 and not any(rows[0][6:9])
        twin.set_quaternion(start(rows[0], axes), "level" if blind else True)
    else:
        twin.set_quaternion(first)
    return follow(twin, rows, decided), twin


# -- accuracy against the float twin; pytest -rP shows the figures
@pytest.mark.parametrize("name", motions.MOTIONS)
@pytest.mark.parametrize("rate, seconds, mag_every", [(100, 12, 1), (200, 10, 3), (1000, 3, 10)])
def test_never_a_tenth_of_a_degree_from_the_float_twin(history, name, rate, seconds, mag_every):
    rendered = motions.render(name, rate=(rate, 1), seconds=seconds, accel_range_g=16)
    for axes in (9, 6):
        got = history(rendered, axes, mag_every)
        q, twin = twin_history(rendered, got.decided.tolist(), axes, mag_every)
        worst = angles_between(got.q, q).max()
        print(f"{name} {rate} Hz {axes} axes: {worst:.5f} deg")
        assert worst < APART_DEG
        assert twin.disagreed <= 3


def test_a_wrong_start_as_the_float_twin(history):
    for axis, degrees in (((1, 2, 0), 160), ((-0.5, 0.5, 0.7), 90)):
        rendered = scene(200, 6)
        got = history(rendered, start=as_start(axis, degrees))
        first = motions.exponential(math.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
        q, twin = twin_history(rendered, got.decided.tolist(), first=first.tolist())
        assert angles_between(got.q, q).max() < APART_DEG
        assert twin.disagreed <= 3


# inclination and total; aligned where north is uncertain
FIGURES = {
    "mpu6050_static": {"inclination": 0.1, "aligned_heading": 0.3},
    "tyrex_nexus5_Thibaud_NoDist": {"inclination": 1.5, "aligned_total": 2.7},
    "broad_": {"inclination": 1.3, "total": 3.2},
}


def test_recorded_trials_as_the_float_twin(history, recorded):
    trial = trials.load(recorded)
    trial.counts = trial.counts[: 4000 if quickest() == "cpython" else 16000]
    got = history(trial)
    q, twin = twin_history(trial, got.decided.tolist())
    worst = angles_between(got.q, q).max()
    print(f"{trial.name}: {worst:.4f} deg apart, {twin.disagreed} decisions otherwise")
    assert worst < APART_DEG
    assert twin.disagreed <= 5


@pytest.mark.slow
def test_recorded_trials_as_accurate_as_promised(history):
    files = recorded_trials()
    if not files or quickest() == "cpython":
        pytest.skip("needs recorded trials and the unix runtime")
    nine, six = [], []
    for file in files:
        trial = trials.load(file)
        score = scoring.score_trial(history(trial).q, trial)
        print(f"{trial.name}\n{score}")
        for name, limits in FIGURES.items():
            if trial.name.startswith(name):
                for figure, limit in limits.items():
                    assert getattr(score, figure) < limit, (trial.name, figure)
        if trial.name.startswith("broad_"):
            nine.append((score.inclination, score.total))
            six.append(scoring.score_trial(history(trial, 6).q, trial).aligned_total)
    if len(nine) >= 6:
        (inclination, total), relative = np.mean(nine, 0), np.mean(six)
        print(f"inclination {inclination:.3f}, total {total:.3f}; six axes: total {relative:.3f}")
        assert inclination <= 0.78
        assert total <= 1.85
        assert relative <= 2.03


# -- the covariance
def motion_of_vibration(rate, seconds):
    """Level and north, never at rest: the vertical acceleration differs from block to block; no noise at all."""
    n = rate * seconds
    counts = np.zeros((n, 11), np.int16)
    counts[:, 2] = np.where(np.arange(n) // 4 % 2, 2048 + 400, 2048 - 400)
    counts[:, 6], counts[:, 8], counts[:, 10] = 1000, -2000, 3
    q = np.tile([1.0, 0, 0, 0], (n, 1))
    return motions.Motion("vibration", counts, q, np.zeros((n, 3)), (rate, 1), 2048, SCALE)


def test_the_covariance_settles_where_the_riccati_equation_says(history):
    """A body that does not turn is a constant system: against scipy's discrete algebraic Riccati equation."""
    linalg = pytest.importorskip("scipy.linalg")
    rate, walk, gyro, mag, velocity = 100, 0.1, 0.3, 0.05, 0.5
    got = history(
        motion_of_vibration(rate, 150),
        cov=True,
        gains={
            "bias_walk": walk,
            "gyro_noise": gyro,
            "mag_noise": mag,
            "velocity_noise": velocity,
        },
    )
    assert not (got.decided[10:] & quaternion_kalman_float.STILL).any()
    T = got.T
    first, second = np.eye(8), np.eye(8)
    first[0:3, 3:6] = -T * np.eye(3)
    second[6, 1], second[7, 0] = T, -T
    F = second @ first
    Q = np.diag([math.radians(gyro) ** 2 * T] * 3 + [math.radians(walk) ** 2 * T] * 3 + [0, 0])
    H = np.zeros((3, 8))
    H[0, 6] = H[1, 7] = H[2, 2] = 1
    R = np.diag([(velocity / 9.80665) ** 2 / T] * 2 + [mag**2 / T])
    prior = linalg.solve_discrete_are(F.T, H.T, Q, R)
    K = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)
    posterior = (np.eye(8) - K @ H) @ prior
    sigma = np.sqrt(np.diag(posterior))
    scale = np.outer(sigma, sigma)
    apart = np.abs(got.P[-1] - posterior) / scale
    print(f"P against the Riccati equation: {apart.max():.5f} of sigma_i sigma_j")
    assert apart.max() < 0.01
    assert (
        np.abs(got.P[len(got.P) // 60] - posterior).max() > 0.1 * scale.max()
    )  # it came from elsewhere


def healthy(P):
    """The least eigenvalue of the correlation matrices, which is above 0 for a covariance."""
    sigma = np.sqrt(np.einsum("nii->ni", P))
    correlation = P / sigma[:, :, None] / sigma[:, None, :]
    off = np.abs(correlation - np.eye(8)).max()
    return np.linalg.eigvalsh(correlation).min(), off


def tilt_errors(got, rendered):
    """The error's part about the two horizontal axes of the earth at each block's end, in sigmas: (n, 2)."""
    n = len(rendered.q_true)
    at = np.flatnonzero(np.arange(n) % round(got.T * rendered.rate[0]) == 0)
    # a block's work ends with the first block's last sample but one: its rows are those with phase 0 next
    at = (
        np.arange(len(got.q)) * round(got.T * rendered.rate[0])
        + round(got.T * rendered.rate[0])
        - 2
    )
    e = motions.multiply(rendered.q_true[at], got.q * [1, -1, -1, -1])
    angle = 2 * e[:, 1:3] * np.sign(e[:, :1])
    return angle / got.sigma[:, 0:2]


@pytest.mark.parametrize("name", ["slow", "coning", "hand", "demo"])
def test_the_covariance_is_one_and_the_errors_are_within_it(history, name):
    rendered = motions.render(name, rate=(200, 1), seconds=60, accel_range_g=16)
    got = history(rendered, cov=True)
    least, off = healthy(got.P)
    assert least > 0.002 and off < 0.999
    normalised = np.abs(tilt_errors(got, rendered))
    print(f"{name}: worst {normalised.max():.2f} sigma, least eigenvalue {least:.3f}")
    assert (normalised < 3).mean() > 0.97
    bias = np.abs(got.bias_dps - (1.2, -0.8, 0.6)) / np.degrees(got.sigma[:, 3:6])
    assert (bias[len(bias) // 4 :] < 4).mean() > 0.9


def test_the_covariance_of_recorded_motion_is_one(history, recorded):
    trial = trials.load(recorded)
    trial.counts = trial.counts[: 4000 if quickest() == "cpython" else 16000]
    least, off = healthy(history(trial, cov=True).P)
    assert least > 0.002 and off < 0.999


@pytest.mark.parametrize("rate, lsb", [(100, 2048), (200, 16384), (1000, 64)])
def test_the_covariance_outlives_any_samples(history, rate, lsb):
    """Full scale at random, held for a while or not, some not fresh."""
    n = 20000
    rng = np.random.default_rng(3)
    counts = np.zeros((n, 11), np.int16)
    held = rng.integers(-32768, 32768, (n // 500, 9)).repeat(500, 0)
    counts[:, :9] = np.where(rng.random((n, 1)) < 0.5, held, rng.integers(-32768, 32768, (n, 9)))
    counts[:, 10] = np.where(rng.random(n) < 0.9, 3, 2)
    rendered = motions.Motion("any", counts, None, None, (rate, 1), lsb, SCALE)
    got = history(rendered, cov=True)
    least, off = healthy(got.P)
    assert least > 0.002 and off < 0.999
    assert np.abs(np.linalg.norm(got.q, axis=1) - 1).max() < 2e-8


def test_sigmas_of_motion_and_rest():
    filter = QuaternionKalman9(200, SCALE, 4096)
    row = counts(flags=3)
    assert filter.tilt_uncertainty_mdeg == pytest.approx(math.degrees(0.75) * 1000, rel=1e-3)
    filter.seed(row)
    assert filter.tilt_uncertainty_mdeg == pytest.approx(12000, abs=5)
    assert filter.heading_uncertainty_mdeg == pytest.approx(12000, abs=5)
    run(filter, row, 200 * 20)
    rested = filter.tilt_uncertainty_mdeg, filter.heading_uncertainty_mdeg
    assert rested[0] < 500 and rested[1] < 3000
    run(filter, counts(gz=8000, flags=1), 200 * 3)  # turning fast, without a magnetometer
    assert filter.tilt_uncertainty_mdeg > 2 * rested[0]
    assert filter.heading_uncertainty_mdeg > rested[1]


# -- start and recovery
def test_a_kick_in_motion_is_forgotten(history):
    rendered = scene(200, 40, all_axes, pushes, kick=(25, (60, -40, 0)))
    inclination, _ = errors(history(rendered).q, rendered)
    assert inclination[25 * 200 + 1] > 35
    assert inclination[39 * 200 :].max() < 5  # it takes seconds: the velocity has to run away first


@pytest.mark.parametrize("rate, mag_every", [(90, 1), (200, 3)])
@pytest.mark.parametrize("moving", [False, True])
def test_a_magnet_comes_and_goes_and_never_tilts(history, rate, mag_every, moving):
    motion = all_axes if moving else None
    plain = history(scene(rate, 60, motion, mag_every=mag_every)).q
    for extra in ((10, 40, -20), (0, 200, 100)):

        def field(t, extra=extra):
            return np.outer((t > 20) & (t < 45), extra)

        rendered = scene(rate, 60, motion, field=field, mag_every=mag_every)
        q = history(rendered).q
        inclination, heading = errors(q, rendered)
        assert np.abs(heading[10 * rate :]).max() < (5 if moving else 1.5), extra
        without, _ = errors(plain, rendered)
        assert np.abs(inclination - without)[10 * rate :].max() < 0.3
        if rate == 90 and extra[1] == 40 and not moving:  # were it not left out, it would show
            _, heading = errors(history(rendered, gains={"field_tolerance": 0.7}).q, rendered)
            assert np.abs(heading[10 * rate :]).max() > 3


def pushed(g, seconds):
    """Shaken a little from 30 s on, and pushed north at 60 s."""
    noise = 0.03 * np.random.default_rng(2).standard_normal((18000, 3))

    def push(t):
        force = noise[: len(t)] * (t > 30)[:, None]
        force[:, 0] += g * ((t >= 60) & (t < 60 + seconds))
        return force

    return scene(200, 90, accel=push)


@pytest.mark.parametrize("g, seconds, most", [(0.3, 2, 2.5), (0.5, 2, 4), (0.3, 5, 5)])
def test_a_push_is_no_rest_and_tilts_by_little(history, g, seconds, most):
    """The known limit is beyond: 0.3 g for 10 s is a velocity of 30 m/s, which the model takes for a tilt."""
    inclination, _ = errors(history(rendered := pushed(g, seconds)).q, rendered)
    assert inclination[60 * 200 :].max() < most


@pytest.mark.parametrize("axes", [6, 9])
def test_a_turn_that_was_taken_for_a_bias_is_unlearnt_at_rest(history, axes):
    rendered = scene(200, 60, lambda t: np.outer(t < 2, (0, 0, 4.0)), mag_every=3)
    got = history(rendered, axes)
    assert got.bias_dps[-1] == pytest.approx((1.2, -0.8, 0.6), abs=0.05)
    _, heading = errors(got.q, rendered)
    assert np.ptp(heading[17 * 200 :]) < 3


@pytest.mark.parametrize("axes", [6, 9])
@pytest.mark.parametrize("bias", [(8, -7, 9), (20, -20, 20), (-20, 20, -20)])
def test_a_large_bias_is_found_at_rest_in_4_s(history, axes, bias):
    got = history(rendered := scene(200, 10, bias_dps=bias, mag_every=3), axes)
    assert got.bias_dps[4 * 200] == pytest.approx(bias, abs=0.1)
    inclination, _ = errors(got.q, rendered)
    assert inclination[4 * 200 :].max() < 1


@pytest.mark.parametrize("rate", [0.5, 1, -1, 2, 3, -3])
def test_a_slow_turn_after_a_rest_is_no_bias_where_a_field_shows_it(history, rate):
    rendered = scene(200, 130, lambda t: np.outer(t > 10, (0, 0, rate)), mag_every=3)
    _, heading = errors(history(rendered).q, rendered)
    assert np.abs(heading[5 * 200 :] - heading[5 * 200]).max() < 2  # in 2 minutes


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_a_spin_beyond_the_gyro_s_range_leaves_no_tilt(history, axis):
    rendered = scene(200, 24, lambda t: np.outer((t > 20) & (t < 20.7), 3000 * np.array(axis)))
    full = (np.abs(rendered.counts[:, 3:6].astype(int)) >= 32767).any(1)
    rendered.counts[:, 10] |= 8 * full
    got = history(rendered, 6, cov=True)
    after = len(got.sigma) * 21 // 24
    assert np.degrees(got.sigma[after, 2]) > 30  # 500 deg are missing
    inclination, _ = errors(history(rendered, 6).q, rendered)
    assert inclination[round(21.2 * 200) :].max() < 2


def test_a_bias_that_is_known_is_known():
    sigma = {}
    for known_s in (0, 10, 100):
        filter = QuaternionKalman6(200, SCALE, 4096)
        filter.set_bias(100, 200, 300, known_s)
        c = filter.state[AT.C] + 15
        T = (1 << filter.state[AT.BLOCK]) / 200
        sigma[known_s] = math.degrees(math.sqrt(filter.state[AT.P + 26]) * 2.0**-c / T)
    assert sigma[0] == pytest.approx(3.3, rel=0.01)
    for known_s in (10, 100):  # rest_noise over the root of the seconds
        assert sigma[known_s] == pytest.approx(0.03 / math.sqrt(known_s), rel=0.1)


# -- no intermediate leaves 32 bits
CORNERS = [
    # rate, full scale, LSB per g, parameters
    (90, 2000, 2048, {}),
    (60, 2000, 2048, {"bias_start": 10, "rest_noise": 1, "gyro_noise": 1, "bias_walk": 0.1}),
    (1000, 2000, 16384, {"bias_start": 10, "scale_error": 0.02, "velocity_noise": 2}),
    (1439, 250, 32767, {"bias_start": 0.5, "velocity_noise": 0.1, "mag_noise": 0.01}),
    (50, 250, 64, {"bias_start": 10, "accel_noise": 1, "mag_noise": 0.2, "gyro_noise": 1}),
    (50, 1000, 16383, {"field_tolerance": 0.7, "scale_error": 0.02, "bias_walk": 0.1}),
    ((2000, 7), 500, 8192, {"bias_start": 0.5, "rest_noise": 0.01, "accel_noise": 0.02}),
    (1439, 500, 64, {"velocity_noise": 2, "mag_noise": 0.2, "rest_accel_g": 0.1}),
    (50, 500, 8192, {"bias_start": 0.5, "bias_walk": 0.025, "rest_noise": 1, "gyro_noise": 1}),
]
UNUSED = ("fixmath._euler", "fixmath.add_scaled")


@pytest.fixture(scope="module")
def checked():
    watch = overflow.Watch()
    names = ("fixmath", "earth_kernels", "quaternion_kernels", "quaternion_kalman")
    modules = overflow.loaded([LIB / f"{name}.py" for name in names], watch)
    return watch, modules["quaternion_kalman"]


def covariance(rng, most):
    """A covariance with sigmas up to `most`, from none to full correlation, as the 36 integers of a state."""
    n = rng.choice((1, 2, 8, 8))
    a = np.array([[rng.gauss(0, 1) for _ in range(n)] for _ in range(8)])
    a /= np.linalg.norm(a, axis=1)[:, None]
    sigma = [m * rng.choice((1, 1, rng.random(), rng.random() ** 4, 5 / m)) for m in most]
    P = (a @ a.T) * np.outer(sigma, sigma)
    return [max(16, int(P[i, j])) if i == j else int(P[i, j]) for i, j in UPPER]


def disturb(rng, filter):
    """Any state that the filter can come to, and the largest values foremost."""
    s = filter.state
    overflow.hold_back(rng, s, AT)
    filter.set_bias(*(rng.choice((-(1 << 21), 1 << 21, 0)) for _ in range(3)))

    def put(at, n, size):
        for i in range(n):
            s[at + i] = rng.choice((-size, size, 0, rng.randint(-size, size)))

    q = np.array([rng.choice((-1, 0, 1, rng.gauss(0, 1))) for _ in range(4)])
    if not q.any():
        q[0] = 1
    q = q / np.linalg.norm(q) * ONE
    for i in range(4):
        s[AT.Q + i] = (int(q[i]) >> 15 << 15) + rng.choice((16383, 16384, -16383))
    block = 1 << s[AT.BLOCK]
    put(AT.FS, 3, 29000000 * (block - 1))
    put(AT.AS, 3, 32768 * (block - 1))
    put(AT.GS, 3, 32768 * (block - 1))
    n = rng.randint(0, block - 1)
    put(AT.MS, 3, 29000000 * n)
    s[AT.MN] = n
    # what a measurement leaves: within 5 sigma, twice
    put(AT.X, 3, rng.choice((20000000, 80000000)))
    put(AT.X + 3, 3, 130000000)
    put(AT.X + 6, 2, 130000000)
    put(AT.V, 2, 1072693248)
    put(AT.B, 3, s[AT.B_MOST])
    roots = [26214] * 3 + [math.isqrt(s[AT.BS])] * 3 + [26214] * 2
    for i, v in enumerate(covariance(rng, roots)):
        s[AT.P + i] = v
    put(AT.LOW1, 3, 32767 << 12)
    put(AT.LOW2, 3, 32767 << 12)
    put(AT.LOW1 + 3, 3, 40960 << 12)
    put(AT.LOW2 + 3, 3, 40960 << 12)
    s[AT.BLOCKS] = rng.choice((0, 1, s[AT.BLOCKS]))
    s[AT.STILL] = rng.choice((0, s[AT.REST_AFTER]))
    s[AT.WIDE_FOR] = rng.choice((0, 0, s[AT.WIDE_MOST]))
    s[AT.LOST] = rng.choice((0, s[AT.LOST_MOST]))
    s[AT.SINCE] = rng.choice((0, 1, 15, 16))
    s[AT.HAVE] = rng.choice((0, 1, 1))
    for i in range(2):
        s[AT.FIELD + 2 * i] = rng.randint(0, 464000000)
        s[AT.FIELD + 2 * i + 1] = rng.choice((-464000000, 464000000, 1000))
    if rng.random() < 0.5:
        s[AT.REF], s[AT.REF + 1] = s[AT.FIELD], s[AT.FIELD + 1]
    s[AT.NEAR] = rng.choice((0, s[AT.FIELD_AFTER]))
    s[AT.AGE] = rng.choice((0, 1, 16384))
    s[AT.NINE] = rng.choice((1, 1, 1, 0))
    s[AT.AXIS] = rng.choice((0, 1, 2, 10, 45, 46, 47))
    s[AT.WAIT] = rng.choice((0, 5, 7 * s[AT.REST_AFTER]))
    s[AT.CLIP] = rng.choice((0, 0, 1, 100))
    s[AT.TIPPED] = rng.choice((0, 7))
    s[AT.FAR] = rng.choice((0, s[AT.FAR_MOST]))
    s[AT.YOUNG] = rng.choice((0, 0, 1, s[AT.AFTER]))
    s[AT.QTR], s[AT.QBR] = rng.choice((0, 65535)), rng.choice((0, 4095))
    for i in range(3):
        s[AT.WR + i] = rng.choice((0, 32767))


def stand_still(rng, filter, row):
    """Let the rest detector be content, with the largest bias against the opposite estimate."""
    s = filter.state
    overflow.stand_still(rng, filter, row, AT)
    for i in range(3):
        s[AT.AS + i] = row[i] * ((1 << s[AT.BLOCK]) - 1)
    if rng.random() < 0.4:  # a bias that is known, and contradicted
        for i in (21, 26, 30):
            s[AT.P + i] = 16
    if rng.random() < 0.3:  # level as it thinks, and tilted by 37 deg as it is
        s[AT.Q : AT.Q + 4] = array("i", [ONE, 0, 0, 0])
        g = filter.accel_lsb_per_g
        for i, v in enumerate((g * 6 // 10, 0, g * 8 // 10)):
            row[i] = v
            s[AT.AS + i] = v * ((1 << s[AT.BLOCK]) - 1)
            s[AT.FS + i] = s[AT.AS + i] << 9
            s[AT.LOW1 + i] = s[AT.LOW2 + i] = v << 12
        for i in range(3):
            s[AT.B + i] = s[AT.LOW2 + 3 + i] = s[AT.LOW1 + 3 + i] = 0
            row[3 + i] = s[AT.GS + i] = s[AT.BASE + i] = 0
            s[AT.O + i] = s[AT.OR + i] = s[AT.O_BASE + i] = s[AT.OR_BASE + i] = s[AT.TURN + i] = 0
            s[AT.X + i] = 0
        if rng.random() < 0.5:
            s[AT.P + 21] = 16
            s[AT.B] = 2 * s[AT.REST_OFF]
            s[AT.WAIT] = 7 * s[AT.REST_AFTER]
            s[AT.GOOD] = 1
            s[AT.SINCE] = s[AT.HEADING] = s[AT.MN] = 0
            row[10] = 1
    elif rng.random() < 0.5:  # in free fall, so that nothing tells of a tilt
        for i in range(3):
            row[i] = s[AT.FS + i] = s[AT.AS + i] = s[AT.LOW1 + i] = s[AT.LOW2 + i] = 0


def test_nothing_leaves_32_bits_at_the_corners_of_the_accepted_range(checked):
    watch, module = checked
    rng = random.Random(5)
    for rate, fsr, lsb, parameters in CORNERS:
        filter = module.QuaternionKalman9(rate, SCALES[fsr], lsb, **parameters)
        for _ in range(90):
            disturb(rng, filter)
            row = array(
                "h",
                [overflow.word(rng) for _ in range(10)] + [rng.choice((3, 3, 3, 11, 7, 1, 0, 2))],
            )
            if rng.random() < 0.2:
                row[6] = row[7] = row[8] = 0
            if rng.random() < 0.4:
                stand_still(rng, filter, row)
            filter.state[AT.PHASE] = 0
            for _ in range(9):
                filter.update(row)
                assert abs(math.hypot(*filter.state[1:5]) / ONE - 1) < 1e-3
    assert [m for m in watch.missed() if not m.startswith(UNUSED)] == []


# -- interface
def test_six_axes_do_not_look_at_the_magnetometer():
    row, other = counts(flags=3), counts(mx=0, my=400, flags=3)
    out = array("i", [0] * 3)
    for kind in (QuaternionKalman6, QuaternionKalman9):
        filter = kind(200, SCALE, 4096)
        filter.set_quaternion(1, 0, 0, 1)
        run(filter, row, 200)
        filter.angles(out)
        assert abs(out[2] - (90000 if kind is QuaternionKalman6 else 0)) < 3000
        run(filter, other, 10)
