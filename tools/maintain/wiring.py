"""Draws the wiring pictures of the I2C boards, boards/<name>/wiring.svg: which pin goes to which of the modules.

.venv/bin/python tools/maintain/wiring.py
"""

from pathlib import Path

from upright_host import paths

# Signal: colour, pin of the MPU6050 module (GY-521), pin of the SSD1306 module
_SIGNALS = {
    "3V3": ("#c0392b", "VCC", "VCC"),
    "GND": ("#2c3e50", "GND", "GND"),
    "SDA": ("#2471a3", "SDA", "SDA"),
    "SCL": ("#b7950b", "SCL", "SCL"),
    "INT": ("#7d8a8f", "INT", None),
}
_PICO = {
    "3V3": "3V3(OUT), pin 36",
    "GND": "GND, pin 38",
    "SDA": "GP4, pin 6",
    "SCL": "GP5, pin 7",
    "INT": "GP6, pin 9",
}
# Modules in place of the GY-521: {folder: (name, {signal: its pin})}
MODULES = {
    "gy87_pico": ("GY-87 or GY-86", {"3V3": "3.3V", "INT": "INTA"}),
    "mpu9250_pico": ("MPU9250 (GY-9250)", {}),
}
# folder: (name, {signal: what is printed at the board's pin})
BOARDS = {
    "pico": ("Raspberry Pi Pico", _PICO),
    "gy87_pico": ("Raspberry Pi Pico", _PICO),
    "mpu9250_pico": ("Raspberry Pi Pico", _PICO),
    "pico_w": ("Raspberry Pi Pico W", _PICO),
    "pico2": ("Raspberry Pi Pico 2", _PICO),
    "pico2_w": ("Raspberry Pi Pico 2 W", _PICO),
    "esp32": (
        "ESP32 DevKitC",
        {"3V3": "3V3", "GND": "GND", "SDA": "IO21", "SCL": "IO22", "INT": "IO19"},
    ),
    "esp32_s3": (
        "ESP32-S3",
        {"3V3": "3V3", "GND": "GND", "SDA": "GPIO8", "SCL": "GPIO9", "INT": "GPIO4"},
    ),
    "esp32_c3": (
        "ESP32-C3",
        {"3V3": "3V3", "GND": "GND", "SDA": "GPIO6", "SCL": "GPIO7", "INT": "GPIO10"},
    ),
    "pyboard": (
        "Pyboard",
        {"3V3": "3V3", "GND": "GND", "SDA": "X10", "SCL": "X9", "INT": "X1"},
    ),
    "weact_f411_blackpill": (
        "WeAct F411 Black Pill",
        {"3V3": "3V3", "GND": "G", "SDA": "B7", "SCL": "B6", "INT": "B0"},
    ),
}


def draw(folder: str) -> str:
    """The picture as SVG text."""
    name, pins = BOARDS[folder]
    module, renamed = MODULES.get(folder, ("MPU6050 (GY-521)", {}))
    out = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 720 330" font-family="sans-serif">',
        '<rect width="720" height="330" fill="#ffffff"/>',
        _box(20, 20, 200, 290, "#1e6f50", name),
        _box(500, 20, 200, 150, "#2e4a7d", module),
        _box(500, 190, 200, 120, "#3b3b3b", "SSD1306 128x64"),
    ]
    for i, (signal, (colour, imu, oled)) in enumerate(_SIGNALS.items()):
        y = 75 + 48 * i
        lane = 270 + 40 * i
        at = 62 + 23 * i
        out.append(_wire(colour, [(220, y), (lane, y), (lane, at), (500, at)], signal == "INT"))
        out.append(_pin(510, at, renamed.get(signal, imu), "start"))
        if oled:
            below = 234 + 22 * i
            out.append(_wire(colour, [(lane, y), (lane, below), (500, below)], False))
            out.append(f'<circle cx="{lane}" cy="{y}" r="4" fill="{colour}"/>')
            out.append(_pin(510, below, oled, "start"))
        out.append(_pin(212, y, pins[signal], "end"))
    out.append(
        '<text x="360" y="322" font-size="12" fill="#555" text-anchor="middle">dashed: only with DRIVE = '
        '"data_ready"</text>'
    )
    return "\n".join([*out, "</svg>", ""])


def _box(x, y, width, height, colour, name):
    return (
        f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="10" fill="{colour}"/>'
        f'<text x="{x + width / 2}" y="{y + 20}" font-size="15" font-weight="bold" fill="#fff" '
        f'text-anchor="middle">{name}</text>'
    )


def _wire(colour, points, dashed):
    path = " ".join(f"{x},{y}" for x, y in points)
    dash = ' stroke-dasharray="7 5"' if dashed else ""
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="3"{dash}/>'


def _pin(x, y, text, anchor):
    return (
        f'<text x="{x}" y="{y + 5}" font-size="14" fill="#fff" text-anchor="{anchor}">{text}</text>'
    )


def path_of(folder: str) -> Path:
    return paths.BOARDS / folder / "wiring.svg"


if __name__ == "__main__":
    for folder in BOARDS:
        path_of(folder).write_text(draw(folder))
        print(path_of(folder).relative_to(paths.ROOT))
