"""The boards of the nine-axis modules: the firmware boots on each, finds its magnetometer, and knows north."""

import pytest
import upright
from chips.ak8963 import AK8963Chip
from chips.hmc5883l import HMC5883LChip
from imus import RIGS
from upright import ahrs
from upright_host import demo
from world import StillWorld

SECOND = 1_000_000
MODULES = {
    "GY-87 with HMC5883L": ("gy87_pico", {}, "HMC5883L"),
    "GY-87 with QMC5883L": ("gy87_pico", {"mag_chip": "QMC5883L"}, "QMC5883L"),
    "MPU9250": ("mpu9250_pico", {}, "AK8963"),
    "MPU9255": ("mpu9250_pico", {"who_am_i": 0x73}, "AK8963"),
}


@pytest.fixture(params=MODULES)
def module(request):
    """(board, options, its magnetometer)"""
    return MODULES[request.param]


def booted(board, runtime="cpython", seconds=5, board_settings=None, **config):
    source = demo.motion_source("demo", seconds, board)
    source.board.update(board_settings or {})
    return demo.run(source, runtime, **config)


def test_it_finds_its_magnetometer_and_north(module):
    board, options, chip = module
    run = booted(board, **options)
    assert f"magnetometer: {chip}, 100/1 Hz" in run.console
    result = run.result
    assert (result["filter"], result["axes"]) == ("inertial9", 9)
    assert result["crashes"] == result["errors"] == result["cuts"] == result["resets"] == 0
    assert result["mag_errors"] == result["mag_resets"] == 0
    assert (
        result["mag_stale"] == 0
    )  # at the start it is polled, faster than its rate was planned for
    assert result["mag_fresh"] >= result["steps"] // 2 - 5
    assert run.score.total < 2.5


def test_the_tick_allocates_nothing(micropython_runtime):
    for board, options, _ in list(MODULES.values())[:3]:
        result = booted(board, micropython_runtime, 3, **options).result
        assert result["heap_checked"] and result["started"]
        assert result["crashes"] == result["uncaught"] == 0


def test_with_the_fifo_it_is_read_by_each_tick(module):
    board, options, _ = module
    result = booted(board, board_settings={"DRIVE": "fifo"}, **options).result
    assert result["crashes"] == result["fifo_overflows"] == result["mag_errors"] == 0
    assert result["mag_fresh"] > 25


def test_without_its_magnetometer_it_goes_on_with_six_axes(module):
    board, options, chip = module
    run = booted(board, mag=False, **options)
    assert run.result["steps"] > 400 and run.result["crashes"] == 0
    wanted = (
        "no AK8963 at 0x0c" if chip == "AK8963" else "no magnetometer on the bus of the MPU6050"
    )
    assert any(wanted in line for line in run.console)


@pytest.mark.parametrize("part", ["imu", "mag"])
def test_a_brown_out_in_flight_is_mended(module, part):
    """That of the IMU also ends the bypass, which comes back with its other registers."""
    board, options, _ = module
    faults = [[3 * SECOND, part, "brown_out", None]]
    result = booted(board, seconds=6, faults=faults, **options).result
    assert result["resets"] == (1 if part == "imu" else 0)
    assert result["mag_resets"] <= 1
    assert result["crashes"] == 0
    assert result["mag_fresh"] > 350


# The face


@pytest.fixture
def i2c(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ahrs.running.clear()
    yield
    ahrs.running.clear()


@pytest.mark.parametrize("name", ["auto", "HMC5883L"])
def test_the_face_takes_a_name(i2c, name):
    world = StillWorld((0, 0, 4096, 0, 0, 0, 66, 0, -132))
    chip = RIGS["MPU6050"].wired(world)
    chip.aux.append(HMC5883LChip(world))
    imu = upright.AHRS(
        RIGS["MPU6050"].driver(), magnetometer=name, measure_bias=False, log=None
    ).start()
    assert imu.status()["magnetometer"] == "HMC5883L"
    assert imu.filter.AXES == 9


def test_another_one_than_the_named_is_said_and_six_axes_go_on(i2c):
    world = StillWorld((0, 0, 4096, 0, 0, 0, 66, 0, -132))
    chip = RIGS["MPU6050"].wired(world)
    chip.aux.append(AK8963Chip(world))
    lines = []
    imu = upright.AHRS(
        RIGS["MPU6050"].driver(),
        magnetometer="HMC5883L",
        measure_bias=False,
        log=lambda *words: lines.append(" ".join(str(word) for word in words)),
    ).start()
    assert any("no HMC5883L" in line and "AK8963 at 0x0c" in line for line in lines)
    status = imu.status()
    assert status["running"] and status["magnetometer"] is None and status["magnetometer_lost"]


@pytest.mark.parametrize("who, name", [(0x70, "MPU6500"), (0x71, "MPU9250"), (0x73, "MPU9255")])
@pytest.mark.parametrize("bus", ["MPU6500", "MPU6500_I2C", "MPU6050"])
def test_the_identity_names_the_part_on_either_bus(who, name, bus):
    rig = RIGS[bus]
    if bus == "MPU6050":  # the driver for it, with another chip on the module
        rig = type(rig)(rig.cls, RIGS["MPU6500_I2C"].chip)
    _, imu = rig.running(who_am_i=who)
    assert (imu.chip, imu.who_am_i, imu.fifo.size) == (name, who, 512)
