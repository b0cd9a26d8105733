"""Scene files: what is wrong is said in one line with the key's name."""

import pytest

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.synthetic.sites import build
from edgeslam_torch.synthetic.sites.build import SITES, named_site
from edgeslam_torch.synthetic.sites.scene_file import FOLDER, read_scene, scene_path

FLAT = """
start = [0.8, 2, 0]
way = [[0.8, 2], [4.2, 2], [5.8, 2]]
room = [{ name = "a", x = [0, 5], y = [0, 4] }, { name = "b", x = [5, 7], y = [0, 4] }]
door = [{ between = ["a", "b"], at = 2 }]
"""


@pytest.fixture
def scene(tmp_path):
    def write(text):
        (tmp_path / "flat.toml").write_text(text)
        return str(tmp_path / "flat.toml")

    return write


def test_every_scene_of_ours_is_read_and_the_sites_are_among_them():
    assert set(SITES) <= {read_scene(path).name for path in FOLDER.glob("*.toml")}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("start", "strat", "unknown key 'strat'; did you mean 'start'"),
        ("at = 2", "wdth = 1", r"\[\[door\]\] 1: unknown key 'wdth'; did you mean 'width'"),
        ("at = 2", "width = 1", r"\[\[door\]\] 1: at is missing"),
        ("at = 2", "at = [1]", r"\[\[door\]\] 1: at must be a number"),
        ("at = 2", "at = 'wide / 2'", "'wide / 2': wide is not a value"),
        ("at = 2", "at = '__import__(1)'", "__import__ is not a value"),
        ("at = 2", "at = '1 / 0'", "cannot be computed"),
        ("at = 2", "at = 'uniform(1)'", "cannot be computed"),
        ("at = 2", "at = 'steps(0, 1000000000000, 1)'", "cannot be computed"),
        ("at = 2", "at = 3.8", "door between 'a' and 'b': .* is not within 0 to 4"),
        ('"a", "b"]', '"a", "c"]', "no room 'c'"),
        ("at = 2", "at = 'sample(1, 2)'", "flat.toml: "),
        ("x = [5, 7]", "x = [5, 700]", "more than 200 m"),
        ("[5.8, 2]", "[8, 2]", r"\[8, 2\] is in no room"),
        ("room = [", "person = [{ x = 1, y = 1 }]\nroom = [", "a walker needs two places"),
        ("x = [5, 7]", "x = [4, 7]", "rooms 'a' and 'b' overlap"),
        ("x = [5, 7]", "x = [7, 5]", "room 'b': x and y go from low to high"),
        ("x = [5, 7]", "x = [6, 8]", "the rooms do not touch"),
        ("door = [", "open = [['a', 'b']]\ndoor = [", "are open to each other"),
        ("at = 2 }", "at = 2 }, { between = ['a', 'b'], at = 2.5 }", "overlaps another door"),
        ("door = [", "#", "room 'a' has no door"),
        ("at = 2", "at = 2, open = false", "a free way"),
        ("way = [", "# [", "start and way are missing"),
        ("room = [", "walls = ['paper']\nroom = [", "walls must be some of plaster, .*got paper"),
        ("room = [", "dress = [{ room = 'a', walls = ['up'] }]\nroom = [", r"\[\[dress\]\] 1: walls must be"),
        ("room = [", "rug = 3\nroom = [", r"rug is a list of tables; write \[\[rug\]\]"),
        ("start", "extends = 'moon'\nstart", "unknown world 'moon'; there are .*l_corridor"),
        ("start", "extends = 'PATH'\nstart", "extends itself"),
    ],
)
def test_what_is_wrong_is_named(scene, tmp_path, monkeypatch, old, new, words):
    monkeypatch.setattr(build, "_TRIES", 2)
    assert old in FLAT
    path = scene(FLAT.replace(old, new.replace("PATH", str(tmp_path / "flat.toml")), 1))
    with pytest.raises(ConfigError, match=f"(?s)^[^\n]*{words}[^\n]*$"):
        named_site(path, 0)


@pytest.mark.parametrize(("name", "seed"), [("moon", 0), ("../corridor", 0), ("none.toml", 0), ("corridor", -1)])
def test_unknown_names_and_negative_seeds_are_refused(name, seed):
    with pytest.raises(ConfigError):
        named_site(name, seed)


def test_a_scene_extends_another(scene):
    file = read_scene(scene_path(scene("extends = 'l_corridor'\nwalls = ['bricks']\n[[lamps]]\nx = 1\ny = 0\n")))
    base = read_scene(scene_path("l_corridor"))
    assert (file.walls, file.lamps[-1].x) == (("bricks",), 1)
    assert (file.room, file.values, file.lamps[:-1]) == (base.room, base.values, base.lamps)
