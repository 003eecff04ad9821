"""The constants in the filters' modules are those of the tables of state words."""

import pytest
from upright_host import paths, words


@pytest.mark.parametrize("module", words.MODULES)
def test_a_module_s_constants_are_those_of_the_table(module):
    text = (paths.PACKAGE / f"{module}.py").read_text()
    assert words.written(text, module) == text, "run python -m upright_host.words"


def test_every_word_is_used():
    assert words.unused() == []


def test_a_constant_that_moved_is_seen_and_written():
    text = (paths.PACKAGE / "mahony.py").read_text()
    moved = text.replace("_KP = const(46)", "_KP = const(47)")
    assert moved != text
    assert words.written(moved, "mahony") == text


def test_the_words_that_two_states_share_stand_in_the_same_places():
    earth = words.table(words.EARTH)
    for state in ("inertial", "quaternion_kalman"):
        assert {name: words.STATES[state][name] for name in earth} == earth
    for name, word in words.STATES["inertial"].items():
        if name in ("PROBE", "Q", "QR", "W", "WR"):  # fixmath.turn works on both
            assert word.at == words.STATES["mahony"][name].at


def test_a_table_with_a_name_twice_is_refused():
    with pytest.raises(ValueError, match="two words are named Q"):
        words.table("Q 4 Q29 x\nQ 1 - y\n")


def test_a_module_without_a_place_for_its_words_is_refused():
    with pytest.raises(ValueError, match=r"mahony.py has no place for its words"):
        words.written("x = 1\n", "mahony")
