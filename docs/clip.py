"""Make the README's clip from a recording: ``python docs/clip.py tum_fr1_xyz``.

Left the picture with the edge map as known at that moment, drawn at the live pose and coloured by depth; right the same
map with the path so far; below the line that ``edgeslam run`` prints. Nothing of it is refined afterwards.
"""

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch import EdgeSlam, open_source
from edgeslam_torch.eval.report.keyframe_pictures import draw_edges
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.terminal.run_progress import status_words
from edgeslam_torch.types import FloatArray, PointCloud
from edgeslam_torch.writers.raster_axes import BACKGROUND, text

CLIP = Path(__file__).resolve().parent / "images" / "live.webp"
_PICTURE, _MAP, _LINE_PX = (408, 306), (400, 306), 30
"""Width and height of the two views; height of the line below them."""
_ELEVATION_RAD, _TURN_RAD = math.radians(28.0), math.radians(70.0)
"""The map is seen from above at this angle, and turns by so much during the clip."""
_PATH_BGR = (46, 157, 255)
_QUALITY = 30


@dataclass(frozen=True, slots=True)
class Moment:
    """What was known after one frame."""

    image: np.ndarray
    T_w_c: FloatArray
    cloud: PointCloud
    path_w: FloatArray
    """Camera centres so far ``(F, 3)``."""
    words: str


def watch(sequence: str, every: int) -> tuple[Camera, list[Moment]]:
    """Run a recording and keep every ``every``-th moment."""
    source = open_source(sequence)
    slam = EdgeSlam(source.camera)
    moments, centres = [], []
    for i, frame in enumerate(source.frames()):
        output = slam.step(frame)
        centres.append(output.T_w_c[:3, 3])
        if i % every == 0:
            words = f"{i + 1}/{source.length} frames, {status_words(output)}"
            image = source.camera.undistort_image(frame.image)
            moments.append(Moment(image, output.T_w_c, slam.edge_map(), np.array(centres), words))
    return source.camera, moments


def drawn(moment: Moment, camera: Camera, axes: FloatArray, centre: FloatArray, pixels_per_unit: float) -> np.ndarray:
    """One picture of the clip, BGR."""
    picture = draw_edges(moment.image, camera, se3.inverse(moment.T_w_c), moment.cloud)
    picture = cv2.resize(picture, _PICTURE, interpolation=cv2.INTER_AREA)
    view = np.full((_MAP[1], _MAP[0], 3), BACKGROUND[::-1], np.uint8)

    def seen(p_w: FloatArray) -> tuple[np.ndarray, FloatArray]:
        q = (p_w - centre) @ axes.T
        return np.rint(q[:, :2] * pixels_per_unit + (_MAP[0] / 2, _MAP[1] / 2)).astype(int), q[:, 2]

    uv, depth = seen(np.asarray(moment.cloud.p_w, np.float64))
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < _MAP[0]) & (uv[:, 1] < _MAP[1])
    order = np.flatnonzero(inside)[np.argsort(-depth[inside])]  # the nearest is drawn last
    view[uv[order, 1], uv[order, 0]] = np.maximum(np.asarray(moment.cloud.colour)[order, ::-1], 60)
    cv2.polylines(view, [seen(moment.path_w)[0][:, None]], False, _PATH_BGR, 1, cv2.LINE_AA)
    corners_c = 0.08 * np.array([[0, 0, 0], [-1, -0.75, 1.3], [1, -0.75, 1.3], [1, 0.75, 1.3], [-1, 0.75, 1.3]])
    tip, *rim = seen(se3.transform(moment.T_w_c, corners_c))[0].tolist()
    for a, b in zip(rim, rim[1:] + rim[:1], strict=True):
        cv2.line(view, a, b, (255, 255, 255), 1, cv2.LINE_AA)
        cv2.line(view, tip, a, (255, 255, 255), 1, cv2.LINE_AA)
    line = np.full((_LINE_PX, _PICTURE[0] + _MAP[0], 3), BACKGROUND[::-1], np.uint8)
    text(line, moment.words, (10, _LINE_PX / 2), 0.42, anchor=(0.0, 0.5))
    return np.vstack([np.hstack([picture, view]), line])


def clip(camera: Camera, moments: list[Moment]) -> list[np.ndarray]:
    """All pictures; the view's middle and size are those of the last map."""
    p = np.asarray(moments[-1].cloud.p_w, np.float64)
    low, high = np.percentile(p, [8.0, 92.0], axis=0)
    pixels_per_unit = 0.9 * min(_MAP) / float(np.linalg.norm((high - low)[:2]))
    forward = moments[0].T_w_c[:2, 2]
    begin = math.atan2(forward[1], forward[0]) - _TURN_RAD / 2
    pictures = []
    for moment, share in zip(moments, np.linspace(0.0, 1.0, len(moments)), strict=True):
        axes = _looking(begin + share * _TURN_RAD)
        pictures.append(drawn(moment, camera, axes, (low + high) / 2, pixels_per_unit))
    return pictures


def _looking(yaw_rad: float) -> FloatArray:
    """Rows: right, down and forward of an eye that looks along ``yaw_rad``, from above."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    ce, se = math.cos(_ELEVATION_RAD), math.sin(_ELEVATION_RAD)
    forward = np.array([c * ce, s * ce, -se])
    right = np.array([s, -c, 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def main() -> None:
    """Run, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", help="tum_fr1_xyz, as 'edgeslam data get' leaves it")
    parser.add_argument("--every", type=int, default=14, help="frames between two pictures (default: 14)")
    parser.add_argument("--out", type=Path, default=CLIP)
    options = parser.parse_args()
    pictures = clip(*watch(options.sequence, options.every))
    animation = cv2.Animation()
    animation.frames = pictures
    animation.durations = [110] * (len(pictures) - 1) + [2500]
    animation.loop_count = 0
    cv2.imwriteanimation(str(options.out), animation, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    sys.stdout.write(f"{options.out}: {len(pictures)} pictures, {options.out.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
