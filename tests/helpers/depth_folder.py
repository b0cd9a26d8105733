"""A small recording with depth: noise on a ramp."""

import cv2
import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def write_folder(folder, count=12, camera=CAMERA):
    rng = np.random.default_rng(0)
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    lines = {"rgb": ["# comment"], "depth": []}
    depth = np.tile(np.linspace(1000, 3000, 64).astype(np.uint16), (48, 1))
    depth[:10] = 0
    depth[10:12] = 65535
    for k in range(count):
        t = 100 + k / 30
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), rng.integers(0, 256, (48, 64, 3), np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), depth)
        lines["rgb"].append(f"{t:.6f} rgb/{k}.png")
        lines["depth"].append(f"{t + 0.004:.6f} depth/{k}.png")
    for name, rows in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")
    save_camera(folder / "camera.yaml", camera)
    with (folder / "camera.yaml").open("a") as file:
        file.write("depth_scale: 1000.0\n")
    return folder
