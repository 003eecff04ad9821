# What the parts of the MPU6050 family are called, can be set to, and how their filters and rates go together.
# Tables and set-up arithmetic in integers. Needs nothing. Runs on MicroPython >= 1.22 and under CPython.
# RM is RM-MPU-6000A rev 4.2, RM-6500 RM-MPU-6500A rev 2.1.

# Temperature in hundredths of a degC as (raw * a + b / 2) // b + c
T_6050 = (5, 17, 3653)  # raw / 340 + 36.53, RM 4.18
_T_6500 = (10000, 33387, 2100)  # raw / 333.87 + 21, RM-6500 4.16, TEMP_OUT
_T_20689 = (1000, 3268, 2500)  # raw / 326.8 + 25, DS-000143

# WHO_AM_I: name, of the MPU6500 family, bytes of FIFO, temperature.
# The identity decides, not the print on the board: modules sold as "MPU6050" carry any of these.
PARTS = {
    0x68: ("MPU6050", False, 1024, T_6050),
    0x70: ("MPU6500", True, 512, _T_6500),
    0x71: ("MPU9250", True, 512, _T_6500),
    # a common clone of the MPU6050; None: what it is like shows after its reset, see of_unknown()
    0x72: ("MPU6050 clone (0x72)", None, 512, None),
    0x73: ("MPU9255", True, 512, _T_6500),
    0x74: ("MPU6515", True, 512, _T_6500),
    0x75: ("MPU6500 clone (0x75)", True, 512, _T_6500),
    0x78: ("MPU6880", True, 512, _T_6500),
    0x98: ("ICM-20689", True, 512, _T_20689),
}

MPU6000 = ("MPU6000", False, 1024, T_6050)  # an MPU6050 on SPI

# Parts that have nearly the registers of an MPU6500, but another FIFO and no auxiliary bus (MPU6886 and ICM-20602
# datasheets, register maps: FIFO_EN has other bits)
_ALIKE = {0x12: "ICM-20602", 0x19: "MPU6886"}
_OTHERS = {0x47: "ICM-42688-P"}

ACCEL_RANGES = (2, 4, 8, 16)  # g; RM 4.5, LSB per g RM 4.17
GYRO_RANGES = (250, 500, 1000, 2000)  # deg/s; RM 4.4
GYRO_SCALES = ((131, 1), (131, 2), (164, 5), (82, 5))  # LSB per deg/s, RM 4.19

# Bandwidth in Hz and delay in ms, rounded up, by DLPF_CFG (CONFIG) and A_DLPF_CFG (ACCEL_CONFIG2)
_BOTH_6050 = ((256, 1), (188, 2), (98, 3), (42, 5), (20, 9), (10, 14), (5, 19))  # gyro, RM 4.3
_ACCEL_6050 = ((260, 1), (184, 2), (94, 3), (44, 5), (21, 9), (10, 14), (5, 19))  # the same field
_GYRO_6500 = (  # RM-6500 4.5
    (250, 1),
    (184, 3),
    (92, 4),
    (41, 6),
    (20, 10),
    (10, 18),
    (5, 34),
    (3600, 1),
    (8800, 1),  # FCHOICE_B = 1
)
_ACCEL_6500 = (  # RM-6500 4.8
    (460, 2),
    (184, 6),
    (92, 8),
    (41, 12),
    (20, 20),
    (10, 36),
    (5, 67),
    (460, 2),
    (1130, 1),  # ACCEL_FCHOICE_B = 1
)
_CHOICES = (0, 1, 2, 3, 4, 5, 6)
_CHOICES_6500 = (0, 1, 2, 3, 4, 5, 6, 7, "bypass")
_BYPASS = 8

_NAMES = {
    0x19: "SMPLRT_DIV",
    0x1A: "CONFIG",
    0x1B: "GYRO_CONFIG",
    0x1C: "ACCEL_CONFIG",
    0x1D: "ACCEL_CONFIG2",
    0x23: "FIFO_EN",
    0x24: "I2C_MST_CTRL",
    0x34: "I2C_SLV4_CTRL",
    0x36: "I2C_MST_STATUS",
    0x37: "INT_PIN_CFG",
    0x38: "INT_ENABLE",
    0x3A: "INT_STATUS",
    0x67: "I2C_MST_DELAY_CTRL",
    0x68: "SIGNAL_PATH_RESET",
    0x6A: "USER_CTRL",
    0x6B: "PWR_MGMT_1",
    0x6C: "PWR_MGMT_2",
    0x75: "WHO_AM_I",
}


def name(register):
    """A register as messages show it: "CONFIG (0x1a)"."""
    if 0x25 <= register <= 0x30:
        n = register - 0x25
        known = "I2C_SLV{}_{}".format(n // 3, ("ADDR", "REG", "CTRL")[n % 3])
    else:
        known = _NAMES.get(register, "register")
    return f"{known} (0x{register:02x})"


def known():
    """Every WHO_AM_I of the table, for a message."""
    return ", ".join(f"0x{who:02x}" for who in sorted(PARTS))


def answers_nothing(who):
    """Whether a WHO_AM_I is what a bus reads that nobody drives, or that is held low."""
    return who in (0x00, 0xFF)


def unknown(who, family_6500=None):
    """A row for a part that is not in the table: taken for the smallest of the family."""
    return _ALIKE.get(who) or f"unknown (0x{who:02x})", family_6500, 512, None


def of_unknown(family_6500, asleep):
    """(of the MPU6500 family, temperature) of a part whose row leaves them open. Asleep after its reset, it is like an
    MPU6050 (RM 4.28; RM-6500 4.33: awake)."""
    if family_6500 is None:
        family_6500 = not asleep
    return family_6500, _T_6500 if family_6500 else T_6050


def stranger(who, where, what, hint):
    """What to tell of a part that is not in the table. where: "at 0x68"; what: "an MPU6050", of the driver; hint: of
    the bus."""
    reads = f"WHO_AM_I (0x75) reads 0x{who:02x} {where}"
    if answers_nothing(who):
        return (
            f"{reads}, which no part has: "
            + ("the data line is held low. " if who == 0 else "nobody drives the data line. ")
            + "Check the chip's supply (3.3 V), ground, and that the wires are short; then switch it off and on"
        )
    if who in _OTHERS:
        return f"{reads}: an {_OTHERS[who]}, which has other registers"
    if who in _ALIKE:
        return (
            f"{reads}: an {_ALIKE[who]}. accept_unknown=True uses it as one of the MPU6500 family, "
            'without FIFO and auxiliary bus: DRIVE = "timer" or "data_ready"'
        )
    return f"{reads}; known are {known()}. {hint}. accept_unknown=True uses it as {what}"


def index(what, value, allowed):
    """Place of value in allowed; raises ValueError, naming all."""
    for i in range(len(allowed)):
        if allowed[i] == value:
            return i
    choice = ", ".join(str(a) for a in allowed)
    raise ValueError(f"{what} {value!r} is not one of {choice}")


def ratio(rate):
    """(num, den) of a rate given as int Hz or as (num, den), reduced. Raises ValueError."""
    num, den = rate if isinstance(rate, (tuple, list)) else (rate, 1)
    if not isinstance(num, int) or not isinstance(den, int) or num <= 0 or den <= 0:
        raise ValueError(f"sample_rate_hz {rate!r} is neither a positive int nor (num, den)")
    a, b = num, den
    while b:
        a, b = b, a % b
    return num // a, den // a


def divider(base_hz, rate):
    """The whole divider of base_hz that comes nearest to rate, (num, den) Hz.

    Raises ValueError when none of 1..256 comes within 0.5 %. The chip's own clock is good to 1 %
    (PS-MPU-6000A rev 3.4, 7.15), so a smaller difference drowns in it, while a larger one would turn
    every angle by as much.
    """
    num, den = rate
    n = (2 * base_hz * den + num) // (2 * num)
    n = 1 if n < 1 else 256 if n > 256 else n
    if abs(base_hz * den - num * n) * 200 > num * n:
        n = base_hz * den // num
        lower = min(max(n + 1, 1), 256)
        upper = min(max(n, 1), 256)
        raise ValueError(
            f"sample_rate_hz {num}/{den} is not {base_hz} divided by 1 to 256; "
            f"next to it are {base_hz}/{lower} and {base_hz}/{upper}"
        )
    return n


class Filters:
    """The digital low-pass filters and the sample rate of one part, checked and as register values.

    own_accel         the part has ACCEL_CONFIG2, a filter of the accelerometer's own
    dlpf, accel_dlpf  as in Mpu.configure(); None: the widest of the gyro's that stays within half
                      the sample rate, and the accelerometer's that follows the gyro's
    rate              (num, den) Hz

    Afterwards dlpf and accel_dlpf say what was chosen, bandwidth_hz and accel_bandwidth_hz what that
    means, delay_ms the longer delay; config, fchoice_b, accel_config2 (None where there is no such
    register) and smplrt_div are bits of registers, sample_rate the exact rate. Raises ValueError.
    """

    def __init__(self, chip, family_6500, own_accel, dlpf, accel_dlpf, rate):
        choices = _CHOICES_6500 if family_6500 else _CHOICES
        gyro = _GYRO_6500 if family_6500 else _BOTH_6050
        accel = _ACCEL_6500 if family_6500 else _ACCEL_6050
        if dlpf is None:
            i = 0
            if rate[0] <= 1000 * rate[1]:
                i = 1
                while i < 6 and 2 * gyro[i][0] * rate[1] > rate[0]:
                    i += 1
        else:
            i = index("dlpf", dlpf, choices)
        j = i
        if accel_dlpf is not None:
            if not own_accel:
                raise ValueError(f"accel_dlpf: dlpf sets both filters of this {chip}")
            j = index("accel_dlpf", accel_dlpf, choices)
        base = 1000 if 0 < i < 7 else 32000 if i == _BYPASS else 8000
        if family_6500 and base > 1000 and rate != (base, 1):
            # RM-6500 4.4: SMPLRT_DIV works with FCHOICE_B = 0 and 0 < DLPF_CFG < 7 only
            raise ValueError(f"dlpf {choices[i]} of this {chip} runs at {base} Hz only")
        n = divider(base, rate)
        self.dlpf = choices[i]
        self.accel_dlpf = choices[j]
        self.bandwidth_hz = gyro[i][0]
        self.accel_bandwidth_hz = accel[j][0]
        self.delay_ms = max(gyro[i][1], accel[j][1])
        self.config = i & 7
        self.fchoice_b = i >> 3
        self.accel_config2 = j if own_accel else None  # ACCEL_FCHOICE_B is its bit 3
        self.smplrt_div = n - 1
        self.sample_rate = ratio((base, n))
