"""Installing on the emulated Pico as a user does on a real one: `upright flash`, `upright doctor`, `mpremote mip`."""

import functools
import hashlib
import http.server
import json
import threading

import pytest
from rp2040 import files, transport
from typer.testing import CliRunner
from upright_host import (
    cli,
    contents,
    device,
    emulated,
    flash,
    packages,
    recordings,
)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

PICO = device.Facts("rp2", "Pico", (1, 26, 1), 6, 3, "armv6m", True, False, True, True, 0)
OLD_SETTINGS = b"import no_such_module"  # what the older installation has: it would not start
# The user's, under the names of a tutorial's modules and of ours before they were a package
OWN = dict.fromkeys(
    ("mpu6050.py", "ssd1306.py", "config.py", "lib/ssd1306.py"), b"raise ValueError"
)
CALIBRATION = b'{"format": "other"}'
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
def keep(tmp_path_factory):
    """Where the emulated board's flash is, instead of the cache."""
    path = tmp_path_factory.mktemp("emulated") / "pico.flash"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emulated, "flash_file", lambda: path)
        yield path


@pytest.fixture(scope="module")
def new():
    return contents.board_files("pico", PICO)


@pytest.fixture(scope="module")
def old(new):
    """An older installation, some of it with the names of then, and what its user has besides: a tutorial's modules, a
    library's, and settings of his own. One module is as it is to be only with the new."""
    older = {name: data for name, data in new.items() if name != "lib/upright/filters.mpy"}
    older |= {
        "lib/upright/settings.mpy": OLD_SETTINGS,
        "main.py": b"import app\n",
        "boot.py": b"import update\n",
        "app.py": b"print('the older one')\n",
        "update.py": b"",
    }
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in older.items()}
    record = json.dumps({"version": "0", "files": hashes}).encode()
    return older | OWN | {flash.RECORD: record, "calibration.json": CALIBRATION}


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
        done = CliRunner().invoke(cli.app, ["flash", "pico", "--emulated", "--seconds", "1.5"])
    return done, snapshots[0].taken


def without_record(found):
    return {name: data for name, data in found.items() if name != flash.RECORD}


def wanted(new):
    return new | OWN | {"calibration.json": CALIBRATION, "upright_cal.json": CALIBRATION}


def test_an_older_board_is_moved_over_and_keeps_what_is_its_users(flashed, keep, new):
    done, _ = flashed
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "Raspberry Pi Pico with RP2040: MicroPython 1." in said
    assert f"{len(new) - 3} files are as they should be, 4 to copy" in said
    assert "3 to remove" in said
    assert "verified by hash" in said
    assert "upright on Raspberry Pi Pico" in said
    assert "Traceback" not in said
    assert without_record(files.read_flash(keep.read_bytes())) == wanted(new)


def test_the_flashed_board_gives_angles_beside_a_tutorials_modules(image, flashed, keep):
    board = transport.EmulatedTransport(transport.pico(image, keep.read_bytes()))
    board.exec("import time, upright\nimu = upright.start()\ntime.sleep_ms(300)")
    assert board.eval("imu.status()['steps']") > 40
    assert [abs(angle) < 1 for angle in board.eval("tuple(imu.angles())")] == [True] * 3


@pytest.mark.xfail(
    reason="one of the moments is not finished by the next boot: its calibration stays staged"
)
def test_whenever_the_power_fails_the_board_boots_the_old_or_the_new_whole(
    image, flashed, old, new
):
    """Every moment is looked at from the host; of those at which /upright.py is there, some are booted."""
    _, moments = flashed
    outcomes, held = [], []
    for moment in moments:
        found = files.read_flash(moment)
        now = {n: d for n, d in found.items() if not n.startswith(flash.STAGE)}
        if flash.SELF in found:
            held.append(moment)
            continue
        now = without_record(now)
        if now.get("boot.py") == flash.BOOT:
            now["boot.py"] = old["boot.py"]
        assert now in (without_record(old), wanted(new))
        outcomes.append(now == wanted(new))
    assert outcomes == sorted(outcomes)
    assert outcomes.count(False) >= 5
    assert outcomes[-1]
    states = {str(sorted(files.read_flash(m))): m for m in held}
    assert len(states) >= 3
    for moment in list(states.values())[:: max(1, len(states) // 2)]:
        board = transport.pico(image, moment).boot()
        board.run(3)  # the boot takes all files in before it starts the program
        assert without_record(board.flash()) == wanted(new)


def test_the_doctor_finds_nothing_wrong_and_writes_nothing(flashed, keep):
    before = files.read_flash(keep.read_bytes())
    done = CliRunner().invoke(cli.app, ["doctor", "--emulated"])
    assert done.exit_code == 0, done.output
    assert "tick: machine.Timer, hard, 200 Hz" in done.output
    assert "sensor: MPU6050, 1000/1 Hz" in done.output
    assert "self-test: passed" in done.output
    assert "all is well" in done.output
    assert files.read_flash(keep.read_bytes()) == before


def test_a_recording_comes_over_the_line_and_writes_nothing(flashed, keep, tmp_path):
    before = files.read_flash(keep.read_bytes())
    file = tmp_path / "rest.imu"
    done = CliRunner().invoke(cli.app, ["record", str(file), "--emulated", "--seconds", "1"])
    assert done.exit_code == 0, done.output
    accel, _ = recordings.load(file).inertial()
    assert len(accel) == 100
    assert abs(accel[:, 2].mean() - 1) < 0.02
    assert files.read_flash(keep.read_bytes()) == before


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
    assert {name.partition(".")[0] for name in found} == {
        f"lib/upright/{module}" for module in packages.modules("auxiliary_bus")
    }
    board.exec("from upright import auxiliary_bus")
    assert board.eval("auxiliary_bus.__file__") == "/lib/upright/auxiliary_bus.py"
    assert board.eval("auxiliary_bus.AuxiliaryBus.__name__") == "AuxiliaryBus"
