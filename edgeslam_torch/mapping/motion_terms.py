"""Motion factors of a window from what telemetry says of its keyframes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.acceleration_prior import inertia
from edgeslam_torch.fusion.displacement import TelemetryModel
from edgeslam_torch.fusion.heading import headings
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.optim.problem import CentreFactor, GravityFactor, HeadingFactor

EFFECTIVE_SAMPLES = 120.0
"""Keypoints err together: a window's thousands of reprojections, taken for independent, hold a wrong scale against
telemetry whose covariance is honest. So many of them count as one in flight, four times as many as for corners
on whole pixels, since they are aligned to a fifth of one (docs/decisions/15-telemetry-in-windows.md)."""
ATTITUDE = 0.25
"""Share of that for attitude, if it is more than one: its errors, of leaning and of the mount, do not average."""
ALIKE_AT_THE_END = 1.0
"""The same in the last refinement: what drifted was taken back in flight, and telemetry's own errors, which have
a memory of seconds, would bend the map."""
GUESSED = 3000.0
"""The same for gravity in a young map while nothing has told metres: what turns and what moves is told apart by guessed
depths, which err together in all of the picture."""


@dataclass(frozen=True, slots=True)
class MotionFactors:
    """What telemetry adds to a window."""

    centres: tuple[CentreFactor, ...] = ()
    gravity: tuple[GravityFactor, ...] = ()
    headings: tuple[HeadingFactor, ...] = ()


def motion_factors(
    model: TelemetryModel | None,
    keyframes: Sequence[Keyframe],
    piece: Sequence[int],
    scale_sigma_log: float | None = None,
    effective_samples: float = EFFECTIVE_SAMPLES,
) -> MotionFactors:
    """Factors between keyframes that follow each other in time, piece by piece.

    Args:
        model: Telemetry and what ties it to the map; None where it is silent.
        keyframes: Of the window, in the order of its poses.
        piece: Number of each one's piece of map: where one lies relative to another is not known.
        scale_sigma_log: How far the scale may be off, common to all; the model's own doubt when None.
        effective_samples: How many keypoints count as one beside it.
    """
    if model is None:
        return MotionFactors()
    centres, gravity, turned = [], [], []
    for number in sorted(set(piece)):
        # Keyframes of earlier flights have no time on this one's clock.
        members = [i for i, p in enumerate(piece) if p == number and np.isfinite(keyframes[i].stamp_s)]
        if not members:
            continue
        order = np.array(sorted(members, key=lambda i: keyframes[i].stamp_s), dtype=np.int64)
        stamps = np.array([keyframes[i].stamp_s for i in order])
        told = model.positions(stamps, np.stack([keyframes[i].centre_w for i in order]), scale_sigma_log)
        if told is not None:
            centres.append(
                CentreFactor(
                    order,
                    effective_samples * told.information,
                    effective_samples * told.vector,
                    effective_samples * told.constant,
                )
            )
        inert = inertia(stamps, model.scale) if model.knows_metres else None
        if inert is not None:
            centres.append(CentreFactor(order, effective_samples * inert, np.zeros(len(inert)), 0.0))
        up, attitude = model.up(stamps), max(1.0, ATTITUDE * effective_samples)
        if up is not None:
            share = GUESSED if model.holds_level else attitude
            gravity.append(GravityFactor(order[up.frame], up.up_c, up.up_m, up.sigma_rad / math.sqrt(share)))
        told_yaw = headings(model, stamps)
        if told_yaw is not None:
            poses = order[told_yaw.frame]
            turned.append(HeadingFactor(poses, told_yaw.R_c_m, told_yaw.up_m, attitude * told_yaw.information))
    return MotionFactors(tuple(centres), tuple(gravity), tuple(turned))
