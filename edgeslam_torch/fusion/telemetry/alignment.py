"""Orientation of the map in the drone's power-on world, from the drone's attitude."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.telemetry.track import TelemetryTrack
from edgeslam_torch.fusion.telemetry.visual_memory import Displacements, Sightings
from edgeslam_torch.geometry.rotations import mean_rotation
from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class Turns:
    """Rotations over the same intervals, in body axes."""

    seen: FloatArray
    """``(N, 3, 3)`` by the images."""
    told: FloatArray
    """``(N, 3, 3)`` by telemetry."""


def map_to_world(sightings: Sightings, track: TelemetryTrack, delay_s: float, R_b_c: FloatArray) -> FloatArray | None:
    """Mean of ``R_w_b(telemetry) R_b_c R_m_c^T`` over the remembered poses.

    Args:
        sightings: Poses in the map.
        track: Telemetry.
        delay_s: Video delay behind telemetry.
        R_b_c: Camera in the body ``(3, 3)``.

    Returns:
        ``R_w_m`` ``(3, 3)``, map axes to the power-on world; ``None`` where no attitude covers a pose.
    """
    stamps_s = sightings.stamps_s - delay_s
    inside = track.covered(stamps_s, stamps_s)
    if not inside.any():
        return None
    R_m_c = sightings.T[inside, :3, :3]
    return mean_rotation(track.attitude(stamps_s[inside]) @ R_b_c @ np.swapaxes(R_m_c, 1, 2))


def turns(moved: Displacements, track: TelemetryTrack, R_b_c: FloatArray) -> Turns:
    """Rotations over each interval according to images and telemetry.

    Args:
        moved: Displacements on telemetry's clock.
        track: Telemetry.
        R_b_c: Camera in the body ``(3, 3)``.
    """
    seen = R_b_c @ np.swapaxes(moved.R_from, 1, 2) @ moved.R_to @ R_b_c.T
    told = np.swapaxes(track.attitude(moved.from_s), 1, 2) @ track.attitude(moved.to_s)
    return Turns(seen, told)
