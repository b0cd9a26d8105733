"""The table of layers in docs/architecture.md, read."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]

TABLE = ROOT / "docs" / "architecture.md"


class Row(NamedTuple):
    """A layer: parts of the package, and the parts that each of them may import."""

    parts: tuple[str, ...]
    may_use: frozenset[str]
    is_all: bool
    """Whether it says "all above" instead of names."""


def layer_table(text):
    """Rows of the table below ``| layer |``, from the bottom of the house up."""
    rows = []
    below = []
    for line in text.split("| layer |", 1)[1].splitlines()[2:]:
        if not line.startswith("|"):
            break
        parts, _, may_use = (cell.strip() for cell in line.strip("|").split("|"))
        names = _names(parts)
        is_all = may_use == "all above"
        rows.append(Row(names, frozenset(below if is_all else _names(may_use)), is_all))
        below += names
    return rows


def _names(cell):
    return tuple(name.strip("/") for name in re.findall(r"`([\w/]+)`", cell))


LAYERS = layer_table(TABLE.read_text(encoding="utf-8"))
PARTS = [part for row in LAYERS for part in row.parts]


def part_of(name):
    """The table's part that a full module name belongs to, the most particular one; None for other packages."""
    words = name.split(".")
    if words[0] != "edgeslam_torch" or len(words) == 1:
        return None
    path = "/".join(words[1:])
    found = [part for part in PARTS if path == part or path.startswith(f"{part}/")]
    return max(found, key=len, default=f"{path}, which is not in the table")
