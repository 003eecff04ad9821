"""What MicroPython's compilers get wrong in viper code does not stand in the code of a board (docs/numerics.md)."""

import ast

import pytest
from overflow import _is_viper
from upright_host import paths

FILES = sorted([*paths.PACKAGE.glob("*.py"), *paths.FIRMWARE.rglob("*.py")])
IN_REGISTERS = 3  # MAX_REGS_FOR_LOCAL_VARS of py/emitnative.c, on every processor but x86
WIDE = ("ptr16", "ptr32")  # an index of these is shifted; that of a ptr8 is not


def mentions(node):
    """The names of a function in the order in which MicroPython's compiler comes upon them (py/compile.c)."""
    if isinstance(node, ast.Name):
        yield node.id
        return
    if isinstance(node, ast.Assign):
        parts = [node.value, *node.targets]
    elif isinstance(node, ast.AnnAssign):
        parts = [node.value, node.target]
    elif isinstance(node, ast.While):
        parts = [*node.body, node.test]
    elif isinstance(node, ast.For):
        ranged = isinstance(node.iter, ast.Call) and getattr(node.iter.func, "id", "") == "range"
        first = reversed(node.iter.args) if ranged else [node.iter]
        parts = [*first, node.target, *node.body, *node.orelse]
    elif isinstance(node, ast.IfExp):
        parts = [node.test, node.body, node.orelse]
    else:
        parts = ast.iter_child_nodes(node)
    for part in parts:
        if part is not None:
            yield from mentions(part)


def in_registers(function):
    """The locals of a viper function that are kept in registers: the first three, arguments before all others."""
    if any(isinstance(node, ast.Try | ast.With) for node in ast.walk(function)):
        return []
    stored = {
        node.id
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    found = dict.fromkeys(argument.arg for argument in function.args.args)
    for statement in function.body:
        found.update((name, None) for name in mentions(statement) if name in stored)
    return [*found][:IN_REGISTERS]


def pointers(function):
    """{name: "ptr8", "ptr16" or "ptr32"} of the pointers in a viper function."""
    found = {
        a.arg: getattr(a.annotation, "id", "")
        for a in function.args.args
        if a.annotation is not None
    }
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            found |= {
                t.id: getattr(node.value.func, "id", "")
                for t in node.targets
                if isinstance(t, ast.Name)
            }
    return found


def faults(text):
    """What of a file MicroPython would compile wrongly: "function, line: expression"."""
    found = []
    for function in filter(_is_viper, ast.walk(ast.parse(text))):
        registers, kinds = in_registers(function), pointers(function)
        for node in ast.walk(function):
            if isinstance(node, ast.UnaryOp):
                wrong = isinstance(node.op, ast.USub | ast.Invert) and isinstance(
                    node.operand, ast.Name
                )
            else:
                wrong = (
                    isinstance(node, ast.Subscript)
                    and kinds.get(getattr(node.value, "id", "")) in WIDE
                    and getattr(node.slice, "id", "") in registers
                )
            if wrong:
                found.append(f"{function.name}, line {node.lineno}: {ast.unparse(node)}")
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_expression_stands_there_that_changes_a_variable_of_its_own(file):
    assert faults(file.read_text("utf-8")) == []


@pytest.mark.parametrize(
    ("arguments", "line", "wrong"),
    [
        ("p: ptr32, n: int", "n += p[n]", "p[n]"),
        ("p: ptr16, n: int", "p[n] = 5", "p[n]"),
        ("p, n: int", "q = ptr16(p); n = q[n]", "q[n]"),
        ("p: ptr32", "i = 0; j = p[i]", "p[i]"),
        ("p: ptr32, n: int", "y = 0; x = n; y = -x", "-x"),
        ("p: ptr32, n: int", "n = p[0] & ~n", "~n"),
        # what is right: a byte's index, one that is worked out or constant, the fourth variable, a negated expression
        ("p: ptr8, n: int", "n += p[n]", None),
        ("p: ptr32, n: int", "n += p[n + 1] + p[2] + p[_N]", None),
        ("p: ptr32, a: int, b: int", "i = 0; a = p[i]", None),
        ("p: ptr32, a: int", "b = 1; i = 0; a = p[i]", None),
        ("p: ptr32, n: int", "n = 0 - n + (-(n + 1)) + -5", None),
        ("p, n: int", "n = int(p[n])", None),
    ],
)
def test_what_would_be_compiled_wrongly_is_noticed(arguments, line, wrong):
    text = f"import micropython\n@micropython.viper\ndef f({arguments}):\n    {line}\n"
    assert [said.split(": ")[1] for said in faults(text)] == ([wrong] if wrong else [])


def test_variables_are_numbered_as_the_compiler_meets_them():
    text = (
        "def f(a):\n    while c:\n        b[d] = e\n        c += 1\n"
        "    for g in range(h, k):\n        g = 0\n    e = d = b = k = 1\n"
    )
    (function,) = ast.parse(text).body
    assert in_registers(function) == ["a", "e", "b"]


def passed_on(text):
    """Pointers that a viper function hands to another function: "function, line: call"."""
    found = []
    for function in filter(_is_viper, ast.walk(ast.parse(text))):
        kinds = pointers(function)
        kinds = {name for name, kind in kinds.items() if kind.startswith("ptr")}
        for node in ast.walk(function):
            if (
                isinstance(node, ast.Call)
                and getattr(node.func, "id", "") not in ("ptr8", "ptr16", "ptr32", "int", "uint")
                and kinds & {getattr(argument, "id", "") for argument in node.args}
            ):
                found.append(f"{function.name}, line {node.lineno}: {ast.unparse(node)}")
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_pointer_is_passed_on(file):
    """It would become an int, which is allocated where the heap lies above 2**30: on rv32, in some boards' SDRAM."""
    assert passed_on(file.read_text("utf-8")) == []


def test_a_pointer_that_is_passed_on_is_noticed():
    head = "import micropython\n@micropython.viper\n"
    wrong = head + "def f(s: ptr32):\n    g(s, 1)\n"
    right = (
        head
        + "def f(state, n: int):\n    s = ptr32(state)\n    g(state, n)\n    s[0] = int(s[1])\n"
    )
    assert [said.split(": ")[1] for said in passed_on(wrong)] == ["g(s, 1)"]
    assert passed_on(right) == []
