"""Filters as C: the unix port's bits, and every value that leaves 32 bits is found."""

import importlib.util
from array import array

import motions
import numpy as np
import pytest
import translate
from samples import SOFTWARE
from upright import filters
from upright_host.simulate import best_runtime as quickest

pytestmark = pytest.mark.skipif(not translate.GCC, reason=translate.NO_GCC)

PLANTED = """
from array import array
import micropython

@micropython.viper
def squared(s: ptr32, n: int) -> int:
    return n * n

@micropython.viper
def shifted(n: int, by: int) -> int:
    return n >> by

class Planted:
    def __init__(self):
        self.state = array("i", [-1, 0, 0])

    @micropython.viper
    def update(self, counts):
        state = self.state
        s = ptr32(state)
        c = ptr16(counts)
        n = ((c[0] & 0xFFFF) ^ 0x8000) - 0x8000
        s[1] = int(squared(state, n)) << 1
        s[2] = int(shifted(n, c[1])) // c[2] + n % c[2]
"""


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """A class whose update() has an overflow that only some samples show."""
    path = tmp_path_factory.mktemp("planted") / "planted.py"
    path.write_text(PLANTED)
    spec = importlib.util.spec_from_file_location("planted", path)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(translate.sys.modules, "planted", module)
        spec.loader.exec_module(module)
        yield module.Planted


def rows(*first):
    """Samples with these first three words."""
    counts = np.zeros((len(first), 11), np.int16)
    counts[:, :3] = first
    return counts


@pytest.mark.parametrize("name", SOFTWARE)
@pytest.mark.parametrize("motion", ["hand", "bursts"])
def test_the_bits_of_every_state_word_are_those_of_the_port(filter_history, name, motion):
    rendered = motions.render(motion, rate=(200, 1), seconds=20, gyro_range_dps=500)
    of_interest = list(range(1, len(_made(name, rendered).filter.state)))
    port = filter_history(quickest(), rendered, name, mag_every=3, words=of_interest)
    counts = rendered.counts.copy()
    counts[:, 10] = np.where(np.arange(len(counts)) % 3 == 0, 3, 1)
    full = (counts[:, :3] == -32768) | (counts[:, :3] == 32767)
    counts[:, 10] += 4 * full.any(1).astype(np.int16)
    ours, run = translate.history(rendered, name, of_interest, counts=counts)
    differ = np.flatnonzero((ours != port.words).any(1))
    assert not len(differ), f"from step {differ[0]} on"
    assert run.overflows() == []


def _made(name, rendered):
    return translate.make(name, rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g)


def test_a_filter_goes_on_where_it_was_and_its_own_readings_see_it():
    run = translate.make("inertial6", 200, (82, 5), 4096)
    row = np.array([[0, 0, 4096, 10, -20, 30, 0, 0, 0, 0, 1]], np.int16)
    run.filter.seed(array("h", row[0].tolist()))
    whole = run.run(np.repeat(row, 1000, 0), every=100)
    assert whole.shape == (10, 4)
    assert list(whole[-1]) == list(run.filter.state[1:5])
    assert run.run(np.repeat(row, 300, 0), every=0).shape == (0, 4)
    assert run.filter.resting
    bias = array("i", [0] * 3)
    run.filter.bias(bias)
    assert np.abs(np.array(bias) / 256 - (10, -20, 30)).max() < 0.1


def test_all_that_update_calls_is_translated():
    functions = translate.program(filters._class("inertial9").update).functions
    assert {"inertial.update", "fixmath.turn", "inertial_kalman.take"} <= set(functions)


def found(run, *first):
    run.run(rows(*first), every=0)
    return [(o.function, o.line, o.text, o.value, o.step, o.times) for o in run.overflows()]


def test_a_value_that_does_not_fit_is_found_with_its_place_its_value_and_its_step(planted):
    run = translate.Translated(planted())
    assert run.run(rows((23170, 2, 7), (-7, 2, 7)), (1, 2)).tolist() == [
        [1073697800, 827],
        [98, -1],
    ]
    assert run.overflows() == []
    assert found(run, (1, 2, 7), (-32768, 2, 7), (-32768, 2, 7)) == [
        ("planted.update", 23, "int(squared(state, n)) << 1", 1 << 31, 1, 2),
        ("planted.squared", 7, "return n * n", 1 << 30, 1, 2),  # a 32-bit port would box it
    ]
    assert found(run, (1, 32, 7)) == [("planted.shifted", 11, "n >> by", 32, 0, 1)]
    assert [f[2] for f in found(run, (1, 1, 0))] == [
        "int(shifted(n, c[1])) // c[2]",
        "n % c[2]",
    ]


def test_what_cannot_be_translated_is_said(planted):
    with pytest.raises(translate.Untranslatable, match="no viper function"):
        translate.Program(planted.__init__)
