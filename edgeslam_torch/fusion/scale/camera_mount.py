"""How the camera sits on the drone, from a flight: the same displacements in camera and in body axes."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.scale.log_scale import fit_displacements
from edgeslam_torch.types import FloatArray

_PRIOR_RAD = math.radians(30.0)
_BIAS_M_S = 0.03
"""Standard deviations of the prior: how far the first guess may be off, and the bias of a velocity reading, a third of
its step of 0.1 m/s."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Rotation between camera and body."""

    R_b_c: FloatArray
    """``(3, 3)`` camera to body."""
    tilt_rad: float
    """Optical axis below the body's horizontal plane."""
    tilt_sigma_rad: float


def estimate_mount(
    moved_c: FloatArray,
    moved_b: FloatArray,
    duration_s: FloatArray,
    sigma_map: FloatArray,
    sigma_velocity_m_s: float,
    R_b_c: FloatArray,
) -> Mount | None:
    """Rotation that takes visual displacements in camera axes to telemetry's in body axes.

    Args:
        moved_c: Visual displacements ``(N, 3)`` in the axes of the camera at their start [map units].
        moved_b: Telemetry's displacements ``(N, 3)`` in the axes of the body at their start [m].
        duration_s: ``(N,)``.
        sigma_map: Noise of ``moved_c`` per axis ``(N,)``.
        sigma_velocity_m_s: Noise of one velocity reading.
        R_b_c: First guess, right to some 30 degrees.

    Returns:
        The mount, or ``None`` when the motion does not tell (less than 10 degrees of certainty).
    """
    sigma_m = sigma_velocity_m_s * np.sqrt(0.1 * duration_s)
    block = np.zeros(len(moved_c), dtype=np.int64)
    guess = moved_c @ R_b_c.T
    fit = fit_displacements(guess, moved_b, duration_s, sigma_map, sigma_m, block, _PRIOR_RAD, _BIAS_M_S, 1.0)
    if fit is None:
        return None
    R = fit.rotation @ R_b_c
    tilt = math.asin(max(-1.0, min(1.0, -float(R[2, 2]))))
    sigma = float(fit.rotation_sigma_rad[1])
    return Mount(R, tilt, sigma) if sigma < math.radians(10.0) else None
