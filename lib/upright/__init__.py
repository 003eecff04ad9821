# Upright: attitude (roll, pitch, yaw) from an MPU6050, MPU6500 or MPU9250, with a magnetometer or without one.
#
#     import upright
#     imu = upright.start()
#     roll, pitch, yaw = imu.angles()
#
# Each function imports what it needs when it is called, so a program that uses one module loads only that one.

__version__ = "0.1.0"


def start(**settings):
    """Start with the sensors and settings of board.py -> AHRS (upright/ahrs.py). A running AHRS is stopped first.

    settings: those of AHRS; they replace the board's: start(rate=100, filter="mahony6", on_step=control).
    """
    stop()
    return from_board(**settings).start()


def from_board(**settings):
    """The same, not started yet: `with upright.from_board() as imu: ...`"""
    try:
        import board
    except ImportError as why:
        if "board" not in str(why):
            raise
        raise ImportError(
            "no board.py here, which `upright flash` installs; without one: "
            "imu = upright.AHRS(MPU6050(i2c)).start()"
        )
    import gc

    gc.collect()  # see filters.py
    from upright import ahrs

    gc.collect()
    return ahrs.from_board(board, **settings)


def AHRS(sensor, rate=200, **options):
    """An AHRS of your own driver object, not started yet; upright/ahrs.py has its options."""
    from upright import ahrs

    return ahrs.AHRS(sensor, rate, **options)


def stop():
    """Stop every running AHRS. After that only the program uses a bus."""
    import sys

    ahrs = sys.modules.get("upright.ahrs")  # nothing runs where nobody has imported it
    if ahrs is not None:
        ahrs.stop()
