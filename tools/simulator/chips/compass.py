# What the simulated magnetometers AK8963, HMC5883L and QMC5883L share: the I2C side and the measurement of the world.
# Needs a world to measure (world.py) and a bus that calls it byte by byte: a board's, or the auxiliary bus of an MPU
# (aux_master.py). Portable: CPython and the MicroPython unix port.

from chips.common import Faults
from chips.ist8310 import _inverse

# Words 6..8 of a world's row are in counts of 3.3 per uT, as an IST8310's
WORLD_LSB_PER_UT = (33, 10)


class Compass(Faults):
    """A magnetometer on an I2C bus.

    world  what it measures
    axes   the board's map of the magnetometer: body x, y, z as "x", "-y", ... of the chip. Undone here, so that a board
           with the same map gets the world's field back

    measurements counts those that were finished. A subclass has _power_on_reset(), _get() and _set() of one register,
    _next(), the register after one in a burst, and _finish() of the measurement that ends at _done_us.
    """

    int_level = 0  # its DRDY pin: not simulated
    reset_us = 100  # after a soft reset: no answer

    def __init__(self, world, address, axes, now):
        self._init_faults(now)
        self.world = world
        self.address = address
        self.measurements = 0
        self.measure_us = None  # a number here is the time of every measurement
        self._from_body = _inverse(axes)
        self._pointer = 0
        self._pointing = False
        self._done_us = None
        self._power_on_reset()

    def poll(self, now):
        """Catch up with time."""
        if now > self._now:
            self._now = now
        while self._done_us is not None and self._now >= self._done_us:
            at = self._done_us
            self._done_us = None
            self.measurements += 1
            self._finish(at)

    def next_event(self):
        return None

    def _field(self, at, lsb, per):
        """What it measures at a time, in the chip's axes, lsb / per counts per uT."""
        row = self.world.row(self.world.index_at(at))
        num, den = lsb * WORLD_LSB_PER_UT[1], per * WORLD_LSB_PER_UT[0]
        return [
            (2 * sign * row[6 + word] * num + den) // (2 * den) for word, sign in self._from_body
        ]

    def _put(self, register, value, big_endian):
        high, low = value >> 8 & 0xFF, value & 0xFF
        first, second = (high, low) if big_endian else (low, high)
        self._registers[register] = first
        self._registers[register + 1] = second

    # I2C

    def i2c_start(self, read, now):
        self.poll(now)
        if not self._acknowledge():
            return False
        self._pointing = not read
        return True

    def i2c_write(self, byte, now):
        self.poll(now)
        if not self._acknowledge():
            return False
        if self._pointing:
            self._pointer = byte
            self._pointing = False
            return True
        if self.log is not None:
            self.log.append((self._now, self._pointer, byte))
        self._set(self._pointer, byte)
        self._pointer = self._next(self._pointer)
        return True

    def i2c_read(self, now):
        self.poll(now)
        if self._gone or self._now < self._dead_until:
            return 0xFF
        at = self._pointer
        self._pointer = self._next(at)
        value = self._get(at) if at < len(self._registers) else 0
        return self._stuck.get(at, value)

    def i2c_stop(self, now):
        self.poll(now)

    def _next(self, register):
        return (register + 1) & 0xFF


def clipped(value, limit):
    return -limit if value < -limit else limit if value > limit else value
