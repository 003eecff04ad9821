"""Pictures of the OLED: as an image with the look of the glass, as PNG and GIF, and as text for a
terminal.

A picture is a list of rows from the top, each a sequence of 0 and 1 (the `picture()` of the
simulated display); `rows_of_frame` makes one from bytes in the display's own page format (the
`buffer` of the writer).
"""

import sys
from pathlib import Path

from PIL import Image, ImageChops
from rich.panel import Panel
from rich.text import Text

LIT = (168, 236, 255)
_UNLIT = (13, 19, 25)
_GLASS = (3, 5, 8)
_BEZEL = (27, 33, 41)
_EDGE = (58, 68, 80)

# bit of each dot of a braille cell, by row and column (Unicode block 2800)
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_SHADES = " ..::+*##"  # by the dots of a cell
_HALVES = " \u2580\u2584\u2588"


def rows_of_frame(frame: bytes, width: int = 128) -> list[bytearray]:
    """Rows from page-major bytes with the LSB on top."""
    pages = len(frame) // width
    return [
        bytearray(frame[page * width + x] >> bit & 1 for x in range(width))
        for page in range(pages)
        for bit in range(8)
    ]


def image(rows, scale: int = 6, margin: int | None = None, lit=LIT) -> Image.Image:
    """A palette image: `scale` pixels to a dot, a slight gap between dots, the glass's frame."""
    if scale < 1:
        raise ValueError(f"scale must be at least 1, not {scale}")
    height, width = len(rows), len(rows[0])
    margin = 3 * scale if margin is None else margin
    dots = Image.frombytes("L", (width, height), bytes(255 * v for row in rows for v in row))
    dots = dots.resize((width * scale, height * scale), Image.Resampling.NEAREST)
    grid = Image.new("L", dots.size, 255)
    if scale >= 3:
        gap = max(1, scale // 6)
        for i in range(gap):
            grid.paste(0, (0, 0, 0, 0))
            for x in range(scale - 1 - i, width * scale, scale):
                grid.paste(0, (x, 0, x + 1, height * scale))
            for y in range(scale - 1 - i, height * scale, scale):
                grid.paste(0, (0, y, width * scale, y + 1))
    out = Image.new("P", (width * scale + 2 * margin, height * scale + 2 * margin), 0)
    out.putpalette([v for colour in (_BEZEL, _EDGE, _GLASS, _UNLIT, tuple(lit)) for v in colour])
    if margin:
        rim = max(1, scale // 3)
        glass = max(0, margin - scale)
        out.paste(1, (glass - rim, glass - rim, out.width - glass + rim, out.height - glass + rim))
        out.paste(2, (glass, glass, out.width - glass, out.height - glass))
    place = (margin, margin)
    out.paste(2, (*place, margin + dots.width, margin + dots.height))
    out.paste(3, place, grid)
    out.paste(4, place, ImageChops.multiply(dots, grid))
    return out


def save_png(rows, path, scale: int = 6) -> Path:
    """Writes the picture; returns the path."""
    path = Path(path)
    image(rows, scale).save(path, "PNG", optimize=True)
    return path


def save_gif(frames, path, frame_ms: int = 100, scale: int = 4) -> Path:
    """Writes pictures as an endless animation; one that did not change lasts longer."""
    path = Path(path)
    images, times, last = [], [], None
    for rows in frames:
        key = b"".join(bytes(row) for row in rows)
        if key == last:
            times[-1] += frame_ms
            continue
        last = key
        images.append(image(rows, scale))
        times.append(frame_ms)
    if not images:
        raise ValueError("no frames to animate")
    images[0].save(
        path, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0, optimize=False
    )
    return path


def braille(rows) -> list[str]:
    """Two by four dots to a character: 64 columns and 16 lines for 128x64."""
    height, width = len(rows), len(rows[0])
    lines = []
    for y in range(0, height, 4):
        line = []
        for x in range(0, width, 2):
            cell = 0x2800
            for dy in range(min(4, height - y)):
                for dx in range(min(2, width - x)):
                    if rows[y + dy][x + dx]:
                        cell |= _DOTS[dy][dx]
            line.append(chr(cell))
        lines.append("".join(line))
    return lines


def half_blocks(rows) -> list[str]:
    """One by two dots to a character: 128 columns and 32 lines for 128x64."""
    height = len(rows)
    lines = []
    for y in range(0, height, 2):
        lower = rows[y + 1] if y + 1 < height else bytes(len(rows[y]))
        lines.append(
            "".join(_HALVES[bool(a) | bool(b) << 1] for a, b in zip(rows[y], lower, strict=True))
        )
    return lines


def terminal(rows, columns: int = 80, encoding: str = "utf-8") -> list[str]:
    """Lines of text in the largest form that fits so many columns, with a frame around it. Where the encoding has no
    such characters, it is made of others."""
    lines = half_blocks(rows) if columns >= len(rows[0]) + 4 else braille(rows)
    try:
        "".join(lines).encode(encoding)
        return lines
    except UnicodeEncodeError:
        return ["".join(map(_plain, line)) for line in lines]


def _plain(character: str) -> str:
    """An ASCII character for a half block, or one as dark as a braille cell."""
    cell = ord(character) - 0x2800
    return _SHADES[cell.bit_count()] if 0 <= cell < 256 else " '.:"[_HALVES.index(character)]


def panel(rows, columns: int = 80, title: str | None = None, subtitle: str | None = None) -> Panel:
    """The same in a rich panel, for a live display."""
    encoding = sys.stdout.encoding or "utf-8"
    text = Text(
        "\n".join(terminal(rows, columns, encoding)), style="bright_cyan on black", no_wrap=True
    )
    return Panel(text, title=title, subtitle=subtitle, expand=False, border_style="grey42")
