# Finds the magnetometer of a board by its identity: on the IMU's bus, in bypass behind it, or by its auxiliary master.
# Needs registers.py and magnetometer.py; of ak8963.py, hmc5883l.py, ist8310.py, qmc5883l.py the one that is there;
# auxiliary_bus.py where bypass does not reach. Runs on MicroPython >= 1.22 and under CPython.

from upright.magnetometer import hexadecimal
from upright.registers import I2CRegisters

# (chip, its addresses, register of the identity, identity), in the order in which they are looked for. An IST8310 can
# be at 0x0C and 0x0D; its register 0x0D (CNTL3) is never 0xFF.
CHIPS = (
    ("HMC5883L", (0x1E,), 0x0A, b"H43"),
    ("QMC5883L", (0x0D,), 0x0D, b"\xff"),
    ("AK8963", (0x0C,), 0x00, b"\x48"),
    ("IST8310", (0x0E, 0x0C, 0x0D, 0x0F), 0x00, b"\x10"),
)
NAMES = tuple([chip[0] for chip in CHIPS])


class MagnetometerNotFound(OSError):
    """No magnetometer, or another one than is wanted; it says what answers where."""


def find(imu, wanted="auto"):
    """The driver of the magnetometer beside a configured IMU, not configured yet.

    wanted  a name of NAMES, or "auto" for whichever is there

    On I2C the IMU's auxiliary bus is connected to its own (imu.set_bypass()), so that the magnetometer answers there.
    The bypass stays on if it is needed. On SPI, or where nothing answers in bypass, the auxiliary master looks for it.
    Where nothing answers at all, a chip that was named is taken to be behind the IMU: the tick finds it when it does.
    Raises MagnetometerNotFound, ValueError for a name that is none.
    """
    if wanted != "auto" and wanted not in NAMES:
        raise ValueError(f"magnetometer {wanted!r} is not one of auto, {', '.join(NAMES)}")
    others = []
    bus = getattr(imu.registers, "bus", None)
    if bus is not None:
        imu.set_bypass()
        found = _look(lambda address: I2CRegisters(bus, address), wanted, others)
        if found is not None:
            name, address = found
            imu.set_bypass(False)
            if not _is_there(I2CRegisters(bus, address), name):
                imu.set_bypass()
            return driver(name)(bus, address)
        imu.set_bypass(False)
    from upright.auxiliary_bus import AuxiliaryBus

    aux = AuxiliaryBus(imu)
    aux.begin()
    found = _look(aux.device, wanted, others)
    if found is not None:
        return driver(found[0])(aux, found[1])
    if wanted != "auto" and not others and bus is None:
        return driver(wanted)(aux)
    imu.set_user_ctrl(0, 0x20)  # I2C_MST_EN
    if wanted != "auto" and not others:
        imu.set_bypass()
        return driver(wanted)(bus)
    what = "magnetometer" if wanted == "auto" else wanted
    places = ", ".join(
        [
            "%s at %s" % (chip[0], " ".join([f"0x{address:02x}" for address in chip[1]]))
            for chip in CHIPS
        ]
    )
    seen = "; ".join(others) if others else "nothing answers there"
    raise MagnetometerNotFound(
        f"no {what} on the bus of the {imu.chip} or behind it. Looked for {places}: {seen}"
    )


def driver(name):
    """The class of a driver; imports its module."""
    if name == "HMC5883L":
        from upright.hmc5883l import HMC5883L as kind
    elif name == "QMC5883L":
        from upright.qmc5883l import QMC5883L as kind
    elif name == "AK8963":
        from upright.ak8963 import AK8963 as kind
    else:
        from upright.ist8310 import IST8310 as kind
    return kind


def _look(registers_at, wanted, others):
    """(name, address) of the first chip that is wanted; what else answers is added to others, in words."""
    taken = {}
    for name, addresses, register, right in CHIPS:
        for address in addresses:
            if address in taken:
                continue
            found = _read(registers_at(address), register, len(right))
            if found is None:
                continue
            if found == right:
                if wanted in ("auto", name):
                    return name, address
                taken[address] = f"{name} at 0x{address:02x}"
    for _, addresses, register, right in CHIPS:
        for address in addresses:
            if address not in taken:
                found = _read(registers_at(address), register, len(right))
                if found is not None:
                    taken[address] = (
                        f"0x{address:02x} answers register 0x{register:02x} with {hexadecimal(found)}, as none of them"
                    )
    for address in sorted(taken):
        if taken[address] not in others:
            others.append(taken[address])
    return None


def _is_there(registers, name):
    for chip, _, register, right in CHIPS:
        if chip == name:
            return _read(registers, register, len(right)) == right
    return False


def _read(registers, register, length):
    """The bytes, None where nothing answers."""
    found = bytearray(length)
    for _ in range(2):
        try:
            registers.read_into(register, found)
            return bytes(found)
        except OSError:
            pass
    return None
