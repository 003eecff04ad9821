"""Inputs that nobody would write: files and JSON values damaged at random, from a seed, to be had again."""

import json

# What parsers stumble over
_PIECES = (
    *(b"", b"\x00", b"\xff", b"\xef\xbb\xbf", b"\n", b"\r\n", b",", b'"', b"'", b"{", b"}", b"[", b"]", b"\\"),
    *(b"NaN", b"Infinity", b"-", b"-1", b"0", b"1e999", b"0x", b"9" * 30, b"9" * 5000, b"true", b"null"),
    *(b"[" * 2000, b"(" * 300, b"{" * 60, b"-" * 3000, b"\xc3\x28", b"\xed\xa0\x80", b"/*", b"*/", b"#define "),
    *("\u0663".encode(), "\u00b2".encode(), b"1_0", b" ", b"\t", b"\x1e", b"\x7f" * 40, b"%s%n"),
)  # fmt: skip
_VALUES = (
    *(None, True, False, 0, 1, -1, 2**15, 2**31, -(2**31), 2**63, 10**30, 10**400, 1e308, 1e-320),
    *(0.5, float("nan"), float("inf"), "", "x", "\x00", "/", "../x", "a" * 5000, "\ud800", "\u00e9"),
    *([], {}, [0], [[]], {"": 0}, [None] * 3, [1e9] * 9, [True] * 3, "0x10", "1", "NaN"),
)  # fmt: skip


def damaged(rng, data: bytes) -> bytes:
    """Some bytes changed, inserted, removed, repeated, or the end missing."""
    data = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        at, kind = rng.randrange(len(data) + 1), rng.randrange(7)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 1 and data:
            data[at % len(data)] = rng.randrange(256)
        elif kind == 2:
            data[at:at] = rng.choice(_PIECES)
        elif kind == 3:
            piece = rng.choice(_PIECES)
            data[at : at + len(piece)] = piece
        elif kind == 4:
            del data[at : at + rng.choice((1, 2, 7, 100))]
        elif kind == 5:
            data[at:at] = data[at : at + rng.choice((1, 3, 40))]
        else:
            del data[at:]
    return bytes(data)


def damaged_value(rng, value):
    """A JSON value of which some part is another one, or missing, or there is one more."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        value = _damage(rng, value)
    return value


def _damage(rng, value):
    if isinstance(value, dict) and value and rng.random() < 0.85:
        value = dict(value)
        key, kind = rng.choice(list(value)), rng.randrange(10)
        if kind == 0:
            del value[key]
        elif kind == 1:
            value[rng.choice(("", "x", key + " ", "/a", "..", "\x00"))] = rng.choice(_VALUES)
        else:
            value[key] = _damage(rng, value[key])
        return value
    if isinstance(value, list) and value and rng.random() < 0.85:
        value = list(value)
        at, kind = rng.randrange(len(value)), rng.randrange(10)
        if kind == 0:
            del value[at]
        elif kind == 1:
            value.insert(at, rng.choice(_VALUES))
        else:
            value[at] = _damage(rng, value[at])
        return value
    if isinstance(value, (int, float)) and abs(value) < 1e200 and rng.random() < 0.4:
        return value * rng.choice((-1, 2, 0.5, 1000, 1e-9)) + rng.choice((0, 1, -1))
    return rng.choice(_VALUES)


def as_json(value) -> bytes:
    """A lone surrogate, NaN and all, as Python writes them."""
    return json.dumps(value).encode("utf-8", "surrogatepass")
