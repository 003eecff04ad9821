# The auxiliary I2C bus of an MPU6050 or MPU6500: the chip's own master, on its pins AUX_CL and AUX_DA.
# Needs the configured driver of the chip (mpu6050.py or mpu6500.py). Runs on MicroPython >= 1.22 and
# under CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2; RM-MPU-6500A has the same master.

import time

import micropython
from micropython import const

# What poll() answers
AUX_IDLE = const(0)  # nothing was posted
AUX_BUSY = const(1)
AUX_DONE = const(2)  # value is the byte of a post_read()
AUX_NACK = const(3)  # nobody acknowledged
AUX_TIMEOUT = const(4)  # not carried out: the IMU asleep or reset, or the bus held low

_I2C_MST_CTRL = const(0x24)
_SLV0_ADDR = const(0x25)  # ADDR, REG, CTRL of slot 0, then of slots 1 to 3
_SLV4_ADDR = const(0x31)
_SLV4_REG = const(0x32)
_SLV4_DO = const(0x33)
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
_POLLS = const(16)  # calls of poll() that a transaction may take

# Steps of a transaction: what poll() does next
_NOTHING = const(0)
_ADDR = const(1)
_REG = const(2)
_DO = const(3)
_CLEAR = const(4)
_CTRL = const(5)
_WAIT = const(6)


class AuxiliaryError(OSError):
    """The auxiliary bus at set-up."""


class AuxiliaryNack(AuxiliaryError):
    """Nobody acknowledged the address or the byte."""


class AuxiliaryTimeout(AuxiliaryError):
    """The master did not carry the transaction out."""


class AuxiliaryBus:
    """The auxiliary master of `imu`, a configured MPU6050, MPU6500 or MPU6500_I2C.

    Slots 0 to 3 repeat themselves with the samples, what they read lies in EXT_SENS_DATA; slot 4 (SLV4)
    does one byte once. begin() first, and again after each imu.configure().

        aux = AuxiliaryBus(imu)
        aux.begin()
        aux.write_register(0x0E, 0x41, 0x24)
        at = aux.periodic_read(0x0E, 0x02, 7)
        aux.start()

    In the tick post_read() or post_write(), then poll() until it is not AUX_BUSY. faults collects the
    bits of I2C_MST_STATUS that the chip itself forgets when they are read: NACK of slots 0 to 3 in bits
    0 to 3, of SLV4 in bit 4, arbitration lost in bit 5. Whoever has seen them sets faults to 0.

    Slots and I2C_MST_DLY are rows of imu's register table: after a reset of the chip imu.health()
    brings them back.
    """

    def __init__(self, imu):
        self._imu = imu
        self._one = bytearray(1)
        self.value = 0
        self.faults = 0
        self._slots = []  # (address, register, length, value or None, delayed)
        self._used = 0  # slots that imu's table has rows for
        self._every = 1
        self._delay = 0  # I2C_MST_DLY
        self._step = _NOTHING
        self._address = 0  # of the transaction, with the read bit
        self._register = 0
        self._data = -1  # -1: a read
        self._there = -1  # what SLV4_ADDR holds, -1: not known
        self._unclean = 1  # I2C_MST_STATUS may still tell of an earlier transaction
        self._left = 0
        self._imu_resets = 0

    # Set-up: may wait, allocate and raise

    @property
    def running(self):
        """True once begin() is through, and until imu.configure()."""
        return self._imu.master_enabled

    def begin(self):
        """Switch the master on: 400 kHz, no slot in use.

        Not WAIT_FOR_ES: it would hold back the IMU's own data-ready for a dead magnetometer.
        DELAY_ES_SHADOW: the bytes of one round appear in EXT_SENS_DATA together.
        """
        if self.running:
            self.stop()  # not the master itself: it may be in the middle of a transfer
            return
        imu = self._imu
        self._off()
        self._used = 0
        imu.set_rows(
            [
                (_I2C_MST_CTRL, _P_NSR | _CLOCK_400_KHZ, 0xFF),
                (_I2C_MST_DELAY_CTRL, _DELAY_ES_SHADOW, _DELAY_BITS),
                (_SLV4_CTRL, 0, _DELAY),
            ]
        )
        imu.set_user_ctrl(_I2C_MST_EN, _I2C_MST_EN)

    def read_register(self, address, register):
        """One byte of a device, through SLV4.

        Takes up to a sample. Raises AuxiliaryNack, AuxiliaryTimeout, or imu's own error.
        """
        self._transfer(address | _READ, register, -1)
        return self._imu.read_register(_SLV4_DI)

    def write_register(self, address, register, value):
        """Write one byte to a device, through SLV4; raises as read_register() does."""
        self._transfer(address, register, value)

    def periodic_read(self, address, register, length, every=1):
        """Read 1 to 15 bytes with every sample, or every 2nd to 32nd; returns their place.

        The place counts from EXT_SENS_DATA_00: the slots' bytes lie there one after the other. Takes
        effect with start(). Raises ValueError when slots or bytes are used up, or for another `every`
        than a slot has already: there is one divider for all.
        """
        if not 1 <= length <= _LONGEST:
            raise ValueError(f"length {length!r} is not 1 to {_LONGEST}")
        at = self.length
        if at + length > _EXT_BYTES:
            raise ValueError(f"{at} + {length} bytes are more than EXT_SENS_DATA's {_EXT_BYTES}")
        self._add(address | _READ, register, length, None, every)
        return at

    def periodic_write(self, address, register, value, every=1):
        """Write the same byte with every sample, or every 2nd to 32nd. As periodic_read()."""
        self._add(address, register, 1, value, every)

    @property
    def length(self):
        """Bytes of EXT_SENS_DATA that the slots fill."""
        return sum(slot[2] for slot in self._slots if slot[3] is None)

    def start(self):
        """Program the slots while all are disabled, then enable them.

        The chip lays out EXT_SENS_DATA anew only when all slots are disabled (RM 4.20). Raises
        ValueError when the transactions take longer than a sample (RM 4.8).
        """
        self._need_begun()
        num, den = self._imu.sample_rate
        clocks = _SLV4_BITS
        for slot in self._slots:
            clocks += 27 + 9 * slot[2] + 3 if slot[3] is None else 29
        if clocks * 5 * num > 2_000_000 * den:  # 2.5 us each
            raise ValueError(
                f"the slots take {clocks * 5 // 2} us of each sample, and "
                f"{num}/{den} Hz leaves {1_000_000 * den // num}"
            )
        self._disable()
        rows = []
        delays = _DELAY_ES_SHADOW
        for n in range(len(self._slots)):
            address, register, _, value, delayed = self._slots[n]
            rows.append((_SLV0_ADDR + 3 * n, address, 0xFF))
            rows.append((_SLV0_ADDR + 3 * n + 1, register, 0xFF))
            if value is not None:
                rows.append((_SLV0_DO + n, value, 0xFF))
            if delayed:
                delays |= 1 << n
        self._delay = self._every - 1
        rows.append((_I2C_MST_DELAY_CTRL, delays, _DELAY_BITS))
        rows.append((_SLV4_CTRL, self._delay, _DELAY))
        for n in range(len(self._slots)):
            rows.append((_SLV0_ADDR + 3 * n + 2, _ENABLE | self._slots[n][2], 0xFF))
        self._used = len(self._slots)
        self._imu.set_rows(rows)

    def stop(self):
        """Disable the slots and forget them."""
        self._need_begun()
        self._off()
        self._imu.set_rows(
            [(_SLV0_ADDR + 3 * n + 2, 0, 0xFF) for n in range(self._used)]
            + [(_I2C_MST_DELAY_CTRL, _DELAY_ES_SHADOW, _DELAY_BITS), (_SLV4_CTRL, 0, _DELAY)]
        )

    def _off(self):
        self._disable()
        self._slots = []
        self._every = 1
        self._delay = 0
        self._step = _NOTHING
        self._there = -1
        self._unclean = 1

    def _disable(self):
        for n in range(_SLOTS):
            self._imu.write_register(_SLV0_ADDR + 3 * n + 2, 0)

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

    def _transfer(self, address, register, value):
        """One transaction of SLV4, from its parameters to SLV4_DONE."""
        self._need_begun()
        imu = self._imu
        self._step = _NOTHING
        self._there = -1
        imu.write_register(_SLV4_ADDR, address)
        imu.write_register(_SLV4_REG, register)
        if value >= 0:
            imu.write_register(_SLV4_DO, value)
        self._status()  # an earlier one's
        imu.write_register(_SLV4_CTRL, _ENABLE | self._delay)
        num, den = imu.sample_rate
        most = 5000 + 3_000_000 * den // num  # SLV4 has its turn once a sample
        start = time.ticks_us()
        while True:
            late = time.ticks_diff(time.ticks_us(), start) > most
            status = self._status()
            if status & (_SLV4_NACK | _SLV4_DONE | _LOST_ARB) or late:
                break
            time.sleep_us(50)
        if not status & _SLV4_DONE:
            imu.write_register(_SLV4_CTRL, self._delay)
        if status & _SLV4_NACK:
            raise AuxiliaryNack(f"auxiliary bus: no acknowledge to {_what(address, register)}")
        if status & _LOST_ARB:
            raise AuxiliaryTimeout(
                f"auxiliary bus: {_what(address, register)} lost to somebody who holds AUX_DA low"
            )
        if not status & _SLV4_DONE:
            raise AuxiliaryTimeout(
                f"auxiliary bus: {_what(address, register)} not done in {most // 1000} ms; is the IMU "
                "awake, are AUX_CL and AUX_DA high?"
            )

    def _status(self):
        status = self._imu.read_register(_I2C_MST_STATUS)
        self.faults |= status & _FAULTS
        return status

    # The tick: nothing below allocates, waits, raises or uses a float. At most two registers a call.

    def post_read(self, address, register):
        """Begin to read one byte; poll() does it."""
        self._post(address | _READ, register, -1)

    def post_write(self, address, register, value):
        """Begin to write one byte; poll() does it."""
        self._post(address, register, value)

    @micropython.native
    def _post(self, address, register, data):
        self._address = address
        self._register = register
        self._data = data
        self._left = _POLLS
        if self._step == _WAIT:
            self._unclean = 1  # the one before was not waited for
        self._step = _REG if self._there == address else _ADDR

    @micropython.native
    def poll(self):
        """Bring the posted transaction forward; returns an AUX_ state, everything else but AUX_BUSY once.

        A read takes 2 or 3 calls, a write 3, as long as there is a sample between two of them; after 16
        calls it is given up.
        """
        if self._step == _NOTHING:
            return AUX_IDLE
        resets = self._imu.resets
        if resets != self._imu_resets:
            self._imu_resets = resets
            self._step = _ADDR  # the chip has forgotten it
        self._left -= 1
        if self._left < 0:
            return self._give_up()
        if self._step == _WAIT:
            return self._look()
        self._access()
        if self._step != _WAIT:
            self._access()
        return AUX_BUSY

    @micropython.native
    def _access(self):
        """One register of SLV4, in the order in which the chip wants them; after a fault once more."""
        step = self._step
        if step == _ADDR:
            self._there = -1
            if self._write(_SLV4_ADDR, self._address):
                self._there = self._address
                self._step = _REG
        elif step == _REG:
            if self._write(_SLV4_REG, self._register):
                self._step = _DO if self._data >= 0 else _CLEAR if self._unclean else _CTRL
        elif step == _DO:
            if self._write(_SLV4_DO, self._data):
                self._step = _CLEAR if self._unclean else _CTRL
        elif step == _CLEAR:
            if self._read(_I2C_MST_STATUS):
                self.faults |= self._one[0] & _FAULTS
                self._unclean = 0
                self._step = _CTRL
        elif self._write(_SLV4_CTRL, _ENABLE | self._delay):  # EN beside the delay, never without
            self._step = _WAIT

    @micropython.native
    def _look(self):
        """Is it done?"""
        if not self._read(_I2C_MST_STATUS):
            return AUX_BUSY
        status = self._one[0]
        self.faults |= status & _FAULTS
        if status & (_SLV4_NACK | _LOST_ARB):
            self._step = _NOTHING
            if not status & _SLV4_DONE:
                self._write(_SLV4_CTRL, self._delay)
            return AUX_NACK if status & _SLV4_NACK else AUX_TIMEOUT
        if not status & _SLV4_DONE:
            return AUX_BUSY
        if self._data < 0:
            if not self._read(_SLV4_DI):
                return AUX_BUSY
            self.value = self._one[0]
        self._step = _NOTHING
        return AUX_DONE

    def _give_up(self):
        self._step = _NOTHING
        self._there = -1
        self._unclean = 1
        self._write(_SLV4_CTRL, self._delay)
        return AUX_TIMEOUT

    @micropython.native
    def _read(self, register):
        try:
            self._imu.registers.read_into(register, self._one)
            return 1
        except OSError:
            return self._fault()

    @micropython.native
    def _write(self, register, value):
        try:
            self._imu.registers.write(register, value)
            return 1
        except OSError:
            return self._fault()

    def _fault(self):
        self._imu.bus_fault()
        return 0


def _what(address, register):
    verb = "a read of" if address & _READ else "a write to"
    return f"{verb} register 0x{register:02x} of 0x{address & 0x7F:02x}"
