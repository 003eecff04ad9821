"""The words of each filter's state, and of a magnetometer's: one table, from which the constants in the modules are
written.

A kernel finds a word of the state by a constant of its own module, as MicroPython folds no others. Run this after a
change of a table: `python -m upright_host.words` writes the constants that each module uses, `--check` only compares.
"""

import re
import sys
from dataclasses import dataclass
from types import SimpleNamespace

from upright_host import paths

BEGIN = "# -- words of the state: written by tools/upright_host/words.py\n"
END = "# -- end of the words\n"

# name, length, format, meaning. Qn: the integer is the value times 2**n.
MAHONY = """
PROBE        1  -    always -1: ptr32 zero-extends on 64-bit ports, see fixmath.py
Q            4  Q29  quaternion w x y z, body to earth
QR           4  Q44  its rounding remainder, 0..32767
W            3  Q31  half the angle of this step, rad
WR           3  Q46  its rounding remainder, 0..32767
V            3  -    a measured vector, scaled so that its length is 2**15..2**16
VR           1  Q30  1 / that length, 16384..32768
UP           3  Q28  the estimated up (gravity's reaction) in the body
E            3  Q29  the attitude error as a rotation vector in the body; see north
LOW          1  -    least squared length / 4 of the accelerometer's counts that is used, 4..2**28
I            3  -    integral of the feedback, half angle per step, Q(31 + I_SHIFT)
IR           3  -    its remainder, KI_SHIFT bits
B            3  Q31  gyro bias, half angle per step
BR           3  Q46  its last bits, 0..32767
O            3  Q31  integral - bias, half angle per step
OR           3  Q46  its last bits, -32767..32767
G            1  Q31  half angle per step of one gyro count
GR           1  Q46  its last bits, 0..32767
KP           1  -    2 kp dt = KP / 2**(KP_SHIFT + 14): E (Q29) to half angle (Q31)
KP_SHIFT     1  -    0..16
KI           1  -    ki dt**2 2**(I_SHIFT + 1) = KI / 2**(KI_SHIFT + 14)
KI_SHIFT     1  -    1..29
I_SHIFT      1  -    0..15
I_MAX        1  -    bound of |I|, below 2**30
MAG_MOST     1  -    a magnetometer sample stands for at most so many steps, 1..253; 0: six axes
MAG_AGE      1  -    steps since one was used, 0..2**30 - 1
"""

EULER = """
PROBE        1  -    always -1, see fixmath.py
Q            4  Q29  quaternion w x y z, body to earth
A            3  -    roll, pitch, yaw in the order zyx; pitch within +-2**28
AR           3  -    their last 15 bits, 0..32767
X            3  -    angles for sines(), any within +-2**30
S            3  Q29  their sines
C            3  Q29  their cosines
Z            2  -    roll and pitch that the accelerometer shows
LOW          1  -    least squared length / 4 of the accelerometer's counts that is used
D            2  -    what roll and pitch turned by in the last step
E            2  -    roll and pitch error of this step: accelerometer less gyro
K            1  -    the part of the error that is taken up: K / 2**(K_SHIFT + 14)
K_SHIFT      1  -    0..16
G            1  -    angle per step of one gyro count
GR           1  -    its last 15 bits, 0..32767
WR           3  -    rounding remainders of the gyro's angles, 15 bits
B            3  -    gyro bias that is set, angle per step
BR           3  -    its last 15 bits, 0..32767
O            3  -    what is added to the gyro: less the bias, set and learnt
OR           3  -    its last 15 bits, -65534..0
"""

# Kalman6 has these besides
KALMAN = """
I            3  -    bias that was learnt, angle per step, 2**-(30 + I_SHIFT) turn
IR           3  -    its remainder, K2_SHIFT bits
V            3  -    the error as a turn of the body, its sign that of the gyro's bias
K2           1  -    bias per error = K2 / 2**(K2_SHIFT + 14) in the units of I
K2_SHIFT     1  -    1..29
I_SHIFT      1  -    0..15
I_MAX        1  -    bound of |I|, below 2**30
"""

# what the inertial and the quaternion Kalman filter begin with; a block is 2**BLOCK steps
EARTH = """
PROBE        1  -    always -1, see fixmath.py
Q            4  Q29  quaternion w x y z, body to earth
QR           4  Q44  its rounding remainder, 0..32767
W            3  Q31  half the angle of this step, rad
WR           3  Q46  its rounding remainder, 0..32767
G            1  Q31  half angle per step of one gyro count
GR           1  Q46  its last bits, 0..32767
O            3  Q31  minus the bias as a half angle per step
OR           3  Q46  its last bits, -32767..32767
TURN         3  Q31  correction that the next step takes up, earth frame, half angle
R            9  Q15  rotation matrix; its rows are north, west, up in the body
FS           3  Q9   specific force in the earth frame, counts, summed over the block
ONE_G        1  Q9   counts of 1 g
FULL_END     1  -    1 + 2 axis + sign of the accelerometer at full scale, 0: none is
FULL_STEPS   1  -    steps that it has been there, no more than FULL_MOST + 1
FULL_MOST    1  -    for more steps no body is accelerated so much
FULL_SUM     3  Q3   specific force of these steps, less 1 g, in the earth frame
LATER        3  Q3   of earlier ones, to be added to FS where there is room
LATER_ANY    1  -    not 0: some of it is left
BASE         3  Q8   gyro bias that was set, counts
O_BASE       3  Q31  O of BASE alone
OR_BASE      3  Q46  its last bits
B            3  -    learnt bias on top of BASE, in the filter's own unit
NINE         1  -    1: use the magnetometer
BLOCK        1  -    log2 of the steps of a block
BLOCK_MASK   1  -    steps of a block less 1
PHASE        1  -    fresh steps of the block
DECIDED      1  -    yes/no decisions, for the tests' float twin
GS           3  -    gyro counts summed over the block
MS           3  Q9   magnetometer in the earth frame, counts, summed over the block
MN           1  -    samples in it
SINCE        1  -    blocks since the last with a magnetometer sample, no more than 16
J            1  -    blocks that the heading of this block stands for; 0: none
HEADING      1  Q28  heading error, rad
NOW          2  Q13  horizontal and vertical field, counts
IN           6  Q12  what LOW1 takes up: accelerometer, gyro less BASE, counts
LOW1         6  Q12  first low-pass of it
LOW2         6  Q12  second
AWAY         2  Q6   squared distance from LOW2 of accelerometer and gyro, counts**2
BLOCKS       1  -    of the low-passes' start
STILL        1  -    blocks without motion, no more than REST_AFTER
REST_AFTER   1  -    blocks
REST_K       1  Q15  gain of the low-passes
REST_GYRO    1  Q6   at rest AWAY is less: counts**2
REST_ACCEL   1  Q6   the same of the accelerometer
REST_MOST    1  Q12  most that is taken for a bias, counts
"""

# of the inertial filter; a block is a levelling, and what counts blocks in rest, P and field counts pairs of them
INERTIAL = """
TWO_MASK     1  -    steps of two blocks less 1
LEVEL        1  -    log2 of the steps of a levelling: 0 at the start, BLOCK in the end
LEVEL_MASK   1  -    steps of it less 1
REGRESS      1  -    1: the regressors take their step next
PART         1  -    part of the work of two blocks that comes next
PACE         1  -    parts in one step
GG           3  -    gyro counts summed over two blocks
FULL         1  -    samples in a row with a gyro axis at full scale, no more than 10
CLIPS        1  -    samples with one, no more than 2**30 - 1
CLIPPED      1  -    samples with one since P grew last
CLIP         1  Q15  what one adds to the doubt of the heading, units of 2.5 rad
MISSED       1  -    steps without a sample since P grew last
MISS         1  Q28  what one of them adds for 4 counts of HELD's root, units of 2.5 rad
OUTAGE       1  -    steps without a fresh sample after which the tilt starts again
SEEN         3  Q12  the gyro of one sample, less BASE
H            3  Q14  specific force of the block in the earth frame, counts
RATE         1  -    squared turn rate of the block, (4 counts)**2
HELD         1  -    the same: follows up at once and down slowly
HELD_K       1  Q15  gain down
S            3  Q14  low-passed specific force in the earth frame, counts
OFF          2  Q14  the block's force less the low-pass, horizontal, counts
SF           2  Q14  the force low-passed quickly, horizontal, counts
SF_K         1  Q15  gain of it
LEAN_G       1  -    |SF| beyond which the tilt is lost: (4 counts)**2
LEAN         1  -    blocks with more
LEAN_AFTER   1  -    blocks
K            1  -    tilt gain of this levelling = K / 2**K_SHIFT, K < 2**15
K_SHIFT      1  -
KC           1  -    the same for S (normalised) to half angle
KC_SHIFT     1  -
AGAIN        1  -    1: the ramp starts anew
N            1  -    steps since the start of the ramp, no more than N_END
N_LATE       1  -    steps until the bias is estimated in motion
N_FULL       1  -    steps until it is at full weight
N_END        1  -    steps after which the start is over
RAMP         1  Q8   ramp of the tilt
K_PACE       1  Q20  tilt gain of a block after the start
K_START      1  Q20  tilt gain of a block while little is known of the bias ...
K_LEAST      1  Q20  ... and its bounds afterwards
K_MOST       1  Q20
K_TURN       1  -    tilt gain for the fourth root of HELD: K_TURN / 2**22
NORM         1  -    shift that brings 1 g to 2**14..2**15 counts
G1           1  -    1 g in counts
LI           1  Q29  1 / (1 g, normalised)
OM_GAIN      1  Q24  1 / (accel_doubt, normalised)
X            6  Q24  regressors north and west: inner low-pass
Y            6  Q24  outer low-pass
D            1  Q15  square of the horizontal deviation / accel_doubt**2
OM           1  Q15  tilt confidence 1 / (1 + D)
REST_OFF     1  Q12  most that a known bias may be off, counts
UPSET        1  -    tilt at rest that restarts the ramp: (counts / 4)**2
JUMP         1  Q12  a bias found at rest that restarts the ramp, counts
SOON         1  -    steps after a restart in which no other follows
WAIT         1  -    blocks for which a rest has contradicted the bias
WAIT_MOST    1  -    blocks
WAIT_SURE    1  -    blocks after which a slow turn is decided, too
WAIT_E       1  Q28  the heading error at their start, rad
WAIT_TURN    1  Q28  corrections of the heading since, rad
WAIT_A       3  Q12  accelerometer at their start, counts
WAIT_MOVED   1  -    how far it may be from there: counts**2 / 16
GYRO         1  Q28  the angle of a count in two blocks, rad
B_SHIFT      1  -    B is in counts, Q(B_SHIFT)
B_MAX        1  -    its bound
B_UNIT       1  -    the unit of P's biases in B's, / 2**13
B_INVERSE    1  -    2**20 counts / this unit
P            16 Q30  covariance of heading (2.5 rad) and bias (bias_start * 2**0.5), 4 x 4
DX           4  Q27  their correction in these two blocks
INNOVATION   1  Q27  what is measured of ROW . (heading, bias), less what DX says ...
NOISE        1  Q20  ... its variance ...
Z            4  Q30  ... P ROW ...
TOTAL        1  Q30  ... and ROW P ROW
P_REST       1  Q30  variance of a bias after two blocks of rest
P_KNOWN      1  Q30  variance of a bias that is known ...
P_VAGUE      1  Q30  ... and of one of which little is known
P_UP         1  Q30  variance of the bias about the vertical
P_SET        1  Q30  variance of a bias that was set with known_s = 1
Q_HEADING    1  Q30  variance that two blocks add to the heading ...
Q_SCALE      1  -    ... and for RATE: Q_SCALE / 2**Q_SCALE_SHIFT
Q_SCALE_SHIFT 1 -
Q_LEVEL      1  Q30  variance that two blocks add to a horizontal bias ...
Q_UP         1  Q30  ... and to a vertical one
Q_FAR        1  Q30  ... the same while the heading stays far off
GROW         1  Q20  heading that a unit of bias makes in two blocks
R_TILT       1  Q20  variance of a tilt correction as a bias
R_REST       1  Q20  variance of the gyro at rest
R_MAG        1  Q20  variance of a heading
FAR          1  -    blocks with the heading off by more than its doubt; the sign: to where
FAR_AFTER    1  -    blocks after which the vertical bias is taken to change
SHARE        1  Q15  how much of what the measurement says of the bias is believed
AXIS         1  -    of the gyro that was measured last, at rest
SIDE         1  -    which tilt correction comes next: 0 north, 1 west
CC           1  -    TURN to INNOVATION: CC / 2**10
C            2  Q31  TURN of the last levelling, north and west
HAVE         1  -    1: field and candidate are set; 2: reference, too; 4: the one before, too
F            2  Q13  smoothed field, counts, horizontal and vertical
FR           2  Q13  reference; F, FR, FO and FC stand together
FO           2  Q13  the reference before this one
FC           2  Q13  candidate
NEAR         1  -    blocks near the reference, no more than FIELD_AFTER
FOR          1  -    blocks for which the reference was seen while turning
FOR_MOST     1  -    most of it
FO_FOR       1  -    the same of the reference before
CAND         1  -    the same of the candidate
BACK         1  -    blocks near the reference before
BACK_AFTER   1  -    blocks
CAND_E       1  Q28  heading error in the candidate's field, rad
STILL_E      1  Q28  slow mean of the heading error at rest, rad
STILL_SET    1  -    1: it is set
STILL_K      1  Q15  its gain
STEADY       1  -    blocks with the field near to the reference, no more than STEADY_MOST
STEADY_MOST  1  -    blocks
OWN          1  -    1: the heading error is the attitude's own, not another field's
LOST         1  -    half blocks of such an error
RESTART_AFTER 1 -    half blocks
WEIGHT       1  -    1: the heading is taken up
TOL          1  Q15  tolerance squared
SAME         1  Q15  the same for a field that has not changed
SMOOTH       1  Q10  blocks of 0.05 s
REF          1  Q10  blocks of the reference's time constant
FIELD_AFTER  1  -    blocks
FIELD_FIRST  1  -    blocks
FIELD_NEW    1  -    blocks
NEED         1  -    blocks of 5 s
TURNING_MIN  1  -    squared turn rate, (4 counts)**2
GATE         1  Q28  heading error that is believed, beside the doubt, rad
GOOD         1  -    1: the field is the reference's, and its heading is believed
DOUBT        1  Q28  heading uncertainty, rad
GAP          1  -    steps since the last fresh sample
LAST         3  Q15  half angle of the step before, without correction, rad
"""

QUATERNION_KALMAN = """
AS           3  -    accelerometer counts, summed
STAGE        1  -    the next piece of the block's work, 0..8
PER          1  -    pieces in a step
T            9  Q15  R at the end of the block
H            3  Q20  the block's mean specific force in the earth frame, g
GM           3  -    GS of the block
ML           3  Q9   MS of the block
MLN          1  -    MN of the block
X            8  -    estimated errors, not applied yet; 10 bits finer than P's units
V            2  Q20  horizontal velocity, g * block
P           36  -    upper triangle of the covariance, row by row
N            9  -    attitude-bias part of P, mean of before and after the block
ROW          8  -    row of P of what is measured
M            8  -    gain of error i = M / 2**(E + 15), M of 28 to 31 bits
E            8  -
FOLDED       3  Q25  correction that the new block starts with, rad
UH           1  -    which error is measured ...
UE           1  -    ... its measured value, in X's units ...
UR           1  -    ... its variance / 16, in P's units ...
UM           1  -    ... bits of the errors that it must not correct
OVER         1  -    1: it was beyond 2.5 sigma
MEANT        2  -    tilt from the accelerometer as measured, X's units
HG           1  -    HS to H: HG / 2**HG_SHIFT
HG_SHIFT     1  -
C            1  -    C - 15; the bias is in units of 2**-C rad a block, B 10 bits finer
B_SHIFT      1  -    B to half angle per step, Q31
B_MOST       1  -    bound of B
QT           1  -    variance that a block adds to the attitude, 2**-16 of P's unit ...
QTR          1  -    ... and what is carried of it
QB           1  -    the same for the bias, 2**-12
QBR          1  -
QS           1  -    variance per (4 counts)**2 of the gyro: QS / 2**QS_SHIFT
QS_SHIFT     1  -
BS           1  -    first variance of the bias
RV           1  -    variances / 16: velocity ...
RM           1  -    ... heading from one block ...
RR           1  -    ... bias at rest ...
RA           1  -    ... accelerometer used as measured
V0           1  -    first variance of the velocity
AXIS         1  -    0..47; modulo 3: axis of the bias that is measured at rest
Z            3  -    low-passed gyro in B's units
REST_OFF     1  -    most that a known bias may be off, B's units
KNOWN        1  -    variance of a known bias
CB           1  -    counts (Q12) to B's units: CB / 2**CB_SHIFT
CB_SHIFT     1  -
WIDE_FOR     1  -    blocks with the accelerometer used as measured; then 2, 1, 0
WIDE_MOST    1  -
LOST         1  -    blocks with the velocity beyond 2.5 sigma
LOST_MOST    1  -
FIELD        2  Q13  smoothed field, counts; NOW, FIELD and REF as (horizontal, vertical)
REF          2  Q13  reference
HAVE         1  -    1: there is one
NEAR         1  -    blocks near the reference, no more than FIELD_AFTER
AGE          1  -    blocks with a field, no more than 16384
FAR          1  -    blocks of large heading error
FIELD_AFTER  1  -    blocks
TOL          1  Q14  tolerance squared
SMOOTH       1  Q10  blocks of 0.05 s
TAU          1  Q10  blocks of the reference's time constant
TAU_FAR      1  Q10  the same while the field is another
TAU_0        1  Q10  blocks of 0.2 s
FAR_MOST     1  -    blocks
GOOD         1  -    1: the field is that of the reference; 2: there is no reference yet
FIRST        1  -    blocks after which there is one
NOISE        1  -    variance / 16 of the heading
YOUNG        1  -    blocks until motion shows the bias
AFTER        1  -    the same at the start
WAIT         1  -    blocks of a rest that a known bias contradicts
CLIP         1  -    steps of the block with the gyro at full scale, no more than 100
RP           1  -    variance / 16: of a bias being 0
TIPPED       1  -    blocks of a rest in which the force is 1 g, but not along the vertical
"""


@dataclass(frozen=True)
class Word:
    name: str
    at: int
    length: int
    format: str
    meaning: str

    @property
    def line(self) -> str:
        """The constant, with what it is."""
        what = [str(self.length)] if self.length > 1 else []
        what += [self.format] if self.format != "-" else []
        text = ": ".join([", ".join(what)] * bool(what) + [self.meaning] * bool(self.meaning))
        return f"_{self.name} = const({self.at})" + (f"  # {text}" if text else "")


MAGNETOMETER = """
FRESH        1  -    measurements that were delivered
STALE        1  -    times that a measurement was overdue
SATURATED    1  -    measurements that were withheld, an axis being beyond its range
UNFLAGGED    1  -    measurements that were recognised by their data
STEP         1  -    what the look at a register is for
LEFT         1  -    samples until the next measurement is overdue
LIMIT        1  -    LEFT after a measurement
N            1  -    samples from one measurement to the next
WAS_READY    1  -    the status said so with the sample before
X            3  -    the newest measurement
NEXT         3  -    the one that is being unpacked
DUE          1  -    calls of read() after which a measurement may be through; 0 behind an IMU
AGE          1  -    calls of read() since the last one was started
WAITING      1  -    1: it has not come yet
LATE         1  -    calls of read() after which it is overdue
"""


def table(*parts: str) -> dict[str, Word]:
    """{name: word} of the tables one after the other."""
    words, at = {}, 0
    for row in "".join(parts).split("\n"):
        if row.strip():
            name, length, form, *meaning = row.split(maxsplit=3)
            if name in words:
                raise ValueError(f"two words are named {name}")
            words[name] = Word(name, at, int(length), form, "".join(meaning).strip())
            at += int(length)
    return words


def size(words: dict[str, Word]) -> int:
    """How many words the state has."""
    return sum(word.length for word in words.values())


STATES = {
    "mahony": table(MAHONY),
    "euler": table(EULER),
    "kalman": table(EULER, KALMAN),
    "inertial": table(EARTH, INERTIAL),
    "quaternion_kalman": table(EARTH, QUATERNION_KALMAN),
    "magnetometer": table(MAGNETOMETER),
}

# module: (its state, does its list say what the words are)
MODULES = {
    "attitude": ("mahony", False),
    "fixmath": ("mahony", True),
    "mahony": ("mahony", True),
    "mahony_kernels": ("mahony", True),
    "euler_kernels": ("euler", True),
    "complementary": ("euler", True),
    "kalman": ("kalman", True),
    "earth_kernels": ("inertial", True),
    "inertial_tilt": ("inertial", True),
    "inertial_field": ("inertial", True),
    "inertial_kalman": ("inertial", True),
    "inertial": ("inertial", False),
    "quaternion_kernels": ("quaternion_kalman", True),
    "quaternion_kalman": ("quaternion_kalman", False),
    "magnetometer": ("magnetometer", True),
}


def places(state: str) -> SimpleNamespace:
    """Where each word of a state stands, as attributes; `size`: how many words there are."""
    words = STATES[state]
    return SimpleNamespace(size=size(words), **{name: word.at for name, word in words.items()})


def written(text: str, module: str) -> str:
    """The module's text with the constants of the words that it uses, in order."""
    before, found, rest = text.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not found or not ended:
        raise ValueError(
            f"{module}.py has no place for its words: {BEGIN.strip()} ... {END.strip()}"
        )
    state, told = MODULES[module]
    words = STATES[state]
    used = set(re.findall(r"\b_[A-Z]\w*", before + after))
    lines = [word.line for word in words.values() if "_" + word.name in used]
    if "_WORDS" in used:
        lines.append(f"_WORDS = const({size(words)})")
    if not told:
        lines = [line.partition("  #")[0] for line in lines]
    return before + found + "".join(line + "\n" for line in lines) + ended + after


def unused() -> list[str]:
    """STATE.WORD of every word that no module of its state uses."""
    lines = []
    for name, words in STATES.items():
        modules = [module for module, (state, _) in MODULES.items() if state == name]
        if name == "quaternion_kalman":
            modules.append("earth_kernels")
        if name in ("euler", "kalman"):
            modules += ["euler_kernels", "complementary"]
        text = "".join((paths.PACKAGE / f"{module}.py").read_text("utf-8") for module in modules)
        lines += [f"{name}.{word}" for word in words if not re.search(rf"\b_{word}\b", text)]
    return lines


def main(arguments: list[str]) -> int:
    """Write what differs, or with --check only say so -> 1 when something differs."""
    stale = []
    for module in MODULES:
        path = paths.PACKAGE / f"{module}.py"
        text = path.read_text("utf-8")
        new = written(text, module)
        if new != text:
            stale.append(path.name)
            if "--check" not in arguments:
                path.write_text(new, "utf-8")
    print("words: " + (", ".join(stale) if stale else "all as in the tables"))
    return int(bool(stale) and "--check" in arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
