"""The builder of `furniture.toml`: what stands, hangs and lies in a scene, each piece at a `Place` of its own axes."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.synthetic.house.scene import PICTURES, VARIANTS, Paint, Place, Scene, random_paint
from edgeslam_torch.synthetic.house.values import Values
from edgeslam_torch.synthetic.textures.materials import MATERIALS
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
FILE = Path(__file__).parent.parent / "furniture.toml"


@cache
def _tables() -> dict[str, Any]:
    return read_mapping(FILE, "TOML", ConfigError)


@cache
def furniture() -> dict[str, dict[str, Any]]:
    """The tables of pieces that stand along walls, by name: ``width`` and ``depth`` from least to most [m], and what
    `furniture.toml` says."""
    return {name: table for name, table in _tables().items() if "width" in table}


def drawn(rng: Rng, name: str) -> tuple[float, float]:
    """Width and depth of a piece of furniture [m]."""
    width, depth = (float(rng.uniform(*furniture()[name][key])) for key in ("width", "depth"))
    return width, depth


def stand(scene: Scene, place: Place, rng: Rng, name: str, width: float, depth: float) -> None:
    """Add a piece of furniture with its back at ``place``."""
    at = place.at(0, depth / 2) if furniture()[name].get("centred") else place
    build(scene, at, rng, name, width=width, depth=depth)


def build(scene: Scene, place: Place, rng: Rng, name: str, **given: Any) -> dict[str, Any]:
    """Add a piece of `furniture.toml` at a place (x along the wall, y into the room); ``given`` values take the place
    of the table's own. Returns its values by name, such as the width that was drawn."""
    table = _tables()[name]
    values = Values(rng, {**_names(), "ceiling": float(scene.high_w[2]), **given}, _paints(rng))
    values.define({key: value for key, value in table.get("values", {}).items() if key not in given})
    for step in table["steps"]:
        _take(scene, place, rng, values, step)
    return values.known


def _take(scene: Scene, place: Place, rng: Rng, values: Values, step: dict[str, Any]) -> None:
    """One step of a piece, as often as it says."""
    if not values(step.get("when", 1)):
        return
    each = step.get("each", {})
    rounds = [dict(zip(each, chosen, strict=True)) for chosen in product(*(values(v) for v in each.values()))]
    for k in range(values(step.get("repeat", 1))):
        for chosen in rounds:
            values.known |= {**chosen, "k": k} if "repeat" in step else chosen
            values.define(step.get("let", {}))
            if values(step.get("until", 0)):
                return
            here = place.at(*values(step["place"])) if "place" in step else place
            if "piece" in step:
                build(scene, here, rng, step["piece"], **{n: values(v) for n, v in step.get("with", {}).items()})
            elif "steps" in step:
                for inner in step["steps"]:
                    _take(scene, here, rng, values, inner)
            elif "shape" in step:
                _shape(scene, here, values, step)


def _shape(scene: Scene, place: Place, values: Values, step: dict[str, Any]) -> None:
    """A painted shape, its values drawn in the order of its keys' description in the file."""
    shape, name = step["shape"], step["name"]
    at, size = values(step.get("at", (0, 0, 0))), values(step.get("size", ()))
    paint = values(step["paint"])
    if shape == "box":
        special = {face: found for face, text in step.get("paints", {}).items() if (found := values(text)) is not None}
        faces, inside = step.get("faces", "frblt"), step.get("inside", False)
        scene.box(place, at, size, paint, name, faces=faces, special=special, inside=inside)
    elif shape == "panel":
        scene.panel(place, at, size[0], size[1], paint, name)
    elif shape == "prism":
        scene.prism(place, size[0], size[1], paint, name, sides=step.get("sides", 8))
    else:
        u, v = (place.direction(values(step[key])) for key in "uv")
        scene.surface(place.point(at), u, v, paint, name, two_sided=step.get("two_sided", False))


WOODS = ("veneer", "veneer", "wood", "metal", "plaster")
CLOTHS = ("fabric", "fabric", "carpet", "rough_plaster")


@cache
def _names() -> dict[str, Any]:
    """Materials, pictures and groups of materials, as text calls them."""
    return {**{name: name for name in (*MATERIALS, *PICTURES)}, "woods": WOODS, "cloths": CLOTHS, "nothing": None}


def _paints(rng: Rng) -> dict[str, Callable[..., Any]]:
    """What text may call to paint something."""

    def paint(*kinds: str | tuple[str, ...], vivid: float = 0.04) -> Paint:
        names = [name for kind in kinds for name in ([kind] if isinstance(kind, str) else kind)]
        return random_paint(rng, names, vivid=vivid)

    def image(kind: str) -> Paint:
        gain = np.exp(rng.normal(0.0, 0.06, 3))
        return Paint(kind, int(rng.integers(VARIANTS)), tuple(gain.tolist()))

    def direction(length: float) -> FloatArray:
        axis = rng.normal(size=3)
        return axis * (length / np.linalg.norm(axis))

    return {
        "direction": direction,
        "paint": paint,
        "variant": lambda: int(rng.integers(VARIANTS)),
        "image": image,
        "plain": lambda kind, number=0, blue=1.0, green=1.0, red=1.0: Paint(kind, number, (blue, green, red)),
        "dyed": lambda paint, blue, green, red: Paint(paint.kind, paint.variant, (blue, green, red)),
        "tinted": lambda kind, number, like: Paint(kind, number, like.tint),
        "glowing": lambda paint, gain=1.0: replace(paint, tint=tuple(gain * t for t in paint.tint), glow=True),
    }
