"""A run for nerfstudio: ``transforms.json`` with undistorted images, masks and sparse depth.

https://docs.nerf.studio/quickstart/data_conventions.html. Its camera looks along -z with y up, and the centre of the
first pixel is (0.5, 0.5). Depth maps are 16-bit millimetres, 0 where nothing is known: the anchors that the keyframe
itself observed, hence nothing hidden shines through. Masks are 0 where the lens showed nothing.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import subfolder, write_image
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, Observations, PointCloud
from edgeslam_torch.writers.ply import write_ply

_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
_MM = 1000.0


def write_nerfstudio(
    folder: Path,
    camera: Camera,
    images: Sequence[Path],
    T_w_c: FloatArray,
    cloud: PointCloud,
    anchors: PointCloud,
    seen: Observations,
    comment: str = "",
) -> None:
    """Write the folder.

    Args:
        folder: Made when missing.
        camera: Of all images.
        images: ``N`` image files, in the order of ``seen``'s keyframes.
        T_w_c: Camera to world ``(N, 4, 4)``.
        cloud: Edge map, for splatting to begin with (``edge_map.ply``).
        anchors: What ``seen`` refers to.
        seen: Undistorted pixels of anchors.
        comment: Kept in ``transforms.json`` and the cloud.

    Raises:
        OSError: If something cannot be written.
        SourceError: If an image cannot be read, or has another size than the calibration.
    """
    for name in ("images", "masks", "depth"):
        subfolder(folder, name)
    mask = valid_pixels(camera)
    frames = []
    for number, (path, T) in enumerate(zip(images, T_w_c, strict=True)):
        name = f"{number:05d}.png"
        own = seen.keyframe == number
        write_image(folder / "images" / name, camera.undistort_image(_image(path, camera)))
        write_image(folder / "masks" / name, mask)
        write_image(folder / "depth" / name, sparse_depth(camera, T, anchors.p_w[seen.anchor[own]], seen.uv[own]))
        files = {"file_path": "images", "mask_path": "masks", "depth_file_path": "depth"}
        frames.append({key: f"{place}/{name}" for key, place in files.items()} | {"transform_matrix": gl_pose(T)})
    write_ply(folder / "edge_map.ply", cloud, (comment,) if comment else ())
    write_text(
        folder / "transforms.json", json.dumps(_head(camera) | {"comment": comment, "frames": frames}, indent=1) + "\n"
    )


def gl_pose(T_w_c: FloatArray) -> list[list[float]]:
    """Camera to world for a camera with y up that looks along -z."""
    return [[float(x) for x in row] for row in T_w_c @ _GL_FROM_CV]


def sparse_depth(camera: Camera, T_w_c: FloatArray, p_w: FloatArray, uv: FloatArray) -> np.ndarray:
    """Depth map ``(H, W)`` [mm, uint16] of points ``(P, 3)`` at the pixels ``(P, 2)`` where they were observed."""
    z_mm = _MM * se3.transform(se3.inverse(T_w_c), np.asarray(p_w, np.float64))[:, 2]
    column, row = np.rint(uv).astype(np.int64).T
    depth = np.zeros((camera.height, camera.width), np.uint16)
    keep = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height) & (z_mm >= 1) & (z_mm < 65535)
    order = np.argsort(-z_mm[keep])  # the nearest of a pixel is written last
    depth[row[keep][order], column[keep][order]] = np.rint(z_mm[keep][order])
    return depth


def valid_pixels(camera: Camera) -> np.ndarray:
    """Mask ``(H, W)``: 255 where the undistorted image has something from the lens, else 0."""
    if not camera.is_distorted:
        return np.full((camera.height, camera.width), 255, np.uint8)
    white = np.full((camera.height, camera.width), 255, np.uint8)
    seen = cv2.remap(white, *camera.undistortion_maps(), cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return np.where(seen == 255, 255, 0).astype(np.uint8)


def _head(camera: Camera) -> dict[str, object]:
    pinhole = replace(camera, distortion=(0.0,) * 5)
    return {
        "camera_model": "OPENCV",
        "w": pinhole.width,
        "h": pinhole.height,
        "fl_x": float(pinhole.fx),
        "fl_y": float(pinhole.fy),
        "cx": float(pinhole.cx) + 0.5,
        "cy": float(pinhole.cy) + 0.5,
        "depth_unit_scale_factor": 1.0 / _MM,
        "ply_file_path": "edge_map.ply",
    }


def _image(path: Path, camera: Camera) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise SourceError(f"{path}: cannot be read as an image")
    if image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise SourceError(f"{path}: is {size}, the run's calibration {camera.width}x{camera.height}")
    return image
