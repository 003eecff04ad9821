"""Debian's packages, fetched and unpacked without touching the system or needing root. Standard library only."""

import contextlib
import lzma
import re
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path

from upright_host import lock

SUITE = "trixie"  # Debian 13


class AptError(Exception):
    """A package is not available here; the message is one line that says why."""


class Apt:
    """apt-get with a private state in the cache; only the mirror and the keys are the system's."""

    def __init__(
        self, folder: Path, architectures: list[str], suite: str = SUITE, sources: bool = False
    ):
        """sources: True: source packages of the suite instead of binary ones."""
        for tool in ("apt-get", "apt-cache", "dpkg-deb"):
            if not shutil.which(tool):
                raise AptError(f"{tool} is not here (not a Debian system?)")
        self.folder = folder
        for sub in ("state/lists/partial", "cache/archives/partial", "debs"):
            (folder / sub).mkdir(parents=True, exist_ok=True)
        (folder / "status").touch()
        keyring = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
        signed = f" signed-by={keyring}" if keyring.exists() else ""
        options = f"arch={','.join(architectures)}{signed}"
        (folder / "sources.list").write_text(
            f"{'deb-src' if sources else 'deb'} [{options}] {self._mirror()} {suite} main\n"
        )
        settings = {
            "Dir::State": folder / "state",
            "Dir::State::status": folder / "status",
            "Dir::Cache": folder / "cache",
            "Dir::Etc::sourcelist": folder / "sources.list",
            "Dir::Etc::sourceparts": "-",
            "APT::Architecture": architectures[0],
            "APT::Sandbox::User": "root",  # else apt, run by root, downloads as a user who may not write here
            "Acquire::Languages": "none",
            "Acquire::Retries": "3",
        }
        self.options = [x for key, value in settings.items() for x in ("-o", f"{key}={value}")]
        for architecture in architectures:
            self.options += ["-o", f"APT::Architectures::={architecture}"]

    @staticmethod
    def _mirror() -> str:
        listed = subprocess.run(
            ["apt-get", "indextargets", "--format", "$(COMPONENT) $(REPO_URI)"],
            capture_output=True,
            text=True,
        ).stdout.split("\n")
        uris = [line.split(" ", 1)[1] for line in listed if line.startswith("main ")]
        # a mirror of the distribution itself, not of its security updates or of a vendor's packages
        for pattern in (r"/debian/?$", r"/debian/(?!.*security)"):
            for uri in uris:
                if re.search(pattern, uri):
                    return uri
        raise AptError("no Debian mirror in the system's apt configuration")

    def run(self, *command: str, cwd: Path | None = None) -> str:
        done = subprocess.run(
            [command[0], *self.options, *command[1:]], capture_output=True, text=True, cwd=cwd
        )
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if line.startswith(("E:", "W:"))]
            raise AptError(f"{command[0]} {command[1]}: {(errors or ['failed'])[0]}")
        return done.stdout

    def with_dependencies(self, packages: list[str], native: str) -> list[str]:
        """-> these packages (name:architecture) and all that they need, each with its architecture."""
        without = ["recommends", "suggests", "conflicts", "breaks", "replaces", "enhances"]
        listed = self.run(
            "apt-cache", "depends", "--recurse", *(f"--no-{kind}" for kind in without), *packages
        )
        names = [line.strip() for line in listed.splitlines() if re.match(r"[a-z0-9]", line)]
        return sorted({n if ":" in n else f"{n}:{native}" for n in names})

    def download(self, packages: list[str], step, command=("download",)) -> None:
        """Fetch the packages into debs/; apt checks signatures and hashes. step(percent, text) tells how far it is."""
        argv = ["apt-get", *self.options, "-o", "APT::Status-Fd=1", *command, *packages]
        with subprocess.Popen(
            argv,
            cwd=self.folder / "debs",
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as apt:
            for line in apt.stdout:
                if line.startswith("dlstatus:"):
                    _, _, percent, text = line.strip().split(":", 3)
                    step(float(percent), text)
            errors = [line for line in apt.stderr if line.startswith("E:")]
        if apt.returncode:
            raise AptError(f"apt-get {command[0]}: {(errors or ['failed'])[0].strip()}")

    def unpack(self, packages: list[str], root: Path) -> None:
        for package in packages:
            name, architecture = package.split(":")
            debs = self.folder / "debs"
            (deb,) = (p for a in (architecture, "all") for p in debs.glob(f"{name}_*_{a}.deb"))
            if name == "qemu-user":  # a hundred emulators, of which one is needed
                with subprocess.Popen(
                    ["dpkg-deb", "--fsys-tarfile", deb], stdout=subprocess.PIPE
                ) as tar:
                    take = ["tar", "-x", "-C", root, "./usr/bin/qemu-arm"]
                    subprocess.run(take, stdin=tar.stdout, check=True)
            else:
                subprocess.run(["dpkg-deb", "-x", deb, root], check=True, capture_output=True)


def source(package: str, suite: str, into: Path, step=lambda percent, text: None) -> Path:
    """Fetch a source package (name, or name=version) of a suite and unpack it -> into, an absolute path.

    Where `into` exists it is the answer: nothing is fetched twice, and what is left of an interrupted run is not taken
    for the whole. apt checks signature and hashes. dpkg-source is not needed: the folder holds what upstream released
    (as Debian repacked it), in debian/ what Debian adds, no patch applied. step(percent, text) tells how
    far it is. Raises AptError, one line.
    """
    into = into.absolute()
    into.parent.mkdir(parents=True, exist_ok=True)
    with lock.held(into.parent / f".{into.name}.lock"):
        if into.exists():
            return into
        for left in into.parent.glob(f".{into.name}-unpacking-*"):  # by a run that was killed
            shutil.rmtree(left, ignore_errors=True)
        with tempfile.TemporaryDirectory(
            dir=into.parent, prefix=f".{into.name}-unpacking-"
        ) as work:
            step(0, "package lists")
            # sources are of no architecture; apt wants to hear one
            apt = Apt(Path(work), ["amd64"], suite, sources=True)
            apt.run("apt-get", "update")
            apt.download([package], step, ("source", "--only-source", "--download-only"))
            step(100, f"unpacking {package}")
            tree = _unpack_source(apt.folder / "debs")
            tree.rename(into)
    return into


def _unpack_source(folder: Path) -> Path:
    """Unpack the tar files of one source package that lie in a folder -> its tree."""
    tree = folder / "tree"
    archives = sorted(folder.glob("*.tar.*"), key=lambda path: ".orig.tar." not in path.name)
    archives = [path for path in archives if path.suffix != ".asc"]
    if not archives or ".dsc" not in {path.suffix for path in folder.iterdir()}:
        raise AptError("apt-get source fetched no source package")
    for archive in archives:
        # name_version.orig.tar.xz, name_version.orig-component.tar.xz, name_version-revision.debian.tar.xz
        component = re.search(r"\.orig-([^.]+)\.tar\.", archive.name)
        debian = ".debian.tar." in archive.name
        scratch = folder / "scratch"
        scratch.mkdir()
        try:
            with tarfile.open(archive) as tar:
                if hasattr(tarfile, "tar_filter"):
                    tar.extractall(scratch, filter="tar")
                else:
                    tar.extractall(scratch)
        except (OSError, EOFError, lzma.LZMAError, tarfile.TarError) as why:
            raise AptError(f"{archive.name} cannot be unpacked: {why}") from None
        inside = list(scratch.iterdir())
        top = inside[0] if len(inside) == 1 and inside[0].is_dir() else scratch
        place = tree / component.group(1) if component else tree / "debian" if debian else tree
        # an empty place of a component, upstream's debian/
        shutil.rmtree(place, ignore_errors=True)
        top.rename(place)
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(scratch)
    return tree
