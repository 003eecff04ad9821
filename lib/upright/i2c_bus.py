# Before an I2C bus is made: free it from a chip that holds it, and the time-out that it needs.
# Needs nothing; pins are handed in. Every port.

import time

_CLOCKS = 9  # the byte that was cut off, and its acknowledge (UM10204, 3.1.16)
_HALF_US = 5  # of a clock at 100 kHz
_LONGEST = 8 * (14 + 8)  # bytes: eight packets of the FIFO with a magnetometer behind each
_SPARE_US = 1000


def free(scl, sda):
    """Make a chip let go of SDA that a reset of the board has cut off in a read: up to nine clocks, then a stop.

    scl, sda: pins, as Pin(5); afterwards they are open drain. Call it before I2C() takes them. Returns whether both
    lines are high: else one is held low for good, or has no pull-up.
    """
    for pin in (scl, sda):
        pin.init(pin.OPEN_DRAIN, pin.PULL_UP, value=1)
    for _ in range(_CLOCKS):
        if sda():
            break
        for level in (0, 1):
            scl(level)
            time.sleep_us(_HALF_US)
    for pin, level in ((scl, 0), (sda, 0), (scl, 1), (sda, 1)):
        pin(level)
        time.sleep_us(_HALF_US)
    return bool(scl() and sda())


def timeout_us(hz, port="", longest=_LONGEST):
    """I2C's timeout= for a bus at hz: what the longest transfer takes, and a little more.

    port: sys.platform. ESP32 counts in ticks of 10 ms; below two of them a transfer may fail (ESP-IDF 5.5.2 and newer).
    longest: bytes; a FIFO drive's batch is the longest of this library.
    """
    # the addresses and the register are three bytes more
    us = _SPARE_US + 9 * (longest + 3) * 1000000 // hz
    return max(us, 20000) if port == "esp32" else us
