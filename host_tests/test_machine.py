"""The machine mock: bus time, interrupts and who gets in whose way. What is tested on it is worth as much as this."""

import time

import kernel
import machine
import micropython
import pytest


class Echo:
    """A chip with 256 registers that counts on; nothing else."""

    def __init__(self, address=0x50):
        self.address = address
        self.registers = bytearray(range(256))
        self.pointer = 0
        self.int_level = 0
        self.toggles = []

    def i2c_start(self, read, now):
        self.first = not read
        return True

    def i2c_write(self, byte, now):
        if self.first:
            self.pointer, self.first = byte, False
        else:
            self.registers[self.pointer] = byte
            self.pointer = (self.pointer + 1) & 255
        return True

    def i2c_read(self, now):
        value = self.registers[self.pointer]
        self.pointer = (self.pointer + 1) & 255
        return value

    def i2c_stop(self, now):
        pass

    def spi_select(self, selected, now):
        self.selected = selected

    def spi_transfer(self, byte, now, hz, mode):
        self.seen = (byte, hz, mode)
        return byte ^ 0xFF

    def next_event(self):
        return self.toggles[0] if self.toggles else None

    def poll(self, now):
        while self.toggles and self.toggles[0] <= now:
            self.toggles.pop(0)
            self.int_level ^= 1


@pytest.fixture
def echo():
    return Echo()


@pytest.fixture
def bus(echo):
    return machine.wire_i2c(0, echo, scl=5, sda=4)


@pytest.fixture
def i2c(bus):
    return machine.I2C(0, scl=machine.Pin(5), sda=machine.Pin(4), freq=400000)


def test_a_transfer_takes_its_bits_on_the_bus(i2c):
    buf = bytearray(14)
    i2c.readfrom_mem_into(0x50, 0x10, buf)
    assert buf == bytes(range(0x10, 0x1E))
    # start, address, register, start, address, 14 bytes, stop: 10 + 9 + 10 + 14 * 9 + 1 bits of 2.5 us
    assert kernel.now() == -(-(10 + 9 + 10 + 14 * 9 + 1) * 25 // 10)


def test_a_slower_bus_takes_longer(echo):
    machine.wire_i2c(1, echo)
    machine.I2C(1, freq=100000).writeto(0x50, b"\x01\x02")
    assert kernel.now() == (10 + 9 + 9 + 1) * 10


def test_an_absent_address_is_a_nack(i2c):
    with pytest.raises(OSError) as error:
        i2c.readfrom(0x51, 1)
    assert error.value.args[0] == machine.EIO


def test_scan_finds_what_is_wired(i2c):
    machine.wire_i2c(0, Echo(0x68))
    assert i2c.scan() == [0x50, 0x68]


def test_soft_i2c_sees_the_same_bus(bus):
    soft = machine.SoftI2C(machine.Pin(5), machine.Pin(4))
    assert soft.readfrom_mem(0x50, 3, 2) == b"\x03\x04"
    with pytest.raises(OSError):
        machine.SoftI2C(machine.Pin(1), machine.Pin(2)).readfrom(0x50, 1)


def test_a_stuck_bus_times_out(i2c, bus):
    bus.stuck = True
    with pytest.raises(OSError) as error:
        i2c.readfrom(0x50, 1)
    assert error.value.args[0] == machine.ETIMEDOUT
    assert kernel.now() == 50000


def test_a_hard_timer_ticks_through_a_sleep_with_the_heap_locked():
    seen = []
    machine.Timer(
        period=5,
        hard=True,
        callback=lambda t: seen.append((kernel.now(), micropython.heap_locked())),
    )
    time.sleep_ms(20)
    assert seen == [(5000, 1), (10000, 1), (15000, 1), (20000, 1)]


def test_the_mock_unlocks_the_heap_for_itself_only(i2c, echo):
    locks = []
    read = echo.i2c_read
    echo.i2c_read = lambda now: (locks.append(micropython.heap_locked()), read(now))[1]
    buf = bytearray(1)

    def callback(timer):
        i2c.readfrom_mem_into(0x50, 0, buf)
        locks.append(micropython.heap_locked())

    machine.Timer(period=1, hard=True, mode=machine.Timer.ONE_SHOT, callback=callback)
    time.sleep_ms(2)
    assert locks == [0, 1]
    assert micropython.heap_locked() == 0


def test_a_hard_callback_cuts_into_a_transfer_and_both_fail(i2c, bus):
    errors = []

    def callback(timer):
        try:
            i2c.writeto(0x50, b"\x00")
        except OSError as error:
            errors.append(error.args[0])

    machine.Timer(period=1, hard=True, mode=machine.Timer.ONE_SHOT, callback=callback)
    with pytest.raises(OSError):
        i2c.readfrom(0x50, 100)
    assert errors == [machine.EIO]
    assert bus.cuts == 1


def test_another_bus_is_not_cut(i2c, bus):
    other = machine.wire_i2c(1, Echo())
    i2c1 = machine.I2C(1)
    machine.Timer(
        period=1,
        hard=True,
        mode=machine.Timer.ONE_SHOT,
        callback=lambda t: i2c1.writeto(0x50, b"a"),
    )
    assert len(i2c.readfrom(0x50, 100)) == 100
    assert (bus.cuts, other.cuts, other.transfers) == (0, 0, 1)


def test_soft_callbacks_run_while_the_main_program_sleeps():
    at = []
    machine.Timer(0, period=10, callback=lambda t: at.append(kernel.now()))
    time.sleep_ms(35)
    assert at == [10000, 20000, 30000]
    assert kernel.now() == 35000


def test_a_numbered_timer_has_soft_callbacks_only():
    with pytest.raises(ValueError, match="hard"):
        machine.Timer(0, period=10, hard=True, callback=print)
    with pytest.raises(ValueError):
        machine.Timer(4)


def test_a_soft_callback_waits_for_the_transfer_to_end(i2c, bus):
    at = []
    machine.Timer(period=1, mode=machine.Timer.ONE_SHOT, callback=lambda t: at.append(bus.busy))
    i2c.readfrom(0x50, 100)
    assert at == [False]


def test_a_tick_that_finds_one_pending_is_lost():
    ticks = []

    def slow(timer):
        ticks.append(kernel.now())
        if len(ticks) == 2:
            time.sleep_us(3500)  # as long as three and a half periods

    timer = machine.Timer(period=1, hard=True, callback=slow)
    time.sleep_ms(9)
    assert ticks == [1000, 2000, 5500, 6000, 7000, 8000, 9000]
    assert timer.lost == 2


def test_ticks_longer_than_their_period_starve_the_main_program_to_the_end():
    kernel.stop_at(20000)
    machine.Timer(period=1, hard=True, callback=lambda t: time.sleep_us(1500))
    with pytest.raises(kernel.PowerOff):
        time.sleep_ms(2)
    assert kernel.now() >= 20000


def test_an_exception_that_escapes_a_hard_callback_stops_its_timer(capsys):
    ticks = []

    def fails(timer):
        ticks.append(1)
        raise ValueError("no")

    machine.Timer(period=1, hard=True, callback=fails)
    time.sleep_ms(10)
    assert len(ticks) == 1
    assert len(kernel.uncaught) == 1
    assert "ValueError" in capsys.readouterr().out


def test_irqs_wait_while_disabled():
    ticks = []
    machine.Timer(period=1, hard=True, callback=lambda t: ticks.append(kernel.now()))
    state = machine.disable_irq()
    kernel.advance(5500)
    assert ticks == []
    machine.enable_irq(state)
    assert ticks == [5500]


def test_a_pin_follows_its_chip_and_interrupts_on_its_edges(echo):
    machine.wire_pin(6, echo)
    edges = []
    pin = machine.Pin(6, machine.Pin.IN)
    pin.irq(lambda p: edges.append((kernel.now(), p.value())), machine.Pin.IRQ_RISING, hard=True)
    echo.toggles = [100, 150, 300]
    kernel.changed()
    kernel.advance(1000)
    assert edges == [(100, 1), (300, 1)]
    pin.irq(handler=None)
    echo.toggles = [1100, 1200]
    kernel.changed()
    kernel.advance(1000)
    assert len(edges) == 2
    echo.toggles = [2300]
    kernel.advance(500)
    assert pin.value() == 0
    echo.toggles = [2700, 3500, 3700]
    kernel.advance(500)  # it rises while nobody listens: no edge for who comes after
    pin.irq(lambda p: edges.append((kernel.now(), p.value())), machine.Pin.IRQ_RISING, hard=True)
    kernel.advance(1000)
    assert edges[2:] == [(3700, 1)]


def test_spi_reaches_the_selected_chip_with_its_clock_and_mode(echo):
    machine.wire_spi(0, echo, cs=17)
    spi = machine.SPI(0, baudrate=1000000, polarity=1, phase=1)
    cs = machine.Pin(17, machine.Pin.OUT, value=1)
    buf = bytearray(2)
    spi.write_readinto(b"\x01\x02", buf)
    assert buf == b"\xff\xff"  # nobody was selected
    cs(0)
    start = kernel.now()
    spi.write_readinto(b"\x01\x02", buf)
    assert kernel.now() - start == 16
    cs(1)
    assert buf == b"\xfe\xfd"
    assert echo.seen == (2, 1000000, 3)
    spi.init(baudrate=8000000)
    cs(0)
    spi.write(b"\x00")
    assert echo.seen[1] == 8000000


def test_the_watchdog_resets_a_main_program_that_forgets_it():
    dog = machine.WDT(timeout=100)
    time.sleep_ms(90)
    dog.feed()
    time.sleep_ms(90)
    with pytest.raises(kernel.Reset) as reset:
        time.sleep_ms(20)
    assert reset.value.args[0] == machine.WDT_RESET


def test_the_simulation_ends_when_it_is_told_to():
    kernel.stop_at(5000)
    with pytest.raises(kernel.PowerOff):
        while True:
            machine.idle()
    assert kernel.now() >= 5000


def test_ticks_wrap_as_on_a_board():
    kernel.advance((1 << 30) - 5)
    before = time.ticks_us()
    kernel.advance(10)
    assert time.ticks_us() == 5
    assert time.ticks_diff(time.ticks_us(), before) == 10
    assert time.ticks_add(before, 10) == 5


def test_the_same_on_every_runtime(runtime, portable):
    """Ticks, cuts, lost ticks and the heap lock, in one script; the unix ports refuse an allocation, CPython cannot."""
    out = portable(runtime, "machine_facts.py")
    expected = (PORTABLE_EXPECTED % ("allowed" if runtime == "cpython" else "refused")).strip()
    lines = [line for line in out.splitlines() if not line.startswith("uncaught")]
    assert lines == expected.splitlines()


PORTABLE_EXPECTED = """
read b'\\x10\\x11' at 120
ticks 200 cuts 0
cut True 1 1
float in a hard callback %s
"""
