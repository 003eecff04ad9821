"""The default filters in scenes that every user meets: each figure is at most what the scene's limits say."""

import field_scenes
import pytest
import translate
from field_scenes import SCENES

# What the filters do not reach yet
BEYOND = (
    *("by hand", "measured while", "parked, z", "parked, all drifted by 2", "turntable at 0.5"),
    *("bias ", "bad start 8", "bad start 9", "magnet while", "field turned"),
    *("5 minutes beside 10,15,5", "5 minutes beside -15", "push 0.3 g 2 s", "push 0.5", "car"),
    *("spin of 3000 deg/s about 1", "quick turn", "cone at 100", "cone at 200", "20 Hz"),
)
pytestmark = pytest.mark.skipif(not translate.GCC, reason=translate.NO_GCC)


def cases(kind="inertial"):
    for name, scene in SCENES.items():
        if name.startswith(BEYOND):
            continue
        for axes in scene.axes:
            yield pytest.param(name, axes, id=f"{kind}{axes}, {name}")


def hold(name, axes, kind="inertial"):
    figures = field_scenes.measured(name, f"{kind}{axes}")
    for figure, value in figures.items():
        limit = SCENES[name].limit(axes, figure)
        print(f"{figure}: {value:.2f} (at most {limit:g})")
    for figure, value in figures.items():
        assert value <= SCENES[name].limit(axes, figure), figure


@pytest.mark.parametrize("name, axes", cases())
def test_a_scene_stays_within_its_limits(name, axes):
    hold(name, axes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 7))
@pytest.mark.parametrize("axes", [6, 9])
def test_the_kalman_filter_forgets_a_start_in_the_middle_of_a_motion_too(axes, seed):
    hold(f"thrown {seed}", axes, "quaternion-kalman")
