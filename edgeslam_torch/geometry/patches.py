"""Sub-pixel alignment of patches between two images.

Forward shifts of templates with the Gauss-Newton step of the inverse compositional algorithm (Baker and Matthews, IJCV
2004, eq. 35, for translations): the gradient is the template's, so that a step samples the image once. A template is
warped to the other camera, assuming a surface parallel to the image that it comes from.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, IntArray

HALF_PX = 4
"""Half the side of a patch: 9 pixels, the size of a corner with its surroundings."""
STEPS = 8
UNLIKE = 0.5
"""Residual relative to a patch's contrast above which the patch shows something else."""
_DONE_PX = 0.01
_LONGEST_PX = 1.0
"""Maximum length of a step, the range of validity of the gradients."""
_OFFSETS = np.arange(-HALF_PX - 1, HALF_PX + 2, dtype=np.float32)
_X, _Y = (a.ravel() for a in np.meshgrid(_OFFSETS, _OFFSETS))
_INNER = np.maximum(np.abs(_X), np.abs(_Y)) <= HALF_PX
SIDE_PX = len(_OFFSETS)
"""Side of a template: a patch and the pixels around it, for its gradients."""


@dataclass(frozen=True, slots=True)
class Found:
    """Positions of patches in an image."""

    uv: FloatArray
    """``(N, 2)`` pixels of their centres."""
    sigma_px: FloatArray
    """``(N,)`` standard deviation along the worst direction if the residual were white noise; infinite for a patch
    without structure, and where the image shows something else."""


def patch_warps(uv: FloatArray, depth: FloatArray, T_to_from: FloatArray, camera: Camera) -> FloatArray:
    """Affine warps between two images around points, ``(N, 2, 2)``.

    Args:
        uv: Pixels ``(N, 2)`` of the points in the source image.
        depth: Their z-depths ``(N,)`` there, positive; the surface is assumed parallel to the image.
        T_to_from: ``(4, 4)`` from the source camera to the other one, in the unit of the depths; or one per point.
        camera: Intrinsics of both images.

    Returns:
        Source pixels per pixel of the other image; not finite where the point lies in the other camera's plane.

    Example:
        Half the distance doubles the size:

        >>> from edgeslam_torch.geometry.camera import PRESETS
        >>> forward = np.eye(4)
        >>> forward[2, 3] = -1.0
        >>> patch_warps(np.array([[320.0, 240.0]]), np.array([2.0]), forward, PRESETS["tum_fr1"])[0].round(3)
        array([[ 0.5, -0. ],
               [-0. ,  0.5]])
    """
    focal = np.array([camera.fx, camera.fy])
    p = np.column_stack([(uv - (camera.cx, camera.cy)) / focal, np.ones(len(uv))]) * depth[:, None]
    R = T_to_from[..., :3, :3]
    x, y, z = (np.einsum("...ij,...j->...i", R, p) + T_to_from[..., :3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = R[..., :2, :2] / z[:, None, None]
        slope = np.stack([x, y], axis=1)[:, :, None] * R[..., 2:, :2] / (z * z)[:, None, None]
        away = (ahead - slope) * focal[:, None] / focal * depth[:, None, None]
        det = away[:, 0, 0] * away[:, 1, 1] - away[:, 0, 1] * away[:, 1, 0]
        swapped = np.stack(
            [np.stack([away[:, 1, 1], -away[:, 0, 1]], 1), np.stack([-away[:, 1, 0], away[:, 0, 0]], 1)], axis=1
        )
        inverse: FloatArray = swapped / det[:, None, None]
    return inverse


def templates(image: NDArray[np.uint8], uv: FloatArray, warps: FloatArray) -> FloatArray:
    """Grey values ``(N, S, S)`` around points of an image, warped to another camera.

    Args:
        image: Grey ``(H, W)``.
        uv: Pixels ``(N, 2)``.
        warps: ``(N, 2, 2)`` from `patch_warps`.
    """
    x = uv[:, :1] + warps[:, 0, :1] * _X + warps[:, 0, 1:] * _Y
    y = uv[:, 1:] + warps[:, 1, :1] * _X + warps[:, 1, 1:] * _Y
    return _looked_up(image, x, y).reshape(len(uv), SIDE_PX, SIDE_PX)


def find(image: NDArray[np.uint8], uv: FloatArray, patches: FloatArray) -> Found:
    """Align patches with an image by translation, invariant to brightness.

    Args:
        image: Grey ``(H, W)``.
        uv: Initial pixels ``(N, 2)``, accurate to a pixel or two.
        patches: From `templates`.
    """
    t = _level(patches[:, 1:-1, 1:-1])
    gx, gy = (
        _level(0.5 * (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2])),
        _level(0.5 * (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1])),
    )
    a, b, c = (gx * gx).sum(1), (gx * gy).sum(1), (gy * gy).sum(1)
    det = a * c - b * b
    least = 0.5 * (a + c - np.sqrt(np.maximum((a + c) ** 2 - 4.0 * det, 0.0)))
    there = np.asarray(uv, dtype=np.float64).copy()
    rest = np.full(len(there), np.inf)
    going: IntArray = np.flatnonzero(np.isfinite(t).all(1) & (det > 1e-6 * (a + c) ** 2))
    for _ in range(STEPS):
        if len(going) == 0:
            break
        seen = _looked_up(image, there[going, :1] + _X[_INNER], there[going, 1:] + _Y[_INNER])
        r = _level(seen) - t[going]
        rest[going] = (r * r).mean(1)
        u, v = (gx[going] * r).sum(1), (gy[going] * r).sum(1)
        step = np.stack([b[going] * v - c[going] * u, b[going] * u - a[going] * v], axis=1) / det[going, None]
        length = np.linalg.norm(step, axis=1)
        there[going] += step * np.minimum(1.0, _LONGEST_PX / np.maximum(length, 1e-9))[:, None]
        going = going[length > _DONE_PX]
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt(rest / least)
    same = rest < UNLIKE * (t * t).mean(1)
    return Found(there, np.where(same & (least > 0.0), sigma, np.inf))


def _level(patches: FloatArray) -> FloatArray:
    """Patches as rows ``(N, P)`` without their mean."""
    rows = patches.reshape(len(patches), np.count_nonzero(_INNER))
    level: FloatArray = rows - rows.mean(1, keepdims=True)
    return level


def _looked_up(image: NDArray[np.uint8], x: FloatArray, y: FloatArray) -> FloatArray:
    """Interpolated grey values ``(N, P)`` float32; the border is replicated."""
    if len(x) == 0:  # OpenCV rejects empty arrays
        return np.zeros(x.shape, np.float32)
    grey = cv2.remap(
        image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return grey.astype(np.float32)
