"""`upright dmp check`: what a file is, in few lines; what is wrong with it, in one."""

import hashlib
import subprocess
import sys

import pytest
import typer
from dmp_images import LIST, V20, V612
from typer.testing import CliRunner
from upright import dmp_image as mpu_dmp_image
from upright_host import console, dmp, paths

APP = typer.Typer(cls=console.Commands)
dmp.register(APP)


def run(*args):
    """(exit code, output) of `upright dmp check`."""
    done = CliRunner().invoke(APP, ["dmp", "check", *map(str, args)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def refused(*args):
    """The one line that it says."""
    code, output = run(*args)
    assert code == 2 and len(output.strip().splitlines()) == 1
    return output.strip()


@pytest.fixture
def file(tmp_path):
    """file(data, name): a file with these bytes, or this text."""

    def make(data, name="dmp.bin"):
        path = tmp_path / name
        path.write_bytes(data.encode() if isinstance(data, str) else data)
        return path

    return make


def digest(data):
    return hashlib.sha256(data).hexdigest()


def header(*arrays, macro=""):
    """A C header as the images are spread."""
    text = "// DMP image, 0x12 0x34\n#define DMP_CODE_SIZE 3062\n" + macro
    for name, data in arrays:
        text += f"const unsigned char {name}[{len(data)}] PROGMEM = {{\n/* bank # 0, 0x99 */\n"
        for at in range(0, len(data), 16):
            row = ", ".join(f"0x{b:02X}" for b in data[at : at + 16])
            text += f"    {row}, // 0xEE\n"
        text += "};\n\n"
    return text


@pytest.fixture
def known(monkeypatch):
    monkeypatch.setattr(
        dmp, "KNOWN", {digest(V612): "a stand-in", digest(V20 + LIST): "another stand-in"}
    )


@pytest.mark.parametrize(
    "data, version, start, packet",
    [(V612, "v6.12", "0x0400", 28), (V20 + LIST, "v2.0", "0x0300", 42)],
)
def test_a_known_image_is_described(known, file, data, version, start, packet):
    code, output = run(file(data))
    assert code == 0
    for word in (version, start, f"{packet} bytes", digest(data), "stand-in", "banks 0 to"):
        assert word in output
    assert f"list behind it {19 if version == 'v2.0' else 0} bytes" in output


def test_an_unknown_one_is_refused_with_its_hash_unless_that_is_named(file):
    path = file(V612)
    line = refused(path)
    assert digest(V612) in line and "not known" in line and "--sha256" in line
    code, output = run(path, "--sha256", digest(V612).upper())
    assert code == 0 and "the one that you named" in output
    assert f"is {digest(V612)}, not {digest(V20)}" in refused(path, "--sha256", digest(V20))


@pytest.mark.parametrize("at", [0, 1500, 3061])
def test_one_flipped_byte_is_another_hash(known, file, at):
    data = bytearray(V612)
    data[at] ^= 1
    assert "not known" in refused(file(bytes(data)))


def test_a_missing_file_a_folder_and_an_empty_one_are_named(file, tmp_path):
    assert "nothing.bin: No such file" in refused(tmp_path / "nothing.bin")
    assert "directory" in refused(tmp_path)
    assert "dmp.bin is empty" in refused(file(b""))


@pytest.mark.parametrize("size", [100, 500, 1928])
def test_another_size_is_refused(known, file, size):
    line = refused(file(V612[:size]))
    assert f"3062 bytes (v6.12) or 1929 (v2.0), this file {size}" in line


@pytest.mark.parametrize("data", [V612[:3061], V612 + b"\x00", V20 + LIST[:-1]])
def test_a_cut_file_or_one_with_something_behind_it_is_refused(known, file, data):
    assert f"{len(data)} bytes are no DMP image" in refused(file(data))


def test_an_image_that_lacks_its_list_is_told_so(monkeypatch, file):
    monkeypatch.setattr(dmp, "BARE", {digest(V20): "MotionApps"})
    assert "needs its configuration list behind it" in refused(file(V20))


def test_image_and_list_can_be_two_files(known, file, tmp_path):
    image, behind = file(V20), file(LIST, "list.bin")
    out = tmp_path / "out.bin"
    code, _ = run(image, behind, "--out", out)
    assert code == 0 and out.read_bytes() == V20 + LIST


def test_a_c_header_is_offered_to_be_converted_and_is(known, file, tmp_path):
    path = file(header(("dmpMemory", V612)), "dmp.h")
    line = refused(path)
    assert "text" in line and "dmpMemory (3062)" in line and "--out" in line
    out = tmp_path / "out.bin"
    code, output = run(path, "--out", out)
    assert code == 0 and out.read_bytes() == V612 and "written to" in output
    assert run(out)[0] == 0


def test_lists_in_the_header_follow_the_image_and_other_arrays_do_not(known, file, tmp_path):
    text = header(
        ("orientation", bytes(9)), ("dmpMemory", V20), ("crc", bytes(64)), ("dmpConfig", LIST)
    )
    out = tmp_path / "out.bin"
    code, _ = run(file(text, "dmp.h"), "--out", out)
    assert code == 0 and out.read_bytes() == V20 + LIST


def test_a_macro_among_the_bytes_is_looked_up(known, file, tmp_path):
    text = header(("dmpMemory", V20), ("dmpConfig", LIST), macro="#define RATE_DIVISOR 0x09\n")
    at = text.rindex("0x09")
    text = text[:at] + "RATE_DIVISOR" + text[at + 4 :]
    out = tmp_path / "out.bin"
    code, _ = run(file(text, "dmp.h"), "--out", out)
    assert code == 0 and out.read_bytes() == V20 + LIST


@pytest.mark.parametrize("kind", ["python", "bare", "decimal"])
def test_python_and_plain_numbers_are_understood_too(known, file, tmp_path, kind):
    text = {
        "python": "IMAGE = bytes([  # 0x00\n" + ",\n".join(map(hex, V612)) + "])\n",
        "bare": "\n".join(f"0x{b:02x}," for b in V612),
        "decimal": ", ".join(map(str, V612)),
    }[kind]
    out = tmp_path / "out.bin"
    code, _ = run(file(text, "dmp.txt"), "--out", out)
    assert code == 0 and out.read_bytes() == V612


@pytest.mark.parametrize(
    "text, what",
    [
        ("an image of the sea\n", "no array of bytes"),
        (header(("dmpMemory", V612[:3000])), "no array of 3062 or 1929 bytes: dmpMemory of 3000"),
        ("x[3] = { 1, 2, 3 };", "no array of 3062 or 1929 bytes: x of 3"),
        (header(("dmpMemory", V612)).replace(f"0x{V612[99]:02X}", "WHAT", 99), "'WHAT' is no byte"),
    ],
)
def test_text_that_has_no_image_is_told_so(file, tmp_path, text, what):
    out = tmp_path / "out.bin"
    assert what in refused(file(text, "x.h"), "--out", out)
    assert not out.exists()


def test_nothing_is_written_of_an_image_that_is_refused(file, tmp_path):
    out = tmp_path / "out.bin"
    assert "not known" in refused(file(header(("m", V612)), "x.h"), "--out", out)
    assert not out.exists()


def test_a_target_that_cannot_be_written_is_named(known, file, tmp_path):
    out = tmp_path / "no" / "out.bin"
    assert "out.bin cannot be written" in refused(file(V612), "--out", out)


def test_board_and_host_know_the_same_images():
    assert set(dmp.KNOWN) == set(mpu_dmp_image.KNOWN)
    assert not set(dmp.BARE) & set(dmp.KNOWN)
    assert all(len(key) == 64 and int(key, 16) for key in (*dmp.KNOWN, *dmp.BARE))


def test_no_image_is_taken_for_text():
    assert not dmp.is_text(V612) and not dmp.is_text(V20) and not dmp.is_text(LIST)
    assert dmp.is_text(header(("m", V612)).encode())


def test_the_image_module_needs_neither_the_shim_nor_numpy():
    code = "import sys; sys.path.insert(0, sys.argv[1]); from upright import dmp_image; print(len(dmp_image.KNOWN))"
    done = subprocess.run(
        [sys.executable, "-S", "-c", code, str(paths.LIB)], capture_output=True, text=True
    )
    assert done.returncode == 0 and int(done.stdout) == len(dmp.KNOWN)
