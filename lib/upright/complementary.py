# The Euler-angle method with a fixed step in 32-bit integers: roll, pitch and yaw from the gyro, roll and pitch
# corrected by the accelerometer. Needs attitude.py, fixmath.py, euler_kernels.py and the viper emitter. update() is
# made for a hard interrupt: it allocates nothing, raises nothing, uses no float, and gives the same bits on every port.

from array import array

import micropython
from micropython import const

from upright import fixmath
from upright.attitude import Attitude, bias_of, hertz
from upright.euler_kernels import accel_angles, compose, direction, sines

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1, see fixmath.py
_A = const(5)  # 3: roll, pitch, yaw in the order zyx; pitch within +-2**28
_AR = const(8)  # 3: their last 15 bits, 0..32767
_X = const(11)  # 3: angles for sines(), any within +-2**30
_S = const(14)  # 3, Q29: their sines
_C = const(17)  # 3, Q29: their cosines
_Z = const(20)  # 2: roll and pitch that the accelerometer shows
_LOW = const(22)  # least squared length / 4 of the accelerometer's counts that is used
_D = const(23)  # 2: what roll and pitch turned by in the last step
_E = const(25)  # 2: roll and pitch error of this step: accelerometer less gyro
_K = const(27)  # the part of the error that is taken up: K / 2**(K_SHIFT + 14)
_K_SHIFT = const(28)  # 0..16
_G = const(29)  # angle per step of one gyro count
_GR = const(30)  # its last 15 bits, 0..32767
_WR = const(31)  # 3: rounding remainders of the gyro's angles, 15 bits
_B = const(34)  # 3: gyro bias that is set, angle per step
_BR = const(37)  # 3: its last 15 bits, 0..32767
_O = const(40)  # 3: what is added to the gyro: less the bias, set and learnt
_OR = const(43)  # 3: its last 15 bits, -65534..0
_WORDS = const(46)
# -- end of the words

_STEP_MAX = const((1 << 30) // 6)  # no axis turns by more than 60 deg in a step
_LEAST_MANTISSA = const(64)  # a gain is held to better than 1 %
_POLE_SHIFT = const(5)  # 1/cos(pitch) is 32 at most: within 1.8 deg of the pole yaw turns no faster


class Euler6(Attitude):
    """Attitude as three Euler angles (zyx), the way most people write their first filter.

    The gyro turns the angles by the kinematics of the order z, y, x, with u = q sin(roll) + r cos(roll):

        roll' = p + u tan(pitch)    pitch' = q cos(roll) - r sin(roll)    yaw' = u / cos(pitch)

    The accelerometer pulls roll to atan2(ay, az) and pitch to atan2(-ax, hypot(ay, az)), in each step by dt/tau of the
    difference. Yaw is the integral of the gyro only. The sines are those of the middle of the step, predicted from the
    last step: second order, with one set of sines.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767; below 1/16 g the accelerometer is not used
    tau               time constant of the accelerometer's correction in s; None: the gyro only. It is exact to 1e-4 of
                      its value, or less if it is very long. A gyro bias b leaves a tilt of b tau.

    The tutorials' `angle = a (angle + gyro dt) + (1 - a) accel` with a = 0.98 at 100 Hz is tau = dt / (1 - a) = 0.5 s,
    which takes every push for a tilt. On eight recorded trials with the bias taken off, the mean error (yaw aligned) is
    33 deg at 0.5 s, 13 at 2 s, 5.7 at 8 s and 3.5 at 32 s. Beyond the default, 8 s, little is gained: a remaining bias
    of 0.1 deg/s tilts by more than a degree, and a wrong start lasts minutes. 1 or 2 s suit slow motion and an unknown
    bias.

    At pitch = +-90 deg roll and yaw turn about the same axis, and their rates have no bound. Here 1/cos(pitch) ends
    at 32 and yaw turns by a quarter a step at most; beyond the pole the angles go on as roll + 180, 180 - pitch,
    yaw + 180. Nothing overflows, and roll and pitch recover within a few tau. Yaw may be wrong by any angle afterwards,
    because nothing corrects it. For attitudes near the pole use a quaternion filter.

    Raises ValueError for a rate, scale or tau that the numbers cannot hold, with the range that they can. At 2000 deg/s
    full scale 42 Hz to 90 kHz hold, at 250 deg/s 6 Hz to 11 kHz.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "euler6"
    AXES = 6

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, tau=8):
        self.prepare(rate, gyro_scale, accel_lsb_per_g, _WORDS)
        if tau is not None:
            self._set_tau(tau)

    def prepare(self, rate, gyro_scale, accel_lsb_per_g, words, bias_limit_dps=0):
        """Set up all but the gains, with room for a learnt bias up to the limit. Returns that limit in 2**-45 turn a
        step."""
        limit = fixmath.quantise(bias_limit_dps, "bias_limit_dps")
        if limit > 250000000:
            raise ValueError("bias_limit_dps is %r, expected 0..250 deg/s" % (bias_limit_dps,))
        Attitude.__init__(self, rate, gyro_scale, accel_lsb_per_g, words)
        self.bias_set = [0, 0, 0]  # 1/256 counts
        s = self.state
        s[_LOW] = accel_lsb_per_g * accel_lsb_per_g >> 10  # (1/16 g)**2 / 4
        num, den = self.rate
        scale_num, scale_den = self.gyro_scale
        gain = fixmath.ratio(scale_den * den << 45, 360 * scale_num * num)
        limit = fixmath.ratio(limit * den << 45, 360000000 * num)
        least = (gain * (32768 + 8192) + limit) >> 15
        if least > _STEP_MAX or gain < 1 << 16:
            raise ValueError(
                "rate is %s, expected %d..%d Hz at %d/%d LSB per deg/s and a bias limit of %r deg/s: "
                "choose another rate or gyro range"
                % (
                    hertz(self.rate),
                    -(-least * num // (den * _STEP_MAX)),
                    (gain * num // den) >> 16,
                    scale_num,
                    scale_den,
                    bias_limit_dps,
                )
            )
        s[_G] = gain >> 15
        s[_GR] = gain & 32767
        self._place(0, 0, 0)
        return limit

    def _set_tau(self, tau):
        num, den = self.rate
        millionths = fixmath.quantise(tau, "tau")
        pair = fixmath.mantissa(den * 1000000, num * millionths, 14, 30) if millionths else None
        if not pair or pair[0] < _LEAST_MANTISSA:
            low = -(-den * 1000000 * 16384 // (num * 16383))
            high = (den * 1000000 << 30) // (num * _LEAST_MANTISSA)
            raise ValueError(
                "tau is %r, expected None or %d.%06d..%d s at a rate of %s"
                % (
                    tau,
                    low // 1000000,
                    low % 1000000,
                    min(high // 1000000, 999999999),
                    hertz(self.rate),
                )
            )
        self.state[_K] = pair[0]
        self.state[_K_SHIFT] = pair[1] - 14

    # -- set-up and main loop
    def seed(self, counts):
        """Take roll and pitch from one accelerometer sample, yaw 0; any attitude will do.

        Returns True, or False when the sample is shorter than 1/16 g: then all angles are 0. The bias stays. Give
        update() the same sample next.
        """
        sample = array("h", [counts[0], counts[1], counts[2], 0, 0, 0, 0, 0, 0, 0, 1])
        if not accel_angles(self.state, sample):
            self._place(0, 0, 0)
            return False
        self._place(self.state[_Z], self.state[_Z + 1], 0)
        return True

    def start_at(self, q):
        """Closer than 2e-4 deg to pitch = +-90 deg roll becomes 0."""
        w, x, y, z = q
        up_x, up_y = 2 * (x * z - w * y), 2 * (y * z + w * x)
        up_z = w * w - x * x - y * y + z * z
        side = fixmath.isqrt(up_y * up_y + up_z * up_z)
        pitch = _direction(-up_x, side)
        if side >> 40:
            roll = _direction(up_y, up_z)
            yaw = _direction(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
        else:
            roll = 0
            yaw = _direction(2 * (w * z - x * y), w * w - x * x + y * y - z * z)
        self._place(roll, pitch, yaw)

    def _place(self, *angles):
        s = self.state
        for i in range(3):
            s[_A + i] = ((angles[i] + (1 << 29)) & 0x3FFFFFFF) - (1 << 29)
            s[_X + i] = s[_A + i] >> 1
            s[_AR + i] = s[_WR + i] = 16384
        for i in range(2):
            s[_D + i] = s[_E + i] = 0
        sines(s, 3)
        compose(s)

    def set_bias(self, x, y, z, known_s=0):
        """Set the gyro's bias, ints in 1/256 of a gyro count; it is subtracted from every sample.

        known_s, how well the bias is known, changes nothing here. Raises ValueError beyond +-8192 counts, and for an
        invalid known_s.
        """
        bias = bias_of(x, y, z, known_s)
        s = self.state
        gain = (s[_G] << 15) + s[_GR]
        for i in range(3):
            self.bias_set[i] = bias[i]
            b = fixmath.ratio(bias[i] * gain, 256)
            s[_B + i] = b >> 15
            s[_BR + i] = b & 32767
            s[_O + i] = -s[_B + i]
            s[_OR + i] = -s[_BR + i]

    # -- tick
    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        The accelerometer is left out when flags (word 10) has bit 0 clear (no fresh sample: the last gyro words go on)
        or bit 2 set (accelerometer at full scale), and below 1/16 g.
        """
        step(self.state, counts)


@micropython.viper
def step(state, counts) -> int:
    """One step of an Euler6 by its state -> 1 when the accelerometer was used: E is what it and the gyro differ by."""
    s = ptr32(state)
    c = ptr16(counts)
    k = 0
    if s[_PROBE] > 0:
        k = 32
    # the gyro's angles of this step, less the bias: p, q, r
    g = s[_G]
    h = s[_GR]
    n = ((c[3] & 0xFFFF) ^ 0x8000) - 0x8000
    t = n * h + s[_WR] + (s[_OR] << k >> k)
    s[_WR] = t & 32767
    p = n * g + (s[_O] << k >> k) + (t >> 15)
    n = ((c[4] & 0xFFFF) ^ 0x8000) - 0x8000
    t = n * h + s[_WR + 1] + (s[_OR + 1] << k >> k)
    s[_WR + 1] = t & 32767
    q = n * g + (s[_O + 1] << k >> k) + (t >> 15)
    n = ((c[5] & 0xFFFF) ^ 0x8000) - 0x8000
    t = n * h + s[_WR + 2] + (s[_OR + 2] << k >> k)
    s[_WR + 2] = t & 32767
    r = n * g + (s[_O + 2] << k >> k) + (t >> 15)
    # half-way
    roll = s[_A] << k >> k
    pitch = s[_A + 1] << k >> k
    yaw = s[_A + 2] << k >> k
    s[_X] = roll + ((s[_D] << k >> k) >> 1)
    s[_X + 1] = pitch + ((s[_D + 1] << k >> k) >> 1)
    sines(state, 2)
    # pitch: q cos - r sin; u, t: q sin + r cos and its last 15 bits
    g = (q + 8192) >> 14
    h = (r + 8192) >> 14
    q -= g << 14
    r -= h << 14
    n = s[_S] << k >> k
    sh = (n + 16384) >> 15
    sl = n - (sh << 15)
    n = s[_C] << k >> k
    ch = (n + 16384) >> 15
    cl = n - (ch << 15)
    t = g * cl - h * sl + ((q * ch - r * sh) << 1) + s[_AR + 1]
    s[_AR + 1] = t & 32767
    n = g * ch - h * sh + (t >> 15)
    pitch += n
    s[_D + 1] = n
    t = g * sl + h * cl + ((q * sh + r * ch) << 1)
    u = g * sh + h * ch + (t >> 15)
    t &= 32767
    # u / cos(pitch): the reciprocal of 2**shift cos from a division and Newton's step, Q29
    n = s[_C + 1] << k >> k
    if n < 0:  # half-way is beyond the pole
        n = 0 - n
        u = 0 - u
        t = 0 - t
    if n < 0x20000000 >> _POLE_SHIFT:
        n = 0x20000000 >> _POLE_SHIFT
    shift = 0
    while n < 0x10000000:
        n <<= 1
        shift += 1
    h = n >> 14
    g = 0x20000000 // h
    n = (g << 15) + (g * (0x20000000 - h * g - ((n & 16383) * g >> 14)) >> 14)
    ch = (n + 16384) >> 15
    cl = n - (ch << 15)
    h = (u + 8192) >> 14
    t = h * cl + ((u - (h << 14)) * ch << 1) + (t * ch >> 14)
    u = h * ch + (t >> 15)
    t &= 32767
    n = 0x10000000 >> shift  # a quarter turn
    if u > n:
        u = n
        t = 0
    elif u < 0 - n:
        u = 0 - n
        t = 0
    t <<= shift
    u = (u << shift) + (t >> 15)
    t &= 32767
    n = t + s[_AR + 2]
    s[_AR + 2] = n & 32767
    yaw += u + (n >> 15)
    # roll: p + sin(pitch) u / cos(pitch)
    n = s[_S + 1] << k >> k
    sh = (n + 16384) >> 15
    sl = n - (sh << 15)
    h = (u + 8192) >> 14
    t = h * sl + ((u - (h << 14)) * sh << 1) + (t * sh >> 14) + s[_AR]
    s[_AR] = t & 32767
    n = p + h * sh + (t >> 15)
    roll += n
    s[_D] = n
    # over the pole
    if pitch > 0x10000000 or pitch < 0 - 0x10000000:
        if pitch > 0:
            pitch = 0x20000000 - pitch
        else:
            pitch = 0 - 0x20000000 - pitch
        roll += 0x20000000
        yaw += 0x20000000
        s[_D + 1] = 0 - (s[_D + 1] << k >> k)
    roll = ((roll + 0x20000000) & 0x3FFFFFFF) - 0x20000000
    used = int(accel_angles(state, counts))
    if used:
        g = s[_K]
        shift = s[_K_SHIFT]
        n = (s[_Z] << k >> k) - roll
        n = ((n + 0x20000000) & 0x3FFFFFFF) - 0x20000000
        s[_E] = n
        h = (n + 8192) >> 14
        n = h * g + (((n - (h << 14)) * g + 8192) >> 14)
        h = n >> shift
        t = ((n - (h << shift)) << 15 >> shift) + s[_AR]
        s[_AR] = t & 32767
        roll += h + (t >> 15)
        roll = ((roll + 0x20000000) & 0x3FFFFFFF) - 0x20000000
        n = (s[_Z + 1] << k >> k) - pitch
        s[_E + 1] = n
        h = (n + 8192) >> 14
        n = h * g + (((n - (h << 14)) * g + 8192) >> 14)
        h = n >> shift
        t = ((n - (h << shift)) << 15 >> shift) + s[_AR + 1]
        s[_AR + 1] = t & 32767
        pitch += h + (t >> 15)
    yaw = ((yaw + 0x20000000) & 0x3FFFFFFF) - 0x20000000
    s[_A] = roll
    s[_A + 1] = pitch
    s[_A + 2] = yaw
    s[_X] = roll >> 1
    s[_X + 1] = pitch >> 1
    s[_X + 2] = yaw >> 1
    sines(state, 3)
    compose(state)
    return used


# ----------------------------------------------------------------------------- set-up: allocates
def _direction(y, x):
    """euler_kernels.direction of ints of any size."""
    most = max(abs(y), abs(x))
    return direction(fixmath.ratio(y << 28, most), fixmath.ratio(x << 28, most)) if most else 0
