"""What is seen in a mirror is not there, and the mirror is."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.synthetic.sites.mirror import REFLECTION, mirrored

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)


def test_a_mirror_shows_what_is_behind_the_camera_twice_as_far_as_the_mirror():
    plain = named_site("l_corridor", 2).world
    world = mirrored(plain)
    wall = plain.bounds_w[1, 0]
    x = wall - 1.5
    seen = render(world, CAMERA, look(np.array([x, 0.1, 1.3]), 0.0), antialias=False)
    turned = render(plain, CAMERA, look(np.array([x, 0.1, 1.3]), np.pi), antialias=False)
    # The mirror's picture is the view from behind it, left and right exchanged; far walls are seen at 1.5 + 1.5 + x.
    assert seen.depth_m[30, 40] == pytest.approx(2 * 1.5 + turned.depth_m[30, 40], abs=0.01)
    assert seen.depth_m[30, 40] == pytest.approx(2 * 1.5 + x, abs=0.01)
    assert world.quads[seen.quad_id[30, 40]].name == REFLECTION
