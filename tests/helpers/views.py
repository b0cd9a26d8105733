"""Depth maps as a pilot is told of them."""

import numpy as np

from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import View
from edgeslam_torch.navigation.map_views import MapUpdate

K = np.array([[77.0, 0.0, 39.5], [0.0, 77.0, 29.5], [0.0, 0.0, 1.0]])


def facing_a_wall(distance_m=2.0, sigma=0.01, x=0.0, yaw=0.0, height_m=1.15, picture=0, stamp_s=0.0):
    """A level camera that sees a wall across its optical axis."""
    T = camera_on_body(0.0, 0.0)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T = turn @ T
    T[:3, 3] = [x, 0.0, height_m]
    depth = np.full((60, 80), distance_m, np.float32)
    return View(stamp_s, depth, np.full((60, 80), sigma, np.float32), K, T, picture)


def longer(ratio):
    """A correction that makes all lengths longer about the take-off."""
    return MapUpdate(np.zeros(0, int), np.zeros((0, 4, 4)), ratio)


def moved(picture, T_w_c, ratio=1.0):
    """A correction after which a view has this pose."""
    return MapUpdate(np.array([picture]), T_w_c[None], ratio)
