"""The default filters in scenes that every user meets: each figure is at most what the scene's limits say."""

import field_scenes
import pytest
import translate
from field_scenes import SCENES

# What the filters do not reach yet
# a field turned at equal strength and dip, while the body moves: believed after 8 s, as if the attitude were wrong
BEYOND = ("field turned by 32 for 22", "field turned by -54 for 13", "field turned by 45 for 20")
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


@pytest.mark.parametrize("name, axes", list(cases()))
def test_a_scene_stays_within_its_limits(name, axes):
    hold(name, axes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 7))
@pytest.mark.parametrize("axes", [6, 9])
def test_the_kalman_filter_forgets_a_start_in_the_middle_of_a_motion_too(axes, seed):
    hold(f"thrown {seed}", axes, "quaternion-kalman")
