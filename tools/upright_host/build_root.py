"""Builds MicroPython's firmware for emulated boards from Debian's packages alone.

It happens in a folder of the cache that holds a small Debian: compilers and sources unpacked, nothing installed. Of all
that only the images are kept. What one board wants is its Recipe. Several are built in one such folder.
"""

import contextlib
import email.utils
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from upright_host import console, debian, paths
from upright_host.console import Unavailable
from upright_host.debian import SUITE, Apt, AptError

MINIMUM = (1, 26)  # rp2: the first whose machine.Timer has hard callbacks
_SUITES = ("forky", "sid")  # in this order, where a MicroPython new enough is looked for
# What every build runs besides its own: a compiler for the machine at hand (mpy-cross, which freezes modules).
_TOOLS = (
    *("gcc", "libc6-dev", "make", "python3"),
    *("dash", "bash", "coreutils", "sed", "grep", "mawk", "findutils", "diffutils"),
)
# Not unpacked: documentation, and libraries for other cores than the Cortex-M0+, the Cortex-M3 and RV32IMAC.
_LEFT_OUT = (
    *("./usr/share/doc", "./usr/share/man", "./usr/share/info", "./usr/share/locale"),
    *(
        f"{folder}/{core}"
        for folder in ("./usr/lib/arm-none-eabi/newlib", "./usr/lib/gcc/arm-none-eabi/*")
        for core in (
            "arm",
            "thumb/nofp",
            "thumb/v7",
            "thumb/v7[!-]*",
            "thumb/v7-[!m]*",
            "thumb/v8*",
        )
    ),
    *(
        f"{folder}/{core}"
        for folder in (
            "./usr/lib/picolibc/riscv64-unknown-elf/lib",
            "./usr/lib/gcc/riscv64-unknown-elf/*",
        )
        for core in (
            *("release", "rv64*", "rv32e*", "rv32i", "rv32i[!m]*", "rv32im", "rv32im[!a]*"),
            *("rv32imaf*", "cc1plus", "lto1", "plugin"),
        )
    ),
    "./usr/bin/riscv64-unknown-elf-lto-dump",
)
# With the folder as $0: what of the system shows in it, then chroot with the arguments. /proc is not needed.
_ENTER = '''mount --bind /dev/null "$0/dev/null" && { mount --rbind /proc "$0/proc" || :; } && exec chroot "$@"'''
_ENVIRONMENT = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8", "HOME": "/build"}


@dataclass(frozen=True)
class Recipe:
    """How the image of one runtime is made inside the unpacked Debian, whose folder /build holds micropython/."""

    name: str  # of the runtime
    number: int  # to be raised when the build changes: images of other recipes are not taken
    tools: tuple[str, ...]  # packages, with what they depend on
    script: str  # for /bin/sh in /build; {jobs} is how many commands at a time
    product: str  # where it leaves the image, below /build
    kept: str  # the image's name in the cache
    version: Callable[[Path], str]  # of the MicroPython in an image; raises Unavailable
    alone: tuple[str, ...] = ()  # packages by themselves: what they depend on is not needed
    prepare: Callable[[Path, Callable], None] = lambda build, step: None  # before the script
    environment: dict = field(default_factory=dict)


# ---------------------------------------------------------------- the images
def image(recipe: Recipe) -> Path:
    """-> the image: the cache's, else it is built. Raises Unavailable with the reason, in one line."""
    found = cached(recipe)
    if found is None:
        why = obtain([recipe]).get(recipe.name)
        if why:
            raise Unavailable(why)
        found = cached(recipe)
    return found


def obtain(recipes: list[Recipe]) -> dict[str, str]:
    """Build what of these is missing, in one go. -> {name: reason} of those that could not be had."""
    with paths.locked("images"):
        missing = [recipe for recipe in recipes if cached(recipe) is None]
        return _build(missing) if missing else {}


def cached(recipe: Recipe) -> Path | None:
    """The newest image in the cache that was made by this recipe or handed over; that first."""

    def age(folder):
        numbers = [int(x) for x in re.findall(r"\d+", folder.name.split("-")[1])]
        return folder.name.endswith("-given"), numbers

    mine = (f"-r{recipe.number}", "-given")
    folders = [
        folder
        for folder in _place().glob(f"{recipe.name}-*")
        if folder.name.endswith(mine) and (folder / recipe.kept).exists()
    ]
    return max(folders, key=age) / recipe.kept if folders else None


def take(recipe: Recipe, path: Path) -> str:
    """Put a finished image into the cache, where it is used from now on -> its version. Raises Unavailable."""
    number = recipe.version(path)
    with paths.locked("images"):
        for former in _place().glob(f"{recipe.name}-*-given"):
            shutil.rmtree(former)
        about = {"micropython": number, "from": str(path.absolute())}
        _keep(recipe, path, number, about, "given")
    return number


def _place() -> Path:
    place = paths.cache() / "runtimes"
    place.mkdir(exist_ok=True)
    return place


def _keep(recipe: Recipe, image: Path, number: str, about: dict, kind: str) -> None:
    folder = _place() / f"{recipe.name}-{number}-{kind}"
    with tempfile.TemporaryDirectory(dir=_place(), prefix=".keeping-") as work:
        new = Path(work) / "new"
        new.mkdir()
        shutil.copyfile(image, new / recipe.kept)
        (new / "about.json").write_text(json.dumps(about, indent=1) + "\n", "utf-8")
        if folder.exists():
            folder.rename(Path(work) / "old")
        new.rename(folder)


# ---------------------------------------------------------------- building them
def _build(recipes: list[Recipe]) -> dict[str, str]:
    """-> {name: reason} of those that did not come out."""
    if sys.platform != "linux":
        return {recipe.name: "the firmware is built on Linux only" for recipe in recipes}
    place = _place()
    for left in place.glob(".building-*"):  # by a run that was killed
        shutil.rmtree(left, ignore_errors=True)
    what = ", ".join(recipe.name for recipe in recipes)
    console.say(f"firmware of {what}: building it, a few minutes, once", where=console.errors)
    with (
        console.progress("firmware", 100) as at,
        # Everything is made in here; the images alone leave it.
        tempfile.TemporaryDirectory(
            dir=place, prefix=".building-", ignore_cleanup_errors=True
        ) as work,
    ):

        def step(percent, text):
            at(percent, text=f"firmware: {text}")

        try:
            root = Path(work) / "root"
            enter = _way_in(root)
            about = _unpack_tools(Path(work), root, recipes, step)
            about |= _unpack_sources(root, portion(step, 50, 55))
        except (AptError, Unavailable) as why:
            return {recipe.name: str(why) for recipe in recipes}
        except subprocess.CalledProcessError as why:
            return {recipe.name: f"unpacking failed: {why}" for recipe in recipes}
        failed = {}
        for n, recipe in enumerate(recipes):
            share = portion(step, 55 + 45 * n / len(recipes), 55 + 45 * (n + 1) / len(recipes))
            try:
                recipe.prepare(root / "build", share)
                _make(recipe, root, enter, share)
                product = root / "build" / recipe.product
                number = recipe.version(product)
                _keep(recipe, product, number, about, f"r{recipe.number}")
                share(100, f"MicroPython {number} for {recipe.name}")
            except (AptError, Unavailable) as why:
                failed[recipe.name] = str(why)
        return failed


def _way_in(root: Path) -> list[str]:
    """-> a command that runs its arguments with `root` as the file system's root. Makes root.

    As root, or as an ordinary user where the kernel lets users have namespaces of their own; root in a container that
    forbids both does with a plain chroot.
    """
    for folder in ("dev/shm", "proc", "tmp", "usr", "build"):  # dev/shm: Python's semaphores
        (root / folder).mkdir(parents=True)
    for link in ("bin", "sbin", "lib", "lib64"):
        (root / link).symlink_to(f"usr/{link}")
    # what the packages' scripts would have linked
    toolchain = root / "usr/lib/arm-none-eabi"
    toolchain.mkdir(parents=True)
    (toolchain / "lib").symlink_to("newlib")
    (toolchain / "include").symlink_to("/usr/include/newlib")
    (root / "dev/null").touch()
    environment = _host_environment()
    shell = ["sh", "-c", _ENTER, str(root)]
    said = []
    for way in (["unshare", "--mount"], ["unshare", "--map-root-user", "--mount"]):
        try:
            # there is nothing in root yet that could be run: the system's own stands in for the trial
            probe = [*way, *shell, "/", "true"]
            done = subprocess.run(probe, env=environment, capture_output=True, text=True)
        except OSError as why:
            said.append(f"unshare: {why.strerror}")
            continue
        if done.returncode == 0:
            return [*way, *shell, str(root)]
        said += done.stderr.strip().splitlines()[-1:]
    if os.geteuid() == 0:
        with contextlib.suppress(OSError):
            (root / "dev/null").unlink()
            os.mknod(root / "dev/null", stat.S_IFCHR | 0o666, os.makedev(1, 3))
            return ["chroot", str(root)]
    why = (said or ["refused"])[-1]
    raise Unavailable(f"building the firmware needs root or user namespaces ({why})")


def _host_environment() -> dict:
    """chroot and mount are in folders that are not on every user's PATH."""
    return os.environ | {"PATH": os.environ.get("PATH", "") + ":/usr/sbin:/sbin:/usr/bin:/bin"}


def _unpack_tools(work: Path, root: Path, recipes: list[Recipe], step) -> dict:
    """Compilers and what else the recipes name, unpacked into root. -> the versions of what was asked for."""
    step(0, "package lists")
    if not shutil.which("dpkg"):
        raise AptError("dpkg is not here (not a Debian system?)")
    native = subprocess.run(
        ["dpkg", "--print-architecture"], capture_output=True, text=True
    ).stdout.strip()
    apt = Apt(work / "apt", [native])
    apt.run("apt-get", "update")
    share = portion(step, 0, 35)
    resolve = ("install", "--download-only", "-y", "--no-install-recommends")
    tools = sorted({tool for recipe in recipes for tool in recipe.tools})
    alone = sorted({package for recipe in recipes for package in recipe.alone})
    apt.download([*_TOOLS, *tools], share, resolve)
    if alone:
        apt.download(alone, share)
    debs = [*(apt.folder / "cache/archives").glob("*.deb"), *(apt.folder / "debs").glob("*.deb")]
    left_out = [f"--exclude={pattern}" for pattern in _LEFT_OUT]

    def unpack(deb):
        take = ["tar", "-x", "--keep-directory-symlink", "-C", root, "--wildcards", *left_out]
        with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", deb], stdout=subprocess.PIPE) as tar:
            subprocess.run(take, stdin=tar.stdout, check=True, capture_output=True)
        deb.unlink()

    with ThreadPoolExecutor(jobs()) as pool:
        for n, _ in enumerate(pool.map(unpack, debs)):
            step(35 + 15 * n / len(debs), f"unpacking {len(debs)} packages")
    versions = {deb.name.split("_")[0]: deb.name.split("_")[1].replace("%3a", ":") for deb in debs}
    named = [*tools, *(package.split(":")[0] for package in alone)]
    return {"suite": SUITE} | {name: versions.get(name) for name in named}


def _unpack_sources(root: Path, step) -> dict:
    """MicroPython, and an empty folder in place of micropython-lib, which is no package."""
    build = root / "build"
    found, said = None, "no suite has it"
    for suite in _SUITES:
        try:
            tree = debian.source("micropython", suite, build / f"micropython-{suite}", step)
        except AptError as why:
            said = str(why)
            continue
        # the first line: micropython (1.26.1+ds-1) unstable; urgency=medium
        text = re.search(r"\((.*?)\)", (tree / "debian/changelog").read_text("utf-8")).group(1)
        if tuple(int(x) for x in re.findall(r"\d+", text)[:2]) >= MINIMUM:
            found = text
            tree.rename(build / "micropython")
            break
        said = f"MicroPython {text} is older than {MINIMUM[0]}.{MINIMUM[1]}"
    if found is None:
        raise Unavailable(f"no MicroPython to build the firmware from: {said}")
    (build / "micropython-lib").mkdir()
    (build / "micropython-lib/README.md").write_text("Empty: nothing of it is frozen in.\n")
    return {"micropython": found}


def _make(recipe: Recipe, root: Path, enter: list[str], step) -> None:
    script = root / "build" / f"build-{recipe.name}.sh"
    script.write_text(recipe.script.format(jobs=jobs()))
    environment = _ENVIRONMENT | recipe.environment | {"SOURCE_DATE_EPOCH": str(_released(root))}
    inside = [f"{key}={value}" for key, value in environment.items()]
    step(0, f"compiling for {recipe.name}")
    log = paths.cache() / f"{recipe.name}-build.log"
    with (
        open(log, "w", encoding="utf-8") as out,
        subprocess.Popen(
            [*enter, "/usr/bin/env", "-i", *inside, "/bin/sh", f"/build/{script.name}"],
            env=_host_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        ) as make,
    ):
        try:
            for line in make.stdout:
                out.write(line)
                percent = re.match(r"\[ *(\d+)%\]", line)
                if percent:
                    step(int(percent.group(1)), f"compiling for {recipe.name}")
        except BaseException:
            os.killpg(make.pid, signal.SIGKILL)
            raise
    if make.returncode:
        lines = [
            line
            for line in log.read_text("utf-8").splitlines()
            if re.search(r"\b(error|Error|undefined)\b", line)
        ]
        raise Unavailable(
            f"the firmware does not build: {(lines or ['no reason given'])[0][:160]} (all of it: {log})"
        )
    log.unlink()


def _released(root: Path) -> int:
    """When this MicroPython was packaged, seconds since 1970: the date in the image, so that each build is the same."""
    changelog = (root / "build/micropython/debian/changelog").read_text("utf-8")
    date = re.search(r"^ -- .*>  (.*)$", changelog, re.MULTILINE).group(1)
    return int(email.utils.parsedate_to_datetime(date).timestamp())


def jobs() -> int:
    return len(os.sched_getaffinity(0))


def portion(step, low, high):
    """-> a step function whose 0..100 % are low..high % of the whole."""
    return lambda percent, text: step(low + (high - low) * percent / 100, text)


def version_in(data: bytes, path: Path) -> str:
    """-> the version of MicroPython whose banner is in an image. Raises Unavailable: none, or too old."""
    found = re.search(rb"MicroPython v(\d+)\.(\d+)\.(\d+)[^ ]* on ", data)
    if not found:
        raise Unavailable(f"{path} holds no MicroPython")
    numbers = tuple(int(x) for x in found.groups())
    text = ".".join(map(str, numbers))
    if numbers < MINIMUM:
        raise Unavailable(f"{path}: MicroPython {text} is older than {MINIMUM[0]}.{MINIMUM[1]}")
    return text
