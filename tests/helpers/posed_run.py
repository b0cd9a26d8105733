"""A recording of a sideways flight through a rendered room, and the folder of a perfect run on it."""

import json
from functools import cache

import cv2
import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look
from edgeslam_torch.synthetic.sites.build import place
from edgeslam_torch.types import PointCloud
from edgeslam_torch.writers.ply import write_ply
from edgeslam_torch.writers.run_writer import tum_line

CAMERA = Camera(128, 96, 100.0, 100.0, 63.5, 47.5)
FRAMES = 12


@cache
def world():
    """Drawn once: it is the slowest thing here."""
    return place("furnished_room", np.random.default_rng(5))


def write_run(root):
    """``root/recording`` and ``root/run``, which is returned."""
    rng = np.random.default_rng(5)
    images, run = root / "recording", root / "run"
    (images / "rgb").mkdir(parents=True)
    run.mkdir()
    poses, stamps, points = [], [], []
    for k in range(FRAMES):
        T_w_c = look(np.array([0.0, 0.05 * k - 0.3, 1.4]), 0.1, 0.15)
        seen = render(world(), CAMERA, T_w_c)
        stamp = round(k / 30.0, 6)
        cv2.imwrite(str(images / "rgb" / f"{stamp:.6f}.png"), seen.image)
        v, u = rng.integers(0, 96, 400), rng.integers(0, 128, 400)
        p_c = CAMERA.back_project(np.stack([u, v], 1), seen.depth_m[v, u])
        points.append(p_c @ T_w_c[:3, :3].T + T_w_c[:3, 3])
        poses.append(T_w_c)
        stamps.append(stamp)
    (images / "rgb.txt").write_text("".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in stamps))
    save_camera(images / "camera.yaml", CAMERA)
    save_camera(run / "camera.yaml", CAMERA)
    (run / "trajectory.txt").write_text("".join(tum_line(t, T) for t, T in zip(stamps, poses, strict=True)))
    rows = ["stamp_s,status"] + [f"{t},{'lost' if k == 3 else 'tracked'}" for k, t in enumerate(stamps)]
    (run / "status.csv").write_text("\n".join(rows) + "\n")
    p_w = np.concatenate(points).astype(np.float32)
    n = len(p_w)
    cloud = PointCloud(p_w, np.zeros((n, 3), np.uint8), np.full(n, 0.01, np.float32), np.full(n, 2, np.int32))
    write_ply(run / "anchors.ply", cloud)
    summary = {"source": {"path": str(images)}, "scale": {"units": "metres"}}
    (run / "summary.json").write_text(json.dumps(summary))
    return run
