"""What is given out of the anchors."""

import numpy as np
import pytest

from edgeslam_torch.map.anchors import Anchors


def anchors(observations, from_depth):
    """Anchors 4 units away along z."""
    out = Anchors()
    count = len(observations)
    p_w = np.tile([0.0, 0.0, 4.0], (count, 1))
    ids = out.add(p_w, np.zeros((count, 4), np.uint64), 0, False, np.zeros((count, 3), np.uint8))
    out.sigma[ids] = 0.1
    out.observations[ids] = observations
    on_prior = ids[np.array(from_depth)]
    out.from_depth[on_prior] = True
    out.rest_on_prior(on_prior, 0, np.zeros(3), np.tile([0.25, 0.2], (len(on_prior), 1)))
    return out, ids


def test_exported_anchors_with_depth_priors_have_the_sigma_of_the_prior():
    some, ids = anchors([3, 3], [False, True])
    cloud = some.cloud(ids)
    assert cloud.sigma_m == pytest.approx([0.1, 0.8 * 4.0])
    assert cloud.observations.tolist() == [3, 3]


def test_anchors_of_a_single_keyframe_are_not_exported():
    some, ids = anchors([1, 2, 1], [True, True, False])
    assert len(some.cloud(ids).p_w) == 1
