"""The refinement of the whole map with its edges, for every setting."""

import numpy as np
import pytest
from flown import flown, true_poses
from point_map import check_map
from rendered import CAMERA

from edgeslam_torch.config import WindowConfig
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping import refinement
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.last_refinement import last_refinement, lm_config
from edgeslam_torch.mapping.motion_terms import MotionFactors
from edgeslam_torch.optim.problem import StopReason, WindowResult

POINTS = WindowConfig(alignment=False, cycle="off")
FORMS = {
    "default": WindowConfig(),
    "corners": WindowConfig(angle="arms", collinearity="relative"),
    "fixed weights": WindowConfig(adaptive=False),
    "no alignment": WindowConfig(alignment=False),
    "no cycle": WindowConfig(cycle="off"),
    "no reprojection": WindowConfig(reprojection="off"),
    "literal cycle": WindowConfig(cycle="literal"),
    "literal corners": WindowConfig(angle="literal", collinearity="literal"),
    "cosines": WindowConfig(angle="cosine", collinearity="off"),
    "literal reprojection": WindowConfig(reprojection="literal"),
}


def finish(config: WindowConfig) -> tuple[SlamMap, EdgeMap, TrajectoryLog, WindowResult]:
    slam_map, edges, log = flown()
    result = last_refinement(slam_map, CAMERA, edges, config)
    assert result is not None
    return slam_map, edges, log, result


def ate(log: TrajectoryLog) -> float:
    T_w_c, truth = log.poses()[1], true_poses()
    aligned = umeyama(T_w_c[:, :3, 3], truth[:, :3, 3]).points(T_w_c[:, :3, 3])
    return float(np.sqrt(np.square(aligned - truth[:, :3, 3]).sum(1).mean()))


@pytest.mark.parametrize("name", FORMS)
def test_every_form_gives_a_valid_map(name):
    slam_map, edges, log, result = finish(FORMS[name])
    check_map(slam_map)
    assert result.cost_after <= result.cost_before
    assert np.isfinite(log.poses()[1]).all()
    assert all(np.isfinite(h.p_c).all() and (h.p_c[:, 2] > 0).all() for h in edges.hosts)
    assert ate(log) < 0.02  # of 0.9 m


def test_edges_are_refined_and_their_depths_written_back():
    _, before, _, points = finish(POINTS)
    _, after, _, both = finish(WindowConfig())
    assert len(points.edge_inverse_depth) == 0
    assert len(both.edge_inverse_depth) > 500
    depths = [np.concatenate([h.p_c[:, 2] for h in e.hosts]) for e in (before, after)]
    moved = np.abs(depths[1] / depths[0] - 1.0)
    assert 0.05 < np.mean(moved > 0) <= 1.0
    assert np.median(moved[moved > 0]) < 0.03


def test_edges_measured_with_wrong_poses_are_measured_again():
    """Half as far as the anchors of that time had them, and these have moved since: no common factor mends that."""
    slam_map, edges, log = flown()
    for host in edges.hosts[::2]:
        host.grow(0.8)
        host.p_c *= 0.5
    last_refinement(slam_map, CAMERA, edges, WindowConfig())
    _, right, _, _ = finish(WindowConfig())
    median = {h.keyframe_id: np.median(h.p_c[:, 2]) for h in right.hosts}
    for host in edges.hosts:
        assert np.median(host.p_c[:, 2]) == pytest.approx(median[host.keyframe_id], rel=0.02)
        assert host.observations.max() > 1
    assert ate(log) < 0.02


def test_without_reprojection_anchors_are_unchanged():
    start, _, _ = flown()
    slam_map, _, _, _ = finish(FORMS["no reprojection"])
    np.testing.assert_allclose(slam_map.anchors.p_w, start.anchors.p_w, rtol=0, atol=1e-12)


def test_a_non_finite_anchor_skips_the_refinement_and_preserves_the_map():
    slam_map, edges, log = flown()
    held = int(slam_map.latest().anchor.max())
    slam_map.anchors.p_w[held] = np.nan
    before = log.poses()[1]
    assert last_refinement(slam_map, CAMERA, edges, WindowConfig()).stop is StopReason.NOT_FINITE
    check_map(slam_map)
    np.testing.assert_allclose(log.poses()[1], before, atol=1e-12)
    assert len(slam_map.anchors) > 300


def test_the_last_refinement_uses_the_full_weight_of_telemetry(monkeypatch):
    """Thirty times, as in flight, bends what is straight."""
    flown()
    asked = []

    def factors(model, keyframes, piece, doubt, effective_samples):
        asked.append(effective_samples)
        return MotionFactors()

    monkeypatch.setattr(refinement, "motion_factors", factors)
    finish(WindowConfig())
    assert set(asked) == {1.0}


def test_forms_of_the_terms_in_flight():
    assert lm_config(WindowConfig()).robust
    assert not lm_config(WindowConfig(reprojection="literal")).robust
    assert lm_config(WindowConfig(reprojection="off")).max_iterations == 0


def test_an_unknown_form_is_rejected():
    with pytest.raises(ValueError, match="cycle must be one of relative, literal, off, got 'pixels'"):
        WindowConfig(cycle="pixels")
