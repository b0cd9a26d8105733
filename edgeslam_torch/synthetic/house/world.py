"""A world of textured parallelograms and solid boxes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from edgeslam_torch.synthetic.textures.image_ops import shrunk
from edgeslam_torch.types import FloatArray

MAX_LEVEL = 18
"""Half-octave texture levels: the coarsest is 1/512 of the finest."""
_CHUNK = 512
"""Points at a time."""
Distance = Callable[[FloatArray], FloatArray]
"""Of points ``(..., 3)`` to the nearest of something [m]."""


class Texture:
    """An image with its half-octave pyramid; a level is built when it is first asked for.

    Threads may share one: at worst both build the same level.
    """

    def __init__(self, image: np.ndarray | Callable[[], np.ndarray]) -> None:
        """Args: ``image`` ``(H, W, 3)`` uint8 BGR, or what makes it: where to fly in a world needs no pictures."""
        self._make = image if callable(image) else lambda: image
        self._levels: dict[int, np.ndarray] = {}

    def level(self, k: int) -> np.ndarray:
        """Level ``k``: the image shrunk by ``2 ** (k / 2)`` in width and height (area average)."""
        if k not in self._levels:
            if k == 0:
                found = np.ascontiguousarray(self._make())
            else:
                source = self.level(max(k - 2, 0))
                shrink = 2.0 ** (-0.5 * min(k, 2))
                found = shrunk(source, *(max(1, round(n * shrink)) for n in source.shape[1::-1]))
            self._levels[k] = found
        return self._levels[k]


@dataclass(frozen=True, slots=True, eq=False)
class Quad:
    """A textured parallelogram, seen from the side from which ``u`` runs right and ``v`` runs down."""

    origin_w: FloatArray
    """``(3,)`` top left corner [m]."""
    u_w: FloatArray
    """``(3,)`` from the top left to the top right corner [m]."""
    v_w: FloatArray
    """``(3,)`` from the top left to the bottom left corner [m]."""
    texture: Texture
    name: str = ""
    two_sided: bool = False
    solid: int = -1
    """Index of the box that it bounds, -1 for none."""


@dataclass(frozen=True, slots=True)
class Box:
    """An upright solid, turned about z: what casts shadows and what a camera must stay out of."""

    centre_w: FloatArray
    """``(3,)`` [m]."""
    half_m: FloatArray
    """``(3,)`` half extents along its own axes [m]."""
    yaw_rad: float = 0.0


def to_boxes(boxes: Sequence[Box]) -> Distance:
    """Distance to the nearest box; 0 inside, infinite without boxes."""
    centre = np.array([b.centre_w for b in boxes]).reshape(-1, 3)
    half = np.array([b.half_m for b in boxes]).reshape(-1, 3)
    yaw = np.array([b.yaw_rad for b in boxes])
    c, s = np.cos(yaw), np.sin(yaw)

    def distance(p_w: FloatArray) -> FloatArray:
        x, y, z = np.moveaxis(p_w[..., None, :] - centre, -1, 0)  # (..., B)
        out = [np.maximum(np.abs(v) - half[:, k], 0.0) for k, v in enumerate((c * x + s * y, c * y - s * x, z))]
        return np.sqrt((out[0] ** 2 + out[1] ** 2 + out[2] ** 2).min(-1, initial=np.inf))

    return distance


def to_quads(quads: Sequence[Quad]) -> Distance:
    """Distance to the nearest quad; exact for rectangles, at most a few percent too far for slanted leaves."""
    origin, u, v = (np.array([getattr(q, k) for q in quads]) for k in ("origin_w", "u_w", "v_w"))
    inverse = np.linalg.pinv(np.stack([u, v], axis=2))

    def distance(p_w: FloatArray) -> FloatArray:
        offset = p_w[:, None] - origin  # (N, Q, 3)
        s, t = (np.clip((offset * inverse[:, k]).sum(-1), 0.0, 1.0)[..., None] for k in (0, 1))
        return np.sqrt(((offset - s * u - t * v) ** 2).sum(-1).min(1))

    return distance


def in_parts(distance: Distance, p_w: FloatArray) -> FloatArray:
    """``distance`` of points ``(N, 3)``, some hundred at a time: a few megabytes."""
    points = np.asarray(p_w, dtype=np.float64)
    return np.concatenate([distance(points[k : k + _CHUNK]) for k in range(0, len(points), _CHUNK)] or [np.zeros(0)])


class World:
    """Quads in the world frame ``w`` (z up, metres), with what is needed to move a camera among them."""

    def __init__(
        self,
        quads: Sequence[Quad],
        name: str = "world",
        bounds_w: FloatArray | None = None,
        boxes: Sequence[Box] = (),
        unseen: Sequence[Box] = (),
    ) -> None:
        """Args: ``bounds_w`` ``(2, 3)`` free space, low and high corner; ``boxes`` the solids inside it; ``unseen``
        those that are not painted, such as panes of glass."""
        if not 0 < len(quads) < 2**15:
            raise ValueError(f"a world needs 1 to 32767 quads, got {len(quads)}")
        self.quads, self.name, self.boxes, self.unseen = tuple(quads), name, tuple(boxes), tuple(unseen)
        o, u, v = (np.array([getattr(q, k) for q in quads]) for k in ("origin_w", "u_w", "v_w"))
        self.corners_w = np.stack([o, o + u, o + u + v, o + v], axis=1)
        """Top left, top right, bottom right, bottom left, ``(Q, 4, 3)``."""
        self.normals_w = np.cross(v, u)
        """Towards the side that is seen, ``(Q, 3)``."""
        self.normals_w /= np.linalg.norm(self.normals_w, axis=1, keepdims=True)
        self.two_sided = np.array([q.two_sided for q in quads])
        low, high = self.corners_w.min((0, 1)), self.corners_w.max((0, 1))
        self.bounds_w = np.stack([low, high]) if bounds_w is None else np.asarray(bounds_w, dtype=np.float64)

    def clearance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., 3)`` to the nearest wall or solid; negative outside the bounds."""
        p = np.asarray(p_w, dtype=np.float64)
        free = np.minimum(p - self.bounds_w[0], self.bounds_w[1] - p).min(-1)
        return np.minimum(free, self._solid(p))

    def floor_below(self, p_w: FloatArray) -> FloatArray:
        """Height [m] of the highest level surface under each point ``(N, 3)``; the lower bound where there is none."""
        p = np.asarray(p_w, dtype=np.float64)
        height = np.full(len(p), self.bounds_w[0, 2])
        for k in np.flatnonzero(self.normals_w[:, 2] >= 0.99):
            quad = self.quads[k]
            basis = np.stack([quad.u_w[:2], quad.v_w[:2]], axis=1)
            st = (p[:, :2] - quad.origin_w[:2]) @ np.linalg.inv(basis).T
            under = (st >= 0).all(1) & (st <= 1).all(1) & (quad.origin_w[2] <= p[:, 2])
            height[under] = np.maximum(height[under], quad.origin_w[2])
        return height

    def distance_to_solid(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to what a drone can hit, ``(N,)``: walls, solids and painted surfaces, but
        not the floor, on which drones stand; 0 inside a solid or outside the world."""
        low, high = self.bounds_w

        def distance(p: FloatArray) -> FloatArray:
            nearest = np.minimum(p[:, :2] - low[:2], high[:2] - p[:, :2]).min(1)
            nearest = np.maximum(np.minimum(nearest, high[2] - p[:, 2]), 0.0)
            return np.min([nearest, *(to(p) for to in self._hard)], axis=0)

        return in_parts(distance, p_w)

    @cached_property
    def _solid(self) -> Distance:
        return to_boxes(self.boxes)

    @cached_property
    def _hard(self) -> tuple[Distance, Distance]:
        return to_quads([quad for quad in self.quads if quad.name != "floor"]), to_boxes([*self.boxes, *self.unseen])

    def distance_to_surface(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to the nearest quad, ``(N,)``."""
        return in_parts(to_quads(self.quads), p_w)
