"""Exact z-buffer rendering of a `World` with numpy and OpenCV.

On a plane, inverse depth is an affine function of the pixel and texture coordinates are a homography of it: depth
is exact at every pixel centre, and one look-up per visible quad and texture level draws its colour.
Borders are smoothed by five samples per pixel: its centre and, shared with its neighbours, its corners.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.world import MAX_LEVEL, Texture, World
from edgeslam_torch.synthetic.textures.image_ops import looked_up
from edgeslam_torch.types import FloatArray

NEAR_M = 0.02
BACKGROUND = 90
"""Grey level where nothing is hit."""


@dataclass(frozen=True, slots=True)
class _Polygon:
    """A quad clipped to the near plane and projected."""

    quad: int
    uv: list[list[float]]
    """Three to five corners [px]."""
    st_from_uv: FloatArray
    """``(3, 3)`` homography from pixels to texture coordinates in [0, 1]; third row times (u, v, 1) is 1/z."""
    det: float
    """Determinant of its inverse."""
    side_m: float
    """Distance of the camera from the plane."""
    iz_range: tuple[float, float]


class Rendered:
    """One view of a `World`; its picture is drawn when it is first asked for, which takes half of the time."""

    def __init__(self, world: World, camera: Camera, T_w_c: FloatArray, antialias: bool) -> None:
        self._world, self._antialias = world, antialias
        self._polygons = _project(world, camera, T_w_c)
        self._iz, self.quad_id, self._roi = _depth_pass(self._polygons, camera.width, camera.height, 0.0)
        """Inverse depth; ``(H, W)`` int16 index into ``world.quads``, -1 where nothing is hit; see `_depth_pass`."""

    @cached_property
    def depth_m(self) -> FloatArray:
        """``(H, W)`` float32 z-depth of the ray through each pixel centre [m]; 0 where nothing is hit."""
        with np.errstate(divide="ignore"):
            return np.where(self._iz > 0, np.float32(1.0) / self._iz, np.float32(0.0))

    @cached_property
    def image(self) -> np.ndarray:
        """``(H, W, 3)`` uint8 BGR."""
        image = np.full((*self._iz.shape, 3), BACKGROUND, np.uint8)
        seen = np.bincount(self.quad_id.ravel() + 1, minlength=len(self._world.quads) + 1)[1:] > 0
        for polygon, roi in zip(self._polygons, self._roi, strict=True):
            if seen[polygon.quad]:
                _draw(image, self._iz, self.quad_id, polygon, roi, self._world.quads[polygon.quad].texture)
        if self._antialias:
            _smooth_borders(image, self.quad_id, [p for p in self._polygons if seen[p.quad]])
        return image


def render(world: World, camera: Camera, T_w_c: FloatArray, *, antialias: bool = True) -> Rendered:
    """Image, exact depth and quad index of the view from a pose ``(4, 4)``; ``antialias`` smooths the borders of quads.

    Raises:
        ValueError: If the camera has distortion.
    """
    if camera.is_distorted:
        raise ValueError("simulated cameras have no distortion")
    return Rendered(world, camera, T_w_c, antialias)


def _project(world: World, camera: Camera, T_w_c: FloatArray) -> list[_Polygon]:
    """The quads that face the camera and reach into the image, nearest first."""
    T_c_w = se3.inverse(np.asarray(T_w_c, dtype=np.float64))
    side = np.einsum("qi,qi->q", world.normals_w, T_w_c[:3, 3] - world.corners_w[:, 0])
    corners = world.corners_w @ T_c_w[:3, :3].T + T_c_w[:3, 3]  # (Q, 4, 3)
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    # A quad is invisible when all its corners are beyond the same side of the viewing pyramid.
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    outside = [(x < left * z), (x > right * z), (y < top * z), (y > bottom * z), z < NEAR_M]
    seen = ~np.any([o.all(1) for o in outside], axis=0) & ((side > 1e-6) | (world.two_sided & (side < -1e-6)))
    index = np.flatnonzero(seen)
    if len(index) == 0:
        return []
    c = corners[index]
    frame = camera.K @ np.stack([c[:, 1] - c[:, 0], c[:, 3] - c[:, 0], c[:, 0]], axis=2)  # columns u, v, origin
    st_from_uv, det = np.linalg.inv(frame), np.abs(np.linalg.det(frame))
    polygons = []
    for row, quad in enumerate(index.tolist()):
        points = _clip(c[row].tolist())
        if len(points) < 3:
            continue
        uv = [[camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy] for p in points]
        izs = [1.0 / p[2] for p in points]
        polygons.append(_Polygon(quad, uv, st_from_uv[row], det[row], abs(side[quad]), (min(izs), max(izs))))
    polygons.sort(key=lambda p: -p.iz_range[1])
    return polygons


def _clip(points: list[list[float]]) -> list[list[float]]:
    """Part of a polygon in front of the near plane (Sutherland-Hodgman)."""
    out = []
    for a, b in zip(points, points[1:] + points[:1], strict=True):
        if a[2] >= NEAR_M:
            out.append(a)
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            t = (NEAR_M - a[2]) / (b[2] - a[2])
            out.append([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), NEAR_M])
    return out


def _depth_pass(
    polygons: list[_Polygon], width: int, height: int, offset: float
) -> tuple[FloatArray, np.ndarray, list[list[int]]]:
    """Inverse depth ``(height, width)`` float32, quad index int16, and x0, y0, x1, y1 of where polygons may be seen, at
    integer pixels plus ``offset``."""
    iz = np.zeros((height, width), np.float32)
    ids = np.full((height, width), -1, np.int16)
    top, low, high = _spans(polygons, width, height, offset)
    columns = np.arange(width, dtype=np.int32)
    planes = np.array([p.st_from_uv[2] for p in polygons]).reshape(-1, 3)
    planes[:, 2] += offset * (planes[:, 0] + planes[:, 1])
    rois = []
    for polygon, y0, first, last, (a, b, c) in zip(polygons, top, low, high, planes.tolist(), strict=True):
        x0, x1, y1 = int(first.min(initial=width)), int(last.max(initial=-1)) + 1, y0 + len(first)
        rois.append([x0, y0, x1, y1])
        if x0 >= x1:
            continue
        xs, ys = columns[x0:x1], np.arange(y0, y1)
        here = (a * xs).astype(np.float32) + (b * ys + c).astype(np.float32)[:, None]
        target = iz[y0:y1, x0:x1]
        nearer = here > target
        nearer &= xs >= first[:, None]
        nearer &= xs <= last[:, None]
        cv2.copyTo(here, nearer.view(np.uint8), target)
        np.copyto(ids[y0:y1, x0:x1], polygon.quad, where=nearer)
    return iz, ids, rois


def _spans(
    polygons: list[_Polygon], width: int, height: int, offset: float
) -> tuple[list[int], list[np.ndarray], list[np.ndarray]]:
    """Of each convex polygon the first row, and the first and last column on each of its rows."""
    count = len(polygons)
    uv = np.array([p.uv + [p.uv[-1]] * (5 - len(p.uv)) for p in polygons]).reshape(-1, 5, 2) - offset
    top = np.clip(np.ceil(uv[:, :, 1].min(1)), 0, height).astype(np.int64)
    rows = np.clip(np.floor(uv[:, :, 1].max(1)) + 1, top, height).astype(np.int64) - top
    end = np.cumsum(rows)
    owner = np.repeat(np.arange(count), rows)
    y = (np.arange(len(owner)) - (end - rows)[owner] + top[owner]).astype(np.float64)
    following = np.roll(uv, -1, axis=1)
    edge = following - uv
    area = np.sum(uv[..., 0] * following[..., 1] - uv[..., 1] * following[..., 0], axis=1)
    low, high = np.full(len(y), 0.0), np.full(len(y), width - 1.0)
    for k in range(5):
        dx, dy = edge[:, k, 0], edge[:, k, 1]
        slope = np.divide(dx, dy, out=np.zeros(count), where=dy != 0)
        cut = (y - uv[owner, k, 1]) * slope[owner] + uv[owner, k, 0]
        # With positive area the inside lies where dx (y - y0) - dy (x - x0) >= 0.
        inwards = (np.sign(area) * dy)[owner]
        np.maximum(low, cut, out=low, where=inwards < 0)
        np.minimum(high, cut, out=high, where=inwards > 0)
    first, last = (np.split(x.astype(np.int32), end[:-1]) for x in (np.ceil(low), np.floor(high)))
    return top.tolist(), first[:count], last[:count]


def _draw(
    image: np.ndarray, iz: FloatArray, ids: np.ndarray, polygon: _Polygon, roi: list[int], texture: Texture
) -> None:
    """Colour the pixels where this quad is the nearest."""
    x0, y0, x1, y1 = roi
    mine = (ids[y0:y1, x0:x1] == polygon.quad).view(np.uint8)
    bx, by, bw, bh = cv2.boundingRect(mine)
    mine = mine[by : by + bh, bx : bx + bw]
    x0, y0 = x0 + bx, y0 + by
    # One texel covers one pixel at level g - 3.5 log2(1/z): texels per pixel are det(st_from_uv) / iz^3 times the
    # texture's size. Half an octave more for each doubling of obliqueness, cos = plane distance times iz, keeps grazing
    # surfaces from flickering.
    texels = math.prod(texture.level(0).shape[:2])
    g = float(np.log2(texels / polygon.det) - 0.5 * np.log2(polygon.side_m))
    a, b, c = polygon.st_from_uv[2].tolist()
    at_corners = [a * x + b * y + c for x in (x0, x0 + bw - 1) for y in (y0, y0 + bh - 1)]
    near = min(max(at_corners), polygon.iz_range[1])
    far = max(min(at_corners), polygon.iz_range[0])
    first, last = (min(max(math.floor(g - 3.5 * math.log2(max(x, 1e-6)) + 0.5), 0), MAX_LEVEL) for x in (near, far))
    for k in range(first, last + 1):
        mask, left, top, w, h = mine, 0, 0, bw, bh
        if first != last:
            block = iz[y0 : y0 + bh, x0 : x0 + bw]
            mask = mine.copy()
            if k > first:
                mask &= block <= _iz_of_level(k - 0.5, g)
            if k < last:
                mask &= block > _iz_of_level(k + 0.5, g)
            left, top, w, h = cv2.boundingRect(mask)
            if w == 0:
                continue
            mask = mask[top : top + h, left : left + w]
        level = texture.level(k)
        rows, columns = level.shape[:2]
        texture_from_st = np.array([[columns, 0.0, -0.5], [0.0, rows, -0.5], [0.0, 0.0, 1.0]])  # centres at integers
        drawn = looked_up(level, *_mapped(texture_from_st @ polygon.st_from_uv, x0 + left, y0 + top, w, h))
        cv2.copyTo(drawn, mask, image[y0 + top : y0 + top + h, x0 + left : x0 + left + w])


def _mapped(H: FloatArray, x0: int, y0: int, width: int, height: int) -> tuple[FloatArray, FloatArray]:
    """Where a homography ``(3, 3)`` takes the pixels of a rectangle, x and y ``(height, width)``."""
    x, y = np.arange(x0, x0 + width, dtype=np.float64), np.arange(y0, y0 + height, dtype=np.float64)[:, None]
    u, v, w = (row[0] * x + (row[1] * y + row[2]) for row in H)
    per_w = 1.0 / w
    return u * per_w, v * per_w


def _iz_of_level(level: float, g: float) -> np.float32:
    return np.float32(2.0 ** ((g - level) / 3.5))


def _smooth_borders(image: np.ndarray, ids: np.ndarray, polygons: list[_Polygon]) -> None:
    """Blend pixels whose corners show another quad than their centre: half centre, an eighth each corner.

    A corner takes its colour from the pixels around it whose centre shows the same quad.
    """
    height, width = ids.shape
    _, ids_corner, _ = _depth_pass(polygons, width + 1, height + 1, -0.5)
    mixed = ids_corner[:-1, :-1] != ids
    for corner in (ids_corner[:-1, 1:], ids_corner[1:, :-1], ids_corner[1:, 1:]):
        mixed |= corner != ids
    pixel = np.flatnonzero(mixed)
    if len(pixel) == 0:
        return
    row, column = np.divmod(pixel, width)
    # Corner (i, j) lies between pixels (i-1, j-1) and (i, j): in an image one pixel wider all round,
    # (i, j) to (i+1, j+1).
    first = row * (width + 1) + column
    corners_of_pixel = [first, first + 1, first + width + 1, first + width + 2]
    touched = np.zeros((height + 1) * (width + 1), bool)
    for index in corners_of_pixel:
        touched[index] = True
    sample = np.flatnonzero(touched)
    wide = width + 2
    around = sample + sample // (width + 1)
    target = ids_corner.ravel()[sample]
    padded_ids = cv2.copyMakeBorder(ids, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-2).ravel()
    padded = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    # The fourth channel counts: one gather gives colour and weight.
    padded = cv2.merge([*cv2.split(padded), np.full(padded.shape[:2], 1, np.uint8)]).reshape(-1, 4)
    total = np.zeros((len(sample), 4), np.uint16)
    for step in (0, 1, wide, wide + 1):
        same = padded_ids[around + step] == target
        total += padded[around + step] * same[:, None].view(np.uint8)
    weight = total[:, 3:]
    colour = (total[:, :3].astype(np.float32) / np.maximum(weight, 1)).astype(np.float32)
    lonely = weight[:, 0] == 0  # no pixel centre shows this corner's quad: leave it out
    position = np.zeros(len(touched), np.int32)
    position[sample] = np.arange(len(sample), dtype=np.int32)
    flat = image.reshape(-1, 3)
    own = flat[pixel].astype(np.float32)
    blended = 4.0 * own
    for index in corners_of_pixel:
        at = position[index]
        blended += np.where(lonely[at, None], own, colour[at])
    flat[pixel] = (blended * 0.125 + 0.5).astype(np.uint8)
