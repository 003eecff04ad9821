# What happens to an MPU6500 on SPI in a bad second, told by its driver: the same on every runtime. Needs the simulator
# and lib/; prints deterministic text.

import kernel
import machine
from chips.mpu6500 import MPU6500Chip
from upright.mpu6500 import MPU6500
from world import StillWorld


class Ext:
    """Something behind the samples."""

    def take(self, raw, at, counts):
        counts[6] = raw[at]
        return 2

    def health(self):
        return 0


def tell(imu, what):
    print(
        what,
        kernel.now(),
        list(imu.counts),
        imu.errors,
        imu.stale,
        imu.resets,
        imu.fifo_overflows,
        imu.fifo_resets,
        imu.fifo_lost,
        imu.temperature_cdeg(),
    )


def main():
    chip = MPU6500Chip(StillWorld((25, -50, 4000, 5, -6, 7, 0, 0, 0, -521)), clock_ppm=3000)
    machine.wire_spi(5, chip, cs="PF6")
    cs = machine.Pin("PF6", machine.Pin.OUT, value=1)
    imu = MPU6500(machine.SPI(5, 1_000_000), cs)
    imu.configure(accel_range_g=2, gyro_range_dps=250)
    print(imu.chip, imu.burst_hz, imu.sample_rate, imu.gyro_scale, imu.bandwidth_hz)
    imu.attach(Ext(), 8)
    for i in range(400):
        kernel.advance(990)
        if i == 100:
            chip.brown_out(kernel.now())
        if i == 250:
            chip.vanish()
        if i == 260:
            chip.come_back()
        flags = imu.read()
        state = imu.health()
        if state or not flags & 1 or i % 50 == 0:
            tell(imu, "%d: %d %d" % (i, flags, state))
    imu.attach(None, 0)
    imu.fifo_enable(8)
    for i in range(60):
        kernel.advance(2000 if i != 20 else 60_000)
        n = imu.fifo_poll()
        for _ in range(n):
            imu.fifo_next()
        tell(imu, "fifo %d" % n)
    imu.fifo_disable()
    chip.broken = (3,)
    print(imu.self_test(), chip.misuse)


main()
