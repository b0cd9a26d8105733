"""Keypoints of a keyframe moved to where the image shows what their anchors looked like first.

ORB finds corners on whole pixels of its pyramid, a third of a pixel off at the finest level and one at the coarsest.
What an anchor's patch looked like in the earliest keyframe that sees it is found again to a twentieth of a pixel
(`geometry/patches.py`), so that parallax tells depths several times better.
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


@dataclass(frozen=True, slots=True)
class _Looks:
    """What one view shows of some anchors, as a keyframe would see it."""

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

    The earliest view stays as it is: any point of a patch is as good as another one.

    Args:
        slam_map: The map; depths and poses say how patches look from elsewhere.
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
        held = look.theirs[np.isfinite(keyframe.aligned_px[look.mine])]
        limit = SIGMA_PX * slam_map.scale_factor ** look.view.features.octave[held].astype(np.float64)
        look.view.aligned_px[held] = np.fmin(look.view.aligned_px[held], limit)
    return int(good.sum())


def _first_looks(slam_map: SlamMap, keyframe: Keyframe, camera: Camera) -> list[_Looks]:
    """What the earliest views of a keyframe's anchors show of them."""
    known = [k for k in slam_map.covisible(keyframe, VIEWS) if k.id < keyframe.id and k.grey is not None]
    waiting = keyframe.keypoints_with_anchor()
    looks = []
    for view in sorted(known, key=lambda k: k.id):
        mine, theirs = _shared(keyframe, waiting, view)
        waiting = np.setdiff1d(waiting, mine, assume_unique=True)
        depth = se3.transform(view.T_c_w, slam_map.anchors.p_w[keyframe.anchor[mine]])[:, 2]
        front = depth > 0
        if front.any():
            looks.append(_look(view, theirs[front], depth[front], keyframe, mine[front], camera, slam_map.scale_factor))
    return looks


def _shared(keyframe: Keyframe, keypoint: IntArray, view: Keyframe) -> tuple[IntArray, IntArray]:
    """Of some keypoints those whose anchors another keyframe sees, and its keypoints."""
    theirs = view.keypoints_with_anchor()
    order = theirs[np.argsort(view.anchor[theirs], kind="stable")]
    at = np.searchsorted(view.anchor[order], keyframe.anchor[keypoint])
    same = at < len(order)
    same[same] = view.anchor[order[at[same]]] == keyframe.anchor[keypoint[same]]
    return keypoint[same], order[at[same]]


def _look(
    view: Keyframe,
    theirs: IntArray,
    depth: FloatArray,
    keyframe: Keyframe,
    mine: IntArray,
    camera: Camera,
    scale_factor: float,
) -> _Looks:
    """Patches of a view around its keypoints at z-depths ``(M,)``, as a keyframe would see them."""
    assert view.grey is not None
    uv = view.features.uv[theirs].astype(np.float64)
    warps = patch_warps(uv, depth, keyframe.T_c_w @ view.T_w_c, camera)
    level = np.rint(np.log2(scale_factor) * view.features.octave[theirs]).astype(np.int64).clip(0, _LEVELS - 1)
    patches = np.zeros((len(mine), SIDE_PX, SIDE_PX), np.float32)
    for i, grey in enumerate(_pyramid(view.grey, int(level.max()) + 1)):
        on = level == i
        patches[on] = templates(grey, uv[on] / 2.0**i, warps[on])
    return _Looks(view, theirs, mine, level, patches)


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
