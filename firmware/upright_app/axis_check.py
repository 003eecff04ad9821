# Finds the axis maps from samples: how the chips are mounted on a board, by gravity, by the gyro, and by the field,
# which stands still while the board turns. Used by doctor.py. Every port. It uses floats and allocates: not for the
# tick.

import math

from micropython import const

_DOMINANT = 0.85  # of 1 g on one axis: the tilt is less than 30 deg

_COUNTS_PER_UNIT = 100.0  # of the field, in the sums: keeps them near 1 (30 uT of an IST8310)
# An interval of the tumble is closed when the board has turned this far (rad): the field then changes by several
# times its noise, and a straight turn still describes it.
_TURN = 0.15
_TURN_MOST = 0.6
_TURN_MOST_S = 0.5
_TURNS_LEAST = const(60)
# Part of the field's changes that a map leaves unexplained: noise alone leaves up to 0.1, a wrong map about 1.
_SCORE_MOST = 0.35
_SECOND_LEAST = 2.0  # times the best
_DIP_LEAST = (
    0.25  # sine of the dip; nearer to the magnetic equator up and down cannot be distinguished
)


def parse(axes):
    """("x", "-y", ...) -> [(index, sign), ...]."""
    return [("xyz".index(a[-1]), -1 if a[0] == "-" else 1) for a in axes]


def names(axes):
    """[(index, sign), ...] -> ("x", "-y", ...)."""
    return tuple(("-" if sign < 0 else "") + "xyz"[index] for index, sign in axes)


def handedness(axes):
    """1: the map turns a right-handed frame into a right-handed one; -1: a left-handed one."""
    a, b, c = [index for index, _ in axes]
    swap = 1 if (a, b, c) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1
    return swap * axes[0][1] * axes[1][1] * axes[2][1]


def mapped(vector, axes):
    """A chip's vector in the body's frame; axes parsed."""
    return [sign * vector[index] for index, sign in axes]


def up_axis(accel, lsb_per_g):
    """The chip's axis that points up, from its mean acceleration in counts -> (index, sign), None: none does."""
    for i in range(3):
        if abs(accel[i]) > _DOMINANT * lsb_per_g:
            return i, 1 if accel[i] > 0 else -1
    return None


def imu_axes(level, nose_up, left_up):
    """The IMU's map, from the chip's axis (index, sign) that points up in each of three postures.

    Raises ValueError if these cannot be the three postures.
    """
    axes = [nose_up, left_up, level]
    if len({index for index, _ in axes}) < 3:
        raise ValueError("two postures had the same axis up")
    if handedness(axes) < 0:
        raise ValueError(
            "these postures need a left-handed chip: one of them was the opposite way up"
        )
    return names(axes)


# ------------------------------------------------------------------------------------------ the tumble


class Tumble:
    """Finds how a magnetometer is mounted beside a gyro. The field stands still in space, so in the body it turns
    against the gyro, dm/dt = -w x m, but only with the right map.

    A map and its opposite explain the rotation equally well. The vertical part of the field decides between them: it
    points down in the northern hemisphere. A hard-iron offset is solved for with each map.

    Memory is bounded: only sums over the intervals are kept.
    """

    def __init__(self, gyro_scale, accel_lsb_per_g, axes, bias=(0, 0, 0)):
        """axes: the IMU's map, as ("x", "y", "z"); bias: the gyro's, in counts of the chip's frame."""
        num, den = gyro_scale
        self._rad = den / num * math.pi / 180
        self._g = accel_lsb_per_g
        self._axes = parse(axes)
        self._bias = bias
        self._theta = [0.0] * 3
        self._elapsed = 0.0
        self._last = None
        self.n = 0  # intervals
        # Sums over the intervals: t the turn (body), d the field's change, m its mean (chip), a up (body).
        self._dd = 0.0
        self._tt = [0.0] * 9
        self._td = [0.0] * 9
        self._ttm = [0.0] * 27
        self._dtm = [0.0] * 27
        self._ttmm = [0.0] * 81
        self._m = [0.0] * 3
        self._mm = 0.0
        self._a = [0.0] * 3
        self._am = [0.0] * 9
        self._an = 0

    def add(self, counts, seconds):
        """One sample in the chips' frames; seconds since the one before. Bit 1 of its flags: a fresh field."""
        bias = self._bias
        rate = mapped([counts[3 + i] - bias[i] for i in range(3)], self._axes)
        for i in range(3):
            self._theta[i] += rate[i] * self._rad * seconds
        self._elapsed += seconds
        if not counts[10] & 2:
            return
        field = [counts[6 + i] / _COUNTS_PER_UNIT for i in range(3)]
        t = self._theta
        turn2 = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
        if self._last is not None and turn2 < _TURN * _TURN and self._elapsed < _TURN_MOST_S:
            return
        if (
            self._last is not None
            and _TURN * _TURN <= turn2 <= _TURN_MOST * _TURN_MOST
            and self._elapsed < _TURN_MOST_S
        ):
            # a turn by t changes the field by -2 tan(t / 2) (t / |t|) x its mean
            self._sum([x * (1 + turn2 / 12) for x in t], self._last, field)
            self._sum_up(mapped([counts[i] / self._g for i in range(3)], self._axes), field)
        self._last = field
        self._theta = [0.0] * 3
        self._elapsed = 0.0

    def _sum(self, t, before, after):
        d = [after[i] - before[i] for i in range(3)]
        m = [(after[i] + before[i]) / 2 for i in range(3)]
        self.n += 1
        for a in range(3):
            self._dd += d[a] * d[a]
            self._m[a] += m[a]
            self._mm += m[a] * m[a]
            for b in range(3):
                self._tt[3 * a + b] += t[a] * t[b]
                self._td[3 * a + b] += t[a] * d[b]
                for c in range(3):
                    self._ttm[9 * a + 3 * b + c] += t[a] * t[b] * m[c]
                    self._dtm[9 * a + 3 * b + c] += d[a] * t[b] * m[c]
                    for e in range(3):
                        self._ttmm[27 * a + 9 * b + 3 * c + e] += t[a] * t[b] * m[c] * m[e]

    def _sum_up(self, up, field):
        if abs(math.sqrt(up[0] * up[0] + up[1] * up[1] + up[2] * up[2]) - 1) > 0.2:
            return  # shaken: not gravity alone
        self._an += 1
        for i in range(3):
            self._a[i] += up[i]
            for j in range(3):
                self._am[3 * i + j] += up[i] * field[j]

    def _score(self, axes):
        """-> (part of the field's changes that this map leaves unexplained, offset (body) that serves it best)."""
        p = [index for index, _ in axes]
        s = [sign for _, sign in axes]
        tt, td, ttm, dtm, ttmm = self._tt, self._td, self._ttm, self._dtm, self._ttmm
        trace = tt[0] + tt[4] + tt[8]
        normal = [[(trace if a == b else 0.0) - tt[3 * a + b] for b in range(3)] for a in range(3)]
        # residual r = d + t x m - t x offset; its square without the offset, and the right side of the normal equations
        square = self._dd
        right = [0.0] * 3
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            # d . (t x m)
            square += 2 * s[a] * s[c] * dtm[9 * p[a] + 3 * b + p[c]]
            square -= 2 * s[a] * s[b] * dtm[9 * p[a] + 3 * c + p[b]]
            # - t x d
            right[a] -= s[c] * td[3 * b + p[c]] - s[b] * td[3 * c + p[b]]
            for e in range(3):
                # |t|^2 |m|^2 - (t . m)^2, and m |t|^2 - t (t . m)
                square += ttmm[27 * a + 9 * a + 3 * p[e] + p[e]]
                square -= s[a] * s[e] * ttmm[27 * a + 9 * e + 3 * p[a] + p[e]]
                right[a] += s[a] * ttm[9 * e + 3 * e + p[a]] - s[e] * ttm[9 * a + 3 * e + p[e]]
        offset = _solve(normal, right)
        if offset is None or not self._dd:
            return 1.0, None
        for a in range(3):
            square -= right[a] * offset[a]
        return square / self._dd, offset

    def result(self, south=False):
        """-> Verdict on all maps. south: in the southern magnetic hemisphere, where the field points up."""
        if self.n < _TURNS_LEAST:
            return Verdict("too little turning: %d of %d turns" % (self.n, _TURNS_LEAST))
        ranked = []
        for a in range(3):
            for b in range(3):
                for signs in range(4):
                    if a != b:
                        axes = [(a, 1), (b, 1 - (signs & 1) * 2), (3 - a - b, 1 - (signs & 2))]
                        score, offset = self._score(axes)
                        ranked.append((score, axes, offset))
        ranked.sort(key=_first)
        score, axes, offset = ranked[0]
        if offset is None:
            return Verdict("it turned about one axis only: turn it about all three")
        second = ranked[1][0]
        if score > _SCORE_MOST:
            return Verdict(
                "no map explains the field (best: %.2f): is something magnetic near?" % score
            )
        if second < _SECOND_LEAST * score:
            return Verdict(
                "several maps fit (%.2f, %.2f): turn it about all three axes" % (score, second)
            )
        chip_offset = [0.0] * 3
        for i in range(3):
            index, sign = axes[i]
            chip_offset[index] = sign * offset[i]
        square = self._mm / self.n
        for i in range(3):
            square += chip_offset[i] * (chip_offset[i] - 2 * self._m[i] / self.n)
        strength = math.sqrt(max(square, 1e-6))
        up = 0.0
        for i in range(3):
            index, sign = axes[i]
            up += sign * self._am[3 * i + index] - offset[i] * self._a[i]
        up /= strength * max(self._an, 1)
        if south:
            up = -up
        if up > 0:
            axes = [(index, -sign) for index, sign in axes]
            up = -up
        verdict = Verdict(None)
        verdict.axes = names(axes)
        verdict.score = score
        verdict.second = second
        verdict.offset = [x * _COUNTS_PER_UNIT for x in chip_offset]
        verdict.strength = strength * _COUNTS_PER_UNIT
        verdict.dip_deg = math.asin(min(1.0, -up)) * 180 / math.pi
        if -up < _DIP_LEAST:
            verdict.problem = (
                "the field is almost level here: %s or its opposite; look at the turn"
                % (verdict.axes,)
            )
        return verdict


class Verdict:
    """The result of a tumble.

    problem  None, or why the map is not certain
    axes     the magnetometer's map, None where none can be told; score, second: what it and the next best class of
             maps leave unexplained
    offset   hard iron, counts, chip's frame; strength: of the field, counts; dip_deg: how steeply it points into the
             ground
    """

    def __init__(self, problem):
        self.problem = problem
        self.axes = None
        self.score = self.second = 1.0
        self.offset = [0.0] * 3
        self.strength = 0.0
        self.dip_deg = 0.0


def _first(row):
    return row[0]


def _solve(m, right):
    """The 3x3 symmetric system by Cramer's rule; None where it is (nearly) singular."""

    def determinant(a, b, c):
        return (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            - a[1] * (b[0] * c[2] - b[2] * c[0])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        )

    whole = determinant(*m)
    if whole <= 1e-4 * (m[0][0] + m[1][1] + m[2][2]) ** 3 / 27:
        return None
    return [determinant(*[right if i == j else m[j] for j in range(3)]) / whole for i in range(3)]


def needle_turn(before, after, axes, offset):
    """Angle in deg by which the field turned about the body's z, from two fields in the chip's counts."""
    angle = []
    for field in (before, after):
        x, y, _ = mapped([field[i] - offset[i] for i in range(3)], parse(axes))
        angle.append(math.atan2(y, x) * 180 / math.pi)
    return (angle[1] - angle[0] + 180) % 360 - 180


def judge_turn(gyro_deg, needle_deg):
    """Compare gyro and field in the level quarter turn to the left -> list of problems."""
    problems = []
    if not 60 < abs(gyro_deg) < 120:
        problems.append("the gyro saw a turn by %d deg, not 90: turn once more" % gyro_deg)
    elif gyro_deg < 0:
        problems.append("the gyro saw a turn to the right: IMU_AXES is wrong, or it was one")
    if needle_deg is not None and abs((needle_deg + gyro_deg + 180) % 360 - 180) > 30:
        problems.append(
            "the board turned by %d deg, the field in it by %d, which should be the opposite"
            % (gyro_deg, needle_deg)
        )
    return problems
