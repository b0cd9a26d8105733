"""Dense depth of one posed image from its neighbours: a plane sweep and semi-global aggregation.

Every hypothesis is a plane parallel to the image, so a neighbour is warped by a homography for any motion, including
forward motion, without rectification (Collins, CVPR 1996). Ambiguities of textureless surfaces are resolved by
semi-global matching (Hirschmueller, PAMI 2008), four paths.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray

WINDOW = 5
"""Side [px] of the windows that are compared."""
NOISE = 4.0
"""Variance of grey values [levels^2] below which a window is textureless: its correlation tends to 0."""
BEST = 0.5
"""Share of the best neighbours that counts: the others may be occluded."""
STEP_COST, JUMP_COST = 0.06, 0.5
"""Of neighbouring pixels one plane apart and farther apart; correlations cost 0 to 1."""
CONTRAST = 8.0
"""Grey levels between neighbours that halve the cost of a jump."""
_OUTSIDE = -1000.0


def sweep_depth(
    reference: FloatArray,
    neighbours: Sequence[FloatArray],
    motions: Sequence[FloatArray],
    K: FloatArray,
    inverse_depths: FloatArray,
) -> FloatArray:
    """Depth ``(H, W)`` float32 of every pixel, unverified: the caller drops pixels that other views do not confirm.

    Args:
        reference: Grey image ``(H, W)`` float32, undistorted.
        neighbours: Grey images of the same size and camera.
        motions: ``T_j_i (4, 4)`` from the reference to each neighbour.
        K: Intrinsics ``(3, 3)`` [px].
        inverse_depths: Of the planes ``(D,)``, evenly spaced, in the motions' inverse unit.
    """
    # One minus the correlation of windows, (D, H, W) in [0, 1], mean of the best neighbours.
    height, width = reference.shape
    mean, spread = _statistics(reference)
    K_inverse, normal = np.linalg.inv(K), np.array([[0.0, 0.0, 1.0]])
    used = max(1, int(np.ceil(BEST * len(neighbours))))
    cost = np.empty((len(inverse_depths), height, width), np.float32)
    costs = np.empty((len(neighbours), height, width), np.float32)
    for d, inverse in enumerate(inverse_depths):
        for k, (image, T) in enumerate(zip(neighbours, motions, strict=True)):
            H = K @ (T[:3, :3] + inverse * T[:3, 3:] @ normal) @ K_inverse
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            seen = np.asarray(
                cv2.warpPerspective(image, H, (width, height), flags=flags, borderValue=_OUTSIDE), np.float32
            )
            seen_mean, seen_spread = _statistics(seen)
            together = cv2.blur(reference * seen, (WINDOW, WINDOW)) - mean * seen_mean
            costs[k] = np.clip(1.0 - together / (spread * seen_spread), 0.0, 1.0)
            # A window that reaches outside has a negative mean.
            costs[k][seen_mean < 0] = 1.0
        cost[d] = np.partition(costs, used - 1, axis=0)[:used].mean(0)
    return 1.0 / _between_planes(aggregate(cost, reference), inverse_depths)


def aggregate(cost: FloatArray, grey: FloatArray) -> FloatArray:
    """Costs of paths from four sides, ``(D, H, W)`` and the image ``(H, W)`` -> ``(H, W, D)``; depth jumps cost less at
    edges of the image."""
    rows = np.ascontiguousarray(cost.transpose(1, 2, 0))
    columns = np.ascontiguousarray(cost.transpose(2, 1, 0))
    total, total_columns = np.zeros_like(rows), np.zeros_like(columns)
    down, right = np.abs(np.diff(grey, axis=0)), np.abs(np.diff(grey, axis=1)).T
    for c, g, out in ((rows, down, total), (columns, right, total_columns)):
        _follow(c, g, out)
        _follow(c[::-1], g[::-1], out[::-1])
    return np.asarray(total + total_columns.transpose(1, 0, 2))


def _follow(cost: FloatArray, contrast: FloatArray, total: FloatArray) -> None:
    """Adds the costs of paths along the first axis to ``total``; all ``(N, M, D)``, ``contrast (N - 1, M)``."""
    path = cost[0].copy()
    total[0] += path
    jump = np.maximum(JUMP_COST / (1.0 + contrast / CONTRAST), 1.5 * STEP_COST)
    for n in range(1, len(cost)):
        path -= path.min(1, keepdims=True)
        best = np.minimum(path, jump[n - 1][:, None])
        stepped = path + STEP_COST
        np.minimum(best[:, 1:], stepped[:, :-1], out=best[:, 1:])
        np.minimum(best[:, :-1], stepped[:, 1:], out=best[:, :-1])
        path = cost[n] + best
        total[n] += path


def _between_planes(total: FloatArray, inverse: FloatArray) -> FloatArray:
    """Inverse depth ``(H, W)`` float32 of the smallest cost, by a parabola through it and the planes beside it."""
    best = total.argmin(2)[..., None]
    inner = np.clip(best, 1, len(inverse) - 2)
    before, at, after = (np.take_along_axis(total, inner + k, 2)[..., 0] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    fits = (bend > 1e-6) & (best == inner)[..., 0]
    offset = np.where(fits, 0.5 * (before - after) / np.maximum(bend, 1e-6), 0.0)
    found = inverse[best[..., 0]] + np.clip(offset, -1.0, 1.0) * (inverse[1] - inverse[0])
    return np.asarray(found, np.float32)


def _statistics(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    window = (WINDOW, WINDOW)
    mean = cv2.blur(image, window)
    variance = cv2.blur(image * image, window) - mean * mean
    return np.asarray(mean), np.sqrt(np.maximum(variance, 0.0) + NOISE)
