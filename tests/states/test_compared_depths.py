"""Network-to-map depth ratios follow a change of the submap's scale."""

from types import SimpleNamespace

import numpy as np
import pytest
from point_map import PointMap

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.geometry import se3
from edgeslam_torch.states.system import System

METRES = 2.5
"""Network metres per map unit."""


def test_depth_ratios_are_recomputed_after_a_change_of_scale(rng):
    """The current submap grows by three; another submap with its own scale is left out."""
    points = PointMap(rng, 300, 6)
    points.fill()
    for view, keyframe in enumerate(points.keyframes):
        z = se3.transform(keyframe.T_c_w, points.world.p_w[points.point_of[view]])[:, 2]
        keyframe.network_m = METRES * z * (1.0 if view >= 2 else 7.0)
    points.map.piece_of = lambda id: int(id >= 2)
    fusion = MotionFusion(FusionConfig(), np.eye(4))
    system = SimpleNamespace(map=points.map, fusion=fusion)
    system._depth_ratio = lambda keyframe: System._depth_ratio(system, keyframe)
    for keyframe in points.keyframes[2:]:
        System.compare_depth(system, keyframe)
    assert fusion.scale().value == pytest.approx(METRES, rel=1e-3)
    points.map.anchors.p_w *= 3.0
    for keyframe in points.keyframes:
        keyframe.T_c_w[:3, 3] *= 3.0
    System.compare_depths_again(system)
    assert fusion.scale().value == pytest.approx(METRES / 3.0, rel=1e-3)
