"""Sub-pixel alignment of patches between two images.

Forward shifts of templates with the Gauss-Newton step of the inverse compositional algorithm (Baker and Matthews, IJCV
2004, eq. 35, for translations): the gradient is the template's, so that a step samples the image once. A template is
warped to the other camera, assuming a surface parallel to the image that it comes from.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray

HALF_PX = 4
"""Half the side of a patch: 9 pixels, the size of a corner with its surroundings."""
STEPS = 8
UNLIKE = 0.5
"""Residual relative to a patch's contrast above which the patch shows something else."""
_DONE_PX = 0.01
_LONGEST_PX = 1.0
"""Maximum length of a step, the range of validity of the gradients."""
SIDE_PX = 2 * HALF_PX + 3
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


@compiled("u1[:,::1], f8[:,::1], f8[:,:,::1]")
def templates(image: NDArray[np.uint8], uv: FloatArray, warps: FloatArray) -> FloatArray:
    """Grey values ``(N, S, S)`` float32 around points of an image, warped to another camera; the border is replicated.

    Args:
        image: Grey ``(H, W)``.
        uv: Pixels ``(N, 2)``.
        warps: ``(N, 2, 2)`` from `patch_warps`; where one is not finite, so is its template.
    """
    height, width = image.shape
    patches = np.full((len(uv), SIDE_PX, SIDE_PX), np.nan, np.float32)
    for n in range(len(uv)):
        A = warps[n]
        if not np.isfinite(A[0, 0] + A[0, 1] + A[1, 0] + A[1, 1]):
            continue
        for i in range(SIDE_PX):
            for j in range(SIDE_PX):
                x, y = j - HALF_PX - 1.0, i - HALF_PX - 1.0
                u = min(max(uv[n, 0] + A[0, 0] * x + A[0, 1] * y, 0.0), width - 1.0)
                v = min(max(uv[n, 1] + A[1, 0] * x + A[1, 1] * y, 0.0), height - 1.0)
                left, top = int(u), int(v)
                right, below = min(left + 1, width - 1), min(top + 1, height - 1)
                a, b = u - left, v - top
                above = image[top, left] + a * (float(image[top, right]) - image[top, left])
                under = image[below, left] + a * (float(image[below, right]) - image[below, left])
                patches[n, i, j] = above + b * (under - above)
    return patches


def find(image: NDArray[np.uint8], uv: FloatArray, patches: FloatArray) -> Found:
    """Align patches with an image by translation, invariant to brightness.

    Args:
        image: Grey ``(H, W)``.
        uv: Initial pixels ``(N, 2)``, accurate to a pixel or two.
        patches: From `templates`.
    """
    there = np.array(uv, dtype=np.float64)
    return Found(there, _aligned(image, there, patches))


@compiled("u1[:,::1], f8[:,::1], f4[:,:,::1]")
def _aligned(image: NDArray[np.uint8], there: FloatArray, patches: FloatArray) -> FloatArray:
    """Moves the pixels ``there`` to their patches; returns the sigmas ``(N,)``."""
    side = 2 * HALF_PX + 1
    area = side * side
    height, width = image.shape
    sigma = np.full(len(there), np.inf)
    t, gx, gy, seen = np.zeros(area), np.zeros(area), np.zeros(area), np.zeros(area)
    for n in range(len(there)):
        P = patches[n]
        k = 0
        for i in range(1, side + 1):
            for j in range(1, side + 1):
                t[k] = P[i, j]
                gx[k] = 0.5 * (P[i, j + 1] - P[i, j - 1])
                gy[k] = 0.5 * (P[i + 1, j] - P[i - 1, j])
                k += 1
        for row in (t, gx, gy):
            row -= row.mean()
        a, b, c = (gx * gx).sum(), (gx * gy).sum(), (gy * gy).sum()
        det = a * c - b * b
        if not det > 1e-6 * (a + c) ** 2:  # also where the template is not finite
            continue
        rest = np.inf
        for _ in range(STEPS):
            # The whole patch has the same fraction of a pixel.
            u, v = math.floor(there[n, 0]), math.floor(there[n, 1])
            right, below = there[n, 0] - u, there[n, 1] - v
            k = 0
            for i in range(side):
                y = int(v) + i - HALF_PX
                top, bottom = min(max(y, 0), height - 1), min(max(y + 1, 0), height - 1)
                for j in range(side):
                    x = int(u) + j - HALF_PX
                    here, beside = min(max(x, 0), width - 1), min(max(x + 1, 0), width - 1)
                    one, two = float(image[top, here]), float(image[bottom, here])
                    one += right * (image[top, beside] - one)
                    two += right * (image[bottom, beside] - two)
                    seen[k] = one + below * (two - one)
                    k += 1
            mean = seen.mean()
            rest, p, q = 0.0, 0.0, 0.0
            for k in range(area):
                r = seen[k] - mean - t[k]
                rest += r * r
                p += gx[k] * r
                q += gy[k] * r
            du, dv = (b * q - c * p) / det, (b * p - a * q) / det
            length = math.hypot(du, dv)
            shorter = min(1.0, _LONGEST_PX / max(length, 1e-9))
            there[n, 0] += du * shorter
            there[n, 1] += dv * shorter
            if length <= _DONE_PX:
                break
        least = 0.5 * (a + c - math.sqrt(max((a + c) ** 2 - 4.0 * det, 0.0)))
        if rest < UNLIKE * (t * t).sum() and least > 0.0:
            sigma[n] = math.sqrt(rest / area / least)
    return sigma
