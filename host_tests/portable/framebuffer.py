# Two display drivers in one program: ours, drawn with framebuf, and another one's ssd1306.py in the folder that the
# first argument names. Prints a line for each panel that shows what was drawn.

import sys

import machine
from chips.ssd1306 import SSD1306Chip

sys.path.insert(0, sys.argv[1])
import ssd1306  # found only now
from upright.ssd1306 import SSD1306

for width, height in ((128, 64), (72, 40)):
    machine.power_on()
    chip = SSD1306Chip(width=width, height=height)
    machine.wire_i2c(0, chip)
    display = SSD1306(machine.I2C(0), "SSD1306 %dx%d" % (width, height))
    display.begin()
    drawing = display.framebuffer
    drawing.text("framebuf", 3, 5)
    drawing.line(0, height - 1, width - 1, 0, 1)
    drawn = set()
    for y in range(height):
        for x in range(width):
            if drawing.pixel(x, y):
                drawn.add((x, y))
    display.show()
    display.flush()
    seen = chip.picture()
    shown = set((x, y) for y in range(height) for x in range(width) if seen[y][x])
    assert shown == drawn and len(drawn) > 100, (len(shown), len(drawn))
    assert (width - 1, 0) in shown and (0, height - 1) in shown
    print(width, height, "shown")
print(ssd1306.SSD1306_I2C(128, 64, None).width)
