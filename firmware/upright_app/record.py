# Records raw counts for `upright calibrate`. `upright record` loads it into the board's RAM and receives the rows.
# Needs upright/settings.py and a board.py. Every port; the application must not run meanwhile.

import json
import os
import time
from array import array

import upright
from micropython import const
from upright.settings import Settings, of_board

_WORDS = const(11)
_BLOCK = const(64)  # rows to a write: 1408 bytes
_SPARE = const(8192)  # bytes of the file system that stay free
_SILENT_US = const(2000000)


def run(path="recording.imu", seconds=60, rate_hz=100, board=None, file=None):
    """Write the counts of `seconds` to `path`, in the chips' own frames; Ctrl-C ends it earlier.

    rate_hz  of the chip and of the rows; a board's flash keeps up with 100 Hz. Samples that were missed during a write
             have a row that is marked as not fresh.
    board    the board's module; None: board.py
    file     an object with write and seek, in place of a file of that name

    Returns the number of rows. Raises the driver's error when there is no sensor, OSError when the
    file cannot be written or is too large for the file system.
    """
    if board is None:
        import board
    upright.stop()  # a tick that was left running would go on using the bus
    imu, mag = _open(board, rate_hz)
    num, den = imu.sample_rate
    rows = max(1, seconds * num // den)
    free = _free(path) if file is None else None
    if free is not None and rows * 2 * _WORDS > free:
        raise OSError(
            "%d s take %d bytes, %d are free: fewer seconds, or a lower rate_hz"
            % (seconds, rows * 2 * _WORDS, free)
        )
    print("recording %d s at %d/%d Hz; Ctrl-C ends it" % (seconds, num, den))
    header = _header(board, imu, mag, path)
    if file is not None:
        return _record(path, file, header, imu, mag, rows)
    with open(path, "wb") as file:
        n = _record(path, file, header, imu, mag, rows)
    print("fetch it:  mpremote cp :%s ." % path)
    print("then:      upright calibrate mag (or gyro, accel) %s" % path[path.rfind("/") + 1 :])
    return n


def _record(path, file, header, imu, mag, rows):
    recorder = _Recorder(file, header, rows)
    num, den = imu.sample_rate
    try:
        recorder.record(imu, mag, num, den)
        print("done")
    except KeyboardInterrupt:
        print("ended")
    finally:
        recorder.finish()
    print("%s: %d rows, %d of them missed" % (path, recorder.n, recorder.lost))
    return recorder.n


class _Recorder:
    """Writes rows into a file, in blocks. n: rows so far; lost: rows that are not fresh."""

    def __init__(self, file, header, rows):
        self._file = file
        self._header = header
        self._rows = rows
        self._block = array("h", [0] * (_WORDS * _BLOCK))
        self._written = 0
        self.n = self.lost = 0
        file.write(header % rows)

    def record(self, imu, mag, num, den):
        period = 1000000 * den // num
        counts = imu.counts
        # 2.25 reads a sample: the phase moves on with each read. A fixed phase could fall between a sample and the
        # bytes of the auxiliary bus, and magnetometer samples would be lost
        step = period * 4 // 9
        last = due = time.ticks_us()
        while self.n < self._rows:
            flags = imu.read()
            now = time.ticks_us()
            passed = time.ticks_diff(now, last)
            if flags & 1:
                # a magnetometer on a bus of its own is read with the IMU's sample
                if mag is not None and mag.own_bus:
                    mag.read(counts)
                missed = (passed + period // 2) // period - 1 if self.n else 0
                while missed > 0 and self.n < self._rows - 1:
                    self._row(counts, 0)
                    self.lost += 1
                    missed -= 1
                self._row(counts, counts[10])
                last = now
            elif passed > _SILENT_US:
                raise OSError("no sample for %d s" % (_SILENT_US // 1000000))
            imu.health()
            due = time.ticks_add(due, step)
            early = time.ticks_diff(due, time.ticks_us())
            if early > 0:
                time.sleep_us(early)
            else:
                due = time.ticks_us()

    def _row(self, counts, flags):
        at = (self.n - self._written) * _WORDS
        for i in range(10):
            self._block[at + i] = counts[i]
        self._block[at + 10] = flags
        self.n += 1
        if self.n - self._written == _BLOCK:
            self._file.write(self._block)
            self._written = self.n

    def finish(self):
        """Write the last rows, and correct the number of rows in the header."""
        # Ctrl-C may have come between a block's write and its count: the block is written again, in its place
        self._file.seek(len(self._header % self._rows) + self._written * 2 * _WORDS)
        self._file.write(memoryview(self._block)[: (self.n - self._written) * _WORDS])
        if self.n != self._rows:
            self._file.seek(0)
            self._file.write(self._header % self.n)


def _open(board, rate_hz):
    settings = Settings(of_board(board))
    imu = board.sensor()
    # no dlpf: the filter follows the rate, which prevents aliasing
    imu.configure(settings.ACCEL_RANGE_G, settings.GYRO_RANGE_DPS, sample_rate_hz=rate_hz)
    print("sensor: %s, %d/%d Hz" % ((imu.chip,) + imu.sample_rate))
    if not hasattr(board, "magnetometer"):
        return imu, None
    try:
        mag = board.magnetometer(imu)
        mag.configure(rate_hz=min(settings.MAG_RATE_HZ, rate_hz), sample_rate=imu.sample_rate)
        print("magnetometer: %s, %d/%d Hz" % ((mag.chip,) + mag.sample_rate))
        return imu, mag
    except OSError as why:
        print("magnetometer: %s; recording without it" % why)
        return imu, None


def _header(board, imu, mag, path):
    """The first line of an .imu file, with a place of 8 digits for the number of rows."""
    fields = {
        "format": "upright-imu",
        "version": 1,
        "name": path,
        "rate": imu.sample_rate,
        "accel_lsb_per_g": imu.accel_lsb_per_g,
        "gyro_scale": imu.gyro_scale,
        "clocked": True,
        "chip": imu.chip,
        "board": board.NAME,
    }
    if mag is not None:
        fields["mag_lsb_per_uT"] = mag.lsb_per_uT
    line = json.dumps(fields).replace("%", "%%").encode()
    return line[:-1] + b', "rows": %8d}\n'


def _free(path):
    """Bytes that may be written, or None if the port does not say."""
    if not hasattr(os, "statvfs"):
        return None
    found = os.statvfs(path[: path.rfind("/") + 1] or ".")
    return found[0] * found[3] - _SPARE
