"""Draws docs/pictures/architecture.svg from the imports of the code: `python tools/maintain/draw_imports.py`.

A box is a group of modules that belong together; an arrow means that a module of one imports a module of the other.
A module that no box names is an error, so that a new module gets its place in the picture.
"""

import ast
import fnmatch
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "pictures" / "architecture.svg"
LINE, PAD, WIDTH = 17, 12, 250

# title: (x, y, patterns of module names: folder/module)
BOXES = {
    "tests": (20, 20, ["host_tests/*"]),
    "the command upright": (330, 20, ["tools/upright_host/*", "tools/maintain/*"]),
    "simulator": (640, 20, ["tools/simulator/*"]),
    "application": (330, 120, ["firmware/*"]),
    "board": (640, 120, ["boards/*"]),
    "face": (330, 255, ["upright/__init__", "upright/ahrs", "upright/reading", "upright/settings", "upright/bias",
                        "upright/black_box"]),
    "tick": (330, 385, ["upright/tick", "upright/timing"]),
    "calibration": (640, 385, ["upright/calibration", "upright/trim"]),
    "display": (640, 255, ["upright/ssd1306", "upright/canvas", "upright/font"]),
    "filters": (20, 385, ["upright/filters", "upright/attitude", "upright/fixmath", "upright/*kernels",
                          "upright/inertial*", "upright/mahony", "upright/complementary", "upright/*kalman"]),
    "sensors": (330, 500, ["upright/mpu*", "upright/dmp*"]),
    "magnetometers": (640, 500, ["upright/auxiliary_bus", "upright/magnetometer*", "upright/ist8310", "upright/ak8963",
                                 "upright/hmc5883l", "upright/qmc5883l"]),
    "buses": (640, 650, ["upright/registers", "upright/i2c_bus"]),
}  # fmt: skip
LIB = "lib/upright"  # the frame around the boxes of that folder


def modules() -> dict[str, Path]:
    """Every file of Python that the picture knows, by folder/module."""
    found = {}
    rooms = (
        *(("upright", ROOT / "lib/upright"), ("firmware", ROOT / "firmware")),
        *(("boards", ROOT / "boards"), ("tools/upright_host", ROOT / "tools/upright_host")),
        *(("tools/simulator", ROOT / "tools/simulator"), ("host_tests", ROOT / "host_tests")),
    )
    for room, folder in rooms:
        for path in sorted(folder.rglob("*.py")):
            found[f"{room}/{path.relative_to(folder).with_suffix('')}"] = path
    return found


def box_of(name: str) -> str | None:
    for title, (_, _, patterns) in BOXES.items():
        if any(fnmatch.fnmatch(name, pattern) for pattern in patterns):
            return title
    return None


def imports(path: Path) -> set[str]:
    """The names of `modules()` that a file imports from lib/upright, firmware and the tools."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = node.module.split(".")
            if parts[0] == "upright":
                names = [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
                found |= {f"upright/{name}" for name in names}
            elif parts[0] == "upright_app":
                found.add("firmware/main")
            elif parts[0] == "upright_host":
                found.add("tools/upright_host/cli")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name == "upright":
                    found.add("upright/__init__")
                elif alias.name == "board":
                    found.add("boards/pico/board")
    return found


def arrows(known: dict[str, Path]) -> set[tuple[str, str]]:
    """(box that imports, box that is imported); from outside lib/upright the frame around it is the target."""
    pairs = set()
    for name, path in known.items():
        for target in imports(path):
            inside = not name.startswith("upright/") and target.startswith("upright/")
            pair = box_of(name), LIB if inside else box_of(target)
            if pair[0] != pair[1] and None not in pair:
                pairs.add(pair)
    return pairs


def draw(known: dict[str, Path]) -> str:
    shapes, where, inside = [], {}, []
    for title, (x, y, _) in BOXES.items():
        mine = [n for n in known if box_of(n) == title]
        if mine and mine[0].startswith("upright/"):
            lines = _wrapped([n.partition("/")[2] + ".py" for n in mine])
            inside.append(title)
        else:
            lines = [_ROOMS[title]]
        height = PAD * 2 + LINE * (1 + len(lines))
        where[title] = (x, y, WIDTH, height)
        shapes.append(f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{height}" rx="6"/>')
        shapes.append(f'<text x="{x + PAD}" y="{y + PAD + 12}" class="title">{title}</text>')
        for k, line in enumerate(lines):
            shapes.append(f'<text x="{x + PAD}" y="{y + PAD + 12 + LINE * (k + 1)}">{line}</text>')
    left, top = (min(where[title][k] for title in inside) - PAD for k in (0, 1))
    right, bottom = (max(where[t][k] + where[t][k + 2] for t in inside) + PAD for k in (0, 1))
    top -= 2 * LINE
    where[LIB] = (left, top, right - left, bottom - top)
    frame = (
        f'<rect x="{left}" y="{top}" width="{right - left}" height="{bottom - top}" class="frame"/>'
    )
    name = f'<text x="{left + PAD}" y="{top + 20}" class="title">{LIB}</text>'
    lines = [_arrow(where, a, b) for a, b in sorted(arrows(known))]
    parts = "\n".join([frame, name, *lines, *shapes])
    return _SVG.format(width=right + 8, height=bottom + 8, parts=parts)


# What a box says whose modules are too many to name
_ROOMS = {
    "the command upright": "tools/upright_host",
    "tests": "host_tests",
    "simulator": "tools/simulator",
    "application": "firmware: main.py, upright_app",
    "board": "boards/NAME/board.py",
}
_SVG = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif"
 font-size="13">
<style>rect {{ fill: #fff; stroke: #345; }} .title {{ font-weight: bold; }} .frame {{ fill: #e8eef4; }}
line {{ stroke: #678; stroke-width: 1.5; }}</style>
<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" orient="auto">
<path d="M0 0 10 5 0 10z" fill="#678"/></marker></defs>
<rect width="{width}" height="{height}" style="fill: #f6f8fa; stroke: none"/>
{parts}
</svg>
"""


def _wrapped(words: list[str]) -> list[str]:
    """Words in lines that fit into a box."""
    lines = []
    for word in words:
        if lines and len(lines[-1]) + len(word) < 30:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def _arrow(where, a: str, b: str) -> str:
    """From the edge of one box to that of another, on the line between their centres; straight down to the frame."""
    (ax, ay), (bx, by) = ((x + w / 2, y + h / 2) for x, y, w, h in (where[a], where[b]))
    if b == LIB:
        ax = bx = ax + (WIDTH * {"tests": 0.4, "simulator": -0.4}.get(a, 0))
        start, end = (ax, where[a][1] + where[a][3]), (bx, where[b][1])
    else:
        start, end = _edge(where[a], bx - ax, by - ay), _edge(where[b], ax - bx, ay - by)
    ends = 'x1="{:.0f}" y1="{:.0f}" x2="{:.0f}" y2="{:.0f}"'.format(*start, *end)
    return f'<line {ends} marker-end="url(#tip)"/>'


def _edge(box, dx, dy):
    x, y, w, h = box
    scale = min(w / 2 / abs(dx) if dx else 1e9, h / 2 / abs(dy) if dy else 1e9)
    return x + w / 2 + dx * scale, y + h / 2 + dy * scale


def main():
    known = modules()
    lost = [name for name in known if box_of(name) is None]
    if lost:
        sys.exit(f"no box of {Path(__file__).name} names {', '.join(lost)}")
    PICTURE.write_text(draw(known))
    print(PICTURE.relative_to(ROOT))


if __name__ == "__main__":
    main()
