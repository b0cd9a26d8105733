"""Frames whose poses are supported by the map: according to the run, and with enough of the delivered map in view."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.eval.inputs.run_folder import is_supported
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, FrameStatus

MIN_POINTS = 30
"""Minimum number of points of the delivered map in view of a supported frame."""
_SAMPLE = 10_000
"""Maximum number of sampled map points."""
_NEAREST_SHARE = 1e-3
"""Points nearer than this share of the map's median distance are not in view."""

Status = Sequence[dict[str, str]]


def live(rows: Status) -> NDArray[np.bool_]:
    """Frames ``(F,)`` of ``status.csv`` whose live pose was supported by the map."""
    supported = {str(status) for status in FrameStatus if status.supported}
    return np.array([row.get("status") in supported for row in rows], dtype=bool)


def at_end(rows: Status, T_w_c: FloatArray, p_w: FloatArray, camera: Camera) -> NDArray[np.bool_]:
    """Frames ``(F,)`` stated as supported whose final pose ``(F, 4, 4)`` has `MIN_POINTS` of the delivered points
    ``(P, 3)`` in view; lens distortion is neglected."""
    said = np.array([is_supported(row) for row in rows], dtype=bool)
    return said & (points_in_view(T_w_c, p_w, camera) >= MIN_POINTS)


def points_in_view(T_w_c: FloatArray, p_w: FloatArray, camera: Camera) -> NDArray[np.int64]:
    """Points in front of each camera and inside its image, ``(F,)``; of a large map, of `_SAMPLE` of its points."""
    p = np.asarray(p_w, dtype=np.float64)
    if len(p) > _SAMPLE:
        p = p[np.random.default_rng(0).choice(len(p), _SAMPLE, replace=False)]
    seen = np.zeros(len(T_w_c), dtype=np.int64)
    if len(p) == 0:
        return seen
    for i, T_c_w in enumerate(se3.inverse(T_w_c)):
        p_c = se3.transform(T_c_w, p)
        p_c = p_c[p_c[:, 2] > _NEAREST_SHARE * np.median(np.abs(p_c[:, 2]))]
        uv = camera.project(p_c)
        seen[i] = int(np.sum(((uv >= -0.5) & (uv <= [camera.width - 0.5, camera.height - 0.5])).all(axis=1)))
    return seen
