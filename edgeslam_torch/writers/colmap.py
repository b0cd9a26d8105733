"""A run as a COLMAP text model: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

https://colmap.github.io/format.html. COLMAP's pixel (0.5, 0.5) is the centre of the first pixel, ours (0, 0); its
poses are world to camera with the quaternion's w first. Points carry no tracks: the map is made of edges, not of
matched keypoints.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, PointCloud


def write_colmap(folder: Path, camera: Camera, names: Sequence[str], T_w_c: FloatArray, cloud: PointCloud) -> None:
    """Write the model.

    Args:
        folder: Created if missing.
        camera: Of all images; distortion is kept.
        names: ``N`` image files, relative to the image folder that COLMAP is given.
        T_w_c: Camera to world ``(N, 4, 4)``.
        cloud: Map points; their sigma is stored as COLMAP's reprojection error, in pixels at 1 m.

    Raises:
        OSError: If the file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "cameras.txt", _camera_text(camera))
    write_text(folder / "images.txt", _images_text(names, T_w_c))
    write_text(folder / "points3D.txt", _points_text(cloud, camera.fx))


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


def _images_text(names: Sequence[str], T_w_c: FloatArray) -> str:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[]"]
    for number, (name, T) in enumerate(zip(names, T_w_c, strict=True), start=1):
        row = se3.pose_to_tum(se3.inverse(T))
        pose = " ".join(f"{x:.12g}" for x in (row[6], *row[3:6], *row[:3]))
        lines += [f"{number} {pose} 1 {name.replace(' ', '_')}", ""]
    return "\n".join(lines) + "\n"


def _points_text(cloud: PointCloud, fx: float) -> str:
    error = np.where(np.isfinite(cloud.sigma_m), cloud.sigma_m * fx, -1.0)
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    for number, (p, c, e) in enumerate(zip(cloud.p_w, cloud.colour, error, strict=True), start=1):
        lines.append(f"{number} {p[0]:.6g} {p[1]:.6g} {p[2]:.6g} {c[0]} {c[1]} {c[2]} {e:.4g}")
    return "\n".join(lines) + "\n"
