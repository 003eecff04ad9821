"""A bus on which anything may happen, and plans of what does."""

from hypothesis import strategies as st

delays = st.one_of(st.integers(0, 3000), st.integers(60_000, 90_000), st.integers(0, 300_000))
faults = st.one_of(
    st.none(),
    st.none(),
    st.tuples(st.just("nack"), st.integers(0, 3)),
    st.tuples(st.just("cut"), st.integers(0, 112)),
    st.tuples(st.just("brown"), st.integers(0, 112)),
)
plans = st.lists(st.tuples(delays, st.sampled_from([0, 25, 300]), faults), max_size=40)


class Hostile:
    """A bus on which anything may happen: `plan` has, for each transaction in turn, (delay before
    it, per byte, fault).

    fault: None; ("nack", n) refuses the n-th acknowledge; ("cut", n) fails after n bytes read;
    ("brown", n) lets the supply dip before byte n of a read. swallows: as on rp2, see machine.py.
    """

    def __init__(self, chip, now, plan, swallows=False):
        self.chip, self.now, self.plan = chip, now, list(plan)
        self.swallows = swallows

    def _begin(self):
        delay, per_byte, fault = self.plan.pop() if self.plan else (500, 25, None)
        self.now += delay
        self.per_byte = per_byte
        kind, n = fault or (None, 0)
        if kind == "nack":
            self.chip.nack_next(1, after=n)
        return kind, n

    def _sent(self, ack):
        self.now += self.per_byte
        if not ack:
            self.chip.i2c_stop(self.now)
            raise OSError(5)

    def readfrom_mem_into(self, address, register, buffer):
        kind, n = self._begin()
        self._sent(self.chip.i2c_start(False, self.now))
        taken = self.chip.i2c_write(register, self.now)
        if not taken and self.swallows:
            self.chip.i2c_stop(self.now)
            return
        self._sent(taken)
        self._sent(self.chip.i2c_start(True, self.now))
        for i in range(len(buffer)):
            if kind == "cut" and i == n:
                self.chip.i2c_stop(self.now)
                raise OSError(110)
            if kind == "brown" and i == n:
                self.chip.brown_out(self.now)
            buffer[i] = self.chip.i2c_read(self.now)
            self.now += self.per_byte
        self.chip.i2c_stop(self.now)

    def writeto(self, address, buffer):
        self._begin()
        self._sent(self.chip.i2c_start(False, self.now))
        for byte in buffer:
            taken = self.chip.i2c_write(byte, self.now)
            if not taken and self.swallows:
                break
            self._sent(taken)
        self.chip.i2c_stop(self.now)
