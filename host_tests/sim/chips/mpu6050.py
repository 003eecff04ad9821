# A simulated MPU6050, and the parts of its family that answer on I2C: registers, clock, FIFO, INT pin.
# Needs a world to sample (world.py) and a bus that calls it byte by byte; knows no machine mock.
# Portable: CPython and the MicroPython unix port. RM is RM-MPU-6000A rev 4.2, PS PS-MPU-6000A rev 3.4.
# One file, and so long, because every part of it hangs on the same registers.

from micropython import const

_SELF_TEST_X = const(0x0D)
_SMPLRT_DIV = const(0x19)
_CONFIG = const(0x1A)
_GYRO_CONFIG = const(0x1B)
_ACCEL_CONFIG = const(0x1C)
_FIFO_EN = const(0x23)
_INT_PIN_CFG = const(0x37)
_INT_ENABLE = const(0x38)
_INT_STATUS = const(0x3A)
_ACCEL_XOUT_H = const(0x3B)
_SIGNAL_PATH_RESET = const(0x68)
_USER_CTRL = const(0x6A)
_PWR_MGMT_1 = const(0x6B)
_PWR_MGMT_2 = const(0x6C)
_MEM_R_W = const(0x6F)
_FIFO_COUNTH = const(0x72)
_FIFO_COUNTL = const(0x73)
_FIFO_R_W = const(0x74)
_WHO_AM_I = const(0x75)

_DATA_RDY = const(0x01)
_FIFO_OFLOW = const(0x10)

# LSB per deg/s as a ratio, RM 4.19; LSB per g, RM 4.17
_GYRO_SCALES = ((131, 1), (131, 2), (164, 5), (82, 5))
_ACCEL_LSB = (16384, 8192, 4096, 2048)

_PULSE_US = const(50)  # RM 4.14, LATCH_INT_EN = 0
_GYRO_START_US = const(30_000)  # PS 6.1, zero-rate output within 1 deg/s of its final value
_GYRO_START_DPS = const(20)  # PS 6.1, initial zero-rate output tolerance
# Where in a world's row (ax ay az gx gy gz mx my mz temp) the words of 0x3B..0x48 stand
_ORDER = (0, 1, 2, 9, 3, 4, 5)
# FIFO_EN bit of each of those words (RM 4.6); packets are in register order all the same (RM 4.31)
_FIFO_BITS = (0x08, 0x08, 0x08, 0x80, 0x40, 0x20, 0x10)


def _gcd(a, b):
    while b:
        a, b = b, a % b
    return a


def _scaled(value, num, den):
    """value * num / den, rounded half up and saturated like the chip's 16-bit output."""
    value = (2 * value * num + den) // (2 * den)
    return -32768 if value < -32768 else 32767 if value > 32767 else value


class MPU6050Chip:
    """One chip on an I2C bus.

    world           what it measures: rows of counts, see world.py
    address         7 bits
    who_am_i        its identity; anything but 0x68 behaves as one of the MPU6500 family: awake after
                    reset, a FIFO of 512 bytes, another temperature scale
    trims           factory self-test codes of accel x y z and gyro x y z, 0..31 (RM 4.1)
    clock_ppm       error of the clock when the gyro PLL drives it (PS 7.15: within 1 %)
    oscillator_ppm  the same for the internal oscillator, which runs after reset
    fifo_byte_us    time between two bytes of a packet on its way into the FIFO; 0: all at once

    The digital low-pass filter sets rates only: it does not filter what the world gives. Not
    simulated: the auxiliary bus, cycle mode, motion interrupts, the DMP, FSYNC, offset registers.
    """

    # The datasheets say only what a driver must allow, 100 ms; these are less, to be changed at will
    reset_us = 20_000  # after DEVICE_RESET: writes are ignored, bit 7 of PWR_MGMT_1 reads 1
    power_up_us = 20_000  # after power-up: no answer

    def __init__(
        self,
        world,
        address=0x68,
        who_am_i=0x68,
        trims=(16, 14, 18, 15, 17, 13),
        clock_ppm=0,
        oscillator_ppm=20_000,
        fifo_byte_us=0,
        now=0,
    ):
        self.world = world
        self.address = address
        self.family_6500 = who_am_i != 0x68
        self.fifo_size = 512 if self.family_6500 else 1024
        self.fifo_byte_us = fifo_byte_us
        self.trims = trims
        self.broken = ()  # axes (0..5: accel x y z, gyro x y z) that do not react to self-test
        self.misuse = []  # what a driver did that the register map forbids
        self.log = None  # a list here receives (now, register, value) of every write
        self.int_level = 0
        self._identity = who_am_i
        self._ppm = (oscillator_ppm, clock_ppm)
        self._stuck = {}
        self._nack_skip = 0
        self._nacks = 0
        self._gone = False
        self._dead_until = 0
        self._reset_until = 0
        self._now = now
        self._busy = False
        self._pointer = 0
        self._pointing = False
        self._plain = False
        self._power_on_reset()

    # Faults and observation, for tests

    def nack_next(self, n=1, after=0):
        """Let `after` acknowledges (of address and written bytes) pass, then refuse n."""
        self._nack_skip = after
        self._nacks = n

    def vanish(self):
        """A broken wire: nothing is acknowledged and the clock runs on unseen."""
        self._gone = True
        self._plain = False

    def come_back(self):
        self._gone = False

    def brown_out(self, now=None):
        """The supply dips: power-on reset in flight, then silence for power_up_us."""
        self.poll(self._now if now is None else now)
        self._power_on_reset()
        self._dead_until = self._now + self.power_up_us
        self._plain = False

    def stick(self, register, value=None):
        """Reading the register always gives value; None mends it."""
        self._plain = False
        if value is None:
            self._stuck.pop(register, None)
        else:
            self._stuck[register] = value

    def register(self, register):
        """What is in a register, without the side effects of reading it over the bus."""
        return self._registers[register]

    def poke(self, register, value):
        """Change a register behind the driver's back."""
        self.poll(self._now)
        self._set(register, value)

    @property
    def fifo_count(self):
        return self._fifo_count

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
        ax, ay, az, gx, gy, gz = self.trims
        if not self.family_6500:
            at = _SELF_TEST_X
            self._registers[at] = (ax >> 2) << 5 | gx
            self._registers[at + 1] = (ay >> 2) << 5 | gy
            self._registers[at + 2] = (az >> 2) << 5 | gz
            self._registers[at + 3] = (ax & 3) << 4 | (ay & 3) << 2 | (az & 3)
        self._words = [0] * 7
        self._shown = None  # the words that the registers 0x3B..0x48 hold
        self._latched = True
        self._sample_row = 0
        self._status = 0
        self._pulse_end = 0
        self._i2c_disabled = False
        self._fifo = bytearray(self.fifo_size)
        self._fifo_last = 0
        self._fifo_clear()
        self._restart_clock()
        self._wake_us = self._now - (0 if self.awake else _GYRO_START_US)
        self._drive_int()

    # The sample clock

    def _restart_clock(self):
        """Sampling starts anew now: at reset, on waking, and when the rate changes."""
        r = self._registers
        dlpf = r[_CONFIG] & 7
        fast = dlpf in (0, 7)  # RM 4.2: gyro output rate 8 kHz without the filter, else 1 kHz
        rate = 8000 if fast else 1000
        # RM-MPU-6500A 4.4: there the divider works with the filter only
        divider = 1 if self.family_6500 and fast else 1 + r[_SMPLRT_DIV]
        ppm = self._ppm[1 if r[_PWR_MGMT_1] & 7 else 0]
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
        self._half_packet = None
        self._quiet_until = 0

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
                self._next_us = self._time(1)
        running = self.awake and now >= self._reset_until and now >= self._dead_until
        if running:
            if self._half_packet is not None:
                self._push_packet()
            if self._next_us is not None and now >= self._next_us:
                self._new_samples(self._count(now))
                self._next_us = self._time(self._done + 1)
        self._drive_int()
        # until when nothing happens of its own accord: most accesses need no more than this
        quiet = now + 1_000_000
        if self._half_packet is not None or (self.awake and not running):
            quiet = now
        elif running and self._next_us is not None:
            quiet = min(quiet, self._next_us)
        if now < self._pulse_end:
            quiet = min(quiet, self._pulse_end)
        self._quiet_until = quiet

    def _new_samples(self, total):
        r = self._registers
        first = self._done + 1
        if r[_USER_CTRL] & 0x40 and r[_FIFO_EN] & 0xF8:
            packet = 0
            for bit in _FIFO_BITS:
                packet += 2 if r[_FIFO_EN] & bit else 0
            # of a long gap only what still fits is worth computing; what it would have pushed out
            # has overflowed
            fit = self.fifo_size // packet + 2
            skipped = total - self._done - fit
            if skipped > 0 and not self._fifo_stops():
                first += skipped
                self._fifo_skip(skipped * packet)
            for k in range(first, total + 1):
                self._done = k
                self._sample_us = self._time(k)
                self._sample_row = self._row_index(self._sample_us, k)
                self._words = self._measure()
                self._half_packet = (self._sample_us, self._packet(), 0)
                self._push_packet()
        self._done = total
        self._sample_us = self._time(total)
        self._sample_row = self._row_index(self._sample_us, total)
        self._latched = False
        if r[_INT_ENABLE] & _DATA_RDY:
            self._status |= _DATA_RDY
            self._pulse_end = self._sample_us + _PULSE_US

    def next_event(self):
        """Absolute time in us of the next change of the interrupt pin that the chip makes by
        itself, or None."""
        r = self._registers
        latching = r[_INT_PIN_CFG] & 0x20
        if not latching and self._now < self._pulse_end:
            return self._pulse_end
        if not r[_INT_ENABLE] & _DATA_RDY or not self.awake or (latching and self._status):
            return None
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

    def _measure(self):
        """The seven words (accel x y z, temperature, gyro x y z) of the newest sample."""
        r = self._registers
        world = self.world
        us = self._sample_us
        row = world.row(self._sample_row)
        words = [row[i] for i in _ORDER]
        if not self._driven() and self._period[0] < 1000 * self._period[1]:
            # RM 4.2: the accelerometer's output rate is 1 kHz, faster samples repeat it
            row = world.row(self._row_index(us - (us - self._epoch) % 1000, 0))
            words[:3] = [row[i] for i in _ORDER[:3]]
        accel = _ACCEL_LSB[r[_ACCEL_CONFIG] >> 3 & 3]
        gyro_num, gyro_den = _GYRO_SCALES[r[_GYRO_CONFIG] >> 3 & 3]
        world_num, world_den = world.gyro_scale
        gyro_num, gyro_den = gyro_num * world_den, gyro_den * world_num
        for i in range(3):
            if accel != world.accel_lsb_per_g:
                words[i] = _scaled(words[i], accel, world.accel_lsb_per_g)
            if gyro_num != gyro_den:
                words[4 + i] = _scaled(words[4 + i], gyro_num, gyro_den)
        self._self_test(words, accel)
        unsettled = self._wake_us + _GYRO_START_US - us
        if unsettled > 0:
            num, den = _GYRO_SCALES[r[_GYRO_CONFIG] >> 3 & 3]
            for i in (4, 5, 6):
                offset = _GYRO_START_DPS * num * unsettled // (den * _GYRO_START_US)
                words[i] = _scaled(words[i] + offset, 1, 1)
        if self.family_6500:
            # world rows carry the MPU6050's temperature word, raw / 340 + 36.53
            lsb, zero = (32680, 2500) if self._identity == 0x98 else (33387, 2100)
            words[3] = _scaled(100 * words[3] + 340 * (3653 - zero), lsb, 340 * 10_000)
        old = self._words
        standby = r[_PWR_MGMT_2]
        for i in range(3):
            if standby & (0x20 >> i):
                words[i] = old[i]
            if standby & (0x04 >> i):
                words[4 + i] = old[4 + i]
        if r[_PWR_MGMT_1] & 0x08:  # TEMP_DIS
            words[3] = old[3]
        return words

    def _self_test(self, words, accel_lsb):
        """Add what the actuated proof masses put out: the factory trim, RM 4.1 (in LSB at +-8 g and
        +-250 deg/s)."""
        r = self._registers
        bits = r[_ACCEL_CONFIG] >> 5, r[_GYRO_CONFIG] >> 5
        if not (bits[0] or bits[1]):
            return
        for axis in range(3):
            n = self.trims[axis]
            if bits[0] & (4 >> axis) and axis not in self.broken:
                response = 4096 * 0.34 * (0.92 / 0.34) ** ((n - 1) / 30) if n else 0.5 * 4096
                words[axis] = _scaled(words[axis] + int(response * accel_lsb / 4096), 1, 1)
            n = self.trims[3 + axis]
            if bits[1] & (4 >> axis) and 3 + axis not in self.broken:
                response = 25 * 131 * 1.046 ** (n - 1) if n else 50 * 131
                num, den = _GYRO_SCALES[r[_GYRO_CONFIG] >> 3 & 3]
                response = int(response * num / (den * 131))
                if axis == 1:
                    response = -response
                words[4 + axis] = _scaled(words[4 + axis] + response, 1, 1)

    def _settle_words(self):
        """Compute the newest sample's words under the configuration that it was taken with."""
        if not self._latched:
            self._words = self._measure()
            self._latched = True

    def _shadow(self):
        """RM 4.17: the registers follow the internal set while the bus is idle, so one burst is one
        sample."""
        self._settle_words()
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

    def _fifo_clear(self):
        self._fifo_head = 0
        self._fifo_count = 0
        self._fifo_shadow = 0
        self._half_packet = None

    def _fifo_skip(self, n):
        """n bytes went in that later ones push out again."""
        self._fifo_head = (self._fifo_head + n) % self.fifo_size
        self._fifo_overflow()

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

    def _push_packet(self):
        """Write as much of the packet under way as time allows."""
        start, packet, written = self._half_packet
        there = len(packet)
        if self.fifo_byte_us:
            there = min(there, (self._now - start) // self.fifo_byte_us + 1)
        while written < there:
            self._fifo_push(packet[written])
            written += 1
        self._half_packet = (start, packet, written) if written < len(packet) else None

    def _fifo_push(self, byte):
        size = self.fifo_size
        if self._fifo_count == size:
            # RM 4.31: the oldest data are lost, so the first packet left has lost its beginning
            self._fifo_overflow()
            if self._fifo_stops():
                return
            self._fifo_head = (self._fifo_head + 1) % size
            self._fifo_count -= 1
        self._fifo[(self._fifo_head + self._fifo_count) % size] = byte
        self._fifo_count += 1

    def _fifo_pop(self):
        if self._fifo_count:
            self._fifo_last = self._fifo[self._fifo_head]
            self._fifo_head = (self._fifo_head + 1) % self.fifo_size
            self._fifo_count -= 1
        return self._fifo_last  # RM 4.31: empty, it returns the last byte again

    # Registers

    def _get(self, register):
        """Read one register with its side effects."""
        r = self._registers
        if register == _FIFO_R_W:
            value = self._fifo_pop()
        elif register == _INT_STATUS:
            value = self._status
            self._status = 0
        elif register == _FIFO_COUNTH:
            self._fifo_shadow = self._fifo_count  # RM 4.30: latches both bytes
            value = self._fifo_shadow >> 8
        elif register == _FIFO_COUNTL:
            value = self._fifo_shadow & 0xFF
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
        if register in (_WHO_AM_I, 0x36):
            return
        if register == _PWR_MGMT_1 and value & 0x80:
            self._plain = False
            self._power_on_reset()
            self._reset_until = self._now + self.reset_us
            return
        if register == _FIFO_R_W:
            self._fifo_push(value)
            return
        self._settle_words()
        self._quiet_until = 0
        old = r[register]
        if register == _USER_CTRL:
            value = self._user_ctrl(value)
        elif register == _SIGNAL_PATH_RESET:
            value = 0  # RM 4.26: resets the analogue paths only; the registers stay
        r[register] = value
        if register == _PWR_MGMT_1:
            if old & 0x40 and not value & 0x40:
                self._wake_us = self._now
            if (old ^ value) & 0x47:
                self._restart_clock()
        elif register in (_SMPLRT_DIV, _CONFIG) and old != value:
            self._restart_clock()
        self._drive_int()

    def _user_ctrl(self, value):
        if value & 0x10:  # I2C_IF_DIS
            self.misuse.append("I2C_IF_DIS set on an I2C part")
            self._i2c_disabled = self.family_6500
        if value & 0x04:
            # RM 4.27: FIFO_RESET works while FIFO_EN equals 0; the RM-MPU-6500A has no such
            # condition
            if value & 0x40 and not self.family_6500:
                self.misuse.append("FIFO_RESET with FIFO_EN set")
            else:
                self._fifo_clear()
        if not value & 0x40:
            self._half_packet = None
        if value & 0x01:  # SIG_COND_RESET clears the sensor registers
            self._words = [0] * 7
        return value & ~0x07  # the reset bits clear themselves

    # I2C

    def _acknowledge(self):
        if self._gone or self._i2c_disabled or self._now < self._dead_until:
            return False
        if self._nacks:
            if self._nack_skip:
                self._nack_skip -= 1
            else:
                self._nacks -= 1
                return False
        return True

    def i2c_start(self, read, now):
        self.poll(now)
        if not self._acknowledge():
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
        if not self._acknowledge():
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
                return self._fifo_pop()
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
