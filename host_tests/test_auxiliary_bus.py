"""The auxiliary master of the MPU: transactions of SLV4, slots and their places, in set-up and in the tick."""

import kernel
import pytest
from imus import RIGS
from upright.auxiliary_bus import (
    AUX_BUSY,
    AUX_NACK,
    AUX_TIMEOUT,
    AuxiliaryBus,
    AuxiliaryError,
    AuxiliaryNack,
    AuxiliaryTimeout,
)
from world import StillWorld

USER_CTRL, MST_CTRL, DELAY_CTRL, SLV4_CTRL, SLV4_ADDR = 0x6A, 0x24, 0x67, 0x34, 0x31
SLV0_CTRL, EXT = 0x27, 0x49
MST_EN, ENABLE, READ = 0x20, 0x80, 0x80


class Device:
    """Registers on the auxiliary bus."""

    def __init__(self, address):
        self.address = address
        self.registers = bytearray((7 * i + address) & 0xFF for i in range(256))
        self.writes = []  # (now, register, value)
        self.reads = 0
        self.gone = False

    def i2c_start(self, read, now):
        self._pointing = not read
        self.reads += read
        return not self.gone

    def i2c_write(self, byte, now):
        if self._pointing:
            self._pointer = byte
            self._pointing = False
        else:
            self.writes.append((now, self._pointer, byte))
            self.registers[self._pointer] = byte
            self._pointer += 1
        return not self.gone

    def i2c_read(self, now):
        value = self.registers[self._pointer & 0xFF]
        self._pointer += 1
        return value

    def i2c_stop(self, now):
        pass


@pytest.fixture(params=RIGS)
def imu(request):
    """A configured driver; .model is that of its chip."""
    model, imu = RIGS[request.param].running(StillWorld())
    imu.model = model
    return imu


@pytest.fixture
def device(imu):
    device = Device(0x1E)
    imu.model.aux.append(device)
    return device


@pytest.fixture
def aux(imu, device):
    aux = AuxiliaryBus(imu)
    aux.begin()
    return aux


@pytest.fixture
def remote(aux):
    """The device's registers, as a driver has them."""
    return aux.device(0x1E)


@pytest.fixture
def nobody(aux):
    return aux.device(0x2A)


def samples(imu, n=1):
    """n ticks of a timer at the sample rate."""
    for _ in range(n):
        kernel.advance(1000 - kernel.now() % 1000)
        imu.read()


def carry_out(imu, device, register, data=-1):
    """transact() after every sample until there is an outcome; (outcome, calls)."""
    for calls in range(1, 30):
        samples(imu)
        outcome = device.transact(register, data)
        if outcome != AUX_BUSY:
            return outcome, calls
    raise AssertionError("never done")


@pytest.fixture
def accesses(imu, monkeypatch):
    """A list that grows by one for every register access of the driver."""
    made = []
    bus, read, write = imu.registers, imu.registers.read_into, imu.registers.write
    monkeypatch.setattr(bus, "read_into", lambda r, b: made.append(r) or read(r, b))
    monkeypatch.setattr(bus, "write", lambda r, v: made.append(r) or write(r, v))
    return made


# Set-up


def test_begin_switches_the_master_on_at_400_khz_with_shadowing_and_without_waiting(imu, aux):
    chip = imu.model
    assert chip.register(USER_CTRL) & MST_EN
    assert chip.register(MST_CTRL) == 0x1D  # no WAIT_FOR_ES: 0x40
    assert chip.register(DELAY_CTRL) == 0x80
    assert aux.running


def test_a_device_has_what_registers_offer_on_any_bus(remote, device):
    remote.write_register(0x41, 0x24)
    assert device.registers[0x41] == 0x24
    assert remote.read_register(0x41) == 0x24
    remote.verify_register(0x41, 0x2F, mask=0xF0)
    with pytest.raises(AuxiliaryError, match="register 0x41: wrote 0x25, read 0x24"):
        remote.verify_register(0x41, 0x25)
    buffer = bytearray(5)
    remote.read_into(0x10, buffer)
    assert buffer == device.registers[0x10:0x15]
    remote.write_from(b"\x50\x01\x02\x03")
    assert device.registers[0x50:0x53] == b"\x01\x02\x03"


def test_no_acknowledge_and_nothing_done_are_told_apart_and_named(imu, remote, nobody):
    with pytest.raises(AuxiliaryNack, match=r"a read of register 0x05 of 0x2a"):
        nobody.read_into(0x05, bytearray(1))
    with pytest.raises(AuxiliaryNack, match=r"a write to register 0x06 of 0x2a"):
        nobody.write(0x06, 1)
    imu.sleep()
    kernel.advance(5000)
    before = kernel.now()
    with pytest.raises(AuxiliaryTimeout, match=r"register 0x05 of 0x1e not done in .* awake"):
        remote.read_into(0x05, bytearray(1))
    assert kernel.now() - before < 20_000
    assert not imu.model.register(SLV4_CTRL) & ENABLE  # it does not come later, unasked


def test_after_a_time_out_the_next_transaction_is_not_taken_for_the_old_one(imu, remote, device):
    imu.sleep()
    with pytest.raises(AuxiliaryTimeout):
        remote.read_into(0x05, bytearray(1))
    imu.wake()
    assert remote.read_register(0x06) == device.registers[0x06]


@pytest.mark.parametrize("imu", ["MPU6050", "MPU6500_I2C"], indirect=True)  # SPI cannot tell
def test_a_bus_that_fails_at_set_up_ends_in_good_time_and_is_blamed(imu, remote):
    imu.model.vanish()
    before = kernel.now()
    with pytest.raises(AuxiliaryTimeout, match="IMU awake, does it answer"):
        remote.read_into(0x05, bytearray(1))
    assert kernel.now() - before < 20_000
    assert imu.errors


def test_before_begin_there_is_no_bus(imu, device):
    aux = AuxiliaryBus(imu)
    for call in (aux.start, lambda: aux.device(0x1E).read_register(0)):
        with pytest.raises(AuxiliaryError, match="begin"):
            call()


def test_configuring_the_imu_anew_ends_it_until_the_next_begin(imu, aux, device):
    at = aux.periodic_read(0x1E, 0x10, 2)
    aux.start()
    imu.configure(sample_rate_hz=1000)
    assert not aux.running
    aux.begin()
    samples(imu, 3)
    reads = device.reads
    samples(imu, 3)
    assert device.reads == reads  # the old slot is gone
    assert aux.periodic_read(0x1E, 0x10, 2) == at


def test_begin_on_a_running_bus_forgets_the_slots_and_the_table_says_so(imu, aux, device):
    aux.periodic_read(0x1E, 0x10, 2)
    aux.start()
    samples(imu, 3)
    aux.begin()
    for _ in range(50):
        samples(imu)
        imu.health()
    assert imu.resets == 0
    assert imu.model.register(SLV0_CTRL) == 0
    assert imu.model.misuse == []


# Slots


def test_places_follow_the_order_of_the_slots_and_their_lengths(imu, aux, device):
    other = Device(0x0C)
    imu.model.aux.append(other)
    assert aux.periodic_read(0x1E, 0x20, 7) == 0
    aux.periodic_write(0x0C, 0x0A, 0x01)
    assert aux.periodic_read(0x0C, 0x40, 3) == 7
    assert aux.periodic_read(0x1E, 0x60, 14) == 10
    aux.start()
    samples(imu, 4)
    there = bytearray(24)
    imu.registers.read_into(EXT, there)
    assert there == (
        device.registers[0x20:0x27] + other.registers[0x40:0x43] + device.registers[0x60:0x6E]
    )
    assert other.writes and other.writes[0][1:] == (0x0A, 0x01)
    assert imu.model.misuse == []


def test_slots_are_programmed_while_all_are_disabled(imu, aux, device):
    aux.periodic_read(0x1E, 0x20, 2)
    aux.start()
    aux.periodic_read(0x1E, 0x30, 2)
    imu.model.log = log = []
    aux.start()
    controls = [0x27, 0x2A, 0x2D, 0x30]
    order = [(register, value) for _, register, value in log]
    off = max(order.index((register, 0)) for register in controls)
    on = min(order.index((register, 0x82)) for register in controls[:2])
    programmed = [
        order.index(row) for row in ((0x25, 0x9E), (0x26, 0x20), (0x28, 0x9E), (0x29, 0x30))
    ]
    assert off < min(programmed) and max(programmed) < on
    samples(imu, 3)
    there = bytearray(4)
    imu.registers.read_into(EXT, there)
    assert there == device.registers[0x20:0x22] + device.registers[0x30:0x32]


def test_other_slots_get_their_places_anew(imu, aux, device):
    aux.periodic_read(0x1E, 0x20, 2)
    aux.periodic_read(0x1E, 0x30, 2)
    aux.start()
    samples(imu, 3)
    aux.begin()
    samples(imu, 2)
    reads = device.reads
    samples(imu, 2)
    assert device.reads == reads
    aux.periodic_read(0x1E, 0x40, 5)
    assert aux.periodic_read(0x1E, 0x50, 1) == 5
    aux.start()
    samples(imu, 3)
    there = bytearray(6)
    imu.registers.read_into(EXT, there)
    assert there == device.registers[0x40:0x45] + device.registers[0x50:0x51]
    assert imu.model.misuse == []


def test_fewer_slots_leave_no_old_one_running(imu, aux, device):
    for register in (0x20, 0x30, 0x40):
        aux.periodic_read(0x1E, register, 1)
    aux.start()
    aux.begin()
    aux.periodic_read(0x1E, 0x20, 1)
    aux.start()
    samples(imu, 2)
    reads = device.reads
    samples(imu, 10)
    assert device.reads - reads == 10
    for _ in range(60):
        samples(imu)
        imu.health()
    assert imu.resets == 0


def test_a_divided_slot_runs_every_nth_sample_and_the_others_with_each(imu, aux, device):
    aux.periodic_read(0x1E, 0x20, 1)
    aux.periodic_write(0x1E, 0x0A, 1, every=10)
    aux.start()
    samples(imu, 5)
    writes, reads = len(device.writes), device.reads
    samples(imu, 100)
    assert len(device.writes) - writes == 10
    assert device.reads - reads == 100
    gaps = {b[0] - a[0] for a, b in zip(device.writes[-5:], device.writes[-4:], strict=False)}
    assert all(abs(gap - 10_000) <= 2 for gap in gaps)


def test_the_shared_delay_survives_every_transaction_of_slot_4(imu, aux, remote, nobody):
    aux.periodic_write(0x1E, 0x0A, 1, every=10)
    aux.start()
    imu.model.log = log = []
    remote.write_register(0x41, 0x24)
    remote.read_register(0x41)
    carry_out(imu, remote, 1)
    carry_out(imu, remote, 2, 3)
    carry_out(imu, nobody, 1)
    imu.sleep()
    with pytest.raises(AuxiliaryTimeout):
        remote.read_into(0x05, bytearray(1))
    written = [value for _, register, value in log if register == SLV4_CTRL]
    assert len(written) >= 6
    assert {value & 0x1F for value in written} == {9}


@pytest.mark.parametrize(
    "calls, what",
    [
        ([(1, 16)], "length 16"),
        ([(1, 0)], "length 0"),
        ([(1, 15), (1, 10)], "24"),
        ([(1, 1)] * 5, "4 slots"),
        ([(33, 1)], "every 33"),
        ([(0, 1)], "every 0"),
        ([(5, 1), (6, 1)], "shared"),
    ],
)
def test_what_the_master_does_not_have_is_refused(imu, aux, calls, what):
    with pytest.raises(ValueError, match=what):
        for every, length in calls:
            aux.periodic_read(0x1E, 0, length, every)


def test_one_divider_is_shared_by_any_slots_that_ask_for_it(imu, aux):
    aux.periodic_read(0x1E, 0, 1, 5)
    aux.periodic_read(0x1E, 1, 1)
    aux.periodic_write(0x1E, 2, 1, 5)
    aux.start()
    assert imu.model.register(SLV4_CTRL) & 0x1F == 4
    assert imu.model.register(DELAY_CTRL) == 0x85


def test_slots_that_do_not_fit_into_a_sample_are_refused():
    _, imu = RIGS["MPU6050"].running(StillWorld())
    imu.configure(sample_rate_hz=8000, dlpf=0)
    aux = AuxiliaryBus(imu)
    aux.begin()
    aux.periodic_read(0x1E, 0x02, 7)
    with pytest.raises(ValueError, match=r"330 us of each sample, and 8000/1 Hz leaves 125"):
        aux.start()


# The tick


@pytest.mark.parametrize("data, most", [(-1, 3), (0x24, 4)])
def test_a_transaction_in_the_tick_takes_a_few_calls_of_two_accesses(
    imu, remote, device, accesses, data, most
):
    samples(imu, 2)
    for register in (0x10, 0x11, 0x12):
        outcome, calls = AUX_BUSY, 0
        while outcome == AUX_BUSY:
            calls += 1
            kernel.advance(1000)
            accesses.clear()
            outcome = remote.transact(register, data)
            assert 1 <= len(accesses) <= 2
        assert calls <= most
        if data < 0:
            assert outcome == device.registers[register]
        else:
            assert outcome == 0 and device.registers[register] == data


@pytest.mark.parametrize("done_with_nack", [True, False])
def test_no_acknowledge_in_the_tick_is_told(imu, remote, nobody, device, done_with_nack):
    imu.model.master.done_with_nack = done_with_nack
    assert carry_out(imu, nobody, 0x10)[0] == AUX_NACK
    assert nobody.errors == 1
    assert not imu.model.register(SLV4_CTRL) & ENABLE
    assert carry_out(imu, remote, 0x10)[0] == device.registers[0x10]
    assert remote.errors == 0


def test_a_master_that_sleeps_is_given_up_and_nothing_comes_late(imu, remote, device):
    imu.sleep()
    outcome, calls = carry_out(imu, remote, 0x10)
    assert outcome == AUX_TIMEOUT
    assert calls <= 17
    assert device.reads == 0
    imu.wake()
    samples(imu, 5)
    assert device.reads == 0
    assert carry_out(imu, remote, 0x11)[0] == device.registers[0x11]


@pytest.mark.parametrize("imu", ["MPU6050", "MPU6500_I2C"], indirect=True)  # SPI cannot tell
def test_a_bus_that_fails_in_the_tick_is_counted_and_tried_again(imu, remote, device):
    imu.model.vanish()
    for _ in range(3):
        assert remote.transact(0x10, -1) == AUX_BUSY
    assert imu.errors == 6
    imu.model.come_back()
    assert carry_out(imu, remote, 0x10)[0] == device.registers[0x10]
    samples(imu)
    remote.transact(0x11, -1)  # it is on its way
    imu.model.vanish()
    outcomes = [remote.transact(0x11, -1) for _ in range(16)]
    assert outcomes == [AUX_BUSY] * 15 + [AUX_TIMEOUT]  # never without end
    imu.model.come_back()
    samples(imu)
    kernel.advance(1)
    # the old one's SLV4_DONE is not taken for this one's
    assert carry_out(imu, remote, 0x12)[0] == device.registers[0x12]


def test_a_transaction_that_was_not_waited_for_is_not_taken_for_the_next(imu, remote, device):
    for register in (0x10, 0x11, 0x12, 0x13):
        for _ in range(2):
            samples(imu)
            assert remote.transact(register, -1) == AUX_BUSY
    samples(imu, 2)
    assert carry_out(imu, remote, 0x14)[0] == device.registers[0x14]


def test_a_reset_of_the_imu_in_the_middle_does_not_confuse_it(imu, remote, device):
    imu.model.power_up_us = 2000
    samples(imu)
    remote.transact(0x10, -1)
    imu.model.brown_out()
    for _ in range(200):
        samples(imu)
        imu.health()
    assert imu.resets == 1
    assert imu.model.register(USER_CTRL) & MST_EN
    assert carry_out(imu, remote, 0x10)[0] == device.registers[0x10]
    assert imu.model.misuse == []


def test_what_the_status_register_forgets_is_kept(imu, aux, remote, device):
    aux.periodic_read(0x1E, 0x10, 1)
    aux.periodic_read(0x2A, 0x10, 1)  # nobody there
    aux.start()
    samples(imu, 3)
    outcome = AUX_BUSY
    while outcome == AUX_BUSY:
        samples(imu)
        outcome = aux.transact(0x1E | READ, 0x20, 0)
    assert outcome == device.registers[0x20]
    assert aux.faults & 0x0F == 0x02
    device.gone = True
    samples(imu, 3)
    with pytest.raises(AuxiliaryNack):
        remote.read_into(0x20, bytearray(1))  # the set-up's looks count as well
    assert aux.faults == 0x13
    carry_out(imu, remote, 0x20)
    assert remote.errors == 1 and aux.faults == 0  # counted, and done with


def test_everything_that_was_set_up_comes_back_after_a_reset_of_the_imu(imu, aux, device):
    aux.periodic_read(0x1E, 0x20, 3)
    aux.periodic_write(0x1E, 0x0A, 1, every=10)
    aux.start()
    samples(imu, 20)
    rows = (*range(0x24, 0x2D), SLV4_CTRL, 0x64, DELAY_CTRL)
    before = [imu.model.register(r) for r in rows]
    imu.model.brown_out()
    for _ in range(300):
        samples(imu)
        imu.health()
    assert [imu.model.register(r) for r in rows] == before
    assert imu.resets == 1
    there = bytearray(3)
    imu.registers.read_into(EXT, there)
    assert there == device.registers[0x20:0x23]
