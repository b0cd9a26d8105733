"""The simulated places that the emulated drone flies in."""

from collections.abc import Callable

import numpy as np

from edgeslam_torch.drone.emulator.air import Air
from edgeslam_torch.drone.emulator.drone import DroneModel
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.world import MAX_LEVEL
from edgeslam_torch.synthetic.sites.build import place
from edgeslam_torch.synthetic.sites.site import Site
from edgeslam_torch.types import FloatArray

Paint = Callable[[FloatArray], np.ndarray]


def furnished_drone(
    seed: int, tilt_rad: float, size: tuple[int, int], battery: float = 1.0
) -> tuple[DroneModel, Paint, Camera]:
    """A drone on the floor of a seeded room, its renderer, and its camera; the arguments are those of `drone_at`."""
    rng = np.random.default_rng(seed)
    world = place("furnished_room", rng)
    low, high = world.bounds_w
    places = rng.uniform(low, high, (500, 3))
    places[:, 2] = low[2] + 0.9
    on_floor = world.floor_below(places) < low[2] + 0.05
    start = places[int(np.argmax(np.where(on_floor, world.clearance(places), -np.inf)))]
    middle = 0.5 * (low + high)
    yaw = float(np.arctan2(middle[1] - start[1], middle[0] - start[0]))
    T_room_w = np.eye(4)  # the drone's own world, fixed at power-on, in the room
    T_room_w[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T_room_w[:3, 3] = start[0], start[1], low[2]
    still = Site("room", seed, world, T_room_w, np.zeros(3), ())
    return drone_at(still, tilt_rad, size, battery)


def drone_at(
    site: Site,
    tilt_rad: float,
    size: tuple[int, int],
    battery: float = 1.0,
    air: Air | None = None,
    ready: bool = True,
) -> tuple[DroneModel, Paint, Camera]:
    """The same at the start of a named site.

    Args:
        site: Where to fly.
        tilt_rad: Downward tilt of the camera.
        size: Width and height that are painted [px]; the Tello's camera is scaled to it.
        battery: Charge in [0, 1].
        air: Wind and gusts; still air without it.
        ready: Prepare all textures at once; else each when it is first seen, which takes time between two pictures.
    """
    if ready:
        for quad in site.world.quads:
            quad.texture.level(MAX_LEVEL)
            quad.texture.level(MAX_LEVEL - 1)
    camera, T_b_c = PRESETS["tello"].scaled(*size), camera_on_body(tilt_rad)
    drone = DroneModel(battery=battery, air=air or Air())

    def paint(T_w_b: FloatArray) -> np.ndarray:
        T_w_c = site.T_site_w @ T_w_b @ T_b_c
        return render(site.painted(drone.clock_s), camera, T_w_c, antialias=False).image

    drone.clearance = lambda p_w: float(site.clearance(p_w[None], drone.clock_s)[0])
    return drone, paint, camera
