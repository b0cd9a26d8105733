"""The page that maps equations to code names things that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "equations.md"


def test_every_named_place_exists():
    places = re.findall(r"`([\w/]+\.py):(\w+)`", PAGE.read_text(encoding="utf-8"))
    assert len(places) > 40
    missing = []
    for file, name in places:
        text = (ROOT / file).read_text(encoding="utf-8")
        if not re.search(rf"^\s*(def|class) {name}\b", text, re.MULTILINE):
            missing.append(f"{file}:{name}")
    assert not missing


def test_every_equation_of_the_paper_is_there():
    rows = re.findall(r"^\| ([\d, ]+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    numbers = sorted(int(n) for row in rows for n in row.split(","))
    assert numbers == list(range(1, 31))
