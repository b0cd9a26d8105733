"""Edges in the windows while flying: where they take part, whose edges, and what comes back."""

from dataclasses import replace

import numpy as np
import pytest
from flown import flown
from rendered import CAMERA

from edgeslam_torch.config import WindowConfig
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.refinement import choose_window, refine, window_problem
from edgeslam_torch.mapping.window_edges import FEW_ANCHORS, WindowEdges, term_config
from edgeslam_torch.optim.problem import LmConfig

ALWAYS = WindowConfig(in_flight="always")


def flying(edges: EdgeMap, config: WindowConfig = ALWAYS) -> WindowEdges:
    terms = config.flying
    assert terms is not None
    return WindowEdges(edges, CAMERA, terms, flying=True)


def test_edges_are_used_with_few_corners():
    slam_map, edges, _ = flown()
    rich = slam_map.latest()
    assert np.count_nonzero(rich.anchor >= 0) >= FEW_ANCHORS
    assert not rich.features.faint
    few = flying(edges, WindowConfig(in_flight="few"))
    assert flying(edges).wanted(rich)
    assert not few.wanted(rich)
    assert few.wanted(replace(rich, features=replace(rich.features, faint=True)))
    assert few.wanted(replace(rich, anchor=np.full_like(rich.anchor, -1)))
    assert WindowConfig(in_flight="off").flying is None


def test_free_keyframes_have_edges_and_unmeasured_ones_are_targets():
    slam_map, edges, _ = flown()
    window = choose_window(slam_map, slam_map.latest(), 4, 15)
    keyframes = [*window.free, *window.fixed]
    measured = {h.keyframe_id for h in edges.hosts}
    assert slam_map.latest().id not in measured
    problem, _ = window_problem(slam_map, window, CAMERA, LmConfig())
    terms = flying(edges).place(problem, keyframes).problem.edges
    assert terms is not None
    hosts = {keyframes[pose].id for pose in terms.host}
    assert hosts
    assert hosts <= measured & {k.id for k in window.free}
    partners = {keyframes[pose].id for pose in terms.pair_pose}
    assert partners - measured, "the newest keyframes' edges were not used"
    unmeasured = np.array([keyframes[pose].id not in measured for pose in terms.pair_pose])
    assert (terms.pair_inverse_depth[unmeasured] == 0).all()  # no depth there, so no cycle
    assert (terms.pair_inverse_depth[~unmeasured] > 0).all()
    assert np.bincount(terms.host).max() <= ALWAYS.in_flight_edges


def test_a_disturbed_pose_is_recovered_by_edges_alone():
    left = []
    for axis, by in ((0, 0.01), (0, -0.01), (1, 0.01), (1, -0.01)):
        slam_map, edges, _ = flown()
        window = choose_window(slam_map, slam_map.latest(), 4, 15)
        moved = next(k for k in window.free if k.id in {h.keyframe_id for h in edges.hosts})
        true = moved.T_c_w.copy()
        moved.T_c_w = true.copy()
        moved.T_c_w[axis, 3] += by
        for keyframe in window.free:
            keyframe.anchor[:] = -1
        window = replace(window, anchor=window.anchor[:0])
        assert refine(slam_map, window, CAMERA, LmConfig(max_iterations=20)) is None
        result = refine(slam_map, window, CAMERA, LmConfig(max_iterations=20), edges=flying(edges))
        assert result is not None
        assert len(result.edge_inverse_depth) > 100
        left.append(np.linalg.norm(moved.T_c_w[:3, 3] - true[:3, 3]))
    assert np.median(left) < 0.005 and max(left) < 0.007


@pytest.mark.parametrize(
    ("losses", "alignment", "cycle", "angle", "collinearity"),
    [
        (("alignment", "cycle"), True, "relative", "off", "off"),
        (("cycle",), False, "relative", "off", "off"),
        (("alignment", "angle"), True, "off", "arms", "off"),
        (("collinearity",), False, "off", "off", "relative"),
    ],
)
def test_losses_in_flight_are_selected_individually(losses, alignment, cycle, angle, collinearity):
    terms = WindowConfig(in_flight_losses=losses).flying
    assert terms is not None
    assert (terms.alignment, terms.cycle, terms.angle, terms.collinearity) == (alignment, cycle, angle, collinearity)
    assert terms.edges_per_keyframe == terms.in_flight_edges


def test_forms_apply_in_flight_and_unknown_losses_are_rejected():
    terms = WindowConfig(cycle="literal").flying
    assert terms is not None
    assert term_config(terms).cycle_px
    assert WindowConfig(in_flight_losses=()).flying is None
    with pytest.raises(ValueError, match="in_flight_losses must be among alignment, cycle, angle, collinearity"):
        WindowConfig(in_flight_losses=("edges",))
    with pytest.raises(ValueError, match="in_flight must be one of off, few, always"):
        WindowConfig(in_flight="sometimes")
