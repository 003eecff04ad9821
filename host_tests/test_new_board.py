"""`upright board new`: a folder for a board that has none."""

import ast
import shutil

import pytest
from upright_host import contents, library, new_board, options, packages, paths
from upright_host.console import Wrong


@pytest.fixture
def boards(tmp_path, monkeypatch):
    """A copy of boards/ in its place."""
    monkeypatch.setattr(paths, "BOARDS", tmp_path / "boards")
    return shutil.copytree(paths.ROOT / "boards", tmp_path / "boards")


@pytest.mark.parametrize(
    "name, like, platform",
    [("picow", "pico_w", "rp2"), ("esp32c6", "esp32_c3", "esp32"), ("feather", "pico", "rp2")],
)
def test_it_is_made_from_the_board_with_the_nearest_name(upright, boards, name, like, platform):
    done = upright("board", "new", name)
    assert done.exit_code == 0, done.output
    assert f"made from {like}" in done.output
    assert contents.platform(name) == platform
    text = (boards / name / "board.py").read_text()
    assert contents.setting(text, "NAME") == name
    assert contents.lines_to_change(text, set(), True) == []
    theirs = (boards / like / "board.py").read_text()
    assert text[text.index("PLATFORM") :] == theirs[theirs.index("PLATFORM") :]


def test_its_readme_names_its_commands_and_links_what_is_there(boards):
    new_board.make("mine", "esp32_s3")
    text = (boards / "mine" / "README.md").read_text()
    assert "upright flash mine" in text and "../esp32_s3/README.md" in text


def test_what_is_there_is_not_touched(boards):
    (boards / "mine").mkdir()
    (boards / "mine" / "board.py").write_text("x = 1\n")
    with pytest.raises(Wrong, match="nothing was changed"):
        new_board.make("mine")
    assert (boards / "mine" / "board.py").read_text() == "x = 1\n"


def test_a_board_without_simulated_chips_is_not_simulated(boards):
    new_board.make("mine")
    with pytest.raises(Wrong, match="simulated chips"):
        options.simulated_board("mine")


def test_every_board_that_comes_with_upright_can_be_simulated():
    assert set(paths.boards()) == set(library.simulator("boards").BOARDS)


def test_a_module_with_a_name_of_any_length_is_told_to_be_none_of_upright():
    """Found by the million inputs: longer than a file's name can be."""
    (line,) = contents.lines_to_change(f"from upright.{'x' * 300} import a\n", set(), True)
    assert line.startswith("line 1: there is no upright/xxx")
    assert packages.imports(ast.parse(f"from upright import {'x' * 300}")) == set()
