"""The runtime rp2040: MicroPython's firmware for the Raspberry Pi Pico, as it goes onto a board, built from Debian's
packages alone. The board itself is emulated by tools/simulator/rp2040.

It is built in a folder of the cache that holds a small Debian (compilers and sources unpacked, nothing installed), and
of all that only the image is kept. UPRIGHT_RP2040_IMAGE names a finished image (.uf2) to take instead.
"""

import contextlib
import email.utils
import json
import os
import re
import shutil
import signal
import stat
import struct
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from upright_host import console, debian, paths
from upright_host.console import Unavailable
from upright_host.debian import SUITE, Apt, AptError

WHAT = "MicroPython's firmware for the Raspberry Pi Pico on an emulated RP2040"
MINIMUM = (1, 26)  # the first whose machine.Timer has hard callbacks on this chip
VARIABLE = "UPRIGHT_RP2040_IMAGE"
# What a machine that cannot build it can do
GIVEN = (
    "To take a finished one: download RPI_PICO's .uf2 (1.26 or newer) from micropython.org/download/RPI_PICO, then run"
    " `upright runtimes --image FILE.uf2`"
)

_RECIPE = 1  # to be raised when the build changes: images of other recipes are not taken
_SUITES = ("forky", "sid")  # in this order, where a MicroPython new enough is looked for
# What the build runs: C and assembler for the board, and for the machine at hand (mpy-cross, which freezes modules).
_TOOLS = (
    *("gcc-arm-none-eabi", "libnewlib-arm-none-eabi", "libstdc++-arm-none-eabi-dev"),
    *("gcc", "libc6-dev", "make", "cmake", "python3", "pioasm", "picotool"),
    *("dash", "bash", "coreutils", "sed", "grep", "mawk", "findutils", "diffutils"),
)
# By themselves: the packages that they ask for besides (438 MB of C++ library) are not needed.
_SOURCES = ("pico-sdk-source:all", "tinyusb-source:all")
# Not unpacked: documentation, and the C library for other cores than the Cortex-M0+.
_LEFT_OUT = (
    *("./usr/share/doc", "./usr/share/man", "./usr/share/info", "./usr/share/locale"),
    *(f"./usr/lib/arm-none-eabi/newlib/{m}" for m in ("arm", "thumb/nofp", "thumb/v[78]*")),
    *(f"./usr/lib/gcc/arm-none-eabi/*/{m}" for m in ("arm", "thumb/nofp", "thumb/v[78]*")),
)

# Run inside the unpacked Debian. MicroPython's own CMake files do the work; its libraries that Debian packages by
# themselves are links, and modules out of micropython-lib (which is no package) are not frozen in.
_BUILD = """set -e
cd /build
make -C micropython/mpy-cross -j {jobs}
cmake -S micropython/ports/rp2 -B out -DPICO_SDK_PATH_OVERRIDE=/usr/src/pico-sdk -DPICO_BUILD_DOCS=0 \\
  -DMICROPY_BOARD=RPI_PICO -DMICROPY_BOARD_DIR=/build/micropython/ports/rp2/boards/RPI_PICO \\
  -DMICROPY_LIB_DIR=/build/micropython-lib -DMICROPY_FROZEN_MANIFEST=/build/manifest.py \\
  -DCMAKE_CXX_STANDARD_LIBRARIES=-lm
make -C out -j {jobs}
"""
# With the folder as $0: what of the system shows in it, then chroot with the arguments. /proc is not needed.
_ENTER = '''mount --bind /dev/null "$0/dev/null" && { mount --rbind /proc "$0/proc" || :; } && exec chroot "$@"'''
_MANIFEST = """freeze("$(PORT_DIR)/modules")
include("$(MPY_DIR)/extmod/asyncio")
"""
_ENVIRONMENT = {
    "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
    "LC_ALL": "C.UTF-8",
    "HOME": "/build",
    # pico-sdk brings what it uses of the C++ library; -lm, which went with it, is in _BUILD
    "CXXFLAGS": "-nostdlib++",
}


# ---------------------------------------------------------------- the image
def image() -> Path:
    """-> the firmware as a UF2 file: the one that UPRIGHT_RP2040_IMAGE names, else the cache's, else it is built.

    Raises Unavailable with the reason, in one line, where this machine cannot have it.
    """
    named = os.environ.get(VARIABLE)
    if named:
        version(Path(named))
        return Path(named)
    with paths.locked("rp2040"):
        built = _cached()
        return built[-1] / "firmware.uf2" if built else _build()


def at_hand() -> bool:
    """Is there an image that need not be built?"""
    return bool(os.environ.get(VARIABLE) or _cached())


def version(path: Path) -> str:
    """-> the version of MicroPython in an image. Unavailable when it is no image for this board, or too old."""
    try:
        data = path.read_bytes()
    except OSError as why:
        raise Unavailable(f"{path}: {why.strerror}") from None
    # UF2: blocks of 512 bytes, payload in front; the family is the RP2040's
    head = struct.unpack_from("<8I", data.ljust(512, b"\0"))
    if head[:2] != (0x0A324655, 0x9E5D5157) or head[7] != 0xE48BFF56 or len(data) % 512:
        raise Unavailable(f"{path} is not a UF2 image for the RP2040")
    payload = b"".join(data[at + 32 : at + 288] for at in range(0, len(data), 512))
    found = re.search(rb"MicroPython v(\d+)\.(\d+)\.(\d+)[^ ]* on ", payload)
    if not found:
        raise Unavailable(f"{path} holds no MicroPython")
    numbers = tuple(int(x) for x in found.groups())
    text = ".".join(map(str, numbers))
    if numbers < MINIMUM:
        raise Unavailable(f"{path}: MicroPython {text} is older than 1.26")
    return text


def take(path: Path) -> str:
    """Put a finished image into the cache, where it is used from now on -> its version. Raises Unavailable."""
    number = version(path)
    with paths.locked("rp2040"):
        for former in _place().glob("rp2040-*-given"):
            shutil.rmtree(former)
        _keep(path, number, {"micropython": number, "from": str(path.absolute())}, "given")
    return number


def _place() -> Path:
    place = paths.cache() / "runtimes"
    place.mkdir(exist_ok=True)
    return place


def _cached() -> list[Path]:
    """Folders of images made by this recipe or handed over, the one to take last."""

    def age(folder):
        numbers = [int(x) for x in re.findall(r"\d+", folder.name.split("-")[1])]
        return folder.name.endswith("-given"), numbers

    folders = [p for p in _place().glob("rp2040-*") if (p / "firmware.uf2").exists()]
    mine = (f"-r{_RECIPE}", "-given")
    return sorted((p for p in folders if p.name.endswith(mine)), key=age)


def _keep(uf2: Path, number: str, about: dict, kind: str) -> Path:
    folder = _place() / f"rp2040-{number}-{kind}"
    with tempfile.TemporaryDirectory(dir=_place(), prefix=".keeping-") as work:
        new = Path(work) / "new"
        new.mkdir()
        shutil.copyfile(uf2, new / "firmware.uf2")
        (new / "about.json").write_text(json.dumps(about, indent=1) + "\n", "utf-8")
        if folder.exists():
            folder.rename(Path(work) / "old")
        new.rename(folder)
    return folder / "firmware.uf2"


# ---------------------------------------------------------------- building it
def _build() -> Path:
    if sys.platform != "linux":
        raise Unavailable(f"the firmware is built on Linux only. {GIVEN}")
    try:
        return _build_here()
    except Unavailable as why:
        raise Unavailable(f"{why}. {GIVEN}") from None


def _build_here() -> Path:
    place = _place()
    for left in place.glob(".building-*"):  # by a run that was killed
        shutil.rmtree(left, ignore_errors=True)
    console.say("rp2040 firmware: building it, a few minutes, once", where=console.errors)
    with (
        console.progress("rp2040 firmware", 100) as at,
        # Everything is made in here; the image alone leaves it, at the end.
        tempfile.TemporaryDirectory(
            dir=place, prefix=".building-", ignore_cleanup_errors=True
        ) as work,
    ):

        def step(percent, text):
            at(percent, text=f"rp2040 firmware: {text}")

        try:
            root = Path(work) / "root"
            enter = _way_in(root)
            about = _unpack_tools(Path(work), root, step)
            about |= _unpack_sources(root, step)
            _make(root, enter, step)
        except AptError as why:
            raise Unavailable(str(why)) from None
        except subprocess.CalledProcessError as why:
            raise Unavailable(f"unpacking failed: {why}") from None
        uf2 = root / "build/out/firmware.uf2"
        number = version(uf2)
        step(100, f"MicroPython {number}")
        return _keep(uf2, number, about, f"r{_RECIPE}")


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


def _unpack_tools(work: Path, root: Path, step) -> dict:
    """Compilers, CMake, the Pico's SDK and TinyUSB, unpacked into root."""
    step(0, "package lists")
    if not shutil.which("dpkg"):
        raise AptError("dpkg is not here (not a Debian system?)")
    native = subprocess.run(
        ["dpkg", "--print-architecture"], capture_output=True, text=True
    ).stdout.strip()
    apt = Apt(work / "apt", [native])
    apt.run("apt-get", "update")
    share = _portion(step, 0, 35)
    resolve = ("install", "--download-only", "-y", "--no-install-recommends")
    apt.download(list(_TOOLS), share, resolve)
    apt.download(list(_SOURCES), share)
    debs = [*(apt.folder / "cache/archives").glob("*.deb"), *(apt.folder / "debs").glob("*.deb")]
    step(35, f"unpacking {len(debs)} packages")
    left_out = [f"--exclude={pattern}" for pattern in _LEFT_OUT]

    def unpack(deb):
        take = ["tar", "-x", "--keep-directory-symlink", "-C", root, "--wildcards", *left_out]
        with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", deb], stdout=subprocess.PIPE) as tar:
            subprocess.run(take, stdin=tar.stdout, check=True, capture_output=True)
        deb.unlink()

    with ThreadPoolExecutor(_jobs()) as pool:
        for n, _ in enumerate(pool.map(unpack, debs)):
            step(35 + 15 * n / len(debs), f"unpacking {len(debs)} packages")
    versions = {deb.name.split("_")[0]: deb.name.split("_")[1].replace("%3a", ":") for deb in debs}
    kept = ("gcc-arm-none-eabi", "libnewlib-arm-none-eabi", "pico-sdk-source", "tinyusb-source")
    return {"suite": SUITE} | {name: versions.get(name) for name in kept}


def _unpack_sources(root: Path, step) -> dict:
    """MicroPython and mbedtls, and what the build wants to find beside them."""
    build = root / "build"
    share = _portion(step, 50, 55)
    found, said = None, "no suite has it"
    for suite in _SUITES:
        try:
            tree = debian.source("micropython", suite, build / f"micropython-{suite}", share)
        except AptError as why:
            said = str(why)
            continue
        # the first line: micropython (1.26.1+ds-1) unstable; urgency=medium
        text = re.search(r"\((.*?)\)", (tree / "debian/changelog").read_text("utf-8")).group(1)
        if tuple(int(x) for x in re.findall(r"\d+", text)[:2]) >= MINIMUM:
            found = text
            tree.rename(build / "micropython")
            break
        said = f"MicroPython {text} is older than 1.26"
    if found is None:
        raise Unavailable(f"no MicroPython to build the firmware from: {said}")
    debian.source("mbedtls", SUITE, build / "mbedtls", share)
    for name, place in (("tinyusb", "/usr/src/tinyusb"), ("mbedtls", "/build/mbedtls")):
        library = build / "micropython/lib" / name
        shutil.rmtree(library, ignore_errors=True)
        library.symlink_to(place)
    (build / "micropython-lib").mkdir()
    (build / "micropython-lib/README.md").write_text("Empty: nothing of it is frozen in.\n")
    (build / "manifest.py").write_text(_MANIFEST)
    return {"micropython": found}


def _make(root: Path, enter: list[str], step) -> None:
    script = root / "build/build.sh"
    script.write_text(_BUILD.format(jobs=_jobs()))
    environment = _ENVIRONMENT | {"SOURCE_DATE_EPOCH": str(_released(root))}
    inside = [f"{key}={value}" for key, value in environment.items()]
    step(55, "compiling mpy-cross")
    log = paths.cache() / "rp2040-build.log"
    with (
        open(log, "w", encoding="utf-8") as out,
        subprocess.Popen(
            [*enter, "/usr/bin/env", "-i", *inside, "/bin/sh", "/build/build.sh"],
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
                    step(60 + int(percent.group(1)) * 0.4, "compiling")
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


def _jobs() -> int:
    return len(os.sched_getaffinity(0))


def _portion(step, low, high):
    """-> a step function whose 0..100 % are low..high % of the whole."""
    return lambda percent, text: step(low + (high - low) * percent / 100, text)
