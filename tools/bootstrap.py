"""Makes .venv with everything that the host side needs: `make setup`, or without make `python tools/bootstrap.py`.
Standard library only, no root needed. Linux, macOS, Windows.

A Debian without python3-venv has no pip to put into a virtual environment: then the wheel of Debian's python3-pip-whl
is fetched beside it, without touching the system. `make test` also wants what tests compare with ("extras"): where a
package of these cannot be had, the tests that need it skip, each with its line.
"""

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path, PurePath, PureWindowsPath

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
STAMP = VENV / ".upright-setup"
EXTRAS = VENV / ".upright-extras"
CONSTRAINTS = ROOT / "tools" / "constraints.txt"
SOURCES = (ROOT / "pyproject.toml", CONSTRAINTS, Path(__file__))
INSTALL = ("install", "--disable-pip-version-check", "-c", str(CONSTRAINTS))


def program(venv: PurePath, name: str) -> PurePath:
    """Where a virtual environment has its programs."""
    if isinstance(venv, PureWindowsPath):
        return venv / "Scripts" / f"{name}.exe"
    return venv / "bin" / name


PYTHON = program(VENV, "python")


def fail(message):
    sys.exit(f"setup: {message}")


def stamp():
    """What the environment was made from."""
    return "\n".join([sys.version, str(ROOT), *(source.read_text("utf-8") for source in SOURCES)])


def pip_wheel(folder):
    """-> pip's wheel out of Debian's package."""
    sys.path.insert(0, str(ROOT / "tools"))
    from upright_host.debian import Apt, AptError

    print(
        "setup: no ensurepip here (python3-venv is not installed): fetching pip's wheel from Debian"
    )
    try:
        native = subprocess.run(
            ["dpkg", "--print-architecture"], capture_output=True, text=True, check=True
        ).stdout.strip()
        apt = Apt(folder, [native])
        apt.run("apt-get", "update")
        apt.download(["python3-pip-whl:all"], lambda percent, text: None)
        apt.unpack(["python3-pip-whl:all"], folder / "unpacked")
        (wheel,) = (folder / "unpacked").glob("usr/share/python-wheels/pip-*.whl")
    except (AptError, OSError, ValueError, subprocess.CalledProcessError) as why:
        fail(f"cannot get pip ({why}). Install Debian's python3-venv and try again.")
    return wheel


def make():
    if sys.version_info < (3, 11):  # noqa: UP036  (this file runs before anything could check)
        fail(f"needs Python 3.11 or newer, this is {sys.version.split()[0]}")
    print(f"setup: making {VENV.name} with Python {sys.version.split()[0]}", flush=True)
    has_pip = importlib.util.find_spec("ensurepip") is not None
    venv = [sys.executable, "-m", "venv", "--clear", str(VENV)]
    if subprocess.run(venv if has_pip else [*venv, "--without-pip"]).returncode:
        fail(f"{' '.join(venv)} failed, see above")
    print("setup: installing the host side's packages", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        pip = (
            [str(PYTHON), "-m", "pip"]
            if has_pip
            else [str(PYTHON), f"{pip_wheel(Path(folder))}/pip"]
        )
        if not has_pip and subprocess.run([*pip, "install", "-q", "pip"]).returncode:
            fail("pip could not be installed, see above")
    install_packages()
    STAMP.write_text(stamp(), "utf-8")
    upright = program(VENV, "upright").relative_to(ROOT)
    print(f"setup: done; {upright} --help", flush=True)


def install_packages():
    """The command and what its tests need; where a system cannot have all of that, the command alone."""
    pip = [str(PYTHON), "-m", "pip", *INSTALL, "-e"]
    if subprocess.run([*pip, f"{ROOT}[test]"]).returncode:
        print("setup: not all that the tests need is to be had here: the command alone", flush=True)
        if subprocess.run([*pip, str(ROOT)]).returncode:
            fail("pip could not install the packages, see above")


def add_extras():
    """Wheels only: none of this is worth a compiler."""
    import tomllib

    print("setup: installing what the tests compare with", flush=True)
    pip = [str(PYTHON), "-m", "pip", *INSTALL, "--only-binary=:all:"]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
        "optional-dependencies"
    ]
    for name in ("plot", "references", "baselines"):
        # one after the other: what has no wheel here is not to take the others with it
        for package in extras[name]:
            if subprocess.run([*pip, package]).returncode:
                print(
                    f"setup: {package} is not available here; tests that need it skip", flush=True
                )
    EXTRAS.write_text(stamp(), "utf-8")


if __name__ == "__main__":
    if not STAMP.exists() or STAMP.read_text("utf-8") != stamp():
        make()
    if "--extras" in sys.argv and (not EXTRAS.exists() or EXTRAS.read_text("utf-8") != stamp()):
        add_extras()
