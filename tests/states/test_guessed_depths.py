"""Depths that a piece of map begins with."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.fusion.output_frame import OutputFrame
from edgeslam_torch.states.starting import Starting
from edgeslam_torch.types import DepthMap


def guessed(network_unit, published, depth_m=3.0):
    """Depth [map units] of the keypoints of a picture that the network says is this far away, in a flight so far."""
    depth = DepthMap(np.full((24, 32), depth_m, np.float32), np.full((24, 32), 0.2, np.float32))
    keyframe = SimpleNamespace(depth=depth, features=SimpleNamespace(uv=np.array([[5.0, 6.0], [20.0, 12.0]])))
    fusion = SimpleNamespace(metres=SimpleNamespace(network_unit=lambda: network_unit))
    system = SimpleNamespace(config=SlamConfig(), fusion=fusion, published=OutputFrame(published))
    starting = Starting.__new__(Starting)
    starting.system = system
    return starting._guess_depth(keyframe)[:, 0]


@pytest.mark.parametrize(
    ("network_unit", "published", "expected"),
    [
        (None, 1.0, 3.0),  # the first piece: the network's metres are the unit
        (0.6, 0.9, 5.0),  # the network is a third short here; what is 5 units away it has told at 3 m before
        (None, 0.5, 6.0),
    ],
)
def test_a_new_piece_has_the_unit_in_which_the_network_told_the_one_before(network_unit, published, expected):
    np.testing.assert_allclose(guessed(network_unit, published), expected, rtol=1e-6)
