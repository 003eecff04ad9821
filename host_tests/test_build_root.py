"""The small Debian in which firmware is built: what is said where it cannot be had, and what is kept in the cache."""

import pytest
from upright_host import build_root, debian, qemu, rp2040, runtimes

RECIPES = [rp2040.RECIPE, *qemu.RECIPES.values()]


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    monkeypatch.delenv(rp2040.VARIABLE, raising=False)
    return tmp_path / "runtimes"


def banner(tmp_path, version="1.26.1"):
    path = tmp_path / "firmware"
    path.write_bytes(b"\x7fELF MicroPython v%s on 2025-09-11; virt" % version.encode())
    return path


def test_without_a_way_into_a_root_folder_the_reason_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(build_root.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(build_root, "_host_environment", lambda: {"PATH": str(tmp_path)})
    with pytest.raises(runtimes.Unavailable) as why:
        build_root._way_in(tmp_path / "root")
    assert "root or user namespaces" in str(why.value)
    assert "\n" not in str(why.value)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.name)
def test_a_dead_mirror_is_said_and_leaves_nothing_behind(monkeypatch, cache, tmp_path, recipe):
    if not debian.shutil.which("apt-get"):
        pytest.skip("no apt-get here")
    monkeypatch.setattr(build_root, "_way_in", lambda root: [])
    nowhere = tmp_path / "no-such-mirror"
    monkeypatch.setattr(debian.Apt, "_mirror", staticmethod(lambda: f"file:{nowhere}"))
    (cache / ".building-killed").mkdir(parents=True)  # what a killed run leaves
    monkeypatch.setattr(runtimes, "_ready", {})
    with pytest.raises(runtimes.Unavailable) as why:
        runtimes.interpreter(recipe.name)
    assert "apt-get" in str(why.value)
    assert "\n" not in str(why.value)
    assert list(cache.iterdir()) == []


def test_all_that_are_missing_are_built_in_one_folder_and_one_failure_leaves_the_others(
    monkeypatch, cache, tmp_path
):
    made = []

    def make(recipe, root, enter, step):
        made.append(recipe.name)
        if recipe.name == "m3":
            raise build_root.Unavailable("it does not compile")
        product = root / "build" / recipe.product
        product.parent.mkdir(parents=True)
        product.write_bytes(banner(tmp_path).read_bytes())

    monkeypatch.setattr(build_root, "_way_in", lambda root: [])
    monkeypatch.setattr(
        build_root, "_unpack_tools", lambda work, root, recipes, step: {"gcc": "14"}
    )
    monkeypatch.setattr(
        build_root, "_unpack_sources", lambda root, step: (root / "build").mkdir(parents=True) or {}
    )
    monkeypatch.setattr(build_root, "_make", make)
    recipes = [*qemu.RECIPES.values()]
    assert build_root.obtain(recipes) == {"m3": "it does not compile"}
    assert (build_root.cached(recipes[0]), made) == (None, ["m3", "rv32"])
    assert build_root.cached(recipes[1]).parent.name == "rv32-1.26.1-r1"
    assert [path.name for path in cache.iterdir()] == ["rv32-1.26.1-r1"]
    assert build_root.obtain(recipes[1:]) == {}
    assert made == ["m3", "rv32"]


def test_the_newest_image_of_this_recipe_is_taken(cache):
    recipe = qemu.RECIPES["rv32"]
    for name in ("1.26.1-r1", "1.9.9-r1", "1.30.0-r0", "1.27.0-r1"):
        (cache / f"rv32-{name}").mkdir(parents=True)
        (cache / f"rv32-{name}" / "firmware.elf").touch()
    (cache / "rv32-1.28.0-r1").mkdir()  # without an image
    assert build_root.cached(recipe).parent.name == "rv32-1.27.0-r1"


@pytest.mark.parametrize(
    "version, message", [("1.25.0", "1.25.0 is older than 1.26"), ("", "holds no MicroPython")]
)
def test_an_image_that_is_too_old_or_none_is_refused(tmp_path, version, message):
    with pytest.raises(runtimes.Unavailable, match=message):
        qemu.RECIPES["m3"].version(banner(tmp_path, version))
