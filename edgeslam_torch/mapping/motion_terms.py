"""Motion factors of a window from telemetry at its keyframes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.acceleration_prior import inertia
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.noise import ATTITUDE_RAD, ATTITUDE_STEP_RAD, CONTRADICTS, READING_S
from edgeslam_torch.optim.problem import CentreFactor, GravityFactor, HeadingFactor
from edgeslam_torch.types import FloatArray

EFFECTIVE_SAMPLES = 120.0
"""Number of correlated reprojections that count as one in flight. Keypoint errors are correlated: thousands of
reprojections treated as independent outweigh telemetry with a realistic covariance. The number is four times that of
corners at whole pixels, since corners are aligned to a fifth of a pixel (docs/decisions/15-telemetry-in-windows.md)."""
ATTITUDE = 0.25
"""Factor on this number for attitude, at least one in total: errors of tilt and camera mount are systematic."""
EFFECTIVE_SAMPLES_AT_THE_END = 1.0
"""The same in the last refinement: drift was corrected in flight, and telemetry errors, correlated over seconds, would
deform the map."""
GUESSED = 300.0
"""The same for gravity before the metric scale is known: predicted depths, whose errors are correlated over the whole
image, distinguish rotation from translation (docs/decisions/05-first-frame.md)."""
GUESSED_IMAGE = 3000.0
"""The same for a single image: more than it has, since it does not measure tilt. A window of several views does, and
this weight would bend it where the attitude is wrong."""


@dataclass(frozen=True, slots=True)
class MotionFactors:
    """Telemetry factors of a window."""

    centres: tuple[CentreFactor, ...] = ()
    gravity: tuple[GravityFactor, ...] = ()
    headings: tuple[HeadingFactor, ...] = ()


@dataclass(frozen=True, slots=True)
class Vertical:
    """The vertical in one frame by one attitude of the drone, in a world in which it is right in a keyframe."""

    up_c: FloatArray
    """``(3,)`` unit vector, camera axes."""
    up_w: FloatArray
    """``(3,)`` the same in the world."""
    sigma_rad: float
    """Standard deviation per axis of a single attitude."""
    held: bool = False
    """Whether the frame rests on guesses whatever the image shows: the map is new and has no metric scale."""
    systematic_rad: float = 0.0
    """The same by the camera's mount, whose error turns with the drone, and by what the drone leaned between two
    readings: no pixel of the image reduces it."""

    def contradicts(self, T_c_w: FloatArray) -> bool:
        """Whether it contradicts the tilt of a tracked pose ``(4, 4)``: on wrong depths a climb looks like a pitch."""
        sigma_rad = math.hypot(math.sqrt(2.0) * ATTITUDE_RAD, self.systematic_rad)
        return float(np.linalg.norm(np.cross(T_c_w[:3, :3] @ self.up_w, self.up_c))) > CONTRADICTS * sigma_rad

    def sigma(self, samples: float) -> float:
        """Standard deviation per axis [rad], if this number of correlated reprojections counts as one."""
        return math.hypot(self.sigma_rad / math.sqrt(samples), self.systematic_rad)


def vertical_since(model: TelemetryModel | None, reference: Keyframe, stamp_s: float) -> Vertical | None:
    """The vertical in a frame, in the world of a keyframe; None without attitude."""
    if model is None or len(model.track) == 0 or model.track.readings.stamp_s[0] > reference.stamp_s:
        return None
    # The picture is older than it arrives: the first ones are older than the first message.
    stamps_s = np.maximum([reference.stamp_s, stamp_s], model.track.readings.stamp_s[0] + model.delay_s)
    up = model.up(stamps_s)
    if up is None or len(up.frame) < 2:
        return None
    at_s = stamps_s - model.delay_s
    turned = float(np.diff(model.track.yaw(at_s))[0])
    mount_rad = 2.0 * abs(math.sin(0.5 * turned)) * model.mount_sigma_rad
    # An attitude that is not validated holds every frame: where it is wrong, the images contradict it the sooner.
    between_rad = np.maximum(model.track.leaned(at_s, READING_S) - ATTITUDE_STEP_RAD, 0.0) * model.turns
    systematic_rad = math.hypot(mount_rad, *between_rad)
    return Vertical(up.up_c[1], reference.T_w_c[:3, :3] @ up.up_c[0], up.sigma_rad, model.holds_level, systematic_rad)


def motion_factors(
    model: TelemetryModel | None,
    keyframes: Sequence[Keyframe],
    piece: Sequence[int],
    scale_sigma_log: float | None = None,
    effective_samples: float = EFFECTIVE_SAMPLES,
) -> MotionFactors:
    """Factors between temporally consecutive keyframes of each submap.

    Args:
        model: Telemetry and its relation to the map; None without telemetry.
        keyframes: Of the window, in the order of its poses.
        piece: Submap number of each keyframe; the relative pose of submaps is unknown.
        scale_sigma_log: Standard deviation of the common log scale; None for the model's own.
        effective_samples: Number of correlated reprojections that count as one.
    """
    if model is None:
        return MotionFactors()
    centres, gravity, turned = [], [], []
    for number in sorted(set(piece)):
        # Stamps of keyframes from a loaded map are not on this run's clock.
        members = [i for i, p in enumerate(piece) if p == number and np.isfinite(keyframes[i].stamp_s)]
        if not members:
            continue
        order = np.array(sorted(members, key=lambda i: keyframes[i].stamp_s), dtype=np.int64)
        stamps = np.array([keyframes[i].stamp_s for i in order])
        guessed = np.array([keyframes[i].tracked is not None for i in order])
        guessed |= model.leaning(stamps, np.stack([keyframes[i].T_c_w[:3, :3] for i in order]))
        reported = model.positions(stamps, np.stack([keyframes[i].centre_w for i in order]), scale_sigma_log, guessed)
        if reported is not None:
            centres.append(
                CentreFactor(
                    order,
                    effective_samples * reported.information,
                    effective_samples * reported.vector,
                    effective_samples * reported.constant,
                )
            )
        inert = inertia(stamps, model.scale) if model.metric else None
        if inert is not None:
            centres.append(CentreFactor(order, effective_samples * inert, np.zeros(len(inert)), 0.0))
        up, attitude = model.up(stamps), max(1.0, ATTITUDE * effective_samples)
        if up is not None:
            known = max(up.sigma_rad / math.sqrt(attitude), ATTITUDE_RAD)
            sigma_rad = up.sigma_rad / math.sqrt(GUESSED) if model.holds_level else known
            gravity.append(GravityFactor(order[up.frame], up.up_c, up.up_m, sigma_rad))
        heading = model.headings(stamps)
        if heading is not None and heading.passes(np.stack([keyframes[i].T_c_w[:3, :3] for i in order[heading.frame]])):
            poses = order[heading.frame]
            turned.append(HeadingFactor(poses, heading.R_c_m, heading.up_m, attitude * heading.information))
    return MotionFactors(tuple(centres), tuple(gravity), tuple(turned))
