"""Runs viper functions under CPython with every intermediate result held to 32 bits.

`load` rewrites the syntax tree of a module: in each function decorated with @micropython.viper
every arithmetic result, every shift count and every stored value goes through a check. What passes
here cannot wrap on a 32-bit board.
"""

import ast
import sys
import types
from dataclasses import dataclass, field

import upright

LOW, HIGH = -(1 << 31), (1 << 31) - 1
SMALL = 1 << 30  # an argument or result beyond +- this is boxed on a 32-bit port


class Overflow(AssertionError):
    """A value that does not fit; the message says which and where."""


@dataclass
class Site:
    """One checked operation of the source, and the extremes that it has taken."""

    function: str
    line: int
    text: str
    low: int = 0
    high: int = 0
    hits: int = 0

    def __str__(self):
        return f"{self.function}, line {self.line}: {self.text}"

    @property
    def used(self):
        """The largest magnitude seen as a part of the range."""
        return max(self.high, -self.low) / (1 << 31)


@dataclass
class Watch:
    """All checked operations of the modules that were loaded with it."""

    sites: list = field(default_factory=list)
    functions: set = field(default_factory=set)
    called: set = field(default_factory=set)

    def add(self, function, node):
        self.sites.append(Site(function, node.lineno, ast.unparse(node)))
        return len(self.sites) - 1

    def check(self, value, number):
        if type(value) is int:
            site = self.sites[number]
            site.hits += 1
            if value > site.high:
                site.high = value
                if value > HIGH:
                    raise Overflow(f"{site} = {value}")
            elif value < site.low:
                site.low = value
                if value < LOW:
                    raise Overflow(f"{site} = {value}")
        return value

    def shift(self, count, number):
        if not 0 <= count <= 31:
            raise Overflow(f"{self.sites[number]}: shift by {count}")
        return count

    def call(self, name, arguments):
        self.called.add(name)
        for value in arguments:
            if type(value) is int and not -SMALL <= value < SMALL:
                raise Overflow(f"{name}: the argument {value} would be boxed")

    def result(self, value, name):
        if type(value) is int and not -SMALL <= value < SMALL:
            raise Overflow(f"{name}: the result {value} would be boxed")
        return value

    def missed(self):
        """The operations, and the functions, that have never run."""
        return sorted(self.functions - self.called) + [str(s) for s in self.sites if not s.hits]

    def largest(self, n):
        return sorted(self.sites, key=lambda site: -site.used)[:n]


def _is_viper(node):
    return isinstance(node, ast.FunctionDef) and any(
        isinstance(d, ast.Attribute) and d.attr == "viper" for d in node.decorator_list
    )


def _call(method, *arguments):
    return ast.Call(
        ast.Attribute(ast.Name("_watch", ast.Load()), method, ast.Load()), list(arguments), []
    )


class _Checks(ast.NodeTransformer):
    """Puts the checks into one viper function."""

    def __init__(self, watch, function):
        self.watch = watch
        self.function = function

    def _checked(self, node, shown):
        number = ast.Constant(self.watch.add(self.function, shown))
        if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.LShift, ast.RShift)):
            node.right = _call("shift", node.right, number)
        return _call("check", node, number)

    def visit_BinOp(self, node):
        shown = ast.copy_location(ast.BinOp(node.left, node.op, node.right), node)
        text = ast.parse(ast.unparse(shown), mode="eval").body
        text.lineno = node.lineno
        self.generic_visit(node)
        return self._checked(node, text)

    def visit_UnaryOp(self, node):
        self.generic_visit(node)
        if isinstance(node.op, ast.Not):
            return node
        return self._checked(node, node)

    def visit_AugAssign(self, node):
        load = ast.parse(ast.unparse(node.target), mode="eval").body
        plain = ast.copy_location(
            ast.Assign([node.target], ast.BinOp(load, node.op, node.value)), node
        )
        plain.value.lineno = node.lineno
        return self.visit(plain)

    def visit_Assign(self, node):
        shown = ast.parse(ast.unparse(node)).body[0]
        shown.lineno = node.lineno
        self.generic_visit(node)
        if any(isinstance(target, ast.Subscript) for target in node.targets):
            node.value = self._checked(node.value, shown)
        return node

    def visit_Return(self, node):
        self.generic_visit(node)
        if node.value is not None:
            node.value = _call("result", node.value, ast.Constant(self.function))
        return node


def load(name, source, watch):
    """Execute the module text `source` as the module `name` with checked viper functions; returns the module.

    A module loaded later may import it: see `loaded`.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if _is_viper(node):
            function = f"{name}.{node.name}"
            watch.functions.add(function)
            checks = _Checks(watch, function)
            body = [checks.visit(statement) for statement in node.body]
            names = [ast.Name(a.arg, ast.Load()) for a in node.args.args]
            entry = ast.Expr(_call("call", ast.Constant(function), ast.Tuple(names, ast.Load())))
            node.body = [entry, *body]
    ast.fix_missing_locations(tree)
    module = types.ModuleType(name)
    module._watch = watch
    exec(compile(tree, f"{name}.py (checked)", "exec"), module.__dict__)
    return module


def loaded(paths, watch):
    """The modules at `paths` (pathlib), in order, each importing the checked ones before it: a dict by name."""
    modules, before = {}, {}
    try:
        for path in paths:
            module = load(path.stem, path.read_text(), watch)
            name = f"upright.{path.stem}"
            before[name] = sys.modules.get(name)
            modules[path.stem] = sys.modules[name] = module
            setattr(upright, path.stem, module)
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
                delattr(upright, name.partition(".")[2])
            else:
                sys.modules[name] = module
                setattr(upright, name.partition(".")[2], module)
    return modules


def word(rng):
    """Any word of a sample, and the largest foremost."""
    return rng.choice((-32768, 32767, 32766, rng.randint(-32768, 32767), rng.randint(-900, 900)))


def stand_still(rng, filter, row, at):
    """Let the rest detector of a filter with the words `at` be content with a sample, at any bias that was set."""
    s = filter.state
    filter.set_bias(*(rng.choice((-(1 << 21), 1 << 21, 0)) for _ in range(3)))
    most = s[at.REST_MOST] // 4096
    for i in range(3):
        low = rng.choice((-most, most))
        row[3 + i] = low + s[at.BASE + i] // 256
        s[at.LOW1 + 3 + i] = s[at.LOW2 + 3 + i] = low << 12
        s[at.GS + i] = row[3 + i] * ((1 << s[at.BLOCK]) - 1)
        s[at.LOW1 + i] = s[at.LOW2 + i] = row[i] << 12
    s[at.BLOCKS] = 1000
    s[at.STILL] = rng.choice((s[at.REST_AFTER], 0))


def hold_back(rng, s, at):
    """Any state that earth_kernels.believe_later() can come to. s: the filter's state, at: where its words stand."""
    most = (s[at.FULL_MOST] + 1) * (56756 * 8 + (s[at.ONE_G] >> 6))
    s[at.FULL_END], s[at.FULL_STEPS] = rng.randrange(7), rng.randint(0, s[at.FULL_MOST] + 1)
    for first, size in ((at.FULL_SUM, most), (at.LATER, 0x1FFFFFFF)):
        for i in range(3):
            s[first + i] = rng.choice((-size, size, 0, rng.randint(-size, size)))
    s[at.LATER_ANY] = 1
