"""`upright calibrate`: magnetometer (a tumble), gyro (rest), accelerometer (six positions and more) from recordings.

The file that it writes is lib/upright/calibration.py's, which also reads and checks it here. All is fitted in the
chip's own frame. docs/calibration.md says how to record, and gives the formula.
"""

import contextlib
from pathlib import Path

import numpy as np
import typer

from upright_host import console, library, options
from upright_host.console import Wrong
from upright_host.mag_fit import DOUBTFUL_OUTLIERS, DOUBTFUL_RESIDUAL, MagFit, fit_mag
from upright_host.recordings import load
from upright_host.rest_fit import FULL_POSES, AccelFit, fit_accel, fit_gyro, positions

EARTH_UT = (22, 67)  # the field's strength at the surface (IGRF)


def _whole(values, unit: float) -> list[int]:
    return [round(float(v) * unit) for v in np.ravel(values)]


def mag_fields(fit: MagFit) -> dict:
    return {"offset_mlsb": _whole(fit.offset, 1e3), "matrix_ppm": _whole(fit.matrix, 1e6)}


def accel_fields(fit: AccelFit) -> dict:
    return {"offset_ug": _whole(fit.offset, 1e6), "matrix_ppm": _whole(fit.matrix, 1e6)}


def store(out: Path, key: str, value, chip: str | None, board: str | None) -> str:
    """Put one part into a calibration file, made where it is missing; -> what happened. Raises Wrong."""
    file = library.upright("calibration")
    try:
        fields = file.read(str(out), chip, board)
        did = "updated"
    except file.CalibrationError as why:
        if why.kind != "missing":
            raise Wrong(f"{why}; remove it, or give another --out") from why
        fields = file.blank()
        did = "written"
    fields["chip"] = fields["chip"] or chip
    fields["board"] = fields["board"] or board
    fields[key] = value
    try:
        file.write(str(out), fields)
    except file.CalibrationError as why:
        raise Wrong(f"not written: {why}") from why
    kept = [k for k in ("gyro_bias_udps", "accel", "mag") if k != key and fields[k]]
    return f"{out} {did}: {key}" + (f"; kept: {', '.join(kept)}" if kept else "")


def describe(fields: dict) -> list[str]:
    """What a calibration file says, in lines for people."""
    of = [f"for the {k} {fields[k]}" for k in ("chip", "board") if fields[k]]
    lines = [", ".join(of) or "for any chip and board"]
    bias = fields["gyro_bias_udps"]
    lines.append("gyro bias      " + (_vector(bias, 1e6, ".3f", "deg/s") if bias else "none"))
    for key, offset, unit, form, name in (
        ("accel", "offset_ug", 1e3, ".2f", "mg"),
        ("mag", "offset_mlsb", 1e3, ".1f", "counts"),
    ):
        part = fields[key]
        if not part:
            lines.append(f"{key:<15}none")
            continue
        lines.append(f"{key + ' offset':<15}" + _vector(part[offset], unit, form, name))
        for i in range(3):
            row = "".join(f"{v / 1e6:10.6f}" for v in part["matrix_ppm"][3 * i : 3 * i + 3])
            lines.append(f"{key + ' matrix' if i == 0 else '':<14}{row}")
    return lines


def _vector(values, unit, form, name) -> str:
    said = (f"{axis} {v / unit:{form}}" for axis, v in zip("xyz", values, strict=True))
    return "  ".join(said) + f" {name}"


def _matrix_lines(title: str, matrix: np.ndarray) -> list[str]:
    rows = ["".join(f"{v:10.5f}" for v in row) for row in matrix]
    return [f"{title if i == 0 else '':<14}{row}" for i, row in enumerate(rows)]


# ---------------------------------------------------------------------------------------- commands
# what a board looks for
_DEFAULT = Path(library.upright("settings").DEFAULTS["CALIBRATION"])
_FILE = typer.Argument(..., help="A recording: .imu, a trial .npz, or .csv of counts.")
_OUT = typer.Option(
    _DEFAULT,
    callback=options.writable,
    help="The calibration file to write or update.",
)
_CHIP = typer.Option(
    None, help="The IMU's name, as the firmware prints it (a recorded .imu knows)."
)
_BOARD = typer.Option(None, help="The board's NAME (a recorded .imu knows).")
_RATE = typer.Option(None, min=1, max=100_000, help="Rows per second of a .csv.")
_ACCEL_RANGE = typer.Option(8, help="Accelerometer range of a .csv, g.")
_GYRO_RANGE = typer.Option(2000, help="Gyro range of a .csv, deg/s.")


@contextlib.contextmanager
def untouched():
    """The calibration file of this folder is a real board's: what a simulated one stores in it meanwhile is undone."""
    before = _DEFAULT.read_bytes() if _DEFAULT.exists() else None
    try:
        yield
    finally:
        if before is None:
            _DEFAULT.unlink(missing_ok=True)
        elif _DEFAULT.read_bytes() != before:
            _DEFAULT.write_bytes(before)


def register(app: typer.Typer) -> None:
    """Give an app the commands `calibrate mag`, `gyro`, `accel` and `show`."""
    commands = typer.Typer(
        no_args_is_help=True, help="Calibrate from recordings; see docs/calibration.md."
    )
    app.add_typer(commands, name="calibrate")

    @commands.command("mag")
    def mag(
        file: Path = _FILE,
        out: Path = _OUT,
        chip: str = _CHIP,
        board: str = _BOARD,
        lsb_per_ut: float = typer.Option(
            None,
            min=0.01,
            max=100_000,
            help="Counts per uT, to show the field in uT (IST8310: 3.3).",
        ),
    ):
        """Hard and soft iron from a tumble through all directions."""
        recording = load(file)
        fit = fit_mag(recording.magnetic())
        scale = lsb_per_ut or recording.mag_lsb_per_uT
        strength = f"{fit.strength:.1f} counts"
        if scale:
            strength = f"{fit.strength / scale:.1f} uT ({strength})"
        share = np.linalg.norm(fit.offset) / fit.strength
        console.say(f"{recording.name}: {fit.samples} samples, {fit.outliers} left out as outliers")
        console.say(f"directions    {fit.coverage:.0%} covered")
        console.say(f"field         {strength}")
        console.say(
            f"hard iron     {_vector(fit.offset, 1, '.1f', 'counts')} ({share:.0%} of the field)"
        )
        for line in _matrix_lines("soft iron", fit.matrix):
            console.say(line)
        console.say(f"strength      varies by {fit.before:.1%} before, {fit.after:.1%} after (rms)")
        if fit.after > DOUBTFUL_RESIDUAL or fit.outliers > DOUBTFUL_OUTLIERS * fit.samples:
            console.say(
                "doubtful: the field was not the same all the way; record again, away from iron and magnets"
            )
        if scale and not EARTH_UT[0] <= fit.strength / scale <= EARTH_UT[1]:
            console.say(f"doubtful: the earth's field is {EARTH_UT[0]} to {EARTH_UT[1]} uT strong")
        console.say(
            store(out, "mag", mag_fields(fit), chip or recording.chip, board or recording.board)
        )

    @commands.command("gyro")
    def gyro(
        file: Path = _FILE,
        out: Path = _OUT,
        chip: str = _CHIP,
        board: str = _BOARD,
        rate: float = _RATE,
        gyro_range: int = _GYRO_RANGE,
        accel_range: int = _ACCEL_RANGE,
    ):
        """The gyro's bias from a recording at rest."""
        recording = load(file, rate, accel_range, gyro_range)
        fit = fit_gyro(recording)
        console.say(f"{recording.name}: at rest for {fit.seconds:.1f} s")
        console.say(f"bias          {_vector(fit.bias, 1, '.3f', 'deg/s')}")
        console.say(f"moved         {fit.moved_dps:.2f} deg/s, {1000 * fit.moved_g:.0f} mg")
        bias = _whole(fit.bias, 1e6)
        console.say(
            store(out, "gyro_bias_udps", bias, chip or recording.chip, board or recording.board)
        )

    @commands.command("accel")
    def accel(
        file: Path = _FILE,
        out: Path = _OUT,
        chip: str = _CHIP,
        board: str = _BOARD,
        rate: float = _RATE,
        gyro_range: int = _GYRO_RANGE,
        accel_range: int = _ACCEL_RANGE,
    ):
        """The accelerometer's offsets and scales from still positions: all six faces up, in any order."""
        recording = load(file, rate, accel_range, gyro_range)
        fit = fit_accel(positions(recording))
        what = "with cross terms" if fit.full else f"without cross terms (from {FULL_POSES} on)"
        console.say(
            f"{recording.name}: still {len(fit.positions)} times, {fit.poses} different positions: {what}"
        )
        console.say(f"offset        {_vector(fit.offset * 1000, 1, '.2f', 'mg')}")
        for line in _matrix_lines("matrix", fit.matrix):
            console.say(line)
        left = f"{1000 * fit.after:.2f} mg after (rms)"
        if len(fit.positions) <= (9 if fit.full else 6):
            left = "no position left over to check the fit with"
        console.say(f"1 g           off by {1000 * fit.before:.2f} mg before, {left}")
        console.say(
            store(out, "accel", accel_fields(fit), chip or recording.chip, board or recording.board)
        )

    @commands.command("show")
    def show(
        file: Path = typer.Argument(_DEFAULT, help="A calibration file."),
        chip: str = typer.Option(None, help="Is it for this IMU?"),
        board: str = typer.Option(None, help="Is it for this board?"),
    ):
        """What a calibration file holds, and whether it is valid."""
        file_format = library.upright("calibration")
        try:
            fields = file_format.read(str(file), chip, board)
        except file_format.CalibrationError as why:
            raise Wrong(f"{why.kind}: {why}") from why
        console.say(f"{file}: valid")
        for line in describe(fields):
            console.say(line)
