"""`upright calibrate` and the recorder on the board: known errors are found again, useless recordings are refused."""

import importlib.util
import json
import re
from array import array
from types import SimpleNamespace

import kernel
import machine
import numpy as np
import pytest
import world
from chips.mpu6050 import MPU6050Chip
from upright import ahrs, calibration
from upright.mpu6050 import MPU6050
from upright_app import record
from upright_host import mag_fit, paths, recordings, rest_fit

import boards

RATE = 100
LSB = 4096
DPS = 16.4
FIELD = 162.0  # counts: 49 uT of an IST8310
HARD = np.array([90.0, -140.0, 55.0])
SOFT = np.array([[1.08, 0.05, -0.02], [0.05, 0.94, 0.03], [-0.02, 0.03, 1.01]])


@pytest.fixture
def run(upright):
    """run(*arguments) -> the result of `upright calibrate ...`, with exit_code and output."""
    return lambda *arguments: upright("calibrate", *arguments)


@pytest.fixture
def out(tmp_path):
    return tmp_path / "calibration.json"


def save(path, counts, rate=RATE, clocked=True, **more):
    """Counts (n, 11) as an .imu file, with what a board that recorded it says besides."""
    counts = np.clip(np.rint(counts), -32768, 32767).astype("<i2")
    line = json.loads(world.header_line("test", (rate, 1), len(counts), LSB, (82, 5), clocked))
    path.write_bytes(json.dumps(line | more).encode() + b"\n" + counts.tobytes())
    return path


def table(accel=None, gyro=None, mag=None, flags=0):
    """Counts (n, 11) from g, deg/s and magnetometer counts."""
    n = len(next(v for v in (accel, gyro, mag) if v is not None))
    counts = np.zeros((n, 11))
    counts[:, 2] = LSB
    for at, part, scale in ((0, accel, LSB), (3, gyro, DPS), (6, mag, 1)):
        if part is not None:
            counts[:, at : at + 3] = np.asarray(part) * scale
    counts[:, 10] = flags
    return counts


# ---------------------------------------------------------------------------------------- magnetometer
def directions(n=3000):
    """Unit vectors all over the sphere, in the order of a slow tumble."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    turn = i * np.pi * (3 - np.sqrt(5)) / 9
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


def tumble(unit, noise=2.0, seed=1):
    """What a magnetometer with hard and soft iron measures, counts."""
    rng = np.random.default_rng(seed)
    return FIELD * unit @ SOFT.T + HARD + rng.normal(0, noise, unit.shape)


def test_hard_and_soft_iron_are_found_again(run, out, tmp_path):
    unit = directions()
    file = save(tmp_path / "t.imu", table(mag=tumble(unit)), mag_lsb_per_uT=[33, 10])
    done = run("mag", file, "--out", out)
    assert done.exit_code == 0, done.output
    fields = calibration.read(str(out))
    offset = np.array(fields["mag"]["offset_mlsb"]) / 1000
    matrix = np.array(fields["mag"]["matrix_ppm"]).reshape(3, 3) / 1e6
    strength = FIELD * np.linalg.det(SOFT) ** (1 / 3)
    assert np.linalg.norm(offset - HARD) < 0.005 * strength
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-5)
    assert (matrix == matrix.T).all()
    corrected = (FIELD * unit @ SOFT.T + HARD - offset) @ matrix
    lengths = np.linalg.norm(corrected, axis=1)
    assert np.abs(lengths / strength - 1).max() < 0.005
    angle = np.degrees(np.arccos(np.clip((corrected * unit).sum(1) / lengths, -1, 1)))
    assert angle.max() < 0.2
    assert f"{strength / 3.3:.1f} uT" in done.output
    before, after = map(
        float, re.search(r"by ([\d.]+)% before, ([\d.]+)% after", done.output).groups()
    )
    assert before > 30 and 0.5 < after < 2
    assert "doubtful" not in done.output


def test_the_board_undoes_what_the_fit_found(run, out, tmp_path):
    """The whole way: recording, fit, file, the tick's arithmetic."""
    unit = directions(600)
    counts = table(mag=tumble(unit, noise=0) * 10, flags=3)
    assert run("mag", save(tmp_path / "t.imu", counts), "--out", out).exit_code == 0
    c = calibration.Calibration(mag_axes=("y", "x", "-z"))
    c.load(str(out))
    strength = 10 * FIELD * np.linalg.det(SOFT) ** (1 / 3)
    for row, u in zip(np.rint(counts).astype(int).tolist(), unit, strict=True):
        c.apply(array("h", row))
        assert np.abs(np.array(c.counts[6:9]) / strength - u[[1, 0, 2]] * [1, 1, -1]).max() < 0.002


def test_perfect_samples_are_no_trouble(run, out, tmp_path):
    centre, a = mag_fit.fit_ellipsoid(1000 * directions(500) + [5, 6, 7])
    assert np.abs(centre - [5, 6, 7]).max() < 1e-6
    assert np.abs(a * 1e6 - np.eye(3)).max() < 1e-6


def test_outliers_are_left_out_and_counted(run, out, tmp_path):
    mag = tumble(directions())
    mag[::50] *= 1.6
    done = run("mag", save(tmp_path / "t.imu", table(mag=mag)), "--out", out)
    assert done.exit_code == 0, done.output
    left = int(re.search(r"3000 samples, (\d+) left out", done.output)[1])
    assert 40 <= left <= 90
    offset = np.array(calibration.read(str(out))["mag"]["offset_mlsb"]) / 1000
    assert np.linalg.norm(offset - HARD) < 0.01 * FIELD


def ring(n=2000):
    turn = np.linspace(0, 20 * np.pi, n)
    return np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)


@pytest.mark.parametrize(
    "mag, said",
    [
        (tumble(ring()), "turned about one axis only"),
        (tumble(ring() @ np.linalg.qr(np.arange(9).reshape(3, 3) + np.eye(3))[0]), "one axis only"),
        (tumble(directions()[:1500]), r"covers \d+% of all directions.*along -z"),
        (tumble(directions(150)), "150 magnetometer samples are too few"),
        (tumble(directions()) * (1 + 0.4 * np.sin(np.arange(3000))[:, None]), "disturbed"),
        (np.random.default_rng(1).normal(0, 30, (3000, 3)), "disturbed"),
        (tumble(directions()) * [1, 1, 0.3], "one axis only|ellipsoid"),
        (np.zeros((3000, 3)), "no magnetometer sample"),
        (np.full((3000, 3), 100.0), "one axis only, or hardly"),
    ],
    ids=["flat", "tilted", "half", "few", "changing", "noise", "squashed", "none", "constant"],
)
def test_a_tumble_that_cannot_tell_is_refused_and_nothing_written(mag, said, run, out, tmp_path):
    done = run("mag", save(tmp_path / "t.imu", table(mag=mag)), "--out", out)
    assert done.exit_code == 2
    assert re.search(said, done.output), done.output
    assert not out.exists()


def test_only_fresh_magnetometer_samples_count(run, out, tmp_path):
    counts = table(mag=tumble(directions(9000)), flags=1)
    counts[::3, 10] = 3
    stale = counts[:, 10] == 1
    counts[stale, 6:9] = 7
    done = run("mag", save(tmp_path / "t.imu", counts), "--out", out)
    assert done.exit_code == 0, done.output
    assert "3000 samples, 0 left out" in done.output or "3000 samples, 1 " in done.output
    counts[:, 10] = 1
    done = run("mag", save(tmp_path / "t.imu", counts), "--out", out)
    assert done.exit_code == 2 and "no magnetometer sample" in done.output


def test_a_field_that_is_not_the_earths_is_doubtful(run, out, tmp_path):
    file = save(tmp_path / "t.imu", table(mag=tumble(directions()) * 3), mag_lsb_per_uT=[33, 10])
    done = run("mag", file, "--out", out)
    assert done.exit_code == 0 and "the earth's field is" in done.output


# ---------------------------------------------------------------------------------------- gyro
BIAS = np.array([1.25, -0.75, 0.5])


def resting(seconds=5, turn=(0, 0, 0), seed=1):
    n = int(seconds * RATE)
    rng = np.random.default_rng(seed)
    gyro = BIAS + np.asarray(turn) + rng.normal(0, 0.05, (n, 3))
    return table(rng.normal((0.1, 0, 1), 0.004, (n, 3)), gyro, flags=1)


def test_the_bias_at_rest_is_found(run, out, tmp_path):
    done = run("gyro", save(tmp_path / "r.imu", resting()), "--out", out)
    assert done.exit_code == 0, done.output
    assert np.abs(np.array(calibration.read(str(out))["gyro_bias_udps"]) / 1e6 - BIAS).max() < 0.01
    assert "at rest for 5.0 s" in done.output


def test_samples_that_are_not_fresh_are_not_averaged(run, out, tmp_path):
    counts = resting()
    counts[::10, 10] = 0
    counts[::10, 3:6] = 9999
    assert run("gyro", save(tmp_path / "r.imu", counts), "--out", out).exit_code == 0
    assert np.abs(np.array(calibration.read(str(out))["gyro_bias_udps"]) / 1e6 - BIAS).max() < 0.01


def bumped():
    counts = resting()
    counts[200:230, 3] += 20 * DPS
    return counts


def swaying():
    counts = resting(20)
    counts[:, 4] += DPS * 2 * np.sin(np.arange(2000) / 200)
    return counts


def tilting():
    counts = resting(20)
    counts[:, 0] += np.linspace(0, 0.1, 2000) * LSB
    return counts


@pytest.mark.parametrize(
    "counts, said",
    [
        (bumped(), r"not at rest: it turned at up to \d+\.\d+ deg/s"),
        (swaying(), r"not at rest: it turned at up to [34]\.\d+ deg/s"),
        (tilting(), r"accelerometer moved by (9|10)\d mg"),
        (resting(turn=(0, 0, 30)), "more than any bias"),
        (resting(1), "too short"),
        (np.zeros((500, 11)), "are all 0"),
        (table(gyro=np.zeros((500, 3)), flags=2), "no fresh sample"),
    ],
    ids=["bumped", "swaying", "tilting", "turning", "short", "zero", "stale"],
)
def test_a_recording_that_was_not_at_rest_is_refused(counts, said, run, out, tmp_path):
    done = run("gyro", save(tmp_path / "r.imu", counts), "--out", out)
    assert done.exit_code == 2
    assert re.search(said, done.output), done.output
    assert not out.exists()


# ---------------------------------------------------------------------------------------- accelerometer
OFFSET = np.array([0.045, -0.03, 0.06])
SCALES = np.diag([1.02, 0.985, 1.01])
CROSSED = SCALES + np.array([[0, 0.012, -0.008], [0.012, 0, 0.005], [-0.008, 0.005, 0]])
FACES = np.concatenate([np.eye(3), -np.eye(3)])


def tilted(ups, degrees, seed=3):
    """Positions as a hand holds them: off by up to so many degrees."""
    rng = np.random.default_rng(seed)
    ups = ups + np.sin(np.radians(degrees)) / np.sqrt(3) * rng.uniform(-1, 1, ups.shape)
    return ups / np.linalg.norm(ups, axis=1)[:, None]


def holding(ups, error=SCALES, seconds=2.5, seed=2):
    """The board held still in one position after the other: (n, 11); the turns between take 0.6 s each."""
    rng = np.random.default_rng(seed)
    accel, gyro = [], []
    for i, up in enumerate(ups):
        if i:
            part = np.linspace(0, 1, 60)[:, None]
            way = (1 - part) * ups[i - 1] + part * up + [0.01, 0.02, 0.03]
            accel.append(
                way / np.linalg.norm(way, axis=1)[:, None] + rng.normal(0, 0.05, way.shape)
            )
            gyro.append(np.tile([90.0, -60, 120], (60, 1)))
        accel.append(np.tile(up, (int(seconds * RATE), 1)))
        gyro.append(np.zeros_like(accel[-1]))
    accel = np.concatenate(accel) @ np.linalg.inv(error) + OFFSET
    gyro = np.concatenate(gyro) + BIAS
    accel += rng.normal(0, 0.004, accel.shape)
    return table(accel, gyro + rng.normal(0, 0.05, gyro.shape), flags=1)


def found_accel(out):
    part = calibration.read(str(out))["accel"]
    return np.array(part["offset_ug"]) / 1e6, np.array(part["matrix_ppm"]).reshape(3, 3) / 1e6


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [5, 0, 3, 2, 4, 1]])
def test_six_positions_give_offsets_and_scales(order, run, out, tmp_path):
    counts = holding(tilted(FACES[order], 8))
    done = run("accel", save(tmp_path / "s.imu", counts), "--out", out)
    assert done.exit_code == 0, done.output
    offset, matrix = found_accel(out)
    assert np.abs(offset - OFFSET).max() < 0.001
    assert np.abs(matrix - SCALES).max() < 0.001
    assert "still 6 times, 6 different positions: without cross terms" in done.output


def test_more_positions_give_the_cross_terms(run, out, tmp_path):
    rng = np.random.default_rng(4)
    more = rng.normal(size=(18, 3))
    ups = np.concatenate([tilted(FACES, 8), more / np.linalg.norm(more, axis=1)[:, None]])
    done = run("accel", save(tmp_path / "s.imu", holding(ups, CROSSED)), "--out", out)
    assert done.exit_code == 0, done.output
    offset, matrix = found_accel(out)
    assert np.abs(offset - OFFSET).max() < 0.001
    assert np.abs(matrix - CROSSED).max() < 0.001
    before, after = map(
        float, re.search(r"by ([\d.]+) mg before, ([\d.]+) mg after", done.output).groups()
    )
    assert before > 20 and after < 1


@pytest.mark.parametrize(
    "counts, said",
    [
        (holding(FACES[[0, 1, 2, 3, 5]]), r"5 still positions, but none with -y up"),
        (holding(FACES[:1], seconds=9), r"1 still position, but none with -x, \+y, -y, \+z, -z up"),
        (holding(FACES, seconds=0.5), "never lay still"),
        (holding(np.concatenate([FACES, FACES * 1.2])), "no offset and scale fit"),
        (np.zeros((2000, 11)), "are all 0"),
    ],
    ids=["one face missing", "one face only", "too quick", "in the hand", "zero"],
)
def test_positions_that_do_not_do_are_refused_with_what_is_missing(
    counts, said, run, out, tmp_path
):
    done = run("accel", save(tmp_path / "s.imu", counts), "--out", out)
    assert done.exit_code == 2
    assert re.search(said, done.output), done.output
    assert not out.exists()


def test_a_slow_steady_turn_is_no_position(tmp_path):
    turn = np.linspace(0, 2 * np.pi, 12000)  # 3 deg/s about x
    accel = np.stack([0 * turn, np.sin(turn), np.cos(turn)], 1)
    counts = table(accel, np.tile([3.0, 0, 0], (12000, 1)), flags=1)
    assert len(rest_fit.positions(recordings.load(save(tmp_path / "s.imu", counts)))) == 0


# ---------------------------------------------------------------------------------------- the file
def test_each_part_is_kept_when_another_is_written(run, out, tmp_path):
    said = {"chip": "MPU6500", "board": "board A"}
    mag = save(tmp_path / "t.imu", table(mag=tumble(directions())), **said)
    gyro = save(tmp_path / "r.imu", resting(), **said)
    accel = save(tmp_path / "s.imu", holding(tilted(FACES, 5)))
    assert "written: mag" in run("mag", mag, "--out", out).output
    assert "updated: gyro_bias_udps; kept: mag" in run("gyro", gyro, "--out", out).output
    done = run("accel", accel, "--out", out)
    assert "updated: accel; kept: gyro_bias_udps, mag" in done.output
    fields = calibration.read(str(out), "MPU6500", "board A")
    assert all(fields[key] for key in ("chip", "board", "gyro_bias_udps", "accel", "mag"))
    shown = run("show", out)
    assert shown.exit_code == 0
    for part in ("valid", "MPU6500", "board A", "1.25", "accel offset", "mag matrix"):
        assert part in shown.output


def test_a_file_of_another_chip_or_a_corrupt_one_is_left_alone(run, out, tmp_path):
    file = save(tmp_path / "r.imu", resting(), chip="MPU6050")
    calibration.write(str(out), calibration.blank("MPU6500"))
    before = out.read_bytes()
    done = run("gyro", file, "--out", out)
    assert done.exit_code == 2 and "made for the chip MPU6500, this is MPU6050" in done.output
    assert out.read_bytes() == before
    out.write_bytes(before[:-5])
    done = run("gyro", file, "--out", out)
    assert done.exit_code == 2 and "remove it, or give another --out" in done.output
    assert out.read_bytes() == before[:-5]


@pytest.mark.parametrize(
    "text, arguments, said",
    [
        (None, (), "missing: .*no such file"),
        (b"{}", (), "foreign: .*not of the format"),
        (b"{", (), "corrupt: .*not JSON"),
        ("valid", ("--chip", "MPU6050"), "foreign: .*made for the chip MPU6500"),
        ("valid", ("--board", "B"), "foreign: .*made for the board A"),
    ],
)
def test_show_says_why_a_file_is_not_valid(text, arguments, said, run, out):
    if text == "valid":
        calibration.write(str(out), calibration.blank("MPU6500", "A"))
    elif text is not None:
        out.write_bytes(text)
    done = run("show", out, *arguments)
    assert done.exit_code == 2
    assert re.search(said, done.output), done.output


# ---------------------------------------------------------------------------------------- recordings
def write_csv(path, counts, names=recordings.COLUMNS, head=None):
    columns = [recordings.COLUMNS.index(name) for name in names if name in recordings.COLUMNS]
    rows = np.rint(counts).astype(int)[:, columns].tolist()
    lines = [head or ",".join(names)] + [",".join(map(str, row)) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_csv_of_counts_will_do(run, out, tmp_path):
    mag = write_csv(tmp_path / "t.csv", table(mag=tumble(directions())), ("mx", "my", "mz"))
    assert run("mag", mag, "--out", out).exit_code == 0
    rest = write_csv(tmp_path / "r.csv", resting(), head=" AX, ay ,az,gx,gy,gz,mx,my,mz,temp,flags")
    done = run("gyro", rest, "--out", out)
    assert done.exit_code == 2 and "give --rate" in done.output
    assert run("gyro", rest, "--out", out, "--rate", RATE).exit_code == 0
    assert np.abs(np.array(calibration.read(str(out))["gyro_bias_udps"]) / 1e6 - BIAS).max() < 0.01
    ranges = ("--gyro-range", 1000, "--accel-range", 8, "--rate", RATE)
    assert run("gyro", rest, "--out", out, *ranges).exit_code == 0
    assert calibration.read(str(out))["gyro_bias_udps"][0] == pytest.approx(BIAS[0] * 5e5, abs=5e3)


def test_a_csv_may_bring_its_times(run, out, tmp_path):
    rows = np.rint(resting()).astype(int)
    lines = ["t,ax,ay,az,gx,gy,gz"]
    lines += [f"{i / RATE:.3f}," + ",".join(map(str, row[:6])) for i, row in enumerate(rows)]
    (tmp_path / "r.csv").write_text("\n".join(lines))
    done = run("gyro", tmp_path / "r.csv", "--out", out)
    assert done.exit_code == 0 and "at rest for 5.0 s" in done.output


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("a.csv", "", "not a CSV file with a header"),
        ("a.csv", "1,2,3\n4,5,6\n", "names none of the columns ax ay"),
        ("a.csv", "mx,my,mz\n1,2,3\n1,2\n", "line 3"),
        ("a.csv", "mx,my,mz\n1,2,x\n", "line 2.*whole counts"),
        ("a.csv", "mx,my,mz\n1,2,40000\n", "16 bits"),
        ("a.csv", "mx,my,mz\n", "no rows"),
        ("a.imu", "hello\n", "not an .imu file"),
        ("a.imu", "", "not an .imu file"),
        ("a.npz", "hello", "a.npz"),
        ("absent.imu", None, "no such file"),
        ("absent.npz", None, "no such file"),
        ("absent.csv", None, "no such file"),
    ],
)
def test_what_is_no_recording_is_named_with_what_is_wrong(name, text, said, run, out, tmp_path):
    if text is not None:
        (tmp_path / name).write_text(text)
    for command in ("mag", "gyro", "accel"):
        done = run(command, tmp_path / name, "--out", out)
        assert done.exit_code == 2
        assert re.search(said, done.output), done.output
        assert done.exception is None or isinstance(done.exception, SystemExit)


def test_ranges_that_no_chip_has_are_refused(run, out, tmp_path):
    file = write_csv(tmp_path / "r.csv", resting())
    done = run("gyro", file, "--out", out, "--rate", RATE, "--gyro-range", 300)
    assert done.exit_code == 2 and "no range" in done.output


def test_a_recorded_trial_calibrates(recorded, run, out):
    """Every trial is one of a person moving a sensor, or of one at rest: the fit takes it or says why not."""
    for command in ("mag", "gyro", "accel"):
        done = run(command, recorded, "--out", out)
        assert done.exit_code in (0, 2)
        assert done.exception is None or isinstance(done.exception, SystemExit)
    if "slow_rotation" in recorded.stem:
        field = calibration.read(str(out))["mag"]
        assert np.abs(field["offset_mlsb"]).max() < 3000  # BROAD's magnetometer is calibrated
        assert np.abs(np.array(field["matrix_ppm"]).reshape(3, 3) / 1e6 - np.eye(3)).max() < 0.02
    if "static" in recorded.stem and recorded.stem.startswith("mpu6050"):
        assert calibration.read(str(out))["gyro_bias_udps"]


# ---------------------------------------------------------------------------------------- the recorder
@pytest.fixture
def board():
    """board(counts, rate) -> a board whose MPU6050 feels them; rows of (n, 11)."""

    def make(path, counts, **parts):
        held = world.World(str(save(path, counts, clocked=False)))
        held.start(0)
        machine.wire_i2c(0, MPU6050Chip(held))
        bus = machine.I2C(0, scl=machine.Pin(5), sda=machine.Pin(4), freq=400000)
        return SimpleNamespace(NAME="test board", sensor=lambda: MPU6050(bus), **parts)

    return make


def test_what_the_board_records_calibrates_it(run, out, tmp_path, board, capsys):
    """The six positions on the simulated board: recorded, fitted, applied: 1 g in every direction."""
    motion = holding(tilted(FACES, 5), seconds=2)
    file = tmp_path / "s.imu"
    n = record.run(str(file), seconds=16, board=board(tmp_path / "world.imu", motion))
    said = capsys.readouterr().out
    # a word that falls to exactly 0 at once may be none
    assert n == 1600 and re.search(r"s\.imu: 1600 rows, [01] of them missed", said)
    assert f"mpremote cp :{file} ." in said
    assert run("accel", file, "--out", out).exit_code == 0
    fields = calibration.read(str(out), "MPU6050", "test board")
    assert (fields["chip"], fields["board"]) == ("MPU6050", "test board")
    c = calibration.Calibration()
    c.load(str(out), "MPU6050", "test board")
    for at in range(6):
        rows = motion[at * 260 + 50 : at * 260 + 150].mean(0).round().astype(int)
        c.apply(array("h", [*rows[:10].tolist(), 1]))
        assert np.linalg.norm(c.counts[:3]) == pytest.approx(LSB, abs=12)  # 3 mg
        assert abs(np.linalg.norm(rows[:3]) - LSB) > 40


class OwnMagnetometer:
    """A magnetometer on a bus of its own: a new sample with every read."""

    own_bus = True

    chip = "IST8310"
    sample_rate = (100, 1)
    lsb_per_uT = (33, 10)

    def __init__(self, samples, absent=False):
        self.samples = np.rint(samples).astype(int).tolist()
        self.absent = absent
        self.reads = 0

    def configure(self, rate_hz, sample_rate):
        assert (rate_hz, sample_rate) == (100, (100, 1))
        if self.absent:
            raise OSError("no IST8310 at 0x0e")

    def read(self, counts):
        for i in range(3):
            counts[6 + i] = self.samples[self.reads][i]
        counts[10] |= 2
        self.reads += 1
        return counts[10]


def test_a_tumble_is_recorded_with_the_magnetometer_and_calibrates_it(run, out, tmp_path, board):
    mag = OwnMagnetometer(tumble(directions(1000)))
    parts = {"magnetometer": lambda imu: mag, "MAG_RATE_HZ": 100}
    b = board(tmp_path / "world.imu", resting(20), **parts)
    assert record.run(str(tmp_path / "t.imu"), 10, board=b) == 1000
    done = run("mag", tmp_path / "t.imu", "--out", out)
    assert done.exit_code == 0, done.output
    assert "1000 samples" in done.output and " uT (" in done.output
    offset = np.array(calibration.read(str(out))["mag"]["offset_mlsb"]) / 1000
    assert np.linalg.norm(offset - HARD) < 0.01 * FIELD


def test_a_tumble_of_the_robomaster_a_is_recorded_through_its_chips(run, out, tmp_path):
    """MPU6500, auxiliary bus, IST8310, recorder, fit, file, and the tick's arithmetic on what the chips give."""
    counts = table(mag=tumble(directions(4400), noise=0))
    felt = world.World(str(save(tmp_path / "world.imu", counts, rate=200, clocked=False)))
    spec = importlib.util.spec_from_file_location("board_a", paths.BOARDS / "robomaster_a/board.py")
    board = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(board)
    boards.wire("robomaster_a", board, felt, {})
    felt.start(kernel.now() + 400000)
    assert record.run(str(tmp_path / "t.imu"), 21, board=board) == 2100
    done = run("mag", tmp_path / "t.imu", "--out", out)
    assert done.exit_code == 0, done.output
    assert int(re.search(r"(\d+) samples", done.output)[1]) > 900
    c = calibration.Calibration(board.IMU_AXES, board.MAG_AXES, LSB)
    c.load(str(out), "MPU6500", board.NAME)
    recorded = world.World(str(tmp_path / "t.imu"))
    strength = FIELD * np.linalg.det(SOFT) ** (1 / 3)
    n = 0
    for k in range(recorded.n):
        c.apply(recorded.row(k))
        if c.counts[10] & 2 and 100 < k < 2000:
            n += 1
            assert np.linalg.norm(c.counts[6:9]) == pytest.approx(strength, rel=0.015)
    assert n > 800


def test_without_its_magnetometer_the_rest_is_recorded(tmp_path, board, capsys):
    mag = OwnMagnetometer([], absent=True)
    b = board(tmp_path / "world.imu", resting(), magnetometer=lambda imu: mag)
    assert record.run(str(tmp_path / "t.imu"), 1, board=b) == 100
    assert "no IST8310 at 0x0e; recording without it" in capsys.readouterr().out
    assert mag.reads == 0


def interrupting(imu, after):
    """The same driver, with Ctrl-C pressed at the read of that number."""
    read, n = imu.read, [0]

    def interrupted():
        n[0] += 1
        if n[0] == after:
            raise KeyboardInterrupt
        return read()

    imu.read = interrupted
    return imu


@pytest.mark.parametrize("after", [2, 500, 5000])
def test_ctrl_c_ends_a_recording_that_is_whole_all_the_same(after, tmp_path, board, capsys):
    b = board(tmp_path / "world.imu", resting())
    sensor = b.sensor
    b.sensor = lambda: interrupting(sensor(), after)
    n = record.run(str(tmp_path / "r.imu"), 60, board=b)
    assert "ended" in capsys.readouterr().out
    if after == 2:
        assert n <= 1
    else:
        assert 20 < n < 3000
        assert world.World(str(tmp_path / "r.imu")).n == n


def test_rows_that_were_missed_are_there_and_not_fresh(tmp_path, board):
    b = board(tmp_path / "world.imu", resting())
    sensor = b.sensor

    def slow_now_and_then():
        import time

        imu = sensor()
        read, n = imu.read, [0]

        def read_or_wait():
            n[0] += 1
            if n[0] % 500 == 0:
                time.sleep_us(73000)  # as the flash does while it is being erased
            return read()

        imu.read = read_or_wait
        return imu

    b.sensor = slow_now_and_then
    assert record.run(str(tmp_path / "r.imu"), 5, board=b) == 500
    recorded = recordings.load(tmp_path / "r.imu")
    missed = (~recorded.fresh(1)).sum()
    assert 10 < missed < 100
    rows = np.flatnonzero(recorded.fresh(1))
    assert np.diff(rows).max() in (7, 8)


def test_a_sensor_that_stops_ends_the_recording(tmp_path, board):
    b = board(tmp_path / "world.imu", resting())
    sensor = b.sensor

    def dying():
        imu = sensor()
        read, n = imu.read, [0]

        def read_or_nothing():
            n[0] += 1
            return read() if n[0] < 500 else 0

        imu.read = read_or_nothing
        return imu

    b.sensor = dying
    with pytest.raises(OSError, match="no sample for 2 s"):
        record.run(str(tmp_path / "r.imu"), 60, board=b)
    assert 20 < world.World(str(tmp_path / "r.imu")).n < 300  # what there was is whole


def test_a_recording_that_does_not_fit_is_not_begun(tmp_path, board, monkeypatch):
    b = board(tmp_path / "world.imu", resting())
    monkeypatch.setattr(record.os, "statvfs", lambda path: (4096, 4096, 50, 20), raising=False)
    with pytest.raises(OSError, match="60 s take 132000 bytes, 73728 are free"):
        record.run(str(tmp_path / "r.imu"), 60, board=b)
    assert not (tmp_path / "r.imu").exists()


def test_a_program_that_still_ticks_is_stopped(tmp_path, board, monkeypatch):
    stopped = []

    class Left:
        def stop(self):
            stopped.append(self)
            ahrs.running.remove(self)

    left = [Left(), Left()]
    monkeypatch.setattr(ahrs, "running", list(left))
    record.run(str(tmp_path / "r.imu"), 1, board=board(tmp_path / "world.imu", resting()))
    assert stopped == left


def test_it_records_the_same_on_every_runtime(runtime, portable, run, tmp_path, out):
    motion = save(tmp_path / "world.imu", resting(4))
    file = tmp_path / "r.imu"
    said = portable(runtime, "calibration_steps.py", "record", motion, file, 2)
    assert said.endswith("\n200\n")
    theirs = recordings.load(file)
    if runtime != "cpython":
        portable("cpython", "calibration_steps.py", "record", motion, tmp_path / "ours.imu", 2)
        assert (theirs.counts == recordings.load(tmp_path / "ours.imu").counts).all()
    assert theirs.chip == "MPU6050" and theirs.fresh(1).all()
    assert run("gyro", file, "--out", out).exit_code == 0
