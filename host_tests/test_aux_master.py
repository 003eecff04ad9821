"""The simulated auxiliary I2C master of the MPU6050 and the MPU6500, and the traps that a driver falls into."""

from itertools import pairwise

import pytest
from bare_bus import Bus, Ramp, Spi
from chips.ist8310 import IST8310Chip
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from world import StillWorld

SMPLRT_DIV, FIFO_EN, I2C_MST_CTRL, INT_PIN_CFG, INT_ENABLE, INT_STATUS = (
    0x19,
    0x23,
    0x24,
    0x37,
    0x38,
    0x3A,
)
SLV4_ADDR, SLV4_REG, SLV4_DO, SLV4_CTRL, SLV4_DI, I2C_MST_STATUS = range(0x31, 0x37)
ACCEL_XOUT_H, EXT_SENS_DATA, MST_DELAY_CTRL = 0x3B, 0x49, 0x67
USER_CTRL, PWR_MGMT_1, FIFO_COUNTH, FIFO_R_W = 0x6A, 0x6B, 0x72, 0x74
MST_EN, MST_RST, IF_DIS = 0x20, 0x02, 0x10
KHZ_400, P_NSR, WAIT_FOR_ES, SHADOW = 13, 0x10, 0x40, 0x80
READ, EN, SW, REG_DIS, GRP = 0x80, 0x80, 0x40, 0x20, 0x10
DONE, LOST_ARB, NACK4 = 0x40, 0x20, 0x10
ADDRESS = 0x1E


class Slave:
    """Register r holds r; notes every transaction as (when it ended, what was written, bytes read)."""

    def __init__(self, address=ADDRESS, value=None):
        self.address = address
        self.value = value  # a number: what all registers hold
        self.there = True
        self.transactions = []
        self.cuts = 0

    def i2c_start(self, read, now):
        if self.there and not read:
            self.written = []
        if self.there and read:
            self.read = 0
        return self.there

    def i2c_write(self, byte, now):
        self.written.append(byte)
        return self.there

    def i2c_read(self, now):
        self.read += 1
        value = self.written[0] + self.read - 1 if self.written else 0xEE
        return (value if self.value is None else self.value) & 0xFF

    def i2c_stop(self, now):
        if self.there:
            self.transactions.append((now, tuple(self.written), self.read))
        self.written, self.read = [], 0

    written, read = (), 0


class Host:
    """A chip that is awake at 1 kHz, its master at 400 kHz on one slave; over I2C or SPI."""

    def __init__(self, kind="mpu6500", slaves=None, world=None, hz=KHZ_400, divider=0, **options):
        self.slave = Slave()
        world = world or StillWorld()
        if kind == "mpu6050":
            self.bus = Bus(MPU6050Chip(world, **options))
            self.user_ctrl = 0
        else:
            self.bus = Spi(MPU6500Chip(world, **options))
            self.user_ctrl = IF_DIS
        self.chip = self.bus.chip
        self.chip.aux.extend([self.slave] if slaves is None else slaves)
        self.write, self.read = self.bus.write, self.bus.read
        self.bus.now = 100_000
        self.write(USER_CTRL, self.user_ctrl)
        self.write(PWR_MGMT_1, 0x01)
        self.write(SMPLRT_DIV, divider, 1, 0x18, 0x10)
        self.write(I2C_MST_CTRL, hz | P_NSR)
        self.write(MST_DELAY_CTRL, SHADOW)
        self.on()
        self.epoch = self.now  # the sample clock starts with the last change of the rate

    @property
    def now(self):
        return self.bus.now

    def run(self, us):
        self.bus.now += us
        self.chip.poll(self.bus.now)

    def on(self, more=0):
        self.write(USER_CTRL, self.user_ctrl | MST_EN | more)

    def off(self, more=0):
        self.write(USER_CTRL, self.user_ctrl | more)

    def slot(self, n, register=0, length=1, address=ADDRESS, control=0, out=None):
        """Slot n reads, or writes `out`."""
        if out is not None:
            self.write(0x63 + n, out)
        at = 0x25 + 3 * n
        self.write(at, address | (READ if out is None else 0), register, EN | control | length)

    def disable(self, *slots):
        for n in slots:
            self.write(0x27 + 3 * n, 0)

    def slv4(self, register, out=None, address=ADDRESS, delay=0):
        if out is not None:
            self.write(SLV4_DO, out)
        self.write(SLV4_ADDR, address | (READ if out is None else 0), register)
        self.write(SLV4_CTRL, EN | delay)

    def ext(self, n=24):
        return self.read(EXT_SENS_DATA, n)


@pytest.fixture(params=["mpu6050", "mpu6500"])
def host(request):
    return Host(request.param)


# Slots 0 to 3


def test_slots_run_once_a_sample_and_their_bytes_lie_in_slave_order(host):
    host.slot(2, 0x30, 1)
    host.slot(0, 0x10, 4)
    host.slot(3, 0x40, 3)
    host.slot(1, 0x20, 2, out=7)
    host.run(5800)
    assert host.ext(9) == bytes((0x10, 0x11, 0x12, 0x13, 0x30, 0x40, 0x41, 0x42, 0))
    what = [(written, read) for _, written, read in host.slave.transactions]
    assert what == [((0x10,), 4), ((0x20, 7, 7), 0), ((0x30,), 1), ((0x40,), 3)] * 5
    assert host.chip.misuse == []


@pytest.mark.parametrize("clock, hz", [(13, 400_000), (0, 347_826), (8, 258_065), (9, 500_000)])
def test_a_transaction_takes_its_bus_time(clock, hz):
    host = Host(hz=clock)
    host.slot(0, 0x10, 7)
    host.run(3700)
    bits = 10 + 9 + 10 + 7 * 9 + 1
    times = [at for at, _, _ in host.slave.transactions]
    assert all(abs((at - host.epoch) % 1000 - bits * 1_000_000 / hz) <= 1 for at in times)
    assert len(times) == 3


def test_bytes_arrive_one_by_one_without_the_shadow(host):
    host.write(MST_DELAY_CTRL, 0)
    host.slot(0, 0x10, 2)
    host.run(1000 + 92)
    assert host.ext(2) == b"\0\0"
    host.run(4)  # 38 bits
    assert host.ext(2) == b"\x10\0"
    host.run(23)
    assert host.ext(2) == b"\x10\x11"


@pytest.mark.parametrize("shadow, torn", [(0, True), (SHADOW, False)])
def test_a_burst_in_the_middle_of_the_transactions_is_torn_without_the_shadow(host, shadow, torn):
    host.write(MST_DELAY_CTRL, shadow)
    host.slot(0, 0, 6)
    host.slave.value = 1
    host.run(1500)
    host.slave.value = 2
    host.run(500 + 142)
    seen = set(host.ext(6))
    assert seen == ({1, 2} if torn else {1})
    host.run(100)
    assert set(host.ext(6)) == {2}


def test_delayed_slots_run_every_so_many_samples_and_the_others_every_one(host):
    host.write(MST_DELAY_CTRL, SHADOW | 0x02)
    host.write(SLV4_CTRL, 3)
    host.slot(0, 0x10, 1)
    host.slot(1, 0x0A, out=1)
    host.run(16_000)
    periods = {}
    for register in (0x10, 0x0A):
        times = [at for at, written, _ in host.slave.transactions if written[0] == register]
        periods[register] = {b - a for a, b in pairwise(times)}
    assert periods == {0x10: {1000}, 0x0A: {4000}}  # 3 means every fourth, not the eighth


def test_slv4_enabled_with_a_bare_0x80_wipes_the_delay_of_all(host):
    host.write(MST_DELAY_CTRL, SHADOW | 0x02)
    host.write(SLV4_CTRL, 9)
    host.slot(1, 0x0A, out=1)
    runs = []
    for delay in (9, 0):
        host.run(20_500)
        host.slave.transactions.clear()
        host.slv4(0x00, delay=delay)
        host.run(20_500)
        runs.append([t[1][0] for t in host.slave.transactions].count(0x0A))
    assert runs == [2, 20]


def test_a_slot_of_length_0_does_nothing(host):
    host.slot(0, 0x10, 0)
    host.run(5000)
    assert host.slave.transactions == []


@pytest.mark.parametrize(
    "register, length, control, expected",
    [
        (0x10, 4, 0, (0x10, 0x11, 0x12, 0x13)),
        (0x10, 4, SW, (0x11, 0x10, 0x13, 0x12)),
        (0x11, 4, SW | GRP, (0x12, 0x11, 0x14, 0x13)),
        (0x11, 4, SW, (0x11, 0x13, 0x12, 0x14)),  # the first and the last have no partner
        (0x10, 3, SW, (0x11, 0x10, 0x12)),
    ],
)
def test_byte_swap_pairs_by_the_slaves_register_addresses(
    host, register, length, control, expected
):
    host.slot(0, register, length, control=control)
    host.run(2000)
    assert host.ext(length) == bytes(expected)


def test_reg_dis_sends_no_register_address(host):
    host.slot(0, 0x10, 2, control=REG_DIS)
    host.slot(1, 0x20, out=5, control=REG_DIS)
    host.run(1500)
    assert [t[1:] for t in host.slave.transactions] == [((), 2), ((5,), 0)]
    assert host.ext(2) == b"\xee\xee"


def test_what_exceeds_24_bytes_is_dropped(host):
    host.slot(0, 0x10, 15)
    host.slot(1, 0x40, 15)
    host.run(2000)
    assert host.ext(24) == bytes(range(0x10, 0x1F)) + bytes(range(0x40, 0x49))


# Places in EXT_SENS_DATA


def test_places_stay_until_all_slaves_are_disabled(host):
    host.slot(0, 0x10, 2)
    host.slot(1, 0x20, 2)
    host.run(2000)
    host.disable(0)
    host.run(2000)
    assert host.ext(4) == bytes((0x10, 0x11, 0x20, 0x21))  # slot 1 has not moved up
    host.slot(0, 0x10, 3)
    host.run(2000)
    assert host.ext(4) == bytes((0x10, 0x11, 0x20, 0x21))  # and the third byte is written over
    host.disable(0, 1)
    host.slot(0, 0x10, 3)
    host.slot(1, 0x20, 2)
    host.run(2000)
    assert host.ext(5) == bytes((0x10, 0x11, 0x12, 0x20, 0x21))


def test_a_slave_enabled_below_one_that_has_its_place_is_noted(host):
    host.slot(1, 0x20, 2)
    host.run(2000)
    host.slot(0, 0x10, 2)
    host.run(2000)
    assert host.ext(4) == bytes((0x20, 0x21, 0x10, 0x11))
    assert host.chip.misuse


def test_i2c_mst_rst_works_the_places_out_anew(host):
    host.slot(0, 0x10, 2)
    host.slot(1, 0x20, 2)
    host.run(1500)
    host.disable(0)
    host.off(MST_RST)
    host.on()
    host.run(2000)
    assert host.ext(2) == bytes((0x20, 0x21))
    assert host.chip.misuse == []


# Nobody there


def test_a_slave_that_does_not_answer_leaves_stale_bytes_and_its_nack_bit(host):
    host.slot(0, 0x10, 2)
    host.slot(2, 0x30, 2)
    host.run(1500)
    assert host.read(I2C_MST_STATUS) == 0
    host.slave.there = False
    host.run(1500)
    assert host.ext(4) == bytes((0x10, 0x11, 0x30, 0x31))
    assert host.read(I2C_MST_STATUS) == 0x05
    assert host.read(I2C_MST_STATUS) == 0  # reading has cleared it


def test_another_address_does_not_answer(host):
    host.slot(1, 0x10, 2, address=ADDRESS ^ 1)
    host.run(1500)
    assert host.read(I2C_MST_STATUS) == 0x02
    assert host.slave.transactions == []


# Slot 4


def test_slot_4_reads_one_byte_once(host):
    host.slot(0, 0x10, 4)
    host.run(1500)
    host.slv4(0x42)
    assert host.read(SLV4_CTRL) == EN and host.read(I2C_MST_STATUS) == 0
    host.run(600)
    assert host.read(I2C_MST_STATUS) == 0  # after slot 0, and 39 bits more
    host.run(200)
    assert host.read(I2C_MST_STATUS) == DONE
    assert host.read(I2C_MST_STATUS) == 0
    assert (host.read(SLV4_DI), host.read(SLV4_CTRL)) == (0x42, 0)
    host.run(5000)
    assert [t[1:] for t in host.slave.transactions].count(((0x42,), 1)) == 1
    assert host.ext(5) == bytes((0x10, 0x11, 0x12, 0x13, 0))


def test_slot_4_writes(host):
    host.slv4(0x42, out=0x99)
    host.run(2000)
    assert host.read(I2C_MST_STATUS) == DONE
    assert host.slave.transactions[0][1] == (0x42, 0x99)


def test_slot_4_runs_at_most_once_a_sample(host):
    times = []
    for _ in range(3):
        host.slv4(0x42)
        while not host.read(I2C_MST_STATUS):
            host.run(10)
        times.append(host.now)
    assert all(950 <= b - a <= 1050 for a, b in pairwise(times))


@pytest.mark.parametrize("done", [True, False])
def test_slot_4_notes_that_nobody_answered(host, done):
    host.chip.master.done_with_nack = done
    host.slv4(0x42)
    host.run(2000)
    assert host.read(SLV4_DI) == 0x42
    host.slave.there = False
    host.read(I2C_MST_STATUS)
    host.slv4(0x43)
    host.run(2000)
    assert host.read(I2C_MST_STATUS) == (NACK4 | DONE if done else NACK4)
    assert (host.read(SLV4_CTRL), host.read(SLV4_DI)) == (0, 0x42)  # the byte of the time before


def test_slot_4_follows_slot_0_and_its_own_delay_bit(host):
    host.write(MST_DELAY_CTRL, SHADOW | 0x10)
    host.slot(0, 0x10, 1)
    host.write(SLV4_CTRL, 3)
    host.run(1500)  # the first of four samples
    host.slv4(0x42, delay=3)
    host.run(3000)
    assert host.read(I2C_MST_STATUS) == 0
    host.run(1000)
    assert host.read(I2C_MST_STATUS) == DONE


# When it runs


def test_it_runs_only_while_the_chip_samples_and_it_is_enabled(host):
    host.slot(0, 0x10, 1)
    host.off()
    host.run(5000)
    assert host.slave.transactions == []
    host.on()
    host.write(PWR_MGMT_1, 0x41)
    host.run(5000)
    assert host.slave.transactions == []
    host.write(PWR_MGMT_1, 0x01)
    host.run(5500)
    assert len(host.slave.transactions) == 5


def test_it_follows_the_sample_rate(host):
    host.write(SMPLRT_DIV, 4)
    host.slot(0, 0x10, 1)
    host.run(50_500)
    assert len(host.slave.transactions) == 10


def test_each_row_of_a_recorded_trial_is_a_sample():
    world = Ramp(n=20, rate=(200, 1))
    host = Host(world=world)
    host.slot(0, 0x10, 1)
    host.run(1000)
    before = len(host.slave.transactions)
    start = host.now + 300
    world.start(start)
    host.run(500)
    before = len(host.slave.transactions) - 1
    host.run(1_000_000)
    times = [at for at, _, _ in host.slave.transactions[before:]]
    assert len(times) == 20
    assert [(at - start) // 5000 for at in times] == list(range(20))


def test_a_device_reset_stops_it_and_clears_its_registers(host):
    host.slot(0, 0x10, 1)
    host.run(1500)
    host.write(PWR_MGMT_1, 0x80)
    host.run(100_000)
    assert host.read(0x27) == 0
    before = len(host.slave.transactions)
    host.on()
    host.run(10_000)
    assert len(host.slave.transactions) == before
    assert not [text for text in host.chip.misuse if "auxiliary" in text]


def test_transactions_that_do_not_fit_are_noted_and_late(host):
    for n in range(4):
        host.slot(n, 0x10, 15)
    host.run(20_000)  # 4 * 165 bits * 2.5 us
    assert host.chip.master.late
    assert host.chip.misuse == ["auxiliary transactions do not fit into the sample period"]
    times = [at for at, _, read in host.slave.transactions]
    assert all(410 <= b - a <= 415 for a, b in pairwise(times))
    host.disable(2, 3)
    host.run(5000)
    late = host.chip.master.late
    host.run(10_000)
    assert host.chip.master.late == late


def test_a_long_gap_leaves_what_short_steps_would_have_left(host):
    worlds = []
    for steps in (5000, 1):
        magnetometer = IST8310Chip(StillWorld((0, 0, 4096, 0, 0, 0, 1, 2, 3)))
        magnetometer.poke(0x42, 0xC0)
        host = Host(slaves=[magnetometer])
        host.write(MST_DELAY_CTRL, SHADOW | 2)
        host.write(SLV4_CTRL, 9)
        host.slot(0, 0x02, 7, address=0x0E)
        host.slot(1, 0x0A, out=1, address=0x0E)
        for _ in range(steps):
            host.run(5_000_000 // steps)
        seen = []
        for _ in range(20):
            host.run(1000)
            seen.append((host.ext(7), host.now))
        worlds.append(seen)
    assert worlds[0] == worlds[1]


# Data ready


@pytest.mark.parametrize("wait, ready_after", [(0, 0), (WAIT_FOR_ES, 232)])
def test_wait_for_es_holds_data_ready_back(host, wait, ready_after):
    host.write(I2C_MST_CTRL, wait | P_NSR | KHZ_400)
    host.slot(0, 0x10, 7)
    host.write(INT_ENABLE, 1)
    host.run(1)
    rises = []
    while len(rises) < 3:
        level = host.chip.int_level
        host.run(host.chip.next_event() - host.now)
        if host.chip.int_level and not level:
            rises.append((host.now - host.epoch) % 1000)
    assert rises == [ready_after] * 3
    host.run(300)
    assert host.read(INT_STATUS) == 1
    host.slave.there = False
    host.run(1000)
    assert host.read(INT_STATUS) == 1  # a NACK ends the wait


# FIFO


def test_the_slaves_bytes_follow_in_the_fifo(host):
    host.slot(0, 0x10, 3)
    host.slot(1, 0x20, 2)
    host.slot(3, 0x40, 1)
    host.write(I2C_MST_CTRL, 0x20 | P_NSR | KHZ_400)  # SLV3 has its bit here
    host.write(FIFO_EN, 0x08 | 0x01)
    host.off(0x04)
    host.on(0x40)
    host.run(3500)
    assert host.read(FIFO_COUNTH, 2) == bytes((0, 30))
    accel = bytes((0, 0, 0, 0, 0x10, 0))
    assert host.read(FIFO_R_W, 30) == (accel + bytes((0x10, 0x11, 0x12, 0x40))) * 3
    host.slave.there = False
    host.run(1000)
    assert host.read(FIFO_COUNTH, 2) == bytes((0, 10))  # stale bytes, but as many


def test_a_packet_with_slaves_is_complete_when_they_have_been_read(host):
    host.slot(0, 0x10, 3)
    host.write(FIFO_EN, 0x08 | 0x01)
    host.off(0x04)
    host.on(0x40)
    host.run(1000 + 100)
    assert host.read(FIFO_COUNTH, 2) == b"\0\0"
    host.run(100)
    assert host.read(FIFO_COUNTH, 2) == b"\0\x09"


# Cut off


def in_the_middle(kind, address=0x0E):
    magnetometer = IST8310Chip(StillWorld())
    host = Host(kind, slaves=[magnetometer])
    host.slot(0, 0x02, 7, address=address)
    host.run(1000 + 150)
    return host, magnetometer


@pytest.mark.parametrize("kind", ["mpu6050", "mpu6500"])
@pytest.mark.parametrize("how", ["off", "reset", "brown out"])
def test_cut_off_in_a_transaction_the_slave_hangs_until_its_bus_is_clocked(kind, how):
    host, magnetometer = in_the_middle(kind)
    if how == "off":
        host.off()
    elif how == "reset":
        host.write(PWR_MGMT_1, 0x80)
    else:
        host.chip.brown_out(host.now)
    assert magnetometer.hung and host.chip.master.cut == 1
    texts = [text for text in host.chip.misuse if "auxiliary transaction" in text]
    assert len(texts) == (0 if how == "brown out" else 1)
    host.run(100_000)
    host.write(USER_CTRL, host.user_ctrl)
    host.write(PWR_MGMT_1, 0x01)
    host.write(SMPLRT_DIV, 0, 1)
    host.write(I2C_MST_CTRL, KHZ_400)
    host.slot(0, 0x00, 1, address=0x0E)
    host.on()
    host.run(1800)
    assert host.read(I2C_MST_STATUS) == LOST_ARB
    assert not magnetometer.hung
    host.run(1000)
    assert host.ext(2)[0] == 0x10


def test_cut_off_between_transactions_nothing_hangs(host):
    host, magnetometer = in_the_middle("mpu6500")
    host.run(200)
    host.off()
    assert not magnetometer.hung and host.chip.master.cut == 0 and host.chip.misuse == []


def test_a_slave_that_only_its_reset_frees():
    host, magnetometer = in_the_middle("mpu6500")
    magnetometer.clocks_free = False
    host.off(MST_RST)
    host.on()
    host.run(50_000)
    assert host.read(I2C_MST_STATUS) & LOST_ARB
    magnetometer.reset_pin(0, host.now)
    magnetometer.reset_pin(1, host.now)
    host.run(50_000)
    host.read(I2C_MST_STATUS)
    host.run(2000)
    assert host.read(I2C_MST_STATUS) == 0


def test_i2c_mst_reset_of_a_6050_needs_the_master_off():
    old, new = Host("mpu6050"), Host("mpu6500")
    for host in (old, new):
        host.slot(0, 0x10, 1)
        host.run(1500)
        host.on(MST_RST)
        assert host.read(USER_CTRL) & MST_RST == 0
    assert old.chip.misuse and not new.chip.misuse


# The example that the vendor of the RoboMaster board A publishes, and everybody copies


class Turning(StillWorld):
    """The field changes every millisecond."""

    def __init__(self):
        super().__init__((), (1000, 1), n=1 << 15)

    def row(self, k):
        self.set([0, 0, 4096, 0, 0, 0, 1 + k % 5000, 2, 3])
        return self._row


def vendor_sequence(restarts=False):
    """Trigger and read with a delay of 3 ("every eighth sample"), averaging 16 times, no DRDY."""
    world = Turning()
    magnetometer = IST8310Chip(world, restarts=restarts)
    host = Host(slaves=[magnetometer], world=world)
    world.start(host.now)
    for register, value in ((0x0B, 0x01), (0x42, 0xC0), (0x41, 0x24)):
        host.slv4(register, out=value, address=0x0E)
        host.run(50_000)
    host.write(SLV4_CTRL, 0x03)
    host.write(MST_DELAY_CTRL, 0x03)
    host.slot(1, 0x0A, out=1, address=0x0E)
    host.slot(0, 0x03, 6, address=0x0E)
    host.run(20_000)
    return host, magnetometer


def test_the_vendors_sequence_delivers_every_measurement_twice():
    host, _ = vendor_sequence()
    read = []
    for _ in range(50):
        host.run(4000)  # as often as the slots run
        read.append(host.ext(6))
    again = [a == b for a, b in pairwise(read)]
    assert again in ([True, False] * 24 + [True], [False, True] * 24 + [False])


def test_and_nothing_at_all_if_a_trigger_begins_the_measurement_anew():
    host, magnetometer = vendor_sequence(restarts=True)
    host.run(1_000_000)
    assert magnetometer.measurements == 0
    assert host.ext(6) == bytes(6)


def test_with_drdy_read_along_and_a_delay_that_the_chip_can_hold_each_is_seen_once():
    host, magnetometer = vendor_sequence()
    host.disable(0, 1)
    host.write(SLV4_CTRL, 9)
    host.write(MST_DELAY_CTRL, SHADOW | 0x02)
    host.slot(0, 0x02, 7, address=0x0E)
    host.slot(1, 0x0A, out=1, address=0x0E)
    host.run(20_000)
    fresh = []
    for _ in range(500):
        host.run(1000)
        data = host.ext(7)
        if data[0] & 1:
            fresh.append(data[1:])
    assert len(fresh) == 50 == len(set(fresh))
    assert magnetometer.misuse == host.chip.misuse == []
