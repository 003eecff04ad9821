# Mahony's attitude filter with a fixed step in 32-bit integers, for six and for nine axes: sensor counts in, quaternion
# out. Needs attitude.py, fixmath.py, mahony_kernels.py and the viper emitter. update() is made for a hard interrupt: it
# allocates nothing, raises nothing, uses no float, and gives the same bits on every port. docs/numerics.md has the
# bounds.

import micropython
from micropython import const

from upright import fixmath
from upright.attitude import Attitude, bias_of, hertz
from upright.fixmath import turn
from upright.mahony_kernels import MAG_LOW, STEPS_MAX, north, tilt

# -- words of the state: written by tools/upright_host/words.py
_PROBE = const(0)  # always -1: ptr32 zero-extends on 64-bit ports, see fixmath.py
_Q = const(1)  # 4, Q29: quaternion w x y z, body to earth
_QR = const(5)  # 4, Q44: its rounding remainder, 0..32767
_W = const(9)  # 3, Q31: half the angle of this step, rad
_WR = const(12)  # 3, Q46: its rounding remainder, 0..32767
_E = const(22)  # 3, Q29: the attitude error as a rotation vector in the body; see north
_LOW = const(25)  # least squared length / 4 of the accelerometer's counts that is used, 4..2**28
_I = const(26)  # 3: integral of the feedback, half angle per step, Q(31 + I_SHIFT)
_IR = const(29)  # 3: its remainder, KI_SHIFT bits
_B = const(32)  # 3, Q31: gyro bias, half angle per step
_BR = const(35)  # 3, Q46: its last bits, 0..32767
_O = const(38)  # 3, Q31: integral - bias, half angle per step
_OR = const(41)  # 3, Q46: its last bits, -32767..32767
_G = const(44)  # Q31: half angle per step of one gyro count
_GR = const(45)  # Q46: its last bits, 0..32767
_KP = const(46)  # 2 kp dt = KP / 2**(KP_SHIFT + 14): E (Q29) to half angle (Q31)
_KP_SHIFT = const(47)  # 0..16
_KI = const(48)  # ki dt**2 2**(I_SHIFT + 1) = KI / 2**(KI_SHIFT + 14)
_KI_SHIFT = const(49)  # 1..29
_I_SHIFT = const(50)  # 0..15
_I_MAX = const(51)  # bound of |I|, below 2**30
_MAG_MOST = const(52)  # a magnetometer sample stands for at most so many steps, 1..253; 0: six axes
_MAG_AGE = const(53)  # steps since one was used, 0..2**30 - 1
_WORDS = const(54)
# -- end of the words

_W_MAX = const((1 << 31) - (1 << 16))  # 1 rad in Q31, less what fixmath.turn adds for rounding
_LEAST_MANTISSA = const(64)  # a gain is held to better than 1 %
_NEVER = const(0x3FFFFFFF)
_MAG_LEAST_HZ = const(10)  # a slower magnetometer acts with less than its full weight
_SEED_SINE = const(32)  # no heading from a field within asin(1/32), 1.8 deg, of the vertical


class Mahony6(Attitude):
    """Attitude from gyro and accelerometer: Mahony's explicit complementary filter with PI feedback.

    R. Mahony, T. Hamel, J.-M. Pflimlin, Nonlinear Complementary Filters on the Special Orthogonal
    Group, IEEE TAC 53(5), 2008. Six axes: yaw is the integral of the gyro alone.

    rate              samples per second: int, or (num, den) for num/den Hz
    gyro_scale        (num, den): exact LSB per deg/s
    accel_lsb_per_g   int, 64..32767; below 1/16 g the accelerometer is not used
    kp                proportional gain, rad/s per unit of |accel x up|, the sine of the tilt error:
                      1/kp is the time constant of levelling in s
    ki                integral gain, rad/s**2 per unit; 0 switches the integral off
    bias_limit_dps    each axis of the integral stays within +- this, deg/s, 0..250

    kp, ki and bias_limit_dps are rounded to six significant digits. kp and ki are exact to 1e-4 of their value, or less
    if they are very small.

    The widespread C code with Kp, Ki and halfT: Kp = kp and halfT = dt / 2 = 1 / (2 * rate). Where
    it has `exInt += ex * Ki`, without the time, its Ki = ki * dt; where it has `ex * Ki * halfT`,
    its Ki = 2 * ki. That code puts a changed q0 into q1..q3 of the same step; this filter does not.

    Raises ValueError for a rate, scale or gain that the numbers cannot hold, with the range that
    they can. At 2000 deg/s full scale 50 Hz to 285 kHz hold with kp up to 20, at 250 deg/s 50 Hz to
    35 kHz.

    state: array('i'); state[QUATERNION] and the next three words are w x y z in Q29.
    """

    NAME = "mahony6"
    AXES = 6

    def __init__(self, rate, gyro_scale, accel_lsb_per_g, kp=0.5, ki=0.0, bias_limit_dps=20):
        Attitude.__init__(self, rate, gyro_scale, accel_lsb_per_g, _WORDS)
        self.bias_set = [0, 0, 0]  # 1/256 counts
        self.heading_seeded = False
        s = self.state
        self.start_at((fixmath.ONE, 0, 0, 0))
        s[_LOW] = accel_lsb_per_g * accel_lsb_per_g >> 10  # (1/16 g)**2 / 4
        s[_MAG_AGE] = _NEVER
        references = self.AXES // 3 - 1
        _set_gains(s, self.rate, self.gyro_scale, kp, ki, bias_limit_dps, references)

    # -- set-up and main loop
    def seed(self, counts):
        """Take roll and pitch from one accelerometer sample, yaw 0 (order zyx); any attitude will do.

        Returns True, or False when the sample is shorter than 1/16 g: then the attitude is the
        identity. The bias and the integral stay. Give update() the same sample next.
        """
        x, y, z = counts[0], counts[1], counts[2]
        if (x * x >> 2) + (y * y >> 2) + (z * z >> 2) < self.state[_LOW]:
            self.start_at((fixmath.ONE, 0, 0, 0))
            return False
        self.start_at(fixmath.attitude_from_up(x, y, z))
        return True

    def start_at(self, q):
        for i in range(4):
            self.state[_Q + i] = q[i]
            self.state[_QR + i] = 16384
        for i in range(3):
            self.state[_WR + i] = 16384

    def set_bias(self, x, y, z, known_s=0):
        """Set the gyro's bias, ints in 1/256 of a gyro count; it is subtracted from every sample.

        The integral of the feedback is kept apart from it (it is added to the rate) and starts
        again from 0; known_s, how well the bias is known, changes nothing here. Raises ValueError
        beyond +-8192 counts, and for an invalid known_s.
        """
        bias = bias_of(x, y, z, known_s)
        s = self.state
        gain = (s[_G] << 15) + s[_GR]
        for i in range(3):
            self.bias_set[i] = bias[i]
            b = fixmath.ratio(bias[i] * gain, 256)
            s[_B + i] = b >> 15
            s[_BR + i] = b & 32767
            s[_I + i] = s[_IR + i] = 0
            s[_O + i] = -s[_B + i]
            s[_OR + i] = -s[_BR + i]

    def bias_mdps(self, out):
        """The filter's gyro bias in millidegrees/s: the bias set less the integral.

        out: array('i') of 3 words. For the main loop: it may allocate.
        """
        integral = [0, 0, 0]
        self.integral_mdps(integral)
        Attitude.bias_mdps(self, out)
        for i in range(3):
            out[i] -= integral[i]

    def integral_mdps(self, out):
        """The integral of the feedback, which is added to the rate, in millidegrees/s: out[0..2].

        For the main loop: it may allocate.
        """
        s = self.state
        num, den = self.rate
        for i in range(3):
            out[i] = fixmath.ratio(
                s[_I + i] * 360000 * num * fixmath.PI_DEN,
                den * fixmath.PI_NUM << (31 + s[_I_SHIFT]),
            )

    # -- tick
    @micropython.viper
    def update(self, counts):
        """One step of 1/rate with the sample counts: array('h') of 11 words.

        The feedback is left out when flags (word 10) has bit 0 clear (no fresh sample: the last
        gyro words go on) or bit 2 set (accelerometer at full scale), and below 1/16 g; the integral
        then stands still and goes on being applied. The magnetometer, where there is one, does not
        depend on the accelerometer: it is used with the bits 0 and 1 set.
        """
        state = self.state
        tilt(state, counts)  # E
        # W = (gyro - bias + kp E + integral) dt/2, after the integral has taken up E. This is not a
        # kernel of its own: a call costs as much as a third of its work.
        s = ptr32(state)
        c = ptr16(counts)
        down = 0  # how much coarser than Q29 E is
        most = s[_MAG_MOST]
        if most:
            n = s[_MAG_AGE]
            if n < _NEVER:
                n += 1
            if c[10] & 3 == 3:
                if n < most:
                    most = n
                down = int(north(state, counts, most))
                if down < 0:
                    down = 0
                else:
                    n = 0
            s[_MAG_AGE] = n
        k = 0
        if s[_PROBE] > 0:
            k = 32
        gain = s[_KI]
        i = 0
        if gain:
            shift = s[_KI_SHIFT] - down
            i_shift = s[_I_SHIFT]
            i_max = s[_I_MAX]
            while i < 3:
                e = s[_E + i] << k >> k
                h = (e + 8192) >> 14
                a = h * gain + (((e - (h << 14)) * gain + 8192) >> 14) + (s[_IR + i] >> down)
                n = (s[_I + i] << k >> k) + (a >> shift)
                s[_IR + i] = (a - (a >> shift << shift)) << down
                if n > i_max:
                    n = i_max
                elif n < 0 - i_max:
                    n = 0 - i_max
                s[_I + i] = n
                a = n >> i_shift
                s[_O + i] = a - (s[_B + i] << k >> k)
                s[_OR + i] = ((n - (a << i_shift)) << 15 >> i_shift) - s[_BR + i]
                i += 1
        # three times the same: a loop with computed indices costs a third more
        gain = s[_KP]
        shift = s[_KP_SHIFT] - down
        g = s[_G]
        g_rest = s[_GR]
        e = s[_E] << k >> k
        h = (e + 8192) >> 14
        a = h * gain + (((e - (h << 14)) * gain + 8192) >> 14)
        h = a >> shift
        n = ((c[3] & 0xFFFF) ^ 0x8000) - 0x8000
        r = ((a - (h << shift)) << 15 >> shift) + n * g_rest + s[_WR] + (s[_OR] << k >> k)
        s[_WR] = r & 32767
        s[_W] = h + n * g + (s[_O] << k >> k) + (r >> 15)
        e = s[_E + 1] << k >> k
        h = (e + 8192) >> 14
        a = h * gain + (((e - (h << 14)) * gain + 8192) >> 14)
        h = a >> shift
        n = ((c[4] & 0xFFFF) ^ 0x8000) - 0x8000
        r = ((a - (h << shift)) << 15 >> shift) + n * g_rest + s[_WR + 1] + (s[_OR + 1] << k >> k)
        s[_WR + 1] = r & 32767
        s[_W + 1] = h + n * g + (s[_O + 1] << k >> k) + (r >> 15)
        e = s[_E + 2] << k >> k
        h = (e + 8192) >> 14
        a = h * gain + (((e - (h << 14)) * gain + 8192) >> 14)
        h = a >> shift
        n = ((c[5] & 0xFFFF) ^ 0x8000) - 0x8000
        r = ((a - (h << shift)) << 15 >> shift) + n * g_rest + s[_WR + 2] + (s[_OR + 2] << k >> k)
        s[_WR + 2] = r & 32767
        s[_W + 2] = h + n * g + (s[_O + 2] << k >> k) + (r >> 15)
        turn(state)


class Mahony9(Mahony6):
    """Mahony6 with a magnetometer (counts 6..8): yaw is the magnetic heading, x of the earth frame is north.

    rate, gyro_scale, accel_lsb_per_g, bias_limit_dps: as for Mahony6. kp and ki act on the sum of
    both errors, accel x up and mag x the field that the attitude makes of it (mahony_kernels.north). A
    heading error falls with the time constant 1 / (kp (1 - sin(dip))) in s: a steep field turns the
    attitude mostly about the horizontal, and the accelerometer undoes that.

    A magnetometer sample is used when flags (word 10) has bits 0 and 1 set, no word of it is at
    full scale of int16 and it is 16 counts or longer; at all other times this is Mahony6, bit for
    bit. The unit of its counts does not matter, their axes do: right-handed, as the
    accelerometer's. It may come more slowly than the steps: its error then acts with the number of
    steps since the one used last, so that the gain does not depend on its rate; but with no more
    than are in 1/10 s, than 253, than make kp n dt 1/2, and than the numbers hold.

    Raises ValueError like Mahony6; the ranges of kp are smaller where the gyro's own are large.

    heading_seeded  True when the last seed() took the heading from the magnetometer
    """

    NAME = "mahony9"
    AXES = 9

    update = Mahony6.update  # see attitude.py

    def seed(self, counts):
        """Mahony6.seed, with the heading from the magnetometer when flags (word 10) has bit 1 set.

        The heading is 0 if update() would not use the sample, or if the field is within 1.8 deg of the vertical: see
        `heading_seeded`. Returns True, or False when the accelerometer sample
        is shorter than 1/16 g: then the attitude is the identity.
        """
        self.heading_seeded = False
        if not Mahony6.seed(self, counts):
            return False
        up, field = tuple(counts[0:3]), tuple(counts[6:9])
        usable = counts[10] & 2 and -32768 < min(field) and max(field) < 32767
        length = _dot(field, field)
        if usable and sum([v * v >> 2 for v in field]) >= MAG_LOW:
            # |up x field|**2
            across = _dot(up, up) * length - _dot(up, field) ** 2
            if across * _SEED_SINE**2 >= _dot(up, up) * length:
                self.start_at(fixmath.attitude_from_up_and_north(up, field))
                self.state[_MAG_AGE] = 0
                self.heading_seeded = True
        return True

    @property
    def mag_age(self):
        """Steps since the magnetometer was used last; 0 when the last step did, 2**30 - 1 if none ever has."""
        return self.state[_MAG_AGE]


# ----------------------------------------------------------------------------- set-up: allocates
def _set_gains(s, rate, gyro_scale, kp, ki, bias_limit_dps, error_max=1):
    """Turn rate, scales and gains into the state's words, in integers throughout.

    error_max: the most that |E| can be, which is 1 for each reference vector; with a second one it
    is the least that is asked for, and sets how many steps a sample of that may stand for.
    Bounds: |W| < 1 rad with every axis of the gyro at full scale against a bias of 8192 counts, the
    error at its maximum and the integral at its limit; the gyro gain in 17 bits or more; 2 kp dt <
    1.
    """
    num, den = rate
    text = hertz(rate)
    # half angle per step of 1 deg/s: half_num / half_den rad
    half_num = fixmath.PI_NUM * den
    half_den = fixmath.PI_DEN * 360 * num
    gain = fixmath.ratio(half_num * gyro_scale[1] << 46, half_den * gyro_scale[0])
    limit = fixmath.quantise(bias_limit_dps, "bias_limit_dps")
    if limit > 250000000:
        raise ValueError("bias_limit_dps is %r, expected 0..250 deg/s" % (bias_limit_dps,))
    limit_q31 = fixmath.ratio(half_num * limit << 31, half_den * 1000000)

    least = ((gain * (32768 + 8192) >> 15) + limit_q31) * 17321 // 10000  # Q31 of a rad, root 3
    if least > _W_MAX or gain < 1 << 17:
        raise ValueError(
            "rate is %s, expected %d..%d Hz at %d/%d LSB per deg/s and a bias limit of %r deg/s: "
            "choose another rate or gyro range"
            % (
                text,
                -(-least * num // (den * _W_MAX)),
                (gain * num // den) >> 17,
                gyro_scale[0],
                gyro_scale[1],
                bias_limit_dps,
            )
        )

    kp_millionths = fixmath.quantise(kp, "kp")
    pair = fixmath.mantissa(2 * kp_millionths * den, num * 1000000, 14, 30)
    most = fixmath.ratio(kp_millionths * den * error_max << 31, num * 2000000) + least
    if kp and (not pair or pair[0] < _LEAST_MANTISSA or most > _W_MAX):
        # both bounds on kp in millionths: 2 kp dt < 1, and what is left of 1 rad
        high = 499960 * num // den
        high = min(high, (_W_MAX - least) * 2000000 * num // (den * error_max << 31))
        low = -(-_LEAST_MANTISSA * 500000 * num // (den << 30))
        raise ValueError(
            "kp is %r, expected 0 or %s..%s rad/s at a rate of %s: "
            "choose another gain or a higher rate" % (kp, _millionths(low), _millionths(high), text)
        )

    # as fine as the limit allows, but with room for a large ki below a small limit
    room = fixmath.ratio(half_num * max(limit, 20000000) << 31, half_den * 1000000) + 1
    shift = 15
    while shift and room << shift >= 1 << 30:
        shift -= 1
    i_max = fixmath.ratio(half_num * limit << (31 + shift), half_den * 1000000)
    ki_millionths = fixmath.quantise(ki, "ki")
    ki_pair = fixmath.mantissa(
        ki_millionths * den * den << (shift + 1), 1000000 * num * num, 15, 43
    )
    if ki and (not ki_pair or ki_pair[0] < _LEAST_MANTISSA):
        unit_num, unit_den = 1000000 * num * num, den * den << (shift + 1)
        low = max(1, -(-_LEAST_MANTISSA * unit_num // (unit_den << 43)))
        high = 16383 * unit_num // (unit_den << 15)
        raise ValueError(
            "ki is %r, expected 0 or %s..%s rad/s**2 at a rate of %s: "
            "choose another gain, or a higher rate for a larger one"
            % (ki, _millionths(low), _millionths(high), text)
        )

    s[_G] = gain >> 15
    s[_GR] = gain & 32767
    s[_KP] = pair[0]
    s[_KP_SHIFT] = pair[1] - 14
    s[_KI] = ki_pair[0]
    s[_KI_SHIFT] = ki_pair[1] - 14
    s[_I_SHIFT] = shift
    s[_I_MAX] = i_max
    s[_MAG_MOST] = 0
    if error_max > 1:
        # E is coarser by mahony_kernels.north's shift, and the gains' shifts are so much smaller meanwhile
        finest = min(s[_KP_SHIFT], s[_KI_SHIFT] - 1)
        steps = min((4 << finest) - 3, STEPS_MAX, -(-num // (_MAG_LEAST_HZ * den)))
        if s[_KP]:
            unit = 1 << (s[_KP_SHIFT] + 14)  # 2 kp dt = KP / unit
            steps = min(steps, unit // s[_KP], (_W_MAX - least) * unit // (s[_KP] << 29) - 1)
        s[_MAG_MOST] = max(steps, 1)


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _millionths(v):
    return "%d.%06d" % (v // 1000000, v % 1000000)
