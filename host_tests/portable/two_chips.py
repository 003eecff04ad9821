# A program on a simulated bus with two MPU6050, tilted differently: argument its file, seconds. Every runtime.

import sys

import kernel
import machine
from chips.mpu6050 import MPU6050Chip
from world import StillWorld

machine.power_on()
for address, counts in ((0x68, (-1401, 0, 3849)), (0x69, (711, 0, 4034))):  # pitch 20 and -10 deg
    world = StillWorld(counts)
    world.start(0)
    machine.wire_i2c(0, MPU6050Chip(world, address=address), 5, 4)
kernel.stop_at(int(float(sys.argv[2]) * 1000000))
program = {"__name__": "__main__"}
with open(sys.argv[1]) as file:
    code = compile(file.read(), sys.argv[1], "exec")
try:
    exec(code, program)
except kernel.PowerOff:
    pass
for name in ("thigh", "shin"):
    status = program[name].status()
    print(
        name,
        "fresh",
        status["fresh"],
        "of",
        status["steps"],
        "faults",
        status["faults"],
        "cuts",
        machine.I2C(0)._bus.cuts,
        "running",
        status["running"],
    )
