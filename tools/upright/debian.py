"""Debian's packages, fetched and unpacked without touching the system or needing root. Standard library only."""

import re
import shutil
import subprocess
from pathlib import Path

SUITE = "trixie"  # Debian 13


class AptError(Exception):
    """A package cannot be had here; the message is one line that says why."""


class Apt:
    """apt-get with a private state in the cache; only the mirror and the keys are the system's."""

    def __init__(self, folder: Path, architectures: list[str]):
        for tool in ("apt-get", "apt-cache", "dpkg-deb"):
            if not shutil.which(tool):
                raise AptError(f"{tool} is not here (not a Debian system?)")
        self.folder = folder
        for sub in ("state/lists/partial", "cache/archives/partial", "debs"):
            (folder / sub).mkdir(parents=True, exist_ok=True)
        (folder / "status").touch()
        keyring = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
        signed = f" signed-by={keyring}" if keyring.exists() else ""
        (folder / "sources.list").write_text(
            f"deb [arch={','.join(architectures)}{signed}] {self._mirror()} {SUITE} main\n"
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

    def download(self, packages: list[str], step) -> None:
        """Fetch the packages into debs/; apt checks signatures and hashes. step(percent, text) tells how far it is."""
        argv = ["apt-get", *self.options, "-o", "APT::Status-Fd=1", "download", *packages]
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
            raise AptError(f"apt-get download: {(errors or ['failed'])[0].strip()}")

    def unpack(self, packages: list[str], root: Path) -> None:
        for package in packages:
            name, architecture = package.split(":")
            (deb,) = (self.folder / "debs").glob(f"{name}_*_{architecture}.deb")
            if name == "qemu-user":  # a hundred emulators, of which one is needed
                with subprocess.Popen(
                    ["dpkg-deb", "--fsys-tarfile", deb], stdout=subprocess.PIPE
                ) as tar:
                    take = ["tar", "-x", "-C", root, "./usr/bin/qemu-arm"]
                    subprocess.run(take, stdin=tar.stdout, check=True)
            else:
                subprocess.run(["dpkg-deb", "-x", deb, root], check=True, capture_output=True)
