"""A run as a COLMAP text model: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

https://colmap.github.io/format.html. COLMAP's pixel (0.5, 0.5) is the centre of the first pixel, ours (0, 0); its
poses are world to camera with the quaternion's w first. Anchors come first and carry tracks: which image saw them at
which pixel, in the image as it is, distorted. Points of edges follow without tracks: they were found along epipolar
lines, not matched.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, Observations, PointCloud

_NONE = np.zeros(0, np.int64)
NO_POINTS = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), _NONE)
_UNSEEN = Observations(np.zeros(0), _NONE, _NONE, np.zeros((0, 2), np.float32))


def write_colmap(
    folder: Path,
    camera: Camera,
    names: Sequence[str],
    T_w_c: FloatArray,
    cloud: PointCloud,
    anchors: PointCloud | None = None,
    seen: Observations | None = None,
    comment: str = "",
) -> None:
    """Write the model.

    Args:
        folder: Created if missing.
        camera: Of all images; distortion is kept.
        names: ``N`` image files, relative to the image folder that COLMAP is given.
        T_w_c: Camera to world ``(N, 4, 4)``.
        cloud: Points of edges; their sigma is stored as COLMAP's reprojection error, in pixels at 1 m.
        anchors: What ``seen`` refers to; left out without it.
        seen: Anchors in the images, whose order is that of ``names``.
        comment: Line above the images and the points.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "cameras.txt", _camera_text(camera))
    if anchors is None or seen is None:
        anchors, seen = NO_POINTS, _UNSEEN
    head = f"# {comment}\n" if comment else ""
    write_text(folder / "images.txt", head + _images_text(names, T_w_c, seen, camera))
    tracks = _tracks(seen, len(anchors.p_w))
    lines = _points_lines(anchors, camera.fx, tracks, first=1)
    lines += _points_lines(cloud, camera.fx, [""] * len(cloud.p_w), first=1 + len(anchors.p_w))
    write_text(
        folder / "points3D.txt", head + "\n".join(["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", *lines]) + "\n"
    )


def _camera_text(camera: Camera) -> str:
    k1, k2, p1, p2, k3 = camera.distortion
    pinhole = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    numbers: tuple[float, ...]
    if not camera.is_distorted:
        model, numbers = "PINHOLE", pinhole
    elif k3 == 0.0:
        model, numbers = "OPENCV", (*pinhole, k1, k2, p1, p2)
    else:
        model, numbers = "FULL_OPENCV", (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    values = " ".join(f"{x:.9g}" for x in numbers)
    return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {model} {camera.width} {camera.height} {values}\n"


def _images_text(names: Sequence[str], T_w_c: FloatArray, seen: Observations, camera: Camera) -> str:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[]"]
    for number, (name, T) in enumerate(zip(names, T_w_c, strict=True), start=1):
        row = se3.pose_to_tum(se3.inverse(T))
        pose = " ".join(f"{x:.12g}" for x in (row[6], *row[3:6], *row[:3]))
        own = seen.keyframe == number - 1
        uv = camera.distort_points(seen.uv[own]) + 0.5
        points = (f"{u:.3f} {v:.3f} {anchor + 1}" for (u, v), anchor in zip(uv, seen.anchor[own], strict=True))
        lines += [f"{number} {pose} 1 {name.replace(' ', '_')}", " ".join(points)]
    return "\n".join(lines) + "\n"


def _tracks(seen: Observations, count: int) -> list[str]:
    """Of each anchor: ``IMAGE_ID POINT2D_IDX`` for every image that saw it."""
    tracks: list[list[str]] = [[] for _ in range(count)]
    place: Counter[int] = Counter()
    for keyframe, anchor in zip(seen.keyframe.tolist(), seen.anchor.tolist(), strict=True):
        tracks[anchor].append(f" {keyframe + 1} {place[keyframe]}")
        place[keyframe] += 1
    return ["".join(track) for track in tracks]


def _points_lines(cloud: PointCloud, fx: float, tracks: Sequence[str], first: int) -> list[str]:
    error = np.where(np.isfinite(cloud.sigma_m), cloud.sigma_m * fx, -1.0)
    rows = enumerate(zip(cloud.p_w, cloud.colour, error, tracks, strict=True), start=first)
    return [f"{n} {p[0]:.6g} {p[1]:.6g} {p[2]:.6g} {c[0]} {c[1]} {c[2]} {e:.4g}{track}" for n, (p, c, e, track) in rows]
