"""The whole SLAM by the loss modules."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import CAMERA, film, sideways, stairs_world

from edgeslam_torch.config import DepthConfig, SlamConfig, WindowConfig
from edgeslam_torch.optim import modules, window
from edgeslam_torch.slam import EdgeSlam


@pytest.mark.slow
def test_modules_reproduce_the_compiled_solvers_trajectory(monkeypatch):
    flown = film(stairs_world(), CAMERA, sideways(24, 0.04, turn_rad=0.006), step_s=1 / 15)
    # Every term takes part.
    terms = WindowConfig(
        edges_per_keyframe=100,
        in_flight_edges=60,
        in_flight="always",
        in_flight_losses=("alignment", "cycle", "angle"),
        angle="arms",
    )
    poses, used = [], []
    monkeypatch.setattr(window, "_modules", lambda: used.append(True) or modules)
    for solver in ("compiled", "modules"):
        config = SlamConfig(depth=DepthConfig(weights="none"), window=replace(terms, solver=solver))
        slam = EdgeSlam(CAMERA, config, depth=flown.depth_function())
        for frame in flown.frames:
            slam.step(frame)
        slam.finish()
        assert bool(used) is (solver == "modules")
        poses.append(slam.trajectory()[1])
    assert len(slam.map.keyframes) >= 4
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-6)
