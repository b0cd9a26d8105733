"""A world of textured parallelograms and solid boxes."""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from edgeslam_torch.synthetic.textures.image_ops import shrunk
from edgeslam_torch.types import FloatArray

MAX_LEVEL = 18
"""Half-octave texture levels: the coarsest is 1/512 of the finest."""
_CHUNK = 512
"""Points at a time."""


class Texture:
    """An image with its half-octave pyramid; a level is built when it is first asked for.

    Threads may share one: at worst both build the same level.
    """

    def __init__(self, image: np.ndarray | Callable[[], np.ndarray]) -> None:
        """Args: ``image`` ``(H, W, 3)`` BGR, or what makes it: where to fly in a world needs no pictures."""
        self._levels: dict[int, np.ndarray] = {}
        self._make: Callable[[], np.ndarray] | None = None
        if callable(image):
            self._make = image
        else:
            self._levels[0] = _checked(image)

    @property
    def image(self) -> np.ndarray:
        """Finest level, ``(H, W, 3)`` BGR."""
        return self.level(0)

    @property
    def texels(self) -> int:
        """Pixels of the finest level."""
        return math.prod(self.image.shape[:2])

    def level(self, k: int) -> np.ndarray:
        """Level ``k``: the image shrunk by ``2 ** (k / 2)`` in width and height (area average)."""
        make, found = self._make, self._levels.get(k)
        if found is None and k == 0:
            assert make is not None
            found = self._levels.setdefault(0, _checked(make()))
            self._make = None
        elif found is None:
            source = self.level(max(k - 2, 0))
            shrink = 2.0 ** (-0.5 * min(k, 2))
            width, height = (max(1, round(n * shrink)) for n in (source.shape[1], source.shape[0]))
            found = self._levels.setdefault(k, shrunk(source, width, height))
        return found


def _checked(image: np.ndarray) -> np.ndarray:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"a texture is (H, W, 3) uint8, got {image.shape} {image.dtype}")
    return np.ascontiguousarray(image)


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

    @property
    def corners_w(self) -> FloatArray:
        """Top left, top right, bottom right, bottom left, ``(4, 3)``."""
        o, u, v = self.origin_w, self.u_w, self.v_w
        return np.stack([o, o + u, o + u + v, o + v])

    @property
    def normal_w(self) -> FloatArray:
        """Unit normal ``(3,)`` towards the side that is seen."""
        n = np.cross(self.v_w, self.u_w)
        return n / np.linalg.norm(n)


@dataclass(frozen=True, slots=True)
class Box:
    """An upright solid, turned about z: what casts shadows and what a camera must stay out of."""

    centre_w: FloatArray
    """``(3,)`` [m]."""
    half_m: FloatArray
    """``(3,)`` half extents along its own axes [m]."""
    yaw_rad: float = 0.0

    def distance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., 3)`` outside; 0 inside."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        local = (np.asarray(p_w) - self.centre_w) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.linalg.norm(np.maximum(np.abs(local) - self.half_m, 0.0), axis=-1)


class Boxes:
    """Boxes, arranged for questions about many points at once."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._centre = np.array([b.centre_w for b in boxes]).reshape(-1, 3)
        self._half = np.array([b.half_m for b in boxes]).reshape(-1, 3)
        yaw = np.array([b.yaw_rad for b in boxes])
        self._cos, self._sin = np.cos(yaw), np.sin(yaw)

    def distance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., 3)`` to the nearest box; 0 inside, infinite without boxes."""
        offset = p_w[..., None, :] - self._centre  # (..., B, 3)
        x = self._cos * offset[..., 0] + self._sin * offset[..., 1]
        y = self._cos * offset[..., 1] - self._sin * offset[..., 0]
        out = [np.maximum(np.abs(v) - self._half[:, k], 0.0) for k, v in enumerate((x, y, offset[..., 2]))]
        return np.sqrt((out[0] ** 2 + out[1] ** 2 + out[2] ** 2).min(-1, initial=np.inf))


class Surfaces:
    """Quads, arranged for questions about many points at once."""

    def __init__(self, quads: Sequence[Quad]) -> None:
        self._origin = np.array([q.origin_w for q in quads])
        self._basis = np.stack([np.array([q.u_w for q in quads]), np.array([q.v_w for q in quads])], axis=2)
        self._inverse = np.linalg.pinv(self._basis)

    def distance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to the nearest quad.

        Exact for rectangles; for slanted parallelograms (leaves) at most a few percent too far.
        """
        offset = p_w[:, None] - self._origin  # (N, Q, 3)
        s, t = (np.clip((offset * self._inverse[:, k]).sum(-1), 0.0, 1.0) for k in (0, 1))
        away = offset - s[..., None] * self._basis[..., 0] - t[..., None] * self._basis[..., 1]
        return np.sqrt((away**2).sum(-1).min(1))


def in_parts(distance: Callable[[FloatArray], FloatArray], p_w: FloatArray) -> FloatArray:
    """``distance`` of points ``(N, 3)``, some hundred at a time: a few megabytes."""
    points = np.asarray(p_w, dtype=np.float64)
    parts = [distance(points[k : k + _CHUNK]) for k in range(0, len(points), _CHUNK)]
    return np.concatenate(parts) if parts else np.zeros(0)


class World:
    """Quads in the world frame ``w`` (z up, metres), with what is needed to move a camera among them."""

    def __init__(
        self,
        quads: list[Quad],
        name: str = "world",
        bounds_w: FloatArray | None = None,
        boxes: list[Box] | None = None,
        unseen: Sequence[Box] = (),
    ) -> None:
        """Args: ``bounds_w`` ``(2, 3)`` free space, low and high corner; ``boxes`` the solids inside it; ``unseen``
        those that are not painted, such as panes of glass."""
        if not 0 < len(quads) < 2**15:
            raise ValueError(f"a world needs 1 to 32767 quads, got {len(quads)}")
        self.quads = tuple(quads)
        self.name = name
        self.boxes = tuple(boxes or [])
        self.unseen = tuple(unseen)
        self.corners_w = np.stack([q.corners_w for q in quads])
        self.normals_w = np.stack([q.normal_w for q in quads])
        self.two_sided = np.array([q.two_sided for q in quads])
        self._solid = Boxes(self.boxes)
        low, high = self.corners_w.min((0, 1)), self.corners_w.max((0, 1))
        self.bounds_w = np.stack([low, high]) if bounds_w is None else np.asarray(bounds_w, dtype=np.float64)

    def clearance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., 3)`` to the nearest wall or solid; negative outside the bounds."""
        p = np.asarray(p_w, dtype=np.float64)
        free = np.minimum(p - self.bounds_w[0], self.bounds_w[1] - p).min(-1)
        return np.minimum(free, self._solid.distance(p))

    def floor_below(self, p_w: FloatArray) -> FloatArray:
        """Height [m] of the highest level surface under each point ``(N, 3)``; the lower bound where there is none."""
        p = np.asarray(p_w, dtype=np.float64)
        height = np.full(len(p), self.bounds_w[0, 2])
        for quad, normal in zip(self.quads, self.normals_w, strict=True):
            if normal[2] < 0.99:
                continue
            basis = np.stack([quad.u_w[:2], quad.v_w[:2]], axis=1)
            st = (p[:, :2] - quad.origin_w[:2]) @ np.linalg.inv(basis).T
            under = (st >= 0).all(1) & (st <= 1).all(1) & (quad.origin_w[2] <= p[:, 2])
            height[under] = np.maximum(height[under], quad.origin_w[2])
        return height

    def distance_to_solid(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to what a drone can hit, ``(N,)``: walls, solids and painted surfaces, but
        not the floor, on which drones stand; 0 inside a solid or outside the world."""
        surfaces, boxes = self._hard
        low, high = self.bounds_w

        def distance(p: FloatArray) -> FloatArray:
            nearest = np.minimum(p[:, :2] - low[:2], high[:2] - p[:, :2]).min(1)
            nearest = np.maximum(np.minimum(nearest, high[2] - p[:, 2]), 0.0)
            return np.minimum(np.minimum(nearest, boxes.distance(p)), surfaces.distance(p))

        return in_parts(distance, p_w)

    @cached_property
    def _hard(self) -> tuple[Surfaces, Boxes]:
        return Surfaces([quad for quad in self.quads if quad.name != "floor"]), Boxes([*self.boxes, *self.unseen])

    def with_quads(self, quads: Sequence[Quad]) -> "World":
        """The same with more to see; the arrays of its own are kept, which takes a millisecond."""
        out = copy(self)
        out.quads = (*self.quads, *quads)
        out.corners_w = np.concatenate([self.corners_w, [q.corners_w for q in quads]])
        out.normals_w = np.concatenate([self.normals_w, [q.normal_w for q in quads]])
        out.two_sided = np.concatenate([self.two_sided, [q.two_sided for q in quads]])
        return out

    def distance_to_surface(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to the nearest quad, ``(N,)``."""
        return in_parts(Surfaces(self.quads).distance, p_w)
