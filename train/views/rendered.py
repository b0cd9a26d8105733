"""Rendered rooms as training views, drawn once and kept in a file."""

from pathlib import Path

import numpy as np

from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.views import random_room, random_view
from edgeslam_torch.terminal.progress import counted
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.types import FloatArray

WIDTH, HEIGHT = 320, 240
FOCAL_PX = (210.0, 360.0)
"""Of the 320 pixel wide images: 75 to 48 degrees across."""
MIN_SPREAD = 1.5
"""90th over 10th percentile of depth; below, a view shows a single surface."""
KEEP_FLAT = 0.3
"""Share of such views kept: drones do look at walls."""


def render_rooms(path: Path, rooms: int, views_per_room: int = 6, seed: int = 7) -> None:
    """Draw ``rooms * views_per_room`` views and write them to ``path`` (npz); room r depends on (seed, r)
    alone."""
    images, depths, matrices = [], [], []
    for r in counted(range(rooms), "rendering rooms", "room"):
        rng = np.random.default_rng((seed, r))
        world = random_room(rng)
        for _ in range(views_per_room):
            focal = float(np.exp(rng.uniform(*np.log(FOCAL_PX))))
            camera = Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
            rendered = random_view(rng, camera, world)
            images.append(rendered.image)
            depths.append(rendered.depth_m.astype(np.float16))
            matrices.append(camera.K)
    arrays = {"image": np.array(images), "depth": np.array(depths), "K": np.array(matrices)}
    write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **arrays))


def load_rendered(path: Path, seed: int = 0) -> list[View]:
    """The stored views without most of the flat ones."""
    rng = np.random.default_rng(seed)
    return [view for view in stored_views(path) if is_worth_learning(view.depth_m, rng.random())]


def stored_views(path: Path) -> list[View]:
    """All views of a file."""
    with np.load(path) as stored:
        parts = zip(stored["image"], stored["depth"], stored["K"], strict=True)
        return [View(image, depth.astype(np.float32), K) for image, depth, K in parts]


def is_worth_learning(depth_m: FloatArray, lottery: float) -> bool:
    """Whether a view shows depth, or, as ``lottery`` in [0, 1) is below `KEEP_FLAT`, some at least."""
    known = depth_m[depth_m > 0]
    if len(known) == 0:
        return False
    low, high = np.percentile(known, (10, 90))
    return bool(high > MIN_SPREAD * low or lottery < KEEP_FLAT)
