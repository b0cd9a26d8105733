"""Poses that the drone's attitude or position contradicts: on a repetitive wall, corners match the neighbouring
repetition. (Corners on whole pixels; with sub-pixel alignment such mismatches are rare.)"""

from functools import lru_cache

import numpy as np
import pytest
from rendered import CAMERA, film, panels, patchwork

from edgeslam_torch.config import DepthConfig, MappingConfig, SlamConfig
from edgeslam_torch.estimation.dead_reckoning import Reckoned
from edgeslam_torch.estimation.output_frame import T_LEVEL
from edgeslam_torch.geometry import se3
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.house.world import Quad, Texture, World

PERIOD_M = 0.24
"""31 px of a wall 2 m away."""
STEPS_M = (0.15, 0.18)
"""Distance from one frame to the next, for three of them: 20 and 23 px."""
PICTURE_M = 0.6
DOUBT_M = 0.08
STEP_RAD = 0.09
"""Rotation from one frame to the next, for three of them: 23 px. When it ends, the neighbouring repetition is nearer to
the prediction."""


def papered(poses, picture_m=0.0):
    """A camera before a papered wall with a picture in its middle, at poses ``(4, 4)``."""
    across = 20
    paper = np.tile(patchwork(np.random.default_rng(5), 128, 40), (across, across, 1))
    side_m = across * PERIOD_M
    size = int(picture_m / side_m * len(paper))
    if size:
        begin = (len(paper) - size) // 2
        inside = slice(begin, begin + size)
        paper[inside, inside] = patchwork(np.random.default_rng(9), size, size * 40 // 128)
    u, v = np.array([side_m, 0.0, 0.0]), np.array([0.0, side_m, 0.0])
    world = World([Quad(np.array([-side_m / 2, -side_m / 2, 2.0]), u, v, Texture(paper))])
    return film(world, CAMERA, np.stack(poses), step_s=1 / 15)


def after_eleven(step):
    """Poses that move slowly sideways, with three larger steps ``(6,)`` after the eleventh, then stop."""
    poses = [se3.exp(np.array(step) * np.clip(k - 11, 0, 3)) for k in range(23)]
    for k, T in enumerate(poses):
        T[0, 3] += 0.01 * k
    return poses


@lru_cache(maxsize=1)
def wallpaper():
    """The camera turns."""
    return papered(after_eleven([0.0, 0.0, 0.0, 0.0, STEP_RAD, 0.0]))


@lru_cache(maxsize=2)
def passing(axis):
    """The camera jumps sideways (axis 0) or down (1), away from a picture by which it began."""
    step = np.zeros(6)
    step[axis] = -STEPS_M[axis]
    return papered(after_eleven(step), PICTURE_M)


def flown(flight, told=lambda stamp_s: None, place=lambda stamp_s: None):
    """Outputs of a flight with the given attitude and position measurements."""
    config = SlamConfig(depth=DepthConfig(weights="none"), mapping=MappingConfig(sub_pixel=False))
    slam = EdgeSlam(CAMERA, config, depth=flight.depth_function())
    slam._system.has_telemetry, slam._system.fusion.orientation.turned, slam._system.fusion.reckoned = True, told, place
    return [slam.step(frame) for frame in flight.frames]


def turned_wrongly_deg(told):
    """Rotation error of the last pose in front of the wallpaper."""
    flight = wallpaper()
    R_w_c = np.stack([out.T_w_c[:3, :3] for out in flown(flight, told)])
    relative = (R_w_c[0].T @ R_w_c[-1]).T @ flight.T_w_c[0, :3, :3].T @ flight.T_w_c[-1, :3, :3]
    return np.degrees(np.arccos(np.clip((np.trace(relative) - 1.0) / 2.0, -1.0, 1.0)))


def true_turn(stamp_s):
    """True attitude, in a map levelled to the first camera."""
    flight = wallpaper()
    k = int(np.argmin(np.abs(flight.stamps_s - stamp_s)))
    return (T_LEVEL[:3, :3] @ flight.T_w_c[0, :3, :3].T @ flight.T_w_c[k, :3, :3]).T, 0.0


def test_attitude_prevents_a_mismatch_on_a_repetitive_wall():
    assert turned_wrongly_deg(true_turn) < 2.0
    assert turned_wrongly_deg(lambda stamp_s: None) > 5.0


def true_centre(flight, k):
    """True camera centre of a frame in a map levelled to the first camera."""
    return (T_LEVEL @ se3.inverse(flight.T_w_c[0]) @ flight.T_w_c[k])[:3, 3]


def sensor_prediction(flight):
    """Dead-reckoned position of a frame's camera."""

    def place(stamp_s):
        k = int(np.argmin(np.abs(flight.stamps_s - stamp_s)))
        return Reckoned(np.eye(3), true_centre(flight, k), np.full(3, DOUBT_M))

    return place


@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_position_prevents_a_mismatch_on_a_repetitive_wall(axis):
    flight = passing(axis)
    held, alone = (flown(flight, place=place) for place in (sensor_prediction(flight), lambda stamp_s: None))
    true = true_centre(flight, len(flight.frames) - 1)
    assert np.abs(held[-1].T_w_c[:3, 3] - true).max() < 1.5 * DOUBT_M
    assert np.abs(alone[-1].T_w_c[:3, 3] - true).max() > 4.0 * DOUBT_M


def test_wrong_sensors_do_not_change_a_pose_that_images_confirm():
    flight = panels().first(16)
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 0.1, 0.1]))[:3, :3]
    place = Reckoned(np.eye(3), np.array([0.3, -0.5, 0.4]), np.full(3, DOUBT_M))
    untold = flown(flight)
    assert not untold[-1].reason
    for lied in (flown(flight, told=lambda stamp_s: (turn, 0.0)), flown(flight, place=lambda stamp_s: place)):
        assert [out.status for out in lied] == [out.status for out in untold]
        for a, b in zip(lied, untold, strict=True):
            np.testing.assert_allclose(a.T_w_c, b.T_w_c, atol=2e-3)
        assert "contradicted" in lied[-1].reason
