"""Installing on the emulated Pico as a user does on a real one: `upright flash`, `upright doctor`, `mpremote mip`."""

import functools
import http.server
import threading

import pytest
from rp2040 import files, transport
from typer.testing import CliRunner
from upright_host import cli, device, emulated, flash, packages, paths, runtimes
from upright_host import rp2040 as firmware

pytestmark = [pytest.mark.xdist_group("rp2040_flash"), pytest.mark.slow, pytest.mark.timeout(1800)]

PICO = device.Facts("rp2", "Pico", (1, 26, 1), 6, 3, "armv6m", True, False, True, True, 0)
OLD_SETTINGS = b"import no_such_module"  # what the older installation has: it would not start
SNAPSHOT_US = 2000


class Snapshots:
    """The board's flash whenever it is another than a moment ago: where the power could have failed."""

    def __init__(self, board):
        self._board = board
        self.taken = []
        self._take()

    def _take(self):
        now = transport.flash_memory(self._board)
        if not self.taken or now != self.taken[-1]:
            self.taken.append(now)
        self._board.at(self._board.now_us + SNAPSHOT_US, self._take)


@pytest.fixture(scope="module")
def image():
    try:
        return firmware.image()
    except runtimes.Unavailable as why:
        pytest.skip(f"runtime rp2040: {why}")


@pytest.fixture(scope="module")
def keep(tmp_path_factory):
    """Where the emulated board's flash is, instead of the cache."""
    path = tmp_path_factory.mktemp("emulated") / "pico.flash"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emulated, "flash_file", lambda: path)
        yield path


@pytest.fixture(scope="module")
def new():
    return flash.board_files("pico", PICO)


@pytest.fixture(scope="module")
def old(new):
    """An older installation: one module is another, one is missing, one is there as its source."""
    older = new | {
        "lib/upright/settings.mpy": OLD_SETTINGS,
        "lib/upright/ssd1306.py": b"raise OSError",
    }
    del older["lib/upright/filters.mpy"]
    return older


@pytest.fixture(scope="module")
def flashed(image, keep, new, old):
    """`upright flash pico --emulated` onto the older installation: (its outcome, the flash at every moment)."""
    keep.write_bytes(files.flash_image(old))
    snapshots = []
    made = transport.pico

    def pico(*args, **named):
        board = made(*args, **named)
        snapshots.append(Snapshots(board))
        return board

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transport, "pico", pico)
        done = CliRunner().invoke(cli.app, ["flash", "pico", "--emulated", "--seconds", "0.6"])
    return done, snapshots[0].taken


def without_record(found):
    return {name: data for name, data in found.items() if name != flash.RECORD}


def test_only_what_changed_is_copied_and_the_board_starts_with_it(flashed, keep, new):
    done, _ = flashed
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "Raspberry Pi Pico with RP2040: MicroPython 1." in said
    assert f"{len(new) - 2} files are as they should be, 2 to copy" in said
    assert "1 to remove" in said
    assert "verified by hash" in said
    assert "upright on Raspberry Pi Pico" in said
    assert "Traceback" not in said
    assert without_record(files.read_flash(keep.read_bytes())) == new


def test_whenever_the_power_fails_the_board_boots_the_old_or_the_new_whole(
    image, flashed, old, new
):
    """Every moment is looked at from the host; where there is a journal, some are booted: boot.py follows it."""
    _, moments = flashed
    outcomes, journalled = [], []
    for moment in moments:
        found = files.read_flash(moment)
        now = {n: d for n, d in found.items() if n != flash.RECORD and not n.endswith(flash.NEW)}
        if flash.JOURNAL in found:
            journalled.append(moment)
        else:
            assert now in (old, new)
            outcomes.append(now == new)
    assert outcomes == sorted(outcomes)
    assert outcomes.count(False) >= 5
    assert outcomes[-1]
    assert len(journalled) >= 3
    states = {str(sorted(files.read_flash(m))): m for m in journalled}
    for moment in list(states.values())[:: max(1, len(states) // 2)]:
        board = transport.pico(image, moment).boot()
        assert without_record(board.flash()) == new


def test_the_doctor_finds_nothing_wrong_with_it(flashed):
    done = CliRunner().invoke(cli.app, ["doctor", "--emulated"])
    assert done.exit_code == 0, done.output
    assert "tick: machine.Timer, hard, 200 Hz" in done.output
    assert "sensor: MPU6050, 1000/1 Hz" in done.output
    assert "all is well" in done.output


def test_mip_installs_a_package_from_an_index_and_it_can_be_imported(image, tmp_path):
    from mpremote import mip

    packages.write_index(tmp_path)
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *a: None})
    handler = functools.partial(quiet, directory=tmp_path)
    board = transport.EmulatedTransport(transport.pico(image, {}))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        index = f"http://127.0.0.1:{server.server_port}"
        mip._install_package(board, "auxiliary_bus", index, "lib", None, True)
        server.shutdown()
    found = board.board.flash()
    assert found == {
        "lib/upright/auxiliary_bus.py": (paths.PACKAGE / "auxiliary_bus.py").read_bytes()
    }
    board.exec("from upright import auxiliary_bus")
    assert board.eval("auxiliary_bus.__file__") == "/lib/upright/auxiliary_bus.py"
    assert board.eval("auxiliary_bus.AuxiliaryBus.__name__") == "AuxiliaryBus"
