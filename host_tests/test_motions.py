"""The synthetic motions: their truth is exact, and their sensor errs as it is told to."""

import dataclasses
import math

import motions
import numpy as np
import pytest
import world

NO_ERRORS = motions.Errors(
    gyro_bias_dps=(0, 0, 0),
    gyro_noise_density=0,
    gyro_scale_error=(0, 0, 0),
    gyro_misalignment_deg=(0, 0, 0),
    accel_bias_g=(0, 0, 0),
    accel_noise_density=0,
    mag_noise_uT=0,
)


def angle_deg(a, b):
    """Angle between attitudes, row by row; by the chord, which is exact where the cosine is not."""
    same = np.linalg.norm(np.asarray(a) - b, axis=-1)
    other = np.linalg.norm(np.asarray(a) + b, axis=-1)
    return np.degrees(4 * np.arcsin(np.clip(np.minimum(same, other) / 2, 0, 1)))


def body_up(q):
    """The earth's z axis in the body frame."""
    q0, q1, q2, q3 = q.T
    return np.stack(
        [2 * (q1 * q3 - q0 * q2), 2 * (q0 * q1 + q2 * q3), q0**2 - q1**2 - q2**2 + q3**2], 1
    )


def integrate(q, rates_dps, dt):
    """Closed-form integration of one rate after the other, in plain floats."""
    w, x, y, z = q
    out = []
    for gx, gy, gz in np.radians(rates_dps):
        norm = math.sqrt(gx * gx + gy * gy + gz * gz)
        c = math.cos(norm * dt / 2)
        s = math.sin(norm * dt / 2) / norm if norm else 0.0
        a, b, d = gx * s, gy * s, gz * s
        w, x, y, z = (
            w * c - x * a - y * b - z * d,
            w * a + x * c + y * d - z * b,
            w * b - x * d + y * c + z * a,
            w * d + x * b - y * a + z * c,
        )
        out.append((w, x, y, z))
    return np.array(out)


@pytest.mark.parametrize("name", motions.MOTIONS)
@pytest.mark.parametrize("rate", [(200, 1), (2000, 7), 1000])
def test_the_ideal_gyro_leads_to_the_true_attitude(name, rate):
    m = motions.render(name, rate, seconds=12, errors=None, substeps=1)
    num, den = m.rate
    assert m.n == 12 * num // den
    assert not m.rate_true_dps[0].any()
    found = integrate(m.q_true[0], m.rate_true_dps, den / num)
    assert np.abs(found - m.q_true).max() < 1e-9
    assert np.abs(np.linalg.norm(m.q_true, axis=1) - 1).max() < 1e-14
    # the counts are those rates and attitudes, rounded
    assert np.abs(m.counts[:, 3:6] - m.rate_true_dps * 16.4).max() <= 0.5 + 1e-9
    if name not in ("hand", "demo"):
        assert np.abs(m.counts[:, 0:3] - body_up(m.q_true) * 4096).max() <= 0.5 + 1e-9
    assert not m.counts[:, 10].any()


def test_fine_steps_follow_a_cone_whose_attitude_is_known_in_closed_form():
    def error(substeps):
        m = motions.render("coning", 200, seconds=10, errors=None, substeps=substeps)
        cone = 2 * np.pi * motions.CONING_HZ
        inner = np.radians([motions.CONING_DPS, 0, motions.CONING_Z_DPS])
        # with the rate turning about z at `cone`: q = q0 exp((inner + cone z) t) exp(-cone z t)
        turned = motions.exponential((inner + cone * np.array([0, 0, 1])) * m.t[:, None])
        back = motions.exponential(-cone * m.t[:, None] * [0, 0, 1])
        exact = motions.multiply(motions.multiply(m.q_true[0], turned), back)
        return angle_deg(m.q_true, exact).max()

    coarse, fine = error(20), error(80)
    assert coarse < 0.01
    assert 12 < coarse / fine < 20  # the middle's rate stands for the step: second order


def test_the_same_motion_whatever_the_rate_and_the_errors():
    for name in motions.MOTIONS:
        slow = motions.render(name, 200, seconds=8, seed=5)
        quick = motions.render(name, 1000, seconds=8, seed=5, errors=None)
        assert angle_deg(slow.q_true, quick.q_true[::5]).max() < 1e-6, name


def test_a_static_accelerometer_shows_gravity_in_the_body_frame():
    m = motions.render("static", seconds=1, errors=None, accel_range_g=2)
    roll, pitch = math.radians(10), math.radians(-5)
    up = [-math.sin(pitch), math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch)]
    assert m.accel_lsb_per_g == 16384
    assert (m.counts[:, 0:3] == np.rint(np.array(up) * 16384)).all()
    assert not m.counts[:, 3:6].any()


def test_the_magnetometer_shows_the_earths_field():
    level = motions.render("demo", seconds=1, errors=None)
    field = np.array([49 * math.cos(math.radians(66)), 0, -49 * math.sin(math.radians(66))])
    assert (level.counts[:, 6:9] == np.rint(field / 0.3)).all()
    m = motions.render("slow", seconds=20, errors=None)
    north = m.counts[:, 6:9] * 0.3 + body_up(m.q_true) * 49 * math.sin(math.radians(66))
    yaw_west = motions.multiply(m.q_true, np.insert(north, 0, 0, 1))
    yaw_west = motions.multiply(yaw_west, m.q_true * [1, -1, -1, -1])[:, 1:]
    assert np.abs(yaw_west - [field[0], 0, 0]).max() < 0.3


def test_spin_turns_once_a_second_about_its_own_tilted_axis():
    m = motions.render("spin", 200, seconds=3, errors=None)
    assert angle_deg(m.q_true[0], m.q_true[200]) < 1e-9
    assert angle_deg(m.q_true[0], m.q_true[50]) == pytest.approx(90)
    assert (m.counts[1:, 5] == 5904).all() and not m.counts[:, 3:5].any()


def test_bursts_are_short_quick_turns_about_changing_axes():
    m = motions.render("bursts", 200, seconds=20, errors=None)
    speed = np.linalg.norm(m.rate_true_dps, axis=1)
    assert set(np.round(speed, 6)) == {0, 1000}
    assert (speed > 0).sum() == 10 * 60
    axes = np.unique(np.round(m.rate_true_dps[speed > 0], 6), axis=0)
    assert len(axes) == 10


def test_a_hand_turns_pushes_and_rests():
    m = motions.render("hand", 200, seconds=60, errors=None)
    speed = np.linalg.norm(m.rate_true_dps, axis=1)
    force = np.linalg.norm(m.counts[:, 0:3] / 4096, axis=1)
    rest = speed == 0
    assert 0.2 < rest.mean() < 0.6
    assert 200 < speed.max() < 1500
    assert np.abs(force[rest] - 1).max() < 1e-3
    assert 0.2 < np.abs(force - 1).max() < 1.5
    assert angle_deg(m.q_true[:1], m.q_true).max() > 90


def test_the_demo_sweeps_each_axis_and_comes_back_level():
    m = motions.render("demo", 200, seconds=motions.DEMO_SECONDS, errors=None)
    q0, q1, q2, q3 = m.q_true.T
    assert angle_deg(m.q_true[:1], m.q_true[: 500 + 1]).max() == 0  # 2.5 s of rest

    def about(part, start, end):
        turn = np.degrees(2 * np.arctan2(part, q0))[int(start * 200) : int(end * 200)]
        return turn.min(), turn.max()

    assert about(q1, 2.5, 7) == pytest.approx((-60, 60), abs=0.01)
    assert about(q2, 7, 12) == pytest.approx((-45, 45), abs=0.01)
    turn = np.degrees(np.unwrap(2 * np.arctan2(q3, q0)))[2400:3740]
    assert (turn.min(), turn.max()) == pytest.approx((-180, 180), abs=0.01)
    assert angle_deg([1, 0, 0, 0], m.q_true[[1440, 2400, 3780, 4350, -1]]).max() < 0.5
    force = np.linalg.norm(m.counts[:, 0:3] / 4096, axis=1)
    assert np.abs(force[:3800] - 1).max() < 1e-3 < 0.3 < np.abs(force[3820:4300] - 1).max()


def test_a_reading_beyond_the_range_sticks_at_full_scale():
    narrow = motions.render("bursts", seconds=20, gyro_range_dps=250).counts[:, 3:6]
    assert narrow.max() == 32767 and narrow.min() == -32768
    wide = motions.render("bursts", seconds=20, gyro_range_dps=2000).counts[:, 3:6]
    assert np.abs(wide.astype(int)).max() < 1010 * 16.4
    assert ((narrow > 0) == (wide > 0))[np.abs(wide.astype(int)) > 100].all()
    huge = dataclasses.replace(NO_ERRORS, accel_bias_g=(3, -3, 0))
    shoved = motions.render("static", seconds=1, accel_range_g=2, errors=huge).counts
    assert (shoved[:, 0] == 32767).all() and (shoved[:, 1] == -32768).all()


def test_each_error_does_what_it_says():
    def gyro(name="static", seconds=100, **errors):
        m = motions.render(
            name, seconds=seconds, errors=dataclasses.replace(NO_ERRORS, **errors), accel_range_g=2
        )
        return m.counts / np.array([16384] * 3 + [16.4] * 3 + [1 / 0.3] * 3 + [1, 1])

    assert not gyro()[:, 3:6].any()  # the failing twin of all that follow
    assert gyro(gyro_bias_dps=(1, -2, 3))[:, 3:6].mean(0) == pytest.approx((1, -2, 3), abs=0.04)
    noisy = gyro(gyro_noise_density=0.05)[:, 3:6]
    assert noisy.std(0) == pytest.approx([0.05 * math.sqrt(98)] * 3, rel=0.03)
    assert noisy.mean(0) == pytest.approx([0, 0, 0], abs=0.02)
    spin = gyro("spin", 1, gyro_scale_error=(0, 0, 0.02))[1:, 5]
    assert spin == pytest.approx(360 * 1.02, abs=0.04)
    turned = gyro("spin", 1, gyro_misalignment_deg=(0, 1, 0))[1:, 3:6].mean(0)
    tilt = math.radians(1)
    assert turned == pytest.approx((-360 * math.sin(tilt), 0, 360 * math.cos(tilt)), abs=0.05)
    still = gyro()[0]
    assert gyro(accel_bias_g=(0.1, 0, -0.1))[0, 0:3] - still[0:3] == pytest.approx(
        (0.1, 0, -0.1), abs=1e-4
    )
    assert gyro(accel_noise_density=400e-6)[:, 0:3].std(0) == pytest.approx(
        [400e-6 * math.sqrt(98)] * 3, rel=0.03
    )
    assert gyro(mag_bias_uT=(9, 0, 0))[0, 6] - still[6] == pytest.approx(9, abs=0.3)
    assert gyro(mag_noise_uT=2)[:, 6:9].std(0) == pytest.approx([2] * 3, rel=0.05)


def test_noise_is_white_within_half_the_rate():
    errors = dataclasses.replace(NO_ERRORS, gyro_noise_density=0.5)
    for rate, bandwidth in ((50, 25), (100, 50), (1000, 98)):
        noise = motions.render("static", rate, seconds=100, errors=errors).counts[:, 3:6] / 16.4
        assert noise.std() == pytest.approx(0.5 * math.sqrt(bandwidth), rel=0.03)
        assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 0.05


def test_a_seed_fixes_motion_and_noise():
    for name in ("hand", "bursts"):
        a, b, c = (motions.render(name, seconds=10, seed=s) for s in (3, 3, 4))
        assert (a.counts == b.counts).all() and (a.q_true == b.q_true).all()
        assert angle_deg(a.q_true, c.q_true).max() > 1
    a, c = (motions.render("static", seconds=10, seed=s) for s in (3, 4))
    assert (a.q_true == c.q_true).all() and (a.counts[:, :6] != c.counts[:, :6]).any()
    longer = motions.render("hand", seconds=20, seed=3)
    shorter = motions.render("hand", seconds=10, seed=3)
    assert (longer.counts[:2000, 3:6] == shorter.counts[:, 3:6]).all()


def test_a_rest_before_the_motion_shifts_it():
    m = motions.render("spin", 200, seconds=3, rest_seconds=2, errors=None)
    assert not m.rate_true_dps[: 400 + 1].any() and (m.q_true[:401] == m.q_true[0]).all()
    assert m.rate_true_dps[401:, 2] == pytest.approx(360)
    plain = motions.render("hand", 200, seconds=5, errors=None)
    rested = motions.render("hand", 200, seconds=7, rest_seconds=2, errors=None)
    assert angle_deg(rested.q_true[400:], plain.q_true).max() < 1e-6


def test_there_is_no_push_during_the_rest(monkeypatch):
    def pushed(rng):
        return motions._static(rng)[0], lambda t: np.tile([0.5, 0, 0], (len(t), 1))

    monkeypatch.setitem(motions._MOTIONS, "pushed", ((0, 0, 0), pushed))
    m = motions.render("pushed", 100, seconds=2, rest_seconds=1, errors=None)
    assert m.counts[99, 0] == 0 and (m.counts[100:, 0] == 2048).all()


def test_the_temperature_word_is_a_warming_mpu6050():
    celsius = motions.render("static", seconds=300).counts[:, 9] / 340 + 36.53
    assert celsius[0] == pytest.approx(25, abs=0.01)
    assert (np.diff(celsius) >= 0).all() and 27 < celsius[-1] < 28


def test_a_motion_is_replayed_by_the_world(tmp_path):
    m = motions.render("demo", (2000, 7), seconds=3, accel_range_g=16, gyro_range_dps=500)
    m.write(tmp_path / "demo.imu")
    w = world.World(tmp_path / "demo.imu")
    assert (w.rate, w.n, w.clocked, w.name) == ((2000, 7), m.n, False, "demo")
    assert (w.accel_lsb_per_g, w.gyro_scale) == (2048, (131, 2))
    assert all(list(w.row(k)) == list(m.counts[k]) for k in range(m.n))
    m.write(tmp_path / "demo.imu", clocked=True)
    assert world.World(tmp_path / "demo.imu").clocked


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"name": "fly"}, "no motion 'fly'; there are static, slow"),
        ({"accel_range_g": 3}, "accel_range_g 3"),
        ({"gyro_range_dps": 300}, "gyro_range_dps 300"),
        ({"rate": 0}, "must be positive"),
        ({"rate": (200, -1)}, "must be positive"),
        ({"seconds": 0}, "must be positive"),
        ({"rest_seconds": -1}, "must be positive"),
    ],
)
def test_what_cannot_be_rendered_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        motions.render(**{"name": "static", **arguments})
