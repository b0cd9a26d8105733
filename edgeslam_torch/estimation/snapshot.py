"""Current camera pose from immutable records, safe to use in other threads."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.estimation.filter.filter_feed import FilterFeed, FilterView
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.prediction import by_vision
from edgeslam_torch.estimation.sensors.imu import Imu
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.imu import ImuReadings
from edgeslam_torch.types import FloatArray, Health, PoseNow, ScaleEstimate, TelemetrySample

_LONGEST_STEP_S = 0.5
"""Maximum time between tracked frames for a velocity."""


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
        seen = by_vision(last, previous, stamp_s)
        if turned is not None:
            T = seen.T_w_c.copy()
            T[:3, :3] = last.T[:3, :3] @ turned.T
            seen = replace(seen, T_w_c=T, sigma_r_rad=last.sigma_r_rad, source="visual+imu")
        velocity, sigma_v = np.zeros(3), math.inf
        if previous is not None and last.stamp_s - previous.stamp_s < _LONGEST_STEP_S:
            step_s = last.stamp_s - previous.stamp_s
            velocity = (last.T[:3, 3] - previous.T[:3, 3]) / step_s
            sigma_v = math.hypot(math.sqrt(2.0) * last.sigma_t / step_s, seen.sigma_t / max(step_s, 1e-3))
        sigma = np.repeat([seen.sigma_t, seen.sigma_r_rad, sigma_v], 3)
        unit = self.published.scale
        return PoseNow(
            stamp_s,
            self.published.pose(seen.T_w_c),
            unit * (self.published.R @ velocity),
            np.diag((sigma * np.repeat([unit, 1.0, unit], 3)) ** 2),
            seen.source,
            last.stamp_s,
            self.metric,
            self.published.revision,
        )


def _in_world(covariance: FloatArray, R: FloatArray, unit: float) -> FloatArray:
    turn = np.kron(np.diag([unit, 1.0, unit]), R)
    return turn @ covariance @ turn.T
