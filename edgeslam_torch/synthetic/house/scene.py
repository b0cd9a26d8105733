"""Assembling a `World`: surfaces, solids and lamps, with light baked into every texture."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache, partial

import cv2
import numpy as np

from edgeslam_torch.synthetic.house.world import Box, Quad, Texture, World, to_boxes
from edgeslam_torch.synthetic.textures import materials, pictures
from edgeslam_torch.synthetic.textures.image_ops import product, resized, shrunk
from edgeslam_torch.types import FloatArray

LIGHT_GRID_M = 0.16
"""Spacing of the points at which light is computed."""
UNIT_LIGHT = 100.0
"""Light 1.0 in the 8-bit light maps; they saturate at 2.55."""
VARIANTS = 6
"""Tiles of each material and pictures of each kind that a process draws at most."""


@cache
def material_tile(kind: str, variant: int) -> Texture:
    """One of `VARIANTS` fixed tiles of a material, drawn when first wanted."""
    rng = np.random.default_rng([list(materials.MATERIALS).index(kind), variant])
    return Texture(materials.MATERIALS[kind](rng))


PICTURES = {
    "poster": (pictures.poster, (480, 360)),
    "picture": (pictures.poster, (360, 480)),
    "book_spines": (pictures.book_spines, (200, 700)),
    "screen": (pictures.screen, (330, 520)),
    "door": (pictures.door, (800, 380)),
    "cabinet": (pictures.cabinet, (480, 480)),
    "window": (pictures.window, (480, 520)),
    "whiteboard": (pictures.whiteboard, (480, 760)),
    "radiator": (pictures.radiator, (200, 400)),
    "keyboard": (pictures.keyboard, (110, 330)),
    "rug": (pictures.rug, (420, 600)),
}


@cache
def picture(kind: str, variant: int) -> np.ndarray:
    """One of a fixed set of pictures of a kind, ``(H, W, 3)`` BGR, drawn when first wanted."""
    draw, shape = PICTURES[kind]
    return draw(np.random.default_rng([1000 + list(PICTURES).index(kind), variant]), shape)


@dataclass(frozen=True, slots=True)
class Paint:
    """What a surface is covered with."""

    kind: str
    """A name in `materials.MATERIALS` or `PICTURES`."""
    variant: int = 0
    tint: tuple[float, ...] = (1.0, 1.0, 1.0)
    """BGR gain."""
    zoom: float = 1.0
    """Magnification of a material's pattern."""
    turned: bool = False
    """Pattern along v instead of u."""
    offset: tuple[float, float] = (0.0, 0.0)
    """Start within the tile, in [0, 1)."""
    glow: bool = False
    """Emissive: not shaded."""


def random_paint(rng: np.random.Generator, kinds: Sequence[str], turned: bool = False, vivid: float = 0.04) -> Paint:
    """Paint of a random kind among ``kinds``, its colour varied."""
    kind = str(rng.choice(kinds))
    gain = np.exp(rng.normal(0.0, 0.12) + rng.normal(0.0, vivid, 3))
    variant, zoom = int(rng.integers(VARIANTS)), float(np.exp(rng.uniform(-0.35, 0.35)))
    return Paint(kind, variant, tuple(gain.tolist()), zoom, turned, (rng.random(), rng.random()))


@dataclass(frozen=True, slots=True)
class Place:
    """Where a piece of furniture stands: local x along the wall, y into the room, z up."""

    x: float
    y: float
    yaw_rad: float
    z: float = 0.0

    def point(self, local: FloatArray) -> FloatArray:
        """World coordinates of a local point ``(3,)``."""
        return np.array([self.x, self.y, self.z]) + self.direction(local)

    def direction(self, local: FloatArray) -> FloatArray:
        """World direction of a local vector ``(3,)``."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        x, y, z = local
        return np.array([c * x - s * y, s * x + c * y, z])

    def at(self, x: float, y: float, z: float = 0.0, yaw_rad: float = 0.0) -> "Place":
        """A place given in this place's own axes."""
        p = self.point(np.array([x, y, z]))
        return Place(float(p[0]), float(p[1]), self.yaw_rad + yaw_rad, float(p[2]))


@dataclass
class Scene:
    """A world being put together; its light is computed and baked when it is first seen."""

    low_w: FloatArray
    high_w: FloatArray
    """Inner corners of the room [m]."""
    texel_m: float = 0.004
    quads: list[Quad] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    unseen: list[Box] = field(default_factory=list)
    """Glass: solid and not painted."""
    lamps_w: list[FloatArray] = field(default_factory=list)
    ambient: float = 0.5
    """Share of the light that comes from everywhere."""
    exposure: float = 1.0
    light_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def surface(
        self,
        origin_w: FloatArray,
        u_w: FloatArray,
        v_w: FloatArray,
        paint: Paint,
        name: str,
        *,
        two_sided: bool = False,
        solid: int = -1,
    ) -> None:
        """Add a parallelogram; see `Quad` for its sides."""
        origin_w, u_w, v_w = (np.asarray(a, dtype=np.float64) for a in (origin_w, u_w, v_w))
        texture = Texture(partial(_bake, len(self.quads), self, paint))
        self.quads.append(Quad(origin_w, u_w, v_w, texture, name, two_sided, solid))

    def box(
        self,
        place: Place,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        paint: Paint,
        name: str,
        *,
        faces: str = "frblt",
        special: dict[str, Paint] | None = None,
        inside: bool = False,
    ) -> None:
        """Add a solid; ``faces`` of Front (+y), Right (+x), Back, Left, Top, Under; ``special`` paints by face.

        ``inside`` marks a solid within another one, which needs no shadow of its own.
        """
        if not inside:
            self.boxes.append(Box(place.point(np.array(centre)), 0.5 * np.array(size), place.yaw_rad))
        solid = len(self.boxes) - 1
        normals = {"f": (0, 1, 0), "r": (1, 0, 0), "b": (0, -1, 0), "l": (-1, 0, 0), "t": (0, 0, 1), "u": (0, 0, -1)}
        for face in faces:
            n = np.array(normals[face], dtype=np.float64)
            if face in "tu":
                u, v = np.array([size[0], 0.0, 0.0]), np.array([0.0, -n[2] * size[1], 0.0])
            else:
                u, v = np.array([-n[1] * size[0], n[0] * size[1], 0.0]), np.array([0.0, 0.0, -size[2]])
            corner = np.array(centre) + 0.5 * n * size - 0.5 * u - 0.5 * v
            chosen = (special or {}).get(face, paint)
            self.surface(place.point(corner), place.direction(u), place.direction(v), chosen, name, solid=solid)

    def panel(
        self, place: Place, centre: tuple[float, float, float], width: float, height: float, paint: Paint, name: str
    ) -> None:
        """Add an upright sheet that faces local +y."""
        u, v = np.array([-width, 0.0, 0.0]), np.array([0.0, 0.0, -height])
        corner = np.array(centre) - 0.5 * u - 0.5 * v
        self.surface(place.point(corner), place.direction(u), place.direction(v), paint, name)

    def prism(self, place: Place, radius: float, height: float, paint: Paint, name: str, *, sides: int = 8) -> None:
        """Add a closed column with an even number of sides."""
        r = radius * np.cos(np.pi / sides)
        self.boxes.append(Box(place.point(np.array([0, 0, height / 2])), np.array([r, r, height / 2]), place.yaw_rad))
        solid = len(self.boxes) - 1
        angles = 2 * np.pi * np.arange(sides) / sides
        ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], axis=1) * radius
        lift = np.array([0.0, 0.0, height])
        for k in range(sides):
            top, side = place.point(ring[k] + lift), place.direction(ring[(k + 1) % sides] - ring[k])
            self.surface(top, side, place.direction(-lift), paint, name, solid=solid)
        path = [ring[(k + 1) % sides] - ring[k] for k in range(sides // 2)]
        for origin, u, v in _rhombi(ring[0] + lift, path):
            self.surface(place.point(origin), place.direction(v), place.direction(u), paint, name, solid=solid)

    def world(self, name: str) -> World:
        """The world as it is now."""
        return World(self.quads, name, np.stack([self.low_w, self.high_w]), self.boxes, self.unseen)

    @cached_property
    def light_maps(self) -> list[FloatArray]:
        """Light at a grid of points of every surface, 1.0 on average."""
        origin, u, v = (np.array([getattr(q, k) for q in self.quads]) for k in ("origin_w", "u_w", "v_w"))
        normal = np.cross(v, u)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        columns = np.clip(np.ceil(np.linalg.norm(u, axis=1) / LIGHT_GRID_M), 2, 80).astype(int)
        rows = np.clip(np.ceil(np.linalg.norm(v, axis=1) / LIGHT_GRID_M), 2, 80).astype(int)
        size = rows * columns
        start = np.cumsum(size) - size
        owner = np.repeat(np.arange(len(size)), size)
        j, i = np.divmod(np.arange(len(owner)) - start[owner], columns[owner])
        a, b = ((i + 0.5) / columns[owner])[:, None], ((j + 0.5) / rows[owner])[:, None]
        p = origin[owner] + a * u[owner] + b * v[owner] + 0.004 * normal[owner]
        solid = np.array([q.solid for q in self.quads])[owner]
        light = self._light(p.T.astype(np.float32), normal[owner].T.astype(np.float32), solid)
        return [light[s : s + r * c].reshape(r, c) for s, r, c in zip(start, rows, columns, strict=True)]

    def _light(self, p: FloatArray, n: FloatArray, solid: np.ndarray) -> FloatArray:
        """Lamps with shadows, ambient light, and darkening near other surfaces; ``p``, ``n`` are ``(3, N)``."""
        local = [_local(box, p) for box in self.boxes]
        direct = np.zeros(p.shape[1], np.float32)
        for lamp in self.lamps_w:
            ray = lamp.astype(np.float32)[:, None] - p
            squared = (ray * ray).sum(0)
            lambert = np.maximum((n * ray).sum(0), 0.0) / np.sqrt(np.maximum(squared, 1e-12))
            lit = np.flatnonzero(lambert > 0)
            seen = np.zeros_like(lambert)
            seen[lit] = self._visibility([x[:, lit] for x in local], lamp, solid[lit])
            direct += lambert * seen / (squared + 0.8)
        sky = 1.0 + 0.12 * n[2]  # what looks up sees the lit ceiling and walls
        for axis in range(3):
            for distance, inward in ((p[axis] - self.low_w[axis], 1.0), (self.high_w[axis] - p[axis], -1.0)):
                sky *= 1.0 - 0.4 * (n[axis] * inward < 0.9) * np.exp(np.minimum(-distance, 0.0) / 0.22)
        for k, box in enumerate(self.boxes):
            reach = 0.6 * min(0.25, float(box.half_m.max()))
            if reach < 0.048:
                continue
            out = np.maximum(np.abs(local[k]) - box.half_m.astype(np.float32)[:, None], 0.0)
            squared = (out * out).sum(0)
            close = np.flatnonzero((squared < (4 * reach) ** 2) & (solid != k))
            sky[close] *= 1.0 - 0.45 * np.exp(-np.sqrt(squared[close]) / reach)
        mean = float(np.median(direct[direct > 0])) if np.any(direct > 0) else 1.0
        light = self.ambient * sky + (1.0 - self.ambient) * direct / mean
        light = light / max(float(np.median(light)), 1e-6)
        return 0.88 * self.exposure * np.where(light > 1, 1 + 0.4 * np.tanh((light - 1) / 1.2), light)

    def _visibility(self, local: list[FloatArray], lamp: FloatArray, solid: np.ndarray) -> FloatArray:
        """Share of a lamp that points see past the solids, ``(N,)``: 1 lit, 0 in shadow."""
        seen = np.ones(len(solid), np.float32)
        for k, box in enumerate(self.boxes):
            if box.half_m.max() < 0.12 or to_boxes([box])(lamp) == 0:
                continue
            half = box.half_m.astype(np.float32)
            b = _local(box, lamp.astype(np.float32)[:, None])
            enter, leave = np.zeros(len(solid), np.float32), np.ones(len(solid), np.float32)
            for axis in range(3):
                d = b[axis] - local[k][axis]
                d[np.abs(d) < 1e-9] = 1e-9
                middle, reach = -local[k][axis] / d, half[axis] / np.abs(d)
                enter = np.maximum(enter, middle - reach)
                leave = np.minimum(leave, middle + reach)
            blocked = np.flatnonzero((enter < leave) & (leave > 1e-3) & (solid != k))
            # A ray that only grazes the solid is half lit: a soft edge for nothing.
            seen[blocked] *= 1.0 - 0.92 * np.minimum((leave - enter)[blocked] * 12.0, 1.0)
        return seen


def _local(box: Box, p: FloatArray) -> FloatArray:
    """Points ``(3, N)`` in a box's own axes."""
    c, s = np.float32(np.cos(box.yaw_rad)), np.float32(np.sin(box.yaw_rad))
    x, y, z = p - box.centre_w.astype(np.float32)[:, None]
    return np.stack([c * x + s * y, c * y - s * x, z])


def _rhombi(start: FloatArray, path: list[FloatArray]) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Parallelograms ``(origin, a, b)`` that tile the even polygon whose first half of sides is ``path``.

    Sorting the sides into reverse order by swaps of neighbours sweeps the polygon, one parallelogram a swap.
    """
    order = list(range(len(path)))
    out: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for _ in range(len(path)):
        for i in range(len(path) - 1):
            if order[i] < order[i + 1]:
                corner = start + sum((path[k] for k in order[:i]), np.zeros(3))
                out.append((corner, path[order[i]], path[order[i + 1]]))
                order[i], order[i + 1] = order[i + 1], order[i]
    return out


def _bake(index: int, scene: Scene, paint: Paint) -> np.ndarray:
    """Texture of a surface: its paint times its light."""
    quad, light = scene.quads[index], scene.light_maps[index]
    width_m, height_m = float(np.linalg.norm(quad.u_w)), float(np.linalg.norm(quad.v_w))
    if paint.kind in PICTURES:
        image = picture(paint.kind, paint.variant)
        if paint.turned:
            image = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
        needed = max(width_m / image.shape[1], height_m / image.shape[0])
        if needed < 0.6 * scene.texel_m:  # finer than anything else in the world: shrink
            image = shrunk(image, *(max(4, round(x / (0.7 * scene.texel_m))) for x in (width_m, height_m)))
    else:
        image = _spread(paint, width_m, height_m, scene.texel_m)
    gain = np.array(paint.tint) * (np.ones(3) if paint.glow else np.array(scene.light_bgr))
    field_ = np.full_like(light, scene.exposure) if paint.glow else light
    light8 = np.clip(UNIT_LIGHT * field_[..., None] * gain, 0, 255).astype(np.uint8)
    return product(image, resized(light8, image.shape[1], image.shape[0]) / np.float32(UNIT_LIGHT))


@lru_cache(maxsize=256)
def _sized_tile(kind: str, variant: int, side_px: int) -> np.ndarray:
    """A material's tile resampled to ``side_px`` (smoothed first when it shrinks)."""
    pyramid = material_tile(kind, variant)
    level = max(0, int(2 * np.log2(materials.TILE_PX / side_px)))
    return resized(pyramid.level(level), side_px, side_px)


def _spread(paint: Paint, width_m: float, height_m: float, texel_m: float) -> np.ndarray:
    """A material's tile repeated over a surface at ``texel_m`` metres a texel."""
    texel_m = max(texel_m, max(width_m, height_m) / 4096)
    columns, rows = max(4, round(width_m / texel_m)), max(4, round(height_m / texel_m))
    # Sizes in steps of 16 texels keep the number of resampled tiles small.
    tile = _sized_tile(paint.kind, paint.variant, max(32, 16 * round(materials.TILE_M * paint.zoom / texel_m / 16)))
    if paint.turned:
        tile = tile.transpose(1, 0, 2)
    side = tile.shape[0]
    tile = np.roll(tile, (-int(paint.offset[1] * side), -int(paint.offset[0] * side)), axis=(0, 1))
    below, right = max(0, rows - side), max(0, columns - side)
    return cv2.copyMakeBorder(tile[:rows, :columns], 0, below, 0, right, cv2.BORDER_WRAP)
