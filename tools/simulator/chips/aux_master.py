# The auxiliary I2C master of the MPU6050 and the MPU6500: five slots that carry on transactions with
# the chips on AUX_DA and AUX_CL, once a sample. Part of the chip models; portable (CPython, MicroPython).
# RM is RM-MPU-6000A rev 4.2; the sections of RM-MPU-6500A rev 2.1 say the same unless noted.

from micropython import const

_FIFO_EN = const(0x23)
_I2C_MST_CTRL = const(0x24)
_SLV0_ADDR = const(0x25)  # then REG and CTRL, three registers a slot
_SLV4_ADDR = const(0x31)  # then REG, DO, CTRL, DI
_SLV4_DO = const(0x33)
_SLV4_CTRL = const(0x34)
_SLV4_DI = const(0x35)
_SLV0_DO = const(0x63)
_DELAY_CTRL = const(0x67)
_EXT_SENS_DATA = const(0x49)
_EXT_BYTES = const(24)

_EN = const(0x80)
_BYTE_SW = const(0x40)
_REG_DIS = const(0x20)
_GRP = const(0x10)

SLV4_DONE = 0x40  # I2C_MST_STATUS, RM 4.13
LOST_ARB = 0x20
SLV4_NACK = 0x10  # and bits 3..0: SLV3_NACK..SLV0_NACK

# What I2C_MST_CLK divides 8 MHz by (RM 4.7): an eighth of it is the microseconds of one bit
_DIVIDERS = (23, 24, 25, 26, 27, 28, 29, 30, 31, 16, 17, 18, 19, 20, 21, 22)


class AuxMaster:
    """The master's state machine; its registers are those of the chip that it is part of.

    slaves           chip models on the auxiliary bus (they speak the I2C side of the protocol)
    status           I2C_MST_STATUS; reading it over the bus clears it (RM 4.13)
    cut              transactions that were cut off in the middle
    late             samples that came while the transactions of the one before were under way
    done_with_nack   SLV4_DONE comes with SLV4_NACK too (the register map does not say; this is
                     worse for a driver that looks at one bit only)

    Not simulated: other masters, I2C_MST_INT, pass-through, the difference between a stop and a
    repeated start between two reads (I2C_MST_P_NSR).
    """

    def __init__(self, chip):
        self.slaves = []
        self.cut = 0
        self.late = 0
        self.done_with_nack = True
        self._chip = chip
        self._run = None
        self._talking = None
        self._hung = False
        self.reset()

    def reset(self):
        """Power-on reset: all of its registers are 0."""
        self.status = 0
        self.on = False
        self.active = False  # on, with a slot enabled: every sample has something to do
        self._ext = bytearray(_EXT_BYTES)  # the internal set of RM 4.20
        self._complete = bytearray(_EXT_BYTES)  # the same at the end of the last cycle
        self._changed = False
        self._now = 0
        self._forget()

    def _forget(self):
        self._places = [-1, -1, -1, -1]
        self._turn = 0
        self._waiting = None
        self._run = None
        self.next_us = None  # when the next byte is through, None while idle

    def clear_data(self):
        """SIG_COND_RESET clears the sensor registers (RM 4.27)."""
        self._ext[:] = bytes(_EXT_BYTES)
        self._complete[:] = self._ext
        self._changed = True

    # What the chip tells it

    def stop(self, now, why):
        """Switched off or reset, in the middle of a transaction if one is under way.

        RM 4.27 of I2C_MST_RESET: in an active transaction the slave will hang. why: what the driver
        did; None: not its fault.
        """
        slave = self._talking
        if self._run is not None:
            self._run.close()
        if slave is not None:
            self._talking = None
            self.cut += 1
            if why:
                self._chip._misused(why + " in the middle of an auxiliary transaction")
            if hasattr(slave, "bus_cut"):
                slave.bus_cut(now)
                self._hung = True
        self._forget()

    def configured(self, registers, on):
        """Its registers or I2C_MST_EN have changed."""
        enabled = False
        for at in range(_SLV0_ADDR + 2, _SLV4_ADDR, 3):
            enabled = enabled or registers[at] & _EN
        if not enabled:
            # RM 4.20: places are worked out anew only when all slaves are disabled, or at a reset
            self._places = [-1, -1, -1, -1]
            self._turn = 0
        self.on = on
        self.active = bool(on and (enabled or registers[_SLV4_CTRL] & _EN))
        self._changed = True

    def sample(self, at, packet=None):
        """The chip has taken a sample; packet: what goes into the FIFO before the slaves' bytes."""
        if self._run is None:
            self._begin(at, packet)
            return
        # RM 4.8 leaves it to the user that all fits into a sample. What happens else is not said;
        # here the next cycle begins late, and of several that wait only the last one is left.
        self.late += 1
        self._chip._misused("auxiliary transactions do not fit into the sample period")
        self._waiting = (packet,)

    def begin_anew(self):
        """A recorded trial begins, and is the same whatever came before: slots with a delay run with its first row."""
        if self._run is not None:
            self._run.close()
        self._run = self._talking = self._waiting = self.next_us = None
        self._turn = 0
        for slave in self.slaves:
            if hasattr(slave, "begin_anew"):
                slave.begin_anew()

    def skip(self, n):
        """n samples pass without a look at them."""
        self._turn += n

    def advance(self, now):
        """Carry the transactions on up to `now`."""
        self._now = now
        while self.next_us is not None and self.next_us <= now:
            self._step()

    # The cycle

    def _begin(self, at, packet):
        self._packet = packet
        self._run = self._cycle(at)
        self._step()

    def _step(self):
        try:
            self.next_us = next(self._run)
            return
        except StopIteration:
            pass
        self._run = None
        self.next_us = None
        self._complete[:] = self._ext
        self._chip._cycle_done(self._end, self._packet)
        if self._waiting is not None:
            packet = self._waiting[0]
            self._waiting = None
            self._begin(self._end, packet)

    def _cycle(self, base):
        """All slots in their order, from `base` on (RM 4.8).

        A generator: runs as far as `_now` reaches and yields when the next byte will be through, so
        that a gap is caught up at once and the host may still come in between any two bytes.
        """
        r = self._chip._registers
        turn = self._turn
        self._turn = turn + 1
        clock = _DIVIDERS[r[_I2C_MST_CTRL] & 15]
        bits = 0
        for n in range(5):
            address = r[_SLV0_ADDR + 3 * n]
            if n < 4:
                control = r[_SLV0_ADDR + 3 * n + 2]
                length = control & 15
                out = r[_SLV0_DO + n]
            else:
                control = r[_SLV4_CTRL]
                length = 1
                out = r[_SLV4_DO]
            if not control & _EN or not length:
                continue
            reading = address & 0x80
            place = self._place(n, r) if reading and n < 4 else 0
            # RM 4.12, 4.25: slots with their delay bit run every 1 + I2C_MST_DLY samples
            if r[_DELAY_CTRL] >> n & 1 and turn % (1 + (r[_SLV4_CTRL] & 0x1F)):
                continue
            register = r[_SLV0_ADDR + 3 * n + 1]
            sent = [] if control & _REG_DIS else [register]
            if not reading:
                sent.extend([out] * length)
            slave = self._find(address & 0x7F)
            self._talking = slave if slave is not None else self
            if self._hung:
                self._hung = self._any_hung()  # a reset may have ended it
            going = True
            if sent:
                bits += 10  # start, address, acknowledge
                at = base + (bits * clock >> 3)
                if at > self._now:
                    yield at
                going = slave is not None and not self._hung and slave.i2c_start(False, at)
                for byte in sent:
                    if not going:
                        break
                    bits += 9
                    at = base + (bits * clock >> 3)
                    if at > self._now:
                        yield at
                    going = slave.i2c_write(byte, at)
            if going and reading:
                bits += 10
                at = base + (bits * clock >> 3)
                if at > self._now:
                    yield at
                going = slave is not None and not self._hung and slave.i2c_start(True, at)
                if going:
                    ext = self._ext
                    for i in range(length):
                        bits += 9
                        at = base + (bits * clock >> 3)
                        if at > self._now:
                            yield at
                        value = slave.i2c_read(at)
                        if n == 4:
                            r[_SLV4_DI] = value
                            continue
                        if control & _BYTE_SW:
                            i = _swapped(i, register, length, control & _GRP)
                        if place + i < _EXT_BYTES:  # RM 4.20: excess bytes are dropped
                            ext[place + i] = value
                            self._changed = True
            bits += 1
            at = base + (bits * clock >> 3)
            if at > self._now:
                yield at
            self._talking = None
            if self._hung:
                self._clock_free(at)
            else:
                if slave is not None:
                    slave.i2c_stop(at)
                if not going:
                    self.status |= 1 << n
            if n == 4:
                r[_SLV4_CTRL] &= ~_EN
                if going or self.done_with_nack:
                    self.status |= SLV4_DONE
                self.configured(r, self.on)
        self._end = base + (bits * clock >> 3)

    def _find(self, address):
        for slave in self.slaves:
            if slave.address == address:
                return slave
        return None

    def _clock_free(self, at):
        """A slave that was cut off holds the data line: arbitration is lost to it. The clocks of
        this try let most slaves finish the byte that they are stuck in."""
        self.status |= LOST_ARB
        for slave in self.slaves:
            if hasattr(slave, "bus_clocked"):
                slave.bus_clocked(at)

    def _any_hung(self):
        for slave in self.slaves:
            if hasattr(slave, "hung") and slave.hung:
                return True
        return False

    # EXT_SENS_DATA

    def _place(self, n, r):
        """Where slot n's bytes begin: in slave order, as it was when the first of them was read."""
        places = self._places
        if places[n] < 0:
            end = 0
            fresh = max(places) < 0
            for m in range(4):
                at = _SLV0_ADDR + 3 * m
                if fresh and r[at] & 0x80 and r[at + 2] & _EN:
                    places[m] = end
                if places[m] >= 0:
                    if m > n and not fresh:
                        self._chip._misused("a slave was enabled below one that has its place")
                    end = max(end, places[m] + (r[at + 2] & 15))
            if not fresh:
                places[n] = end
        return places[n]

    def show(self, registers):
        """RM 4.20: the registers follow the internal set while the serial interface is idle.

        Byte by byte, so that a burst in the middle of the transactions mixes two samples; unless
        DELAY_ES_SHADOW (RM 4.25) holds them back until all are in.
        """
        if self._changed:
            self._changed = self._run is not None
            delayed = registers[_DELAY_CTRL] & 0x80
            data = self._complete if delayed else self._ext
            registers[_EXT_SENS_DATA : _EXT_SENS_DATA + _EXT_BYTES] = data

    def fifo_bytes(self, registers):
        """What the slots with a FIFO bit add to a packet (RM 4.6; SLV3: RM 4.7)."""
        packet = bytearray()
        for n in range(4):
            wanted = registers[_FIFO_EN] & 1 << n if n < 3 else registers[_I2C_MST_CTRL] & 0x20
            control = registers[_SLV0_ADDR + 3 * n + 2]
            if wanted and control & _EN and registers[_SLV0_ADDR + 3 * n] & 0x80:
                place = self._places[n]
                for i in range(place, place + (control & 15)):
                    packet.append(self._ext[i] if 0 <= i < _EXT_BYTES else 0)
        return packet


def _swapped(i, register, length, group):
    """Where byte i goes. RM 4.8: pairs go by the slave's register addresses, even-odd or (GRP)
    odd-even; a byte without its partner stays."""
    odd = 1 if group else 0
    partner = ((register + i - odd) ^ 1) + odd - register
    return partner if 0 <= partner < length else i
