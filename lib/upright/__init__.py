# Upright: attitude (roll, pitch, yaw) from an MPU6050 or an MPU6500 with an IST8310.
