"""Two pieces of one place are joined, two different places never; exact ground truth."""

from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, PointMap, add_anchors, check_map, edge_points

from edgeslam_torch.atlas import links
from edgeslam_torch.atlas.atlas import Atlas
from edgeslam_torch.atlas.links import agreed_scale, link, log_ratios, on_one_plane, view_of
from edgeslam_torch.atlas.relaxation import move
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.atlas.submap_graph import SubmapGraph
from edgeslam_torch.config import EdgeConfig, OrbConfig, TrackingConfig
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.tracking.relocaliser import match_keyframe
from edgeslam_torch.tracking.tracker import Tracker
from edgeslam_torch.types import ScaleEstimate

MISPLACED = sim3.exp(np.array([0.5, -0.8, 0.3, 0.4, -0.3, 0.6, np.log(1.4)]))
"""Offset of the second piece's gauge."""


class Pieces:
    """Views 0 to 3 in one piece, 4 to 7 in another, which has anchors of its own and lies elsewhere."""

    def __init__(self, rng, same_place=True, noise_px=0.3, misplaced=MISPLACED):
        points = self.points = PointMap(rng, 1200, 8, noise_px)
        self.map = points.map
        self.map.begin_piece("first")
        points.fill(range(4))
        self.map.begin_piece("second")
        if not same_place:
            points.descriptors = rng.integers(0, 256, points.descriptors.shape, dtype=np.uint8)
        later = points.keyframes[4:]
        known = np.unique(np.concatenate(points.point_of[4:]))
        anchor_of = np.full(len(points.world.p_w), -1)
        p_w = sim3.transform(misplaced, points.world.p_w[known])
        anchor_of[known] = add_anchors(self.map, p_w, points.descriptors[known], 4)
        for keyframe, seen in zip(later, points.point_of[4:], strict=True):
            keyframe.words = words(points.descriptors[seen])
            keyframe.T_c_w = sim3.moved_camera(misplaced, keyframe.T_c_w)
            keyframe.anchor[:] = anchor_of[seen]
            self.map.add_keyframe(keyframe)
        self.map.refresh_anchors(anchor_of[known])
        self.keyframes = points.keyframes
        self.tracker = Tracker(self.map, CAMERA, OrbConfig(), TrackingConfig())
        self.edges = EdgeMap(self.map, CAMERA, EdgeConfig())
        self.log = TrajectoryLog(self.map)
        for keyframe in self.keyframes:
            self.log.append(keyframe.frame_index, keyframe.stamp_s, keyframe.id, keyframe.T_c_w, True)

    def atlas(self, start_sigma=np.inf):
        """Sensors have not measured the second submap unless it begins at a predicted pose."""
        sigma = 0.02 if np.isfinite(start_sigma) else 1.0
        graph = SubmapGraph(self.map, self.log, lambda: ScaleEstimate(2.0, sigma, "telemetry"))
        graph.begin(1, self.keyframes[4], start_sigma, 0.01)
        return Atlas(self.tracker, self.edges, graph, LmConfig(diagnostics=False))

    def move_second(self, S):
        return move(self.map, self.edges, self.log, {k.id: S for k in self.keyframes[4:] if k.id in self.map.keyframes})

    def position_error(self):
        """RMSE of all keyframes after Sim(3) alignment."""
        found = np.stack([k.centre_w for k in self.keyframes])
        truth = np.stack([-T[:3, :3].T @ T[:3, 3] for T in self.points.world.T_c_w])
        return np.linalg.norm(umeyama(found, truth).points(found) - truth, axis=1).max()


def test_submaps_of_one_place_are_merged(rng):
    pieces = Pieces(rng)
    assert pieces.position_error() > 0.2
    join = pieces.atlas().update()
    assert join.kind == "joined"
    assert join.growth(7) / join.growth(0) == pytest.approx(1 / 1.4, rel=0.02)
    check_map(pieces.map)
    assert {pieces.map.piece_of(k.id) for k in pieces.keyframes} == {0}
    assert pieces.position_error() < 0.01
    shared = pieces.map.shared_counts(pieces.keyframes[1].anchor[pieces.keyframes[1].anchor >= 0])
    assert max(shared.get(k.id, 0) for k in pieces.keyframes[4:]) > 200
    assert pieces.log.support().piece.tolist() == [0] * 8


def test_only_new_keyframes_are_compared_again_with_a_submap(rng):
    pieces = Pieces(rng)
    atlas = pieces.atlas()
    assert not atlas.is_up_to_date
    assert atlas.update() is not None
    assert atlas.update() is None
    assert atlas.is_up_to_date
    atlas.search_all_again()
    assert not atlas.is_up_to_date
    assert len(atlas.changes) == 1


def test_submaps_of_different_places_are_not_merged(rng):
    pieces = Pieces(rng, same_place=False)
    before = [k.T_c_w.copy() for k in pieces.keyframes]
    assert pieces.atlas().update() is None
    assert [pieces.map.piece_of(k.id) for k in pieces.keyframes] == [0] * 4 + [1] * 4
    for keyframe, T_c_w in zip(pieces.keyframes, before, strict=True):
        np.testing.assert_array_equal(keyframe.T_c_w, T_c_w)


def test_a_single_keyframe_does_not_merge_submaps(rng):
    pieces = Pieces(rng)
    for keyframe in pieces.keyframes[5:]:
        pieces.map.forget_observations(keyframe, keyframe.keypoints_with_anchor())
    assert pieces.atlas().update() is None
    assert pieces.map.piece_of(pieces.keyframes[4].id) == 1


def test_inconsistent_links_do_not_merge_submaps(rng):
    """Half of the second piece has come apart from the other half: no two links say the same."""
    pieces = Pieces(rng)
    anchors = pieces.map.anchors
    for n, keyframe in enumerate(pieces.keyframes[4:]):
        own = keyframe.anchor[keyframe.anchor >= 0]
        ids = add_anchors(pieces.map, anchors.p_w[own], anchors.words[own], 9)
        pieces.map.forget_observations(keyframe, keyframe.keypoints_with_anchor()[:0])
        S = sim3.exp(np.array([0, 0, 0, 0, 0, 0, 0.25 * n]))
        anchors.p_w[ids] = sim3.transform(S, anchors.p_w[own])
        anchors.observations[own] -= 1
        keyframe.anchor[keyframe.anchor >= 0] = ids
        anchors.observations[ids] += 1
        keyframe.T_c_w = sim3.moved_camera(S, keyframe.T_c_w)
        pieces.map.refresh_anchors(ids)
    assert pieces.atlas().update() is None


def test_a_link_gives_the_similarity(rng):
    pieces = Pieces(rng)
    found = link(pieces.tracker, pieces.keyframes[4], pieces.keyframes[3])
    error = sim3.log(found.S @ MISPLACED)
    assert np.abs(error[3:6]).max() < 0.005
    assert abs(error[6]) < 0.01
    assert np.abs(error[:3]).max() < 0.03
    assert found.sigma_log < 0.01
    assert found.agrees(link(pieces.tracker, pieces.keyframes[5], pieces.keyframes[3]))


def test_inconsistent_depths_give_no_scale(rng):
    """The same pictures on a wall that stands elsewhere in every direction: a pose fits, the depths do not."""
    pieces = Pieces(rng)
    keyframe = pieces.keyframes[4]
    track = match_keyframe(pieces.tracker, view_of(keyframe, SCALE_FACTOR), pieces.keyframes[3])
    scale, _ = agreed_scale(log_ratios(pieces.tracker, keyframe, track))
    assert scale == pytest.approx(1 / 1.4, rel=0.01)
    own = keyframe.anchor[keyframe.anchor >= 0]
    away = pieces.map.anchors.p_w[own] - keyframe.centre_w
    pieces.map.anchors.p_w[own] = keyframe.centre_w + away * np.exp(rng.normal(0.0, 0.4, (len(own), 1)))
    assert agreed_scale(log_ratios(pieces.tracker, keyframe, track)) is None


def test_transforming_a_submap_preserves_its_projections(rng):
    pieces = Pieces(rng)
    slam_map, anchors = pieces.map, pieces.map.anchors
    first, last = pieces.keyframes[0], pieces.keyframes[7]
    p_c = np.array([[0.1, 0.2, 2.0]])
    pieces.edges.hosts += [edge_points(keyframe.id, p_c.copy(), sigma=np.full(1, 0.1)) for keyframe in (first, last)]
    held = last.anchor[last.anchor >= 0]
    anchors.from_depth[held[0]] = True
    anchors.rest_on_prior(held[:1], last.id, last.centre_w, np.array([[0.5, 0.1]]))
    slam_map.remove_keyframe(pieces.keyframes[6])
    seen = [CAMERA.project(se3.transform(k.T_c_w, anchors.p_w[k.anchor[k.anchor >= 0]])) for k in (first, last)]
    for i, near in enumerate((0.02, 0.04, 0.06)):  # frames between two keyframes; refinement has moved the second
        T_c_w = se3.exp(np.array([near, 0, 0, 0, 0, 0])) @ last.T_c_w
        pieces.log.append(80 + i, 8.0 + i, last.id, T_c_w, True, None if i < 2 else se3.exp(np.full(6, 0.01)))
    _, T_before = pieces.log.poses()
    S = sim3.exp(rng.normal(size=7))
    scale = sim3.scale_of(S)
    pieces.move_second(S)
    check_map(slam_map)
    for keyframe, uv in zip((first, last), seen, strict=True):
        ids = keyframe.anchor[keyframe.anchor >= 0]
        np.testing.assert_allclose(CAMERA.project(se3.transform(keyframe.T_c_w, anchors.p_w[ids])), uv, atol=1e-6)
    np.testing.assert_allclose(anchors.prior[held[0]], np.array([0.5, 0.1]) / scale)
    np.testing.assert_allclose(anchors.origin[held[0]], last.centre_w)
    np.testing.assert_allclose(pieces.edges.hosts[0].p_c, p_c)
    np.testing.assert_allclose(pieces.edges.hosts[1].p_c, scale * p_c)
    assert pieces.edges.hosts[1].sigma[0] == pytest.approx(0.1 * scale)
    _, T_after = pieces.log.poses()
    np.testing.assert_allclose(T_after[:4], T_before[:4])
    np.testing.assert_allclose(T_after[4:, :3, 3], sim3.transform(S, T_before[4:, :3, 3]), atol=1e-9)
    np.testing.assert_allclose(T_after[4:, :3, :3], sim3.parts(S)[1] @ T_before[4:, :3, :3], atol=1e-9)


@pytest.mark.parametrize("smaller", [0, 1])
def test_the_smaller_submap_is_transformed_to_the_larger(rng, smaller):
    pieces = Pieces(rng)
    there = {k.id: centre for k, centre in zip(pieces.keyframes, se3.inverse(pieces.points.world.T_c_w), strict=True)}
    for keyframe in pieces.keyframes[:2] if smaller == 0 else pieces.keyframes[6:]:
        pieces.map.remove_keyframe(keyframe)
    left = list(pieces.map.keyframes.values())
    larger = np.array([pieces.map.piece_of(k.id) != smaller for k in left])
    truth = np.stack([there[k.id][:3, 3] for k in left])
    before = np.stack([k.centre_w for k in left])
    join = pieces.atlas().update()
    after = np.stack([k.centre_w for k in left])
    assert {k // 4 for k in join.scale_change} == {smaller}
    to_larger = umeyama(truth[larger], before[larger])
    np.testing.assert_allclose(after, to_larger.points(truth), atol=0.03)


def test_planarity_is_invariant_to_position_and_size(rng):
    """A floor known to 5 mm, in metres and in kilometres; a twelfth of it wrong; a floor and a wall; a bent floor."""
    floor = np.column_stack([rng.uniform(-1, 1, (240, 2)), rng.normal(0, 0.005, 240)])
    wrong = floor + np.where(np.arange(240) % 12 == 0, 0.5, 0.0)[:, None]
    corner = np.where(np.arange(240)[:, None] % 3 == 0, floor[:, [2, 0, 1]] + [1.0, 0.0, 1.0], floor)
    bent = floor + np.column_stack([np.zeros((240, 2)), 0.2 * floor[:, 0] ** 2])
    for size in (1.0, 1000.0):
        S = sim3.exp(np.array([30.0, -8.0, 3.0, 0.4, -0.3, 0.6, np.log(size)]))
        told = [on_one_plane(sim3.transform(S, p), 2.0 * size) for p in (floor, wrong, corner, bent)]
        assert told == [True, True, False, False]


@pytest.mark.parametrize(("share", "believed"), [(0.15, False), (0.25, True)])
def test_a_planar_place_needs_a_larger_share_of_matches(rng, monkeypatch, share, believed):
    pieces = Pieces(rng)
    place = links._place
    monkeypatch.setattr(links, "_place", lambda *args: replace(place(*args), share=share))
    assert link(pieces.tracker, pieces.keyframes[4], pieces.keyframes[3]) is not None
    monkeypatch.setattr(links, "ON_PLANE", 10.0)  # everything is one
    assert (link(pieces.tracker, pieces.keyframes[4], pieces.keyframes[3]) is not None) == believed


@pytest.mark.parametrize("guessed_there", [False, True])
def test_predicted_depths_give_no_scale(rng, guessed_there):
    pieces = Pieces(rng)
    keyframe, anchors = pieces.keyframes[4], pieces.map.anchors
    track = match_keyframe(pieces.tracker, view_of(keyframe, SCALE_FACTOR), pieces.keyframes[3])
    anchors.from_depth[track.anchor if guessed_there else keyframe.anchor[keyframe.anchor >= 0]] = True
    assert len(log_ratios(pieces.tracker, keyframe, track)) == 0


def test_an_unreachable_submap_is_not_merged(rng):
    """Half a metre and forty degrees off after a way of centimetres: nothing drifts so, however much it looks alike."""
    assert Pieces(rng, misplaced=MISPLACED).atlas(start_sigma=0.01).update() is None
    assert Pieces(rng, misplaced=MISPLACED).atlas().update() is not None, "by images alone"


def test_sensors_do_not_relate_a_loaded_submap(rng):
    pieces = Pieces(rng, misplaced=MISPLACED)
    for keyframe in pieces.keyframes[:4]:
        keyframe.stamp_s = BEFORE_S
    assert pieces.atlas(start_sigma=0.01).update() is not None


@pytest.mark.parametrize(("sigma", "may"), [(0.1, False), (0.4, True)])
def test_a_correction_within_sensor_uncertainty_is_accepted(rng, sigma, may):
    """More than a metre beside where it was carried to."""
    beside = sim3.exp(np.array([1.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    join = Pieces(rng, misplaced=beside).atlas(start_sigma=sigma).update()
    assert (join is not None) == may


def test_the_link_must_agree_in_both_directions(rng):
    """Ten degrees of roll between a keyframe and its own anchors: all depths agree, the poses do not."""
    pieces = Pieces(rng)
    keyframe, other = pieces.keyframes[4], pieces.keyframes[3]
    assert link(pieces.tracker, keyframe, other) is not None
    keyframe.T_c_w = se3.exp(np.array([0, 0, 0, 0, 0, np.deg2rad(10.0)])) @ keyframe.T_c_w
    assert link(pieces.tracker, keyframe, other) is None


@pytest.mark.parametrize("known", [0, 1])
def test_a_loaded_map_keeps_its_pose_and_scale(rng, known):
    """However small it is beside the flight's own piece."""
    pieces = Pieces(rng)
    for keyframe in pieces.keyframes[:2] if known == 0 else pieces.keyframes[6:]:
        pieces.map.remove_keyframe(keyframe)
    atlas, metres = pieces.atlas(), ScaleEstimate(1.0, 0.02, "telemetry")
    atlas.known_scale[known] = metres
    join = atlas.update()
    assert {k // 4 for k in join.scale_change} == {1 - known}
    assert atlas.known_scale == {0: metres}
