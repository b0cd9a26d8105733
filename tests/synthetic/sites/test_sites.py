"""Named sites: free where they say so, solid where something is seen."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.sites.build import JUDGED, SITES, named_site
from edgeslam_torch.synthetic.sites.obstacles import PASSAGE_M

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)
QUICK = ("blank_walls", "corridor", "l_corridor", "t_corridor", "glass")


def looking(T_w_c_site, yaw):
    """Level camera in the site's axes."""
    T = np.eye(4)
    T[:3, :3] = np.array([[np.sin(yaw), 0, np.cos(yaw)], [-np.cos(yaw), 0, np.sin(yaw)], [0, -1, 0]])
    T[:3, 3] = T_w_c_site
    return T


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize("seed", [3])
def test_start_and_goal_are_free_and_the_same_seed_gives_the_same_site(name, seed):
    site = named_site(name, seed)
    above = np.array([[0.0, 0.0, z] for z in np.linspace(0.1, 1.2, 12)])
    assert site.clearance(above).min() > PASSAGE_M - 0.1
    assert site.clearance(site.goal_w[None])[0] > PASSAGE_M - 0.1
    again = named_site(name, seed)
    np.testing.assert_array_equal(again.goal_w, site.goal_w)
    assert len(again.world.quads) == len(site.world.quads)


@pytest.mark.slow
@pytest.mark.parametrize("name", JUDGED)
def test_seeds_of_a_judged_site_can_be_built(name):
    for seed in range(6):
        site = named_site(name, seed)
        assert site.clearance(site.goal_w[None])[0] > PASSAGE_M - 0.1


@pytest.mark.parametrize("name", ["blank_walls", "l_corridor"])
def test_what_a_camera_sees_can_be_hit(name):
    """Rays to seen surfaces end within a centimetre of a solid: the renderer and the judge agree."""
    site = named_site(name, 1)
    p = site.in_site(np.array([1.0, 0.1, 1.1]))
    for yaw in (0.0, 1.3, 2.6):
        T_w_c = looking(p, yaw)
        depth = render(site.world, CAMERA, T_w_c, antialias=False).depth_m
        v, u = np.mgrid[2:60:9, 2:80:9]
        z = depth[v, u].ravel()
        rays = np.stack([(u.ravel() - CAMERA.cx) / CAMERA.fx, (v.ravel() - CAMERA.cy) / CAMERA.fy, np.ones(u.size)], 1)
        hits = (z[:, None] * rays) @ T_w_c[:3, :3].T + T_w_c[:3, 3]
        above_floor = hits[:, 2] > 0.05
        assert site.solids.distance(hits[above_floor]).max() < 0.01


def test_an_exit_is_open_and_its_frame_is_not():
    site = named_site("blank_walls", 2)
    (way_out,) = site.exits
    across = np.array([-way_out.normal_w[1], way_out.normal_w[0], 0.0])
    assert site.clearance(way_out.centre_w[None])[0] == pytest.approx(0.5 * way_out.width_m, abs=0.01)
    beside = way_out.centre_w + (0.5 * way_out.width_m + 0.02) * across
    assert site.clearance(beside[None])[0] < 0.03


def test_glass_is_hit_and_not_seen():
    site = named_site("glass", 0)
    pane = site.solids
    without = named_site("glass", 0).world.boxes
    xs = np.linspace(5.0, 7.0, 201)
    for side in (-0.6, 0.6):
        line = np.stack([xs, np.full(201, side), np.full(201, 1.5)], axis=1)
        seen = np.min([box.distance(line) for box in without], axis=0)
        if pane.distance(line).min() == 0 and seen.min() > 0.05:
            return
    pytest.fail("no pane is in the way")


def test_unknown_names_and_negative_seeds_are_refused():
    with pytest.raises(ValueError, match="l_corridor"):
        named_site("moon", 0)
    with pytest.raises(ValueError, match="at least 0"):
        named_site("corridor", -1)
    assert set(JUDGED) <= set(SITES)
