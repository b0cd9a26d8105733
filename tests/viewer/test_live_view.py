"""The live view while another thread maps."""

from types import SimpleNamespace

import numpy as np
from fake_slam import FakeSlam

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import DepthMap, Frame
from edgeslam_torch.viewer import live_view

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


class Screen:
    """Records what it is given to show."""

    def __init__(self, *_, **__):
        self.depth = []

    def step(self, output, image=None, features_uv=None, edges_uv=None, depth_m=None):
        self.depth.append(depth_m)

    def camera(self, camera):
        pass

    def map(self, cloud, entity="edges"):
        pass


class Measured:
    """A keyframe whose depth the mapping thread drops after the first read."""

    features = SimpleNamespace(uv=np.zeros((5, 2), np.float32))

    def __init__(self):
        self.looks = 0

    @property
    def depth(self):
        self.looks += 1
        flat = np.ones((48, 64), np.float32)
        return DepthMap(flat, flat) if self.looks == 1 else None


def test_depth_that_is_dropped_while_it_is_shown(monkeypatch):
    monkeypatch.setattr(live_view, "Viewer", Screen)
    view = live_view.LiveView("test", CAMERA, None)
    slam = FakeSlam()
    frame = Frame(0, 0.0, np.full((48, 64, 3), 9, np.uint8))
    output = slam.step(frame)
    monkeypatch.setattr(slam, "keyframes", lambda: [Measured()])
    view.on_frame(frame, output, slam)
    assert len(view._viewer.depth) == 1
