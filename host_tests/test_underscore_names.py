"""No module of lib/ uses an underscore name of another one: what parts of the library share is public."""

import ast

import pytest
from upright_host import paths


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
