"""Keypoints of a keyframe moved to where the image shows what their anchors looked like first.

ORB finds corners on whole pixels of its pyramid, a third of a pixel off at the finest level and one at the coarsest.
What an anchor's patch looked like in the earliest keyframe that sees it is found again to a twentieth of a pixel
(`geometry/patches.py`), so that parallax tells depths several times better.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.patches import find, patch_warps, templates
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FloatArray, IntArray

VIEWS = 30
"""Earlier keyframes that are asked for an anchor's first view, the most covisible ones."""
SIGMA_PX = 0.4
"""Standard deviation of an aligned keypoint beside white noise: surfaces that are not parallel to the image, lenses and
shutters; the noise alone leaves a twentieth of a pixel."""
_UNSURE_PX = 0.5
"""Standard deviation by what is left of a patch from which on a corner says more."""
_FARTHEST_PX = 1.5
"""How far corners move, in pixels of their octave: quantisation and noise, three sigmas."""
_LEVELS = 3
"""Of a pyramid of halves: the coarsest of ORB's octaves is 3.6 times smaller."""


def align(slam_map: SlamMap, keyframe: Keyframe, camera: Camera) -> int:
    """Align a keyframe's keypoints that have anchors with the anchors' earliest views; called under the map's lock.

    The earliest view stays as it is: any point of a patch is as good as another one.

    Args:
        slam_map: The map; depths and poses say how patches look from elsewhere.
        keyframe: ``features.uv`` and ``aligned_px`` are changed.
        camera: Of all keyframes.

    Returns:
        Number of keypoints that were aligned.
    """
    if keyframe.grey is None:
        return 0
    known = [k for k in slam_map.covisible(keyframe, VIEWS) if k.id < keyframe.id and k.grey is not None]
    waiting = keyframe.keypoints_with_anchor()
    uv, sigma = keyframe.features.uv.astype(np.float64), keyframe.aligned_px.copy()
    pyramid, growth = _pyramid(keyframe.grey), slam_map.scale_factor
    for view in sorted(known, key=lambda k: k.id):
        mine, theirs = _shared(keyframe, waiting, view)
        waiting = np.setdiff1d(waiting, mine, assume_unique=True)
        depth = se3.transform(view.T_c_w, slam_map.anchors.p_w[keyframe.anchor[mine]])[:, 2]
        mine, theirs, depth = mine[depth > 0], theirs[depth > 0], depth[depth > 0]
        if len(mine) == 0:
            continue
        found, sigma_px = _found(view, theirs, depth, keyframe, mine, pyramid, camera, growth)
        farthest = _FARTHEST_PX * growth ** keyframe.features.octave[mine]
        good = (sigma_px < _UNSURE_PX) & (np.abs(found - uv[mine]).max(1) < farthest)
        uv[mine[good]] = found[good]
        sigma[mine[good]] = np.hypot(SIGMA_PX * growth ** keyframe.features.octave[mine[good]], sigma_px[good])
        held = theirs[good]
        view.aligned_px[held] = np.fmin(view.aligned_px[held], SIGMA_PX * growth ** view.features.octave[held])
    keyframe.features.uv[:] = uv  # in place: optical flow follows these very pixels
    keyframe.aligned_px[:] = sigma
    return int(np.isfinite(sigma).sum())


def _shared(keyframe: Keyframe, keypoint: IntArray, view: Keyframe) -> tuple[IntArray, IntArray]:
    """Of some keypoints those whose anchors another keyframe sees, and its keypoints."""
    theirs = view.keypoints_with_anchor()
    order = theirs[np.argsort(view.anchor[theirs], kind="stable")]
    at = np.searchsorted(view.anchor[order], keyframe.anchor[keypoint])
    same = at < len(order)
    same[same] = view.anchor[order[at[same]]] == keyframe.anchor[keypoint[same]]
    return keypoint[same], order[at[same]]


def _found(
    view: Keyframe,
    theirs: IntArray,
    depth: FloatArray,
    keyframe: Keyframe,
    mine: IntArray,
    pyramid: list[NDArray[np.uint8]],
    camera: Camera,
    growth: float,
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(M, 2)`` of a keyframe that show what a view shows at its keypoints, and their sigmas ``(M,)`` [px]."""
    assert view.grey is not None
    uv_from = view.features.uv[theirs].astype(np.float64)
    warps = patch_warps(uv_from, depth, keyframe.T_c_w @ view.T_w_c, camera)
    level = np.rint(np.log2(growth) * view.features.octave[theirs]).astype(np.int64).clip(0, _LEVELS - 1)
    from_pyramid = _pyramid(view.grey)
    uv = keyframe.features.uv[mine].astype(np.float64)
    sigma = np.full(len(mine), np.inf)
    for i in np.unique(level):
        on, half = level == i, 2.0**i
        patches = templates(from_pyramid[i], uv_from[on] / half, warps[on])
        found = find(pyramid[i], uv[on] / half, patches)
        uv[on], sigma[on] = half * found.uv, half * found.sigma_px
    return uv, sigma


def _pyramid(grey: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Halves of an image: pixel ``i`` of one level is pixel ``2 i`` of the one before."""
    levels = [grey]
    for _ in range(_LEVELS - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    return levels
