"""What the documents promise: their code runs, their links lead somewhere, their commands exist."""

import re

import kernel
import machine
import pytest
from chips.mpu6050 import MPU6050Chip
from upright_host import cli, paths
from world import StillWorld

PAGES = sorted(
    [paths.ROOT / "README.md", *paths.ROOT.glob("docs/*.md"), *paths.BOARDS.glob("*/*.md")]
)


def test_the_readmes_program_runs_and_shows_the_tilt():
    (code,) = re.findall(r"```python\n(.*?)```", (paths.ROOT / "README.md").read_text(), re.S)
    chip = MPU6050Chip(StillWorld((0, 2896, 2896)))  # rolled by 45 deg
    machine.wire_i2c(0, chip)
    kernel.stop_at(600000)
    names = {}
    with pytest.raises(kernel.PowerOff):
        exec(code, names)
    roll, pitch, yaw = names["angles"]
    assert roll == pytest.approx(45000, abs=20)
    assert pitch == pytest.approx(0, abs=20)
    assert yaw == pytest.approx(0, abs=20)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(paths.ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(paths.ROOT)))
def test_commands_exist(page):
    commands = {command.name for command in cli.app.registered_commands}
    commands |= {group.name for group in cli.app.registered_groups}
    text = page.read_text()
    named = re.findall(r"`(?:\.venv/bin/)?upright ([a-z]+)", text)
    assert set(named) <= commands
    targets = re.findall(r"^([a-z]+):", (paths.ROOT / "Makefile").read_text(), re.M)
    assert set(re.findall(r"`make ([a-z]+)", text)) <= set(targets)
