"""Hostile samples through the translated filters (translate.py): does any value leave 32 bits, any attitude its length?

`python host_tests/fuzz_filters.py --seconds 600 [--from N] [NAME ...]` runs case after case, a hundred million steps in
some minutes. A case is fixed by its number: filter, rate, scales, parameters, start, samples. `--case N` repeats one.

It finds what only a long history leads to, and needs gcc. That no result leaves 32 bits at the corners of the accepted
range, whatever led there, and that every operation has run, is overflow.py's part, on every machine.
"""

import argparse
import random
import sys
import time
from array import array
from pathlib import Path

if __name__ == "__main__":  # as the tests' conftest has it
    ROOT = Path(__file__).resolve().parents[1]
    sys.path[:0] = [str(ROOT / part) for part in ("lib", "tools/simulator", "tools/simulator/shim")]

import numpy as np
import translate
from upright import filters

NAMES = [name for name in filters.FILTERS if name not in filters.HARDWARE]
GYRO = [(131, 1), (131, 2), (164, 5), (82, 5)]
ACCEL = [16384, 8192, 4096, 2048, 64, 32767, 5000]
RATES = [
    (20, 1),
    (46, 1),
    (91, 1),
    (100, 1),
    (200, 1),
    (2000, 7),
    (333, 1),
    (500, 1),
    (1000, 1),
    (1439, 1),
]
BIAS = 8192 * 256
FULL = (-32768, 32767)
# filters without a table of parameters: (least, most)
RANGES = {
    "mahony": {"kp": (0.01, 100), "ki": (1e-6, 20), "bias_limit_dps": (0.1, 250)},
    "euler": {"tau": (0.01, 1000)},
    "kalman": {
        "q_angle": (1e-6, 100),
        "q_bias": (1e-9, 10),
        "r_angle": (1e-3, 1e4),
        "bias_limit_dps": (0.1, 250),
    },
}


def words(rng, n):
    """n samples of three axes, in one of the ways that are hard on integers."""
    kind = rng.integers(10)
    if kind == 0:
        return rng.integers(-32768, 32768, (n, 3))
    if kind == 1:
        return rng.choice(FULL, (n, 3))
    if kind == 2:  # stuck, at full scale or dead
        return np.tile(rng.choice((*FULL, 0), 3), (n, 1))
    if kind == 3:  # at rest, anywhere
        return rng.integers(-30, 31, (n, 3)) + rng.integers(-3000, 3001, 3)
    if kind == 4:  # a square wave
        period = rng.choice((2, 3, 5, 8, 17, 50, 333))
        wave = np.sign(np.sin(2 * np.pi * np.arange(n) / period + 0.1))
        return wave[:, None] * rng.choice((-32767, 32767, 20000, 0), 3)
    if kind == 5:
        return rng.integers(-5, 6, (n, 3))
    if kind == 6:  # a slow wave of any size
        wave = np.sin(2 * np.pi * np.arange(n) / rng.uniform(20, 2000))
        return wave[:, None] * rng.uniform(-32767, 32767, 3)
    if kind == 7:  # at rest near the largest bias
        return rng.integers(-3, 4, (n, 3)) + rng.choice((-8192, 8192, 0), 3)
    if kind == 8:
        return np.zeros((n, 3))
    return rng.normal(0, rng.choice((10, 100, 1000, 8000)), (n, 3))


def stretches(rng):
    """Some stretches of 50 to 3000 samples, each (n, 11)."""
    parts = []
    for _ in range(rng.integers(1, 12)):
        n = int(rng.choice((50, 500, 3000)))
        part = np.zeros((n, 11))
        for at in (0, 3, 6):
            part[:, at : at + 3] = words(rng, n)
        kind = rng.integers(6)
        if kind < 2:
            part[:, 10] = 3
        elif kind == 2:
            part[:, 10] = rng.integers(0, 16, n)
        elif kind == 3:
            part[:, 10] = np.where(np.arange(n) % rng.choice((2, 5, 20, 200)) == 0, 3, 1)
        elif kind == 4:
            part[:, 10] = rng.choice((0, 3), n, p=(0.9, 0.1))
        else:
            part[:, 10] = 1
        parts.append(part.clip(*FULL).astype(np.int16))
    return parts


def gains(rnd, kind, name):
    """Parameters of a filter's class: none, or some anywhere in their ranges and at their ends."""
    if rnd.random() < 0.4:
        return {}
    table = getattr(kind, "PARAMETERS", None)
    ranges = RANGES.get(name.rstrip("69"), {})
    if table:
        ranges = {key: row[1:] for key, row in table.items() if rnd.random() < 0.4}
    out = {}
    for key, (least, most) in ranges.items():
        any_value = least * (most / least) ** rnd.random() if least > 0 else most * rnd.random()
        out[key] = rnd.choice((least, most, float(f"{any_value:.5g}")))
        if not table and least < 1e-5 and rnd.random() < 0.3:
            out[key] = 0
    return out


def case(number, names=NAMES):
    """One case: (steps, what it was, what was wrong: [str]); no steps where the set-up is refused."""
    rnd, rng = random.Random(number), np.random.default_rng(number)
    name = rnd.choice(names)
    rate = rnd.choice([*RATES, (rnd.randrange(20, 1440), 1), (rnd.randrange(400, 14000), 7)])
    scale, lsb = rnd.choice(GYRO), rnd.choice(ACCEL)
    module, kind = filters.FILTERS[name]
    kind = getattr(__import__("upright." + module, None, None, (kind,)), kind)
    given = gains(rnd, kind, name)
    what = f"case {number}: {name}, {rate[0]}/{rate[1]} Hz, {scale}, {lsb}, {given}"
    try:
        run = translate.make(name, rate, scale, lsb, **given)
    except ValueError:
        return 0, what, []
    filter = run.filter

    def new_bias():
        known_s = rnd.choice((0, 1, 10, 100, 3600))
        filter.set_bias(
            *(rnd.choice((0, BIAS, -BIAS, rnd.randint(-BIAS, BIAS))) for _ in range(3)), known_s
        )

    if rnd.random() < 0.7:
        new_bias()
    parts = stretches(rng)
    start = rnd.randrange(3)
    if start == 0:
        filter.seed(array("h", parts[0][0].tolist()))
    elif start == 1:
        filter.set_quaternion(*rng.normal(0, 1, 4))
    else:
        filter.set_quaternion(
            *rnd.choice(((1, 0, 0, 0), (0, 1, 0, 0), (1, 1, 0, 0), (1, 0, -1, 0)))
        )
    steps = 0
    for i in [*range(len(parts)), *rng.integers(0, len(parts), 30)]:
        run.run(parts[i], every=0)
        steps += len(parts[i])
        if rnd.random() < 0.02:
            new_bias()
    wrong = [str(overflow) for overflow in run.overflows()]
    length = np.linalg.norm(np.array(filter.state[1:5]) / (1 << 29))
    if abs(length - 1) > 1e-3:
        wrong.append(f"the quaternion's length is {length:.5f}")
    return steps, what, wrong


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument(
        "--from", type=int, default=0, dest="first", help="number of the first case"
    )
    parser.add_argument("--case", type=int, help="run this one alone")
    parser.add_argument(
        "names", nargs="*", default=NAMES, metavar="NAME", help="filters; all of them"
    )
    asked = parser.parse_args(arguments)
    if not translate.GCC:
        print(translate.NO_GCC)
        return 1
    if asked.case is not None:
        _, what, wrong = case(asked.case, asked.names)
        print("\n  ".join([what, *wrong]))
        return bool(wrong)
    end, number, steps, seen = time.monotonic() + asked.seconds, asked.first, 0, {}
    while time.monotonic() < end:
        n, what, wrong = case(number, asked.names)
        steps += n
        number += 1
        for text in wrong:
            place = text.partition(" = ")[0]
            if place not in seen:
                print(f"{what}\n  {text}", flush=True)
            seen[place] = seen.get(place, 0) + 1
    print(f"{steps / 1e6:.1f} million steps in the cases {asked.first} to {number - 1}")
    for place, times in seen.items():
        print(f"{place}: in {times} cases")
    return bool(seen)


if __name__ == "__main__":
    sys.exit(main())
