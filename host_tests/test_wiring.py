"""The wiring pictures of boards/ are those that tools/maintain/wiring.py draws."""

import runpy

from upright_host import paths

WIRING = runpy.run_path(str(paths.ROOT / "tools" / "maintain" / "wiring.py"))


def test_each_picture_is_drawn_from_its_boards_pins():
    for board in WIRING["BOARDS"]:
        assert WIRING["path_of"](board).read_text() == WIRING["draw"](board)
