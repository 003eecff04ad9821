# The application: starts the board's AHRS and shows the angles on the display. It uses only the calls of `upright`.
# Needs board.py. Every port.

import time
from array import array

import machine
import upright
from micropython import const

from upright_app import pages

_FRAME_MS = const(100)
_RETRY_MS = const(1000)
# The faults are kept in this file, for the doctor: so long after the first one, and not more often than that
FAULTS = "upright_faults.txt"
_KEEP_AFTER_MS = const(5000)
_KEEP_EVERY_MS = const(600000)
# What machine.reset_cause() may give: each port has some of these names.
_CAUSES = (
    ("PWRON_RESET", "power-on"),
    ("HARD_RESET", "reset pin or machine.reset()"),
    ("WDT_RESET", "watchdog"),
    ("BROWN_OUT_RESET", "supply too low"),
    ("DEEPSLEEP_RESET", "deep sleep"),
    ("SOFT_RESET", "soft reset"),
)


def reset_cause():
    """Why the board has started, in words."""
    if not hasattr(machine, "reset_cause"):
        return "unknown: this port does not say"
    cause = machine.reset_cause()
    for name, words in _CAUSES:
        if cause == getattr(machine, name, None):
            return words
    return "cause %r" % cause


class App:
    """One board's application: run() never returns. imu: the board's AHRS."""

    def __init__(self):
        self.imu = imu = upright.from_board(say=self.say)
        self.angles = array("i", [0] * 3)  # roll, pitch, yaw in millidegrees
        self._status = array("i", [-1] * pages.STATUS_WORDS)
        self._page = 0
        self._pages = None if imu.display is None else pages.Pages(imu.display)
        self._frame_at = self._page_at = time.ticks_ms()
        self._reported = 0
        self._watchdog = None
        self._fed_at = 0  # fresh samples when the watchdog was last fed
        self._cause = ""
        self._kept = 0  # entries of the black box that are in the file
        self._fault_at = self._kept_at = None
        self._restarted = None  # what the first message of a start says about the one before

    def run(self):
        """Run for ever. Only a wrong setting, a Ctrl-C, or the watchdog's reset end it."""
        self.tell_cause()
        self.start()
        self.start_watchdog()
        try:
            while True:
                try:
                    self.poll()
                    machine.idle()
                except Exception as why:
                    self.recover(why)
        except KeyboardInterrupt:
            self.keep_faults()
            raise

    def tell_cause(self):
        self._cause = cause = reset_cause()
        print("started by:", cause)
        if cause == "watchdog":
            self._restarted = "watchdog reset"

    def start(self):
        """Try until the sensor answers. Raises ValueError for a wrong setting: board.py must change."""
        imu = self.imu
        print("upright on", imu.board)
        while True:
            try:
                imu.start()
                return
            except OSError as why:
                print("sensor:", why)
                self.say("No sensor", str(why))
            except (ValueError, TypeError) as why:
                self.say("Wrong setting", str(why))
                raise
            time.sleep_ms(_RETRY_MS)

    def recover(self, why):
        """The main loop has raised: show why, and start again until that works."""
        self._restarted = repr(why)
        self._reported = 0
        while True:
            print("stopped by %r; starting again" % why)
            try:
                self.imu.stop()
                self.keep_faults()
                self.say("Starting again", repr(why))
                time.sleep_ms(_RETRY_MS)
                self.imu.start()
                return
            except Exception as another:
                why = another

    def start_watchdog(self):
        """It runs from the first attitude on, and poll() feeds it while fresh samples come."""
        timeout = self.imu.settings.WATCHDOG_MS
        if not timeout:
            print(
                "watchdog: off, since no port can stop it again; WATCHDOG_MS = 8000 in board.py turns it on"
            )
        elif not hasattr(machine, "WDT"):
            print("watchdog: this port has none")
        else:
            try:
                self._watchdog = machine.WDT(timeout=timeout)
                print("watchdog: resets the board after %d ms without a fresh sample" % timeout)
            except TypeError:
                self._watchdog = machine.WDT()  # esp8266
                print("watchdog: resets the board after the time that its system sets")

    def poll(self):
        """One turn of the main loop: never waits."""
        imu = self.imu
        busy = True if imu.display is None else imu.refresh_display()
        now = time.ticks_ms()
        if time.ticks_diff(now, self._frame_at) >= _FRAME_MS:
            self._frame_at = now
            imu.angles_into(self.angles)
            status = imu.status()
            if self._watchdog is not None and status["fresh"] != self._fed_at:
                self._fed_at = status["fresh"]
                self._watchdog.feed()
            if status["crashes"] != self._reported:
                self._reported = status["crashes"]
                print("tick: %d exceptions, last: %r" % (self._reported, status["error"]))
            self._watch_faults(now, status["at_rest"] is not False or status["sensor_lost"])
            if not busy:
                self._draw(now, status)

    def _watch_faults(self, now, idle):
        """Keep new faults, rarely, and not in motion: a write to the flash blocks everything for some hundredths of a
        second on most boards."""
        if self.imu.black_box.total == self._kept:
            self._fault_at = None
        elif self._fault_at is None:
            self._fault_at = now
        elif idle and time.ticks_diff(now, self._fault_at) >= _KEEP_AFTER_MS:
            kept = self._kept_at
            if kept is None or time.ticks_diff(now, kept) >= _KEEP_EVERY_MS:
                self._kept_at = now
                self.keep_faults()

    def keep_faults(self):
        """Write the last faults into the file, if there are new ones."""
        entries = self.imu.faults()
        if self.imu.black_box.total == self._kept:
            return
        self._kept = self.imu.black_box.total
        try:
            with open(FAULTS, "w") as file:
                file.write(
                    "written %d s after the clock's start; started by: %s\n"
                    % (time.ticks_ms() // 1000, self._cause)
                )
                for name, count, first, last in entries:
                    file.write(
                        "%.1f s before: %s %d, over %.1f s\n" % (last, name, count, first - last)
                    )
        except OSError as why:
            print("faults: not kept:", why)
        self.imu.faults()
        self._kept = (
            self.imu.black_box.total
        )  # ticks that the write has cost are no reason for another one

    def _draw(self, now, status):
        seconds = self.imu.settings.PAGE_SECONDS
        if seconds and time.ticks_diff(now, self._page_at) >= seconds * 1000:
            self._page_at = now
            self._page = (self._page + 1) % pages.COUNT
        flags = 0 if status["bias_known"] else pages.BIAS_UNKNOWN
        if status["sensor_lost"]:
            flags |= pages.SENSOR_LOST
        if status["magnetometer_lost"]:
            flags |= pages.MAG_LOST
        doubt = status["heading_uncertainty"]
        if doubt is not None and doubt * 1000 > pages.YAW_DOUBT_MDEG:
            flags |= pages.YAW_DOUBTFUL
        if self._page == pages.STATUS:
            self._fill_status(status)
        self._pages.draw(
            self._page,
            self.angles,
            status["rate_hz"],
            round(self.imu.temperature() * 100),
            status["faults"],
            flags,
            self._status,
        )
        self.imu.display.show()

    def _fill_status(self, status):
        """Fill the words of the status page; a filter without a value leaves -1."""
        words = self._status
        for i in range(3):
            words[pages.BIAS + i] = round(status["bias_dps"][i] * 1000)
        if status["at_rest"] is not None:
            words[pages.REST] = 1 if status["at_rest"] else 0
            words[pages.DOUBT] = round(status["heading_uncertainty"] * 1000)
        if status["field_accepted"] is not None:
            lost = status["magnetometer_lost"]
            words[pages.FIELD] = 0 if lost else 1 if status["field_accepted"] else 2

    def say(self, title, *lines):
        """Show a message on the display while the main program owns its bus. The console has its own messages."""
        display = self.imu.display
        if display is not None:
            if self._restarted and title == "Upright":
                lines += (self._restarted,)
                self._restarted = None
            self._pages.message(title, *lines)
            display.show()
            while display.busy:
                display.flush_step(self.imu.settings.DISPLAY_CHUNK)
