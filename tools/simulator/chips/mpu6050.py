# A simulated MPU6050, and the parts of its family that answer on I2C: registers, clock, FIFO, INT pin.
# Needs a world to sample (world.py) and a bus that calls it byte by byte; knows no machine mock.
# Portable: CPython and the MicroPython unix port. RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A rev 3.4.
# One file, and so long, because every part of it hangs on the same registers.

from micropython import const

from chips.aux_master import AuxMaster
from chips.common import PacketFifo
from chips.dmp import Dmp
from chips.mpu_sensors import GYRO_START_US, Sensors

_SMPLRT_DIV = const(0x19)
_CONFIG = const(0x1A)
_FIFO_EN = const(0x23)
_I2C_MST_CTRL = const(0x24)
_SLV4_CTRL = const(0x34)
_SLV4_DI = const(0x35)
_I2C_MST_STATUS = const(0x36)
_INT_PIN_CFG = const(0x37)
_INT_ENABLE = const(0x38)
_INT_STATUS = const(0x3A)
_ACCEL_XOUT_H = const(0x3B)
_MST_DELAY_CTRL = const(0x67)
_SIGNAL_PATH_RESET = const(0x68)
_USER_CTRL = const(0x6A)
_PWR_MGMT_1 = const(0x6B)
_BANK_SEL = const(0x6D)
_MEM_START_ADDR = const(0x6E)
_MEM_R_W = const(0x6F)
_FIFO_COUNTH = const(0x72)
_FIFO_COUNTL = const(0x73)
_FIFO_R_W = const(0x74)
_WHO_AM_I = const(0x75)

_DATA_RDY = const(0x01)
_FIFO_OFLOW = const(0x10)

_PULSE_US = const(50)  # RM 4.14, LATCH_INT_EN = 0
# FIFO_EN bit of each of the words of 0x3B..0x48 (RM 4.6); packets are in register order all the same (RM 4.31)
_FIFO_BITS = (0x08, 0x08, 0x08, 0x80, 0x40, 0x20, 0x10)


def _gcd(a, b):
    while b:
        a, b = b, a % b
    return a


class MPU6050Chip(Sensors):
    """One chip on an I2C bus.

    world           what it measures: rows of counts, see world.py
    address         7 bits
    who_am_i        its identity; anything but 0x68 behaves as one of the MPU6500 family: awake after
                    reset, a FIFO of 512 bytes, another temperature scale
    trims           factory self-test codes of accel x y z and gyro x y z, 0..31 (RM 4.1); of the
                    MPU6500 family 0..255 (RM-MPU-6500A 4.1, 4.2); None: some
    clock_ppm       error of the clock when the gyro PLL drives it (PS 7.15: within 1 %)
    oscillator_ppm  the same for the internal oscillator, which runs after reset
    fifo_byte_us    time between two bytes of a packet on its way into the FIFO; 0: all at once
    dmp_dead        how its DMP is broken, see Dmp; that of 0x98 is "silent" unless another fault is named

    Its attributes: aux, the list of chip models on its auxiliary bus; master, the AuxMaster that
    speaks with them; dmp, the Dmp; misuse and log, see Faults.

    The digital low-pass filter sets rates only: it does not filter what the world gives. Not
    simulated: cycle mode, motion interrupts, the DMP's interrupt, FSYNC, offset registers.
    """

    # The datasheets say only what a driver must allow, 100 ms; this is less, to be changed at will
    reset_us = 20_000  # after DEVICE_RESET: writes are ignored, bit 7 of PWR_MGMT_1 reads 1
    _rate_registers = (_SMPLRT_DIV, _CONFIG)

    def __init__(
        self,
        world,
        address=0x68,
        who_am_i=0x68,
        trims=None,
        clock_ppm=0,
        oscillator_ppm=20_000,
        fifo_byte_us=0,
        dmp_dead=None,
        now=0,
    ):
        self._init_faults(now)
        self.world = world
        self.address = address
        self.family_6500 = self._of_6500(who_am_i)
        self.fifo = PacketFifo(self._fifo_size(), fifo_byte_us)
        self.trims = trims or self._some_trims()
        self.broken = ()  # axes (0..5: accel x y z, gyro x y z) that do not react to self-test
        self.int_level = 0
        self.master = AuxMaster(self)
        self.aux = self.master.slaves
        # RM-MPU-6500A: FIFO and DMP share 4 KB; the 6050 has 12 banks (InvenSense's motion driver 6.12)
        fault = dmp_dead or ("silent" if who_am_i == 0x98 else None)
        self.dmp = Dmp(self, 4096 - 512 if self.family_6500 else 3072, fault)
        self._identity = who_am_i
        self._ppm = (oscillator_ppm, clock_ppm)
        self._reset_until = 0
        self._busy = False
        self._pointer = 0
        self._pointing = False
        self._power_on_reset()

    # What clones do in another way (mpu_clone.py)

    def _of_6500(self, who_am_i):
        return who_am_i != 0x68

    def _fifo_size(self):
        return 512 if self.family_6500 else 1024

    # Observation, for tests; faults are in Faults

    @property
    def fifo_count(self):
        return self.fifo.count

    def jam(self):
        """Until the next reset no sample is taken, while every register answers as before."""
        self._next_us = None

    @property
    def awake(self):
        """Sampling: not asleep, and with a clock (CLKSEL 7 stops it, RM 4.28)."""
        return not self._registers[_PWR_MGMT_1] & 0x40 and self._registers[_PWR_MGMT_1] & 7 != 7

    @property
    def sample_us(self):
        """When the newest sample was taken, absolute microseconds."""
        return self._sample_us

    # Reset

    def _power_on_reset(self):
        # RM 3: every register 0 but PWR_MGMT_1 and WHO_AM_I; RM-MPU-6500A 3: PWR_MGMT_1 = 1
        self._registers = bytearray(128)
        self._registers[_PWR_MGMT_1] = 0x01 if self.family_6500 else 0x40
        self._registers[_WHO_AM_I] = self._identity
        self._factory_values()
        self._words = [0] * 7
        self._shown = None  # the words that the registers 0x3B..0x48 hold
        self._latched = True
        self._sample_row = 0
        self._status = 0
        self._pulse_end = 0
        self._i2c_disabled = False
        self.fifo.clear()
        self.master.stop(self._now, None)
        self.master.reset()
        self.dmp.reset()
        self._restart_clock()
        self._wake_us = self._now - (0 if self.awake else GYRO_START_US)
        self._drive_int()

    # The sample clock

    def _restart_clock(self):
        """Sampling starts anew now: at reset, on waking, and when the rate changes."""
        rate, divider = self._rate()
        ppm = self._ppm[1 if self._registers[_PWR_MGMT_1] & 7 else 0]
        num, den = divider * 1_000_000_000_000, rate * (1_000_000 + ppm)
        g = _gcd(num, den)
        self._period = (num // g, den // g)
        self._epoch = self._now
        self._start_us = self.world.start_us
        self._done = 0
        self._sample_us = self._now
        if self._driven():
            self._done = self._count(self._now)
        self._next_us = self._time(self._done + 1)
        self.fifo.packet = None
        self._quiet_until = 0

    def _rate(self):
        """Gyro output rate in Hz and what it is divided by (RM 4.2)."""
        r = self._registers
        fast = r[_CONFIG] & 7 in (0, 7)  # 8 kHz without the filter, else 1 kHz
        # RM-MPU-6500A 4.4: there the divider works with the filter only
        divider = 1 if self.family_6500 and fast else 1 + r[_SMPLRT_DIV]
        return 8000 if fast else 1000, divider

    def _accel_us(self):
        """RM 4.2: the accelerometer's output rate is 1 kHz, faster samples repeat it."""
        return 1000

    def _driven(self):
        """True when a recorded trial sets the times of the samples: its row k is chip sample k."""
        return self.world.clocked and self.world.start_us is not None

    def _count(self, now):
        """Number of samples since the epoch that exist at `now`."""
        if self._driven():
            us = now - self.world.start_us
            return self.world.index(us) + 1 if us >= 0 else 0
        num, den = self._period
        return (now - self._epoch) * den // num

    def _time(self, k):
        """Absolute time of the k-th sample (1, 2, ...), None after the end of a trial."""
        if self._driven():
            return None if k > self.world.n else self.world.start_us + self.world.time_us(k - 1)
        num, den = self._period
        return self._epoch - (-k * num // den)

    def poll(self, now):
        """Catch up with time; samples that nobody can see any more are skipped."""
        if now > self._now:
            self._now = now
        if now >= self._quiet_until or self._start_us != self.world.start_us:
            self._catch_up()

    def _catch_up(self):
        now = self._now
        if self._start_us != self.world.start_us:
            # the world started to move: a trial drives the clock from its first row on
            self._start_us = self.world.start_us
            if self._driven():
                self._settle_words()
                self._done = 0
                self.master.begin_anew()
                self._next_us = self._time(1)
        running = self.awake and now >= self._reset_until and now >= self._dead_until
        if running:
            if self.fifo.packet is not None:
                self._push_packet()
            if self._next_us is not None and now >= self._next_us:
                self._new_samples(self._count(now))
                self._next_us = self._time(self._done + 1)
        master = self.master
        if master.next_us is not None:
            master.advance(now)
        self._drive_int()
        # until when nothing happens of its own accord: most accesses need no more than this
        quiet = now + 1_000_000
        if self.fifo.packet is not None or (self.awake and not running):
            quiet = now
        elif running and self._next_us is not None:
            quiet = min(quiet, self._next_us)
        if master.next_us is not None:
            quiet = min(quiet, master.next_us)
        if now < self._pulse_end:
            quiet = min(quiet, self._pulse_end)
        self._quiet_until = quiet

    def _new_samples(self, total):
        r = self._registers
        master = self.master
        fifo_on = r[_USER_CTRL] & 0x40 and (r[_FIFO_EN] or r[_I2C_MST_CTRL] & 0x20)
        dmp = self.dmp
        if fifo_on or master.active or dmp.running:
            slaves = fifo_on and master.active and (r[_FIFO_EN] & 7 or r[_I2C_MST_CTRL] & 0x20)
            first = self._done + 1
            jump_at = first + (2 if master.active else 0)
            jump = 0 if dmp.running else self._idle_samples(total - jump_at + 1, fifo_on)
            k = first
            while k <= total:
                if k == jump_at and jump:
                    k += jump
                    master.skip(jump)
                self._done = k
                self._sample_us = self._time(k)
                self._sample_row = self._row_index(self._sample_us, k)
                packet = None
                if dmp.running:
                    self._words = self._measure()
                    packet = dmp.sample(self._sample_row)
                    if packet and r[_USER_CTRL] & 0x40:
                        self._queue_packet(self._sample_us, packet)
                    packet = None
                if fifo_on:
                    self._words = self._measure()
                    packet = self._packet()
                    if packet and not slaves:
                        self._queue_packet(self._sample_us, packet)
                        packet = None
                if master.active:
                    master.advance(self._sample_us)
                    master.sample(self._sample_us, packet)
                k += 1
        self._done = total
        self._sample_us = self._time(total)
        self._sample_row = self._row_index(self._sample_us, total)
        self._latched = False
        # RM 4.7, WAIT_FOR_ES: not before the slaves' data are in
        if not (r[_I2C_MST_CTRL] & 0x40 and master.next_us is not None):
            self._data_ready(self._sample_us)

    def _idle_samples(self, n, fifo_on):
        """How many of n samples that come in a long gap need no work: what the FIFO would push out
        again has overflowed, and the auxiliary bus is back in step long before the last 1024."""
        keep = 1024 if self.master.active else 0
        if fifo_on:
            length = self._packet_length()
            if self._fifo_stops() or not length:
                return 0
            keep = max(keep, self.fifo.size // length + 2)
            if n > keep:
                self.fifo.skip((n - keep) * length)
                self._fifo_overflow()
        return max(0, n - keep)

    def _cycle_done(self, at, packet):
        """The auxiliary transactions of a sample are through."""
        if packet is not None:
            packet.extend(self.master.fifo_bytes(self._registers))
            if packet and self._registers[_USER_CTRL] & 0x40:
                self._queue_packet(at, packet)
        if self._registers[_I2C_MST_CTRL] & 0x40:
            self._data_ready(at)

    def _data_ready(self, at):
        if self._registers[_INT_ENABLE] & _DATA_RDY:
            self._status |= _DATA_RDY
            self._pulse_end = at + _PULSE_US

    def next_event(self):
        """Absolute time in us of the next change of the interrupt pin that the chip makes by
        itself, or None."""
        r = self._registers
        latching = r[_INT_PIN_CFG] & 0x20
        if not latching and self._now < self._pulse_end:
            return self._pulse_end
        if not r[_INT_ENABLE] & _DATA_RDY or not self.awake or (latching and self._status):
            return None
        if r[_I2C_MST_CTRL] & 0x40 and self.master.next_us is not None:
            return self.master.next_us
        return self._next_us

    def _drive_int(self):
        # RM 4.14: INT_LEVEL 1 = active low; LATCH_INT_EN 1 = held until cleared, else a 50 us pulse
        config = self._registers[_INT_PIN_CFG]
        active = self._status if config & 0x20 else self._now < self._pulse_end
        self.int_level = int(active != 0) ^ (config >> 7)

    # What it measures

    def _row_index(self, us, k):
        if self._driven():
            return k - 1
        if self.world.start_us is None:
            return 0
        return self.world.index(us - self.world.start_us)

    def _settle_words(self):
        """Compute the newest sample's words under the configuration that it was taken with."""
        if not self._latched:
            self._words = self._measure()
            self._latched = True

    def _shadow(self):
        """RM 4.17: the registers follow the internal set while the bus is idle, so one burst is one
        sample."""
        self._settle_words()
        self.master.show(self._registers)
        if self._shown is self._words:
            return
        self._shown = self._words
        at = _ACCEL_XOUT_H
        for word in self._words:
            self._registers[at] = word >> 8 & 0xFF
            self._registers[at + 1] = word & 0xFF
            at += 2

    # FIFO

    def _fifo_stops(self):
        """FIFO_MODE (CONFIG bit 6, MPU6500 family only): when full, new bytes are refused."""
        return self.family_6500 and self._registers[_CONFIG] & 0x40

    def _fifo_overflow(self):
        if self._registers[_INT_ENABLE] & _FIFO_OFLOW:
            if not self._status & _FIFO_OFLOW:
                self._pulse_end = self._now + _PULSE_US
            self._status |= _FIFO_OFLOW

    def _packet(self):
        packet = bytearray()
        for i in range(7):
            if self._registers[_FIFO_EN] & _FIFO_BITS[i]:
                packet.append(self._words[i] >> 8 & 0xFF)
                packet.append(self._words[i] & 0xFF)
        return packet

    def _packet_length(self):
        length = len(self.master.fifo_bytes(self._registers)) if self.master.active else 0
        for bit in _FIFO_BITS:
            length += 2 if self._registers[_FIFO_EN] & bit else 0
        return length

    def _queue_packet(self, at, packet):
        self.fifo.start(at, packet)
        self._push_packet()

    def _push_packet(self):
        if self.fifo.fill(self._now, self._fifo_stops()):
            self._fifo_overflow()

    # Registers

    def _get(self, register):
        """Read one register with its side effects."""
        r = self._registers
        if register == _FIFO_R_W:
            value = self.fifo.pop()
        elif register == _INT_STATUS:
            value = self._status
            self._status = 0
        elif register == _FIFO_COUNTH:
            self.fifo.shadow = self.fifo.count  # RM 4.30: latches both bytes
            value = self.fifo.shadow >> 8
        elif register == _FIFO_COUNTL:
            value = self.fifo.shadow & 0xFF
        elif register == _MEM_R_W:
            value = self.dmp.read()
        elif register == _I2C_MST_STATUS:
            value = self.master.status
            self.master.status = 0  # RM 4.13: reading clears it
        else:
            value = r[register]
        if register == _PWR_MGMT_1 and self._now < self._reset_until:
            value |= 0x80
        if r[_INT_PIN_CFG] & 0x10:  # INT_RD_CLEAR: any read clears (RM 4.14)
            self._status = 0
        self._drive_int()
        return self._stuck.get(register, value)

    def _set(self, register, value):
        """Write one register with its side effects."""
        r = self._registers
        if _INT_STATUS <= register <= 0x60 or _FIFO_COUNTH <= register <= _FIFO_COUNTL:
            return  # read only
        if register in (_WHO_AM_I, _I2C_MST_STATUS, _SLV4_DI):
            return
        if register == _PWR_MGMT_1 and value & 0x80:
            self._plain = False
            self.master.stop(self._now, "DEVICE_RESET")
            self._power_on_reset()
            self._reset_until = self._now + self.reset_us
            return
        if register == _FIFO_R_W:
            if self.fifo.push(value, self._fifo_stops()):
                self._fifo_overflow()
            return
        if register == _MEM_R_W:
            self.dmp.write(value)
            return
        self._settle_words()
        self._quiet_until = 0
        old = r[register]
        if register == _USER_CTRL:
            value = self._user_ctrl(value)
        elif register == _SIGNAL_PATH_RESET:
            value = 0  # RM 4.26: resets the analogue paths only; the registers stay
        r[register] = value
        if _BANK_SEL <= register <= _MEM_START_ADDR:
            self.dmp.point(register, value)
        elif register == _PWR_MGMT_1:
            if old & 0x40 and not value & 0x40:
                self._wake_us = self._now
            if (old ^ value) & 0x47:
                self._restart_clock()
        elif register in self._rate_registers and old != value:
            self._restart_clock()
        elif _I2C_MST_CTRL <= register <= _SLV4_CTRL or register in (_USER_CTRL, _MST_DELAY_CTRL):
            self.master.configured(r, r[_USER_CTRL] & 0x20)
        self._drive_int()

    def _user_ctrl(self, value):
        self._i2c_if_dis(value & 0x10)
        master = self.master
        if master.on and not value & 0x20:
            master.stop(self._now, "I2C_MST_EN cleared")
        if value & 0x02:
            # RM 4.27: I2C_MST_RESET works while I2C_MST_EN equals 0; the RM-MPU-6500A has no such
            # condition
            if value & 0x20 and not self.family_6500:
                self._misused("I2C_MST_RESET with I2C_MST_EN set")
            else:
                master.stop(self._now, "I2C_MST_RST")
        if value & 0x04:
            # RM 4.27: the same of FIFO_RESET and FIFO_EN
            if value & 0x40 and not self.family_6500:
                self._misused("FIFO_RESET with FIFO_EN set")
            else:
                self.fifo.clear()
        if not value & 0x40:
            self.fifo.packet = None
        if value & 0x01:  # SIG_COND_RESET clears the sensor registers
            self._words = [0] * 7
            master.clear_data()
        self.dmp.control(value)
        return value & ~0x0F  # the reset bits clear themselves

    def _i2c_if_dis(self, bit):
        if bit:
            self._misused("I2C_IF_DIS set on an I2C part")
            self._i2c_disabled = self.family_6500

    # I2C

    def behind(self, address):
        """The chip on the auxiliary bus that answers on this one in bypass (RM 4.14: I2C_MST_EN must be 0), or None."""
        r = self._registers
        if self._gone or not r[_INT_PIN_CFG] & 0x02 or r[_USER_CTRL] & 0x20:
            return None
        for chip in self.aux:
            if chip.address == address:
                return chip
        return None

    def i2c_start(self, read, now):
        self.poll(now)
        if self._i2c_disabled or not self._acknowledge():
            self._busy = False
            return False
        if not self._busy:
            self._shadow()
            self._busy = True
        self._pointing = not read
        self._plain = not self._stuck and not self._registers[_INT_PIN_CFG] & 0x10
        return True

    def i2c_write(self, byte, now):
        self.poll(now)
        if self._i2c_disabled or not self._acknowledge():
            self._busy = False
            return False
        if self._pointing:
            self._pointer = byte & 0x7F
            self._pointing = False
            return True
        if self._now >= self._reset_until:
            if self.log is not None:
                self.log.append((self._now, self._pointer, byte))
            self._set(self._pointer, byte)
        self._advance()
        return True

    def i2c_read(self, now):
        if now < self._quiet_until:
            self._now = now
        else:
            self.poll(now)
        if self._plain:
            # the bulk of all traffic, taken straight: sensor registers and FIFO
            at = self._pointer
            if _ACCEL_XOUT_H <= at <= 0x60:
                self._pointer = at + 1
                return self._registers[at]
            if at == _FIFO_R_W:
                return self.fifo.pop()
        if self._gone or self._now < self._dead_until:
            return 0xFF  # nobody pulls the line down
        value = self._get(self._pointer)
        self._advance()
        return value

    def i2c_stop(self, now):
        if now >= self._quiet_until:
            self.poll(now)
        self._busy = False

    def _advance(self):
        # bursts step through the registers, but stay on the FIFO and on the DMP memory port
        if self._pointer not in (_FIFO_R_W, _MEM_R_W):
            self._pointer = (self._pointer + 1) & 0x7F
