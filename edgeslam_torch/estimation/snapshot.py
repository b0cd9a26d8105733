"""Current camera pose from immutable records, safe to use in other threads."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.estimation.filter.filter_feed import FilterFeed, FilterView
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.sensors.imu import Imu
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import rotation_vector
from edgeslam_torch.imu import ImuReadings
from edgeslam_torch.types import FloatArray, Health, PoseNow, ScaleEstimate, TelemetrySample

_LONGEST_STEP_S = 0.5
"""Maximum time between tracked frames for a velocity."""
_VISUAL_REACH_S = 0.15
"""Time up to which the last visual velocity predicts better than 10 Hz readings of 0.1 m/s."""
_VISUAL_LIMIT_S = 0.5
"""Time after which constant velocity stops, without telemetry."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of the fusion at one time."""

    last: VisualPose
    """Newest tracked frame."""
    previous: VisualPose | None
    """The one before, if tracking was not interrupted since."""
    filter: FilterFeed
    imu: Imu
    scale: ScaleEstimate
    delay_sigma_s: float


@dataclass(frozen=True, slots=True)
class Present:
    """State after a frame: the snapshot, the published world, and its reliability."""

    snapshot: Snapshot | None = None
    published: OutputFrame = field(default_factory=OutputFrame)
    metric: bool = False
    health: Health | None = None
    """None before the first frame."""

    def pose_at(
        self, stamp_s: float, telemetry: Sequence[TelemetrySample] = (), inertial: Sequence[ImuReadings] = ()
    ) -> PoseNow | None:
        """Camera pose at a stamp; ``None`` before the first tracked frame.

        Args:
            stamp_s: No earlier than the newest state message.
            telemetry: State messages that arrived since the snapshot.
            inertial: IMU readings that did.
        """
        known = self.snapshot
        if known is None:
            return None
        view = known.filter.at_present(stamp_s, telemetry)
        if view is not None:
            return self._by_filter(known, view)
        return self._by_vision(known, stamp_s, known.imu.frozen(inertial).turned(known.last.stamp_s, stamp_s))

    def _by_filter(self, known: Snapshot, view: FilterView) -> PoseNow:
        unit = self.published.scale / known.scale.value  # published units per metre
        T_w_seen = self.published.pose(view.seen.T)
        T_seen_c = view.T_seen_c.copy()
        T_seen_c[:3, 3] *= unit
        return PoseNow(
            view.to_s,
            T_w_seen @ T_seen_c,
            unit * (T_w_seen[:3, :3] @ view.velocity_m_s),
            _in_world(view.with_doubts(known.scale, known.delay_sigma_s), T_w_seen[:3, :3], unit),
            "filter",
            view.seen.stamp_s,
            self.metric,
            self.published.revision,
        )

    def _by_vision(self, known: Snapshot, stamp_s: float, turned: FloatArray | None) -> PoseNow:
        """Constant velocity, with the rotation ``(3, 3)`` since the last frame by a gyroscope if there is one; without
        two frames the sigma of the velocity is infinite."""
        last, previous = known.last, known.previous
        gap = stamp_s - last.stamp_s
        growth = max(0.0, gap) / _VISUAL_REACH_S
        T, velocity, sigma_v = last.T.copy(), np.zeros(3), math.inf
        sigma_t, sigma_r = (1.0 + growth) * last.sigma_t, last.sigma_r_rad + 0.005 * growth
        if previous is not None:
            step_s = last.stamp_s - previous.stamp_s
            reach = min(gap, _VISUAL_LIMIT_S) / step_s
            step = last.T[:3, 3] - previous.T[:3, 3]
            turn = reach * rotation_vector(previous.T[:3, :3].T @ last.T[:3, :3])
            T[:3, 3] += reach * step
            T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), turn]))[:3, :3]
            sigma_t = last.sigma_t + growth * max(reach * float(np.linalg.norm(step)), last.sigma_t)
            sigma_r = last.sigma_r_rad + growth * max(float(np.linalg.norm(turn)), 0.005)
            if step_s < _LONGEST_STEP_S:
                velocity = step / step_s
                sigma_v = math.hypot(math.sqrt(2.0) * last.sigma_t / step_s, sigma_t / max(step_s, 1e-3))
        if turned is not None:
            T[:3, :3], sigma_r = last.T[:3, :3] @ turned.T, last.sigma_r_rad
        unit = self.published.scale
        return PoseNow(
            stamp_s,
            self.published.pose(T),
            unit * (self.published.R @ velocity),
            np.diag(np.repeat([unit * sigma_t, sigma_r, unit * sigma_v], 3) ** 2),
            "visual" if turned is None else "visual+imu",
            last.stamp_s,
            self.metric,
            self.published.revision,
        )


def _in_world(covariance: FloatArray, R: FloatArray, unit: float) -> FloatArray:
    turn = np.kron(np.diag([unit, 1.0, unit]), R)
    return turn @ covariance @ turn.T
