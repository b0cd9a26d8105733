"""Camera poses and views, and varied rooms to train depth on."""

import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.dressing import fits, furnish_wall, lamps_anywhere, rug
from edgeslam_torch.synthetic.house.pieces import build, drawn, furniture, stand
from edgeslam_torch.synthetic.house.render import Rendered, render
from edgeslam_torch.synthetic.house.scene import Place, Scene
from edgeslam_torch.synthetic.house.walls import SIDES, shell, side_of
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
CLOSE_UPS = 0.35
"""Share of random poses that look at the top of a table or shelf from near."""
TEXEL_M = 0.006
WALLS = ("plaster", "plaster", "plaster", "rough_plaster", "wallpaper", "concrete", "bricks", "tiles", "veneer")


def random_room(rng: Rng) -> World:
    """An indoor place of random size, layout, materials and light, for training depth."""
    if rng.random() < 0.12:
        length, width = rng.uniform(5.0, 12.0), rng.uniform(1.5, 2.8)
        size = np.array([length, width, rng.uniform(2.2, 3.2)])
    else:
        size = np.array([*np.exp(rng.uniform(np.log(2.3), np.log(8.5), 2)), rng.uniform(2.2, 3.4)])
        size[1] = min(size[1], 9.0)
    low, high = np.array([-size[0] / 2, -size[1] / 2, 0.0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    scene = shell(rng, low, high, TEXEL_M, walls=WALLS)
    lamps_anywhere(scene, rng)
    scene.ambient = float(rng.uniform(0.35, 0.85))
    scene.exposure = float(np.exp(rng.normal(-0.05, 0.22)))
    warmth = rng.normal(0.0, 0.1)
    scene.light_bgr = (float(np.exp(-warmth)), 1.0, float(np.exp(warmth)))
    density, pictures = float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.0, 0.8))
    for side in SIDES:
        place, length = side_of(low, high, side)
        furnish_wall(scene, place, length, rng, density=density, door=rng.random() < 0.35, pictures=pictures)
    for _ in range(int(rng.poisson(size[0] * size[1] / 14.0))):
        _in_the_middle(scene, rng)
    if rng.random() < 0.4:
        rug(scene, rng, rng.uniform(-0.2, 0.2) * size[0], rng.uniform(-0.2, 0.2) * size[1])
    if rng.random() < 0.25:
        build(scene, Place(0.0, -0.5 * size[1], 0.0), rng, "floating_clutter", width=size[0], depth=size[1])
    return scene.world("random room")


def _in_the_middle(scene: Scene, rng: Rng) -> None:
    """A table with chairs, cartons or any other piece, standing free, where there is room for it."""
    x, y = rng.uniform(scene.low_w[:2] + 0.5, scene.high_w[:2] - 0.5)
    place = Place(float(x), float(y), float(rng.uniform(-np.pi, np.pi)))
    kind = rng.random()
    if kind < 0.4:
        width, depth = float(rng.uniform(0.7, 1.6)), float(rng.uniform(0.6, 1.0))
        if fits(scene, place.at(0, -0.5), width, depth + 1.0):
            build(scene, place, rng, "table_and_chairs", width=width, depth=depth)
    elif kind < 0.7:
        if fits(scene, place.at(0, -0.4), 0.7, 0.8):
            build(scene, place, rng, "cartons")
    else:
        name = str(rng.choice(list(furniture())))
        width, depth = drawn(rng, name)
        if fits(scene, place, width, depth):
            stand(scene, place, rng, name, width, depth)


def look(p_w: FloatArray, yaw_rad: float, down_rad: float = 0.0, roll_rad: float = 0.0) -> FloatArray:
    """Pose ``T_w_c`` of a camera at ``p_w`` that looks along ``yaw``, tilted down, rolled clockwise."""
    cy, sy, cd, sd = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(down_rad), np.sin(down_rad)
    forward = np.array([cy * cd, sy * cd, -sd])
    right = np.array([sy, -cy, 0.0])
    down = np.cross(forward, right)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    T_w_c = np.eye(4)
    T_w_c[:3, :3] = np.stack([cr * right + sr * down, cr * down - sr * right, forward], axis=1)
    T_w_c[:3, 3] = p_w
    return T_w_c


def random_pose(rng: Rng, world: World) -> FloatArray:
    """A camera pose ``T_w_c`` in free space, 0.3 to 2.2 m high, mostly near level, at times steeply tilted."""
    low, high = world.bounds_w
    best, best_clearance = 0.5 * (low + high), -np.inf
    ceiling = min(2.2, high[2] - 0.25)
    if rng.random() < CLOSE_UPS:
        T_w_c = _close_up(rng, world, ceiling)
        if T_w_c is not None:
            return T_w_c
    for _ in range(40):
        margin = np.minimum(0.3, 0.25 * (high - low))
        p = rng.uniform(low + margin, high - margin)
        p[2] = np.clip(rng.normal(1.3, 0.4), 0.3, ceiling)
        clearance = float(world.clearance(p))
        if clearance > best_clearance:
            best, best_clearance = p, clearance
        if clearance > 0.3:
            break
    steep = rng.random() < 0.2
    yaw = rng.uniform(-np.pi, np.pi)
    pitch = rng.normal(0.15, 0.45 if steep else 0.18)  # positive looks down
    roll = rng.normal(0.0, 0.35 if steep else 0.06)
    return look(best, yaw, float(np.clip(pitch, -1.0, 1.3)), roll)


def _close_up(rng: Rng, world: World, ceiling_m: float) -> FloatArray | None:
    """A view of the top of some table, shelf or box from within arm's reach to two metres; None when none is free."""
    tops = [b for b in world.boxes if b.half_m[:2].max() > 0.15 and 0.3 < b.centre_w[2] + b.half_m[2] < 1.4]
    for _ in range(12 if tops else 0):
        box = tops[int(rng.integers(len(tops)))]
        target = box.centre_w + [*rng.uniform(-0.7, 0.7, 2) * box.half_m[:2], float(box.half_m[2])]
        yaw, distance = rng.uniform(-np.pi, np.pi), float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
        down = float(rng.uniform(0.1, 1.0))
        p = target - distance * np.array([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)])
        if 0.3 < p[2] < ceiling_m and world.clearance(p) > 0.2:
            aim = rng.normal(0.0, 0.12, 2)
            return look(p, yaw + aim[0], down + aim[1], float(rng.normal(0.0, 0.15)))
    return None


def random_view(rng: Rng, camera: Camera, world: World) -> Rendered:
    """An exact view from a sensible place of ``world``.

    A preview of 40 x 30 pixels rejects views of something nearer than arm's length.
    """
    small = camera.scaled(40, 30)
    for _ in range(12):
        T_w_c = random_pose(rng, world)
        depth = render(world, small, T_w_c, antialias=False).depth_m
        if np.percentile(depth, 10) > 0.35 and np.median(depth) > 0.7:
            break
    return render(world, camera, T_w_c)
