# One driver alone, in a loop of one's own at 20 Hz: the chip samples at 200 Hz into its FIFO, and no sample is lost.
# Needs upright/mpu6050.py with its package, and no board.py.

import time

from machine import I2C, Pin
from upright.mpu6050 import MPU6050

imu = MPU6050(I2C(0, scl=Pin(5), sda=Pin(4), freq=400000))
imu.configure(sample_rate_hz=200)
imu.fifo_enable()
samples = 0
due = time.ticks_ms()
while True:
    n = imu.fifo_poll()
    while n:
        if imu.fifo_next() & 1:  # a sample in imu.counts
            samples += 1
            up = imu.counts[2] / imu.accel_lsb_per_g
        n -= 1
        if not n:
            n = imu.fifo_poll()  # what is left in the chip
    imu.health()  # a chip that has reset itself is set up again
    if samples:
        print(samples, "samples, z feels", up, "g, lost", imu.fifo_lost)
    due = time.ticks_add(due, 50)
    time.sleep_ms(max(0, time.ticks_diff(due, time.ticks_ms())))
