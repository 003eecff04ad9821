"""What the documents promise: their code runs, their links lead somewhere, their commands, files and calls exist."""

import re
import subprocess

import kernel
import machine
import pytest
import upright
from chips.mpu6050 import MPU6050Chip
from upright import reading
from upright.mpu6050 import MPU6050
from upright_host import cli, paths, runtimes
from world import StillWorld

PAGES = sorted(
    [*paths.ROOT.glob("*.md"), *paths.ROOT.glob("docs/*.md"), *paths.BOARDS.glob("*/*.md")]
)
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: name(page))


def name(page):
    return str(page.relative_to(paths.ROOT))


def programs(page):
    """The Python programs of a page."""
    return re.findall(r"```python\n(.*?)```", (paths.ROOT / page).read_text(), re.S)


def test_the_readmes_module_program_shows_the_tilt():
    code = programs("README.md")[1]
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


RUN = [
    (name(page), number)
    for page in PAGES
    for number, code in enumerate(programs(page))
    if "import" in code
]


@pytest.mark.parametrize("page,number", RUN)
def test_programs_run_on_the_simulated_board(page, number, tmp_path):
    script = tmp_path / "program.py"
    script.write_text(programs(page)[number])
    argv, environment = runtimes.program("cpython", script, seconds=2)
    done = subprocess.run(
        argv, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_readmes_five_lines_print_degrees(tmp_path):
    script = tmp_path / "main.py"
    script.write_text(programs("README.md")[0])
    argv, environment = runtimes.program("cpython", script, seconds=2)
    done = subprocess.run(argv, env=environment, cwd=tmp_path, capture_output=True, text=True)
    lines = [line.split() for line in done.stdout.splitlines() if re.match(r"-?\d", line)]
    angles = [[float(word) for word in line] for line in lines]
    assert len(angles) > 20
    assert max(abs(angle) for line in angles for angle in line) < 1  # level, at rest


@EVERY_PAGE
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@EVERY_PAGE
def test_mpremote_is_the_one_of_setup_and_is_given_no_pattern(page):
    """Debian's Python refuses `pip install mpremote`; Windows' shells hand `*` over as it is."""
    commands = re.findall(r"(?:`|^ *)([\w./]*mpremote [^`\n]*)", page.read_text(), re.M)
    for command in commands:
        assert "*" not in command
        assert command.startswith(".venv/bin/mpremote ") or name(page) == "README.md"
    assert not re.search(r"^ *pip install mpremote", page.read_text(), re.M)


@EVERY_PAGE
def test_commands_exist(page):
    commands = {command.name for command in cli.app.registered_commands}
    commands |= {group.name for group in cli.app.registered_groups}
    text = page.read_text()
    named = re.findall(r"(?:`|^ *)(?:\.venv/bin/)?upright ([a-z]+)", text, re.M)
    assert set(named) <= commands
    targets = re.findall(r"^([a-z]+):", (paths.ROOT / "Makefile").read_text(), re.M)
    assert set(re.findall(r"(?:`|^ *)make ([a-z]+)", text, re.M)) <= set(targets)


@EVERY_PAGE
def test_the_files_that_are_named_exist(page):
    rooms = "lib|firmware|boards|host_tests|tools|docs"
    for named in re.findall(
        rf"(?<![\w./])(?:{rooms})/[\w/]+\.(?:py|md|json|svg)\b", page.read_text()
    ):
        if "NAME" not in named:
            assert (paths.ROOT / named).exists(), f"{page.name} names {named}"


@pytest.mark.parametrize("page", ["methods.md", "methods.zh.md"])
def test_the_functions_that_the_methods_name_are_in_the_files_beside_them(page):
    paragraphs = re.findall(
        r"^(?:In the code|代码)[:\uFF1A].*?(?:\n\n|\Z)",
        (paths.ROOT / "docs" / page).read_text(),
        re.S | re.M,
    )
    assert len(paragraphs) > 12
    for paragraph in filter(re.compile(r"\.py`").search, paragraphs):
        files = re.findall(r"`([\w/]+\.py)`", paragraph)
        text = "".join((paths.ROOT / file).read_text() for file in files)
        for named in re.findall(r"`(\w+)(?:\(\))?`", paragraph):
            assert re.search(rf"\b{named}\b", text), f"{named} is not in {files}"


def test_every_call_and_every_word_of_the_status_is_on_the_page_of_the_face():
    page = (paths.ROOT / "docs/face.md").read_text()
    machine.wire_i2c(0, MPU6050Chip(StillWorld((0, 0, 4096))))
    with upright.AHRS(MPU6050(machine.I2C(0)), log=None) as imu:
        words = set(imu.status())
    calls = {call for kind in (type(imu), reading.Reading) for call in vars(kind)}
    calls |= {call for call in vars(upright) if callable(getattr(upright, call))}
    inner = {"counts", "sample", "unwrapped_mdeg"}  # of the library's own modules
    wanted = {call for call in calls if call[0] != "_"} - inner | words
    assert {call for call in wanted if not re.search(rf"[`.,] ?{call}\b", page)} == set()
