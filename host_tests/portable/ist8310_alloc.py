# Do the magnetometer's driver and the auxiliary bus allocate in the tick? 2,000 ticks each of read, health,
# recovery and transactions, with the heap locked and with it open. Needs only lib/; runs on every
# MicroPython. Prints a line each, and exits with 1 if one failed.

from array import array

import allocation
from memory_chip import Watched
from upright.auxiliary_bus import AUX_BUSY, AuxiliaryBus
from upright.ist8310 import IST8310
from upright.mpu6050 import MPU6050

TICKS = 2_000
MAG = 0x0E


class Registers(Watched):
    """An IMU that is nothing but memory, with a magnetometer of the same kind behind its slot 4 and at its own
    address: no call here allocates, if it raises nothing."""

    def __init__(self):
        Watched.__init__(self)
        self.memory = bytearray(128)
        self.memory[0x75] = 0x68
        self.mag = bytearray(128)
        self.mag[0x00] = 0x10
        self.status = 0  # I2C_MST_STATUS
        self.asleep = False  # the auxiliary master does nothing
        self.deaf = False  # the magnetometer does not acknowledge
        self.fail = 0  # nobody on the bus
        self.word = 0
        self.drdy = 1

    def readfrom_mem_into(self, address, register, buffer):
        if self.fail or (address == MAG and self.deaf):
            raise OSError(5)
        if self.watch:
            self.look(register if address != MAG else 128 + register)
        if address == MAG:
            if len(buffer) == 7:
                self.measured(buffer, 0)
            else:
                buffer[0] = self.mag[register]
        elif register == 0x3A and len(buffer) > 1:
            buffer[0] = 1
            buffer[1] = self.word & 0x7F
            if len(buffer) > 15:
                self.measured(buffer, 15)
        elif register == 0x36:
            buffer[0] = self.status
            self.status = 0
        else:
            for i in range(len(buffer)):
                buffer[i] = self.memory[register + i]

    def measured(self, buffer, at):
        self.word = (self.word + 37) & 0x0FFF
        buffer[at] = self.drdy
        buffer[at + 1] = self.word & 0xFF
        buffer[at + 2] = self.word >> 8
        buffer[at + 4] = 0xFF
        buffer[at + 6] = 0x80 if self.word & 0x0F == 7 else 0  # out of range now and then

    def writeto(self, address, buffer):
        if self.fail or (address == MAG and self.deaf):
            raise OSError(5)
        if self.watch:
            self.look(buffer[0] if address != MAG else 128 + buffer[0])
        register = buffer[0]
        value = buffer[1]
        if address == MAG:
            self.to_mag(register, value)
            return
        if register == 0x6B:
            value &= 0x7F
        elif register == 0x6A:
            value &= 0xF8
        elif register == 0x34 and value & 0x80 and not self.asleep:
            value &= 0x1F
            self.status = 0x40
            if self.deaf:
                self.status = 0x51
            elif self.memory[0x31] & 0x80:
                self.memory[0x35] = self.mag[self.memory[0x32]]
            else:
                self.to_mag(self.memory[0x32], self.memory[0x33])
        self.memory[register] = value

    def to_mag(self, register, value):
        if register == 0x0B and value & 1:
            self.mag[0x00] = 0x10
            value = 0x0C
        self.mag[register] = value


class Ticks:
    def __init__(self, faults):
        self.bus = Registers()
        self.faults = faults
        self.imu = MPU6050(self.bus, 0x68)
        self.imu.configure(sample_rate_hz=1000, settle=False)
        self.aux = AuxiliaryBus(self.imu)
        self.mag = IST8310(self.aux)
        self.mag.configure()
        self.device = self.aux.device(MAG)
        self.direct = IST8310(self.bus)
        self.direct.configure(sample_rate=1000)
        self.counts = array("h", bytes(22))
        self.busy = 0
        self.done = 0

    def disturb(self, i):
        bus = self.bus
        bus.drdy = i % 10 == 3
        if i % 500 == 250:
            bus.mag[0x41] = 0  # a reset of the magnetometer
        elif i % 500 == 400:
            bus.mag[0x00] = 0x55
        elif i % 1000 == 777:
            bus.memory[0x27] = 0  # and of the IMU
        if self.faults:
            bus.deaf = i % 400 > 350 or i % 7 == 3
            bus.asleep = i % 1000 > 950
            bus.fail = i % 10 == 7

    def behind(self, i):
        """The magnetometer behind the IMU: sample, health, repair of both."""
        self.disturb(i)
        self.busy += self.imu.read() >> 1 & 1
        self.imu.health()

    def health(self, i):
        """Its own part of that alone."""
        self.disturb(i)
        self.busy += self.mag.health()

    def alone(self, i):
        """Directly on the bus."""
        self.disturb(i)
        self.busy += self.direct.read(self.counts) >> 1 & 1

    def transactions(self, i):
        self.disturb(i)
        if self.done & 1:
            outcome = self.device.transact(0x41, -1)
        else:
            outcome = self.device.transact(0x41, 0x24)
        if outcome != AUX_BUSY:
            self.done += 1
            self.busy += 1

    # A twin that must be found out

    def keeps_a_bound_method(self, i):
        health = self.mag.health
        health()


verdict = allocation.Verdict()
for name in ("behind", "health", "alone", "transactions"):
    for faults in (True, False):
        ticks = Ticks(faults)
        judged = allocation.judge(ticks, getattr(ticks, name), TICKS, 300, 245)
        mag, direct, imu = ticks.mag, ticks.direct, ticks.imu
        said = "busy", ticks.busy, "errors", mag.errors, direct.errors
        said += "resets", imu.resets, mag.resets, direct.resets
        verdict.ticks(name, ticks, judged, ticks.busy > TICKS // 100, *said)
verdict.twin("a bound method", allocation.locked(Ticks(False).keeps_a_bound_method, 1) is not None)
verdict.end()
