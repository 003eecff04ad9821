# The set-up half of the drivers of the InvenSense MPU6050 family: configuration, register table, FIFO mode, sleep.
# Needs mpu_parts.py. Runs on MicroPython >= 1.22 and under CPython with a `micropython` shim. RM is RM-MPU-6000A
# rev 4.2, PS PS-MPU-6000A rev 3.4, RM-6500 RM-MPU-6500A rev 2.1. One class, as all of it hangs on one state.

import time
from array import array

from micropython import const

from upright import mpu_parts

_SMPLRT_DIV = const(0x19)
_CONFIG = const(0x1A)
_GYRO_CONFIG = const(0x1B)
_ACCEL_CONFIG = const(0x1C)
_ACCEL_CONFIG2 = const(0x1D)
_FIFO_EN = const(0x23)
_INT_PIN_CFG = const(0x37)
_INT_ENABLE = const(0x38)
_INT_STATUS = const(0x3A)
_USER_CTRL = const(0x6A)
_PWR_MGMT_1 = const(0x6B)
_PWR_MGMT_2 = const(0x6C)
_FIFO_COUNTH = const(0x72)

_DATA_RDY = const(0x01)  # INT_STATUS and INT_ENABLE
_FIFO_OFLOW = const(0x10)
_FIFO_ENABLE = const(0x40)  # USER_CTRL.FIFO_EN
_I2C_MST_EN = const(0x20)
_SLV_CTRL = (0x27, 0x2A, 0x2D, 0x30, 0x34)  # I2C_SLV0_CTRL to I2C_SLV4_CTRL
_FIFO_ALL = const(0xF8)  # FIFO_EN: TEMP, XG, YG, ZG, ACCEL
_DEVICE_RESET = const(0x80)
_SLEEP = const(0x40)
_CLK_PLL = const(0x01)  # CLKSEL 1, PLL on the X gyro: RM 4.28 prefers it to the internal oscillator
_PACKET = const(14)  # accel x y z, temperature, gyro x y z

# Until the zero-rate output has settled: PS 6.1; PS-MPU-6500A rev 1.3, table 1
_GYRO_START_MS = const(30)
_GYRO_START_6500_MS = const(35)


class MpuSetup:
    """What may wait, allocate and raise; mpu_common.MpuBase adds what the tick calls."""

    # the bits of USER_CTRL that the bus wants: I2C_IF_DIS or none
    _INTERFACE = 0

    def __init__(self, registers):
        self.registers = registers
        self.error_class = registers.error_class
        self.counts = array("h", bytes(22))  # ax ay az gx gy gz mx my mz temp flags
        self.errors = 0
        self.stale = 0
        self.resets = 0
        self.fifo_overflows = 0
        self.fifo_resets = 0
        self.fifo_lost = 0
        self.fifo_level = 0
        self.chip = None
        self.who_am_i = None
        self.family_6500 = False
        self.fifo_size = 1024
        self.repair_calls = 0
        self._user_ctrl = self._INTERFACE  # USER_CTRL without FIFO_EN
        self._temperature = (5, 17, 3653)
        self._raw = bytearray(1 + _PACKET)
        self._one = bytearray(1)
        self._status = bytearray(1)
        self._two = bytearray(2)
        self._registers = b""  # the table of rows: register, value, bits that are compared
        self._values = bytearray(0)
        self._masks = b""
        self._ext = None  # takes what comes behind the sample
        self._ext_length = 0
        self._ext_turn = 0  # 1: at the next health() that has nothing urgent it is ext's turn
        self._packet = _PACKET
        self._full = 0  # packets from which on the FIFO counts as full
        self._fifo_bits = _FIFO_ALL
        self._begun = False
        self._configured = False
        self._fifo_on = False
        self._batch = bytearray(0)
        self._views = ()
        self._batch_max = 0
        self._pending = 0  # packets of the batch not yet delivered
        self._at = 0  # where the next one begins
        self._dirty = 0  # 1: the FIFO's packet boundary is not certain, restart it first
        self._hold = 0  # samples still to be withheld; -1: until the repair is through
        self._hold_samples = 0
        self._settled = 0  # samples since the last row was written back
        self._row = 0  # the row that health() takes next
        self._suspect = 0  # 1: a reset would explain what was seen
        self._looked = 0  # 1: the last health() went out of turn
        self._writing = -1  # step of the repair, see _restore; -1 when there is nothing to repair
        self._verifying = 0  # rows to read back before the repair counts as done
        # MicroPython looks for a method among the attributes of the instance first, and a table of
        # attributes that is (nearly) full is searched from end to end, 1500 instructions for a call. So
        # what every tick calls stands in that table.
        self._read_into = self.registers.read_into
        self._write = self.registers.write
        for name in ("read", "health", "fifo_next", "_compare"):
            setattr(self, name, getattr(self, name))

    def configure(
        self,
        accel_range_g=8,
        gyro_range_dps=2000,
        dlpf=None,
        sample_rate_hz=1000,
        settle=True,
        accel_dlpf=None,
    ):
        """Set the chip up and start it; finds and resets it first unless begin() has.

        accel_range_g   2, 4, 8 or 16
        gyro_range_dps  250, 500, 1000 or 2000
        dlpf            DLPF_CFG 0..6: gyro bandwidth 256, 188, 98, 42, 20, 10, 5 Hz (RM 4.3; MPU6500
                        250, 184, 92, 41, 20, 10, 5, RM-6500 4.5); None picks the widest that stays
                        within half the sample rate. On the MPU6500 family also 7 (3600 Hz) and
                        "bypass" (FCHOICE_B: 8800 Hz, a sample every 31 us, for read() only)
        sample_rate_hz  int or (num, den): 1000 Hz divided by 1 to 256, the nearest of these when it
                        lies within 0.5 %. With dlpf 0 8000 Hz takes the place of 1000, with 7 too;
                        there the MPU6500 family cannot divide; with "bypass" 32000 only
        settle          wait for the gyro's start-up and the filter (from 34 ms on)
        accel_dlpf      MPU6500 family: A_DLPF_CFG 0..7, accelerometer bandwidth 460, 184, 92, 41, 20,
                        10, 5, 460 Hz, or "bypass" (1130 Hz; RM-6500 4.8). None: as dlpf

        Afterwards accel_lsb_per_g is an int, gyro_scale the exact LSB per deg/s as (num, den),
        sample_rate the exact rate as (num, den) Hz; bandwidth_hz, accel_bandwidth_hz, dlpf,
        accel_range_g and gyro_range_dps say what was set; FIFO mode is off, the INT pin gives pulses,
        active high.

        Raises ValueError for a setting that the part does not have, and the driver's own error for
        a chip that is absent, is another one, or does not keep what was written to it.
        """
        self._configured = False
        afs = mpu_parts.index("accel_range_g", accel_range_g, mpu_parts.ACCEL_RANGES)
        fs = mpu_parts.index("gyro_range_dps", gyro_range_dps, mpu_parts.GYRO_RANGES)
        rate = mpu_parts.ratio(sample_rate_hz)
        if not self._begun:
            self.begin()
        filters = mpu_parts.Filters(self.chip, self.family_6500, dlpf, accel_dlpf, rate)

        self._fifo_on = False
        self._pending = self._dirty = self.fifo_level = 0
        self._user_ctrl = self._INTERFACE
        self.attach(None, 0)
        rows = [
            # awake first: the other registers keep what is written either way
            (_PWR_MGMT_1, _CLK_PLL),
            (_PWR_MGMT_2, 0),
            (_SMPLRT_DIV, filters.smplrt_div),
            (_CONFIG, filters.config),
            (_GYRO_CONFIG, fs << 3 | filters.fchoice_b),
            (_ACCEL_CONFIG, afs << 3),
        ]
        if self.family_6500:
            rows.append((_ACCEL_CONFIG2, filters.accel_config2))
        rows += [
            # never INT_RD_CLEAR: any read would then wipe the FIFO overflow flag (RM 4.14)
            (_INT_PIN_CFG, 0),
            (_FIFO_EN, 0),
            (_INT_ENABLE, _DATA_RDY),
        ]
        table = [(register, value, 0xFF) for register, value in rows]
        # last: this is what starts the FIFO. RM-6500 4.27: I2C_IF_DIS clears itself
        table.append((_USER_CTRL, self._user_ctrl, 0xFF & ~self._INTERFACE))
        self._set_table(table)
        self._row = self._suspect = self._looked = self._verifying = 0
        self._writing = -1

        self.accel_range_g = accel_range_g
        self.gyro_range_dps = gyro_range_dps
        self.dlpf = filters.dlpf
        self.accel_dlpf = filters.accel_dlpf
        self.bandwidth_hz = filters.bandwidth_hz
        self.accel_bandwidth_hz = filters.accel_bandwidth_hz
        self.accel_lsb_per_g = 16384 >> afs
        self.gyro_scale = mpu_parts.GYRO_SCALES[fs]
        self.sample_rate = filters.sample_rate
        start_ms = _GYRO_START_6500_MS if self.family_6500 else _GYRO_START_MS
        self._settle_ms = start_ms + 4 * filters.delay_ms
        self._hold_samples = 1 + self._settle_ms * self.sample_rate[0] // (
            1000 * self.sample_rate[1]
        )
        self._apply()
        self._configured = True
        self._hold = 0
        if settle:
            self._settle()

    def begin(self):
        """Find the chip, check its identity, reset it (0.1 s). Raises the driver's own error."""
        self._begin()
        self._begun = True

    def configure_interrupt(self, active_low=False, open_drain=False, latch=False):
        """How the INT pin tells of a sample: a pulse of 50 us, or with latch a level until read()."""
        self._need_configured()
        value = (0x80 if active_low else 0) | (0x40 if open_drain else 0) | (0x20 if latch else 0)
        self._set_row(_INT_PIN_CFG, value)

    def fifo_enable(self, batch=8):
        """Let the chip queue its samples; from now on drive it with fifo_poll() and fifo_next().

        batch: packets (14 bytes, and what attach() adds) that one fifo_poll() fetches at most, in one
        burst; 1 to what the FIFO holds.
        """
        self._need_configured()
        if self.dlpf == "bypass":
            raise ValueError("a FIFO that fills 32000 times a second cannot be read out")
        size = self._packet
        if not 1 <= batch <= self.fifo_size // size:
            raise ValueError(f"batch {batch!r} is not 1 to {self.fifo_size // size}")
        # off until the chip is known to write packets of this length
        self._fifo_on = False
        self._full = self.fifo_size // size - 1
        self._pending = self.fifo_level = 0
        if len(self._batch) != batch * size or batch != self._batch_max:
            self._batch = bytearray(batch * size)
            whole = memoryview(self._batch)
            self._views = [whole[: n * size] for n in range(batch + 1)]
            self._batch_max = batch
        self._dirty = 1
        self._set_row(_FIFO_EN, self._fifo_bits)
        self._set_row(_INT_ENABLE, _DATA_RDY | _FIFO_OFLOW)
        self._values[len(self._values) - 1] = self._user_ctrl | _FIFO_ENABLE
        if self._ext_length:
            self._measure_packet()
        self._fifo_restart()
        if self._dirty:
            raise self.error_class("the bus failed while the FIFO was started")
        self._fifo_on = True

    def fifo_disable(self):
        """Back to read(). What the FIFO still holds is dropped."""
        self._need_configured()
        self._fifo_on = False
        self._pending = self._dirty = self.fifo_level = 0
        self._set_row(_USER_CTRL, self._user_ctrl)
        self._set_row(_FIFO_EN, 0)
        self._set_row(_INT_ENABLE, _DATA_RDY)

    def self_test(self):
        """Actuate the proof masses and judge the response, by the part's own formulas.

        To be run at rest; takes 0.4 to 0.7 s. Returns (passed, changes): six ints for accel x y z and
        gyro x y z, how far the response is off the factory's, in per mille, or None where the part
        carries no factory value. passed is None when there is nothing to judge by.

        MPU6050: within 14 % (PS 6.1, 6.2). MPU6500 family: gyro at least half, accelerometer half to
        one and a half times the factory's, or absolute limits without one, and a gyro offset within 20
        deg/s (AN-MPU-9250A-03). Needs mpu_selftest.py. Afterwards the configuration is as before.
        Raises the driver's own error for a bus fault.
        """
        self._need_configured()
        from upright import mpu_selftest  # only here: most programs never run it

        return mpu_selftest.run(self)

    def sleep(self):
        """Stop sampling (about 5 uA, PS 6.3) until wake(); the configuration stays."""
        self._need_configured()
        self._set_row(_PWR_MGMT_1, _CLK_PLL | _SLEEP)

    def wake(self):
        """Sample again, after the gyro's start-up time."""
        self._need_configured()
        self._set_row(_PWR_MGMT_1, _CLK_PLL)
        self._settle()
        self._pending = 0
        if self._fifo_on:
            self._dirty = 1  # what came in while the gyro settled is not wanted

    def configuration(self):
        """The configuration as a list of (register, value), in the order in which it is written."""
        return [(self._registers[i], self._values[i]) for i in range(len(self._registers))]

    # Set-up for what works through this chip: a device on its auxiliary bus

    def read_register(self, register):
        """One register; raises error_class, naming it, when the bus fails."""
        return self.registers.read_register(register)

    def write_register(self, register, value):
        """Write one register that health() is not to watch; raises error_class, naming it."""
        self.registers.write_register(register, value)

    def set_rows(self, rows):
        """Configure registers and have health() watch them and a repair write them back.

        rows: (register, value, mask), mask being the bits that are compared. They are written in this
        order and read back; a register that the table has already keeps its place there, a new one
        comes before USER_CTRL, which starts FIFO and master. configure() forgets them.

        In FIFO mode what is in the FIFO is dropped; where the rows change what a slave reads, call
        attach() again. Raises error_class for a bus fault and for a register that does not keep its
        value.
        """
        self._need_configured()
        table = [
            (self._registers[i], self._values[i], self._masks[i])
            for i in range(len(self._registers))
        ]
        for row in rows:
            at = self._registers.find(bytes((row[0],)))
            if at < 0:
                at = len(table) - 1
                table.insert(at, row)
            else:
                table[at] = row
            self._set_table(table)
        if self._fifo_on:
            self._pending = 0
            self._dirty = 1
        for register, value, _ in rows:
            self.registers.write_register(register, value)
        for register, _, _ in rows:
            self._verify(register)

    @property
    def master_enabled(self):
        """Is the auxiliary master to run, as set_user_ctrl() has it?"""
        return bool(self._user_ctrl & _I2C_MST_EN)

    def set_user_ctrl(self, bits, mask):
        """Change the bits of USER_CTRL that mask names, I2C_MST_EN (0x20) say, on the chip as well."""
        self._need_configured()
        self._user_ctrl = self._user_ctrl & ~mask | bits & mask
        self._set_row(_USER_CTRL, self._user_ctrl | (_FIFO_ENABLE if self._fifo_on else 0))

    def attach(self, ext, length, fifo_en=0x01):
        """Fetch EXT_SENS_DATA_00 and on, `length` bytes (0 to 24), in the same burst as the sample.

        In FIFO mode they come behind the gyro in each packet: fifo_en names the slaves in FIFO_EN
        (SLV0 0x01, SLV1 0x02, SLV2 0x04), which must be set up to read `length` bytes in all. ext has

            take(raw, at, counts)   called after a fresh sample: raw[at] to raw[at + length - 1] are its
                                    bytes; fills counts[6] to counts[8], returns the flags to add: 2 or 0
            health()                called by every second health() while the chip is in order

        and neither may allocate or raise. attach(None, 0) ends it. In FIFO mode this starts the FIFO
        anew, with fewer packets in a batch if it holds fewer; error_class is raised, and FIFO mode
        over, if the packets turn out to have another length.
        """
        if not 0 <= length <= 24:
            raise ValueError(f"length {length!r} is not 0 to 24")
        if ext is not None:
            self._need_configured()
        on = self._fifo_on
        self._fifo_on = False
        self._pending = 0
        self._ext = None  # never with buffers of another length
        self._ext_turn = 0
        self._ext_length = length
        self._packet = _PACKET + length
        self._fifo_bits = _FIFO_ALL | (fifo_en & 0x07 if length else 0)
        self._raw = bytearray(1 + self._packet)
        self._ext = ext
        if on:
            self.fifo_enable(min(self._batch_max, self.fifo_size // self._packet))

    # Its parts

    def _measure_packet(self):
        """Does a sample bring as many bytes as attach() was told? Raises error_class if not."""
        wait_ms = 5 + 2000 * self.sample_rate[1] // self.sample_rate[0]
        level = 0
        for _ in range(3):
            self._fifo_restart()
            begun = time.ticks_ms()
            level = 0
            while level < self._packet and time.ticks_diff(time.ticks_ms(), begun) <= wait_ms:
                self.registers.read_registers(_FIFO_COUNTH, self._two)
                level = self._two[0] << 8 | self._two[1]
            if level == self._packet:
                return
        raise self.error_class(
            f"a sample does not put {self._packet} bytes into the FIFO (at the last look {level}): do "
            "the slaves that attach() was told of read what it was told?"
        )

    def _set_table(self, rows):
        self._registers = bytes(row[0] for row in rows)
        self._values = bytearray(row[1] for row in rows)
        self._masks = bytes(row[2] for row in rows)
        self.repair_calls = 2 * len(rows) + 3

    def _adopt(self, who, part):
        """Become the part that was found: a row of mpu_parts.PARTS."""
        self.who_am_i = who
        self.chip, self.family_6500, self.fifo_size, self._temperature = part

    def _reset(self, where):
        """DEVICE_RESET, waited for; raises the driver's own error if it does not come to an end."""
        for _ in range(3):
            try:
                self._stop()
                self._write(_PWR_MGMT_1, _DEVICE_RESET)
                break
            except OSError:
                # perhaps the chip let go of the bus as it reset: once more is safe
                time.sleep_ms(1)
        time.sleep_ms(100)  # what the register maps ask for after DEVICE_RESET
        for _ in range(10):
            try:
                self._read_into(_PWR_MGMT_1, self._one)
                if not self._one[0] & _DEVICE_RESET:
                    return
            except OSError:
                pass
            # late after a slow supply ramp: the family's registers may take another 100 ms
            time.sleep_ms(10)
        raise self.error_class(f"chip {where} did not come out of reset")

    def _stop(self):
        """FIFO and auxiliary master off.

        The master may be running even before the first configure(), since a reset of the board need
        not be one of the chip. Cut off within a transaction (by the chip's reset, too) it would leave
        the device on its bus hanging (RM-6500 4.33): it finishes what it began if its slots go first.
        """
        if self.read_register(_USER_CTRL) & _I2C_MST_EN:
            for control in _SLV_CTRL:
                self.registers.write_register(control, 0)
            time.sleep_ms(5)  # 24 bytes and five addresses at the slowest clock
        self.registers.write_register(_USER_CTRL, self._INTERFACE)

    def _settle(self):
        # the gyro's start-up (PS 6.1) and four times the filter's delay, so that its step response
        # has died away
        time.sleep_ms(self._settle_ms)
        self.registers.read_registers(
            _INT_STATUS, self._raw
        )  # what was ready meanwhile is not a fresh sample

    def _need_configured(self):
        if not self._configured:
            raise self.error_class("configure() first")

    def _apply(self):
        """Write the whole table, then read it back."""
        self._stop()
        for register, value in self.configuration():
            self.registers.write_register(register, value)
        for register in self._registers:
            self._verify(register)

    def _resume(self):
        """Configured again after something that changed registers without the table."""
        self._apply()
        if self._fifo_on:
            self._dirty = 1
            self._pending = 0
        self._settle()

    def _set_row(self, register, value):
        """Change one row of the table, on the chip as well."""
        self._values[self._registers.find(bytes((register,)))] = value
        self.registers.write_register(register, value)
        self._verify(register)

    def _verify(self, register):
        row = self._registers.find(bytes((register,)))
        self.registers.verify_register(register, self._values[row], self._masks[row])
