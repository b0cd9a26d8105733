"""Depths with which a submap begins."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.states.starting import Starting
from edgeslam_torch.types import DepthMap


def guessed(network_unit, published, depth_m=3.0):
    """Initial depth [map units] of keypoints that the network puts at this distance."""
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
        (None, 1.0, 3.0),  # the first submap: the network's metres set the scale
        (0.6, 0.9, 5.0),  # the network underestimates here: 5 units were 3 m before
        (None, 0.5, 6.0),
    ],
)
def test_a_new_submap_inherits_the_network_scale_of_the_previous_one(network_unit, published, expected):
    np.testing.assert_allclose(guessed(network_unit, published), expected, rtol=1e-6)
