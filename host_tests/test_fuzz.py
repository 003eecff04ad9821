"""Whatever a file holds, the answer is its contents or one clear line: ten thousand inputs for each parser, and in
`make soak` a million. Input number N of a parser is the same in every run."""

import inspect
import io
import json
import os
import random
import tempfile
import warnings
import zipfile
from array import array
from binascii import crc32
from pathlib import Path

import numpy as np
import pytest
import trial_files
from dmp_images import LIST, V20, V612
from fuzz import as_json, damaged, damaged_value
from upright import calibration, dmp_image
from upright import dmp as mpu_dmp
from upright_host import (
    contents,
    dmp,
    faults,
    flash,
    library,
    mag_fit,
    paths,
    recordings,
    rest_fit,
    scoring,
    trials,
)
from upright_host.console import Wrong

INPUTS, SOAKED = 10_000, 1_000_000
PARSERS = {}


def parser(function):
    """function(folder) -> one(rng), which makes an input, has it parsed, and looks at what comes of it."""
    PARSERS[function.__name__] = function
    return function


def refused(error):
    """It says what is wrong in one line."""
    text = str(error)
    assert text.strip() and "\n" not in text, repr(text)[:2000]


@parser
def trial(folder):
    path = trial_files.save(folder / "seed.npz", seconds=0.5)
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(np.load(path)["header"].tobytes())
    file = folder / "fuzzed.npz"

    def packed(parts):
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            for name, data in parts.items():
                archive.writestr(name, data)
        return out.getvalue()

    def with_header(text):
        out = io.BytesIO()
        np.save(out, np.frombuffer(text, np.uint8))
        return packed(members | {"header.npy": out.getvalue()})

    def one(rng):
        kind = rng.randrange(4)
        if kind == 0:
            file.write_bytes(damaged(rng, whole))
        elif kind == 1:
            name = rng.choice(list(members))
            file.write_bytes(packed(members | {name: damaged(rng, members[name])}))
        elif kind == 2:
            file.write_bytes(with_header(damaged(rng, as_json(header))))
        else:
            file.write_bytes(with_header(as_json(damaged_value(rng, header))))
        try:
            found = trials.load(file)
        except trials.TrialError as why:
            return refused(why)
        assert found.counts.dtype == np.int16 and found.counts.shape == (found.n, 11)
        assert found.rows(0.1) <= found.n
        if found.has_truth:
            assert found.q_true().shape == (len(found.movement), 4)
        found.write(folder / "fuzzed.imu")
        recordings.load(folder / "fuzzed.imu")

    return one


@parser
def calibration_file(folder):
    fields = calibration.blank("MPU6050", "a board") | {
        "gyro_bias_udps": [1197000, -801000, 596000],
        "accel": {"offset_ug": [1000, -2000, 3000], "matrix_ppm": [1000000, 0, 0] * 2 + [0, 0, 990000]},
        "mag": {"offset_mlsb": [1, 2, 3], "matrix_ppm": [1000000, 0, 0, 0, 900000, 0, 0, 0, 1100000]},
        "up_ppm": [0, 0, 1000000],
    }  # fmt: skip
    fields["accel"]["matrix_ppm"] = [1000000, 0, 0, 0, 1010000, 0, 0, 0, 990000]
    file = folder / "upright_cal.json"
    calibration.write(str(file), fields)
    whole = file.read_bytes()
    raw = array("h", [32767, -32768, 4096, 1, -1, 32767, -32768, 300, 0, 0, 3])

    def sealed(body):
        return body + b' "checksum": "%08x"\n}\n' % crc32(body)

    def one(rng):
        kind = rng.randrange(3)
        if kind == 0:
            file.write_bytes(damaged(rng, whole))
        elif kind == 1:
            file.write_bytes(sealed(damaged(rng, whole[: whole.rindex(b' "checksum"')])))
        else:
            file.write_bytes(sealed(as_json(damaged_value(rng, fields)).rstrip(b"}") + b",\n"))
        try:
            found = calibration.read(str(file))
        except calibration.CalibrationError as why:
            return refused(why)
        one = calibration.Calibration()
        try:
            one.set(found)
        except calibration.CalibrationError as why:
            return refused(why)
        one.apply(raw)  # an array of int16 raises where a count does not fit
        one.gyro_bias()

    return one


def analysed(found, rng):
    """What `upright calibrate` makes of a recording; it is a matter of milliseconds, so of some only."""
    if rng.random() > 0.05:
        return
    for fit in (
        lambda: mag_fit.fit_mag(found.magnetic()),
        lambda: rest_fit.fit_gyro(found),
        lambda: rest_fit.fit_accel(rest_fit.positions(found)),
    ):
        try:
            fit()
        except Wrong as why:
            refused(why)


@parser
def csv_of_counts(folder):
    rows = [(i / 100, 1, -2, 4096, *(30, -20, 10), *(82 + i % 3, -i % 7, -141), 0, 3) for i in range(60)]  # fmt: skip
    text = "t," + ",".join(recordings.COLUMNS) + "\n"
    text += "".join(",".join(map(str, row)) + "\n" for row in rows)
    file = folder / "fuzzed.csv"

    def one(rng):
        file.write_bytes(damaged(rng, text.encode()))
        try:
            found = recordings.load(file, None if rng.random() < 0.5 else 100)
        except Wrong as why:
            return refused(why)
        assert found.counts.shape[1] == 11
        analysed(found, rng)

    return one


@parser
def csv_of_attitudes(folder):
    text = scoring.CSV_HEADER + "\n" + "0.005,1,0,0,0\n0.010,0.5,0.5,0.5,0.5\n" * 9
    file = folder / "fuzzed.csv"

    def one(rng):
        file.write_bytes(damaged(rng, text.encode()))
        try:
            t, q = scoring.read_csv(file)
        except ValueError as why:
            return refused(why)
        assert q.shape == (len(t), 4) and np.isfinite(t).all() and np.isfinite(q).all()

    return one


@parser
def recording(folder):
    trial = trial_files.save(folder / "seed.npz", seconds=1.0)
    file = folder / "fuzzed.imu"
    trials.load(trial).write(file)
    head, _, body = file.read_bytes().partition(b"\n")
    header = json.loads(head) | {"mag_lsb_per_uT": [33, 10], "chip": "MPU6050", "board": "a board"}

    def one(rng):
        kind = rng.randrange(3)
        if kind == 0:
            file.write_bytes(damaged(rng, as_json(header) + b"\n" + body))
        elif kind == 1:
            file.write_bytes(as_json(damaged_value(rng, header)) + b"\n" + body)
        else:
            file.write_bytes(as_json(header) + b"\n" + damaged(rng, body))
        try:
            found = recordings.load(file)
        except Wrong as why:
            return refused(why)
        assert found.counts.shape[1] == 11
        for name in (found.chip, found.board):
            assert name is None or isinstance(name, str)
        analysed(found, rng)

    return one


@parser
def image_of_the_dmp(folder):
    in_c = (
        "#define SIZE 3062\nconst unsigned char image[SIZE] = {" + ",".join(map(hex, V612)) + "};\n"
    )
    in_c += "const unsigned char list[] = {" + ",".join(map(str, LIST)) + "};\n"
    seeds = [V612, V20, V612 + LIST, V20 + LIST, in_c.encode()]
    file = folder / "fuzzed.bin"

    def one(rng):
        file.write_bytes(damaged(rng, rng.choice(seeds[:4] if rng.random() < 0.9 else seeds[4:])))
        try:
            data, _ = dmp.read([file])
            image = dmp_image.DmpImage(data, accept_unknown=True)
        except (dmp.ImageError, dmp_image.MpuDmpError) as why:
            return refused(why)
        for address, piece in (*image.pieces(), *image.patches()):
            assert address >> 8 == (address + len(piece) - 1) >> 8 < dmp_image.BANKS
        with pytest.raises(dmp.ImageError) as why:
            dmp.describe(data)
        refused(why.value)

    return one


@parser
def packet_of_the_dmp(folder):
    half = (1 << 29).to_bytes(4, "big")
    images = [dmp_image.DmpImage(data, accept_unknown=True) for data in (V612, V20)]

    def one(rng):
        image = rng.choice(images)
        packet = bytearray(rng.randbytes(image.packet))
        if rng.random() < 0.8:
            packet[:16] = half * 4
            for _ in range(rng.randrange(4)):
                packet[rng.randrange(16)] = rng.randrange(256)
        state, counts = array("i", [0] * mpu_dmp._STATE_WORDS), array("h", [7] * 11)
        state[mpu_dmp._ACCEL], state[mpu_dmp._GYRO] = image.accel_at, image.gyro_at
        state[mpu_dmp._STEP], state[mpu_dmp._FULL] = image.step, image.accel_full
        before = bytes(state)
        flags = mpu_dmp._parse(bytes(2) + packet, 2, state, counts)
        length = sum(
            (int.from_bytes(packet[i : i + 4], "big", signed=True) / 2**30) ** 2
            for i in range(0, 16, 4)
        )
        if flags < 0:
            assert bytes(state) == before and set(counts) == {7}
            assert abs(length - 1) > 0.001
        else:
            assert flags & 1 and counts[10] == flags
            assert abs(length - 1) < 0.1
            q = [x / 2**29 for x in state[mpu_dmp._Q : mpu_dmp._Q + 4]]
            assert abs(sum(x * x for x in q) - length) < 1e-6

    return one


class Files:
    """A board that is but its files, and carries nothing out."""

    def __init__(self, files):
        self.files = files

    def fs_readfile(self, name):
        if name not in self.files:
            raise OSError(2, "ENOENT")
        return self.files[name]

    def exec(self, code, data_consumer=None):
        compile(code, "<sent>", "exec")
        return b""


@parser
def record_of_an_installation(folder):
    """upright.json, the older update.json, and /upright.py, as they lie on a board."""
    record = {"version": "0.1.0", "files": {"main.py": "0" * 64, "lib/upright/tick.mpy": "1" * 64}}
    journal = {"install": ["main.py", "lib/tick.mpy"], "remove": ["boot.py"]}
    script = flash._in_front("finish(['main.py', 'board.py'], ['boot.py'])")

    def some(rng, value):
        return damaged(rng, as_json(value)) if rng.random() < 0.5 else as_json(damaged_value(rng, value))  # fmt: skip

    def one(rng):
        files = {flash.RECORD: some(rng, record), flash.JOURNAL: some(rng, journal)}
        if rng.random() < 0.1:  # it is long
            files[flash.SELF] = damaged(rng, script[-120:] if rng.random() < 0.5 else script)
        board = Files(files)
        found = flash._read_record(board)
        for name, digest in found.items():
            assert isinstance(digest, str) and flash._is_plain(name)
        assert all(isinstance(name, str) for name in flash._finish(board))

    return one


@parser
def board_py(folder):
    """A board.py or main.py of the user's, as `upright flash` and `upright doctor` look through it."""
    seeds = [(paths.BOARDS / name / "board.py").read_bytes() for name in ("pico", "robomaster_a")]
    seeds.append(
        b"FILTER = ['mahony6']\nimport mpu6050\nfrom ahrs import x\nNAME = 'a'\nPLATFORM = 'rp2'\nFOO = 1\n"
    )

    def one(rng):
        text = damaged(rng, rng.choice(seeds))
        board = Files({"board.py": text, "main.py": text})
        own = flash._own(board)
        decoded = text.decode("utf-8", "replace")
        if rng.random() < 0.01:  # they read the modules that it imports
            contents.library(own)
            contents.lines_to_change(decoded, {"mpu6050"}, True)
        contents.lines_to_change(decoded, {"mpu6050"})
        try:
            contents.setting(decoded, "PLATFORM")
        except ValueError as why:
            refused(why)

    return one


@parser
def plan_of_faults(folder):
    plan = [
        [1000, "imu", "nack", None, 3, 1],
        [2000, "imu", "swapped", 500, 112],
        [3000, "bus", "low", 400, "scl"],
    ]
    plan += [[4000, "bus", "raise", None, "OSError"], [5000, "imu", "stuck_axis", 100, 1, 32767]]
    parts = dict.fromkeys(("imu", "display", "bus"), object())
    file = folder / "plan.json"

    def one(rng):
        made = damaged(rng, as_json(plan)) if rng.random() < 0.4 else None
        file.write_bytes(made or as_json(damaged_value(rng, plan)))
        try:
            (case,) = faults._cases((), file)
        except Wrong as why:
            return refused(why)
        library.simulator("faults").Plan(case.faults, parts)
        for _, on, name, _, *values in case.faults:
            begin = library.simulator("faults").FAULTS[name][0]
            if name not in ("brown_out", "jam", "swapped"):
                inspect.signature(begin).bind(None, on, *values)

    return one


@pytest.fixture
def folder():
    """In memory where that can be had: ten thousand files take a busy disk half a minute."""
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as name:
        yield Path(name)


@pytest.mark.soak
@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_a_parser_takes_any_input_or_refuses_it_in_one_line(name, soaking, folder):
    one = PARSERS[name](folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(SOAKED if soaking else INPUTS):
            try:
                one(random.Random(f"{name} {number}"))
            except Exception as why:
                said = f"input {number} of {name}: {type(why).__name__}: {why}"
                raise AssertionError(said) from why
