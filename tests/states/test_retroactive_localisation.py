"""Lost frames are localised backwards in time, only where the map supports them."""

from types import SimpleNamespace

import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, PointMap

from edgeslam_torch.config import OrbConfig, TrackingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.states.retroactive_localisation import Frames, place_lost_frames
from edgeslam_torch.tracking.tracker import Tracker, make_view
from edgeslam_torch.types import FrameFeatures

VIEW = 3


class Lost:
    """A map, and frames from one place in it."""

    def __init__(self, rng):
        self.rng = rng
        self.points = PointMap(rng, 2000, 6)
        self.points.fill()
        self.keyframe = self.points.keyframes[VIEW]
        self.placed = {}
        self.log = SimpleNamespace(replace=self._replace)
        self.tracker = Tracker(self.points.map, CAMERA, OrbConfig(), TrackingConfig())
        self.frames = Frames(maxlen=6)

    def _replace(self, poses, keyframes):
        assert keyframes == [self.keyframe]
        self.placed |= poses

    def keep(self, index, known=1.0):
        """A frame of which a share of the keypoints, spread over the image, matches the map."""
        seen = np.flatnonzero(self.points.world.visible[VIEW])
        features = self.points.features(VIEW, seen, 0.5 * self.rng.normal(size=(len(seen), 2)))
        strange = self.rng.random(len(seen)) >= known
        descriptors = features.descriptors.copy()
        descriptors[strange] = self.rng.integers(0, 256, (strange.sum(), 32), dtype=np.uint8)
        features = FrameFeatures(features.uv, features.octave, features.angle_rad, descriptors)
        self.frames.append((index, make_view(features, SCALE_FACTOR)))

    def place(self):
        held = self.keyframe.anchor[self.keyframe.anchor >= 0]
        T_c_w = self.points.world.T_c_w[VIEW]
        return place_lost_frames(self.frames, self.tracker, self.log, self.keyframe, T_c_w, held)


@pytest.fixture
def lost(rng):
    return Lost(rng)


def test_frames_are_localised_at_their_true_poses(lost):
    for index in (4, 5, 6):
        lost.keep(index)
    assert lost.place() == 3
    assert sorted(lost.placed) == [4, 5, 6]
    for T_c_w in lost.placed.values():
        assert np.linalg.norm(se3.log(T_c_w @ se3.inverse(lost.points.world.T_c_w[VIEW]))[:3]) < 0.03
    assert lost.place() == 0, "each loss is processed once"


@pytest.mark.parametrize("share", [0.08, 0.0])
def test_the_search_continues_after_one_failure_and_ends_after_two(lost, share):
    """Of 2000 anchors 8 % agree: enough keypoints for a pose, too few to accept it."""
    for index, known in enumerate((1.0, share, share, 1.0, share, 1.0)):
        lost.keep(index, known)
    assert lost.place() == 2
    assert sorted(lost.placed) == [3, 5]
