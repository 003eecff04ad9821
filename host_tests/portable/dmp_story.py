# What happens to a DMP from its first loading to a supply dip, told by its driver: the same on every runtime. Needs the
# simulator and lib/; prints deterministic text. The image is a stand-in.

import kernel
import machine
from chips.mpu6050 import MPU6050Chip
from chips.mpu6500 import MPU6500Chip
from upright.dmp import MpuDmp, MpuDmpError
from upright.mpu6050 import MPU6050
from upright.mpu6500 import MPU6500
from world import StillWorld

PATCHES = bytes((3, 0x7B, 3, 1, 2, 3, 0, 0, 0, 1, 7, 0x86, 1, 0xFE))


def image(size):
    return bytes([(i * i * 37 + i * 11 + (i >> 3)) & 255 for i in range(size)])


def tell(dmp, what):
    print(
        what,
        kernel.now(),
        list(dmp.counts),
        list(dmp.state)[1:5],
        dmp.stale,
        dmp.skipped,
        dmp.misaligned,
        dmp.stalls,
        dmp.reloads,
        dmp.errors,
        dmp.resets,
        dmp.fifo_overflows,
        dmp.fifo_lost,
        dmp.needs_reload,
    )


def live(chip, imu, file, axes, reload):
    chip.dmp.images.append(file)
    try:
        MpuDmp(imu, file)
    except MpuDmpError as why:
        print(why)
    dmp = MpuDmp(imu, file, 200, accept_unknown=True, axes=axes)
    dmp.configure()
    tell(dmp, dmp.version)
    for i in range(300):
        kernel.advance(4900 if i != 60 else 500_000)
        if i == 100:
            chip.nack_next(1, after=3)
        if i == 150:
            chip.brown_out(kernel.now())
        if i == 220 and reload:
            dmp.reload()
        dmp.read()
        state = dmp.health()
        if state or i % 25 == 0:
            tell(dmp, "%d: %d" % (i, state))
    print(chip.misuse)


def main():
    world = StillWorld((500, -900, 3900, 40, -30, 20))
    chip = MPU6050Chip(world, clock_ppm=2000)
    machine.wire_i2c(0, chip)
    live(chip, MPU6050(machine.I2C(0, freq=400_000)), image(3062), ("x", "y", "z"), True)
    machine.power_on()
    chip = MPU6500Chip(world)
    machine.wire_spi(5, chip, cs="PF6")
    imu = MPU6500(machine.SPI(5, 1_000_000), machine.Pin("PF6", machine.Pin.OUT, value=1))
    live(chip, imu, image(1929) + PATCHES, ("z", "-y", "x"), False)


main()
