"""Scenes that every user meets, each with the figures that a filter has to reach in it: rest after a turn, a large
bias, magnets, pushes, spins beyond the gyro's range, cones, slow loops.

Needs numpy; a filter goes through them translated to C (translate.py). `measured` gives the figures of a scene;
its limits say the largest that each may be.
"""

import math
from array import array
from dataclasses import dataclass
from functools import lru_cache

import motions
import numpy as np
import translate
from scenes import FIELD_UT, all_axes, errors, pushes, scene

RATE = 200
BIAS = (1.2, -0.8, 0.6)  # scene's own, deg/s


@dataclass
class Run:
    """A filter's way through a motion. Each (n,): t, inclination, heading (error, unwrapped); each second: bias_off
    (k, 3) deg/s from the true one, doubt_deg (of the heading, by the filter itself; nan where it says none)."""

    t: np.ndarray
    inclination: np.ndarray
    heading: np.ndarray
    bias_off: np.ndarray
    doubt_deg: np.ndarray

    def tilt(self, start, end=math.inf):
        return self.inclination[(self.t >= start) & (self.t < end)].max()

    def north(self, start, end=math.inf):
        """The largest heading error, which is no more than 180."""
        part = (self.heading[(self.t >= start) & (self.t < end)] + 180) % 360 - 180
        return np.abs(part).max()

    def yaw(self, start, end=math.inf):
        """By how much the heading error changes, turns and all."""
        return np.ptp(self.heading[(self.t >= start) & (self.t < end)])

    def last(self, which, limit, since):
        """Seconds after `since` until the error stays within the limit."""
        error = {"tilt": self.inclination, "heading": np.abs((self.heading + 180) % 360 - 180)}[
            which
        ]
        beyond = np.flatnonzero((error > limit) & (self.t >= since))
        return self.t[beyond[-1]] - since if len(beyond) else 0.0


@dataclass
class Scene:
    """render() -> motions.Motion; judge(Run) -> {figure: value}; limits: {figure: the largest value}, for both numbers
    of axes, or {(axes, figure): ...}; bias: set before, 1/256 counts, as after known_s of rest."""

    render: object
    judge: object
    limits: dict
    axes: tuple = (9, 6)
    bias: tuple = ()
    known_s: float = 0

    def limit(self, axes, figure):
        return self.limits.get((axes, figure), self.limits.get(figure, math.inf))


def followed(name, rendered, bias=(), known_s=0, gains=None):
    """A filter of the registry through a motion -> (Run, translate.Overflow list)."""
    num, den = rendered.rate
    run = translate.make(
        name, rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, **(gains or {})
    )
    filter = run.filter
    if bias:
        filter.set_bias(*bias, known_s)
    filter.seed(array("h", rendered.counts[0].tolist()))
    second = max(1, num // den)
    read, q, biases, doubts = array("i", [0] * 3), [], [], []
    for start in range(0, rendered.n, second):
        q.append(run.attitudes(rendered.counts[start : start + second]))
        filter.bias_mdps(read)
        biases.append([b / 1000 for b in read])
        doubts.append(getattr(filter, "heading_uncertainty_mdeg", math.nan) / 1000)
    inclination, heading = errors(np.concatenate(q), rendered)
    heading = np.degrees(np.unwrap(np.radians(heading)))
    if "6" in name:
        heading = heading - heading[0]
    ends = np.minimum(np.arange(1, len(biases) + 1) * second, rendered.n) - 1
    truth = rendered.bias_dps[ends]
    return (
        Run(rendered.t, inclination, heading, np.array(biases) - truth, np.array(doubts)),
        run.overflows(),
    )


@lru_cache(maxsize=8)
def rendered(name):
    return SCENES[name].render()


def measured(name, filter, gains=None):
    """The figures of a scene with this filter: {figure: value}."""
    s = SCENES[name]
    run, overflows = followed(filter, rendered(name), s.bias, s.known_s, gains)
    assert not overflows, overflows[0]
    return s.judge(run)


# -- motion
def still(t):
    return np.zeros((len(t), 3))


def between(t, start, end):
    return ((t >= start) & (t < end))[:, None]


def gently(t):
    return 0.5 * all_axes(t)


def as_made(rate, seconds, *arguments, bias_dps=BIAS, **options):
    """scenes.scene, whose motion gets the true bias of every row."""
    motion = scene(rate, seconds, *arguments, bias_dps=bias_dps, **options)
    values = bias_dps(motion.t) if callable(bias_dps) else np.array(bias_dps, float)
    motion.bias_dps = np.broadcast_to(values, (motion.n, 3))
    return motion


def mounted(motion, roll):
    """The same motion seen by a sensor that is mounted with this roll, deg."""
    mount = motions.exponential(np.radians((roll, 0, 0)))
    turn = motions._matrix(mount[None])[0]
    for first in (0, 3, 6):
        part = slice(first, first + 3)
        motion.counts[:, part] = np.rint(motion.counts[:, part] @ turn).astype(np.int16)
    motion.bias_dps = motion.bias_dps @ turn
    motion.q_true = motions.multiply(motion.q_true, mount)
    return motion


def without_samples(motion, start, end):
    """The steps of a loop that gets no sample meanwhile: the last one, not fresh."""
    first, last = int(start * RATE), int(end * RATE)
    motion.counts[first:last] = motion.counts[first - 1]
    motion.counts[first:last, 10] = 0
    return motion


def turned_by_hand(seconds, rate_dps, rest=120):
    return as_made(RATE, seconds + rest, lambda t: between(t, 0, seconds) * np.array(rate_dps))


def parked(per_minute, about_all, rest):
    """A minute of rest, ten of driving while the bias drifts, rest again."""

    def rate(t):
        if about_all:
            return all_axes(t) * between(t, 60, 660)
        swing = 40 * np.sin(0.2 * np.pi * t) + 20 * np.sin(0.062 * np.pi * t)
        return np.stack([0 * t, 0 * t, swing], 1) * between(t, 60, 660)

    def accel(t):
        return 0.05 * np.random.default_rng(3).standard_normal((len(t), 3)) * between(t, 60, 660)

    def bias(t):
        minutes = np.clip(t - 60, 0, 600)[:, None] / 60
        return np.array(BIAS) + minutes * np.array(per_minute)

    return as_made(RATE, 660 + rest, rate, accel, bias_dps=bias)


def turntable(dps):
    """A rest of 10 s, then 4 minutes of a steady turn; a calibrated accelerometer."""
    return as_made(
        RATE, 250, lambda t: between(t, 10, 1e9) * np.array((0, 0, dps)), accel_offset_g=(0, 0, 0)
    )


def vibrated(t, accel):
    """Pushes of a vehicle whose engine runs from 30 s on."""
    noise = 0.03 * np.random.default_rng(2).standard_normal((len(t), 3))
    return accel + noise * between(t, 30, 1e9)


def push(g, seconds):
    return as_made(
        RATE, 100, None, lambda t: vibrated(t, between(t, 60, 60 + seconds) * np.array((g, 0, 0)))
    )


def car(g, seconds, speed=15):
    """A turn at `speed` m/s that presses with g; the car's nose is its x axis."""
    dps = math.degrees(g * 9.81 / speed)

    def accel(t):
        psi = np.radians(dps * np.clip(t - 60, 0, seconds))
        centre = np.stack([-g * np.sin(psi), g * np.cos(psi), 0 * t], 1)
        return vibrated(t, centre * between(t, 60, 60 + seconds))

    return as_made(RATE, 110, lambda t: between(t, 60, 60 + seconds) * np.array((0, 0, dps)), accel)


def spin(dps, seconds, axis, range_dps=2000, rest=30):
    """A rest of 20 s, a turn at a steady rate, a rest."""
    turn = dps * np.array(axis, float) / np.linalg.norm(axis)
    return as_made(
        RATE,
        20 + seconds + rest,
        lambda t: between(t, 20, 20 + seconds) * turn,
        range_dps=range_dps,
    )


def cone(rate, degrees=10, hertz=5, seconds=20):
    """An axis that goes round a cone: the gyro's mean rates hide a drift.

    With noise: without it a constant rate is rounded to the same count for ever, 0.025 deg/s off.
    """
    half, turn = math.radians(degrees), 2 * math.pi * hertz

    def body_rate(t):
        x, y = -math.sin(half) * np.sin(turn * t), math.sin(half) * np.cos(turn * t)
        return np.degrees(turn * np.stack([x, y, 0 * t - (1 - math.cos(half))], 1)) * between(
            t, 1, 1e9
        )

    return as_made(rate, seconds + 1, body_rate, bias_dps=(0, 0, 0), accel_offset_g=(0, 0, 0))


# -- fields
def magnet(start, end, extra):
    return lambda t: between(t, start, end) * np.array(extra, float)


def turned_field(start, end, degrees, strength=1.0):
    """The earth's field turned about the vertical, and so many times as strong."""
    a = math.radians(degrees)
    north, _, up = FIELD_UT
    other = strength * np.array([north * math.cos(a), north * math.sin(a), up])
    return magnet(start, end, other - FIELD_UT)


def thrown(seed):
    """Turns and pushes in bursts, from the first sample on, and a raw gyro."""
    rng = np.random.default_rng(seed)
    size, hz, phase = (
        rng.uniform(0, 1, (3, 4)),
        rng.uniform(0.05, 1.5, (3, 4)),
        rng.uniform(0, 6, (3, 4)),
    )
    force, force_hz = rng.uniform(0.2, 0.6), rng.uniform(0.3, 4, (3, 3))
    ends = np.cumsum(rng.uniform(2, 12, 40))

    def active(t):
        return np.searchsorted(ends, t) % 2 == 0

    def body_rate(t):
        wave = np.sin(2 * np.pi * hz[..., None] * t + phase[..., None])
        return (active(t) * 150 * (size[..., None] * wave).sum(1)).T

    def accel(t):
        wave = np.sin(2 * np.pi * force_hz[..., None] * t + phase[:, :3, None])
        return (active(t) * force / 2 * wave.sum(1)).T

    return as_made(RATE, 45, body_rate, accel, bias_dps=tuple(rng.uniform(-5, 5, 3)))


def bad_start(seed):
    """Carried by someone who walks, from the first sample on, with a raw gyro; for 6 s the field is turned by 20 to 90
    deg and 0.6 to 1.8 times as strong.

    Nothing shows the bias about the vertical but a good field: the body swings, and never rests.
    """
    rng = np.random.default_rng([seed, 6])
    hz = rng.uniform(0.85, 1.1)  # of a pair of steps
    swing = rng.uniform((4, 2, 3), (35, 6, 8)) * hz * 2 * np.pi
    turn, turn_hz, phase = rng.uniform(0, 25, 4), rng.uniform(0.01, 0.2, 4), rng.uniform(0, 6, 7)
    push = rng.uniform((0.08, 0.05, 0.2), (0.2, 0.15, 0.4))
    degrees = rng.uniform(20, 90) * rng.choice([-1, 1])
    field = turned_field(0, 6, degrees, rng.uniform(0.6, 1.8))

    def body_rate(t):
        steps = swing * np.sin(2 * np.pi * hz * t[:, None] + phase[:3])
        slow = turn * np.sin(2 * np.pi * turn_hz * t[:, None] + phase[3:])
        return steps + slow.sum(1)[:, None] * np.array((0, 0, 1))

    def accel(t):
        return push * np.sin(2 * np.pi * hz * t[:, None] * np.array((2, 1, 2)) + phase[:3])

    bias = tuple(rng.uniform(-5, 5, 3))
    return as_made(RATE, 95, body_rate, accel, bias_dps=bias, field=field)


# -- the scenes
SCENES = {}


def _rest_after(name, render, from_s, until, **more):
    """After the first 15 s of a rest that begins at from_s."""
    SCENES[name] = Scene(
        render,
        lambda run: {
            "yaw": run.yaw(from_s + 15, until),
            "bias": np.abs(run.bias_off[int(until) - 1]).max(),
        },
        {"yaw": 3, "bias": 0.1},
        **more,
    )


for _seconds, _dps in (
    (2, (0, 0, 4)),
    (2.5, (0, 0, -4)),
    (5, (0, 0, 4)),
    (10, (2, -2, 3)),
    (60, (0, 0, 4)),
):
    _rest_after(
        f"by hand {_seconds:g} s at {','.join(map(str, _dps))}",
        lambda s=_seconds, d=_dps: turned_by_hand(s, d),
        _seconds,
        _seconds + 120,
    )
# what the firmware's measurement makes of the first second of a turn
_rest_after(
    "measured while turning",
    lambda: turned_by_hand(5, (0, 0, 4)),
    5,
    125,
    bias=tuple(round(256 * 16.4 * b) for b in (1.2, -0.8, 4.6)),
    known_s=100,
)
for _name, _drift, _all in (
    ("parked, z drifted by 1", (0, 0, 0.1), False),
    ("parked, all drifted by 0.5", (0.05, 0.05, 0.05), True),
    ("parked, all drifted by 2", (0.2, -0.2, 0.2), True),
):
    _rest_after(_name, lambda d=_drift, a=_all: parked(d, a, 300), 660, 960)


def _of_turntable(dps):
    def judge(run):
        minute, heading = 60 * RATE, run.heading[10 * RATE :]
        adopted = np.flatnonzero(run.bias_off[:, 2] > dps / 2)
        return {
            "a minute": np.abs(heading[minute:] - heading[:-minute]).max(),
            "adopted after": adopted[0] - 10 if len(adopted) else 999,  # s; 999: never
        }

    return judge


for _dps in (0.5, 1, 2, 3):
    SCENES[f"turntable at {_dps:g}"] = Scene(
        lambda d=_dps: turntable(d), _of_turntable(_dps), {(9, "a minute"): 1}
    )

for _bias in ((8, -7, 9), (20, -20, 20), (-20, 20, 20), (20, 0, 0), (0, 0, -20), (-15, -15, -15)):
    SCENES[f"bias {','.join(map(str, _bias))} at rest"] = Scene(
        lambda b=_bias: as_made(RATE, 25, bias_dps=b),
        lambda run: {
            "bias at 4 s": np.abs(run.bias_off[3:]).max(),
            "tilt after 4 s": run.tilt(4),
            "yaw after 4 s": run.yaw(4),
        },
        {"bias at 4 s": 0.1, "tilt after 4 s": 1, (6, "yaw after 4 s"): 1},
    )

for _seed in range(1, 13):
    SCENES[f"bad start {_seed}"] = Scene(
        lambda s=_seed: bad_start(s), lambda run: {"heading": run.north(90)}, {"heading": 45}, (9,)
    )
SCENES["magnet while lying still"] = Scene(
    lambda: as_made(
        RATE,
        150,
        lambda t: all_axes(t) * between(t, 10, 60),
        field=turned_field(101, 116, 155, 1.1),
    ),
    lambda run: {"heading": run.north(70)},
    {"heading": 10},
    (9,),
)
for _degrees, _seconds in ((32, 22), (-54, 13), (45, 20)):
    SCENES[f"field turned by {_degrees} for {_seconds} s in motion"] = Scene(
        lambda d=_degrees, s=_seconds: as_made(
            RATE, 150, lambda t: gently(t) * between(t, 20, 1e9), field=turned_field(60, 60 + s, d)
        ),
        lambda run, s=_seconds: {"heading": run.north(60), "after": run.north(90 + s)},
        {"heading": 10, "after": 5},
        (9,),
    )
for _extra, _end in (
    ((10, 15, 5), 480),
    ((0, 20, 0), 480),
    ((-15, 8, 20), 480),
    ((5, 5, 0), 480),
    ((10, 40, -20), 60),  # at rest from then on
):
    SCENES[f"5 minutes beside {','.join(map(str, _extra))} uT"] = Scene(
        lambda e=_extra, z=_end: as_made(
            RATE, 480, lambda t: gently(t) * between(t, 20, z), field=magnet(60, 360, e)
        ),
        lambda run: {"after": run.north(390), "beside": run.north(60, 360)},
        {"after": 5},
        (9,),
    )

for _name, _render, _limits in (
    ("push 0.3 g 2 s", lambda: push(0.3, 2), {"tilt": 2.5}),
    ("push 0.5 g 2 s", lambda: push(0.5, 2), {"tilt": 4}),
    ("push 0.3 g 5 s", lambda: push(0.3, 5), {}),
    ("car 0.3 g 5 s", lambda: car(0.3, 5), {"tilt": 5, "heading": 5}),
    ("car 0.3 g 20 s", lambda: car(0.3, 20), {"tilt": 10, "heading": 5}),
):
    SCENES[_name] = Scene(
        _render, lambda run: {"tilt": run.tilt(60), "heading": run.north(60)}, _limits
    )

for _axis in ((1, 0, 0), (0, 0, 1), (1, 0.2, 0.3)):
    SCENES[f"spin of 3000 deg/s about {','.join(map(str, _axis))}"] = Scene(
        lambda a=_axis: spin(3000, 0.7, a),
        lambda run: {"tilt": run.tilt(21.2), "heading beyond doubt": _beyond_doubt(run, 25)},
        {"tilt": 2, "heading beyond doubt": 10},
    )
SCENES["quick turn beyond 250 deg/s"] = Scene(
    lambda: spin(600, 0.3, (0, 0, 1), 250),
    lambda run: {"heading beyond doubt": _beyond_doubt(run, 22), "heading": run.north(35)},
    {"heading beyond doubt": 10, (9, "heading"): 5},
)


def _beyond_doubt(run, second):
    """By how much the heading is further off than the filter says that it may be."""
    off = abs((run.heading[second * RATE - 1] + 180) % 360 - 180)
    return off - run.doubt_deg[second - 1]


SCENES["turntable at 1, mounted at 45"] = Scene(
    lambda: mounted(turntable(1), 45), _of_turntable(1), {(9, "a minute"): 2.5}, (9,)
)
for _roll in (10, 45, 90):
    SCENES[f"car 0.3 g 20 s, mounted at {_roll}"] = Scene(
        lambda r=_roll: mounted(car(0.3, 20), r),
        lambda run: {"tilt": run.tilt(60), "heading": run.north(60)},
        {"tilt": 10, "heading": 5},
    )
for _drift, _heading in ((0.03, 5), (0.1, 7), (0.2, 9)):
    SCENES[f"driving while z drifts by {_drift} a minute"] = Scene(
        lambda d=_drift: parked((0, 0, d), False, 60),
        lambda run: {"heading": run.north(60)},
        {"heading": _heading},
        (9,),
    )
# found again: a turn of which the end was not sampled, one that nothing measured, a spin that ends at rest
for _dps, _gap, _most in ((250, 0.2, 8), (400, 0.2, 16), (250, 0.45, 8)):
    SCENES[f"a turn of {_dps} ends in a gap of {_gap} s"] = Scene(
        lambda d=_dps, g=_gap: without_samples(
            as_made(
                RATE,
                80,
                lambda t: (
                    between(t, 38, 40.02) * np.array((0, 0, d)) + gently(t) * between(t, 5, 30)
                ),
            ),
            40,
            40 + g,
        ),
        lambda run, g=_gap: {"heading < 5 after": run.last("heading", 5, 40 + g)},
        {"heading < 5 after": _most},
        (9,),
    )
SCENES["turned by 170 without samples"] = Scene(
    lambda: without_samples(
        as_made(RATE, 80, lambda t: gently(t) * between(t, 5, 30), kick=(41, (0, 0, 170))), 40, 42
    ),
    lambda run: {"heading < 5 after": run.last("heading", 5, 42)},
    {"heading < 5 after": 3},
    (9,),
)
for _moment in range(4):
    SCENES[f"yaw kick of 130 at rest, {_moment}"] = Scene(
        lambda k=_moment: as_made(RATE, 80, kick=(40 + 0.044 * k, (0, 0, 130))),
        lambda run: {"heading < 5 after": run.last("heading", 5, 40)},
        {"heading < 5 after": 30},
        (9,),
    )

# what the gyro has not seen, in a good field: found again as quickly as ever, within a factor of two
for _name, _moving, _kick, _tilt, _heading in (
    ("kick at rest", None, (60, 40, 30), 6, 11),
    (
        "yaw kick at rest",
        None,
        (0, 0, 90),
        6,
        20,
    ),  # no gyro misses it: a magnet would look the same
    ("kick in motion", gently, (60, 40, 0), 20, 20),
    ("yaw kick in motion", gently, (0, 0, 40), 20, 40),
):
    SCENES[_name] = Scene(
        lambda m=_moving, k=_kick: as_made(RATE, 120, m, kick=(40, k)),
        lambda run: {
            "tilt < 3 after": run.last("tilt", 3, 40),
            "heading < 5 after": run.last("heading", 5, 40),
        },
        {"tilt < 3 after": _tilt, (9, "heading < 5 after"): _heading},
    )
for _seed in (1, 2, 3, 4, 5, 6):
    SCENES[f"thrown {_seed}"] = Scene(
        lambda s=_seed: thrown(s),
        lambda run: {"tilt": run.tilt(25), "heading": run.north(25)},
        {"tilt": 4, (9, "heading"): 10},
    )
SCENES["first sample 0.7 g sideways"] = Scene(
    lambda: _pushed_at_first(),
    lambda run: {"tilt": run.tilt(1)},
    {"tilt": 2},
)
SCENES["uncalibrated magnetometer 20,-15,10 uT"] = Scene(
    lambda: as_made(
        RATE, 200, lambda t: all_axes(t) * between(t, 5, 1e9), mag_offset_uT=(20, -15, 10)
    ),
    lambda run: {"tilt": run.tilt(20), "heading": run.north(60)},
    {"tilt": 2},
    (9,),
)


def _pushed_at_first():
    motion = as_made(RATE, 30)
    motion.counts[0, :3] = 1434, 0, 2048
    return motion


for _rate, _limit in ((100, 0.4), (200, 0.1), (500, 0.1)):
    SCENES[f"cone at {_rate} Hz"] = Scene(
        lambda r=_rate: cone(r),
        lambda run: {"yaw": run.yaw(2), "tilt": run.tilt(2)},
        {(6, "yaw"): _limit},
        (6, 9),
    )
for _rate in (20, 50):
    SCENES[f"{_rate} Hz at 500 deg/s"] = Scene(
        lambda r=_rate: as_made(r, 120, all_axes, pushes, range_dps=500),
        lambda run: {"tilt": run.tilt(20), "heading": run.north(40)},
        {"tilt": 3, (9, "heading"): 6},
    )
