"""A pose that the drone's attitude denies: before a wall whose pattern repeats, images alone take any neighbour."""

from functools import lru_cache

import numpy as np
from rendered import CAMERA, film, patchwork, sideways, stairs_world

from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.house.world import Quad, Texture, World

PERIOD_M = 0.24
"""31 px of a wall 2 m away."""
STEP_RAD = 0.09
"""Turn from one frame to the next, for three of them: 23 px. When it ends, the neighbour is nearer to what is
expected."""


@lru_cache(maxsize=1)
def wallpaper():
    """A camera before a papered wall that creeps sideways, turns, and stops at once."""
    across = 20
    paper = np.tile(patchwork(np.random.default_rng(5), 128, 40), (across, across, 1))
    side_m = across * PERIOD_M
    u, v = np.array([side_m, 0.0, 0.0]), np.array([0.0, side_m, 0.0])
    world = World([Quad(np.array([-side_m / 2, -side_m / 2, 2.0]), u, v, Texture(paper))])
    poses = [se3.exp(np.array([0.0, 0.0, 0.0, 0.0, STEP_RAD * np.clip(k - 11, 0, 3), 0.0])) for k in range(23)]
    for k, T in enumerate(poses):
        T[0, 3] = 0.01 * k
    return film(world, CAMERA, np.stack(poses), step_s=1 / 15)


def flown(flight, told):
    """Outputs of a flight where attitude is ``told`` as a frame's."""
    slam = EdgeSlam(CAMERA, SlamConfig(depth=DepthConfig(weights="none")), depth=flight.depth_function())
    slam._system.has_telemetry, slam._system.fusion.turned = True, told
    return [slam.step(frame) for frame in flight.frames]


def turned_wrongly_deg(told):
    """How far the last pose before the wallpaper is turned from the true one."""
    flight = wallpaper()
    R_w_c = np.stack([out.T_w_c[:3, :3] for out in flown(flight, told)])
    relative = (R_w_c[0].T @ R_w_c[-1]).T @ flight.T_w_c[0, :3, :3].T @ flight.T_w_c[-1, :3, :3]
    return np.degrees(np.arccos(np.clip((np.trace(relative) - 1.0) / 2.0, -1.0, 1.0)))


def true_turn(stamp_s):
    """What attitude tells, in a map whose axes are those of the first camera turned upright."""
    flight = wallpaper()
    k = int(np.argmin(np.abs(flight.stamps_s - stamp_s)))
    first = se3.inverse(EdgeSlam(CAMERA)._system.motion.T_c_w)
    return (first[:3, :3] @ flight.T_w_c[0, :3, :3].T @ flight.T_w_c[k, :3, :3]).T, 0.0


def test_a_repeating_wall_is_no_turn_that_the_drone_has_not_made():
    assert turned_wrongly_deg(true_turn) < 2.0


def test_without_attitude_the_images_are_all_there_is():
    assert turned_wrongly_deg(lambda stamp_s: None) > 10.0


def test_attitude_that_lies_moves_no_pose_that_the_images_prove():
    flight = film(stairs_world(), CAMERA, sideways(16, 0.03, turn_rad=0.004), step_s=1 / 30)
    lie = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 0.1, 0.1]))[:3, :3]
    lied, untold = flown(flight, lambda stamp_s: (lie, 0.0)), flown(flight, lambda stamp_s: None)
    assert [out.status for out in lied] == [out.status for out in untold]
    for a, b in zip(lied, untold, strict=True):
        np.testing.assert_allclose(a.T_w_c, b.T_w_c, atol=2e-3)
