# Degrees, in five lines. Needs board.py, which `upright flash` installs.

import upright

imu = upright.start()
while True:
    roll, pitch, yaw = imu.angles()
    print(roll, pitch, yaw)
