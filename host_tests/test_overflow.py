"""No intermediate result of the viper kernels leaves 32 bits, at the corners of what the filter accepts."""

import math
import random
from array import array
from pathlib import Path

import overflow
import pytest
from upright_host import words

LIB = Path(__file__).resolve().parents[1] / "lib" / "upright"
SCALES = {250: (131, 1), 500: (131, 2), 1000: (164, 5), 2000: (82, 5)}
ONE = 1 << 29
AT = words.places("mahony")
NAMES = ("fixmath", "mahony_kernels", "mahony")


@pytest.fixture(scope="module")
def checked():
    """(watch, then the modules of NAMES) with checked viper functions; at the end nothing may have gone unexercised."""
    watch = overflow.Watch()
    modules = overflow.loaded([LIB / f"{name}.py" for name in NAMES], watch)
    return watch, *(modules[name] for name in NAMES)


def accepted(make, value):
    try:
        make(value)
    except ValueError:
        return False
    return True


def largest(make, low, high):
    """The largest integer in low..high that `make` accepts; it must accept low and refuse high."""
    assert accepted(make, low) and not accepted(make, high)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if accepted(make, middle) else (low, middle)
    return low


def corners(kind):
    """(rate, full scale, kp, ki, bias limit) at the ends of the ranges that the constructor accepts."""
    out = []
    for fsr, limit in ((2000, 20), (2000, 250), (250, 20), (500, 0)):

        def make(rate, kp=0, ki=0, fsr=fsr, limit=limit):
            return kind(rate, SCALES[fsr], 2048, kp, ki, limit)

        slow = -largest(lambda v, make=make: make(-v), -100, -1)
        fast = largest(make, 1000, 1 << 20)
        for rate in (slow, 50 if slow <= 50 else 200, 8000, fast):
            kp = largest(lambda v, r=rate, make=make: make(r, kp=v / 1000), 0, 10**9) / 1000
            ki = largest(lambda v, r=rate, make=make: make(r, ki=v / 1000), 0, 10**11) / 1000
            out.append((rate, fsr, kp, min(ki, 1e6), limit))
            # gains at which a magnetometer sample may stand for many steps, with an integral of
            # few and of many bits
            for little in (min(ki, 1e6), min(ki, 1), 3e-6 if rate <= 8000 else 1e-4):
                out.append((rate, fsr, min(kp, 0.5), little, limit))
    out.append((50, 2000, 10, 1, 20))
    return out


def random_quaternion(rng):
    v = [rng.gauss(0, 1) for _ in range(4)]
    if rng.random() < 0.3:
        v = [rng.choice((-1, 0, 0, 1)) for _ in range(4)]
    if not any(v):
        v = [0, 0, 1, 0]
    r = math.sqrt(sum(x * x for x in v))
    return [round(x / r * ONE) for x in v]


def with_extreme_low_parts(rng, values, bits):
    """The values with their low `bits` bits where a centred split leaves the largest remainder."""
    half = 1 << (bits - 1)
    return [(v >> bits << bits) + rng.choice((half - 1, half, -half + 1)) for v in values]


def extreme_counts(rng):
    def word():
        c = rng.random()
        if c < 0.5:
            return rng.choice((-32768, 32767))
        return rng.randint(-32768, 32767) if c < 0.8 else rng.randint(-1200, 1200)

    flags = rng.choice((0, 1, 3, 3, 3, 7, 5, 9))
    return array("h", [word() for _ in range(10)] + [flags])


def turned_back(q, v):
    """The earth vector v in the body of attitude q (Q29)."""
    w, x, y, z = (c / ONE for c in q)
    r = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return [sum(r[j][i] * v[j] for j in range(3)) for i in range(3)]


# Lengths of a field that are scaled to nearly 2**16 and to 2**15, then any
FIELDS = (32766.9, 16383.9, 2047.9, 32766, 16384, 16385, 8192, 128, 16, 50, 165, 333)


def extreme_field(rng, q):
    """(counts, earth-frame error) of a field that is as wrong as can be, in a few ways."""
    h = rng.choice(
        (
            (0, 1, 0),
            (0, -1, 0),
            (-1, 0, 0),
            (0, 1, 1),
            (0, -1, 1),
            (-1, 1e-3, 1),
            (-1e-3, 0, -1),
            (0, 0, 1),
            (1e-4, 1e-4, 1),
            [rng.gauss(0, 1) for _ in range(3)],
        )
    )
    norm = math.sqrt(sum(v * v for v in h))
    h = [v / norm for v in h]
    length = rng.choice(FIELDS)
    m = [max(-32767, min(32766, round(v * length))) for v in turned_back(q, h)]
    bx = math.hypot(h[0], h[1])
    return m, (h[1] * h[2], h[2] * (bx - h[0]), -h[1] * bx)


@pytest.mark.parametrize("name", ["Mahony6", "Mahony9"])
def test_nothing_leaves_32_bits_at_the_corners_of_the_accepted_range(checked, name):
    *_, mahony = checked
    kind = getattr(mahony, name)
    rng = random.Random(1)
    out = array("i", bytes(12))
    limit = 8192 * 256
    for rate, fsr, kp, ki, bias_limit in corners(kind):
        filter = kind(rate, SCALES[fsr], 2048, kp, ki, bias_limit)
        s = filter.state
        for i in range(90):
            if i % 5 == 0:
                filter.set_bias(*(rng.choice((-limit, limit, 0)) for _ in range(3)))
                s[1:5] = array("i", with_extreme_low_parts(rng, random_quaternion(rng), 15))
                for j in range(3):
                    s[mahony._I + j] = n = rng.choice((-1, 0, 1)) * s[mahony._I_MAX]
                    s[mahony._O + j] = (n >> s[mahony._I_SHIFT]) - s[mahony._B + j]
                    s[mahony._IR + j] = (1 << s[mahony._KI_SHIFT]) - 1
                    s[mahony._WR + j] = 32767
            counts = extreme_counts(rng)
            if i % 3 == 0:
                # both errors at their largest, in the same direction, after many steps without a sample
                field, e = extreme_field(rng, s[1:5])
                up = turned_back(s[1:5], (-e[1], e[0], e[2] / 3))
                norm = math.hypot(*up) or 1
                counts[0:3] = array("h", [round(v / norm * 32000) for v in up])
                counts[6:9] = array("h", field)
                counts[10] = 3
                s[mahony._MAG_AGE] = rng.choice((0, 1, 4, 1 << 29))
            if i % 10 == 5:  # all of it on one axis
                s[1:5] = array("i", [ONE, 0, 0, 0])
                counts[6:9] = array("h", [0, rng.choice((-32766, 32766)), 0])
                counts[10] = 3
                s[mahony._MAG_AGE] = 1 << 29
            if i % 7 == 0:  # everything on one side: gyro and bias against each other on all axes
                for j in range(3):
                    counts[3 + j] = -32768 if filter.bias_set[j] > 0 else 32767
            filter.update(counts)
            filter.angles(out, rng.choice(("zyx", "zxy")))
            assert abs(math.hypot(*s[1:5]) / ONE - 1) < 1e-3


def test_nothing_leaves_32_bits_in_the_kernels_at_their_own_limits(checked):
    """Beyond what the filter feeds them: every half angle below 1 rad, every vector, every attitude."""
    _, fixmath, mahony_kernels, _ = checked
    rng = random.Random(2)
    out = array("i", bytes(12))
    s = array("i", bytes(4 * AT.size))
    s[0] = -1
    for i in range(4000):
        q = random_quaternion(rng)
        s[1:5] = array("i", with_extreme_low_parts(rng, q, 15) if i & 1 else q)
        for j in range(4):
            s[AT.QR + j] = rng.choice((0, 32767))
        d = [rng.choice((-1, 1, 0.01, rng.gauss(0, 1))) for _ in range(3)]
        if (
            i % 3 == 0
        ):  # along the quaternion's own vector part, where the sums of products are largest
            d = [v or 1e-9 for v in q[1:]]
        norm = math.sqrt(sum(v * v for v in d))
        size = 0x7FFEFFFF * rng.choice((1, 1, rng.random(), rng.random() ** 4))
        w = [int(v / norm * size) for v in d]
        s[AT.W : AT.W + 3] = array("i", w)
        for j in range(3):
            s[AT.WR + j] = rng.choice((0, 32767))
        s[AT.LOW] = 4
        counts = extreme_counts(rng)
        if i % 5 == 0:
            counts[0], counts[1], counts[2] = rng.randint(-9, 9), rng.randint(-9, 9), 4
        mahony_kernels.tilt(s, counts)
        field, e = extreme_field(rng, s[1:5])
        norm = math.hypot(*e) or 1
        # the other error's largest, in the same direction
        e = turned_back(s[1:5], [v / norm * ONE for v in e])
        s[AT.E : AT.E + 3] = array("i", [int(v) for v in e])
        counts[6:9] = array("h", field if i & 3 else extreme_counts(rng)[6:9])
        mahony_kernels.north(s, counts, rng.choice((1, 2, 5, 13, 61, mahony_kernels.STEPS_MAX)))
        fixmath.euler(s[1:5], out, ("zyx", "zxy")[i & 1])
        fixmath.turn(s)
        assert abs(math.hypot(*s[1:5]) / ONE - 1) < 1e-4
        factor = fixmath.scale(0, 1 + rng.randrange(1 << rng.randrange(1, 30)), 1 << 30)
        words = [rng.choice((-(1 << 30), (1 << 30) - 1, 32767, rng.randint(-9, 9))) for _ in "xyz"]
        fixmath.add_scaled(array("i", words), out, factor)
        out[0] = out[1] = out[2] = rng.choice((-1, 1)) << 21


def test_every_operation_of_every_viper_function_was_exercised(checked):
    """The two tests above leave nothing out. They run again here: in parallel they may have run in another process."""
    test_nothing_leaves_32_bits_at_the_corners_of_the_accepted_range(checked, "Mahony9")
    test_nothing_leaves_32_bits_in_the_kernels_at_their_own_limits(checked)
    watch, *_ = checked
    assert watch.missed() == []
    assert watch.functions == {
        "mahony_kernels.tilt",
        "mahony_kernels.north",
        "fixmath.turn",
        "fixmath._euler",
        "fixmath.add_scaled",
        "mahony.update",
    }


SOURCE = """
import micropython
@micropython.viper
def square(s: ptr32, x: int) -> int:
    y = x * x
    s[0] = y >> 4
    return s[0] >> 1
def plain(x):
    return x * x
"""


@pytest.mark.parametrize(
    "change, x, said",
    [
        ("", 46341, "square, line 5: x * x = 2147488281"),
        (("y >> 4", "y << 33"), 1, "shift by 33"),
        (("y >> 4", "y * 4 - y + y"), 24000, "= 2304000000"),
        (("s[0] >> 1", "x << 16"), 30000, "result 1966080000 would be boxed"),
        ("", 1 << 30, "argument 1073741824 would be boxed"),
        (("y = x * x", "y = x; y *= x"), 50000, "x * x"),
    ],
)
def test_a_function_that_overflows_is_caught(change, x, said):
    source = SOURCE.replace(*change) if change else SOURCE
    module = overflow.load("twin", source, overflow.Watch())
    module.plain(1 << 40)  # not a viper function: not held to anything
    if x > 1:
        module.square([0], 1)
    with pytest.raises(overflow.Overflow) as caught:
        module.square([0], x)
    assert said in str(caught.value).replace("y * x", "x * x")


def test_an_operation_that_never_ran_is_reported():
    watch = overflow.Watch()
    module = overflow.load("twin", SOURCE, watch)
    assert "twin.square" in watch.missed()
    module.square([0], 3)
    assert watch.missed() == []
