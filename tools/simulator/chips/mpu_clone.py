# A simulated part that is sold as an MPU6050 and is not quite one: each habit that users have reported, by itself.
# Needs mpu6050.py beside it. Portable: CPython and the MicroPython unix port.

from micropython import const

from chips.mpu6050 import MPU6050Chip

_ACCEL_CONFIG2 = const(0x1D)
_DATA_RDY = const(0x01)


class MPU6050Clone(MPU6050Chip):
    """An MPU6050 but for what is asked for.

    who_am_i       0x72 is a common one
    family_6500    like an MPU6500 after reset: awake, and with its temperature scale
    fifo_size      bytes
    data_ready     DATA_RDY of INT_STATUS: "enabled" (with its bit of INT_ENABLE), "always" (without it, too), "never"
                   (as in simulators that have no INT_STATUS)
    accel_config2  False: what is written to that register is lost

    And at any time: freeze() and zeros(). The other arguments are MPU6050Chip's.
    """

    def __init__(
        self,
        world,
        who_am_i=0x72,
        family_6500=False,
        fifo_size=512,
        data_ready="enabled",
        accel_config2=True,
        **options,
    ):
        self._like_6500 = family_6500
        self._size = fifo_size
        self._ready = data_ready
        self._accel_config2 = accel_config2
        self._frozen = self._zero = False
        MPU6050Chip.__init__(self, world, who_am_i=who_am_i, **options)

    def freeze(self, on=True):
        """Every sample from now on is the newest one once more; not even a reset mends that."""
        self._frozen = on

    def zeros(self, on=True):
        """Every register reads 0, and is acknowledged."""
        self._zero = on

    def _of_6500(self, who_am_i):
        return self._like_6500

    def _fifo_size(self):
        return self._size

    def _measure(self):
        return list(self._words) if self._frozen else MPU6050Chip._measure(self)

    def _data_ready(self, at):
        if self._ready != "never":
            MPU6050Chip._data_ready(self, at)
        if self._ready == "always":
            self._status |= _DATA_RDY

    def _set(self, register, value):
        if register != _ACCEL_CONFIG2 or self._accel_config2:
            MPU6050Chip._set(self, register, value)

    def _power_on_reset(self):
        words = getattr(self, "_words", None)
        MPU6050Chip._power_on_reset(self)
        if self._frozen:
            self._words = words

    def i2c_read(self, now):
        value = MPU6050Chip.i2c_read(self, now)
        return 0 if self._zero else value
