"""What holds for every filter of the registry: that the firmware runs with it; test_attitude.py has the interface."""

import hashlib
import sys

import dmp_images
import pytest
from conftest import healthy
from samples import SOFTWARE, Scales
from upright import filters
from upright_host import registry, simulate


def test_an_unknown_name_is_refused_with_those_that_there_are():
    with pytest.raises(ValueError, match=r"unknown filter 'dmp9'.*inertial9"):
        filters.make("dmp9", 200, Scales, {})


def test_a_module_that_is_not_on_the_board_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "upright.kalman", None)
    with pytest.raises(ValueError, match=r"kalman.py is not on this board: .* FILTER = 'kalman6'"):
        filters.make("kalman6", 200, Scales, {})


def test_no_samples_can_be_handed_to_a_filter_in_the_sensor():
    with pytest.raises(ValueError, match="dmp6 runs in the sensor: it cannot take samples"):
        filters.make("dmp6", 200, Scales, {})


# -- the firmware with each of them
@pytest.mark.parametrize("name", SOFTWARE)
def test_the_firmware_runs_with_it_and_nothing_is_allocated(boot_board, demo_world, name):
    path, motion = demo_world
    nine = registry.axes(name) == 9
    boot = boot_board(
        world=str(path),
        seconds=4 if nine else 7,  # which takes 1 kHz
        board_name="robomaster_a" if nine else "sim",
        board={"FILTER": name},
    )
    healthy(boot.result)
    assert boot.result["filter"] == name
    assert boot.result["missed"] == 0 and boot.result["steps"] > 800
    if boot.result["heap_checked"]:
        assert boot.result["irqs"] >= boot.result["steps"]
    score = boot.score(motion, slack=0.0005)
    assert score.inclination < 2.5
    assert (score.total if nine else score.aligned_total) < 4


def dmp_board(tmp_path, image, **board):
    file = tmp_path / "dmp.bin"
    file.write_bytes(image)
    board = {"DMP_IMAGE": str(file), "DMP_SHA256": hashlib.sha256(image).hexdigest()} | board
    return {"dmp_image": str(file), "board": {"FILTER": "dmp6", "RATE": 100} | board}


@pytest.mark.parametrize("version", dmp_images.IMAGES)
@pytest.mark.parametrize("rate", [200, 50])
def test_the_firmware_shows_what_the_dmp_says(boot_board, demo_world, tmp_path, version, rate):
    path, motion = demo_world
    config = dmp_board(tmp_path, dmp_images.IMAGES[version], RATE=rate)
    boot = boot_board(world=str(path), seconds=7, **config)
    healthy(boot.result)
    assert boot.result["filter"] == "dmp6"
    assert f"dmp: image {version}" in "\n".join(boot.lines)
    assert boot.result["fresh"] > 5 * rate
    score = boot.score(motion, slack=0.0005)
    # between two packets the attitude is as old as that
    assert score.aligned_total < (0.5 if rate == 200 else 3)


@pytest.mark.parametrize(
    "faults",
    [
        [[2_000_000, "imu", "brown_out", None]],
        [[2_000_000, "imu", "silent", 700_000]],
    ],
    ids=["brown-out", "gone for a while"],
)
def test_a_dmp_that_lost_its_program_gets_it_again_and_the_display_lives_on(
    boot_board, demo_world, tmp_path, runtime, faults
):
    config = dmp_board(tmp_path, dmp_images.V612)
    boot = boot_board(runtime, world=str(demo_world[0]), seconds=5, faults=faults, **config)
    healthy(boot.result)
    assert boot.result["resets"] == 1
    assert "dmp: loaded again" in boot.lines
    # most of a second without, and no ticks to be made up for
    assert boot.result["missed"] == 0
    assert 150 < boot.result["fresh"] < boot.result["steps"]


@pytest.mark.parametrize(
    "change, said",
    [
        ({"DMP_SHA256": "0" * 64}, "this DMP image is not known"),
        ({"DMP_IMAGE": "nowhere.bin"}, "the DMP image nowhere.bin cannot be read"),
    ],
)
def test_an_image_that_cannot_be_had_is_said_on_the_console(boot_board, tmp_path, change, said):
    config = dmp_board(tmp_path, dmp_images.V612, **change)
    boot = boot_board(seconds=2, **config)
    assert not boot.result["started"]
    assert said in "\n".join(boot.lines)


@pytest.mark.parametrize("change", [{"RATE": 30}, {"RATE": [2000, 7]}, {"DRIVE": "fifo"}])
def test_settings_that_a_dmp_cannot_keep_are_refused(boot_board, tmp_path, change):
    config = dmp_board(tmp_path, dmp_images.V612, **change)
    with pytest.raises(simulate.SimulationError, match=r"rate_hz 30|DRIVE is \"timer\""):
        boot_board(seconds=2, **config)
