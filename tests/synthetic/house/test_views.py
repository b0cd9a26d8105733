"""Poses, and random rooms to train depth on."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look, random_pose, random_room, random_view

CAMERA = Camera(80, 60, 65.0, 65.0, 39.5, 29.5)


def test_pose_looks_along_its_yaw_and_tilt():
    T_w_c = look(np.array([1.0, 2.0, 3.0]), np.pi / 2, 0.2)
    np.testing.assert_allclose(T_w_c[:3, 2], [0, np.cos(0.2), -np.sin(0.2)], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(T_w_c[:3, :3]), 1.0)
    assert T_w_c[2, 1] < 0  # image down is world down


@pytest.mark.slow
def test_random_rooms_are_closed_sensible_textured_and_the_same_for_a_seed():
    views = []
    for seed in (5, 6):
        rng = np.random.default_rng(seed)
        world = random_room(rng)
        pose = random_pose(rng, world)
        assert world.clearance(pose[:3, 3]) > 0
        views += [render(world, CAMERA, pose), random_view(rng, CAMERA, world)]
    depth = np.stack([v.depth_m for v in views])
    assert np.all(depth > 0.02), "a room has no holes"
    assert 0.9 < np.median(depth) < 4.0 and np.percentile(depth, 99) < 12.0
    assert np.mean([v.image.std() > 8 for v in views]) > 0.8
    rng = np.random.default_rng(6)
    world = random_room(rng)
    assert render(world, CAMERA, random_pose(rng, world)).image.tobytes() == views[2].image.tobytes()
