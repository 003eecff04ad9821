"""Every file that a board runs compiles to machine code for every processor that MicroPython boards have."""

import subprocess

import pytest
from upright_host import paths, runtimes

FILES = sorted(
    [*paths.PACKAGE.glob("*.py"), *paths.FIRMWARE.rglob("*.py"), *paths.BOARDS.glob("*/board.py")]
)
TARGETS = [
    (version, march)
    for version in runtimes.MPY_CROSS_VERSIONS
    for march in ("armv6m", "armv7emsp", "xtensawin", "rv32imc")
    if (version, march) != (runtimes.MPY_CROSS_VERSIONS[0], "rv32imc")  # it cannot, in all of 1.25
]
# and those that no board of boards/ has, with the newest only
TARGETS += [
    (runtimes.MPY_CROSS_VERSIONS[-1], m) for m in ("armv7m", "armv7em", "armv7emdp", "xtensa")
]


def compiler(version):
    try:
        return runtimes.mpy_cross(version)
    except runtimes.Unavailable as why:
        pytest.skip(f"mpy-cross {version}: {why}")


def compile_file(binary, march, file, out):
    return subprocess.run(
        [binary, f"-march={march}", "-o", out, file], capture_output=True, text=True
    )


@pytest.mark.parametrize("version, march", TARGETS)
def test_every_file_compiles(version, march, tmp_path):
    binary = compiler(version)
    assert len(FILES) > 10
    for file in FILES:
        done = compile_file(binary, march, file, tmp_path / "out.mpy")
        assert done.returncode == 0, f"{file.name} for {march} with {version}: {done.stderr}"


def test_a_viper_function_that_no_processor_can_take_is_noticed(tmp_path):
    source = tmp_path / "wrong.py"
    source.write_text(
        "import micropython\n@micropython.viper\ndef f(x: int) -> int:\n    return x ** 2\n"
    )
    binary = compiler(runtimes.MPY_CROSS_VERSIONS[-1])
    assert compile_file(binary, "armv6m", source, tmp_path / "out.mpy").returncode != 0
