# What MicroPython's compiler makes of viper code that some of its versions get wrong (docs/numerics.md). To be run as a
# source, compiled by the runtime itself, or imported as what mpy-cross made of it: show() prints what each gives.

from array import array

import micropython


@micropython.viper
def masked(x: int) -> int:
    return x & 0x1FFFFFFF


@micropython.viper
def index32(p: ptr32, i: int) -> int:
    p[i] = p[i] + 1
    return i


@micropython.viper
def index16(p: ptr16, i: int) -> int:
    p[i] = p[i] + 1
    return i


@micropython.viper
def index8(p: ptr8, i: int) -> int:
    p[i] = p[i] + 1
    return i


@micropython.viper
def computed(p: ptr32, i: int) -> int:
    p[i + 0] = p[i + 0] + 1
    return i


@micropython.viper
def negated(x: int) -> int:
    y = -x
    return x + 0 * y


@micropython.viper
def inverted(x: int) -> int:
    y = ~x
    return x + 0 * y


def show():
    """Every one is asked with 3 and gives 3 where it is right; an index may be read and written."""
    words = array("i", [0] * 64)
    print(
        *("index32", index32(words, 3), "index16", index16(words, 3), "index8", index8(words, 3)),
        *("computed", computed(words, 3), "negated", negated(3), "inverted", inverted(3)),
    )
    print("masked", masked(3))


if __name__ == "__main__":
    show()
