"""docs/architecture.md: its picture is that of the imports, and the way of a sample names what there is."""

import ast
import re
import runpy

from upright_host import paths

DRAWN = runpy.run_path(str(paths.ROOT / "tools" / "maintain" / "draw_imports.py"))
PAGE = (paths.ROOT / "docs" / "architecture.md").read_text()


def test_the_picture_is_that_of_the_imports():
    known = DRAWN["modules"]()
    new = [name for name in known if not DRAWN["box_of"](name)]
    assert not new, "say in BOXES of tools/maintain/draw_imports.py where these belong"
    assert DRAWN["PICTURE"].read_text() == DRAWN["draw"](known), (
        "run tools/maintain/draw_imports.py"
    )


def test_the_way_of_a_sample_names_functions_that_there_are():
    rows = re.findall(r"\| `(\w+)\.py` \| `([\w.]+)` \|", PAGE)
    assert len(rows) > 10
    for module, function in rows:
        *parents, name = function.split(".")
        scope = ast.parse((paths.PACKAGE / f"{module}.py").read_text()).body
        for parent in parents:
            (scope,) = (n.body for n in scope if isinstance(n, ast.ClassDef) and n.name == parent)
        assert name in [n.name for n in scope if isinstance(n, ast.FunctionDef)], (module, function)
