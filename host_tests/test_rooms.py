"""Who may import whom: tools and tests -> firmware -> lib, and the simulator apart from both tools and tests.

No module of lib/ uses an underscore name of another one: what parts of the library share is public.
"""

import ast

import pytest
from upright_host import paths

TOOLS, TESTS = paths.ROOT / "tools", paths.ROOT / "host_tests"
STAND_INS = {
    "machine",
    "time",
    "utime",
    "micropython",
}  # the simulator's, of modules that every board has


def names_in(folder):
    """What a folder on the search path offers: its modules and packages."""
    modules = {path.stem for path in folder.glob("*.py")}
    return modules | {path.parent.name for path in folder.glob("*/*.py")}


SIMULATOR = names_in(paths.SIMULATOR) - STAND_INS
HOST = {"upright_host", *names_in(TOOLS)} - {"simulator"}
TEST = {"host_tests", *names_in(TESTS)}
APPLICATION = {"upright_app", "main"}


def imports(path):
    """(module, name of the function around it or None) of each import in a file."""
    found = []

    def visit(node, function):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            function = node.name
        if isinstance(node, ast.Import):
            found.extend((alias.name, function) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            found.append((node.module, function))
            found.extend((f"{node.module}.{alias.name}", function) for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child, function)

    visit(ast.parse(path.read_text()), None)
    return found


def roots(path):
    return {module.partition(".")[0] for module, _ in imports(path)}


def files(folder):
    found = sorted(folder.rglob("*.py"))
    assert found
    return found


@pytest.mark.parametrize(
    ("folder", "never"),
    [
        (paths.LIB, APPLICATION | SIMULATOR | HOST | TEST),
        (paths.FIRMWARE, SIMULATOR | HOST | TEST),
        (paths.BOARDS, APPLICATION | SIMULATOR | HOST | TEST),
        (paths.SIMULATOR, HOST | TEST),
        (TOOLS / "upright_host", TEST),
        (TOOLS / "maintain", TEST),
    ],
    ids=lambda value: value.name if hasattr(value, "name") else "",
)
def test_a_room_imports_none_of_the_rooms_above_it(folder, never):
    for path in files(folder):
        assert not roots(path) & never, path


def test_only_timing_knows_the_machine_and_only_start_knows_the_board():
    """start() asks from_board(), which is the same without starting, and a function's import waits for its call."""
    for path in files(paths.LIB):
        for module, function in imports(path):
            if module.partition(".")[0] == "machine":
                assert path.name == "timing.py", path
            if module.partition(".")[0] == "board":
                assert (path.name, function) == ("__init__.py", "from_board"), path


def test_the_simulated_chips_know_the_library_only_through_the_bus():
    """What boots a board or measures a filter imports lib, and so does the board.py of an emulated one."""
    programs = {*paths.SIMULATOR.glob("run_*.py"), *(paths.SIMULATOR / "bench").glob("*.py")}
    programs.add(paths.SIMULATOR / "rp2040" / "spi_board.py")
    for path in files(paths.SIMULATOR):
        if path not in programs:
            assert not roots(path) & {"upright", "upright_app"}, path


def test_no_modules_of_the_command_import_each_other_in_a_circle():
    folder = TOOLS / "upright_host"
    wants = {
        path.stem: {
            module.split(".")[1]
            for module, _ in imports(path)
            if module.startswith("upright_host.")
        }
        for path in files(folder)
    }
    done = set()

    def follow(name, way):
        assert name not in way, " -> ".join([*way, name])
        if name not in done and name in wants:
            for other in sorted(wants[name]):
                follow(other, [*way, name])
            done.add(name)

    for name in wants:
        follow(name, [])


# -- what is private
def own_names(tree):
    """Underscore names that a module defines: of itself, of its classes, of their objects."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and of_self(node):
            names.add(node.attr)
    return names


def of_self(node):
    return isinstance(node.value, ast.Name) and node.value.id == "self"


def foreign_names(tree):
    """(line, name) of each use of an underscore name that the module does not define, `self` aside."""
    own = own_names(tree)
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("upright"):
            found += [(node.lineno, a.name) for a in node.names if a.name.startswith("_")]
        elif (
            isinstance(node, ast.Attribute)
            and node.attr.startswith("_")
            and not node.attr.startswith("__")
            and not of_self(node)
            and node.attr not in own
        ):
            found.append((node.lineno, node.attr))
    return found


@pytest.mark.parametrize("path", sorted(paths.PACKAGE.glob("*.py")), ids=lambda path: path.stem)
def test_a_module_uses_no_underscore_name_of_another(path):
    assert foreign_names(ast.parse(path.read_text())) == []


@pytest.mark.parametrize(
    "source",
    [
        "from upright.mpu import _x",
        "self.imu._x = 1",
        "imu._read_into(1, 2)",
        "from upright import mpu\nmpu._x",
    ],
)
def test_a_foreign_name_is_found(source):
    assert foreign_names(ast.parse(source))
