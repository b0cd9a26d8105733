"""A lost frame is relocalised at its place, not at one of similar appearance."""

import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, PointMap, add_anchors, filled, pose_error

from edgeslam_torch.config import OrbConfig, TrackingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.tracking.relocaliser import (
    AGREEING_FRAMES,
    GRID,
    Place,
    Reach,
    Relocaliser,
    candidates,
    match_keyframe,
    place_of,
    reach_after,
)
from edgeslam_torch.tracking.tracker import Track, Tracker, make_view
from edgeslam_torch.types import FrameFeatures

SOMEWHERE = Reach(np.eye(4), 100.0, np.pi)
NOWHERE = Reach(se3.exp(np.array([50.0, 0, 0, 0, 0, 0])), 1.0, 0.1)


@pytest.fixture
def points(rng):
    return filled(rng, 2000, 6)


def tracker_of(points):
    return Tracker(points.map, CAMERA, OrbConfig(), TrackingConfig())


def view_of(points, view, rng, known=None):
    """A frame at a keyframe's place; of its keypoints only ``known`` have the descriptors that they have there."""
    seen = np.flatnonzero(points.world.visible[view])
    features = points.features(view, seen, 0.5 * rng.normal(size=(len(seen), 2)))
    descriptors = features.descriptors.copy()
    if known is not None:
        strange = ~known(features.uv)
        descriptors[strange] = rng.integers(0, 256, (strange.sum(), 32), dtype=np.uint8)
    return make_view(FrameFeatures(features.uv, features.octave, features.angle_rad, descriptors), SCALE_FACTOR)


def poster(uv):
    """A picture on the wall."""
    return (np.abs(uv - [220, 240]) < [75, 60]).all(axis=1)


def test_a_single_poster_is_rejected(points, rng):
    """All that the frame sees is found, in one corner: whatever share of it agrees, it may hang anywhere."""
    relocaliser = Relocaliser(tracker_of(points))
    whole = view_of(points, 3, rng).features
    inside = poster(whole.uv)
    view = make_view(
        FrameFeatures(whole.uv[inside], whole.octave[inside], whole.angle_rad[inside], whole.descriptors[inside]),
        SCALE_FACTOR,
    )
    place = place_of(relocaliser.tracker, view, match_keyframe(relocaliser.tracker, view, points.keyframes[3]))
    assert place.share > 0.8
    for index in range(2 * AGREEING_FRAMES):
        assert relocaliser.find(index, view, points.keyframes, SOMEWHERE) is None


def test_a_repeated_pattern_is_rejected(points, rng):
    """One keypoint of twelve agrees, all over the image: doors that repeat do as well in the wrong place."""
    tracker = tracker_of(points)
    relocaliser = Relocaliser(tracker)
    view = view_of(points, 3, rng, lambda uv: (uv // 10).sum(axis=1) % 12 == 0)
    wrong = match_keyframe(tracker, view, points.keyframes[3])
    assert wrong.inliers >= 2 * tracker.config.min_inliers, "enough by number"
    assert place_of(tracker, view, wrong).spread > 0.5, "and wide enough"
    for index in range(AGREEING_FRAMES + 1):
        assert relocaliser.find(index, view, [points.keyframes[3]], SOMEWHERE) is None


@pytest.mark.parametrize("view", [0, 3, 5])
def test_a_lost_frame_within_reach_is_accepted_at_once(points, rng, view):
    seen = view_of(points, view, rng)
    found = Relocaliser(tracker_of(points)).find(7, seen, [points.keyframes[view]], SOMEWHERE)
    assert pose_error(found.track.T_c_w, points.world.T_c_w[view])[0] < 0.03
    assert found.earlier == {}


@pytest.mark.parametrize("one_of", [6, 11])
def test_the_only_reachable_place_is_accepted(points, rng, one_of):
    """Every sixth or eleventh keypoint is known, as in a blurred image: enough at once where the camera can hardly have
    moved, not after seconds, and not elsewhere."""
    tracker, view = tracker_of(points), view_of(points, 3, rng, lambda uv: (uv // 10).sum(axis=1) % one_of == 0)
    here, elsewhere = points.world.T_c_w[3], se3.exp(np.array([5.0, 0, 0, 0, 0, 0])) @ points.world.T_c_w[3]
    for expected, shift, at_once in ((here, 0.1, True), (here, 100.0, False), (elsewhere, 0.1, False)):
        reach = Reach(expected, shift, 0.2, 1.0)
        found = Relocaliser(tracker).find(0, view, [points.keyframes[3]], reach)
        assert (found is not None) is at_once


def test_a_place_beyond_reach_needs_confirmation_by_frames(points, rng):
    relocaliser = Relocaliser(tracker_of(points))
    seen = view_of(points, 3, rng)
    for index in range(AGREEING_FRAMES - 1):
        assert relocaliser.find(index, seen, [points.keyframes[3]], NOWHERE) is None
        assert relocaliser.waiting == index + 1
    found = relocaliser.find(AGREEING_FRAMES, seen, [], NOWHERE)  # no keyframe is matched again
    assert sorted(found.earlier) == list(range(AGREEING_FRAMES - 1))
    for T_c_w in (found.track.T_c_w, *found.earlier.values()):
        assert pose_error(T_c_w, points.world.T_c_w[3])[0] < 0.03
    assert relocaliser.waiting == 0


def test_an_inconsistent_frame_rejects_the_place(points, rng):
    relocaliser = Relocaliser(tracker_of(points))
    seen = view_of(points, 3, rng)
    assert relocaliser.find(0, seen, points.keyframes, NOWHERE) is None
    assert relocaliser.find(1, view_of(points, 3, rng, poster), points.keyframes, NOWHERE) is None
    assert relocaliser.waiting == 0
    assert relocaliser.find(2, seen, points.keyframes, NOWHERE) is None, "counted anew"


def doubled(rng, shift):
    """Every place twice, one ``shift`` beside the other: the doors of a corridor."""
    points = PointMap(rng, 2000, 3)
    anchor_of = points.fill()
    known = np.flatnonzero(anchor_of >= 0)
    there = np.full(len(anchor_of), -1)
    there[known] = add_anchors(points.map, points.world.p_w[known] + shift, points.descriptors[known], 3)
    for v in range(3):
        T_c_w = points.world.T_c_w[v].copy()
        T_c_w[:3, 3] -= T_c_w[:3, :3] @ shift
        keyframe = make_keyframe(points.map.next_keyframe_id(), 100 + v, 9.0, T_c_w, points.keyframes[v].features)
        keyframe.anchor[:] = there[points.point_of[v]]
        points.map.add_keyframe(keyframe)
        points.keyframes.append(keyframe)
    points.map.refresh_anchors(there[known])
    return points


def test_of_two_similar_places_only_the_reachable_one_is_accepted(rng):
    points = doubled(rng, np.array([30.0, 0, 0]))
    relocaliser = Relocaliser(tracker_of(points))
    seen = view_of(points, 1, rng)
    for index in range(2 * AGREEING_FRAMES):
        assert relocaliser.find(index, seen, points.keyframes, SOMEWHERE) is None
    near = Reach(points.keyframes[4].T_c_w, 1.0, 0.5, 1.0)
    found = relocaliser.find(99, seen, points.keyframes, near)
    assert pose_error(found.track.T_c_w, points.keyframes[4].T_c_w)[0] < 0.03


def test_evidence_of_a_place(points, rng):
    tracker = tracker_of(points)
    whole, part = (view_of(points, 3, rng, known) for known in (None, poster))
    all_of_it, some = (place_of(tracker, v, match_keyframe(tracker, v, points.keyframes[3])) for v in (whole, part))
    assert all_of_it.share > 0.8
    assert all_of_it.cells > 0.8 * GRID[0] * GRID[1]
    assert all_of_it.spread > 0.9
    assert some.spread == pytest.approx(some.cells / all_of_it.cells, abs=0.05)
    assert some.share == pytest.approx(poster(part.features.uv).mean(), abs=0.03)
    z = se3.transform(points.world.T_c_w[3], points.world.p_w[points.world.visible[3]])[:, 2]
    assert all_of_it.depth == pytest.approx(np.median(z), rel=0.05)
    assert all_of_it.is_as(some)


def test_reach_grows_with_the_square_of_time():
    """Half of 9 m/s^2 over 0.2 s is 18 cm, and half of 60 rad/s^2 1.2 rad."""
    reach = reach_after(0.2, np.eye(4), metre=2.0)
    assert reach.shift_m == pytest.approx(0.18)
    assert reach.turn_rad == pytest.approx(1.2)
    assert (reach.metre * reach.shift_m) == pytest.approx(0.36)


def test_aliasing_is_excluded_within_a_small_reach_or_at_the_expected_pose():
    """36 cm are all one place at a depth of 2.5 m; at 2 m as expected within 15 %; and at 1 m doors may repeat."""
    reach, aside = reach_after(0.2, np.eye(4), metre=2.0), se3.exp(np.array([0.35, 0, 0, 0, 0, 0]))
    assert reach.leaves_only(at(se3.exp(np.array([0.7, 0, 0, 0, 0, 0])), depth=2.5))
    assert not reach.leaves_only(at(se3.exp(np.array([0.8, 0, 0, 0, 0, 0])), depth=2.5))
    assert reach.leaves_only(at(np.eye(4), depth=2.0))
    assert not reach.leaves_only(at(aside, depth=2.0))
    assert not reach.leaves_only(at(se3.exp(np.array([0, 0, 0, 0, 0.4, 0])), depth=2.0))
    assert not reach.leaves_only(at(np.eye(4), depth=1.0))
    unknown = reach_after(0.2, np.eye(4), metre=None)  # 6 % of the depth
    assert unknown.leaves_only(at(aside, depth=2.0))
    assert not reach_after(0.5, np.eye(4), metre=None).leaves_only(at(np.eye(4), depth=2.0))


def at(T_c_w, depth):
    """A place with a scene depth."""
    none = np.zeros(0, dtype=np.int64)
    return Place(Track(T_c_w, none, none, none, none, np.eye(6)), 1.0, 48, 1.0, depth)


@pytest.mark.parametrize(
    ("xi", "inside"),
    [([0.65, 0, 0, 0, 0, 0], True), ([0, -0.67, 0, 0, 0, 0], False), ([0, 0, 0, 0, 0.54, 0], True)]
    + [([0, 0, 0, 0, 0, -0.56], False)],
)
def test_reach_has_a_tolerance(xi, inside):
    """36 cm and 15 % of a depth of 2 m, and 0.2 rad and 20 degrees."""
    place = at(se3.exp(np.array(xi, dtype=float)), depth=2.0)
    assert Reach(np.eye(4), 0.36, 0.2, 1.0).holds(place) == inside


def test_every_keyframe_is_matched_in_rotation(points):
    tracker = tracker_of(points)
    tried = {k.id for n in range(1, 8) for k in candidates(tracker, points.world.T_c_w[0], 2, n)}
    assert tried == set(range(6))
    assert all(len(candidates(tracker, points.world.T_c_w[0], 2, n)) <= 2 for n in range(8))
