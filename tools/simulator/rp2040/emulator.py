"""What the board harness uses of rp2040py, and what had to be mended in it.

Each class or function here names a defect of rp2040py 0.3.6; version.py refuses any other version, so that a mend is
never laid over code that it was not made for.
"""

from rp2040py.execute_batch import execute_batch
from rp2040py.gpio_pin import GPIOPinState
from rp2040py.peripherals import i2c
from rp2040py.rp2040 import RP2040

HZ = 125_000_000  # the core's clock, which rp2040py takes for granted
_I2C_BLOCKS = (0x40044, 0x40048)  # where they sit in the map of peripherals (address >> 12)
# CLK_PERI_CTRL.AUXSRC (RP2040 datasheet 2.15.7): clk_sys, pll_sys, pll_usb
_PERIPHERAL_HZ = {0: HZ, 1: HZ, 2: 48_000_000}
_CLK_PERI_CTRL = 0x48
_PIO_BLOCKS = (0x50200, 0x50300)
_SSPCR0, _SSPCPSR = 0x000, 0x010
_PACKET = 64  # bytes of a full-speed bulk packet


def run(simulator):
    """Run until simulator.stopped.

    One clock tick an instruction: then it does not matter where execute_batch, which ends after some milliseconds of
    the host's time, breaks off, and every run is the same.
    """
    simulator.stopped = False
    while not simulator.stopped:
        execute_batch(simulator, 1)


class IdlePIO:
    """No defect: both PIO blocks are asked after each instruction whether they run, which takes an eighth of all time.
    So they are off the list until a program of the board writes to one of them.
    """

    def __init__(self, mcu: RP2040):
        self._working = mcu.pio
        self._blocks = list(mcu.pio)
        for at, block in zip(_PIO_BLOCKS, self._blocks, strict=True):
            mcu.peripherals[at] = _PIOBlock(self, block)
        self.rest()

    def rest(self):
        self._working.clear()

    def wake(self):
        self._working[:] = self._blocks


class _PIOBlock:
    def __init__(self, idle, block):
        self.read_uint32 = block.read_uint32
        self._wake, self._write = idle.wake, block.write_uint32_atomic

    def write_uint32_atomic(self, offset, value, atomic_type):
        self._wake()
        self._write(offset, value, atomic_type)


class HeldUSB:
    """Defect: a bulk OUT endpoint that the firmware arms is answered at once, with an empty packet when the host has
    nothing to say; the firmware arms it again, and spends its time in the USB interrupt. A host lets it wait (NAK).

    `kick` is called when there is something to send.
    """

    def __init__(self, mcu: RP2040):
        self._usb = mcu.usb_ctrl
        self._done = self._usb.endpoint_read_done
        self._usb.endpoint_read_done = self._answer
        self._waiting = []  # endpoints that the firmware has armed
        self._alarm = mcu.clock.create_alarm(self._serve)

    def _answer(self, endpoint, buffer, delay=None):
        if endpoint and not len(buffer):
            self._waiting.append(endpoint)
        else:
            self._done(endpoint, buffer, delay)

    def kick(self):
        if self._waiting:
            self._alarm.schedule(1000)

    def _serve(self):
        waiting, self._waiting = self._waiting, []
        for endpoint in waiting:
            self._usb.on_endpoint_read(endpoint, _PACKET)

    def forget(self):
        """The firmware starts anew: nothing is armed."""
        self._waiting = []
        self._alarm.cancel()


class I2C(i2c.RPI2C):
    """The I2C block, with defects mended that show once a transfer takes time on the bus:

    - TX_EMPTY is raised when a byte leaves the FIFO, though the SDK asks (TX_EMPTY_CTRL) for the moment when it has
      left the shift register: a byte that is refused late would go unnoticed.
    - An abort (a NACK) flushes the FIFO without raising TX_EMPTY: the SDK then waits until its timeout, and
      MicroPython says ETIMEDOUT instead of EIO.
    - Clearing ENABLE in the middle of a transfer leaves it running, and the next one is taken for its continuation.
      (The SDK clears it at the beginning of every transfer; one that was left open on purpose goes on with RESTART.)

    And, though no defect: the SDK's loop around a byte on the wire is not run to its end but passed over to the next
    event, its cycles counted. It is most of what a bus costs here.
    """

    def __init__(self, mcu: RP2040, number: int):
        super().__init__(mcu, f"I2C{number}", mcu.i2c[number].irq)
        mcu.peripherals[_I2C_BLOCKS[number]] = mcu.i2c[number] = self
        self.on_cut = None  # called when a transfer is cut off by the beginning of another
        self._reopened = False
        self._polled = None  # what the last look at the raw status saw, since the last command
        self.clocked = False  # a bit or byte is on the wire, its end is an alarm

    @property
    def active(self):
        return self._state != i2c.I2CState.IDLE

    @property
    def bit_ns(self):
        return (self.scl_low_period + self.scl_high_period) * 1e9 / HZ

    def read_uint32(self, offset):
        if offset == i2c.IC_RAW_INTR_STAT:  # what the SDK polls
            if self.int_raw == self._polled and self.clocked:
                clock, core = self.rp2040.clock, self.rp2040.core
                ns = clock.nanos_to_next_alarm
                core.cycles += int(ns * HZ / 1e9)
                clock.tick(ns)
            self._polled = self.int_raw
            return self.int_raw
        return super().read_uint32(offset)

    def write_uint32(self, offset, value):
        self._polled = None
        disabled = offset == i2c.IC_ENABLE and self.enable & ~value & i2c.ENABLE and self.active
        super().write_uint32(offset, value)
        if disabled:
            if self._busy:
                self._cut()
            else:
                self._reopened = True  # the next command tells whether it was to be so

    def _cut(self):
        self._state = i2c.I2CState.IDLE
        self._busy = self._stop = self._pending_restart = self._reopened = False
        self.on_cut()

    def _next_command(self):
        fifo = self._tx_fifo
        if fifo.empty or self._busy or self.enable & i2c.TX_CMD_BLOCK or not self.enable & 1:
            return
        if self._reopened and self.active and not fifo.peek() & i2c.RESTART:
            self._cut()
        self._reopened = False
        self._busy = True
        restart = bool(fifo.peek() & i2c.RESTART) and not self._pending_restart and not self._stop
        if self._state == i2c.I2CState.IDLE or restart:
            self._pending_restart = restart
            self._stop = False
            self._state = i2c.I2CState.START
            self.on_start(restart)
            return
        self._pending_restart = False
        command = fifo.pull()
        self._stop = bool(command & i2c.STOP)
        if command & i2c.CMD:
            self.on_read_byte(not self._stop)
        else:
            self.on_write_byte(command & 0xFF)

    def _shifted_out(self):
        if self._tx_fifo.item_count <= self.tx_threshold:
            self._set_interrupts(i2c.R_TX_EMPTY)

    def complete_write(self, ack):
        if ack:
            self._shifted_out()
        super().complete_write(ack)

    def complete_read(self, value):
        self._shifted_out()
        super().complete_read(value)

    def _abort(self, reason):
        super()._abort(reason)
        self._shifted_out()


def spi_clock(mcu: RP2040, number: int) -> tuple[float, int, int]:
    """-> (SCK in Hz, mode, bits of a word) that an SPI block is set to.

    Defects of RPSPI's own properties: modes 2 and 3 change places, and the clock is reckoned from 125 MHz though the
    firmware feeds the peripherals from the USB's PLL.
    """
    block = mcu.spi[number]
    control = block.read_uint32(_SSPCR0)
    source = mcu.clocks.read_uint32(_CLK_PERI_CTRL) >> 5 & 7
    divisor = block.read_uint32(_SSPCPSR) * (1 + (control >> 8 & 0xFF))
    mode = (control >> 6 & 1) << 1 | (control >> 7 & 1)
    return _PERIPHERAL_HZ[source] / divisor, mode, block.data_bits


def level(state: GPIOPinState, undriven: int) -> int:
    """What a pin's state is for a chip on the other end; `undriven`: where nothing but a resistor holds it."""
    if state == GPIOPinState.HIGH:
        return 1
    return 0 if state == GPIOPinState.LOW else undriven
