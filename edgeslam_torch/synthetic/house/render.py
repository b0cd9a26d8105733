"""Exact z-buffer rendering of a `World` with numpy and OpenCV.

On a plane, inverse depth is an affine function of the pixel and texture coordinates are a homography of it: depth
is exact at every pixel centre, and one look-up per visible quad and texture level draws its colour.
Borders are smoothed by five samples per pixel: its centre and, shared with its neighbours, its corners.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.world import MAX_LEVEL, World
from edgeslam_torch.synthetic.textures.image_ops import looked_up
from edgeslam_torch.types import FloatArray

NEAR_M = 0.02
BACKGROUND = 90
"""Grey level where nothing is hit."""


@dataclass(frozen=True, slots=True)
class Rendered:
    """One view of a `World`."""

    image: np.ndarray
    """``(H, W, 3)`` uint8 BGR."""
    depth_m: FloatArray
    """``(H, W)`` float32 z-depth of the ray through each pixel centre [m]; 0 where nothing is hit."""
    quad_id: np.ndarray
    """``(H, W)`` int32 index into ``world.quads``; -1 where nothing is hit."""


@dataclass(frozen=True, slots=True)
class _Polygon:
    """A quad clipped to the near plane and projected."""

    quad: int
    uv: list[list[float]]
    """Three to five corners [px]."""
    st_from_uv: FloatArray
    """``(3, 3)`` homography from pixels to texture coordinates in [0, 1]; third row times (u, v, 1) is 1/z."""
    iz_range: tuple[float, float]
    level_offset: float
    """g of level = g - 3.5 log2(1/z), where one texel covers one pixel."""


@dataclass(frozen=True, slots=True)
class _Spans:
    """The polygons' pixels on one sampling grid: columns ``low..high`` on each row."""

    roi: np.ndarray
    """``(P, 4)`` x0, y0, x1, y1, exclusive ends; empty where x0 >= x1."""
    start: np.ndarray
    """``(P,)`` where each polygon's rows begin in ``low`` and ``high``, counted as if they began at its y0."""
    low: np.ndarray
    high: np.ndarray
    """``(rows,)`` int32, inclusive."""


def render(world: World, camera: Camera, T_w_c: FloatArray, *, antialias: bool = True) -> Rendered:
    """Image, exact depth and quad index of a view.

    Args:
        world: What to look at.
        camera: Intrinsics without distortion.
        T_w_c: Pose, ``(4, 4)``.
        antialias: Smooth the borders of quads.

    Raises:
        ValueError: If the camera has distortion.
    """
    image, iz, ids = _drawn(world, camera, T_w_c, antialias)
    return Rendered(image, _depth(iz), ids.astype(np.int32))


def picture(world: World, camera: Camera, T_w_c: FloatArray) -> np.ndarray:
    """The image of `render` alone, ``(H, W, 3)`` uint8 BGR, borders not smoothed: for live pictures."""
    return _drawn(world, camera, T_w_c, antialias=False)[0]


def depth_map(world: World, camera: Camera, T_w_c: FloatArray) -> FloatArray:
    """The depth of `render` alone, ``(H, W)`` [m], borders not smoothed: at half of its time."""
    return _depth(_depth_pass(_project(world, camera, T_w_c), camera.width, camera.height, 0.0)[0])


def _depth(iz: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.where(iz > 0, np.float32(1.0) / iz, np.float32(0.0))


def _drawn(
    world: World, camera: Camera, T_w_c: FloatArray, antialias: bool
) -> tuple[np.ndarray, FloatArray, np.ndarray]:
    """Image, inverse depth, and quad index int16."""
    polygons = _project(world, camera, T_w_c)
    iz, ids, spans = _depth_pass(polygons, camera.width, camera.height, 0.0)
    image = np.full((camera.height, camera.width, 3), BACKGROUND, np.uint8)
    seen = np.bincount(ids.ravel() + 1, minlength=len(world.quads) + 1)[1:] > 0
    for polygon, roi in zip(polygons, spans.roi.tolist(), strict=True):
        if seen[polygon.quad]:
            _draw(image, iz, ids, polygon, roi, world)
    if antialias:
        _smooth_borders(image, ids, [p for p in polygons if seen[p.quad]])
    return image, iz, ids


def _project(world: World, camera: Camera, T_w_c: FloatArray) -> list[_Polygon]:
    """The quads that face the camera and reach into the image, nearest first."""
    if camera.is_distorted:
        raise ValueError("simulated cameras have no distortion")
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
    st_from_uv = np.linalg.inv(frame)
    # Texels per pixel are det(st_from_uv) / iz^3 times the texture's size. Half an octave more for each doubling
    # of obliqueness, cos = plane distance times iz, keeps grazing surfaces from flickering.
    texels = np.array([world.quads[k].texture.texels for k in index.tolist()]) / np.abs(np.linalg.det(frame))
    level_offset = (np.log2(texels) - 0.5 * np.log2(np.abs(side[index]))).tolist()
    near, far = c[:, :, 2].min(1), c[:, :, 2].max(1)
    clipped = near < NEAR_M
    ahead = np.maximum(c[:, :, 2], NEAR_M)
    uv_all = np.stack([camera.fx * c[:, :, 0] / ahead + camera.cx, camera.fy * c[:, :, 1] / ahead + camera.cy], axis=2)
    polygons = []
    for row, (quad, corners_uv) in enumerate(zip(index.tolist(), uv_all.tolist(), strict=True)):
        iz_range = (1.0 / far[row], 1.0 / near[row])
        if clipped[row]:
            points = _clip(c[row].tolist())
            if len(points) < 3:
                continue
            corners_uv = [[camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy] for p in points]
            izs = [1.0 / p[2] for p in points]
            iz_range = (min(izs), max(izs))
        polygons.append(_Polygon(quad, corners_uv, st_from_uv[row], iz_range, level_offset[row]))
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
) -> tuple[FloatArray, np.ndarray, _Spans]:
    """Inverse depth ``(height, width)`` float32 and quad index int16, at integer pixels plus ``offset``."""
    iz = np.zeros((height, width), np.float32)
    ids = np.full((height, width), -1, np.int16)
    spans = _spans(polygons, width, height, offset)
    columns = np.arange(width, dtype=np.int32)
    planes = np.array([p.st_from_uv[2] for p in polygons]).reshape(-1, 3)
    planes[:, 2] += offset * (planes[:, 0] + planes[:, 1])
    for polygon, (x0, y0, x1, y1), start, (a, b, c) in zip(
        polygons, spans.roi.tolist(), spans.start.tolist(), planes.tolist(), strict=True
    ):
        if x0 >= x1:
            continue
        xs, ys = columns[x0:x1], np.arange(y0, y1)
        here = (a * xs).astype(np.float32) + (b * ys + c).astype(np.float32)[:, None]
        target = iz[y0:y1, x0:x1]
        nearer = here > target
        rows = slice(start, start + y1 - y0)
        nearer &= xs >= spans.low[rows, None]
        nearer &= xs <= spans.high[rows, None]
        cv2.copyTo(here, nearer.view(np.uint8), target)
        np.copyto(ids[y0:y1, x0:x1], polygon.quad, where=nearer)
    return iz, ids, spans


def _spans(polygons: list[_Polygon], width: int, height: int, offset: float) -> _Spans:
    """First and last column inside each convex polygon on each of its rows."""
    count = len(polygons)
    uv = np.array([p.uv + [p.uv[-1]] * (5 - len(p.uv)) for p in polygons]).reshape(-1, 5, 2) - offset
    top = np.clip(np.ceil(uv[:, :, 1].min(1)), 0, height).astype(np.int64)
    bottom = np.clip(np.floor(uv[:, :, 1].max(1)) + 1, top, height).astype(np.int64)
    rows = bottom - top
    start = np.cumsum(rows) - rows
    owner = np.repeat(np.arange(count), rows)
    y = (np.arange(len(owner)) - start[owner] + top[owner]).astype(np.float64)
    following = np.roll(uv, -1, axis=1)
    edge = following - uv
    area = np.sum(uv[..., 0] * following[..., 1] - uv[..., 1] * following[..., 0], axis=1)
    low, high = np.full(len(y), 0.0), np.full(len(y), width - 1.0)
    for k in range(5):
        dx, dy = edge[:, k, 0], edge[:, k, 1]
        slope = np.divide(dx, dy, out=np.zeros(count), where=dy != 0)
        cut = (y - uv[owner, k, 1]) * slope[owner] + uv[owner, k, 0]
        # With positive area the inside lies where dx (y - y0) - dy (x - x0) >= 0.
        bounds_low = (np.sign(area) * dy < 0)[owner]
        bounds_high = (np.sign(area) * dy > 0)[owner]
        np.maximum(low, cut, out=low, where=bounds_low)
        np.minimum(high, cut, out=high, where=bounds_high)
    first, last = np.ceil(low).astype(np.int32), np.floor(high).astype(np.int32)
    roi = np.zeros((count, 4), np.int64)
    nonempty = np.flatnonzero(rows)
    if len(nonempty):
        left = np.minimum.reduceat(first, start[nonempty])
        right = np.maximum.reduceat(last, start[nonempty]) + 1
        roi[nonempty] = np.stack([left, top[nonempty], right, bottom[nonempty]], axis=1)
    return _Spans(roi, start, first, last)


def _texture_from_st(level: np.ndarray) -> FloatArray:
    """Texture pixels (centres at integers) from [0, 1] coordinates."""
    h, w = level.shape[:2]
    return np.array([[w, 0.0, -0.5], [0.0, h, -0.5], [0.0, 0.0, 1.0]])


def _draw(image: np.ndarray, iz: FloatArray, ids: np.ndarray, polygon: _Polygon, roi: list[int], world: World) -> None:
    """Colour the pixels where this quad is the nearest."""
    x0, y0, x1, y1 = roi
    mine = (ids[y0:y1, x0:x1] == polygon.quad).view(np.uint8)
    bx, by, bw, bh = cv2.boundingRect(mine)
    mine = mine[by : by + bh, bx : bx + bw]
    x0, y0 = x0 + bx, y0 + by
    texture, g = world.quads[polygon.quad].texture, polygon.level_offset
    a, b, c = polygon.st_from_uv[2].tolist()
    at_corners = [a * x + b * y + c for x in (x0, x0 + bw - 1) for y in (y0, y0 + bh - 1)]
    near = min(max(at_corners), polygon.iz_range[1])
    far = max(min(at_corners), polygon.iz_range[0])
    first, last = _level_at(near, g), _level_at(far, g)
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
        texture_from_uv = _texture_from_st(level) @ polygon.st_from_uv
        drawn = looked_up(level, *_mapped(texture_from_uv, x0 + left, y0 + top, w, h))
        cv2.copyTo(drawn, mask, image[y0 + top : y0 + top + h, x0 + left : x0 + left + w])


def _mapped(H: FloatArray, x0: int, y0: int, width: int, height: int) -> tuple[FloatArray, FloatArray]:
    """Where a homography ``(3, 3)`` takes the pixels of a rectangle, x and y ``(height, width)``."""
    x, y = np.arange(x0, x0 + width, dtype=np.float64), np.arange(y0, y0 + height, dtype=np.float64)[:, None]
    u, v, w = (row[0] * x + (row[1] * y + row[2]) for row in H)
    per_w = 1.0 / w
    return u * per_w, v * per_w


def _level_at(iz: float, g: float) -> int:
    return min(max(math.floor(g - 3.5 * math.log2(max(iz, 1e-6)) + 0.5), 0), MAX_LEVEL)


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
