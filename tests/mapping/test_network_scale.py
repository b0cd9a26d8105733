"""The depth network against drift of the map's scale."""

import numpy as np
import pytest
from point_map import CAMERA, PointMap

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import NetworkView
from edgeslam_torch.mapping.network_scale import network_line, network_priors, network_view
from edgeslam_torch.mapping.refinement import Window, refine
from edgeslam_torch.optim.problem import LmConfig

METRES = 2.5
"""Network metres per map unit."""


@pytest.fixture
def points(rng):
    """Eight keyframes with exact anchors, and a network that is right but for its unit."""
    points = PointMap(rng, 400, 8)
    points.fill()
    for view, keyframe in enumerate(points.keyframes):
        z = se3.transform(keyframe.T_c_w, points.world.p_w[points.point_of[view]])[:, 2]
        keyframe.network_m = METRES * z
        keyframe.network_view = network_view(points.map, keyframe)
    return points


def anchors_of(points):
    return points.map.anchors_seen_by(points.keyframes)


def depth_of(points, priors):
    """Depth of the priors' anchors in their hosts as the map has it ``(D,)``."""
    p_w = points.map.anchors.p_w[anchors_of(points)[priors.anchor]]
    T = np.stack([k.T_c_w for k in points.keyframes])[priors.pose]
    return (np.einsum("dij,dj->di", T[:, :3, :3], p_w) + T[:, :3, 3])[:, 2]


def leave_alone(points):
    """The last two keyframes keep only what no other keyframe sees, so that nothing else knows its scale."""
    a, b = points.keyframes[-2:]
    others = np.unique(np.concatenate([k.anchor[k.anchor >= 0] for k in points.keyframes[:-2]]))
    shared = np.intersect1d(a.anchor[a.anchor >= 0], b.anchor[b.anchor >= 0])
    for keyframe in points.keyframes[:-2]:
        points.map.forget_observations(keyframe, np.flatnonzero(np.isin(keyframe.anchor, shared[::2])))
    for keyframe in (a, b):
        kept = np.isin(keyframe.anchor, shared[::2])
        points.map.forget_observations(keyframe, np.flatnonzero((keyframe.anchor >= 0) & ~kept))
    assert len(others) > 0
    return a, b, shared[::2]


def test_a_map_without_drift_is_pulled_nowhere(points):
    priors = network_priors(points.map, anchors_of(points), points.keyframes)
    np.testing.assert_allclose(priors.inverse_depth, 1.0 / depth_of(points, priors), rtol=1e-6)
    assert len(np.unique(priors.anchor)) == len(priors.anchor), "an anchor is pulled once"


def test_all_anchors_of_a_keyframe_together_are_one_measurement(points):
    """A tenth of depth for a network with slope 1: the information of a common factor sums up to 1 / 0.1^2."""
    held = points.keyframes[0].anchor[points.keyframes[0].anchor >= 0]
    priors = network_priors(points.map, held, points.keyframes[:1])
    z = 1.0 / priors.inverse_depth
    assert np.sum(1.0 / (priors.sigma * z) ** 2) == pytest.approx(1.0 / 0.1**2, rel=1e-6)


@pytest.mark.parametrize("drift", [0.85, 1.15])
def test_a_keyframe_whose_depths_have_drifted_goes_back(points, drift):
    a, b, alone = leave_alone(points)
    centre = a.centre_w
    points.map.anchors.p_w[alone] = centre + drift * (points.map.anchors.p_w[alone] - centre)
    moved = b.T_w_c
    moved[:3, 3] = centre + drift * (moved[:3, 3] - centre)
    b.T_c_w = se3.inverse(moved)
    true_way = np.linalg.norm(points.world.T_c_w[-1][:3, :3].T @ points.world.T_c_w[-1][:3, 3] + centre)
    window = Window([b], points.keyframes[:-1], points.map.anchors_seen_by([b]))
    refine(points.map, window, CAMERA, LmConfig(max_iterations=30))
    assert np.linalg.norm(b.centre_w - centre) == pytest.approx(true_way, rel=0.01)


def views(slope, constant=0.4, spread=0.0):
    log_map = np.linspace(0.0, 1.5, 20)
    off = spread * (-1.0) ** np.arange(20)
    return [NetworkView(constant + slope * z + e, z, slope, 1.0) for z, e in zip(log_map, off, strict=True)]


def test_the_line_is_found_and_asks_for_what_is_missing():
    line = network_line(views(0.5, spread=0.05))
    assert (line.slope, line.constant) == (pytest.approx(0.5), pytest.approx(0.4, abs=0.06))
    line = network_line(views(0.5))
    # The network says 0.05 more than at this depth: with half a slope, the map is 0.1 too near.
    assert line.excess(NetworkView(0.4 + 0.5 * 1.0 + 0.05, 1.0, 0.5, 1.0)) == pytest.approx(0.1)
    assert line.sigma_log == pytest.approx(0.2)
    assert line.excess(NetworkView(0.4 + 0.5 * 1.0 - 9.0, 1.0, 0.5, 1.0)) == pytest.approx(-0.4), "two sigmas at most"


def test_a_network_that_says_the_same_of_everything_has_no_say():
    assert network_line(views(0.02)) is None
    assert network_line(views(0.9)[:4]) is None, "four keyframes are no line"


def test_pieces_of_other_units_do_not_draw_the_line(points):
    """Half of the keyframes belong to a piece that is three times as large: the others are pulled nowhere."""
    other = [k.id for k in points.keyframes[4:]]
    points.map.piece_of = lambda id: int(id in other)
    for keyframe in points.keyframes[4:]:
        keyframe.scale(3.0)
    for keyframe in points.keyframes[:4]:
        keyframe.network_view = None
    assert network_priors(points.map, anchors_of(points), points.keyframes[:4]) is None, "four keyframes are no line"
