# What the two filters that average in the earth frame share: inertial.py and quaternion_kalman.py. The kernels of every
# step, of the magnetometer's heading and of rest; below them the class that both are. Needs attitude.py, fixmath.py and
# the viper emitter. The kernels allocate nothing, raise nothing, use no float, and give the same bits on every port.
#
# The kernels work on a filter's state, one array('i') that starts as fixmath.py's (probe, quaternion, half angle;
# `turn` needs no more). A block is 2**BLOCK steps of 22 to 44 ms together (up to 80 ms below 90 Hz): slow parts
# run once a block, each on a step of its own, so their constants do not depend on the sample rate. Bounds:
# docs/numerics.md.

from array import array

import micropython
from micropython import const

from upright import fixmath
from upright.attitude import Attitude, bias_of, hertz

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_Q = const(1)  # 4, Q29: quaternion w x y z, body to earth
_QR = const(5)  # 4, Q44: its rounding remainder, 0..32767
_WR = const(12)  # 3, Q46: its rounding remainder, 0..32767
_G = const(15)  # Q31: half angle per step of one gyro count
_GR = const(16)  # Q46: its last bits, 0..32767
_O = const(17)  # 3, Q31: minus the bias as a half angle per step
_OR = const(20)  # 3, Q46: its last bits, -32767..32767
_TURN = const(23)  # 3, Q31: correction that the next step takes up, earth frame, half angle
_R = const(26)  # 9, Q15: rotation matrix; its rows are north, west, up in the body
_FS = const(35)  # 3, Q9: specific force in the earth frame, counts, summed over the block
_ONE_G = const(38)  # Q9: counts of 1 g
_FULL_END = const(39)  # 1 + 2 axis + sign of the accelerometer at full scale, 0: none is
_FULL_STEPS = const(40)  # steps that it has been there, no more than FULL_MOST + 1
_FULL_MOST = const(41)  # for more steps no body is accelerated so much
_FULL_SUM = const(42)  # 3, Q3: specific force of these steps, less 1 g, in the earth frame
_LATER = const(45)  # 3, Q3: of earlier ones, to be added to FS where there is room
_LATER_ANY = const(48)  # not 0: some of it is left
_BASE = const(49)  # 3, Q8: gyro bias that was set, counts
_O_BASE = const(52)  # 3, Q31: O of BASE alone
_OR_BASE = const(55)  # 3, Q46: its last bits
_B = const(58)  # 3: learnt bias on top of BASE, in the filter's own unit
_NINE = const(61)  # 1: use the magnetometer
_BLOCK = const(62)  # log2 of the steps of a block
_BLOCK_MASK = const(63)  # steps of a block less 1
_PHASE = const(64)  # fresh steps of the block
_MS = const(69)  # 3, Q9: magnetometer in the earth frame, counts, summed over the block
_MN = const(72)  # samples in it
_SINCE = const(73)  # blocks since the last with a magnetometer sample, no more than 16
_J = const(74)  # blocks that the heading of this block stands for; 0: none
_HEADING = const(75)  # Q28: heading error, rad
_NOW = const(76)  # 2, Q13: horizontal and vertical field, counts
_IN = const(78)  # 6, Q12: what LOW1 takes up: accelerometer, gyro less BASE, counts
_LOW1 = const(84)  # 6, Q12: first low-pass of it
_LOW2 = const(90)  # 6, Q12: second
_AWAY = const(96)  # 2, Q6: squared distance from LOW2 of accelerometer and gyro, counts**2
_BLOCKS = const(98)  # of the low-passes' start
_STILL = const(99)  # blocks without motion, no more than REST_AFTER
_REST_AFTER = const(100)  # blocks
_REST_K = const(101)  # Q15: gain of the low-passes
_REST_GYRO = const(102)  # Q6: at rest AWAY is less: counts**2
_REST_ACCEL = const(103)  # Q6: the same of the accelerometer
# -- end of the words


MILLION = const(1000000)
_STEP_MAX = const((1 << 31) - (1 << 16))  # 1 rad in Q31, less what fixmath.turn adds for rounding

# atan(2**-i) in rad, Q28
# fmt: off
_ATAN = array("i", [
    210828714, 124459457, 65760959, 33381290, 16755422, 8385879, 4193963, 2097109, 1048571,
    524287, 262144, 131072, 65536, 32768, 16384, 8192, 4096, 2048, 1024, 512,
])
# fmt: on


# ------------------------------------------------------------------------------------------ every step
@micropython.viper
def believe_later(s: ptr32, north: int, west: int, up: int, end: int):
    """The specific force of a step, Q9, with an axis at full scale (`end`), or after such steps, into FS.

    A shake or a blow may reach full scale. To leave that out would tilt: the rest of the motion shows the opposite. But
    an axis that stays there is broken. So 1 g upward takes the place of these steps, and what they said is
    added when the axis has come back in time; no step has more than full scale.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    n = s[_FULL_STEPS]
    if end != s[_FULL_END]:
        # the one before is over
        i = 0
        while i < 3:
            if n <= s[_FULL_MOST]:
                h = (s[_LATER + i] << k >> k) + (s[_FULL_SUM + i] << k >> k)
                if h > 0x1FFFFFFF:
                    h = 0x1FFFFFFF
                elif h < -0x1FFFFFFF:
                    h = -0x1FFFFFFF
                s[_LATER + i] = h
            s[_FULL_SUM + i] = 0
            i += 1
        s[_FULL_END] = end
        n = 0
        s[_FULL_STEPS] = 0
    if end:
        if n <= s[_FULL_MOST]:
            s[_FULL_STEPS] = n + 1
            s[_FULL_SUM] = s[_FULL_SUM] + (north >> 6)
            s[_FULL_SUM + 1] = s[_FULL_SUM + 1] + (west >> 6)
            s[_FULL_SUM + 2] = s[_FULL_SUM + 2] + (up - s[_ONE_G] >> 6)
        north = 0
        west = 0
        up = s[_ONE_G]
    left = 0
    i = 0
    v = north
    while i < 3:
        room = v >> 6
        if room < 0:
            room = 0 - room
        room = 0x40000 - room
        if room < 0:
            room = 0
        h = s[_LATER + i] << k >> k
        r = h
        if r > room:
            r = room
        elif r < 0 - room:
            r = 0 - room
        s[_LATER + i] = h - r
        left |= h - r
        s[_FS + i] = s[_FS + i] + v + (r << 6)
        i += 1
        v = west
        if i == 2:
            v = up
    s[_LATER_ANY] = left


@micropython.viper
def to_earth(state, counts: ptr16):
    """R of Q; the specific force in the earth frame goes into the sum FS, a fresh magnetometer sample into MS, MN.

    The accelerometer is used as measured, neither normalised nor left out at full scale, so that swings cancel; but
    see believe_later(). A magnetometer sample is left out when all of it is zero or an axis is at full scale.
    """
    s = ptr32(state)
    k = 0
    if s[_PROBE] > 0:
        k = 32
    a = ((s[_Q] << k >> k) + 8192) >> 14
    b = ((s[_Q + 1] << k >> k) + 8192) >> 14
    c = ((s[_Q + 2] << k >> k) + 8192) >> 14
    d = ((s[_Q + 3] << k >> k) + 8192) >> 14
    x = ((counts[0] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((counts[1] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((counts[2] & 0xFFFF) ^ 0x8000) - 0x8000
    # north: 1 - 2 (c c + d d), 2 (b c - a d), 2 (b d + a c); FS += R accel
    m = 32768 - ((c * c + d * d + 8192) >> 14)
    n = (b * c - a * d + 8192) >> 14
    o = (b * d + a * c + 8192) >> 14
    s[_R] = m
    s[_R + 1] = n
    s[_R + 2] = o
    north = m * x + n * y + o * z + 32 >> 6
    # west
    m = (b * c + a * d + 8192) >> 14
    n = 32768 - ((b * b + d * d + 8192) >> 14)
    o = (c * d - a * b + 8192) >> 14
    s[_R + 3] = m
    s[_R + 4] = n
    s[_R + 5] = o
    west = m * x + n * y + o * z + 32 >> 6
    # up
    m = (b * d - a * c + 8192) >> 14
    n = (c * d + a * b + 8192) >> 14
    o = 32768 - ((b * b + c * c + 8192) >> 14)
    s[_R + 6] = m
    s[_R + 7] = n
    s[_R + 8] = o
    up = m * x + n * y + o * z + 32 >> 6
    end = 0
    if counts[10] & 4:
        # the axis that is farthest out
        end = 1
        a = x
        if x < 0:
            end = 2
            a = 0 - x
        if y > a or y < 0 - a:
            end = 3
            a = y
            if y < 0:
                end = 4
                a = 0 - y
        if z > a:
            end = 5
        elif z < 0 - a:
            end = 6
    if end | s[_FULL_END] | s[_LATER_ANY]:
        believe_later(state, north, west, up, end)  # a pointer would be boxed
    else:
        s[_FS] = s[_FS] + north
        s[_FS + 1] = s[_FS + 1] + west
        s[_FS + 2] = s[_FS + 2] + up
    if counts[10] & 2 == 0 or s[_NINE] == 0 or s[_MN] > 63:  # MS holds 64
        return
    # MS += R mag
    x = ((counts[6] & 0xFFFF) ^ 0x8000) - 0x8000
    y = ((counts[7] & 0xFFFF) ^ 0x8000) - 0x8000
    z = ((counts[8] & 0xFFFF) ^ 0x8000) - 0x8000
    if (x | y | z) == 0:
        return
    if x > 32766 or y > 32766 or z > 32766 or x < -32766 or y < -32766 or z < -32766:
        return
    s[_MN] += 1
    i = 0
    a = _R
    while i < 3:
        n = (s[a] << k >> k) * x + (s[a + 1] << k >> k) * y + (s[a + 2] << k >> k) * z
        s[_MS + i] = (s[_MS + i] << k >> k) + ((n + 32) >> 6)
        a += 3
        i += 1


# ------------------------------------------------------------------------------------------ once a block
@micropython.viper
def compass(s: ptr32, at: int, half_turn: int):
    """HEADING = atan2(-w, n), NOW = (hypot(n, w), up) of the block's mean field; J: how many blocks it stands for.

    at: where north, west and up are summed (counts, Q9), and of how many samples in the fourth word; all become 0.
    half_turn: pi in Q28, as the filter rounds it.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    n = s[at + 3]
    first = at  # MicroPython 1.26 and 1.27 shift an index that is one of the first three variables (docs/numerics.md)
    j = s[_SINCE] + 1
    if j > 16:
        j = 16
    s[_SINCE] = j
    s[_J] = 0
    if n == 0:
        return
    s[_J] = j
    s[_SINCE] = 0
    x = (s[first] << k >> k) // n << 4
    y = 0 - ((s[at + 1] << k >> k) // n << 4)
    s[_NOW + 1] = (s[at + 2] << k >> k) // n << 4
    s[first] = 0
    s[at + 1] = 0
    s[at + 2] = 0
    s[at + 3] = 0
    angle = 0
    if x < 0:
        angle = half_turn
        if y < 0:
            angle = 0 - angle
        x = 0 - x
        y = 0 - y
    t = y
    if t < 0:
        t = 0 - t
    if x + t == 0:
        s[_HEADING] = 0
        s[_NOW] = 0
        return
    shift = 0
    while x + t < 0x10000000:
        x <<= 1
        y <<= 1
        t <<= 1
        shift += 1
    # CORDIC, vectoring: each turn by +-atan(2**-i) brings (x, y) nearer to the x axis
    table = ptr32(_ATAN)
    i = 0
    while i < 20:
        t = y >> i
        if y > 0:
            y -= x >> i
            x += t
            angle += table[i]
        else:
            y += x >> i
            x -= t
            angle -= table[i]
        i += 1
    s[_HEADING] = angle
    # x is 1.64676 times the length
    t = x >> 15
    s[_NOW] = t * 19898 + ((x - (t << 15)) * 19898 >> 15) >> shift


@micropython.viper
def low_pass(s: ptr32, gyro: int):
    """LOW1 += k (IN - LOW1); LOW2 += k (LOW1 - LOW2); AWAY = |seen - LOW2|**2 of accelerometer and gyro.

    seen: IN, but its gyro stands from word `gyro` on; no difference counts with more than 2048 counts.
    """
    k = 0
    if s[_PROBE] > 0:
        k = 32
    gain = s[_REST_K]
    i = s[_BLOCKS] + 1
    if i * gain < 32768:
        s[_BLOCKS] = i
        gain = 32768 // i  # the mean of all, until the low-pass takes over
    total = 0
    at = _IN
    i = 0
    while i < 6:
        f = s[_LOW1 + i] << k >> k
        v = (s[_IN + i] << k >> k) - f
        h = v >> 15
        f += h * gain + ((v - (h << 15)) * gain + 16384 >> 15)
        s[_LOW1 + i] = f
        v = s[_LOW2 + i] << k >> k
        f -= v
        h = f >> 15
        v += h * gain + ((f - (h << 15)) * gain + 16384 >> 15)
        s[_LOW2 + i] = v
        v = ((s[at] << k >> k) - v) >> 9
        if v < 0:
            v = 0 - v
        if v > 16383:
            v = 16383
        total += v * v
        at += 1
        i += 1
        if i == 3:
            s[_AWAY] = total
            total = 0
            at = gyro
    s[_AWAY + 1] = total


# ----------------------------------------------------------------------------- set-up and main loop: allocates
class EarthFilter(Attitude):
    """Set-up and readings of both filters. A subclass adds:

    PARAMETERS             {name: (default, least, most)}, in s, rad, g, deg/s ...; taken to six significant digits
    start_at(q, known)     see Attitude; known: 1 the tilt, 2 tilt and heading are from a sample, 0: neither
    bounds(p)              the largest learnt bias in 1e-6 deg/s, and the part of 1 rad (Q31) that corrections use
    set_up(p, given)       the filter's own words; p: parameters in millionths; given: those that were given, as given
    bias_is_new(known_s)   a bias was set: drop the learnt one
    BLOCKS_HZ, LEAST_HZ    blocks a second, at most; the lowest rate
    bias_unit              (num, den): gyro counts of one unit of B
    """

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, words, parameters):
        """Check rate, scales and parameters, or raise; then call set_up(p, parameters), start level and without a bias.

        p: all parameters in millionths.
        """
        Attitude.__init__(self, rate, gyro_scale, accel_lsb_per_g, words)
        s = self.state
        s[_NINE] = int(self.AXES == 9)
        p = {}
        for name in self.PARAMETERS:
            default, least, most = self.PARAMETERS[name]
            value = parameters.get(name, default)
            p[name] = fixmath.quantise(value, name)
            if not fixmath.quantise(least, "") <= p[name] <= fixmath.quantise(most, ""):
                raise ValueError("%s is %r, expected %r..%r" % (name, value, least, most))
        for name in parameters:
            if name not in p:
                raise TypeError("no parameter %r; there are %s" % (name, ", ".join(sorted(p))))
        num, den = self.rate
        scale, per = self.gyro_scale
        shift = 2  # a block: at least 4 steps, and 1 / BLOCKS_HZ
        while num >= self.BLOCKS_HZ * den << shift:
            shift += 1
        text = hertz(self.rate)
        if num >= 1440 * den or num < self.LEAST_HZ * den:
            raise ValueError("rate is %s, expected %d..1439 Hz" % (text, self.LEAST_HZ))
        gain = fixmath.ratio(fixmath.PI_NUM * den * per << 46, fixmath.PI_DEN * 360 * num * scale)
        s[_G] = gain >> 15
        s[_GR] = gain & 32767
        s[_BLOCK] = shift
        s[_BLOCK_MASK] = (1 << shift) - 1
        s[_PHASE] = 1  # the first block is a whole one for the gyro's mean
        # |W| < 1 rad with every axis at full scale against a bias of 8192 counts and the largest corrections
        bias_most, room = self.bounds(p)
        counts_most = 32768 + 8192 + self.gyro_counts(bias_most, 1)
        turn_most = (gain * counts_most >> 15) * 17321 // 10000
        if turn_most + room > _STEP_MAX or gain < 1 << 17:
            raise ValueError(
                "rate is %s, expected %d..%d Hz at %d/%d LSB per deg/s: choose another rate or gyro range"
                % (
                    text,
                    max(self.LEAST_HZ, -(-turn_most * num // (den * (_STEP_MAX - room)))),
                    min(1439, (gain * num // den) >> 17),
                    scale,
                    per,
                )
            )
        s[_ONE_G] = accel_lsb_per_g << 9
        # until 10 m/s are reached from rest
        s[_FULL_MOST] = num * accel_lsb_per_g // (32100 * den)
        if self.gyro_counts(p["rest_gyro_dps"], 1) > 2000:
            raise ValueError("gyro_scale is %d/%d, too fine for rest_gyro_dps" % self.gyro_scale)
        t = den << shift
        s[_REST_K] = fixmath.ratio(t << 17, num + 4 * t)  # T / (1/4 + T), Q15
        s[_REST_AFTER] = max(1, self.blocks(p["rest_after"]))
        s[_REST_GYRO] = self.gyro_counts(p["rest_gyro_dps"], 8) ** 2
        s[_REST_ACCEL] = fixmath.ratio(p["rest_accel_g"] * 8 * accel_lsb_per_g, MILLION) ** 2
        self.set_up(p, parameters)
        num, den = self.bias_unit
        self._bias_scale = fixmath.scale(_B, num << 8, den)
        self.set_bias(0, 0, 0)
        self.start_at((fixmath.ONE, 0, 0, 0))

    def blocks(self, millionths, bits=0):
        """A time in us as blocks, Q(bits)."""
        num, den = self.rate
        return fixmath.ratio(millionths * num << bits, MILLION * den << self.state[_BLOCK])

    def gyro_counts(self, millionths, units):
        """A rate in 1e-6 deg/s as gyro counts, times units."""
        scale, per = self.gyro_scale
        return fixmath.ratio(millionths * units * scale, MILLION * per)

    def seed(self, counts):
        """Take roll and pitch from one accelerometer sample, heading from the magnetometer's where flags bit 1 is set.

        Without a magnetometer sample, or with one of its axes at full scale, yaw is 0 (order zyx). Returns True, or
        False when the accelerometer is shorter than 1/16 g: then the attitude is the identity. The learnt bias and
        field stay. Give update() the same sample next.
        """
        x, y, z = counts[0], counts[1], counts[2]
        if (x * x + y * y + z * z) << 8 < self.accel_lsb_per_g**2:
            self.start_at((fixmath.ONE, 0, 0, 0))
            return False
        i, j, k = counts[6], counts[7], counts[8]
        across = y * k != z * j or z * i != x * k or x * j != y * i
        full = (
            max(i, j, k) > 32766 or min(i, j, k) < -32766
        )  # an axis at full scale, as in to_earth
        if self.AXES == 9 and counts[10] & 2 and across and not full:
            self.start_at(fixmath.attitude_from_up_and_north((x, y, z), (i, j, k)), 2)
        else:
            self.start_at(fixmath.attitude_from_up(x, y, z), 1)
        return True

    def start_at(self, q):
        s = self.state
        for i in range(4):
            s[_Q + i] = q[i]
            s[_QR + i] = 16384
        for i in range(3):
            s[_WR + i] = 16384
            s[_TURN + i] = 0
            s[_MS + i] = 0
            s[_LATER + i] = s[_FULL_SUM + i] = 0
        s[_MN] = s[_SINCE] = s[_J] = s[_FULL_END] = s[_FULL_STEPS] = s[_LATER_ANY] = 0

    def set_bias(self, x, y, z, known_s=0):
        """Set the gyro's bias, ints in 1/256 of a gyro count; what the filter learns afterwards is added to it.

        known_s: how well it is known: the seconds of rest over which it was averaged, 0..3600; 0: unknown.

        Raises ValueError beyond +-8192 counts, and for an invalid known_s.
        """
        bias = bias_of(x, y, z, known_s)
        s = self.state
        gain = (s[_G] << 15) + s[_GR]
        for i in range(3):
            b = fixmath.ratio(bias[i] * gain, 256)
            change = (s[_BASE + i] - bias[i]) << 4
            s[_IN + 3 + i] += change
            s[_LOW1 + 3 + i] += change
            s[_LOW2 + 3 + i] += change
            s[_BASE + i] = bias[i]
            s[_O + i] = s[_O_BASE + i] = -(b >> 15)
            s[_OR + i] = s[_OR_BASE + i] = -(b & 32767)
            s[_B + i] = 0
        self.bias_is_new(known_s)

    def bias(self, out):
        """The gyro's bias, set and learnt, in 1/256 of a gyro count: out[0..2]. Allocates nothing."""
        s = self.state
        for i in range(3):
            out[i] = s[_BASE + i]
        fixmath.add_scaled(s, out, self._bias_scale)

    def bias_mdps(self, out):
        """The gyro's bias, set and learnt, in millidegrees/s: out[0..2]. It may allocate."""
        scale, per = self.gyro_scale
        num, den = self.bias_unit
        s = self.state
        for i in range(3):
            b = s[_BASE + i] * den + (s[_B + i] * num << 8)
            out[i] = fixmath.ratio(b * 1000 * per, 256 * den * scale)

    @property
    def resting(self):
        """True while the filter finds the body at rest: then the gyro's reading is its bias."""
        return self.state[_STILL] == self.state[_REST_AFTER]


def fine_mantissa(num, den, bits):
    """(m, s) with num/den = m / 2**s and m of so many bits; s may not be negative."""
    s = 0
    while num and fixmath.ratio(num << (s + 1), den) < 1 << bits:
        s += 1
    return fixmath.ratio(num << s, den), s
