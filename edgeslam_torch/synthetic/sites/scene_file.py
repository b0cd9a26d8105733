"""Scenes as TOML files: rooms, doors, and what stands, hangs and walks there; docs/guides/worlds.md explains the keys.

Where a number is expected, text may stand: arithmetic over the file's values, with draws from the seed such as
``"wide / 2 + uniform(-0.2, 0.2)"``.
"""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.config_file import laid_over
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.synthetic.house.pieces import furniture
from edgeslam_torch.synthetic.house.values import Number
from edgeslam_torch.synthetic.house.walls import DOOR_HEIGHT_M
from edgeslam_torch.synthetic.textures.materials import MATERIALS

FOLDER = Path(__file__).parent.parent / "scenes"
T = TypeVar("T")
Extent = tuple[Number, Number]
Side = Literal["south", "east", "north", "west"]


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangle of the floor; what is between rooms and in none is solid."""

    name: str
    x: Extent
    y: Extent


@dataclass(frozen=True, slots=True)
class Door:
    """A way through the wall between two rooms."""

    between: tuple[str, str]
    at: Number
    """Its middle: y in a wall along y, x in one along x [m]."""
    width: Number = 0.9
    height: Number = DOOR_HEIGHT_M
    leaf: bool = False
    """Whether a door leaf hangs in it."""
    open: bool | str = True
    values: dict[str, Number] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Dress:
    """What walls of a room are dressed with, in this order."""

    room: str
    walls: tuple[Side, ...]
    style: Literal["furniture", "corridor", "door", "doors"] = "furniture"
    """Furniture, windows and pictures; shut doors, notices and small things; one shut door; two or three of them."""
    margin: Number = 0.0
    """Left bare at both ends [m]."""
    density: Number = 0.7
    """Share of the wall that is furnished."""
    pictures: Number = 0.8
    """Share of the free upper part that is hung."""
    pieces: tuple[str, ...] = ()
    """Furniture to choose from; the scene's when empty."""
    door: Side | None = None
    """The wall with a shut door among the furniture."""
    shuffle: bool = False
    """Whether the walls are furnished in an order of the seed."""


@dataclass(frozen=True, slots=True)
class Lamps:
    """Shining panels under the ceiling, at every x with every y."""

    x: Number | tuple[Number, ...]
    y: Number | tuple[Number, ...]
    width: Number = 1.0


@dataclass(frozen=True, slots=True)
class Rug:
    """A rug on the floor."""

    x: Number
    y: Number


@dataclass(frozen=True, slots=True)
class Block:
    """A solid from the floor to the ceiling."""

    x: Extent
    y: Extent


@dataclass(frozen=True, slots=True)
class Obstacles:
    """Things that stand and hang in a room, at every height, and leave a way to where the scene's way leads."""

    room: str
    x: Extent
    y: Extent
    count: int = 5


@dataclass(frozen=True, slots=True)
class Glass:
    """A pane that is solid and not seen, across x or y."""

    x: Number | Extent
    y: Number | Extent


@dataclass(frozen=True, slots=True)
class Person:
    """A person who walks to and fro along x or y."""

    x: Number | Extent
    y: Number | Extent
    speed: Number = "uniform(0.5, 0.9)"
    """[m/s]."""
    values: dict[str, Number] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SceneFile:
    """One scene. Lengths in metres."""

    name: str = ""
    values: dict[str, Number] = field(default_factory=dict)
    """Names for numbers, drawn in this order before anything is built; a part's own when it is built."""
    height: Number = 2.6
    texel: Number = 0.006
    ambient: Number = 0.6
    """Share of the light that comes from everywhere."""
    walls: tuple[str, ...] = ("rough_plaster", "wallpaper", "bricks", "concrete", "plaster")
    """Materials to choose from."""
    pieces: tuple[str, ...] = ()
    """Furniture to choose from; what stands twice is twice as frequent; all of it when empty."""
    one_paint: bool = False
    """Whether all outer walls have the same paint."""
    random_lamps: bool = False
    start: tuple[Number, Number, Number] | None = None
    """x, y and heading [degrees]."""
    way: tuple[tuple[Number, Number], ...] = ()
    """Points from the start to the goal."""
    open: tuple[tuple[str, str], ...] = ()
    """Pairs of rooms without a wall between them."""
    mirror: bool = False
    """Whether the wall at the high end of x is a mirror."""
    room: tuple[Room, ...] = ()
    door: tuple[Door, ...] = ()
    dress: tuple[Dress, ...] = ()
    lamps: tuple[Lamps, ...] = ()
    rug: tuple[Rug, ...] = ()
    block: tuple[Block, ...] = ()
    obstacles: tuple[Obstacles, ...] = ()
    glass: tuple[Glass, ...] = ()
    person: tuple[Person, ...] = ()


PARTS: dict[str, type] = {
    "room": Room, "door": Door, "dress": Dress, "lamps": Lamps, "rug": Rug, "block": Block, "obstacles": Obstacles,
    "glass": Glass, "person": Person,
}  # fmt: skip


def read_scene(path: Path) -> SceneFile:
    """Read a scene.

    Raises:
        ConfigError: If it cannot be read, or a key is unknown, missing or of the wrong type; one line names it.
    """
    table = _table(path, ())
    parts: dict[str, Any] = {}
    for name, kind in PARTS.items():
        entries = table.pop(name, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ConfigError(f"{path}: {name} is a list of tables; write [[{name}]] and its keys below")
        parts[name] = tuple(_record(kind, entry, f"{path}: [[{name}]] {k}") for k, entry in enumerate(entries, 1))
    scene = dataclasses.replace(_record(SceneFile, table, str(path)), name=path.stem, **parts)
    named: list[tuple[str, tuple[str, ...], Iterable[str]]] = [("walls", scene.walls, MATERIALS)]
    named += [("pieces", scene.pieces, furniture())]
    named += [(f"[[dress]] {k} pieces", d.pieces, furniture()) for k, d in enumerate(scene.dress, 1)]
    for where, given, known in named:
        if set(given) - set(known) or not (given or known is not MATERIALS):
            raise ConfigError(f"{path}: {where} must be some of {', '.join(known)}, got {', '.join(given)}")
    return scene


def _table(path: Path, before: tuple[Path, ...]) -> dict[str, Any]:
    """A file's table laid over that of the scene that it extends: lists go on, other keys are replaced."""
    if path in before:
        raise ConfigError(f"{path}: extends itself")
    table = read_mapping(path, "TOML", ConfigError)
    if (base := table.pop("extends", None)) is None:
        return table
    out = _table(scene_path(str(base)), (*before, path))
    for key, value in table.items():
        out[key] = out.get(key, []) + value if key in PARTS and isinstance(value, list) else value
    return out


def scene_path(name: str) -> Path:
    """A file of the user's by its path ``*.toml``, or a scene of ours by its name.

    Raises:
        ConfigError: If there is none of that name.
    """
    if name.endswith(".toml"):
        return Path(name)
    path = FOLDER / f"{name}.toml"
    if not name.isidentifier() or not path.is_file():
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.toml")))
        raise ConfigError(f"unknown world {name!r}; there are {known}, or give a file *.toml")
    return path


def _record(kind: type[T], table: dict[str, Any], where: str) -> T:
    """A part of the type ``kind`` from its table."""
    values = table.pop("values", {})
    if not isinstance(values, dict) or not all(isinstance(v, int | float | str) for v in values.values()):
        raise ConfigError(f"{where}: values are numbers or text, such as values = {{ wide = 2.4 }}")
    required = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory]  # type: ignore[arg-type]
    part = laid_over(kind(**dict.fromkeys(required)), table, where)
    for name in required:
        if getattr(part, name) is None:
            raise ConfigError(f"{where}: {name} is missing")
    return dataclasses.replace(part, values=values) if values else part  # type: ignore[type-var]
