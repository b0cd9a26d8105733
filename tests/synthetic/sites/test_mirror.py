"""What is seen in a mirror is not there, and the mirror is."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look
from edgeslam_torch.synthetic.house.world import Quad, Texture, World
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.synthetic.sites.mirror import REFLECTION, mirrored

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)


def test_a_mirror_shows_what_is_behind_the_camera_twice_as_far_as_the_mirror():
    left, right = (Texture(np.full((4, 4, 3), grey, np.uint8)) for grey in (50, 200))
    down = np.array([0.0, 0.0, -3.0])
    behind = [
        Quad(np.array([0.0, y, 3.0]), np.array([0.0, 3.0, 0.0]), down, t) for y, t in ((0.0, left), (-3.0, right))
    ]
    mirror = Quad(np.array([4.0, 3.0, 3.0]), np.array([0.0, -6.0, 0.0]), down, left)
    world = mirrored(World([*behind, mirror], bounds_w=np.array([[0.0, -3.0, 0.0], [4.0, 3.0, 3.0]])))
    seen = render(world, CAMERA, look(np.array([2.5, 0.0, 1.5]), 0.0), antialias=False)
    assert seen.depth_m[30, 40] == pytest.approx(2 * 1.5 + 2.5)
    assert world.quads[seen.quad_id[30, 40]].name == REFLECTION
    assert seen.image[30, [25, 55], 0].tolist() == [50, 200], "left stays left"
    line = np.array([[4.0 - away, 0.0, 1.5] for away in (1.0, 0.5, 0.0)])
    np.testing.assert_allclose(world.distance_to_solid(line), [1.0, 0.5, 0.0], atol=1e-9)


def test_a_mirror_is_hit_and_what_it_shows_is_not():
    site = named_site("mirror", 0)
    wall = float(site.world.bounds_w[1, 0])
    line = np.array([[wall - away, 0.0, 1.3] for away in (1.0, 0.5, 0.0)])
    np.testing.assert_allclose(site.world.distance_to_solid(line), [1.0, 0.5, 0.0], atol=0.02)
