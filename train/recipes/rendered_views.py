"""Rendered rooms, corridors, halls and sites of flights as training views, drawn once and kept in files.

``default`` learns from level views of rooms (`room_views`); ``near`` from views of a `random_place`, also oblique and
near ones (`place_views`).
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import Rendered, render
from edgeslam_torch.synthetic.house.views import look, random_room, random_view
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.synthetic.sites.build import JUDGED, named_site, place
from edgeslam_torch.terminal.progress import counted
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
WIDTH, HEIGHT = 320, 240
ROOM_FOCAL_PX = (210.0, 360.0)
"""Of the 320 pixel wide images of rooms: 75 to 48 degrees across."""
MIN_SPREAD = 1.5
"""90th over 10th percentile of depth; below, a view shows a single surface."""
KEEP_FLAT = 0.3
"""Share of such views kept: drones do look at walls."""
LEVEL_FOCAL_PX = (140.0, 380.0)
"""Of the 320 pixel wide images: 98 to 46 degrees across."""
OBLIQUE_FOCAL_PX = (130.0, 300.0)
ROOM_VIEWS = 6
"""Of each room."""
LEVEL_VIEWS, OBLIQUE_VIEWS, NEAR_VIEWS = 8, 5, 5
"""Of each place."""
NEAREST_M = 0.18
"""Least fifth percentile of an oblique or near view's depth: nearer, a single texture fills it."""
SITE_SHARE = 0.4
"""Of the places: what a drone hits stands there."""
SITE_SEEDS = (1_000_000, 2_000_000)
"""Of sites to learn from; flights are judged on smaller ones."""
TRIES = 8
PLACES_A_FILE = 10


Drawn = Iterator[tuple[Camera, Rendered]]
"""Views with their cameras."""


def room_views(rng: Rng) -> Drawn:
    """Level views of a random room."""
    world = random_room(rng)
    for _ in range(ROOM_VIEWS):
        camera = _camera(_log(rng, *ROOM_FOCAL_PX))
        yield camera, random_view(rng, camera, world)


def place_views(rng: Rng) -> Drawn:
    """Level, oblique and near views of a random place."""
    world = random_place(rng)
    for kind in ["level"] * LEVEL_VIEWS + ["oblique"] * OBLIQUE_VIEWS + ["near"] * NEAR_VIEWS:
        camera = _camera(_log(rng, *(OBLIQUE_FOCAL_PX if kind == "oblique" else LEVEL_FOCAL_PX)))
        if kind == "level":
            rendered: Rendered | None = random_view(rng, camera, world)
        else:
            rendered = close_view(rng, camera, world, oblique_pose if kind == "oblique" else near_pose)
        if rendered is not None:
            yield camera, rendered


def render_files(folder: Path, views: Callable[[Rng], Drawn], places: int, seed: int) -> list[Path]:
    """Draw views of ``places`` places into ``folder``, `PLACES_A_FILE` a file, without most of the flat ones; place p
    depends on (seed, p) alone. Files that are there stay. Returns all of them, in the order of the places."""
    folder.mkdir(parents=True, exist_ok=True)
    firsts = range(0, places, PLACES_A_FILE)
    files = {folder / f"places_{first:05d}.npz": range(first, min(first + PLACES_A_FILE, places)) for first in firsts}
    for path in counted([path for path in files if not path.is_file()], "rendering places", "file"):
        _render_file(path, views, files[path], seed)
    return list(files)


def _render_file(path: Path, views: Callable[[Rng], Drawn], numbers: range, seed: int) -> None:
    found = []
    for p in numbers:
        rng = np.random.default_rng((seed, p))
        for camera, view in views(rng):
            if is_worth_learning(view.depth_m, rng.random()):
                found.append((view.image, view.depth_m.astype(np.float16), camera.K))
    arrays = {name: np.array([row[k] for row in found]) for k, name in enumerate(("image", "depth", "K"))}
    write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **arrays))


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


def random_place(rng: Rng) -> World:
    """A place of random kind and size: what a drone flies through that `random_room` does not have."""
    if rng.random() < SITE_SHARE:
        return named_site(str(rng.choice((*JUDGED, "doors"))), int(rng.integers(*SITE_SEEDS))).world
    kind = rng.random()
    if kind < 0.3:
        return random_room(rng)
    if kind < 0.5:
        return place("long_corridor", rng, **_size(rng, (6, 24), (1.5, 4.0), (2.3, 3.6)))
    if kind < 0.68:
        return place("long_blank_corridor", rng, **_size(rng, (6, 24), (1.5, 4.0), (2.3, 3.6)))
    if kind < 0.8:  # as wide as a hall
        return place("long_blank_corridor", rng, **_size(rng, (8, 24), (4.0, 11.0), (2.6, 6)))
    if kind < 0.95:
        return place("furnished_room", rng, **_size(rng, (6, 16), (5, 11), (2.4, 5)))
    return place("building", rng, side=_log(rng, 3.2, 5.0), opening=float(rng.uniform(0.9, 1.8)))


def _size(rng: Rng, *ranges: tuple[float, float]) -> dict[str, float]:
    return {name: _log(rng, *ends) for name, ends in zip(("long", "wide", "high"), ranges, strict=True)}


def oblique_pose(rng: Rng, world: World) -> FloatArray | None:
    """A pose ``T_w_c`` 0.3 to 1.3 m from a wall, 5 to 75 degrees from along it, tilted and rolled; None without a free
    place."""
    low, high = world.bounds_w
    for _ in range(60):
        p = rng.uniform(low + 0.3, high - 0.3)
        p[2] = np.clip(rng.normal(1.3, 0.5), 0.25, high[2] - 0.25)
        wall, distance = int(rng.integers(4)), _log(rng, 0.3, 1.3)
        axis, at_low = wall // 2, wall % 2 == 0
        if distance > 0.6 * (high - low)[axis]:
            continue
        p[axis] = low[axis] + distance if at_low else high[axis] - distance
        if world.clearance(p) < min(0.2, 0.8 * distance):
            continue
        towards = np.zeros(2)
        towards[axis] = -1.0 if at_low else 1.0
        along = np.array([-towards[1], towards[0]]) * (1 if rng.random() < 0.5 else -1)
        turned = np.deg2rad(rng.uniform(5.0, 75.0))
        ahead = np.cos(turned) * along + np.sin(turned) * towards
        down = float(np.clip(rng.normal(0.1, 0.4), -1.0, 1.2))
        return look(p, float(np.arctan2(ahead[1], ahead[0])), down, float(rng.normal(0.0, 0.45)))
    return None


def near_pose(rng: Rng, world: World) -> FloatArray | None:
    """A pose ``T_w_c`` of a drone that has something 0.35 to 1 m beside or before it; None without a free place."""
    low, high = world.bounds_w
    wanted = _log(rng, 0.35, 1.0)
    for _ in range(60):
        p = rng.uniform(low + 0.3, high - 0.3)
        p[2] = np.clip(rng.normal(1.1, 0.3), 0.3, high[2] - 0.3)
        away = float(world.clearance(p))
        if not 0.8 * wanted < away < 1.25 * wanted:
            continue
        towards = away - np.array([float(world.clearance(p + step)) for step in 0.05 * np.eye(3)[:2]])
        if np.linalg.norm(towards) < 0.025:  # the floor or the ceiling is nearest
            continue
        yaw = float(np.arctan2(towards[1], towards[0])) + float(rng.normal(0.0, 0.6))
        return look(p, yaw, float(np.clip(rng.normal(0.05, 0.12), -0.5, 0.5)), float(rng.normal(0.0, 0.06)))
    return None


def close_view(
    rng: Rng, camera: Camera, world: World, pose: Callable[[Rng, World], FloatArray | None]
) -> Rendered | None:
    """A view from `oblique_pose` or `near_pose` that is not filled by what is next to the lens; None without one."""
    for _ in range(TRIES):
        T_w_c = pose(rng, world)
        if T_w_c is None:
            return None
        if np.percentile(render(world, camera.scaled(40, 30), T_w_c, antialias=False).depth_m, 5) > NEAREST_M:
            return render(world, camera, T_w_c)
    return None


def _camera(focal_px: float) -> Camera:
    return Camera(WIDTH, HEIGHT, focal_px, focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def _log(rng: Rng, low: float, high: float) -> float:
    """Uniform in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
