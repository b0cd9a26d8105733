"""Edges of one picture against views around it: near and far without a prior, nothing where a camera has turned."""

from functools import lru_cache

import cv2
import numpy as np
from rendered import CAMERA, film, patchwork, sideways

from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.edges.edge_depth import StereoView
from edgeslam_torch.mapping.edges.fresh_edges import SIGMA_LOG, measure_fresh_edges
from edgeslam_torch.synthetic.house.world import Quad, Texture, World

NEAR_M, FAR_M = 0.7, 3.0


@lru_cache(maxsize=1)
def board_before_a_wall():
    """A plain dark board .7 m away before a wall of patches at 3 m, seen from five places 5 cm apart."""
    rng = np.random.default_rng(7)
    plain = np.full((64, 64, 3), 25, np.uint8)
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    wall = Quad(np.array([-4.0, -4.0, FAR_M]), 8.0 * right, 8.0 * down, Texture(patchwork(rng, patches=250)))
    board = Quad(np.array([-0.1, -0.15, NEAR_M]), 0.25 * right, 0.3 * down, Texture(plain))
    return film(World([wall, board]), CAMERA, sideways(5, 0.05))


def stereo(flight, poses=None):
    return [
        StereoView(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), se3.inverse(T_w_c))
        for frame, T_w_c in zip(flight.frames, flight.T_w_c if poses is None else poses, strict=True)
    ]


def measured(views, around=(0, 1, 2, 3), nearest=0.3, farthest=6.0):
    """Pixels and depths of the last picture's edges."""
    edges = extract_edges(board_before_a_wall().frames[4].image, 40.0, 100.0, 800)
    return measure_fresh_edges(views[4], edges, [views[k] for k in around], nearest, farthest, CAMERA)


def truth(uv):
    """Nearest depth within two pixels: an edge is of the nearer of what it parts."""
    nearest = cv2.erode(board_before_a_wall().depth_m[4], np.ones((5, 5), np.uint8))
    u, v = np.rint(uv).astype(int).T
    return nearest[v, u]


def test_near_and_far_depths_are_measured_without_a_prior():
    uv, z = measured(stereo(board_before_a_wall()))
    true = truth(uv)
    near = true < 1.0
    assert near.sum() > 30
    assert (~near).sum() > 100
    assert np.mean(np.abs(np.log(z / true)[near]) < 0.05) > 0.9
    assert np.mean(np.abs(np.log(z / true)[~near]) < 0.1) > 0.9


def test_depth_is_in_the_unit_of_the_poses():
    flight = board_before_a_wall()
    larger = flight.T_w_c.copy()
    larger[:, :3, 3] *= 3.0
    uv, z = measured(stereo(flight))
    again, tripled = measured(stereo(flight, larger), nearest=0.9, farthest=18.0)
    np.testing.assert_array_equal(uv, again)
    np.testing.assert_allclose(tripled, 3.0 * z, rtol=1e-3)


def test_depths_outside_the_bounds_are_not_measured():
    _, z = measured(stereo(board_before_a_wall()), nearest=1.5)
    assert (z > 1.4).all()


def test_a_rotation_gives_no_depth():
    flight = board_before_a_wall()
    on_the_spot = np.repeat(flight.T_w_c[4:], 5, axis=0)
    assert len(measured(stereo(flight, on_the_spot))[1]) == 0


def test_views_without_baseline_do_not_displace_others():
    alone, _ = measured(stereo(board_before_a_wall()))
    crowded, _ = measured(stereo(board_before_a_wall()), (4, 4, 4, 4, 0, 1, 2, 3))
    np.testing.assert_array_equal(alone, crowded)


def test_a_view_with_a_long_baseline_is_not_used():
    """From .5 to 2 m the longest baseline is .19 m: the first of these views is .2 m away, the second .15."""
    assert len(measured(stereo(board_before_a_wall()), (0,), nearest=0.5, farthest=2.0)[1]) == 0
    assert len(measured(stereo(board_before_a_wall()), (1,), nearest=0.5, farthest=2.0)[1]) > 10


def test_depths_with_a_large_sigma_are_omitted():
    """Over 5 cm the wall at 3 m is 4.3 px from where it would be infinitely far away: half of one is more than 10 %."""
    _, z = measured(stereo(board_before_a_wall()), (3,))
    assert len(z) > 30
    assert z.max() < SIGMA_LOG * CAMERA.fx * 0.05 / 0.5
