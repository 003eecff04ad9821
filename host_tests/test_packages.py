"""Packages for mip: up to date, complete each by itself, and installable from an index."""

import ast
import functools
import http.server
import itertools
import json
import re
import shutil
import subprocess
import threading

import pytest
from conftest import some_micropython
from unix_board import UnixBoard
from upright_host import __version__, library, packages, paths, runtimes


def test_the_package_files_are_as_they_would_be_written():
    wanted = packages.package_files()
    assert set(paths.PACKAGE.glob("*.json")) | {paths.ROOT / "package.json"} == set(wanted)
    for path, text in wanted.items():
        assert path.read_text() == text, f"{path.name}: run `upright packages`"


def test_every_module_is_in_a_package_and_every_version_is_the_projects():
    named = set()
    for path in packages.package_files():
        package = json.loads(path.read_text())
        assert [at for at, _ in package["urls"] if "__init__" in at] == ["upright/__init__.py"]
        assert package["version"] == __version__
        named |= {url.rpartition("/")[2] for _, url in package["urls"]}
        for _, url in package["urls"]:
            assert (path.parent / url).exists()
    assert named == {path.name for path in paths.PACKAGE.glob("*.py")}
    assert library.upright("__init__").__version__ == __version__
    whole = [json.loads((p / "package.json").read_text()) for p in (paths.ROOT, paths.PACKAGE)]
    for package in whole:
        assert {at for at, _ in package["urls"]} == {f"upright/{name}" for name in named}


@pytest.mark.parametrize("name", packages.names())
def test_a_module_can_be_imported_with_its_package_alone(name, tmp_path):
    start, _ = runtimes.interpreter(some_micropython())
    (tmp_path / "upright").mkdir()
    package = json.loads((paths.PACKAGE / f"{name}.json").read_text())
    for place, source in package["urls"]:
        shutil.copy(paths.PACKAGE / source, tmp_path / place)
    assert (tmp_path / "upright" / "__init__.py").exists()
    done = subprocess.run(
        [*start, "-c", f"import upright.{name}"],
        cwd=tmp_path,
        env={"MICROPYPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def needs(name):
    """The modules that the header of a module names behind "Needs"."""
    lines = itertools.takewhile(
        lambda line: line.startswith("#"), (paths.PACKAGE / f"{name}.py").read_text().splitlines()
    )
    header = " ".join(line.lstrip("# ") for line in lines)
    said = re.search(r"Needs (.*?)\.(?= [A-Z]|$)", header)
    assert said, f"{name}.py: its header does not say what it needs"
    return set(re.findall(r"(\w+)\.py", said[1]))


@pytest.mark.parametrize("name", packages.names())
def test_what_a_header_says_that_a_module_needs_is_what_it_needs(name):
    tree = ast.parse((paths.PACKAGE / f"{name}.py").read_text())
    imports = packages.imports(tree)
    also = set(packages.TOGETHER.get(name, ()))  # handed in
    assert needs(name) - also == imports - also, f"{name}.py: Needs ... (left), imports (right)"


def test_the_headers_lead_to_all_that_a_package_holds():
    for name in packages.names():
        found, wanted = {"__init__"}, [name]
        while wanted:
            module = wanted.pop()
            if module not in found:
                found.add(module)
                wanted += [*needs(module), *packages.TOGETHER.get(module, ())]
        assert found == set(packages.modules(name))


def test_the_mpu6500_comes_with_its_magnetometer():
    assert {"mpu6500", "mpu_monitor", "ist8310", "auxiliary_bus"} <= set(
        packages.modules("mpu6500")
    )
    assert "mahony" not in packages.modules("mpu6500")


@pytest.fixture
def index(tmp_path):
    """The address of a served index."""
    folder = tmp_path / "index"
    packages.write_index(folder)
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *a: None})
    handler = functools.partial(quiet, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("mpy", [True, False], ids=["mpy", "py"])
def test_mpremotes_mip_installs_from_the_index(index, tmp_path, mpy):
    from mpremote import mip

    some_micropython()
    flash = tmp_path / "flash"
    flash.mkdir()
    board = UnixBoard(flash)
    try:
        mip._install_package(board, "mahony", index, "lib", None, mpy)
        mip._install_package(board, "ssd1306", index, "lib", __version__, mpy)
        board.exec("import sys\nsys.path.append('lib')\nfrom upright import mahony, ssd1306")
        board.exec("f = mahony.Mahony6(200, (82, 5), 4096)\nf.update(bytearray(22))")
    finally:
        board.close()
    names = {path.stem for path in (flash / "lib" / "upright").iterdir()}
    assert names == {*packages.modules("mahony"), *packages.modules("ssd1306")}


def test_mip_installs_a_package_file_of_a_clone(tmp_path):
    from mpremote import mip

    some_micropython()
    board = UnixBoard(tmp_path)
    try:
        mip._install_package(board, str(paths.PACKAGE / "calibration.json"), "", "lib", None, True)
    finally:
        board.close()
    names = {path.stem for path in (tmp_path / "lib" / "upright").iterdir()}
    assert names == {*packages.modules("calibration")}
