"""Keyframes with the map's edges drawn in, coloured by depth: does the map lie on the image?"""

from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.inputs.associate import nearest
from edgeslam_torch.eval.inputs.run_folder import RunFolder, record
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import load_camera
from edgeslam_torch.readers import images
from edgeslam_torch.readers.layouts import layout_of
from edgeslam_torch.readers.listing import ImageEntry
from edgeslam_torch.types import FloatArray, PointCloud
from edgeslam_torch.writers.keyframe_images import kept_images

_CELL_PX = 8
"""Side of the cells in which nearer points hide farther ones."""

_HIDDEN = 1.08
"""A point this much farther than its cell's nearest is behind it."""

_WITH_TELEMETRY = "flight"
"""What a run calls a folder of images in TUM's layout with a telemetry beside them."""


def keyframe_pictures(run: RunFolder, cloud: PointCloud, stamps_s: FloatArray) -> list[tuple[float, np.ndarray]]:
    """Stamp and BGR picture of the keyframes at ``stamps_s`` whose images can still be read.

    Only folders of images are supported; a missing one gives no pictures, not an error.
    """
    paths = image_paths(run, stamps_s)
    if len(cloud.p_w) == 0 or not any(paths):
        return []
    try:
        camera = load_camera(run.path / "camera.yaml")
    except EdgeSlamError:
        return []
    out = []
    for stamp, path in zip(stamps_s, paths, strict=True):
        image = images.pixels_or_none(path, cv2.IMREAD_COLOR) if path is not None else None
        if image is None or image.shape[:2] != (camera.height, camera.width):
            continue
        pose = int(nearest(run.trajectory.stamps_s, np.array([stamp]))[0])
        T_c_w = se3.inverse(run.trajectory.T_w_c[pose])
        out.append((float(stamp), draw_edges(camera.undistort_image(image), camera, T_c_w, cloud)))
    return out


def image_paths(run: RunFolder, stamps_s: FloatArray) -> list[Path | None]:
    """Image files at ``stamps_s``: of the run's source, else those that the run kept; None where there is none."""
    try:
        files = {entry.stamp_s: entry.path for entry in _entries(run)}
    except (EdgeSlamError, OSError):
        files = {}
    files = files or kept_images(run.path)
    if not files:
        return [None] * len(stamps_s)
    known = np.array(sorted(files))
    at = [float(known[i]) for i in nearest(known, np.asarray(stamps_s))]
    return [files[near] if abs(near - t) < 1e-3 else None for near, t in zip(at, stamps_s, strict=True)]


def draw_edges(image: np.ndarray, camera: Camera, T_c_w: FloatArray, cloud: PointCloud) -> np.ndarray:
    """The undistorted image ``(H, W, 3)``, dimmed, with the visible map points in it."""
    p = se3.transform(T_c_w, np.asarray(cloud.p_w, dtype=np.float64))
    p = p[p[:, 2] > 1e-3]
    uv = np.rint(camera.project(p)).astype(np.int64)
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width - 1) & (uv[:, 1] < camera.height - 1)
    uv, z = uv[inside], p[inside, 2]
    out = (0.4 * image).astype(np.uint8)
    if len(z) == 0:
        return out
    columns = -(-camera.width // _CELL_PX)
    cell = uv[:, 1] // _CELL_PX * columns + uv[:, 0] // _CELL_PX
    front = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(front, cell, z)
    seen = z < _HIDDEN * front[cell]
    uv, z = uv[seen], z[seen]
    near, far = np.quantile(1.0 / z, [0.97, 0.03])
    code = np.clip((1.0 / z - far) / max(near - far, 1e-9), 0, 1) * 215 + 20  # without turbo's dark ends
    colour = cv2.applyColorMap(code.astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO).reshape(-1, 3)
    order = np.argsort(-z)
    for dv, du in ((0, 0), (0, 1), (1, 0), (1, 1)):
        out[uv[order, 1] + dv, uv[order, 0] + du] = colour[order]
    return out


def _entries(run: RunFolder) -> list[ImageEntry]:
    kind, folder = str(record(run.summary.get("source")).get("kind")), run.source
    if folder is None:
        return []
    if kind == "images":
        return images.list_image_folder(folder)[0]
    layout = layout_of(folder)
    if layout is None or kind not in (layout.KIND, _WITH_TELEMETRY):
        return []
    return list(layout.read(folder).images)
