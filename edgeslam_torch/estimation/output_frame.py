"""Transform from map units and axes to the published world: metric and z up, each if known.

The map itself is never rescaled. Its units are published as they are until reliable sensors contradict them. A revision
rescales about the origin, where the flight began: positions after it are right at once, and those published before
carry the revision of their unit. The axes are revised likewise: once the attitude is known, and again where a validated
one finds them off, as after a bent take-off. Final results without telemetry are levelled by `mapping/level/`.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, smallest_rotation
from edgeslam_torch.noise import FIRST_ATTITUDE_RAD
from edgeslam_torch.types import FloatArray, PointCloud, ScaleEstimate

T_LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""``T_w_c`` of a level camera that looks along world x: the first pose without attitude."""

SURE = 0.15
"""Maximum relative sigma of a scale that revises a published one of a similar sigma; depth networks reach 0.16 at
best."""

CONTRADICTION = 2.0
"""Deviation of the published scale that triggers a revision [sigmas]."""

_IMPROVED = 0.5
"""Share of the published scale's sigma at which an estimate replaces it if it is off by more than the new sigma. The
initial guess has an infinite one; an IMU's first estimate is good to a half, and to a hundredth ten seconds later."""

_LEANS_RAD = 2.0 * FIRST_ATTITUDE_RAD
"""Error of levelled axes that is corrected: two standard deviations of the attitude that levelled them."""

MEASURED = frozenset({"telemetry", "height", "imu"})
"""Sources that measure metres; the depth network has set the initial guess already."""


@dataclass(frozen=True, slots=True)
class OutputFrame:
    """Similarity ``p_published = scale R p_map``."""

    scale: float = 1.0
    R: FloatArray = field(default_factory=lambda: np.eye(3))
    revision: int = 0
    """Number of revisions so far."""
    sigma: float = math.inf
    """Relative standard deviation of the scale at its last revision; infinite for the initial guess."""
    upright: bool = False
    """Whether z is up by the drone's attitude."""
    is_earlier: bool = False
    """Whether scale and axes are those of an earlier flight, which stay."""

    def pose(self, T_w_c: FloatArray) -> FloatArray:
        """Poses ``(..., 4, 4)`` of the map as published."""
        out = np.array(T_w_c, dtype=np.float64)
        out[..., :3, :3] = self.R @ T_w_c[..., :3, :3]
        out[..., :3, 3] = self.points(T_w_c[..., :3, 3])
        return out

    def points(self, p: FloatArray) -> FloatArray:
        """Points ``(..., 3)`` of the map as published."""
        return self.scale * (p @ self.R.T)

    def cloud(self, cloud: PointCloud) -> PointCloud:
        """A point cloud of the map as published."""
        p = self.points(cloud.p_w.astype(np.float64)).astype(np.float32)
        return replace(cloud, p_w=p, sigma_m=(self.scale * cloud.sigma_m).astype(np.float32))

    def is_metric(self, estimate: ScaleEstimate) -> bool:
        """Whether the published unit is a metre within the uncertainty of an estimate [metres per map unit]."""
        return math.isfinite(estimate.sigma) and not self.contradicts(estimate)

    def contradicts(self, estimate: ScaleEstimate) -> bool:
        """Whether an estimate [metres per map unit] contradicts the published scale."""
        sigma = estimate.sigma / estimate.value
        return bool(self._off(estimate) > CONTRADICTION * sigma)

    def _off(self, estimate: ScaleEstimate) -> float:
        """Deviation of the published scale from an estimate, in the logarithm."""
        return abs(math.log(estimate.value / self.scale))

    def turned_upright(self, R_w_m: FloatArray | None, validated: bool) -> "OutputFrame":
        """The same with z up, by the smallest rotation, if it is not yet level and the attitude is known.

        Args:
            R_w_m: Rotation ``(3, 3)`` from the map to a world whose z is up; None while unknown.
            validated: Whether it is known well enough to correct axes that were levelled before.
        """
        if R_w_m is None or self.is_earlier:
            return self
        leans_rad = math.acos(float(np.clip(self.R[2] @ R_w_m[2], -1.0, 1.0)))
        if self.upright and not (validated and leans_rad > _LEANS_RAD):
            return self
        return replace(self.levelled(R_w_m[2]), revision=self.revision + 1, upright=True)

    def levelled(self, up_map: FloatArray) -> "OutputFrame":
        """The same with a direction ``(3,)`` of the map up, by the smallest rotation."""
        return replace(self, R=smallest_rotation(self.R @ up_map, np.array([0.0, 0.0, 1.0])) @ self.R)

    def revised(self, estimate: ScaleEstimate) -> "OutputFrame":
        """The same at an estimated scale, if that is measured, and is much more accurate than the published one or
        accurate and contradicts it.

        Args:
            estimate: Metres per map unit.
        """
        sigma = estimate.sigma / estimate.value
        better = sigma < _IMPROVED * self.sigma and self._off(estimate) > sigma
        measured = not MEASURED.isdisjoint(estimate.source.split("+"))
        if not (measured and (better or (sigma < SURE and self.contradicts(estimate)))):
            return self
        return replace(self, scale=estimate.value, revision=self.revision + 1, sigma=sigma)


def first_pose(rpy_rad: FloatArray, T_b_c: FloatArray) -> FloatArray:
    """``T_w_c`` at the origin from the drone's attitude ``(3,)``; level and forward if unknown."""
    if not np.isfinite(rpy_rad).all():
        return T_LEVEL.copy()
    T = np.eye(4)
    T[:3, :3] = matrix_from_rpy(rpy_rad) @ T_b_c[:3, :3]
    return se3.orthonormalised(T)
