"""Ten million hostile steps: nothing leaves 32 bits."""

import fuzz_filters
import pytest
import translate
from upright import complementary

pytestmark = pytest.mark.skipif(not translate.GCC, reason=translate.NO_GCC)

EACH = 1_500_000


@pytest.mark.slow
@pytest.mark.parametrize("name", fuzz_filters.NAMES)
def test_nothing_leaves_32_bits_in_millions_of_hostile_steps(name):
    steps, number = 0, 0
    while steps < EACH:
        n, what, wrong = fuzz_filters.case(number, (name,))
        assert not wrong, f"{what}: {wrong}"
        steps += n
        number += 1


def test_a_case_is_the_same_each_time():
    first, again = (fuzz_filters.case(5, ("mahony9",)) for _ in range(2))
    assert first == again and first[0] > 1000


def test_a_value_that_leaves_32_bits_is_reported(monkeypatch, capsys):
    made = complementary.Euler6.__init__

    def with_a_shift_that_is_none(self, *arguments, **gains):
        made(self, *arguments, **gains)
        self.state[complementary._K_SHIFT] = 40

    monkeypatch.setattr(complementary.Euler6, "__init__", with_a_shift_that_is_none)
    assert fuzz_filters.main(["--seconds", "0.5", "euler6"]) == 1
    assert "complementary.step, line " in capsys.readouterr().out


def test_the_command_says_what_it_ran(capsys):
    assert fuzz_filters.main(["--seconds", "0.5", "euler6"]) == 0
    assert "million steps in the cases 0 to " in capsys.readouterr().out
    assert fuzz_filters.main(["--case", "5", "mahony9"]) == 0
    assert "case 5: mahony9, " in capsys.readouterr().out
