"""`upright board new`: a folder of boards/ for a board that has none, from the one that is most like it."""

import re

import typer

from upright_host import paths
from upright_host.console import Wrong, say, writing

_README = """# {name}

Made from [{like}](../{like}/README.md) by `upright board new`. Its README says how MicroPython gets onto such a board.

1. Put your pins into [board.py](board.py): those of the bus, and that of INT in `data_ready_pin()`.
2. Wire the modules: 3V3 to VCC, GND to GND, SDA to SDA, SCL to SCL.
3. From the project's root:

   ```
   .venv/bin/upright flash {name}
   .venv/bin/upright doctor
   ```

[A new board](../../docs/new-board.md) explains every name in board.py.
"""


def make(name: str, like: str | None = None) -> str:
    """Make boards/NAME, which is not there yet -> the board that it was made from. Raises Wrong."""
    if not re.fullmatch("(?!(aux|con|nul|prn)$)[a-z][a-z0-9_]*", name):  # no files to Windows
        raise Wrong(f"{name!r} is no name for a folder of boards/: lower-case letters, digits, _")
    folder = paths.BOARDS / name
    if folder.exists():
        raise Wrong(f"boards/{name} is there already: nothing was changed")
    like = paths.known_board(like or paths.nearest_board(name) or "pico")
    text = (paths.BOARDS / like / "board.py").read_text("utf-8")
    _, _, rest = text.partition("\n\n")  # behind the comment about the other board
    rest = re.sub(r'^NAME = ".*"', f'NAME = "{name}"', rest, flags=re.M)
    head = f"# {name}, made from boards/{like}: put your pins here; see docs/new-board.md.\n"
    head += "# lib/upright/settings.py lists every setting.\n\n"
    with writing(folder):
        folder.mkdir()
        (folder / "board.py").write_text(head + rest, "utf-8", newline="\n")
        (folder / "README.md").write_text(
            _README.format(name=name, like=like), "utf-8", newline="\n"
        )
    return like


def register(app: typer.Typer):
    """Add `upright board` to the command line."""
    commands = typer.Typer(no_args_is_help=True, help="Boards that Upright does not know yet.")
    app.add_typer(commands, name="board")

    @commands.callback()
    def _group():
        """Boards that Upright does not know yet."""

    @commands.command("new")
    def new(
        name: str = typer.Argument(..., help="The folder of boards/ to make."),
        like: str = typer.Option(
            None, help="The board to start from (default: the one with the nearest name, or pico)."
        ),
    ):
        """Make boards/NAME with a board.py and a README to fill in. Nothing that is there is touched."""
        like = make(name, like)
        say(f"boards/{name}: board.py and README.md, made from {like}")
        say(f"Next: put your pins into boards/{name}/board.py, then `upright flash {name}`")
