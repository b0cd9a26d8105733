"""What can be seen of a world's exact edges and corners from a pose: ground truth for edge depth and L-junctions."""

from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import NEAR_M, Rendered
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

HIDDEN_RATIO = 0.01
"""A point is hidden when everything drawn within a pixel is nearer than it by this share."""


@dataclass(frozen=True, slots=True)
class VisibleEdges:
    """Points along the visible parts of 3-D edges."""

    uv: FloatArray
    """``(E, 2)`` exact projection [px]."""
    p_w: FloatArray
    """``(E, 3)`` [m]."""
    depth_m: FloatArray
    """``(E,)`` z-depth of the edge itself."""
    direction_uv: FloatArray
    """``(E, 2)`` unit direction of the edge in the image."""
    segment: np.ndarray
    """``(E,)`` row of ``world.edge_segments()``."""


@dataclass(frozen=True, slots=True)
class VisibleJunctions:
    """Corners of quads that are seen together with the beginning of both arms."""

    uv: FloatArray
    """``(C, 2)`` [px]."""
    arm_a_uv: FloatArray
    """``(C, 2)`` projection of a point on one arm."""
    arm_b_uv: FloatArray
    """``(C, 2)`` projection of a point on the other."""
    p_w: FloatArray
    """``(C, 3)`` corner [m]."""
    arm_a_w: FloatArray
    """``(C, 3)`` the point on one arm [m]."""
    arm_b_w: FloatArray
    """``(C, 3)`` the point on the other [m]."""
    junction: np.ndarray
    """``(C,)`` row of ``world.junctions()``."""


def visible_edges(
    world: World, camera: Camera, T_w_c: FloatArray, view: Rendered, *, spacing_m: float = 0.01
) -> VisibleEdges:
    """Points every ``spacing_m`` on the visible parts of `World.edge_segments`; ``camera`` without distortion."""
    ends = world.edge_segments().p_w
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    count = np.maximum(2, np.ceil(length / spacing_m).astype(int))
    owner = np.repeat(np.arange(len(ends)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    share = ((within + 0.5) / count[owner])[:, None]
    p_w = ends[owner, 0] + share * (ends[owner, 1] - ends[owner, 0])
    kept = np.flatnonzero(is_visible(camera, T_w_c, view, p_w))
    T_c_w = se3.inverse(np.asarray(T_w_c))
    p_c = se3.transform(T_c_w, p_w[kept])
    along = (ends[owner[kept], 1] - ends[owner[kept], 0]) @ T_c_w[:3, :3].T
    uv = camera.project(p_c)
    z = p_c[:, 2:]
    direction = (along[:, :2] * z - p_c[:, :2] * along[:, 2:]) * [camera.fx, camera.fy]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    return VisibleEdges(uv, p_w[kept], p_c[:, 2], direction, owner[kept].astype(np.int32))


def visible_junctions(
    world: World, camera: Camera, T_w_c: FloatArray, view: Rendered, *, arm_m: float = 0.1
) -> VisibleJunctions:
    """Corners that are seen with both arms, out to ``arm_m`` or their ends; ``camera`` without distortion."""
    junctions = world.junctions()
    arms = []
    for far in (junctions.arm_a_w, junctions.arm_b_w):
        step = far - junctions.p_w
        length = np.linalg.norm(step, axis=1, keepdims=True)
        arms.append(junctions.p_w + step * np.minimum(1.0, arm_m / np.maximum(length, 1e-12)))
    seen = is_visible(camera, T_w_c, view, junctions.p_w)
    for arm in arms:
        for share in (0.5, 1.0):
            seen &= is_visible(camera, T_w_c, view, junctions.p_w + share * (arm - junctions.p_w))
    kept = np.flatnonzero(seen)
    T_c_w = se3.inverse(np.asarray(T_w_c))
    p, a, b = junctions.p_w[kept], arms[0][kept], arms[1][kept]
    uv, uv_a, uv_b = (camera.project(se3.transform(T_c_w, x)) for x in (p, a, b))
    return VisibleJunctions(uv, uv_a, uv_b, p, a, b, kept.astype(np.int32))


def is_visible(camera: Camera, T_w_c: FloatArray, view: Rendered, p_w: FloatArray) -> np.ndarray:
    """Which points ``(N, 3)`` on surfaces project into the image and are not hidden, ``(N,)`` bool."""
    p_c = se3.transform(se3.inverse(np.asarray(T_w_c)), p_w)
    z = p_c[:, 2]
    seen = z > NEAR_M
    uv = np.full((len(p_w), 2), -1.0)
    uv[seen] = camera.project(p_c[seen])
    seen &= np.all((uv >= 0.0) & (uv <= [camera.width - 1.0, camera.height - 1.0]), axis=1)
    farthest = cv2.dilate(view.depth_m, np.ones((3, 3), np.uint8))
    column, row = np.rint(uv[seen]).astype(np.int64).T
    seen[seen] = z[seen] <= farthest[row, column] * (1.0 + HIDDEN_RATIO)
    return seen


def depth_discontinuities(view: Rendered, *, ratio: float = 0.05) -> np.ndarray:
    """Pixels ``(H, W)`` bool on the near side of a jump of depth by more than ``ratio``."""
    farthest = cv2.dilate(view.depth_m, np.ones((3, 3), np.uint8))
    return farthest > view.depth_m * (1.0 + ratio)
