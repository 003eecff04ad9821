# The auxiliary I2C bus of an MPU6050 or MPU6500: the chip's own master, on its pins AUX_CL and AUX_DA.
# Needs registers.py; the configured driver of the chip is passed in. Runs on MicroPython >= 1.22
# and under CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2; RM-MPU-6500A has the same master.

import time

import micropython
from micropython import const

from upright.registers import Registers, plain_name

# What transact() returns in place of a byte
AUX_BUSY = const(-1)
AUX_NACK = const(-2)  # no acknowledge
AUX_TIMEOUT = const(-3)  # not carried out: the IMU asleep or reset, or the bus held low

_I2C_MST_CTRL = const(0x24)
_SLV0_ADDR = const(0x25)  # ADDR, REG, CTRL of slot 0, then of slots 1 to 3
_SLV0_CTRL = const(0x27)
_SLV4_ADDR = const(0x31)  # then SLV4_REG and SLV4_DO
_SLV4_CTRL = const(0x34)
_SLV4_DI = const(0x35)
_I2C_MST_STATUS = const(0x36)
_SLV0_DO = const(0x63)
_I2C_MST_DELAY_CTRL = const(0x67)

_READ = const(0x80)  # ADDR
_ENABLE = const(0x80)  # CTRL
_CLOCK_400_KHZ = const(13)  # RM 4.7
_P_NSR = const(0x10)  # I2C_MST_CTRL: a stop between one slot's read and the next one's
_DELAY_ES_SHADOW = const(0x80)  # I2C_MST_DELAY_CTRL; bits 6 and 5 are reserved
_DELAY_BITS = const(0x9F)
_DELAY = const(0x1F)  # SLV4_CTRL[4:0] is I2C_MST_DLY, shared by all slots
_I2C_MST_EN = const(0x20)  # USER_CTRL
_SLV4_DONE = const(0x40)  # I2C_MST_STATUS
_LOST_ARB = const(0x20)
_SLV4_NACK = const(0x10)
_FAULTS = const(0x3F)

_SLOTS = const(4)
_EXT_BYTES = const(24)
_LONGEST = const(15)
_SLV4_BITS = const(39)  # clocks of the longest transaction of slot 4, a read of one byte
_CALLS = const(16)  # calls of transact() that a transaction may take
_COUNT_MASK = const(0x3FFFFFFF)

# State of the transaction: what transact() does next. The first three write SLV4_ADDR, SLV4_REG, SLV4_DO.
_NOTHING = const(0)
_ADDR = const(1)
_REG = const(2)
_DO = const(3)
_CLEAR = const(4)  # clear I2C_MST_STATUS of an earlier transaction
_CTRL = const(5)
_WAIT = const(6)


class AuxiliaryError(OSError):
    """The auxiliary bus at set-up."""


class AuxiliaryNack(AuxiliaryError):
    """No acknowledge of the address or the byte."""


class AuxiliaryTimeout(AuxiliaryError):
    """The master did not carry the transaction out."""


class AuxiliaryBus:
    """The auxiliary master of `imu`, a configured MPU6050 or MPU6500.

    Slots 0 to 3 repeat with the samples; what they read is in EXT_SENS_DATA. Slot 4 (SLV4) transfers one byte once.
    Call begin() first, and again after each imu.configure().

        aux = AuxiliaryBus(imu)
        aux.begin()
        mag = aux.device(0x0E)
        mag.write_register(0x41, 0x24)
        at = aux.periodic_read(0x0E, 0x02, 7)
        aux.start()

    faults collects the bits of I2C_MST_STATUS, which the chip clears when they are read: NACK of slots 0 to 3 in bits 0
    to 3, of SLV4 in bit 4, arbitration lost in bit 5. Set faults to 0 after reading it.

    Slots and I2C_MST_DLY are rows of imu's register table: after a reset of the chip imu.health()
    brings them back.
    """

    def __init__(self, imu):
        self.imu = imu
        self.faults = 0
        self._byte = bytearray(1)
        self._slots = []  # (address, register, length, value or None, delayed)
        self._used = 0  # slots that have rows in imu's table
        self._every = 1
        self._delay = 0  # I2C_MST_DLY
        self._step = _NOTHING
        self._words = bytearray(3)  # of the transaction: for SLV4_ADDR, SLV4_REG, SLV4_DO
        self._known = -1  # contents of SLV4_ADDR; -1: unknown, and I2C_MST_STATUS must be cleared
        self._left = 0
        self._imu_resets = 0

    # Set-up: may wait, allocate and raise

    @property
    def running(self):
        """True after begin(), until imu.configure()."""
        return self.imu.master_enabled

    def begin(self):
        """Switch the master on: 400 kHz, no slot in use. A running master goes on, without its slots.

        Not WAIT_FOR_ES: it would hold back the IMU's own data-ready for a dead magnetometer.
        DELAY_ES_SHADOW: all bytes of one sample appear in EXT_SENS_DATA together.
        """
        if self.imu.bypass:
            self.imu.set_bypass(False)
        # a running master may be in the middle of a transfer: only its slots are switched off
        running = self.running
        rows = [] if running else [(_I2C_MST_CTRL, _P_NSR | _CLOCK_400_KHZ, 0xFF)]
        if running:
            rows += [(_SLV0_CTRL + 3 * n, 0, 0xFF) for n in range(self._used)]
        rows += [(_I2C_MST_DELAY_CTRL, _DELAY_ES_SHADOW, _DELAY_BITS), (_SLV4_CTRL, 0, _DELAY)]
        self._disable()
        self._slots = []
        self._every = 1
        self._delay = 0
        self._step = _NOTHING
        self._known = -1
        self.imu.set_rows(rows)
        if not running:
            self._used = 0
            self.imu.set_user_ctrl(_I2C_MST_EN, _I2C_MST_EN)

    def device(self, address, error_class=AuxiliaryError, name=plain_name):
        """The registers of the device at `address`, an AuxiliaryDevice."""
        return AuxiliaryDevice(self, address, error_class, name)

    def periodic_read(self, address, register, length, every=1):
        """Read 1 to 15 bytes with every sample, or every 2nd to 32nd; returns their place.

        The place counts from EXT_SENS_DATA_00, where the slots' bytes follow each other. It takes effect with start().
        Raises ValueError when slots or bytes are used up, or for a second value of `every`: all slots share one
        divider.
        """
        if not 1 <= length <= _LONGEST:
            raise ValueError(f"length {length!r} is not 1 to {_LONGEST}")
        at = sum(slot[2] for slot in self._slots if slot[3] is None)
        if at + length > _EXT_BYTES:
            raise ValueError(f"{at} + {length} bytes are more than EXT_SENS_DATA's {_EXT_BYTES}")
        self._add(address | _READ, register, length, None, every)
        return at

    def periodic_write(self, address, register, value, every=1):
        """Write the same byte with every sample, or every 2nd to 32nd. As periodic_read()."""
        self._add(address, register, 1, value, every)

    def start(self):
        """Program the slots while all are disabled, then enable them.

        The chip assigns EXT_SENS_DATA anew only when all slots are disabled (RM 4.20). Raises ValueError when the
        transactions take longer than a sample (RM 4.8).
        """
        self._need_begun()
        num, den = self.imu.sample_rate
        clocks = _SLV4_BITS
        rows = []
        enable = []
        delays = _DELAY_ES_SHADOW
        for n, (address, register, length, value, delayed) in enumerate(self._slots):
            rows.append((_SLV0_ADDR + 3 * n, address, 0xFF))
            rows.append((_SLV0_ADDR + 3 * n + 1, register, 0xFF))
            if value is None:
                clocks += 30 + 9 * length
            else:
                clocks += 29
                rows.append((_SLV0_DO + n, value, 0xFF))
            if delayed:
                delays |= 1 << n
            enable.append((_SLV0_CTRL + 3 * n, _ENABLE | length, 0xFF))
        if clocks * 5 * num > 2_000_000 * den:  # 2.5 us each
            raise ValueError(
                f"the slots take {clocks * 5 // 2} us of each sample, and "
                f"{num}/{den} Hz leaves {1_000_000 * den // num}"
            )
        self._disable()
        self._delay = self._every - 1
        rows.append((_I2C_MST_DELAY_CTRL, delays, _DELAY_BITS))
        rows.append((_SLV4_CTRL, self._delay, _DELAY))
        self._used = len(self._slots)
        self.imu.set_rows(rows + enable)

    def _disable(self):
        for n in range(_SLOTS):
            self.imu.write_register(_SLV0_CTRL + 3 * n, 0)

    def _add(self, address, register, length, value, every):
        if len(self._slots) == _SLOTS:
            raise ValueError(f"all {_SLOTS} slots are in use")
        if not 1 <= every <= 32:
            raise ValueError(f"every {every!r} is not 1 to 32")
        if every > 1:
            if self._every not in (1, every):
                raise ValueError(
                    f"every {every!r}: another slot runs every {self._every}, and I2C_MST_DLY is shared"
                )
            self._every = every
        self._slots.append((address, register, length, value, every > 1))

    def _need_begun(self):
        if not self.running:
            raise AuxiliaryError("auxiliary bus: begin() first")

    def transfer(self, address, register, data):
        """Call transact() until it is done, up to a sample. Raises AuxiliaryNack and AuxiliaryTimeout."""
        self._need_begun()
        num, den = self.imu.sample_rate
        most = 5000 + 3_000_000 * den // num  # SLV4 has its turn once a sample
        earlier, self.faults = self.faults, 0
        self._step = _NOTHING
        start = time.ticks_us()
        while True:
            late = time.ticks_diff(time.ticks_us(), start) > most
            outcome = self.transact(address, register, data)
            if outcome != AUX_BUSY:
                break
            if self._step != _WAIT:  # not started yet: if the IMU does not answer, it has 16 calls
                start = time.ticks_us()
                continue
            self._left = 0 if late else _CALLS  # 0: the next call gives up
            time.sleep_us(50)
        lost = self.faults & _LOST_ARB
        self.faults |= earlier
        if outcome >= 0:
            return outcome
        verb = "a read of" if address & _READ else "a write to"
        what = f"{verb} register 0x{register:02x} of 0x{address & 0x7F:02x}"
        if outcome == AUX_NACK:
            raise AuxiliaryNack(f"auxiliary bus: no acknowledge to {what}")
        if lost:
            raise AuxiliaryTimeout(f"auxiliary bus: {what} failed: something else holds AUX_DA low")
        raise AuxiliaryTimeout(
            f"auxiliary bus: {what} not done in {most // 1000} ms; is the IMU awake, does it answer, are "
            "AUX_CL and AUX_DA high?"
        )

    # The tick: nothing below allocates, waits, raises or uses a float.

    @micropython.native
    def transact(self, address, register, data):
        """Write data to a register of a device or, with bit 7 of address set, read one (data is then 0).

        Call it with the same arguments until it no longer returns AUX_BUSY. Then it returns the byte that was read, 0
        for a write, or an AUX_ state. A call accesses at most two registers of the IMU. A read takes 2 or 3 calls, a
        write 3, if there is a sample between two calls. After 16 calls it gives up.
        """
        words = self._words
        step = self._step
        if step == _NOTHING or words[0] != address or words[1] != register or words[2] != data:
            if step == _WAIT:
                self._known = -1  # the transaction before was not completed
            words[0] = address
            words[1] = register
            words[2] = data
            self._left = _CALLS
            self._step = _REG if self._known == address else _ADDR
        resets = self.imu.resets
        if resets != self._imu_resets:
            self._imu_resets = resets
            self._known = -1
            self._step = _ADDR  # the chip has lost it
        self._left -= 1
        if self._left < 0:
            self._step = _NOTHING
            self._known = -1
            self._write(_SLV4_CTRL, self._delay)
            return AUX_TIMEOUT
        if self._step == _WAIT:
            return self._look()
        self._advance()
        if self._step != _WAIT:
            self._advance()
        return AUX_BUSY

    @micropython.native
    def _advance(self):
        """Write one register of SLV4, in the order that the chip needs; after a fault once more."""
        step = self._step
        if step == _CTRL:
            if self._write(
                _SLV4_CTRL, _ENABLE | self._delay
            ):  # EN and the delay share this register
                self._step = _WAIT
        elif step == _CLEAR:
            if self._read(_I2C_MST_STATUS):
                self.faults |= self._byte[0] & _FAULTS
                self._known = self._words[0]
                self._step = _CTRL
        elif self._write(_SLV4_ADDR - _ADDR + step, self._words[step - _ADDR]):
            reading = self._words[0] & _READ
            if step == _ADDR:
                if self._known >= 0:
                    self._known = self._words[0]
                self._step = _REG
            elif step == _REG and not reading:
                self._step = _DO
            else:
                self._step = _CLEAR if self._known < 0 else _CTRL

    @micropython.native
    def _look(self):
        """Is it done?"""
        if not self._read(_I2C_MST_STATUS):
            return AUX_BUSY
        status = self._byte[0]
        self.faults |= status & _FAULTS
        if status & (_SLV4_NACK | _LOST_ARB):
            self._step = _NOTHING
            if not status & _SLV4_DONE:
                self._write(_SLV4_CTRL, self._delay)
            return AUX_NACK if status & _SLV4_NACK else AUX_TIMEOUT
        if not status & _SLV4_DONE:
            return AUX_BUSY
        if self._words[0] & _READ and not self._read(_SLV4_DI):
            return AUX_BUSY
        self._step = _NOTHING
        return self._byte[0] if self._words[0] & _READ else 0

    @micropython.native
    def _read(self, register):
        try:
            self.imu.registers.read_into(register, self._byte)
            return 1
        except OSError:
            return self._fault()

    @micropython.native
    def _write(self, register, value):
        try:
            self.imu.registers.write(register, value)
            return 1
        except OSError:
            return self._fault()

    def _fault(self):
        self._known = -1
        self.imu.bus_fault()
        return 0


class AuxiliaryDevice(Registers):
    """One device on the auxiliary bus. For set-up it has the methods of registers.py, a byte at a time, each within a
    sample; for the tick it has transact(). errors counts the transactions after which some device on the bus had not
    acknowledged."""

    own_bus = False  # its measurements come with the IMU's samples

    def __init__(self, bus, address, error_class, name):
        Registers.__init__(self, error_class, name)
        self.address = address
        self.errors = 0
        self._bus = bus

    @property
    def where(self):
        return f" behind the {self._bus.imu.chip}"

    @property
    def sample_rate(self):
        return self._bus.imu.sample_rate

    def read_into(self, register, buffer):
        for i in range(len(buffer)):
            buffer[i] = self._bus.transfer(self.address | _READ, register + i, 0)

    def write(self, register, value):
        self._bus.transfer(self.address, register, value)

    def write_from(self, buffer):
        for i in range(1, len(buffer)):
            self.write(buffer[0] + i - 1, buffer[i])

    def begin(self):
        """Start the bus, with no slot in use."""
        self._bus.imu.attach(None, 0)
        self._bus.begin()

    def attach(self, ext, reads, start, every):
        """Read with every sample, write with every n-th, pass the bytes to ext as imu.attach() says. It uses all slots.

        reads  (register, length) of each read
        start  (register, value) that is written; None: nothing is
        """
        bus = self._bus
        self.begin()
        length = 0
        for register, n in reads:
            bus.periodic_read(self.address, register, n)  # the first at 0: no other slot is in use
            length += n
        if start is not None:
            bus.periodic_write(self.address, start[0], start[1], every)
        bus.start()
        bus.faults = 0
        bus.imu.attach(ext, length, (1 << len(reads)) - 1)

    @micropython.native
    def transact(self, register, data):
        """transact() of the bus; data -1: a read."""
        bus = self._bus
        if data < 0:
            outcome = bus.transact(self.address | _READ, register, 0)
        else:
            outcome = bus.transact(self.address, register, data)
        if outcome != AUX_BUSY and bus.faults:
            bus.faults = 0
            self.errors = (self.errors + 1) & _COUNT_MASK
        return outcome
