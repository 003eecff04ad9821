# The driver of the InvenSense MPU6050 family, put together from its parts: registers, table, monitor and FIFO.
# Needs mpu_parts.py, mpu_table.py, mpu_monitor.py, mpu_fifo.py, and mpu_selftest.py for a self-test. Runs on
# MicroPython >= 1.22 and under CPython with a `micropython` shim. RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A
# rev 3.4, RM-6500 RM-MPU-6500A rev 2.1.

import time
from array import array

import micropython
from micropython import const

from upright import mpu_parts
from upright.mpu_fifo import Counters, Fifo, make_buffer, unpack
from upright.mpu_monitor import Monitor
from upright.mpu_table import RegisterTable

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

_I2C_BYPASS_EN = const(0x02)  # INT_PIN_CFG
_DATA_RDY = const(0x01)  # INT_STATUS and INT_ENABLE
_FIFO_OFLOW = const(0x10)
_NO_STATUS = const(0xA4)  # bits of INT_STATUS that no part of the family sets (RM 4.16)
_FIFO_ENABLE = const(0x40)  # USER_CTRL.FIFO_EN
_I2C_MST_EN = const(0x20)
_SLV_CTRL = (0x27, 0x2A, 0x2D, 0x30, 0x34)  # I2C_SLV0_CTRL to I2C_SLV4_CTRL
_FIFO_ALL = const(0xF8)  # FIFO_EN: TEMP, XG, YG, ZG, ACCEL
_DEVICE_RESET = const(0x80)
_SLEEP = const(0x40)
_CLK_PLL = const(0x01)  # CLKSEL 1, PLL on the X gyro: RM 4.28 prefers it to the internal oscillator
_MASTER_MS = const(5)  # the master needs it for 24 bytes and five addresses at the slowest clock
_EXT_BYTES = const(24)  # EXT_SENS_DATA
_PACKET = const(14)  # accel x y z, temperature, gyro x y z
# The head of a buffer, see mpu_fifo.py
_HEAD = const(6)
_ODD = const(2)
_ENABLED = const(3)
_STATUS = const(5)
_ODD_TAKEN = const(4)

# Until the zero-rate output has settled: PS 6.1; PS-MPU-6500A rev 1.3, table 1
_GYRO_START_MS = const(30)
_GYRO_START_6500_MS = const(35)

_FLAGS = const(10)  # of counts
_RESET = const(4)  # state of the monitor
_COUNT_MASK = const(0x3FFFFFFF)


class Mpu(Counters):
    """A chip of the family behind a port. The port says how the chip is connected:

        registers    I2CRegisters or SPIRegisters
        interface    the bits of USER_CTRL that the bus needs: I2C_IF_DIS or none
        after_reset  pairs (register, value) that follow DEVICE_RESET
        where        for messages: "at 0x68"
        prepare()    before the first access
        find()       (WHO_AM_I, row of mpu_parts.PARTS); waits for the chip, raises the driver's own error

    The constructor touches no bus. configure() finds, resets and starts the chip. Then, in a timer's or a pin's
    interrupt, read() fills counts (ax ay az gx gy gz mx my mz temp flags), and health() checks the configuration, see
    mpu_monitor.Monitor. In FIFO mode fifo_poll() and fifo_next() replace read(), see mpu_fifo.Fifo.

        imu.configure(accel_range_g=8, gyro_range_dps=2000, sample_rate_hz=200)

        def tick(timer):
            if imu.read() & 1:
                ...  # a new sample in imu.counts
            imu.health()

    In a program, accel(), gyro() and temperature() give the newest sample in g, deg/s and degC. As a context
    manager (`with`) the driver puts the chip to sleep at the end; entering configures nothing.

    Counters, wrapping at 2**30: errors (faults of the bus; on SPI, reads of a floating bus), stale (read() found
    nothing new), resets (of the chip by itself), full_resets (by health(), when no samples came), fifo_overflows,
    fifo_resets, fifo_lost (packets, also those that came while nobody could read). fifo_level is the number of packets
    that the last poll left in the chip. chip is the part's name, who_am_i its identity, remarks a list of how
    it differs from its data sheet.

    Set-up methods are not interrupt-safe: stop the tick first.
    """

    def __init__(self, port):
        self.port = port
        self.registers = registers = port.registers
        self.error_class = registers.error_class
        self.counts = counts = array("h", bytes(22))
        self.stale = 0
        self.chip = None
        self.who_am_i = None
        self.family_6500 = False
        self.bypass = False  # see set_bypass()
        self.aux_device = None  # takes the bytes behind the sample
        self.table = RegisterTable(registers)
        self.monitor = Monitor(registers, self.table, counts)
        self.fifo = Fifo(registers, self.table, self.monitor, counts)
        self.remarks = []  # how this chip differs from its data sheet, a line each; found by configure()
        self._always = False
        self._own_accel_filter = False
        self._sampled_us = 0
        self._length_behind(0, 0)
        self._temperature = mpu_parts.T_6050
        self._begun = False
        self._configured = False
        # Methods that ticks call are looked up once, see mpu_monitor.Monitor. (With all of these the table of
        # attributes grows to its next size once configure() has set its own, and is not nearly full.)
        self._unusual = self._unusual
        self._withheld = self._withheld
        self._is_sample = self._is_sample
        self._is_due = self._is_due
        self._has_words = self._has_words
        self.bus_fault = self.bus_fault
        self._read_into = registers.read_into
        self.read = self.read
        self.health = self.monitor.health
        self.fifo_poll = self.fifo.poll
        self.fifo_next = self.fifo.next
        # For set-up, also of what works through this chip; raise error_class, naming the register. health() does not
        # watch what write_register() writes.
        self.read_register = registers.read_register
        self.write_register = registers.write_register

    # The tick: nothing here allocates, waits, raises or uses a float. Native: half the time of bytecode.

    @micropython.native
    def read(self):
        """Fetch the newest sample into counts; returns its flags (bit 0: fresh).

        One burst from INT_STATUS on: DATA_RDY distinguishes a new sample from one already read. If there is no new
        sample, or the bus fails, or the gyro has not settled after a repair, bit 0 is clear and the words keep their
        values.
        """
        if self.monitor.state:
            return self._withheld()
        raw = self._raw
        try:
            self._read_into(self._first, self._burst)
        except OSError:
            return self.monitor.fault()
        counts = self.counts
        flags = unpack(raw, _HEAD, counts)
        if not flags:
            flags = self._unusual(raw)
            if not flags:
                return counts[_FLAGS]
        device = self.aux_device
        if device is not None:
            flags |= device.take(raw, _HEAD + _PACKET, counts)
            counts[_FLAGS] = flags
        return flags

    def _unusual(self, raw):
        """What is not an ordinary sample: flags if it is one all the same, else 0."""
        if not raw[_ODD]:
            if not self._is_sample(raw):
                return 0
            flags = unpack(raw, _HEAD, self.counts)
            if flags:
                return flags
        raw[_STATUS] = 0xFF
        if not self.monitor.accept(raw):
            return 0
        raw[_STATUS] = _DATA_RDY
        return unpack(raw, _HEAD, self.counts)

    def _withheld(self):
        """read() while the chip is repaired or the gyro settles."""
        if self.monitor.state == _RESET:
            return self.monitor.not_fresh()  # the chip must not be accessed
        try:
            self._read_into(self._first, self._burst)
        except OSError:
            return self.monitor.fault()
        if self._is_sample(self._raw):
            self.monitor.withhold(0)
        return self.counts[_FLAGS]

    def _is_sample(self, raw):
        """Is there a new sample? Handles every other value of INT_STATUS."""
        status = raw[_STATUS]
        raw[_STATUS] = 0xFF
        if status & _NO_STATUS:  # a floating bus, or a transfer that did not fill the buffer
            self.monitor.fault()
            return False
        if status & _FIFO_OFLOW:
            self.monitor.fifo_misaligned = 1  # reading the flag has cleared it
        if self._by_time:
            status |= self._is_due(raw)
        if status & _DATA_RDY and raw[_ENABLED] & _DATA_RDY:
            raw[_STATUS] = _DATA_RDY  # the rest is handled
            return True
        self.stale = (self.stale + 1) & _COUNT_MASK
        self.monitor.no_sample(raw)
        return False

    def _is_due(self, raw):
        """Going by time: _DATA_RDY once a sample is due, else 0."""
        now = time.ticks_us()
        if 0 <= time.ticks_diff(now, self._sampled_us) < self.fifo.period_us >> 1:
            return 0
        if not self._has_words(raw):
            return 0
        self._sampled_us = now
        return _DATA_RDY

    def temperature_cdeg(self, counts=None):
        """Temperature in hundredths of a degC, by the formula of the part; counts: None: of the newest sample."""
        mul, div, offset = self._temperature
        if counts is None:
            counts = self.counts[9]
        return (counts * mul + (div >> 1)) // div + offset

    def bus_fault(self):
        """Count a bus fault that another part of the driver has met, and have health() check the chip."""
        self.monitor.fault()

    # For programs: these allocate

    def accel(self):
        """(x, y, z) of the newest sample in g, in the chip's frame: of the last read(), or of configure()."""
        self._need_configured()
        counts, lsb = self.counts, self.accel_lsb_per_g
        return counts[0] / lsb, counts[1] / lsb, counts[2] / lsb

    def gyro(self):
        """The same of the gyro in deg/s."""
        self._need_configured()
        counts, (num, den) = self.counts, self.gyro_scale
        return counts[3] * den / num, counts[4] * den / num, counts[5] * den / num

    def temperature(self):
        """Temperature of the newest sample in degC."""
        return self.temperature_cdeg() / 100

    def __enter__(self):
        return self

    def __exit__(self, kind, error, traceback):
        """FIFO off, chip asleep. A bus fault here must not hide the exception that ends the block."""
        if not self._configured:
            return
        try:
            if self.fifo.on:
                self.fifo_disable()
            self.sleep()
        except self.error_class:
            if kind is None:
                raise

    # Set-up: may wait, allocate and raise

    def configure(
        self,
        accel_range_g=8,
        gyro_range_dps=2000,
        dlpf=None,
        sample_rate_hz=1000,
        settle=True,
        accel_dlpf=None,
    ):
        """Set the chip up and start it. Without begin() it finds and resets it first.

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

        Afterwards accel_lsb_per_g is an int, gyro_scale the exact LSB per deg/s as (num, den), sample_rate the exact
        rate as (num, den) Hz. bandwidth_hz, accel_bandwidth_hz, dlpf, accel_range_g and gyro_range_dps hold what was
        set. FIFO mode is off. The INT pin gives pulses, active high.

        Raises ValueError for a setting that the part does not have, and the driver's own error for a chip that is
        absent, is another one, or does not keep what was written to it.
        """
        self._configured = False
        afs = mpu_parts.index("accel_range_g", accel_range_g, mpu_parts.ACCEL_RANGES)
        fs = mpu_parts.index("gyro_range_dps", gyro_range_dps, mpu_parts.GYRO_RANGES)
        rate = mpu_parts.ratio(sample_rate_hz)
        if not self._begun:
            self.begin()
        filters = mpu_parts.Filters(
            self.chip, self.family_6500, self._own_accel_filter, dlpf, accel_dlpf, rate
        )

        self.fifo.stop()
        self.monitor.fifo_misaligned = 0
        self.attach(None, 0)
        rows = [
            # awake first: the other registers keep what is written in any case
            (_PWR_MGMT_1, _CLK_PLL),
            (_PWR_MGMT_2, 0),
            (_SMPLRT_DIV, filters.smplrt_div),
            (_CONFIG, filters.config),
            (_GYRO_CONFIG, fs << 3 | filters.fchoice_b),
            (_ACCEL_CONFIG, afs << 3),
        ]
        if filters.accel_config2 is not None:
            rows.append((_ACCEL_CONFIG2, filters.accel_config2))
        rows += [
            # never INT_RD_CLEAR: any read would then clear the FIFO overflow flag (RM 4.14)
            (_INT_PIN_CFG, self._bypass_bit()),
            (_FIFO_EN, 0),
            (_INT_ENABLE, _DATA_RDY),
        ]
        interface = self.port.interface
        table = [(register, value, 0xFF) for register, value in rows]
        # last: this is what starts the FIFO. RM-6500 4.27: I2C_IF_DIS clears itself
        table.append((_USER_CTRL, interface, 0xFF & ~interface))
        self.table.load(table)

        self.accel_range_g = accel_range_g
        self.gyro_range_dps = gyro_range_dps
        self.dlpf = filters.dlpf
        self.accel_dlpf = filters.accel_dlpf
        self.bandwidth_hz = filters.bandwidth_hz
        self.accel_bandwidth_hz = filters.accel_bandwidth_hz
        self.accel_lsb_per_g = 16384 >> afs
        self.gyro_scale = mpu_parts.GYRO_SCALES[fs]
        self.sample_rate = num, den = filters.sample_rate
        # the gyro's start-up, and four times the filter's delay: then its step response has settled
        start_ms = _GYRO_START_6500_MS if self.family_6500 else _GYRO_START_MS
        self.settle_ms = start_ms + 4 * filters.delay_ms
        self._stop()
        self.table.apply()
        self.monitor.start(
            self.port.after_reset,
            interface,
            self.settle_ms,
            self.sample_rate,
        )
        self.fifo.period_us = (2_000_000 * den + num) // (2 * num)
        self._configured = True
        self._trust(True)
        if settle:
            self._learn_habits(1 + 1000 * den // num)

    def begin(self):
        """Find the chip, check its identity, reset it (0.1 s). Raises the driver's own error."""
        port = self.port
        port.prepare()
        self._adopt(port.find())
        self._reset()
        for register, value in port.after_reset:
            self.write_register(register, value)
        if port.after_reset:
            time.sleep_ms(100)
        self._adopt(port.find())
        self._probe_part()
        self._begun = True

    def configure_interrupt(self, active_low=False, open_drain=False, latch=False):
        """Set how the INT pin signals a sample: a pulse of 50 us, or with latch a level until read()."""
        self._need_configured()
        value = (0x80 if active_low else 0) | (0x40 if open_drain else 0) | (0x20 if latch else 0)
        self.table.set(_INT_PIN_CFG, value | self._bypass_bit())

    def fifo_enable(self, batch=8):
        """Let the chip queue its samples; read them with fifo_poll() and fifo_next().

        batch: packets (14 bytes, and the bytes of attach()) that one fifo_poll() fetches at most, in one burst; 1 to
        the capacity of the FIFO.
        """
        self._need_configured()
        if self.dlpf == "bypass":
            raise ValueError("a FIFO that fills 32000 times a second cannot be read out")
        self.fifo.prepare(batch)  # off until the chip is known to write packets of this length
        self.monitor.fifo_misaligned = 1
        self.table.set(_FIFO_EN, self._fifo_bits)
        self.table.set(_INT_ENABLE, _DATA_RDY | _FIFO_OFLOW)
        self.table.change_last(_FIFO_ENABLE, _FIFO_ENABLE)
        if self.fifo.packet > _PACKET:
            self._measure_packet()
        if not self.fifo.restart():
            raise self.error_class("the bus failed while the FIFO was started")
        self.fifo.on = True

    def fifo_disable(self):
        """Back to read(). The contents of the FIFO are dropped."""
        self._need_configured()
        self.fifo.stop()
        self.monitor.fifo_misaligned = 0
        self.table.set(_USER_CTRL, self.table.last() & ~_FIFO_ENABLE)
        self.table.set(_FIFO_EN, 0)
        self.table.set(_INT_ENABLE, _DATA_RDY)

    def self_test(self):
        """Actuate the proof masses and judge the response, by the part's own formulas.

        Run it at rest; it takes 0.4 to 0.7 s. Returns (passed, changes). changes: six ints for accel x y z and gyro
        x y z, the difference of the response from the factory's in per mille, or None if the part has no factory
        value. passed is None when there is no value at all.

        MPU6050: within 14 % (PS 6.1, 6.2). MPU6500 family: gyro at least half, accelerometer half to
        one and a half times the factory's, or absolute limits without one, and a gyro offset within 20
        deg/s (AN-MPU-9250A-03). Needs mpu_selftest.py. Afterwards the configuration is as before.
        Raises the driver's own error for a bus fault.
        """
        self._need_configured()
        from upright import mpu_selftest  # only here: most programs never run it

        try:
            self._stop()
            return mpu_selftest.run(self)
        finally:
            self._stop()
            self.table.apply()
            if self.fifo.on:
                self.fifo.drop()
            self._settle()

    def sleep(self):
        """Stop sampling (about 5 uA, PS 6.3) until wake(); the configuration stays."""
        self._need_configured()
        self.table.set(_PWR_MGMT_1, _CLK_PLL | _SLEEP)

    def wake(self):
        """Sample again, after the gyro's start-up time."""
        self._need_configured()
        self.table.set(_PWR_MGMT_1, _CLK_PLL)
        self._settle()
        if self.fifo.on:
            self.fifo.drop()  # drop the samples that came while the gyro settled

    def configuration(self):
        """The configuration as a list of (register, value), in the order in which it is written."""
        return [row[:2] for row in self.table.rows()]

    # Set-up for a device on this chip's auxiliary bus

    def set_rows(self, rows):
        """Configure registers; health() then checks them and a repair restores them.

        rows: (register, value, mask); mask has the bits that are compared. They are written in this order and read
        back. A register that is in the table already keeps its place. A new one comes before USER_CTRL, which starts
        FIFO and master. configure() removes them.

        In FIFO mode the contents of the FIFO are dropped. If the rows change what a slave reads, call attach() again.
        Raises error_class for a bus fault and for a register that does not keep its value.
        """
        self._need_configured()
        if self.fifo.on:
            self.fifo.drop()
        self.table.merge(rows)

    def set_user_ctrl(self, bits, mask):
        """Change the bits of mask in USER_CTRL, for example I2C_MST_EN (0x20), also on the chip."""
        self._need_configured()
        self.table.change_last(bits, mask)
        self.table.set(_USER_CTRL, self.table.last())

    def set_bypass(self, on=True):
        """Connect the auxiliary bus to the chip's own I2C bus, or separate them (I2C_BYPASS_EN, RM 4.14).

        A magnetometer behind the chip then answers on the bus of the microcontroller. It stays so after configure(),
        and health() restores it after a reset of the chip. Raises ValueError on SPI, and error_class while an
        AuxiliaryBus is in use.
        """
        if self.port.interface:
            raise ValueError("bypass needs the chip on I2C; on SPI use an AuxiliaryBus")
        if on and self._configured and self.master_enabled:
            raise self.error_class("the auxiliary master is on: configure() ends that")
        self.bypass = bool(on)
        if self._configured:
            row = self.table.numbers.find(bytes((_INT_PIN_CFG,)))
            value = self.table.values[row] & ~_I2C_BYPASS_EN
            self.table.set(_INT_PIN_CFG, value | self._bypass_bit())

    def _bypass_bit(self):
        return _I2C_BYPASS_EN if self.bypass else 0

    @property
    def master_enabled(self):
        """Whether set_user_ctrl() has enabled the auxiliary master."""
        return bool(self.table.last() & _I2C_MST_EN)

    def attach(self, device, length, fifo_en=0x01):
        """Fetch `length` bytes (0 to 24) from EXT_SENS_DATA_00 on, in the same burst as the sample.

        In FIFO mode they follow the gyro in each packet. fifo_en names the slaves in FIFO_EN (SLV0 0x01, SLV1 0x02,
        SLV2 0x04), which must be set up to read `length` bytes in all. device has

            take(raw, at, counts)   called after a fresh sample: raw[at] to raw[at + length - 1] are its
                                    bytes; fills counts[6] to counts[8], returns the flags to add: 2 or 0
            health()                called by every second health() while the chip has no fault

        Neither may allocate or raise. attach(None, 0) ends it. In FIFO mode this restarts the FIFO, with fewer packets
        in a batch if it holds fewer. If the packets have another length, it raises error_class and FIFO mode ends.
        """
        if not 0 <= length <= _EXT_BYTES:
            raise ValueError(f"length {length!r} is not 0 to {_EXT_BYTES}")
        if device is not None:
            self._need_configured()
        fifo = self.fifo
        on = fifo.on
        fifo.stop()
        self._hand_on_to(None)  # never with buffers of another length
        self._length_behind(length, fifo_en)
        self._hand_on_to(device)
        if on:
            self.fifo_enable(min(fifo.batch, fifo.size // fifo.packet))

    # Its parts

    def _hand_on_to(self, device):
        self.aux_device = self.fifo.device = None
        self.monitor.attach(device)
        self.aux_device = self.fifo.device = device

    def _length_behind(self, length, fifo_en):
        """Make buffers for samples with so many bytes behind them."""
        self.fifo.packet = _PACKET + length
        self._fifo_bits = _FIFO_ALL | (fifo_en & 0x07 if length else 0)
        self._raw = make_buffer(_PACKET + length)
        self._trust(not self._always)

    def _measure_packet(self):
        """Raise error_class unless a sample brings as many bytes as attach() was told."""
        wait_ms = 5 + 2000 * self.sample_rate[1] // self.sample_rate[0]
        packet = self.fifo.packet
        level = 0
        two = bytearray(2)
        for _ in range(3):
            self.fifo.restart()
            begun = time.ticks_ms()
            level = 0
            while level < packet and time.ticks_diff(time.ticks_ms(), begun) <= wait_ms:
                self.registers.read_registers(_FIFO_COUNTH, two)
                level = two[0] << 8 | two[1]
            if level == packet:
                return
        raise self.error_class(
            f"a sample does not put {packet} bytes into the FIFO (last count {level}): do "
            "the slaves of attach() read as many bytes as it was told?"
        )

    def _adopt(self, found):
        """Take over the properties of the part that was found."""
        self.who_am_i, part = found
        self.monitor.who_am_i = self.who_am_i
        self.chip, self.family_6500, self.fifo.size, self._temperature = part

    def _reset(self):
        """DEVICE_RESET; waits for it, and raises the driver's own error if it does not end."""
        registers = self.registers
        for _ in range(3):
            try:
                self._stop()
                registers.write(_PWR_MGMT_1, _DEVICE_RESET)
                break
            except OSError:
                # perhaps the chip released the bus as it reset: writing again is safe
                time.sleep_ms(1)
        time.sleep_ms(100)  # what the register maps ask for after DEVICE_RESET
        for _ in range(10):
            try:
                if not registers.read_register(_PWR_MGMT_1) & _DEVICE_RESET:
                    return
            except OSError:
                pass
            # late after a slow supply ramp: the family's registers may take another 100 ms
            time.sleep_ms(10)
        raise self.error_class(f"chip {self.port.where} did not come out of reset")

    def _stop(self):
        """FIFO and auxiliary master off.

        The master may be running even before the first configure(), because a reset of the board does not reset the
        chip. A transaction that is interrupted (also by the chip's reset) can hang the device on its bus (RM-6500
        4.33). The master finishes a transaction if its slots are disabled first.
        """
        if self.read_register(_USER_CTRL) & _I2C_MST_EN:
            for control in _SLV_CTRL:
                self.write_register(control, 0)
            time.sleep_ms(_MASTER_MS)
        self.write_register(_USER_CTRL, self.port.interface)

    def _probe_part(self):
        """Find out what the identity does not tell, after a reset."""
        if self._temperature is None:
            asleep = self.read_register(_PWR_MGMT_1) & _SLEEP
            self.family_6500, self._temperature = mpu_parts.of_unknown(self.family_6500, asleep)
        self._own_accel_filter = self.family_6500
        if self.family_6500:
            self.write_register(_PWR_MGMT_1, _CLK_PLL)
            self.write_register(_ACCEL_CONFIG2, 0x05)
            if self.read_register(_ACCEL_CONFIG2) & 0x0F != 0x05:
                self._own_accel_filter = False
                self.remarks.append("(it has no ACCEL_CONFIG2)")

    def _learn_habits(self, period_ms):
        """Wait as _settle() does, and find out meanwhile how the chip says that it has sampled."""
        registers = self.registers
        # Without its bit in INT_ENABLE no part of the family may set DATA_RDY (RM 4.15, 4.16); some do.
        registers.write_register(_INT_ENABLE, 0)
        raw = self._raw
        registers.read_registers(_INT_STATUS, self._burst)
        time.sleep_ms(max(self.settle_ms - 1, period_ms + 1))
        registers.read_registers(_INT_STATUS, self._burst)
        always = raw[_STATUS] & _DATA_RDY
        registers.write_register(_INT_ENABLE, _DATA_RDY)
        if always:
            self._trust(False)
            self._tell("(it sets DATA_RDY without INT_ENABLE)")
        begun = time.ticks_ms()
        while True:
            registers.read_registers(self._first, self._burst)
            if raw[_STATUS] & _DATA_RDY:
                break
            if time.ticks_diff(time.ticks_ms(), begun) > 2 * period_ms + 5:
                # after its reset only a chip that samples has anything here
                self._by_time = self._has_words(raw)
                break
            time.sleep_us(200)
        if self._by_time:
            self._tell("(it never sets DATA_RDY: going by time)")
            self.monitor.constant = not self._varies(period_ms)
            raw[_STATUS] = _DATA_RDY
            if self.monitor.constant:
                self._tell("(its samples never vary)")
        raw[_ODD] = _ODD_TAKEN
        if unpack(raw, _HEAD, self.counts):
            self.monitor.not_fresh()
        raw[_ODD] = 0
        self.monitor.heard()

    def _varies(self, period_ms):
        """Do the words change within eight samples, or a tenth of a second?"""
        first = bytes(self._raw[_HEAD:])
        for _ in range(min(8, 1 + 100 // period_ms)):
            time.sleep_ms(period_ms)
            self.registers.read_registers(self._first, self._burst)
            if bytes(self._raw[_HEAD:]) != first:
                return True
        return False

    def _trust(self, data_ready):
        """Does DATA_RDY prove that INT_ENABLE is set, and so that the chip was not reset? Else bursts begin there."""
        self._by_time = self.monitor.constant = False
        self._always = not data_ready
        self._first = _INT_STATUS if data_ready else _INT_ENABLE
        self._burst = memoryview(self._raw)[_STATUS if data_ready else _ENABLED :]
        self._raw[_ENABLED] = _DATA_RDY
        self.fifo.proof = _DATA_RDY if data_ready else 0

    def _tell(self, remark):
        if remark not in self.remarks:
            self.remarks.append(remark)

    def _has_words(self, raw):
        """Does the accelerometer measure anything? All zeros are no sample, but in free fall for a moment."""
        at = _HEAD
        return bool(raw[at] | raw[at + 1] | raw[at + 2] | raw[at + 3] | raw[at + 4] | raw[at + 5])

    def _settle(self):
        time.sleep_ms(self.settle_ms)
        # a sample that was ready meanwhile: accel() has it until there is a newer one
        raw = self._raw
        self.registers.read_registers(self._first, self._burst)
        raw[_ODD] = _ODD_TAKEN
        if unpack(raw, _HEAD, self.counts):
            self.monitor.not_fresh()
        raw[_ODD] = 0
        self.monitor.heard()

    def _need_configured(self):
        if not self._configured:
            raise self.error_class("configure() first")
