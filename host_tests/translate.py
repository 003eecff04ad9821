"""Runs a filter of the registry as C: the same bits as on a board, a thousand times faster than under CPython.

The viper functions that `update` reaches are translated into one C file. Every intermediate result is held to 32 bits
there, every argument and result of a call to the 31 of a small int; what does not fit is counted with its place. Needs
gcc.
"""

import ast
import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
from array import array
from dataclasses import dataclass
from functools import cache

import numpy as np

GCC = shutil.which("gcc")
NO_GCC = "gcc is not installed: the filters cannot be translated"
_POINTERS = {"ptr32": "int32_t *", "ptr16": "uint16_t *", "ptr8": "uint8_t *"}
_COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_CHECKED = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}
_BITWISE = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
_DIVIDED = {ast.FloorDiv: "floor_div", ast.Mod: "floor_mod"}


@dataclass
class Overflow:
    """A place where a value did not fit: the first such value, at which step of how many, and how often."""

    function: str
    line: int
    text: str
    value: int
    step: int
    times: int

    def __str__(self):
        return f"{self.function}, line {self.line}: {self.text} = {self.value} at step {self.step}, {self.times} times"


class Untranslatable(Exception):
    """What viper takes and this does not; the message says where."""


def is_viper(node):
    return isinstance(node, ast.FunctionDef) and any(
        isinstance(d, ast.Attribute) and d.attr == "viper" for d in node.decorator_list
    )


class _Function:
    """One viper function as C. `calls`: the functions that it needs; `tables`: the arrays."""

    def __init__(self, program, function):
        self.program = program
        self.module = sys.modules[function.__module__]
        self.name = function.__module__.rpartition(".")[2] + "." + function.__name__
        self.symbol = _symbol(function)
        self.calls, self.tables = [], {}
        self.node = _node(function)
        self.types, self.locals = {}, set()
        declared = []
        for a in self.node.args.args:
            kind = a.annotation.id if a.annotation is not None else "object"
            if kind in ("int", "uint", "bool"):
                declared.append(f"int64_t {a.arg}_")
                self.types[a.arg] = "int"
            else:
                declared.append(f"{_POINTERS.get(kind, 'void *')}{a.arg}_")
                self.types[a.arg] = "pointer"
        self.prototype = f"static int64_t {self.symbol}({', '.join(declared)})"

    def c(self):
        body = self.block(self.node.body, "  ")
        lines = [self.prototype, "{"]
        lines += [f"  int64_t {name}_ = 0;" for name in sorted(self.locals)]
        return "\n".join(lines) + "\n" + body + "  return 0;\n}\n"

    # -- statements; a name of Python has a _ behind it, so that none is a word of C
    def block(self, statements, indent):
        return "".join(self.statement(s, indent) for s in statements)

    def statement(self, s, indent):
        if isinstance(s, ast.Expr):
            return "" if isinstance(s.value, ast.Constant) else f"{indent}{self.value(s.value)};\n"
        if isinstance(s, ast.Assign) and len(s.targets) == 1:
            pointer = self.pointer(s.targets[0], s.value)
            if pointer:
                return indent + pointer
            return indent + self.store(s.targets[0], self.value(s.value), s)
        if isinstance(s, ast.AugAssign):
            result = ast.copy_location(ast.BinOp(_loaded(s.target), s.op, s.value), s)
            return indent + self.store(s.target, self.value(result), s)
        if isinstance(s, ast.If):
            text = f"{indent}if ({self.value(s.test)}) {{\n{self.block(s.body, indent + '  ')}{indent}}}"
            if s.orelse:
                text += f" else {{\n{self.block(s.orelse, indent + '  ')}{indent}}}"
            return text + "\n"
        if isinstance(s, ast.While) and not s.orelse:
            return f"{indent}while ({self.value(s.test)}) {{\n{self.block(s.body, indent + '  ')}{indent}}}\n"
        if isinstance(s, ast.Return):
            result = self.small(self.value(s.value), s) if s.value else "0"
            return f"{indent}return {result};\n"
        if isinstance(s, (ast.Break, ast.Continue, ast.Pass)):
            return (
                indent
                + {"Break": "break", "Continue": "continue", "Pass": ""}[type(s).__name__]
                + ";\n"
            )
        raise self.refused(s)

    def pointer(self, target, value):
        """`s = ptr32(state)`, `table = ptr32(_TABLE)`, `state = self.state`; None if it is none of them."""
        if isinstance(value, ast.Attribute) and ast.unparse(value) == "self.state":
            self.types[target.id] = "pointer"
            return f"void *{target.id}_ = self_;\n"
        if not (isinstance(value, ast.Call) and getattr(value.func, "id", "") in _POINTERS):
            return None
        kind, (source,) = _POINTERS[value.func.id], value.args
        self.types[target.id] = "pointer"
        name = source.id + "_"
        if source.id not in self.types:
            table = getattr(self.module, source.id)
            name = f"table_{self.module.__name__.rpartition('.')[2]}_{source.id}"
            word = {"i": "int32_t", "h": "int16_t", "B": "uint8_t"}[
                "B" if isinstance(table, (bytes, bytearray)) else table.typecode
            ]
            self.tables[name] = f"static const {word} {name}[] = {{{', '.join(map(str, table))}}};"
        return f"{kind}{target.id}_ = ({kind}){name};\n"

    def store(self, target, value, node):
        if isinstance(target, ast.Name):
            if target.id not in self.types:
                self.locals.add(target.id)
            return f"{target.id}_ = {value};\n"
        return f"{target.value.id}_[{self.value(target.slice)}] = {self.checked(value, node)};\n"

    # -- expressions, all int64_t
    def value(self, n):
        if isinstance(n, ast.Constant):
            return f"{int(n.value)}LL"
        if isinstance(n, ast.Name):
            if n.id in self.types or n.id in self.locals:
                return n.id + "_"
            if hasattr(self.module, n.id):
                return f"{int(getattr(self.module, n.id))}LL"
            self.locals.add(n.id)
            return n.id + "_"
        if isinstance(n, ast.BinOp):
            return self.binary(n)
        if isinstance(n, ast.UnaryOp):
            value = self.value(n.operand)
            if isinstance(n.op, ast.USub):
                return self.checked(f"-({value})", n)
            if isinstance(n.op, ast.Not):
                return f"(int64_t)!({value})"
            if isinstance(n.op, ast.Invert):
                return f"(~({value}))"
        if isinstance(n, ast.Subscript):
            return f"(int64_t){n.value.id}_[{self.value(n.slice)}]"
        if isinstance(n, ast.BoolOp):  # as a condition, not as one of the operands
            joined = " && " if isinstance(n.op, ast.And) else " || "
            return "(int64_t)(" + joined.join(f"({self.value(v)})" for v in n.values) + ")"
        if isinstance(n, ast.Compare) and len(n.ops) == 1:
            left, right = self.value(n.left), self.value(n.comparators[0])
            return f"(int64_t)({left} {_COMPARED[type(n.ops[0])]} {right})"
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name):
            return self.call(n)
        raise self.refused(n)

    def binary(self, n):
        a, b, op = self.value(n.left), self.value(n.right), type(n.op)
        if op in _CHECKED:
            return self.checked(f"{a} {_CHECKED[op]} {b}", n)
        if op in _BITWISE:
            return f"({a} {_BITWISE[op]} {b})"
        if op in _DIVIDED:
            return self.checked(f"{_DIVIDED[op]}({a}, {b}, {self.site(n)})", n)
        if op in (ast.LShift, ast.RShift):
            if not isinstance(n.right, ast.Constant):
                b = f"count({b}, {self.site(n)})"
            return self.checked(f"{a} {'<<' if op is ast.LShift else '>>'} {b}", n)
        raise self.refused(n)

    def call(self, n):
        if n.func.id in ("int", "bool"):
            return self.value(n.args[0])
        function = getattr(self.module, n.func.id, None)
        if not callable(function):
            raise self.refused(n)
        self.calls.append(function)
        arguments = []
        for a, kind in zip(n.args, _node(function).args.args, strict=True):
            annotation = kind.annotation.id if kind.annotation is not None else "object"
            if annotation in ("int", "uint", "bool"):
                arguments.append(self.small(self.value(a), n))
            else:
                arguments.append("self_" if isinstance(a, ast.Attribute) else a.id + "_")
        return f"{_symbol(function)}({', '.join(arguments)})"

    # -- checks
    def site(self, node):
        return self.program.site(self.name, node)

    def checked(self, text, node):
        return f"fit({text}, {self.site(node)})"

    def small(self, text, node):
        return f"small({text}, {self.site(node)})"

    def refused(self, node):
        return Untranslatable(f"{self.name}, line {node.lineno}: {ast.unparse(node)}")


def _loaded(target):
    return ast.copy_location(ast.parse(ast.unparse(target), mode="eval").body, target)


def _symbol(function):
    return f"{function.__module__}_{function.__qualname__}".replace(".", "_")


@cache
def _tree(file):
    with open(file) as text:
        return ast.parse(text.read())


def _node(function):
    """Its syntax; the shim's viper leaves the function as it is."""
    code = function.__code__
    for node in ast.walk(_tree(code.co_filename)):
        if is_viper(node) and node.decorator_list[0].lineno == code.co_firstlineno:
            return node
    raise Untranslatable(f"{function.__qualname__} is no viper function")


_HEAD = r"""
#include <stdint.h>
#include <string.h>

static int64_t step, times[SITES], values[SITES], steps[SITES];

static void __attribute__((noinline, cold)) over(int64_t value, int site)
{
  if (times[site]++ == 0) {
    values[site] = value;
    steps[site] = step;
  }
}

/* what does not fit wraps, as it would on a board */
static inline int64_t fit(int64_t value, int site)
{
  if (__builtin_expect(value != (int32_t)value, 0)) {
    over(value, site);
    return (int32_t)value;
  }
  return value;
}

static inline int64_t small(int64_t value, int site)
{
  if (__builtin_expect(value < -(1LL << 30) || value >= 1LL << 30, 0))
    over(value, site);
  return (int32_t)value;
}

static inline int64_t count(int64_t value, int site)
{
  if (__builtin_expect(value < 0 || value > 31, 0)) {
    over(value, site);
    return value & 31;
  }
  return value;
}

/* rounded down, as Python's; by 0 there is none */
static inline int64_t floor_mod(int64_t a, int64_t b, int site)
{
  if (b == 0) {
    over(a, site);
    return 0;
  }
  int64_t rest = a % b;
  return rest && (rest < 0) != (b < 0) ? rest + b : rest;
}

static inline int64_t floor_div(int64_t a, int64_t b, int site)
{
  if (b == 0) {
    over(a, site);
    return 0;
  }
  return (a - floor_mod(a, b, site)) / b;
}
"""

_TAIL = r"""
void run(int32_t *state, int16_t *rows, int64_t n, int64_t every, const int32_t *words, int64_t width, int32_t *out)
{
  for (int64_t i = 0; i < n; i++) {
    UPDATE(state, rows + 11 * i);
    step++;
    if (every && (i + 1) % every == 0)
      for (int64_t k = 0; k < width; k++)
        *out++ = state[words[k]];
  }
}

int64_t overflow(int site, int64_t *value, int64_t *at)
{
  *value = values[site];
  *at = steps[site];
  return times[site];
}

void forget(void)
{
  step = 0;
  memset(times, 0, sizeof times);
}
"""


class Program:
    """The C of one viper `update(self, counts)` and of all that it calls, built and loaded."""

    def __init__(self, update):
        self.sites, self._numbers = [], {}
        order, waiting = {}, [update]
        while waiting:
            function = waiting.pop()
            if _symbol(function) not in order:
                translated = _Function(self, function)
                order[_symbol(function)] = translated, translated.c()
                waiting += translated.calls
        parts = [f"#define SITES {len(self.sites)}\n#define UPDATE {_symbol(update)}", _HEAD]
        tables = {}
        for translated, _ in order.values():
            tables |= translated.tables
            parts.append(translated.prototype + ";")
        parts += tables.values()
        parts += [text for _, text in order.values()]
        self.source = "\n".join((*parts, _TAIL))
        self.functions = sorted(translated.name for translated, _ in order.values())
        self._library = _built(self.source)

    def site(self, function, node):
        """The number of a checked operation."""
        key = function, node.lineno, node.col_offset, ast.unparse(node)
        if key not in self._numbers:
            self._numbers[key] = len(self.sites)
            self.sites.append((function, node.lineno, key[3]))
        return self._numbers[key]

    def run(self, state, rows, words, every):
        out = np.empty((len(rows) // every if every else 0, len(words)), np.int32)
        places = np.array(words, np.int32)
        self._library.run(
            *(ctypes.c_void_p(a.ctypes.data) for a in (np.frombuffer(state, np.int32), rows)),
            *(ctypes.c_int64(v) for v in (len(rows), every)),
            ctypes.c_void_p(places.ctypes.data),
            ctypes.c_int64(len(words)),
            ctypes.c_void_p(out.ctypes.data),
        )
        return out

    def overflows(self):
        """What did not fit since the last call: a list of Overflow."""
        value, at, found = ctypes.c_int64(), ctypes.c_int64(), []
        for number, site in enumerate(self.sites):
            times = self._library.overflow(number, ctypes.byref(value), ctypes.byref(at))
            if times:
                found.append(Overflow(*site, value.value, at.value, times))
        self._library.forget()
        return found


def _built(source):
    if not GCC:
        raise RuntimeError(NO_GCC)
    base = os.environ.get("UPRIGHT_CACHE") or os.path.expanduser("~/.cache/upright")
    folder = os.path.join(base, "translated")
    os.makedirs(folder, exist_ok=True)
    stem = os.path.join(folder, hashlib.sha256(source.encode()).hexdigest()[:16])
    if not os.path.exists(stem + ".so"):
        own = f"{stem}.{os.getpid()}"
        with open(own + ".c", "w") as file:
            file.write(source)
        flags = ("-O2", "-fwrapv", "-fno-strict-aliasing", "-shared", "-fPIC", "-w")
        subprocess.run([GCC, *flags, "-o", own + ".so", own + ".c"], check=True)
        os.replace(own + ".c", stem + ".c")
        os.replace(own + ".so", stem + ".so")
    library = ctypes.CDLL(stem + ".so")
    library.overflow.restype = ctypes.c_int64
    return library


@cache
def program(update):
    return Program(update)


class Translated:
    """A filter whose `run` is C; its set-up, bias, angles ... are the filter's own, on the same state."""

    def __init__(self, filter):
        self.filter = filter
        self.program = program(type(filter).update)
        self.program.overflows()

    def run(self, counts, words=(1, 2, 3, 4), every=1):
        """Steps with all rows of counts (n, 11): the words of the state after every so many of them, int32.

        every 0: none of them. Word 1 to 4: the quaternion, Q29.
        """
        rows = np.ascontiguousarray(counts, "<i2")
        assert rows.ndim == 2 and rows.shape[1] == 11, rows.shape
        return self.program.run(self.filter.state, rows, words, every)

    def attitudes(self, counts, every=1):
        """The same as quaternions (n, 4)."""
        return self.run(counts, every=every) / (1 << 29)

    def overflows(self):
        return self.program.overflows()


def make(name, rate, gyro_scale, accel_lsb_per_g, **gains):
    """A filter of the registry, translated."""
    from upright import filters

    class Scales:
        pass

    Scales.gyro_scale, Scales.accel_lsb_per_g = gyro_scale, accel_lsb_per_g
    return Translated(filters.make(name, rate, Scales, gains))


def history(rendered, name, words=(1, 2, 3, 4), bias=(), start=None, gains=None, counts=None):
    """A filter over all rows of a motion or trial, seeded with the first: (words of each step, the Translated).

    counts: instead of rendered.counts; a row's flags must be in it.
    """
    rows = rendered.counts if counts is None else counts
    run = make(name, rendered.rate, rendered.gyro_scale, rendered.accel_lsb_per_g, **(gains or {}))
    if bias:
        run.filter.set_bias(*bias)
    if start:
        run.filter.set_quaternion(*start)
    else:
        run.filter.seed(array("h", [int(v) for v in rows[0]]))
    return run.run(rows, words), run
