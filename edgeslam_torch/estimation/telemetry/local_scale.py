"""Metres per map unit around one time of the flight, from the seconds before and after it.

The scale of a whole flight (`estimation/telemetry_scale.py`) is that of the present map. A monocular map drifts in
scale, so that two places in it may differ; local velocities measure the difference.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.scale.evidence import displacement_evidence
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements
from edgeslam_torch.noise import VELOCITY_M_S
from edgeslam_torch.types import FloatArray, ScaleEstimate

AROUND_S = 5.0
"""Time before and after the moment: four metres each at an indoor drone's speed."""
MOST_SIGMA = 0.15
"""Maximum relative standard deviation of a local scale."""
LEAST_SIGMA = 0.03
"""Lower bound of the standard deviation: drift within the window."""
_SIGMAS, _SAID_LOG = 3.0, math.log(1.15)
"""Minimum significance and size of a reported difference: above the effect of quantised velocities and map
distortion."""


def scale_of(
    moved: Displacements,
    track: TelemetryTrack,
    delay_s: float,
    R_w_m: FloatArray,
    T_b_c: FloatArray,
    config: FusionConfig,
    shortfall_m_s: float = 0.0,
) -> ScaleEstimate | None:
    """Metres per map unit along some displacements; None where velocities do not determine it.

    Args:
        moved: Visual displacements, by the stamps of frames.
        track: Telemetry of the flight.
        delay_s: Video delay behind telemetry.
        R_w_m: Map axes to telemetry's world ``(3, 3)``.
        T_b_c: Camera to body ``(4, 4)`` [m].
        config: Noise of velocities, and the minimum speed.
        shortfall_m_s: Expected truncation loss of every non-zero velocity.
    """
    moved = moved.on_telemetry_clock(delay_s)
    moved = moved.only(track.covered(moved.from_s, moved.to_s))
    if not len(moved):
        return None
    turned = track.attitude(moved.to_s) - track.attitude(moved.from_s)
    reported = track.displacement(moved.to_s, shortfall_m_s) - track.displacement(moved.from_s, shortfall_m_s)
    reported += turned @ T_b_c[:3, 3]
    moving = np.linalg.norm(reported, axis=1) > config.min_speed_m_s * moved.duration_s
    moved, reported = moved.only(moving), reported[moving]
    sigma_m = VELOCITY_M_S * np.sqrt(0.1 * moved.duration_s)
    tilt = config.alignment_sigma_rad
    evidence = displacement_evidence(
        moved.moved @ R_w_m.T, reported, moved.from_s, moved.duration_s, moved.sigma, sigma_m, tilt
    )
    found = None if evidence is None else evidence.belief("telemetry", tilt, 0.0)
    if found is None or found.sigma > MOST_SIGMA:
        return None
    return replace(found, sigma=max(found.sigma, LEAST_SIGMA)).estimate


def drift_in_words(scale_at: Callable[[float], ScaleEstimate | None], from_s: float, to_s: float) -> str | None:
    """Warning that an earlier part of the map differs significantly in scale from the present one; None otherwise.

    Args:
        scale_at: Metres per map unit around a moment.
        from_s: Oldest stored moment.
        to_s: The present.
    """
    now = scale_at(to_s - AROUND_S)
    if now is None:
        return None
    most, said = _SAID_LOG, None
    for moment_s in np.arange(from_s + AROUND_S, to_s - 3.0 * AROUND_S, 2.0 * AROUND_S).tolist():
        then = scale_at(moment_s)
        if then is None:
            continue
        gap = abs(math.log(now.value / then.value))
        if gap > most and gap > _SIGMAS * math.hypot(now.sigma / now.value, then.sigma / then.value):
            most = gap
            said = (
                f"the map's scale has drifted: by telemetry {then.value:.3g} metres per map unit "
                f"{to_s - moment_s:.0f} s ago and {now.value:.3g} now; distances there are off by "
                f"{100 * math.expm1(gap):.0f} %"
            )
    return said
