# A balancing robot: pitch and its rate of the same step, 200 times a second, in the interrupt of the tick itself.

from array import array

import micropython
import upright
from micropython import const

KP = const(40)  # of 1000, for each degree
KD = const(3)  # of 1000, for each degree/s

angles = array("i", [0] * 3)  # roll, pitch, yaw in millidegrees
rates = array("i", [0] * 3)  # about x, y, z in millidegrees/s
power = array("i", [0])  # for the motors, -1000..1000


# It allocates nothing: integers below 2**30, arrays made before. What it raises is counted in imu.status().
@micropython.native
def balance(imu):
    imu.angles_into(angles)
    imu.rates_into(rates)
    command = (KP * angles[1] + KD * rates[1]) // 1000
    power[0] = max(-1000, min(1000, command))
    # motor.duty_u16(...) of a machine.PWM belongs here: it does not allocate either


with upright.start(rate=200, on_step=balance) as imu:
    while True:
        reading = imu.wait()  # the program is free for everything else
        if reading.step % 20 == 0:
            print("step", reading.step, "pitch", reading.angles()[1], "power", power[0])
