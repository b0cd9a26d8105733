"""Orientation of the map in the drone's power-on world, from the drone's attitude."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.scale.camera_mount import mount_by_turns
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements, Sightings
from edgeslam_torch.geometry.rotations import mean_rotation, rpy_from_matrix, vectors_from_matrices
from edgeslam_torch.types import FloatArray

LATELY = 5
"""Number of recent frames for detecting a sudden fault: half a second."""


@dataclass(frozen=True, slots=True)
class Attitudes:
    """Camera rotations in the map, and the drone's attitude."""

    stamp_s: FloatArray
    """``(N,)`` on telemetry's clock."""
    R_m_c: FloatArray
    """``(N, 3, 3)`` by the images."""
    R_w_b: FloatArray
    """``(N, 3, 3)`` by telemetry."""

    def map_to_world(self, R_b_c: FloatArray) -> FloatArray:
        """``R_w_m`` ``(3, 3)``, the mean of ``R_w_b R_b_c R_m_c^T``."""
        return mean_rotation(self.R_w_b @ R_b_c @ np.swapaxes(self.R_m_c, 1, 2))


@dataclass(frozen=True, slots=True)
class Turns:
    """Rotations over the same intervals, in body axes."""

    seen: FloatArray
    """``(N, 3, 3)`` by the images."""
    reported: FloatArray
    """``(N, 3, 3)`` by telemetry."""


@dataclass(frozen=True, slots=True)
class AttitudeDeviation:
    """RMS deviation between attitude and images, and the visual rotation; per body axis [rad]."""

    rms: FloatArray
    """``(3,)`` RMS of the rotation between both."""
    lately: FloatArray
    """``(3,)`` the same over the newest `LATELY` frames: a sudden fault."""
    seen: FloatArray
    """``(3,)`` standard deviation of roll, pitch and yaw by the images."""
    rate: FloatArray
    """``(3,)`` root mean square of their rates [rad/s]."""


def attitude_deviation(reported: Attitudes, R_b_c: FloatArray, sigma_rad: float) -> AttitudeDeviation:
    """Deviation between attitude and images over the whole flight, with mount and map rotation fitted.

    Attitudes, unlike their increments, reveal a jump, a frozen reading and a wrong sign: the rotation from the map to
    the power-on world must be the same in all frames.

    Args:
        reported: Both.
        R_b_c: Configured camera in the body ``(3, 3)``.
        sigma_rad: Its standard deviation.
    """
    turned = mount_by_turns(reported.R_m_c, reported.R_w_b, reported.stamp_s, R_b_c, sigma_rad)
    seen = turned.R_w_m @ reported.R_m_c @ turned.R_b_c.T
    off = vectors_from_matrices(np.swapaxes(seen, 1, 2) @ reported.R_w_b)
    rpy = np.unwrap([rpy_from_matrix(R) for R in seen], axis=0)
    rate = np.diff(rpy, axis=0) / np.diff(reported.stamp_s)[:, None]
    rms = [np.sqrt(np.mean(x**2, axis=0)) for x in (off, off[-LATELY:], rate)]
    return AttitudeDeviation(rms[0], rms[1], np.std(rpy, axis=0), rms[2])


def attitudes(sightings: Sightings, track: TelemetryTrack, delay_s: float) -> Attitudes | None:
    """The drone's attitude at each pose that telemetry covers; None without any."""
    stamps_s = sightings.stamps_s - delay_s
    inside = track.covered(stamps_s, stamps_s)
    if not inside.any():
        return None
    return Attitudes(stamps_s[inside], sightings.T[inside, :3, :3], track.attitude(stamps_s[inside]))


def map_to_world(sightings: Sightings, track: TelemetryTrack, delay_s: float, R_b_c: FloatArray) -> FloatArray | None:
    """Mean of ``R_w_b(telemetry) R_b_c R_m_c^T`` over the stored poses.

    Args:
        sightings: Poses in the map.
        track: Telemetry.
        delay_s: Video delay behind telemetry.
        R_b_c: Camera in the body ``(3, 3)``.

    Returns:
        ``R_w_m`` ``(3, 3)``, map axes to the power-on world; ``None`` where no attitude covers a pose.
    """
    reported = attitudes(sightings, track, delay_s)
    return None if reported is None else reported.map_to_world(R_b_c)


def in_common(moved: Displacements, track: TelemetryTrack, delay_s: float) -> Displacements:
    """The displacements that telemetry covers, on its clock."""
    moved = moved.on_telemetry_clock(delay_s)
    return moved.only(track.covered(moved.from_s, moved.to_s))


def camera_moved(
    moved: Displacements, track: TelemetryTrack, arm_b: FloatArray, shortfall_m_s: float = 0.0
) -> FloatArray:
    """Displacements ``(N, 3)`` of the camera by telemetry [m], over intervals on its clock.

    Args:
        moved: The intervals.
        track: Telemetry.
        arm_b: From body to camera ``(3,)``, body axes [m].
        shortfall_m_s: As for `TelemetryTrack.displacement`.
    """
    path = track.displacement(np.concatenate([moved.from_s, moved.to_s]), shortfall_m_s)
    turned = track.attitude(moved.to_s) - track.attitude(moved.from_s)
    return np.asarray(path[len(moved) :] - path[: len(moved)] + turned @ arm_b)


def turns(moved: Displacements, track: TelemetryTrack, R_b_c: FloatArray) -> Turns:
    """Rotations over each interval according to images and telemetry.

    Args:
        moved: Displacements on telemetry's clock.
        track: Telemetry.
        R_b_c: Camera in the body ``(3, 3)``.
    """
    seen = R_b_c @ np.swapaxes(moved.R_from, 1, 2) @ moved.R_to @ R_b_c.T
    reported = np.swapaxes(track.attitude(moved.from_s), 1, 2) @ track.attitude(moved.to_s)
    return Turns(seen, reported)
