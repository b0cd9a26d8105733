"""Sub-pixel alignment of a keyframe's keypoints with the first views of their anchors.

ORB finds corners on whole pixels of its pyramid, a third of a pixel off at the finest level and one at the coarsest.
What an anchor's patch looked like in the earliest keyframe that sees it is found again to a twentieth of a pixel
(`geometry/patches.py`), so that parallax determines depths several times better.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.patches import SIDE_PX, find, patch_warps, templates
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FloatArray, IntArray

VIEWS = 30
"""Number of earlier keyframes searched for first views, the most covisible ones."""
SIGMA_PX = 0.4
"""Standard deviation of an aligned keypoint beside white noise: surfaces that are not parallel to the image, lenses and
shutters; the noise alone leaves a twentieth of a pixel."""
_UNSURE_PX = 0.5
"""Maximum standard deviation by the residual of a patch; beyond it the detected corner is more accurate."""
_FARTHEST_PX = 1.5
"""How far corners move, in pixels of their octave: quantisation and noise, three sigmas."""
_LEVELS = 3
"""Of a pyramid of halves: the coarsest of ORB's octaves is 3.6 times smaller."""


@dataclass(frozen=True, slots=True)
class _Looks:
    """Patches of anchors in one view, warped to a keyframe."""

    view: Keyframe
    theirs: IntArray
    """``(M,)`` the view's keypoints."""
    mine: IntArray
    """``(M,)`` the keyframe's."""
    level: IntArray
    """``(M,)`` of the pyramid of halves."""
    patches: FloatArray
    """``(M, S, S)``"""


def align(slam_map: SlamMap, keyframe: Keyframe, camera: Camera) -> int:
    """Align a keyframe's keypoints that have anchors with the anchors' earliest views; called under the map's lock.

    The earliest view defines the reference point of a patch.

    Args:
        slam_map: The map; depths and poses define the warp of patches.
        keyframe: ``features.uv`` and ``aligned_px`` are changed.
        camera: Of all keyframes.

    Returns:
        Number of keypoints that were aligned.
    """
    looks = [] if keyframe.grey is None else _first_looks(slam_map, keyframe, camera)
    if keyframe.grey is None or not looks:
        return 0
    mine = np.concatenate([look.mine for look in looks])
    octave_px = slam_map.scale_factor ** keyframe.features.octave[mine].astype(np.float64)
    before = keyframe.features.uv[mine].astype(np.float64)
    uv, sigma_px = _found(keyframe.grey, before, looks)
    good = (sigma_px < _UNSURE_PX) & (np.abs(uv - before).max(1) < _FARTHEST_PX * octave_px)
    keyframe.features.uv[mine[good]] = uv[good]  # in place: optical flow follows these very pixels
    keyframe.aligned_px[mine[good]] = np.hypot(SIGMA_PX * octave_px, sigma_px)[good]
    for look in looks:
        observed = look.theirs[np.isfinite(keyframe.aligned_px[look.mine])]
        limit = SIGMA_PX * slam_map.scale_factor ** look.view.features.octave[observed].astype(np.float64)
        look.view.aligned_px[observed] = np.fmin(look.view.aligned_px[observed], limit)
    return int(good.sum())


def _first_looks(slam_map: SlamMap, keyframe: Keyframe, camera: Camera) -> list[_Looks]:
    """Patches of a keyframe's anchors in their earliest views."""
    known = [k for k in slam_map.covisible(keyframe, VIEWS) if k.id < keyframe.id and k.grey is not None]
    known.sort(key=lambda k: k.id)
    mine, first, theirs = _first_seen(keyframe, known, len(slam_map.anchors.alive))
    if len(mine) == 0:
        return []
    T_c_w = np.stack([k.T_c_w for k in known])
    p_w = slam_map.anchors.p_w[keyframe.anchor[mine]]
    depth = np.einsum("ij,ij->i", T_c_w[first, 2, :3], p_w) + T_c_w[first, 2, 3]
    front = depth > 0
    mine, first, theirs, depth = mine[front], first[front], theirs[front], depth[front]
    uv = np.zeros((len(mine), 2))
    octave = np.zeros(len(mine))
    groups = [np.flatnonzero(first == i) for i in range(len(known))]
    for view, some in zip(known, groups, strict=True):
        uv[some], octave[some] = view.features.uv[theirs[some]], view.features.octave[theirs[some]]
    warps = patch_warps(uv, depth, (keyframe.T_c_w @ se3.inverse(T_c_w))[first], camera)
    level = np.rint(np.log2(slam_map.scale_factor) * octave).astype(np.int64).clip(0, _LEVELS - 1)
    return [
        _Looks(view, theirs[some], mine[some], level[some], _patches(view, uv[some], warps[some], level[some]))
        for view, some in zip(known, groups, strict=True)
        if len(some)
    ]


def _first_seen(keyframe: Keyframe, known: list[Keyframe], anchors: int) -> tuple[IntArray, IntArray, IntArray]:
    """A keyframe's keypoints ``(M,)`` whose anchors others see, which of ``known`` is the first, and its keypoints."""
    first, theirs = np.full(anchors, -1), np.zeros(anchors, dtype=np.int64)
    for i in reversed(range(len(known))):
        observed = known[i].keypoints_with_anchor()
        first[known[i].anchor[observed]], theirs[known[i].anchor[observed]] = i, observed
    mine = keyframe.keypoints_with_anchor()
    mine = mine[first[keyframe.anchor[mine]] >= 0]
    return mine, first[keyframe.anchor[mine]], theirs[keyframe.anchor[mine]]


def _patches(view: Keyframe, uv: FloatArray, warps: FloatArray, level: IntArray) -> FloatArray:
    """Patches ``(M, S, S)`` of a view around pixels, each on its level of the pyramid, as another view sees them."""
    assert view.grey is not None
    patches = np.zeros((len(uv), SIDE_PX, SIDE_PX), np.float32)
    for i, grey in enumerate(_pyramid(view.grey, int(level.max()) + 1)):
        on = np.flatnonzero(level == i)
        if len(on):
            patches[on] = templates(grey, uv[on] / 2.0**i, warps[on])
    return patches


def _found(grey: NDArray[np.uint8], uv: FloatArray, looks: list[_Looks]) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(N, 2)`` of an image where it shows patches, looked for around ``uv``; their sigmas ``(N,)`` [px]."""
    level = np.concatenate([look.level for look in looks])
    patches = np.concatenate([look.patches for look in looks])
    there, sigma = uv.copy(), np.full(len(uv), np.inf)
    for i, image in enumerate(_pyramid(grey, int(level.max()) + 1)):
        on, half = level == i, 2.0**i
        found = find(image, uv[on] / half, patches[on])
        there[on], sigma[on] = half * found.uv, half * found.sigma_px
    return there, sigma


def _pyramid(grey: NDArray[np.uint8], levels: int) -> list[NDArray[np.uint8]]:
    """Halves of an image: pixel ``i`` of one level is pixel ``2 i`` of the one before."""
    pyramid = [grey]
    for _ in range(levels - 1):
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), dtype=np.uint8))
    return pyramid
