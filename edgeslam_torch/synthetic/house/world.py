"""A world of textured parallelograms, and its exact edges and corners."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.synthetic.textures.image_ops import shrunk
from edgeslam_torch.types import FloatArray

MAX_LEVEL = 18
"""Half-octave texture levels: the coarsest is 1/512 of the finest."""


class Texture:
    """An image with its half-octave pyramid, built when a level is first asked for.

    Threads may share one: at worst both build the same level.
    """

    def __init__(self, image: np.ndarray) -> None:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"a texture is (H, W, 3) uint8, got {image.shape} {image.dtype}")
        self._levels: dict[int, np.ndarray] = {0: np.ascontiguousarray(image)}

    @property
    def image(self) -> np.ndarray:
        """Finest level, ``(H, W, 3)`` BGR."""
        return self._levels[0]

    def level(self, k: int) -> np.ndarray:
        """Level ``k``: the image shrunk by ``2 ** (k / 2)`` in width and height (area average)."""
        found = self._levels.get(k)
        if found is None:
            source = self.level(max(k - 2, 0))
            shrink = 2.0 ** (-0.5 * min(k, 2))
            width, height = (max(1, round(n * shrink)) for n in (source.shape[1], source.shape[0]))
            found = self._levels.setdefault(k, shrunk(source, width, height))
        return found


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

    def to_local(self, p_w: FloatArray) -> FloatArray:
        """Points ``(..., 3)`` in the box's own axes, centre at zero."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        R_w_box = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return (np.asarray(p_w) - self.centre_w) @ R_w_box

    def distance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., 3)`` outside; 0 inside."""
        return np.linalg.norm(np.maximum(np.abs(self.to_local(p_w)) - self.half_m, 0.0), axis=-1)


@dataclass(frozen=True, slots=True)
class EdgeSegments:
    """Straight 3-D edges known from geometry."""

    p_w: FloatArray
    """``(S, 2, 3)`` ends [m]."""
    quad: np.ndarray
    """``(S,)`` the quad each belongs to, int32."""


@dataclass(frozen=True, slots=True)
class Junctions:
    """Corners where two straight edges of a quad meet (L-junctions)."""

    p_w: FloatArray
    """``(C, 3)`` corner [m]."""
    arm_a_w: FloatArray
    """``(C, 3)`` far end of one arm [m]."""
    arm_b_w: FloatArray
    """``(C, 3)`` far end of the other arm [m]."""
    quad: np.ndarray
    """``(C,)`` int32."""


class World:
    """Quads in the world frame ``w`` (z up, metres), with what is needed to move a camera among them."""

    def __init__(
        self,
        quads: list[Quad],
        name: str = "world",
        bounds_w: FloatArray | None = None,
        boxes: list[Box] | None = None,
        background: tuple[int, int, int] = (90, 90, 90),
    ) -> None:
        """Args: ``bounds_w`` ``(2, 3)`` free space, low and high corner; ``boxes`` the solids inside it."""
        if not 0 < len(quads) < 2**15:
            raise ValueError(f"a world needs 1 to 32767 quads, got {len(quads)}")
        self.quads = tuple(quads)
        self.name = name
        self.boxes = tuple(boxes or [])
        self.background = background
        self.corners_w = np.stack([q.corners_w for q in quads])
        self.normals_w = np.stack([q.normal_w for q in quads])
        self.texels = np.array([q.texture.image.shape[0] * q.texture.image.shape[1] for q in quads], dtype=np.float64)
        self.two_sided = np.array([q.two_sided for q in quads])
        self._box_centre = np.array([b.centre_w for b in self.boxes]).reshape(-1, 3)
        self._box_half = np.array([b.half_m for b in self.boxes]).reshape(-1, 3)
        yaw = np.array([b.yaw_rad for b in self.boxes])
        self._box_cos, self._box_sin = np.cos(yaw), np.sin(yaw)
        low, high = self.corners_w.min((0, 1)), self.corners_w.max((0, 1))
        self.bounds_w = np.stack([low, high]) if bounds_w is None else np.asarray(bounds_w, dtype=np.float64)

    def clearance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., 3)`` to the nearest wall or solid; negative outside the bounds."""
        p = np.asarray(p_w, dtype=np.float64)
        free = np.minimum(p - self.bounds_w[0], self.bounds_w[1] - p).min(-1)
        if not self.boxes:
            return free
        offset = p[..., None, :] - self._box_centre  # (..., B, 3)
        x = self._box_cos * offset[..., 0] + self._box_sin * offset[..., 1]
        y = self._box_cos * offset[..., 1] - self._box_sin * offset[..., 0]
        out = [np.maximum(np.abs(v) - self._box_half[:, k], 0.0) for k, v in enumerate((x, y, offset[..., 2]))]
        return np.minimum(free, np.sqrt((out[0] ** 2 + out[1] ** 2 + out[2] ** 2).min(-1)))

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

    def distance_to_surface(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to the nearest quad, ``(N,)``."""
        p = np.asarray(p_w, dtype=np.float64)
        best = np.full(len(p), np.inf)
        for quad in self.quads:
            basis = np.stack([quad.u_w, quad.v_w], axis=1)  # (3, 2)
            st = np.clip((p - quad.origin_w) @ np.linalg.pinv(basis).T, 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(p - quad.origin_w - st @ basis.T, axis=1))
        return best

    def edge_segments(self) -> EdgeSegments:
        """The four borders of every quad."""
        ends = np.stack([self.corners_w, np.roll(self.corners_w, -1, axis=1)], axis=2)  # (Q, 4, 2, 3)
        return EdgeSegments(ends.reshape(-1, 2, 3), np.repeat(np.arange(len(self.quads), dtype=np.int32), 4))

    def junctions(self) -> Junctions:
        """The four corners of every quad with both borders that meet there."""
        previous, following = np.roll(self.corners_w, 1, axis=1), np.roll(self.corners_w, -1, axis=1)
        quad = np.repeat(np.arange(len(self.quads), dtype=np.int32), 4)
        return Junctions(self.corners_w.reshape(-1, 3), previous.reshape(-1, 3), following.reshape(-1, 3), quad)
