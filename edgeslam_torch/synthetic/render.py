"""Exact z-buffer rendering of a `World` with numpy and OpenCV.

On a plane, inverse depth is an affine function of the pixel and texture coordinates are a homography of it: depth
is exact at every pixel centre, and one `cv2.warpPerspective` per visible quad and texture level draws its colour.
Borders are smoothed by five samples per pixel: its centre and, shared with its neighbours, its corners.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.world import MAX_LEVEL, World
from edgeslam_torch.types import FloatArray

NEAR_M = 0.02
REMAP_CHUNK = 32000
"""`cv2.remap` wants image sides below 2**15."""


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
    uv: FloatArray
    """``(V, 2)`` corners [px], float64."""
    inverse_depth: FloatArray
    """``(3,)`` 1/z = inverse_depth @ (u, v, 1)."""
    st_from_uv: FloatArray
    """``(3, 3)`` homography from pixels to texture coordinates in [0, 1]; its third row is ``inverse_depth``."""
    plane_m: float
    """Distance of the camera from the plane."""
    roi: tuple[int, int, int, int]
    """x0, y0, x1, y1 of the corner grid, inclusive."""
    iz_range: tuple[float, float]


def render(world: World, camera: Camera, T_w_c: FloatArray, *, antialias: bool = True) -> Rendered:
    """Image, exact depth and quad index of a view.

    Args:
        world: What to look at.
        camera: Intrinsics; with distortion the image, depth and indices are those of the distorted pixels.
        T_w_c: Pose, ``(4, 4)``.
        antialias: Smooth the borders of quads.
    """
    if camera.is_distorted:
        return _render_distorted(world, camera, T_w_c, antialias)
    polygons = _project(world, camera, T_w_c)
    iz, ids = _depth_pass(polygons, camera.width, camera.height, 0.0)
    image = np.empty((camera.height, camera.width, 3), np.uint8)
    image[:] = world.background
    for polygon in polygons:
        _draw(image, iz, ids, polygon, world)
    if antialias:
        _smooth_borders(image, ids, polygons, world)
    with np.errstate(divide="ignore"):
        depth = np.where(iz > 0, np.float32(1.0) / iz, np.float32(0.0))
    return Rendered(image, depth, ids)


def _project(world: World, camera: Camera, T_w_c: FloatArray) -> list[_Polygon]:
    """The quads that face the camera and reach into the image, nearest first."""
    T_c_w = se3.inverse(np.asarray(T_w_c, dtype=np.float64))
    side = np.einsum("qi,qi->q", world.normals_w, T_w_c[:3, 3] - world.corners_w[:, 0])
    corners = world.corners_w @ T_c_w[:3, :3].T + T_c_w[:3, 3]  # (Q, 4, 3)
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    # A quad is out of sight when all its corners are beyond the same side of the viewing pyramid.
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    outside = [(x < left * z), (x > right * z), (y < top * z), (y > bottom * z), z < NEAR_M]
    seen = ~np.any([o.all(1) for o in outside], axis=0) & ((side > 1e-6) | (world.two_sided & (side < -1e-6)))
    index = np.flatnonzero(seen)
    if len(index) == 0:
        return []
    c = corners[index]
    frame = np.stack([c[:, 1] - c[:, 0], c[:, 3] - c[:, 0], c[:, 0]], axis=2)  # columns u, v, origin
    st_from_uv = np.linalg.inv(camera.K @ frame)
    polygons = []
    for row, quad in enumerate(index):
        points = _clip(c[row].tolist())
        if len(points) < 3:
            continue
        uv = [(camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy) for p in points]
        us, vs = [p[0] for p in uv], [p[1] for p in uv]
        # The corner grid reaches half a pixel beyond the centres on every side.
        x0, x1 = max(0, int(np.floor(min(us)))), min(camera.width, int(np.ceil(max(us))) + 1)
        y0, y1 = max(0, int(np.floor(min(vs)))), min(camera.height, int(np.ceil(max(vs))) + 1)
        if x0 > x1 or y0 > y1:
            continue
        izs = [1.0 / p[2] for p in points]
        polygons.append(
            _Polygon(
                int(quad),
                np.array(uv),
                st_from_uv[row, 2],
                st_from_uv[row],
                abs(float(side[quad])),
                (x0, y0, x1, y1),
                (min(izs), max(izs)),
            )
        )
    polygons.sort(key=lambda p: -p.iz_range[1])
    return polygons


def _clip(points: list[list[float]]) -> list[list[float]]:
    """Part of a polygon in front of the near plane (Sutherland-Hodgman)."""
    if min(p[2] for p in points) >= NEAR_M:
        return points
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
) -> tuple[FloatArray, np.ndarray]:
    """Inverse depth ``(height, width)`` float32 and quad index, sampled at integer pixels plus ``offset``."""
    iz = np.zeros((height, width), np.float32)
    ids = np.full((height, width), -1, np.int32)
    for polygon in polygons:
        x0, y0, x1, y1 = polygon.roi
        x1, y1 = min(x1, width - 1), min(y1, height - 1)
        xs, ys = np.arange(x0, x1 + 1) + offset, np.arange(y0, y1 + 1) + offset
        low, high = _row_spans(polygon.uv, ys, x0 + offset, x1 + offset)
        rows = np.flatnonzero(low <= high)
        if len(rows) == 0:
            continue
        first, last = int(rows[0]), int(rows[-1]) + 1
        low, high, ys = low[first:last], high[first:last], ys[first:last]
        left = max(int(np.ceil(low.min() - xs[0])), 0)
        right = min(int(np.floor(high.max() - xs[0])) + 1, len(xs))
        if left >= right:
            continue
        xs = xs[left:right]
        a, b, c = polygon.inverse_depth
        here = (a * xs).astype(np.float32) + (b * ys + c).astype(np.float32)[:, None]
        part = np.s_[y0 + first : y0 + last, x0 + left : x0 + right]
        nearer = here > iz[part]
        nearer &= xs >= low[:, None]
        nearer &= xs <= high[:, None]
        np.copyto(iz[part], here, where=nearer)
        np.copyto(ids[part], polygon.quad, where=nearer)
    return iz, ids


def _row_spans(uv: FloatArray, ys: FloatArray, x_min: float, x_max: float) -> tuple[FloatArray, FloatArray]:
    """First and last x inside a convex polygon ``(V, 2)`` on each row; first > last where the row misses it."""
    following = np.roll(uv, -1, axis=0)
    dx, dy = (following - uv).T
    area = float(np.sum(uv[:, 0] * following[:, 1] - uv[:, 1] * following[:, 0]))
    sign = 1.0 if area > 0 else -1.0
    # Inside: sign * (dx (y - y0) - dy (x - x0)) >= 0, that is A x + D >= 0 on a row.
    A = -sign * dy
    D = sign * (dx[:, None] * (ys - uv[:, 1:]) + (dy * uv[:, 0])[:, None])  # (V, rows)
    low, high = np.full(len(ys), x_min), np.full(len(ys), x_max)
    for a, d in zip(A, D, strict=True):
        if a > 0:
            np.maximum(low, -d / a, out=low)
        elif a < 0:
            np.minimum(high, -d / a, out=high)
        else:
            low[d < 0] = np.inf
    return low, high


def _level_offset(polygon: _Polygon, world: World) -> float:
    """``g`` of level = g - 3.5 log2(1/z): where one texel covers one pixel.

    Texels per pixel are det(st_from_uv) / iz^3 times the texture's size; half an octave more for each doubling of
    obliqueness, cos = plane distance times iz, keeps grazing surfaces from flickering.
    """
    image = world.quads[polygon.quad].texture.image
    texels = image.shape[0] * image.shape[1] * abs(float(np.linalg.det(polygon.st_from_uv)))
    return float(np.log2(max(texels, 1e-30)) - 0.5 * np.log2(polygon.plane_m))


def _texture_from_st(level: np.ndarray) -> FloatArray:
    """Texture pixels (centres at integers) from [0, 1] coordinates."""
    h, w = level.shape[:2]
    return np.array([[w, 0.0, -0.5], [0.0, h, -0.5], [0.0, 0.0, 1.0]])


def _draw(image: np.ndarray, iz: FloatArray, ids: np.ndarray, polygon: _Polygon, world: World) -> None:
    """Colour the pixels where this quad is the nearest."""
    x0, y0, x1, y1 = polygon.roi
    mine = (ids[y0 : y1 + 1, x0 : x1 + 1] == polygon.quad).view(np.uint8)
    if mine.size == 0:
        return
    bx, by, bw, bh = cv2.boundingRect(mine)
    if bw == 0:
        return
    mine = mine[by : by + bh, bx : bx + bw]
    x0, y0 = x0 + bx, y0 + by
    texture = world.quads[polygon.quad].texture
    g = _level_offset(polygon, world)
    a, b, c = polygon.inverse_depth
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
        shift = np.array([[1.0, 0.0, x0 + left], [0.0, 1.0, y0 + top], [0.0, 0.0, 1.0]])
        source_from_roi = _texture_from_st(level) @ polygon.st_from_uv @ shift
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        drawn = cv2.warpPerspective(level, source_from_roi, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        cv2.copyTo(drawn, mask, image[y0 + top : y0 + top + h, x0 + left : x0 + left + w])


def _level_at(iz: float, g: float) -> int:
    return int(min(max(np.floor(g - 3.5 * np.log2(max(iz, 1e-6)) + 0.5), 0), MAX_LEVEL))


def _iz_of_level(level: float, g: float) -> np.float32:
    return np.float32(2.0 ** ((g - level) / 3.5))


def _smooth_borders(image: np.ndarray, ids: np.ndarray, polygons: list[_Polygon], world: World) -> None:
    """Blend pixels whose corners show another quad than their centre: half centre, an eighth each corner."""
    height, width = ids.shape
    iz_corner, ids_corner = _depth_pass(polygons, width + 1, height + 1, -0.5)
    corners = [ids_corner[:-1, :-1], ids_corner[:-1, 1:], ids_corner[1:, :-1], ids_corner[1:, 1:]]
    mixed = corners[0] != ids
    for corner in corners[1:]:
        mixed |= corner != ids
    pixel = np.flatnonzero(mixed)
    if len(pixel) == 0:
        return
    row, column = np.divmod(pixel, width)
    first = row * (width + 1) + column
    touched = np.zeros((height + 1) * (width + 1), bool)
    neighbours = [first, first + 1, first + width + 1, first + width + 2]
    for n in neighbours:
        touched[n] = True
    sample = np.flatnonzero(touched)
    colour = _sample_colours(sample, iz_corner.ravel()[sample], ids_corner.ravel()[sample], width + 1, polygons, world)
    position = np.zeros(len(touched), np.int64)
    position[sample] = np.arange(len(sample))
    flat = image.reshape(-1, 3)
    total = 4.0 * flat[pixel].astype(np.float32)
    for n in neighbours:
        total += colour[position[n]]
    flat[pixel] = (total * 0.125 + 0.5).astype(np.uint8)


def _sample_colours(
    sample: np.ndarray, iz: FloatArray, ids: np.ndarray, stride: int, polygons: list[_Polygon], world: World
) -> FloatArray:
    """Colours ``(N, 3)`` float32 at single points of the corner grid (flat indices ``sample``)."""
    colour = np.empty((len(sample), 3), np.float32)
    colour[:] = world.background
    order = np.argsort(ids, kind="stable")
    ids_sorted = ids[order]
    for polygon in polygons:
        start, end = np.searchsorted(ids_sorted, [polygon.quad, polygon.quad + 1])
        if start == end:
            continue
        chosen = order[start:end]
        texture = world.quads[polygon.quad].texture
        g = _level_offset(polygon, world)
        levels = np.floor(g - 3.5 * np.log2(iz[chosen]) + 0.5)
        levels = np.clip(levels, 0, MAX_LEVEL).astype(np.int64)
        y, x = np.divmod(sample[chosen], stride)
        st = polygon.st_from_uv @ np.stack([x - 0.5, y - 0.5, np.ones(len(x))])
        st = st[:2] / st[2]
        for k in range(int(levels.min()), int(levels.max()) + 1):
            at = np.flatnonzero(levels == k)
            if len(at) == 0:
                continue
            level = texture.level(k)
            h, w = level.shape[:2]
            map_x = (st[0, at] * w - 0.5).astype(np.float32)
            map_y = (st[1, at] * h - 0.5).astype(np.float32)
            for i in range(0, len(at), REMAP_CHUNK):
                part = np.s_[i : i + REMAP_CHUNK]
                values = cv2.remap(
                    level, map_x[part], map_y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
                colour[chosen[at[part]]] = values.reshape(-1, 3)
    return colour


def _render_distorted(world: World, camera: Camera, T_w_c: FloatArray, antialias: bool) -> Rendered:
    """Render a pinhole view that covers the distorted one, look it up, and take depth from the planes."""
    grid_v, grid_u = np.mgrid[0 : camera.height, 0 : camera.width]
    uv = np.stack([grid_u.ravel(), grid_v.ravel()], axis=1)
    ideal = camera.undistort_points(uv).astype(np.float64)
    low, high = np.floor(ideal.min(0)) - 1.0, np.ceil(ideal.max(0)) + 1.0
    width, height = (high - low + 1).astype(int).tolist()
    wide = replace(
        camera,
        width=width,
        height=height,
        cx=camera.cx - low[0],
        cy=camera.cy - low[1],
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    )
    view = render(world, wide, T_w_c, antialias=antialias)
    local = ideal - low
    shape = (camera.height, camera.width)
    map_x, map_y = (local[:, i].astype(np.float32).reshape(shape) for i in (0, 1))
    image = cv2.remap(view.image, map_x, map_y, cv2.INTER_LINEAR)
    nearest = np.rint(local).astype(np.int64)
    ids = view.quad_id[nearest[:, 1], nearest[:, 0]]
    planes = np.zeros((len(world.quads) + 1, 3))
    for polygon in _project(world, wide, T_w_c):
        planes[polygon.quad] = polygon.inverse_depth
    iz = np.einsum("ni,ni->n", planes[ids], np.column_stack([local, np.ones(len(local))]))
    depth = np.zeros(len(iz), np.float32)
    depth[iz > 0] = 1.0 / iz[iz > 0]
    return Rendered(image, depth.reshape(shape), ids.reshape(shape))
