"""boards/robomaster_a: the stm32 port takes its MicroPython board definition, and board.py is at one with that.

The firmware runs on the simulated one: nine axes at 1 kHz, a magnetometer behind the IMU, and what goes wrong.
"""

import importlib.util
import json
import re
import subprocess
import sys
import types

import machine
import motions
import numpy as np
import pytest
from conftest import healthy
from upright import calibration, timing
from upright_host import debian, paths, simulate

BOARD = paths.BOARDS / "robomaster_a"
DEFINITION = BOARD / "ROBOMASTER_A"
SECOND = 1000000
FILTER = "mahony9"  # the figures are its


@pytest.fixture(scope="module")
def port():
    """ports/stm32 of the MicroPython that Debian packages the sources of."""
    try:
        tree = debian.source(
            "micropython", debian.SUITE, paths.cache() / f"sources/micropython-{debian.SUITE}"
        )
    except debian.AptError as why:
        pytest.skip(f"MicroPython's sources: {why}")
    return tree / "ports/stm32"


def defines():
    """mpconfigboard.h and the HAL's configuration -> {name: value without its brackets}."""
    text = (DEFINITION / "mpconfigboard.h").read_text()
    text += (DEFINITION / "stm32f4xx_hal_conf.h").read_text()
    found = re.findall(r"^#define +(\w+) +(\S.*?) *(?://.*)?$", text, re.MULTILINE)
    return {name: value.strip("()") for name, value in found}


def settings():
    """mpconfigboard.mk -> {name: value}."""
    text = (DEFINITION / "mpconfigboard.mk").read_text()
    return dict(re.findall(r"^(\w+) *\??= *(.*)$", text, re.MULTILINE))


def pins():
    """pins.csv -> {name on the board: pin}; a hidden pin's name is empty."""
    lines = (DEFINITION / "pins.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines if line and line[0] != "#"]
    return {name or pin: pin.lstrip("-") for name, pin in rows}


def wired():
    """What the header gives to peripherals -> {(peripheral, number, function): pin}."""
    out = {}
    for name, value in defines().items():
        match = re.fullmatch(r"MICROPY_HW_(SPI|I2C|UART|CAN)(\d)_([A-Z]+)", name)
        if match and value.startswith("pin_"):
            kind, number, function = match.groups()
            out[kind, int(number), function] = "P" + value[4:]
    return out


KINDS = ("source", "header", "af-const", "af-defs")


def make_pins(port, pins_csv, tmp_path):
    table = port / settings()["AF_FILE"]
    outputs = [f"--output-{kind}={tmp_path / kind}" for kind in KINDS]
    command = [sys.executable, "boards/make-pins.py", "--board-csv", pins_csv, "--af-csv", table]
    command += ["--prefix", "boards/stm32f4xx_prefix.c", *outputs]
    return subprocess.run(command, cwd=port, capture_output=True, text=True)


# ---------------------------------------------------------------- the definition


def test_the_port_takes_the_pins(port, tmp_path):
    done = make_pins(port, DEFINITION / "pins.csv", tmp_path)
    assert done.returncode == 0, done.stderr
    header = (tmp_path / "header").read_text()
    for pin in pins().values():
        assert re.search(rf"\bpin_{pin[1:]}\b", header), pin
    # the alternate functions of the two buses, as the port compiles them in
    source = (tmp_path / "source").read_text()
    for function in ("SPI, 5, SCK", "SPI, 5, MISO", "SPI, 5, MOSI", "SPI, 1, SCK", "SPI, 1, MOSI"):
        assert function in source


@pytest.mark.parametrize("wrong", ["IMU_NSS,PZ6", "IMU_NSS,F6", "IMU_NSS,PF6,PF7"])
def test_the_port_refuses_pins_that_are_none(port, tmp_path, wrong):
    wrong_csv = tmp_path / "pins.csv"
    wrong_csv.write_text((DEFINITION / "pins.csv").read_text().replace("IMU_NSS,PF6", wrong))
    assert make_pins(port, wrong_csv, tmp_path).returncode != 0


def test_every_pin_can_do_what_the_header_wants_of_it(port):
    rows = (port / settings()["AF_FILE"]).read_text().splitlines()[2:]
    can = {
        row.split(",")[1].strip(): {name.strip() for name in re.split("[,/]", row)} for row in rows
    }
    assert len(wired()) > 15
    for (kind, number, function), pin in wired().items():
        kinds = ("UART", "USART") if kind == "UART" else (kind,)
        assert {f"{k}{number}_{function}" for k in kinds} & can[pin], (kind, number, function, pin)


def test_the_files_that_the_makefile_names_are_the_ports(port):
    for name in [*settings()["LD_FILES"].split(), settings()["AF_FILE"]]:
        assert (port / name).exists(), name
    script = (port / settings()["LD_FILES"].split()[0]).read_text()
    areas = {
        name: (int(start, 16), int(kib) * 1024)
        for name, start, kib in re.findall(
            r"(\w+) \(\w+\) *: *ORIGIN = (\w+), LENGTH = +(\d+)K", script
        )
    }
    # STM32F427xI: 2 MiB of flash, 192 KiB of RAM and 64 KiB beside the core
    assert areas["FLASH"] == (0x08000000, 2048 * 1024)
    assert areas["RAM"] == (0x20000000, 192 * 1024)
    assert areas["CCMRAM"] == (0x10000000, 64 * 1024)
    assert areas["FLASH_START"][0] == int(settings()["TEXT0_ADDR"], 0)
    assert areas["FLASH_TEXT"][0] == int(settings()["TEXT1_ADDR"], 0)


def test_the_file_system_has_room_for_more_than_the_library(port):
    script = (port / settings()["LD_FILES"].split()[0]).read_text()
    sizes = dict(re.findall(r"(FLASH_FS2?) .*LENGTH = +(\d+)K", script))
    assert defines()["MICROPY_HW_ENABLE_INTERNAL_FLASH_STORAGE_SEGMENT2"] == "1"
    assert sum(map(int, sizes.values())) == 256


def test_the_clock_tree_gives_168_MHz_and_USB_its_48():
    d = defines()
    hse, m, n, q = (
        int(d[name]) for name in ("HSE_VALUE", *(f"MICROPY_HW_CLK_PLL{factor}" for factor in "MNQ"))
    )
    assert d["MICROPY_HW_CLK_PLLP"] == "RCC_PLLP_DIV2"
    assert hse == 12000000
    assert 1000000 <= hse // m <= 2000000  # the PLL's input, RM0090 7.3.2
    vco = hse // m * n
    assert 100000000 <= vco <= 432000000
    assert vco // 2 == 168000000
    assert vco / q == 48000000


def test_every_pin_of_the_header_and_of_board_py_is_in_the_list():
    known = set(pins().values())
    header = (DEFINITION / "mpconfigboard.h").read_text()
    of_header = {"P" + name for name in re.findall(r"\bpin_([A-I]\d+)\b", header)}
    of_board = set(re.findall(r'Pin\("(P[A-Z]\d+)"', (BOARD / "board.py").read_text()))
    assert {"PF6", "PE2", "PB9", "PB10", "PB8"} <= of_board
    assert of_header | of_board <= known
    assert len(known) == len(pins()), "a pin stands twice in the list"


def test_the_card_is_off_since_it_shares_the_sensors_DMA_stream(port):
    assert defines()["MICROPY_HW_ENABLE_SDCARD"] == "0"
    dma = re.sub(r"/\*.*?\*/|//[^\n]*", "", (port / "dma.c").read_text(), flags=re.DOTALL)
    # those of the F4 name a channel, those of newer families a request
    streams = dict(re.findall(r"dma_(\w+) = \{ (DMA\d_Stream\d), DMA_CHANNEL_\d", dma))
    assert streams["SDIO_0"] == streams["SPI_5_RX"]  # else the reason is gone
    of_the_tick = {streams["SPI_5_RX"], streams["SPI_5_TX"]}
    assert not of_the_tick & {streams["SPI_1_RX"], streams["SPI_1_TX"]}


def test_a_transfer_in_the_tick_ends_since_DMA_interrupts_come_first(port):
    irq = (port / "irq.h").read_text()
    level = {
        name: int(re.search(rf"IRQ_PRI_{name} +NVIC_EncodePriority\(\w+, (\d+),", irq)[1])
        for name in ("DMA", "TIMX", "SYSTICK")
    }
    assert level["SYSTICK"] < level["DMA"] < level["TIMX"]


def test_the_manifest_is_the_ports():
    included = []
    exec((DEFINITION / "manifest.py").read_text(), {"include": included.append})
    assert included == ["$(PORT_DIR)/boards/manifest.py"]
    assert settings()["FROZEN_MANIFEST"] == "$(BOARD_DIR)/manifest.py"


# ---------------------------------------------------------------- board.py on the simulated machine


class Probe:
    """Records a reset pin."""

    def __init__(self):
        self.levels = []

    def reset_pin(self, level, now):
        self.levels.append((level, now))


@pytest.fixture
def board():
    spec = importlib.util.spec_from_file_location("board_robomaster_a", BOARD / "board.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_board_py_is_one_that_the_firmware_takes(board):
    from upright.settings import Settings, of_board

    settings = Settings(of_board(board))
    settings.check(9)
    assert (settings.RATE, settings.DRIVE, settings.FILTER) == ((1000, 1), "timer", None)
    assert not settings.DISPLAY_SHARES_BUS
    assert board.data_ready_pin() is not None
    assert board.sensor() is not None
    assert board.display(32) is not None


def test_the_magnetometers_map_makes_its_left_handed_frame_right_handed(board):
    from upright_app import axis_check

    assert axis_check.handedness(axis_check.parse(board.IMU_AXES)) == 1
    assert axis_check.handedness(axis_check.parse(board.MAG_AXES)) == -1


def test_the_magnetometer_is_reset_by_its_pin_and_given_its_time(board):
    probe = Probe()
    machine.wire_reset("PE2", probe)
    board.magnetometer(board.sensor())
    (low, at), (high, then) = probe.levels
    assert (low, high) == (0, 1)
    assert then - at >= 1000
    assert machine.kernel.now() - then >= 50000


def test_the_tick_is_a_hard_timer_of_exactly_a_millisecond(board, monkeypatch):
    class Timer:
        def __init__(self, number):
            self.number = number

        def init(self, freq=None, prescaler=None, period=None):
            self.cycles = 0 if freq else (prescaler + 1) * (period + 1)

        def source_freq(self):
            return 84000000  # TIM7: twice APB1 (RM0090, clock tree)

        def callback(self, function):
            self.function = function

    monkeypatch.setattr(timing, "_taken", [])
    monkeypatch.setattr(timing, "pyb", types.SimpleNamespace(Timer=Timer))
    ticker = board.make_tick((1000, 1), print)
    assert ticker.hard
    assert ticker.timer.number == 7
    assert ticker.timer.cycles == 84000
    assert ticker.period_us == 1000


# ---------------------------------------------------------------- where the sources come from


def test_sources_are_fetched_once(port, monkeypatch):
    def refuse(*args, **options):
        raise AssertionError("fetched again")

    monkeypatch.setattr(debian, "Apt", refuse)
    tree = port.parents[1]
    assert debian.source("micropython", debian.SUITE, tree) == tree


def test_a_mirror_that_is_dead_is_said_in_one_line_and_leaves_nothing(monkeypatch, tmp_path):
    if not debian.shutil.which("apt-get"):
        pytest.skip("no apt-get here")
    monkeypatch.setattr(debian.Apt, "_mirror", staticmethod(lambda: f"file:{tmp_path}/nowhere"))
    into = tmp_path / "sources" / "micropython"
    (into.parent / ".micropython-unpacking-killed").mkdir(parents=True)
    with pytest.raises(debian.AptError) as why:
        debian.source("micropython", debian.SUITE, into)
    assert "\n" not in str(why.value)
    assert [path.name for path in into.parent.iterdir()] == [".micropython.lock"]


def test_a_damaged_archive_is_said_in_one_line(tmp_path):
    (tmp_path / "x_1.dsc").write_text("")
    (tmp_path / "x_1.orig.tar.xz").write_bytes(b"no archive")
    with pytest.raises(debian.AptError, match=r"x_1\.orig\.tar\.xz cannot be unpacked"):
        debian._unpack_source(tmp_path)


# ---------------------------------------------------------------- the firmware on it


@pytest.fixture
def boot(boot_board, demo_world):
    def run(runtime=None, flash=None, **config):
        config = {"board_name": BOARD.name, "world": str(demo_world[0]), "seconds": 5} | config
        config["board"] = {"FILTER": FILTER} | config.get("board", {})
        return boot_board(runtime, flash, **config)

    return run


def first_after(run, at_us, bit):
    """Microseconds from a moment to the first step whose sample has this bit of the flags."""
    after = run.times[(run.times > at_us) & (run.flags & bit != 0)]
    assert len(after), f"never again bit {bit}"
    return after[0] - at_us


def longest_gap(run, bit, since_us=0):
    """The longest time in us between two steps whose samples have this bit of the flags."""
    return int(np.diff(run.times[(run.times >= since_us) & (run.flags & bit != 0)]).max())


def test_nine_axes_at_1_khz_on_every_runtime_with_the_same_bits(firmware_runtime, boot, demo_world):
    run = boot(firmware_runtime)
    healthy(run.result)
    assert run.result["missed"] == run.result["errors"] == run.result["mag_errors"] == 0
    assert run.result["filter"] == FILTER
    assert run.result["chip"] == "MPU6500"
    assert run.result["mag_stale"] == 0
    seconds = len(run.times) / 1000
    assert abs(np.count_nonzero(run.flags & 2) - 100 * seconds) <= 2  # each sample once
    score = run.score(demo_world[1])
    assert score.inclination < 0.6
    assert score.total < 1.5
    assert any("IST8310" in line for line in run.lines)
    if firmware_runtime != "cpython":
        there = boot("cpython")
        assert (run.rows == there.rows).all()
        assert (run.q29 == there.q29).all()
        assert run.picture == there.picture


@pytest.mark.parametrize(
    "drive",
    [{"DRIVE": "data_ready"}, {"DRIVE": "fifo", "FIFO_HZ": 200}],
    ids=["data_ready", "fifo"],
)
def test_the_other_drives_carry_the_magnetometer_too(boot, drive):
    run = boot(board=drive)
    healthy(run.result)
    assert run.result["missed"] == run.result["fifo_overflows"] == 0
    assert run.result["mag_stale"] == 0
    assert longest_gap(run, 2) <= 15000


def test_without_a_magnetometer_six_axes_go_on_and_it_is_said(boot, demo_world):
    run = boot(mag=False)
    healthy(run.result)
    assert run.result["mag_fresh"] == 0
    assert any(line.startswith("magnetometer:") and "0x0e" in line for line in run.lines)
    assert run.score(demo_world[1]).inclination < 0.6


def test_a_magnetometer_that_appears_late_is_set_up_by_the_tick(boot):
    run = boot(
        world=None,
        seconds=8,
        faults=[[0, "mag", "silent", 6 * SECOND]],
    )
    healthy(run.result)
    assert first_after(run, 6 * SECOND, 2) < 500000


def test_a_magnetometer_that_vanishes_is_done_without_and_taken_up_again(boot, demo_world):
    run = boot(
        seconds=6,
        faults=[[3 * SECOND, "mag", "silent", SECOND]],
    )
    healthy(run.result)
    gone = (run.times > 3020000) & (run.times < 4 * SECOND)
    assert not (run.flags[gone] & 2).any()
    assert (run.flags[gone] & 1).all()
    assert first_after(run, 4 * SECOND, 2) < 500000
    assert run.score(demo_world[1]).total < 2.0
    assert run.result["mag_errors"] > 0
    assert run.result["mag_stale"] > 50


def test_nack_storms_on_the_auxiliary_bus_cost_samples_of_the_magnetometer_alone(boot, demo_world):
    faults = [[2 * SECOND + 41000 * i, "mag", "nack", None, 7] for i in range(40)]
    run = boot(faults=faults)
    healthy(run.result)
    assert longest_gap(run, 1, 2 * SECOND) <= 2000
    assert longest_gap(run, 2, 2 * SECOND) < 500000
    assert run.result["errors"] == 0
    assert run.score(demo_world[1]).total < 1.5


@pytest.mark.parametrize("drive", ["timer", "data_ready", "fifo"])
def test_an_imu_that_resets_itself_is_back_in_time_and_brings_the_magnetometer(boot, drive):
    run = boot(
        world=None,
        seconds=6,
        board={"DRIVE": drive, "FIFO_HZ": 200},
        faults=[[4 * SECOND, "imu", "brown_out", None]],
    )
    healthy(run.result)
    assert run.result["resets"] == 1
    # from the reset on: the 20 ms that the chip itself is away are in it
    assert first_after(run, 4 * SECOND + 20000, 1) < 200000
    assert first_after(run, 4 * SECOND + 20000, 2) < 500000
    assert longest_gap(run, 2, 4 * SECOND + 600000) <= 20000


def test_the_attitude_and_the_bias_outlive_a_reset_of_both_chips(boot, demo_world):
    run = boot(
        seconds=8,
        faults=[[5 * SECOND, "imu", "brown_out", None], [5 * SECOND, "mag", "brown_out", None]],
    )
    healthy(run.result)
    assert run.result["bias_known"]
    assert run.result["mag_resets"] >= 1
    assert first_after(run, 5 * SECOND + 20000, 2) < 500000
    score = run.score(demo_world[1], 7 * SECOND)
    assert score.total < 6  # what it turned in the 0.1 s without samples is made up for slowly


def test_an_imu_that_nobody_hears_on_spi_is_counted_and_back_again(boot):
    run = boot(
        world=None,
        seconds=6,
        faults=[[4 * SECOND, "imu", "silent", 300000]],
    )
    healthy(run.result)
    assert run.result["errors"] >= 250
    assert first_after(run, 4300000, 1) < 200000
    assert first_after(run, 4300000, 2) < 500000


def test_sampling_slower_than_the_chip_would_lose_magnetometer_samples_and_is_refused(boot):
    with pytest.raises(simulate.SimulationError, match="SENSOR_RATE_HZ"):
        boot(board={"RATE": 200, "SENSOR_RATE_HZ": 1000})


# -- its calibration


def write_calibration(flash, **sections):
    calibration.write(str(flash / "upright_cal.json"), calibration.blank() | sections)


@pytest.fixture
def iron(tmp_path):
    """The demo's motion with a hard iron of (20, -15, 25) uT beside the magnetometer."""
    path = tmp_path / "iron.imu"
    errors = motions.Errors(mag_bias_uT=(20.0, -15.0, 25.0))
    motion = motions.render("demo", rate=(1000, 1), seconds=6, errors=errors)
    motion.write(path)
    return path, motion


@pytest.mark.slow
@pytest.mark.parametrize(
    "content, said",
    [
        (None, "calibration: none yet"),
        (json.dumps(calibration.blank() | {"checksum": "00000000"}), "checksum"),
        (json.dumps({"format": "recipe", "version": 1}), "not of the format"),
    ],
    ids=["missing", "corrupt", "foreign"],
)
def test_a_calibration_file_that_cannot_be_used_means_defaults_and_a_message(
    boot, tmp_path, content, said
):
    if content is not None:
        (tmp_path / "upright_cal.json").write_text(content)
    run = boot(flash=tmp_path)
    healthy(run.result)
    assert any(line.startswith("calibration:") and said in line for line in run.lines)


def test_a_calibration_that_cannot_be_used_is_named_on_the_display_too(boot, tmp_path):
    """While it asks for stillness, the one time at which everybody looks."""
    pictures = []
    for content in ("{}", None):
        if content:
            (tmp_path / "upright_cal.json").write_text(content)
        else:
            write_calibration(tmp_path)
        run = boot(flash=tmp_path, seconds=1)
        assert not run.result["started"]
        pictures.append(run.picture)
    title_and_two_lines, note = slice(0, 32), slice(32, 44)
    assert pictures[0][title_and_two_lines] == pictures[1][title_and_two_lines]
    assert any(map(any, pictures[0][note]))
    assert not any(map(any, pictures[1][note]))


def test_hard_iron_turns_the_heading_until_it_is_calibrated_away(boot, iron, tmp_path):
    path, motion = iron
    spoilt = boot(world=str(path))
    # body (x, y, z) is chip (y, -x, -z) on this board; 0.3 uT a count in the world
    offset = [round(1000 * v / 0.3) for v in (15.0, 20.0, -25.0)]
    write_calibration(
        tmp_path, mag={"offset_mlsb": offset, "matrix_ppm": [10**6, 0, 0, 0, 10**6, 0, 0, 0, 10**6]}
    )
    mended = boot(world=str(path), flash=tmp_path)
    healthy(mended.result)
    assert "calibration: upright_cal.json" in mended.lines
    assert spoilt.score(motion).total > 10
    assert mended.score(motion).total < 1.5


def test_the_bias_of_the_file_is_used_when_the_board_never_rests(boot, tmp_path):
    path = tmp_path / "spin.imu"
    motions.render("spin", rate=(1000, 1), seconds=8).write(path)
    write_calibration(tmp_path, gyro_bias_udps=[100000, -200000, 300000])
    run = boot(world=str(path), seconds=8, flash=tmp_path)
    healthy(run.result)
    assert run.result["bias_known"]
    assert "bias: from upright_cal.json" in run.lines
