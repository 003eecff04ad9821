# Draws and sends frames with a bus that itself allocates nothing, until 10,000 pieces are sent, and
# prints what happened: under heap_lock, and by mem_alloc with the heap free. With an argument, the
# failing twin: something that does allocate must be noticed. Arguments: [slice | format]

import gc
import sys
from array import array

import micropython
from upright import ssd1306
from upright_app import pages

STEPS = 10000
twin = sys.argv[1] if len(sys.argv) > 1 else ""


class Bus:
    """Takes everything, or fails now and then, as a wire does."""

    failure = OSError(5)

    def __init__(self, fails):
        self.transfers = 0
        self.fails = fails

    def writeto(self, address, data):
        self.transfers += 1
        if twin == "slice":
            data[0:1]
        if self.fails and self.transfers % 97 == 0:
            raise self.failure


class Pins:
    def __call__(self, level):
        pass

    def write(self, data):
        pass


def frame(display, book, k, angles):
    angles[0] = (k * 137) % 360000 - 180000
    angles[1] = (k * 71) % 180000 - 90000
    angles[2] = (k * -53) % 360000 - 180000
    book.draw(k & 1, angles, 200 + k % 7, 3000 + k, k, k & 3)
    if k % 10 == 0:
        display.fill_rect(-3, 60, 50, 50, ssd1306.XOR)
        display.rect(3, 3, 50, 50, ssd1306.XOR)
        display.line(-5, 40, 140, 60, ssd1306.XOR)
        display.pixel(k % 150 - 10, 5)
        display.text("text \u00b0", -7, 30, ssd1306.LARGE, ssd1306.INVERSE)
        display.contrast(k & 255)
        display.invert(k & 1)
    if twin == "format":
        "%d" % k
    display.show()


def run(display, book, angles, used, steps):
    k = 0
    used[0] = gc.mem_alloc()
    while steps > 0:
        frame(display, book, k, angles)
        k += 1
        while display.busy and steps > 0:
            display.flush_step(32)
            steps -= 1
    used[1] = gc.mem_alloc()
    return k


def measure(display, name, locked):
    book = pages.Pages(display)
    angles = array("i", [0, 0, 0])
    used = [0, 0]
    display.begin()
    run(display, book, angles, used, 200)  # globals and attributes come to rest
    gc.collect()
    gc.disable()
    try:
        if locked:
            micropython.heap_lock()
        try:
            frames = run(display, book, angles, used, STEPS)
        finally:
            if locked:
                micropython.heap_unlock()
    except MemoryError:
        print(name, "ALLOCATES")
        return
    finally:
        gc.enable()
    print(name, "frames", frames, "bytes", used[1] - used[0], "errors", display.errors > 0)


# raising an exception takes heap for its traceback where there is any, so failures only when locked
measure(ssd1306.SSD1306(Bus(True)), "i2c-locked", True)
measure(ssd1306.SSD1306(Bus(False)), "i2c-free", False)
pins = Pins()
measure(ssd1306.SSD1306(pins, "SSD1306 128x32", dc=pins, cs=pins), "spi-locked", True)
