# Do the drivers of magnetometers and the auxiliary bus allocate in the tick? 2,000 ticks each of read, health, recovery
# and transactions, behind an IMU and on a bus of their own, with the heap locked and with it open. Argument: the chip.
# Needs only lib/; runs on every MicroPython. Prints a line each, and exits with 1 if one failed.

import sys
from array import array

import allocation
from memory_chip import Watched
from upright import magnetometers
from upright.auxiliary_bus import AUX_BUSY, AuxiliaryBus
from upright.mpu6050 import MPU6050

TICKS = 2_000
Driver = magnetometers.driver(sys.argv[1])
MAG = {"AK8963": 0x0C, "HMC5883L": 0x1E, "IST8310": 0x0E, "QMC5883L": 0x0D}[Driver.chip]
BIG_ENDIAN = Driver.LAYOUT[0] > Driver.LAYOUT[1]
CONFIGURATION = {"AK8963": 0x0C, "HMC5883L": 0x01, "IST8310": 0x41, "QMC5883L": 0x0B}[Driver.chip]


class Registers(Watched):
    """An IMU that is nothing but memory, with a magnetometer of the same kind behind its slot 4 and at its own
    address: no call here allocates, if it raises nothing."""

    def __init__(self):
        Watched.__init__(self)
        self.memory = bytearray(128)
        self.memory[0x75] = 0x68
        self.mag = bytearray(128)
        self.identify()
        self.status = 0  # I2C_MST_STATUS
        self.asleep = False  # the auxiliary master does nothing
        self.deaf = False  # the magnetometer does not acknowledge
        self.fail = 0  # nobody on the bus
        self.word = 0
        self.drdy = 1

    def identify(self):
        register, identity = Driver.IDENTITY
        for i in range(len(identity)):
            self.mag[register + i] = identity[i]

    def readfrom_mem_into(self, address, register, buffer):
        if self.fail or (address == MAG and self.deaf):
            raise OSError(5)
        if self.watch:
            self.look(register if address != MAG else 128 + register)
        if address == MAG:
            if len(buffer) > 6:
                buffer[0] = self.drdy
                self.measured(buffer, 1)
            elif len(buffer) == 6:
                self.measured(buffer, 0)
            elif register == Driver.STATUS:
                buffer[0] = self.drdy
            else:
                for i in range(len(buffer)):
                    buffer[i] = self.mag[register + i]
        elif register == 0x3A and len(buffer) > 1:
            buffer[0] = 1
            buffer[1] = self.word & 0x7F
            if len(buffer) > 15:
                buffer[15] = self.drdy
                self.measured(buffer, 16)
        elif register == 0x36:
            buffer[0] = self.status
            self.status = 0
        else:
            for i in range(len(buffer)):
                buffer[i] = self.memory[register + i]

    def measured(self, buffer, at):
        self.word = (self.word + 37) & 0x03FF
        high = 0x70 if self.word & 0x0F == 7 else self.word >> 8
        for i in range(at, at + 6, 2):
            buffer[i] = high if BIG_ENDIAN else self.word & 0xFF
            buffer[i + 1] = self.word & 0xFF if BIG_ENDIAN else high
        if len(buffer) == at + 7:
            buffer[at + 6] = 0x08 if self.word & 0x0F == 7 else 0

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
        reset = Driver.RESET
        if reset is not None and register == reset[0]:
            if value & reset[1]:
                self.identify()
            value &= ~reset[1]
        if Driver.chip != "QMC5883L" or register < 0x0D:
            self.mag[register] = value


class Ticks:
    def __init__(self, faults):
        self.bus = Registers()
        self.faults = faults
        self.imu = MPU6050(self.bus, 0x68)
        self.imu.configure(sample_rate_hz=1000, settle=False)
        self.aux = AuxiliaryBus(self.imu)
        self.mag = Driver(self.aux)
        self.mag.configure()
        self.device = self.aux.device(MAG)
        self.direct = Driver(self.bus)
        self.direct.configure(sample_rate=1000)
        self.counts = array("h", bytes(22))
        self.busy = 0
        self.done = 0

    def disturb(self, i):
        bus = self.bus
        bus.drdy = i % 10 == 3
        if i % 500 == 250:
            bus.mag[CONFIGURATION] ^= 0x61  # a reset of the magnetometer
        elif i % 500 == 400 and Driver.RESET is not None:
            bus.mag[Driver.IDENTITY[0]] = 0x55
        elif i % 1000 == 777:
            bus.memory[0x27] = 0  # and of the IMU
        if self.faults:
            bus.deaf = i % 400 > 350 or i % 7 == 3
            bus.fail = i % 10 == 7
            bus.asleep = i % 1000 > 950

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
            outcome = self.device.transact(CONFIGURATION, -1)
        else:
            outcome = self.device.transact(CONFIGURATION, 0x24)
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
        verdict.ticks(name, ticks, judged, ticks.busy > TICKS // 200, *said)
verdict.twin("a bound method", allocation.locked(Ticks(False).keeps_a_bound_method, 1) is not None)
verdict.end()
