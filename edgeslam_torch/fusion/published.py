"""From the map's own units and axes to the world that is published: metres when they are known, z up.

The map itself is never rescaled. When the scale estimate changes, the similarity that publishes it turns about the
present camera: the live pose does not jump, and map and trajectory stay consistent, because both pass through the
same similarity at any moment. The final results use the final scale throughout.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, PointCloud

T_LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""``T_w_c`` of a level camera that looks along world x: the first pose when nothing tells the attitude."""

MIN_CHANGE = 1e-3
"""Relative change of the scale that is worth publishing."""


@dataclass(frozen=True, slots=True)
class Published:
    """Similarity ``p_published = scale R p_map + offset``."""

    scale: float = 1.0
    R: FloatArray = field(default_factory=lambda: np.eye(3))
    offset: FloatArray = field(default_factory=lambda: np.zeros(3))

    def pose(self, T_w_c: FloatArray) -> FloatArray:
        """Poses ``(..., 4, 4)`` of the map as published."""
        out = np.array(T_w_c, dtype=np.float64)
        out[..., :3, :3] = self.R @ T_w_c[..., :3, :3]
        out[..., :3, 3] = self.points(T_w_c[..., :3, 3])
        return out

    def points(self, p: FloatArray) -> FloatArray:
        """Points ``(..., 3)`` of the map as published."""
        return self.scale * (p @ self.R.T) + self.offset

    def cloud(self, cloud: PointCloud) -> PointCloud:
        """A point cloud of the map as published."""
        p = self.points(cloud.p_w.astype(np.float64)).astype(np.float32)
        return replace(cloud, p_w=p, sigma_m=(self.scale * cloud.sigma_m).astype(np.float32))

    def with_scale(self, scale: float, centre_map: FloatArray) -> "Published":
        """The same, at another scale, with one map point published where it was."""
        if abs(scale / self.scale - 1.0) < MIN_CHANGE:
            return self
        return Published(scale, self.R, self.offset + (self.scale - scale) * (self.R @ centre_map))


def first_pose(rpy_rad: FloatArray, T_b_c: FloatArray) -> FloatArray:
    """``T_w_c`` at the origin from the drone's attitude ``(3,)``; level and forward when it is not known."""
    if not np.isfinite(rpy_rad).all():
        return T_LEVEL.copy()
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", rpy_rad[::-1]).as_matrix() @ T_b_c[:3, :3]
    return se3.orthonormalised(T)
