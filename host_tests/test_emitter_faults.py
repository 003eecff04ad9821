"""What MicroPython's compilers get wrong in viper code does not stand in the code of a board (docs/numerics.md)."""

import ast

import pytest
from overflow import _is_viper
from upright_host import paths

FILES = sorted([*paths.PACKAGE.glob("*.py"), *paths.FIRMWARE.rglob("*.py")])
IN_REGISTERS = 3  # MAX_REGS_FOR_LOCAL_VARS of py/emitnative.c, on every processor but x86
POINTERS = ["", "ptr8", "ptr16", "ptr32"]  # the widest last
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
        parts = [*node.body, node.test, *node.orelse]
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


def bare(node):
    """The expression without what the compiler passes through: int(), uint(), +, :=."""
    while True:
        if isinstance(node, ast.NamedExpr):
            node = node.target
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd):
            node = node.operand
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("int", "uint"):
            node = node.args[0]
        else:
            return node


def kind_of(node, kinds):
    """ "ptr8", "ptr16" or "ptr32", the widest that an expression may be; "" for what is no pointer."""
    node = bare(node)
    if isinstance(node, ast.IfExp):
        return max(kind_of(node.body, kinds), kind_of(node.orelse, kinds), key=POINTERS.index)
    name = getattr(node.func if isinstance(node, ast.Call) else node, "id", "")
    if isinstance(node, ast.Call):
        return name if name in POINTERS else ""
    return kinds.get(name, "")


def assigned(function):
    """(name, value) of every assignment, those of tuples one by one."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign | ast.NamedExpr) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        for target in targets:
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = zip(target.elts, value.elts, strict=True)
            yield from ((t.id, v) for t, v in pairs if isinstance(t, ast.Name))


def pointers(function):
    """{name: "ptr8", "ptr16" or "ptr32"} of the pointers in a viper function."""
    kinds = {
        a.arg: kind
        for a in function.args.args
        if (kind := getattr(a.annotation, "id", "")) in POINTERS
    }
    before = None
    while before != kinds:
        before = dict(kinds)
        for name, value in assigned(function):
            kind = max(kind_of(value, kinds), kinds.get(name, ""), key=POINTERS.index)
            if kind:
                kinds[name] = kind
    return kinds


def faults(text):
    """What of a file MicroPython would compile wrongly: "function, line: expression"."""
    found = []
    for function in filter(_is_viper, ast.walk(ast.parse(text))):
        registers, kinds = in_registers(function), pointers(function)
        for node in ast.walk(function):
            if isinstance(node, ast.UnaryOp):
                wrong = isinstance(node.op, ast.USub | ast.Invert) and isinstance(
                    bare(node.operand), ast.Name
                )
            else:
                wrong = (
                    isinstance(node, ast.Subscript)
                    and kind_of(node.value, kinds) in WIDE
                    and getattr(bare(node.slice), "id", "") in registers
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
        ("a, i: int", "i = ptr32(a)[i]", "ptr32(a)[i]"),
        ("p: ptr32, i: int", "q = p; i = q[i]", "q[i]"),
        ("a, i: int", "p, n = ptr32(a), 0; i = p[i]", "p[i]"),
        ("a, i: int", "p: ptr32 = ptr32(a); i = p[i]", "p[i]"),
        ("a, i: int", "p = ptr32(a) if i else ptr8(a); i = p[i]", "p[i]"),
        ("p: ptr32, i: int", "i = p[int(i)]", "p[int(i)]"),
        ("p: ptr32, i: int", "i = p[+i]", "p[+i]"),
        ("p: ptr32, i: int", "i = p[(i := 2)]", "p[(i := 2)]"),
        ("x: int", "y = -int(x)", "-int(x)"),
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
        for node in ast.walk(function):
            if (
                isinstance(node, ast.Call)
                and getattr(node.func, "id", "") not in ("ptr8", "ptr16", "ptr32", "int", "uint")
                and any(kind_of(argument, kinds) for argument in node.args)
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
