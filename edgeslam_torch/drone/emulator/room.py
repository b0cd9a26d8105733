"""The simulated room that the emulated drone flies in."""

from collections.abc import Callable

import numpy as np

from edgeslam_torch.drone.emulator.drone import DroneModel
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.house.render import picture
from edgeslam_torch.synthetic.house.rooms import room
from edgeslam_torch.synthetic.house.world import MAX_LEVEL, World
from edgeslam_torch.types import FloatArray

_MIN_AREA_M2 = 0.01
"""Smaller surfaces (handles, legs, cups) are left out: half the surfaces, a third of the painting time."""


def furnished_drone(
    seed: int, tilt_rad: float, size: tuple[int, int], battery: float = 1.0
) -> tuple[DroneModel, Callable[[FloatArray], np.ndarray], Camera]:
    """A drone on the floor of a seeded room, the function that paints what it sees, and its camera.

    Args:
        seed: Of room and place.
        tilt_rad: Downward tilt of the camera.
        size: Width and height that are painted [px]; the Tello's camera is scaled to it.
        battery: Charge in [0, 1].
    """
    rng = np.random.default_rng(seed)
    world = _plainer(room(rng))
    camera = PRESETS["tello"].scaled(*size)
    low, high = world.bounds_w
    places = rng.uniform(low, high, (500, 3))
    places[:, 2] = low[2] + 0.9
    on_floor = world.floor_below(places) < low[2] + 0.05
    start = places[int(np.argmax(np.where(on_floor, world.clearance(places), -np.inf)))]
    start[2] = low[2]
    middle = 0.5 * (low + high)
    yaw = float(np.arctan2(middle[1] - start[1], middle[0] - start[0]))
    T_room_w = np.eye(4)  # the drone's own world, fixed at power-on, in the room
    T_room_w[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T_room_w[:3, 3] = start
    T_b_c = camera_on_body(tilt_rad)

    def clearance(p_w: FloatArray) -> float:
        return float(world.clearance((T_room_w[:3, :3] @ p_w + T_room_w[:3, 3])[None])[0])

    def paint(T_w_b: FloatArray) -> np.ndarray:
        return picture(world, camera, T_room_w @ T_w_b @ T_b_c)

    return DroneModel(clearance=clearance, battery=battery), paint, camera


def _plainer(world: World) -> World:
    """A world fast enough for 30 frames per second: without its smallest surfaces, and with all texture levels
    precomputed, which would otherwise delay their first use by a tenth of a second."""
    quads = [q for q in world.quads if float(np.linalg.norm(np.cross(q.u_w, q.v_w))) > _MIN_AREA_M2]
    for quad in quads:
        quad.texture.level(MAX_LEVEL)
        quad.texture.level(MAX_LEVEL - 1)
    return World(quads, world.name, world.bounds_w, list(world.boxes), world.background)
