"""What is remembered in map units follows a map that grows."""

import numpy as np
import pytest
from point_map import check_map, filled

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.growth import depths, take_along


@pytest.fixture
def points(rng):
    return filled(rng, 400, 6)


def grow(points, factor):
    """The whole map, scaled about the first camera."""
    centre = points.keyframes[0].centre_w
    for keyframe in points.keyframes:
        T_w_c = keyframe.T_w_c
        T_w_c[:3, 3] = centre + factor * (T_w_c[:3, 3] - centre)
        keyframe.T_c_w = se3.inverse(T_w_c)
    points.map.anchors.p_w[:] = centre + factor * (points.map.anchors.p_w - centre)


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_anchors_are_expected_on_the_same_pyramid_level_and_depth(points, factor):
    anchors, host = points.map.anchors, points.keyframes[2]
    ids = host.anchor[host.anchor >= 0][:20]
    anchors.from_depth[ids] = True
    anchors.rest_on_prior(ids, host.id, host.centre_w, np.tile([0.5, 0.1], (len(ids), 1)))
    anchors.sigma[:] = 0.02
    far, before = anchors.max_distance.copy(), depths(points.map, points.keyframes)
    grow(points, factor)
    take_along(points.map, points.keyframes, before)
    seen = points.map.anchors_seen_by(points.keyframes)
    np.testing.assert_allclose(anchors.max_distance[seen], factor * far[seen], rtol=1e-9)
    points.map.refresh_anchors(seen)  # computes them from the keyframes
    np.testing.assert_allclose(anchors.max_distance[seen], factor * far[seen], rtol=1e-9)
    np.testing.assert_allclose(anchors.sigma[seen], 0.02 * factor)
    np.testing.assert_allclose(anchors.prior[ids], np.tile([0.5 / factor, 0.1 / factor], (len(ids), 1)))
    np.testing.assert_allclose(anchors.origin[ids], np.tile(host.centre_w, (len(ids), 1)))
    check_map(points.map)


def test_a_keyframe_with_few_anchors_gives_no_estimate(points):
    before = depths(points.map, points.keyframes[:1])
    held, z = before[0]
    far = points.map.anchors.max_distance.copy()
    grow(points, 2.0)
    take_along(points.map, points.keyframes[:1], {0: (held[:5], z[:5])})
    np.testing.assert_array_equal(points.map.anchors.max_distance, far)
