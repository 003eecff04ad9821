"""MicroPython's qemu port as a runtime: the host's files on the board, and what its compilers make of viper code."""

import shutil
import subprocess
import time

import pytest
from conftest import PORTABLE, require
from upright_host import contents, device, paths, qemu, runtimes

BOARDS = tuple(qemu.RECIPES)
# as the port says, which has one name for Thumb-2 without an FPU
ARCHITECTURE = {"m3": "armv7em", "rv32": "rv32imc"}


@pytest.fixture(params=BOARDS)
def board(request):
    """Each emulated board that runs the host's scripts, in turn."""
    return require(request.param)


def run(board, text, *args, cwd=None, **more):
    """A program given as a text."""
    start, _ = runtimes.interpreter(board)
    more = {"capture_output": True, "text": True, "timeout": 120} | more
    return subprocess.run([*start, "-c", text, *args], cwd=cwd, **more)


# ---------------------------------------------------------------- the host's files, and how a program ends
FILES = """
import os, sys
from array import array
with open("numbers", "wb") as file:
    print(file.write(array("h", [1, 2, -3])), file.write(b"ab"), file.tell())
row = array("h", [0, 0, 0])
with open("numbers", "rb") as file:
    print(file.readinto(row), list(row), file.read(), file.read(), file.seek(2), file.read(2), file.seek(0, 2))
with open("text", "w") as file:
    file.write("one\\ntwo \\u00b0\\n")
with open("text", "a") as file:
    file.write("three")
with open("text") as file:
    print([line for line in file])
os.rename("text", "renamed")
os.remove("numbers")
print(os.stat("renamed")[0] == 0x8000, os.stat("renamed")[6], os.stat("folder")[0] == 0x4000)
for absent in (lambda: open("text"), lambda: os.stat("numbers"), lambda: os.remove("text")):
    try:
        absent()
    except OSError as why:
        print(why.errno, end=" ")
"""


def test_the_boards_files_are_the_hosts(board, tmp_path):
    (tmp_path / "folder").mkdir()
    done = run(board, FILES, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "6 2 8",
        "6 [1, 2, -3] b'ab' b'' 2 b'\\x02\\x00' 8",
        r"['one\n', 'two \xb0\n', 'three']",
        "True 16 True",
        "2 2 2 ",
    ]
    assert (tmp_path / "renamed").read_text("utf-8") == "one\ntwo °\nthree"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "renamed"]


@pytest.mark.parametrize(
    "text, status, said",
    [
        ("pass", 0, ""),
        ("import sys; sys.exit(7)", 7, ""),
        ("raise SystemExit", 0, ""),
        ("1 / 0", 1, "ZeroDivisionError: divide by zero"),
        ("raise KeyboardInterrupt", 1, "KeyboardInterrupt: "),
        ("import nothing", 1, "ImportError: no module named 'nothing'"),
        ("print('\\u00b0' * 3, 'x' * 100000)", 0, ""),
    ],
)
def test_a_program_ends_with_its_status_and_its_traceback_on_standard_error(
    board, text, status, said
):
    done = run(board, text)
    assert (done.returncode, (done.stderr.splitlines() or [""])[-1]) == (status, said)
    assert done.stdout == ("°°° " + "x" * 100000 + "\n" if "print" in text else "")


def test_a_board_ends_with_its_host_process(board):
    """Killed, as a test is that took too long, it leaves no board behind that computes for ever."""
    start, _ = runtimes.interpreter(board)
    endless = "print('here')\nwhile True: pass"
    with subprocess.Popen([*start, "-c", endless], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"here\n"
            (child,) = children(process.pid)
        finally:
            process.kill()
    for _ in range(200):
        if not alive(child):
            return
        time.sleep(0.05)
    pytest.fail("the emulated board goes on")


def children(pid):
    return [int(n) for n in open(f"/proc/{pid}/task/{pid}/children").read().split()]


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_firmware_that_does_not_come_up_is_said(board, tmp_path):
    start, _ = runtimes.interpreter(board)
    image = next(i for i, word in enumerate(start) if word.endswith(".elf"))
    start = [*start[:image], str(tmp_path / "absent.elf"), *start[image + 1 :]]
    done = subprocess.run([*start, "-c", "pass"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "the board ended with" in done.stderr


def test_a_failure_before_the_program_is_said(board, tmp_path):
    start, _ = runtimes.interpreter(board)
    run_py = next(i for i, word in enumerate(start) if word.endswith("run.py"))
    shutil.copy(start[run_py], tmp_path)
    (tmp_path / "board.py").write_text("print('begins')\n1 / 0\n")
    start = [*start[:run_py], str(tmp_path / "run.py"), *start[run_py + 1 :]]
    done = subprocess.run([*start, "-c", "pass"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "begins\n")
    assert done.stderr.splitlines()[-1] == "ZeroDivisionError: divide by zero"


# ---------------------------------------------------------------- compiled code
class Link:
    """What device.facts asks a board through."""

    def __init__(self, board):
        self._board = board

    def exec(self, text):
        done = run(self._board, text)
        assert done.returncode == 0, done.stderr
        return done.stdout.encode()


def test_what_upright_flash_would_compile_for_it_runs_there(board, tmp_path):
    """find_compiler's choice: 1.25.0's masked() never returns on RISC-V."""
    facts = device.facts(Link(board))
    assert (facts.architecture, facts.viper) == (ARCHITECTURE[board], True)
    try:
        compiler = contents.find_compiler(facts)
    except runtimes.Unavailable as why:
        pytest.skip(str(why))
    compiled = contents.compile_module(compiler, facts.architecture, PORTABLE / "emitter.py")
    (tmp_path / "compiled.mpy").write_bytes(compiled)
    done = run(board, "import compiled\ncompiled.show()", cwd=tmp_path)
    assert done.stderr == ""
    assert done.stdout.split()[1::2] == ["3"] * 7


def test_1_25_compiles_code_for_risc_v_that_never_ends(tmp_path):
    require("rv32")
    try:
        compiler = runtimes.mpy_cross(runtimes.MPY_CROSS_VERSIONS[0])
    except runtimes.Unavailable as why:
        pytest.skip(str(why))
    compiled = contents.compile_module(compiler, "rv32imc", PORTABLE / "emitter.py")
    (tmp_path / "compiled.mpy").write_bytes(compiled)
    start, _ = runtimes.interpreter("rv32")
    text = "import compiled\nprint('asked')\ncompiled.masked(3)"
    with subprocess.Popen([*start, "-c", text], cwd=tmp_path, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"asked\n"
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(2)
        finally:
            process.kill()


def test_what_the_runtimes_compiler_gets_wrong_is_what_the_docs_say(micropython_runtime, portable):
    name = micropython_runtime
    _, version = runtimes.interpreter(name)
    version = tuple(int(n) for n in version.split(".")[:2])
    words = portable(name, "emitter.py").split()
    found = dict(zip(words[::2], map(int, words[1::2]), strict=True))
    wrong = {word: value for word, value in found.items() if value != 3}
    expected = {}
    if name in BOARDS and (1, 26) <= version <= (1, 27):
        expected |= {"index32": 3 << 2 * 2, "index16": 3 << 2}
    if version <= (1, 28):
        expected |= {"negated": -3, "inverted": ~3}
    assert wrong == expected


def test_what_goes_over_the_raw_prompt_has_no_byte_that_ends_it():
    text = (paths.SIMULATOR / "qemu" / "board.py").read_text("ascii")
    assert not {"\x01", "\x02", "\x03", "\x04", "\x05"} & {*text}
