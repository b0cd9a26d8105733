"""Which frames' poses rest on the map, told from what a run left: its status table, final poses and map points."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.eval.run_folder import is_keyframe
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray

GUESSED = "initialised"
"""Status of a frame that was posed against depths that nothing has confirmed yet."""
UNSEEN = frozenset({"predicted", "lost"})
"""Status of a frame whose pose does not rest on its own image."""

LEAST_POINTS = 30
"""Points of the delivered map that must lie in a frame's view for its pose to rest on that map."""
_SAMPLE = 10_000
"""Map points that are looked for, drawn with a fixed seed."""
_NEAREST_SHARE = 1e-3
"""Points nearer than this share of the map's median distance are not in view."""

Status = Sequence[dict[str, str]]


def live(rows: Status) -> NDArray[np.bool_]:
    """Frames ``(F,)`` whose pose rested on a map when they came: neither predicted nor against guessed depths."""
    return np.array([_status(row) not in UNSEEN | {GUESSED} for row in rows], dtype=bool)


def at_end(rows: Status, T_w_c: FloatArray, p_w: FloatArray, camera: Camera) -> NDArray[np.bool_]:
    """Frames ``(F,)`` whose final pose rests on the delivered map.

    Those of `live`, and those of the attempt that started the map, which are posed again against it; and of these
    only the frames in whose view at least `LEAST_POINTS` points of the map lie.

    Args:
        rows: Of ``status.csv``, one a frame.
        T_w_c: ``(F, 4, 4)`` final poses.
        p_w: ``(P, 3)`` delivered points, anchors and edges together.
        camera: Of the run; its lens distortion is neglected.
    """
    return (live(rows) | _posed_again(rows)) & (points_in_view(T_w_c, p_w, camera) >= LEAST_POINTS)


def pieces(rows: Status) -> int:
    """Times that a map was started: runs of guessed frames with a tracked one after them, or tracked from frame 0."""
    guessed = np.array([_status(row) == GUESSED for row in rows], dtype=bool)
    on_map = live(rows)
    if len(rows) == 0 or not on_map.any():
        return 0
    return max(1, int(np.sum(guessed[:-1] & on_map[1:])))


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


def _posed_again(rows: Status) -> NDArray[np.bool_]:
    """Guessed frames from the reference keyframe of an attempt that came through to the frame that ended it."""
    out = np.zeros(len(rows), dtype=bool)
    on_map = live(rows)
    reference = 0
    for i, row in enumerate(rows):
        if _status(row) != GUESSED or not is_keyframe(row):
            continue
        if i + 1 < len(rows) and on_map[i + 1]:
            out[reference : i + 1] = True
        reference = i
    return out & np.array([_status(row) == GUESSED for row in rows], dtype=bool)


def _status(row: dict[str, str]) -> str:
    return row.get("status", "")
