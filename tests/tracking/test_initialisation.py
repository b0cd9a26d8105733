"""From a predicted map to a triangulated one, and the checks that reject a wrong one."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, PointMap, check_map, small_motion

from edgeslam_torch.config import InitialisationConfig, OrbConfig, TrackingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.tracking import bootstrap as bootstrap_module
from edgeslam_torch.tracking.bootstrap import Bootstrap
from edgeslam_torch.tracking.initialiser import (
    MIN_POINTS,
    BootstrapView,
    Structure,
    from_essential_matrix,
    poses_between,
    triangulated,
)
from edgeslam_torch.tracking.tracker import Tracker, make_view
from edgeslam_torch.types import DepthMap, Frame, FrameFeatures

CONFIG = InitialisationConfig()


@pytest.fixture
def points(rng):
    return PointMap(rng, 500, 6)


def view_of(points, view):
    return make_view(points.keyframes[view].features, SCALE_FACTOR)


def matches(points, i, j):
    """Keypoints of keyframes i and j of the same points."""
    common, a, b = np.intersect1d(points.point_of[i], points.point_of[j], return_indices=True)
    assert len(common) > 80
    return a, b


def guess_of(points, guess_depth, j=4, T_c_w=None):
    """The matches of views 0 and j, with points at guessed depths."""
    a, b = matches(points, 0, j)
    reference = points.keyframes[0]
    p_r = CAMERA.back_project(reference.features.uv[a], guess_depth[a])
    T = points.world.T_c_w[j] if T_c_w is None else T_c_w
    return Structure(T, a, b, se3.transform(reference.T_w_c, p_r))


def by_essential_matrix(points, guess_depth, j=4):
    """Structure of two views; the guess knows nothing of their motion."""
    guess = guess_of(points, guess_depth, j, points.world.T_c_w[0])
    return from_essential_matrix(points.keyframes[0], guess, view_of(points, j), CAMERA)


def test_two_exact_views_give_the_exact_world(points):
    found = by_essential_matrix(points, points.depths(0))
    np.testing.assert_allclose(found.p_w, points.world.p_w[points.point_of[0][found.reference_keypoint]], atol=5e-3)
    xi = se3.log(found.T_c_w @ se3.inverse(points.world.T_c_w[4]))
    assert np.abs(xi).max() < 1e-3


def turned_view(points, turn):
    """View 0 after a rotation of the camera on the spot, and its keypoints that lie ahead."""
    ahead = np.flatnonzero(points.depths(0) > 1.0)
    p_c = se3.transform(turn @ points.world.T_c_w[0], points.world.p_w[points.point_of[0][ahead]])
    view = view_of(points, 0)
    uv = view.features.uv.copy()
    uv[ahead] = CAMERA.project(p_c)
    return replace(view, features=replace(view.features, uv=uv)), ahead


def test_pure_rotation_is_rejected_with_a_reason(points):
    turn = se3.exp(np.array([0, 0, 0, 0.02, 0.1, 0.0]))
    bootstrap = make_bootstrap(points, points.depths(0))
    view, _ = turned_view(points, turn)
    track = bootstrap.track(view, turn @ points.world.T_c_w[0])
    found = bootstrap.two_views(frame_of(points, 1), view, track, leaving=True)
    assert found.structure is None
    assert found.reason == "no parallax yet"


@pytest.mark.parametrize(("height_m", "starts"), [(0.28, True), (0.03, False)])
def test_before_a_wall_a_camera_that_climbs_and_sinks_starts_a_map(points, height_m, starts):
    """Ten seconds, 3 m before the wall: a rotation explains all but half a degree of five. One that hovers waits."""
    bootstrap = make_bootstrap(points, np.full(len(points.point_of[0]), 3.0))
    reference, rng, found = points.keyframes[0], np.random.default_rng(5), None
    ahead = view_of(points, 0)
    wall = CAMERA.back_project(reference.features.uv, np.full(len(reference.features.uv), 3.0))
    for k in range(1, 101):
        T_c_r = np.eye(4)
        T_c_r[1, 3] = height_m * np.sin(0.15 * k)
        uv = CAMERA.project(se3.transform(T_c_r, wall)) + rng.normal(0.0, 0.5, (len(wall), 2))
        view = replace(ahead, features=replace(ahead.features, uv=uv.astype(np.float32)))
        track = bootstrap.track(view, T_c_r @ reference.T_c_w)
        frame = Frame(k, reference.stamp_s + 0.1 * k, np.zeros((4, 4), np.uint8))
        found = bootstrap.two_views(frame, view, track)
        if found.structure is not None:
            break
        bootstrap.wait(frame, view, track)
    assert (found.structure is not None) == starts
    if found.structure is not None:
        moved = found.structure.T_c_w @ reference.T_w_c
        assert abs(moved[1, 3]) > 0.95 * np.linalg.norm(moved[:3, 3])
        assert np.rad2deg(np.linalg.norm(se3.log(moved)[3:])) < 1.5


def test_few_matches_are_rejected_with_a_reason(points):
    few = np.arange(len(points.point_of[0])) < 40
    bootstrap = make_bootstrap(points, points.depths(0))
    bootstrap.reference.features = replace(bootstrap.reference.features, corner=few)
    track = bootstrap.track(view_of(points, 4), points.world.T_c_w[4])
    found = bootstrap.two_views(frame_of(points, 4), view_of(points, 4), track, leaving=True)
    assert found.structure is None
    assert found.reason.endswith("corners matched")
    a, b = matches(points, 0, 4)
    guess = guess_of(points, points.depths(0))
    nine = Structure(guess.T_c_w, a[:9], b[:9], guess.p_w[:9])
    assert from_essential_matrix(points.keyframes[0], nine, view_of(points, 4), CAMERA) is None


def test_a_frame_between_gets_a_pose_where_it_sees_enough_points(points):
    a, b = matches(points, 0, 1)
    rough = small_motion(np.random.default_rng(0), 0.05, 0.02) @ points.world.T_c_w[1]
    view = BootstrapView(1, points.keyframes[1].features.uv[b], np.ones(len(b)), a, rough)
    for known, expected in ((a, points.world.T_c_w[1]), (a[:10], rough)):
        p_w = np.full((len(points.point_of[0]), 3), np.nan)
        p_w[known] = points.world.p_w[points.point_of[0][known]]
        np.testing.assert_allclose(poses_between([view], p_w, CAMERA)[0], expected, atol=1e-3)


@pytest.fixture(autouse=True)
def wide_search(monkeypatch):
    """The views lie farther apart than successive frames."""
    monkeypatch.setattr("edgeslam_torch.tracking.bootstrap.MOTION_RADIUS_PX", 100.0)


def make_bootstrap(points, guess_depth, config=CONFIG):
    tracker = Tracker(points.map, CAMERA, OrbConfig(), TrackingConfig())
    reference = points.keyframes[0]
    colour = np.zeros((len(reference.anchor), 3), np.uint8)
    guess = np.stack([guess_depth, np.full(len(guess_depth), 0.35)], axis=1)
    return Bootstrap(points.map, tracker, config, reference, guess, colour)


def frame_of(points, view):
    return Frame(points.keyframes[view].frame_index, 0.1 * view, np.zeros((4, 4), np.uint8))


def attempted(points, **config):
    """The bootstrap that saw views 0 to 4, those between waiting, and what it made of the last."""
    spread = np.random.default_rng(1).normal(0.0, 0.05, len(points.point_of[0]))
    config = InitialisationConfig(**config)
    bootstrap = make_bootstrap(points, points.depths(0) * np.exp(spread), config)
    check_map(points.map)
    assert points.map.anchors.from_depth[points.keyframes[0].anchor].all()
    accepted = None
    for view in (1, 2, 3, 4):
        track = bootstrap.track(view_of(points, view), points.world.T_c_w[view])
        assert track is not None
        accepted = bootstrap.two_views(frame_of(points, view), view_of(points, view), track)
        if view < 4:
            bootstrap.wait(frame_of(points, view), view_of(points, view), track)
    return bootstrap, accepted


@pytest.mark.parametrize("side", ["reference", "frame"])
def test_keypoints_on_edges_are_not_used_for_motion(points, side):
    """Every keypoint slides with its neighbours, as on the parallel joints of a wall, but for 40 % of them."""
    corner = np.random.default_rng(0).random(len(points.point_of[0])) < 0.4
    view = view_of(points, 4)
    there = np.isin(points.point_of[4], points.point_of[0][corner])
    view.features.uv[~there] += 0.02 * (view.features.uv[~there][:, ::-1] - [CAMERA.cy, CAMERA.cx])
    bootstrap = make_bootstrap(points, points.depths(0))
    if side == "reference":
        bootstrap.reference.features = replace(bootstrap.reference.features, corner=corner)
    else:
        view = replace(view, features=replace(view.features, corner=there))
    track = bootstrap.track(view, points.world.T_c_w[4])
    assert track is not None
    found = bootstrap.two_views(frame_of(points, 4), view, track, leaving=True).structure
    T = found.T_c_w @ se3.inverse(points.world.T_c_w[4])
    assert np.abs(se3.log(T)).max() < 2e-3
    assert corner[found.reference_keypoint].all()


def started(points, **config):
    """A map that views 0 and 4 made, with the views between waiting."""
    bootstrap, accepted = attempted(points, **config)
    result = bootstrap.replace_map(frame_of(points, 4), view_of(points, 4), accepted.structure, LmConfig())
    check_map(points.map)
    return result


def test_guessed_map_is_replaced_and_the_map_stays_consistent(points):
    between = started(points, keyframe_gap_s=100.0).T_c_w
    alive = np.flatnonzero(points.map.anchors.alive)
    assert len(alive) >= MIN_POINTS
    assert not points.map.anchors.from_depth[alive].any()
    index = {points.keyframes[v].frame_index: v for v in (1, 2, 3)}
    np.testing.assert_array_equal(between.pop(points.keyframes[0].frame_index), points.keyframes[0].T_c_w)
    assert set(between) == set(index)
    # Up to the guess's scale, the frames between are where they were.
    centre = points.keyframes[0].centre_w
    moved = {i: se3.inverse(T)[:3, 3] - centre for i, T in between.items()}
    truth = {i: se3.inverse(points.world.T_c_w[v])[:3, 3] - centre for i, v in index.items()}
    ratios = np.array([np.linalg.norm(moved[i]) / np.linalg.norm(truth[i]) for i in between])
    assert np.ptp(ratios) / ratios.mean() < 0.03
    assert 0.8 < ratios.mean() < 1.25


@pytest.mark.parametrize("network", [False, True])
def test_without_a_network_two_views_need_a_smaller_sigma(points, network, monkeypatch):
    """With a network a flat scene is recognised; without one, the baseline direction must be certain."""
    if network:
        with_network(points)
    monkeypatch.setattr("edgeslam_torch.tracking.bootstrap.MAX_DIRECTION_SIGMA_ALONE", 1e-9)
    _, accepted = attempted(points)
    assert (accepted.structure is not None) == network
    assert network or accepted.reason == "rotation and translation are not yet distinguishable"


def test_intermediate_frames_become_keyframes_in_order(points):
    result = started(points, keyframe_gap_s=0.01)
    new = [k for _, k in result.new]
    assert [k.frame_index for k in new] == [points.keyframes[v].frame_index for v in (1, 2, 3, 4)]
    assert [k.id for k in new] == sorted(k.id for k in new)
    assert all(points.map.keyframes[k.id] is k for k in new)
    for keyframe in new[:-1]:
        np.testing.assert_array_equal(result.T_c_w[keyframe.frame_index], keyframe.T_c_w)
        assert len(keyframe.keypoints_with_anchor()) > 60
    observed = points.map.anchors.observations[points.map.anchors.alive]
    assert (observed >= 4).mean() > 0.8


def test_distant_intermediate_frames_are_kept(points):
    guess = points.depths(0)
    bootstrap = make_bootstrap(points, guess, InitialisationConfig(keyframe_gap_s=0.01, max_keyframes=2))
    for index, view in enumerate((1, 1, 1, 2, 3), start=1):
        seen = view_of(points, view)
        track = bootstrap.track(seen, points.world.T_c_w[view])
        bootstrap.two_views(replace(frame_of(points, view), index=index), seen, track)
        bootstrap.wait(Frame(index, 0.1 * index, np.zeros((4, 4), np.uint8)), seen, track)
    assert len(bootstrap.waiting) == 2
    standing_still = {1, 2, 3}
    assert len(standing_still & {w.frame.index for w in bootstrap.waiting}) <= 1
    assert bootstrap.waiting[-1].frame.index == 5


def test_a_repeated_image_does_not_set_the_maximum_of_matches(points):
    """A camera that stands still matches every keypoint; by that, the first step away would look like another view."""
    bootstrap = make_bootstrap(points, points.depths(0))
    still = bootstrap.track(view_of(points, 0), points.world.T_c_w[0])
    assert still.inliers > 0
    assert bootstrap.max_matched == 0
    moved = bootstrap.track(view_of(points, 1), points.world.T_c_w[1])
    assert bootstrap.max_matched == moved.inliers > 0


def test_an_abandoned_initialisation_removes_its_anchors(points):
    bootstrap = make_bootstrap(points, np.ones(len(points.point_of[0])))
    bootstrap.forget_guess()
    check_map(points.map)
    assert len(points.map.anchors) == 0
    assert 0 in points.map.keyframes


# -- what may become the map -----------------------------------------------------------------------------------------


def seen_by(points, views, guess_depth=None, wrong_between=0.0, tracked=None, **config):
    """What the last of some views offers after the others.

    Args:
        guess_depth: Predicted depths; the true ones by default.
        wrong_between: Share of the matches in the views between that point anywhere.
        tracked: Pose of tracking in the last view in place of its own.
    """
    guess_depth = points.depths(0) if guess_depth is None else guess_depth
    bootstrap = make_bootstrap(points, guess_depth, InitialisationConfig(**config))
    rng = np.random.default_rng(3)
    for view in views:
        track = bootstrap.track(view_of(points, view), points.world.T_c_w[view])
        if view == views[-1] and tracked is not None:
            track = replace(track, T_c_w=tracked)
        found = bootstrap.two_views(frame_of(points, view), view_of(points, view), track, leaving=len(views) == 1)
        uv = bootstrap.views[-1].keypoint_uv
        wrong = rng.permutation(len(uv))[: round(wrong_between * len(uv))]
        uv[wrong] = rng.uniform((0, 0), (640, 480), (len(wrong), 2))
    return found


def from_essential_matrix_comes(monkeypatch, structure):
    """The essential matrix gives this structure of the matches, or none."""

    def found(reference, guess, *_):
        if structure is None:
            return None
        _, ours, theirs = np.intersect1d(guess.reference_keypoint, structure.reference_keypoint, return_indices=True)
        p_w = guess.p_w.copy()
        p_w[ours] = structure.p_w[theirs]
        return replace(guess, T_c_w=structure.T_c_w, p_w=p_w)

    monkeypatch.setattr(bootstrap_module, "from_essential_matrix", found)


def with_network(points):
    """A depth network has seen the first view; what it says of the keypoints is the guess."""
    flat = np.ones((CAMERA.height, CAMERA.width), np.float32)
    points.keyframes[0].depth = DepthMap(flat, 0.2 * flat)


def test_a_map_with_many_outliers_is_rejected(points):
    """38 % of the matches between are wrong: 77 % of all observations agree."""
    found = seen_by(points, (1, 2, 3, 4), wrong_between=0.38)
    assert (found.structure, found.reason) == (None, "the frames disagree with one structure")
    assert seen_by(points, (1, 2, 3, 4), wrong_between=0.1).structure is not None


@pytest.mark.parametrize("leaving", [False, True])
def test_two_views_alone_wait_for_a_third(points, leaving):
    """On repetitive texture many motions explain two views; the last view of the reference has no choice."""
    bootstrap = make_bootstrap(points, points.depths(0))
    view = view_of(points, 4)
    track = bootstrap.track(view, points.world.T_c_w[4])
    assert (bootstrap.two_views(frame_of(points, 4), view, track, leaving).structure is not None) == leaving
    assert bootstrap.two_views(frame_of(points, 4), view, track).structure is not None


@pytest.mark.parametrize("start", ["tracking", "essential matrix"])
def test_structure_keeps_the_networks_scale(points, monkeypatch, start):
    """Tracked with half as long again a baseline, which comes back to the guessed depths."""
    with_network(points)
    if start == "tracking":
        from_essential_matrix_comes(monkeypatch, None)
    first = points.world.T_c_w[0]
    T = points.world.T_c_w[4] @ se3.inverse(first)
    T[:3, 3] *= 1.5
    found = seen_by(points, (4,), tracked=T @ first).structure
    z = se3.transform(first, found.p_w)[:, 2]
    assert np.median(z / points.depths(0)[found.reference_keypoint]) == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(se3.inverse(found.T_c_w)[:3, 3] - points.keyframes[0].centre_w) == pytest.approx(
        np.linalg.norm(points.keyframes[4].centre_w - points.keyframes[0].centre_w), rel=0.02
    )


@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize("wrong", ["tracking", "essential matrix"])
def test_the_network_resolves_the_ambiguity_of_a_plane(seed, wrong, monkeypatch):
    """A plane's two views have two explanations that fit alike; only the shape of the guess tells them apart."""
    points = on_a_plane(PointMap(np.random.default_rng(seed), 400, 6))
    with_network(points)
    right = guess_of(points, points.depths(0))
    T, p_w = other_explanation(points, right)
    other = replace(right, T_c_w=T, p_w=p_w)
    true = points.world.T_c_w[4]
    assert np.abs(se3.log(T @ se3.inverse(true))).max() > 0.1, "it is another one"
    seen = CAMERA.project(se3.transform(T, p_w)) - view_of(points, 4).features.uv[right.keypoint]
    assert np.abs(seen).max() < 3.0, "and it fits"
    from_essential_matrix_comes(monkeypatch, right if wrong == "tracking" else other)
    found = seen_by(points, (4,), tracked=T if wrong == "tracking" else None, max_direction_sigma=10.0)
    assert found.structure is not None, found.reason
    assert np.abs(se3.log(found.structure.T_c_w @ se3.inverse(true))).max() < 0.05


@pytest.mark.parametrize("network", [True, False])
def test_the_shape_of_the_guess_does_not_bend_the_structure(points, network):
    """Every second depth is 30 % off: the images alone decide where they can."""
    if network:
        with_network(points)
    z = points.depths(0)
    found = seen_by(points, (1, 2, 3, 4), guess_depth=z * np.where(np.arange(len(z)) % 2, 1.3, 1 / 1.3)).structure
    ratio = se3.transform(points.world.T_c_w[0], found.p_w)[:, 2] / z[found.reference_keypoint]
    assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.01


def on_a_plane(points, noise_px=0.3):
    """The same views of points that lie on one slanted plane, with a little noise."""
    rng = np.random.default_rng(6)
    world = points.world
    first = se3.inverse(world.T_c_w[0])
    uv = rng.uniform((200, 140), (440, 340), (len(world.p_w), 2))
    rays = CAMERA.back_project(uv, np.ones(len(uv)))
    normal = np.array([0.5, 0.3, 1.0])
    world.p_w[:] = se3.transform(first, rays * (2.5 / (rays @ normal))[:, None])
    for view, T in enumerate(world.T_c_w):
        p_c = se3.transform(T, world.p_w)
        world.uv[view] = CAMERA.project(p_c)
        inside = (p_c[:, 2] > 0.1) & (world.uv[view] > 0).all(1) & (world.uv[view] < (639, 479)).all(1)
        points.point_of[view] = np.flatnonzero(inside)
        features = points.features(view, points.point_of[view], rng.normal(0, noise_px, (inside.sum(), 2)))
        keyframe = points.keyframes[view]
        points.keyframes[view] = make_keyframe(keyframe.id, keyframe.frame_index, keyframe.stamp_s, T, features)
    return points


def other_explanation(points, found):
    """Pose and points of the other decomposition of the plane's homography, at the truth's baseline."""
    uv_r = points.keyframes[0].features.uv[found.reference_keypoint]
    uv_c = view_of(points, 4).features.uv[found.keypoint]
    H, _ = cv2.findHomography(uv_r, uv_c)
    _, turns, shifts, normals = cv2.decomposeHomographyMat(H, CAMERA.K)
    T_true = points.world.T_c_w[4] @ se3.inverse(points.world.T_c_w[0])
    rays = CAMERA.back_project(uv_r, np.ones(len(uv_r)))
    best, distance = None, 0.0
    for R, t, n in zip(turns, shifts, normals, strict=True):
        z = 1.0 / (rays @ n[:, 0])  # the plane n p = 1
        p = rays * z[:, None]
        if (z <= 0).any() or ((p @ R.T + t[:, 0])[:, 2] <= 0).any():
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t[:, 0]
        grown = np.linalg.norm(T_true[:3, 3]) / np.linalg.norm(t)
        T[:3, 3] *= grown
        off = np.linalg.norm(se3.log(T @ se3.inverse(T_true)))
        if off > distance:
            first = points.world.T_c_w[0]
            best, distance = (T @ first, se3.transform(se3.inverse(first), p * grown)), off
    return best


def test_an_adopted_predicted_map_keeps_its_matches(points):
    """Turned away before parallax came: the frames so far hang on the guess, each with its own matches."""
    with_network(points)
    bootstrap = make_bootstrap(points, points.depths(0), InitialisationConfig(keyframe_gap_s=0.01))
    for view in (1, 2, 3):
        seen = view_of(points, view)
        track = bootstrap.track(seen, points.world.T_c_w[view])
        bootstrap.two_views(frame_of(points, view), seen, track)
        bootstrap.wait(frame_of(points, view), seen, track)
    seen = view_of(points, 4)
    track = bootstrap.track(seen, points.world.T_c_w[4])
    bootstrap.two_views(frame_of(points, 4), seen, track)
    adopted = bootstrap.adopt(frame_of(points, 4), seen, track)
    check_map(points.map)
    assert [k.frame_index for _, k in adopted.new] == [points.keyframes[v].frame_index for v in (1, 2, 3, 4)]
    assert set(adopted.T_c_w) == {points.keyframes[v].frame_index for v in (0, 1, 2, 3)}
    point_of_anchor = dict(zip(points.keyframes[0].anchor.tolist(), points.point_of[0].tolist(), strict=True))
    for view, (_, keyframe) in zip((1, 2, 3, 4), adopted.new, strict=True):
        held = keyframe.keypoints_with_anchor()
        assert len(held) > 60
        told = [point_of_anchor[a] for a in keyframe.anchor[held].tolist()]
        np.testing.assert_array_equal(told, points.point_of[view][held])
        assert np.abs(se3.log(keyframe.T_c_w @ se3.inverse(points.world.T_c_w[view]))).max() < 0.02


def test_points_behind_the_second_camera_do_not_triangulate(rng):
    """Half a metre forward; matches that meet between the two cameras fit every line, and lie behind the second."""
    ahead = np.column_stack([rng.uniform(-1.5, 1.5, (120, 2)), rng.uniform(2.0, 6.0, 120)])
    between = np.column_stack([rng.uniform(0.03, 0.12, (20, 2)), np.full(20, 0.25)])
    p = np.concatenate([ahead, between])
    forward = se3.exp(np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0]))
    bits = rng.integers(0, 256, (len(p), 32), dtype=np.uint8)
    none = np.zeros(len(p), np.int32)
    uv = [CAMERA.project(q).astype(np.float32) for q in (p, se3.transform(forward, p))]
    features = [FrameFeatures(x, none, none.astype(np.float32), bits) for x in uv]
    reference = make_keyframe(0, 0, 0.0, np.eye(4), features[0])
    every = np.arange(len(p))
    good = triangulated(Structure(forward, every, every, p), reference, np.deg2rad(0.75))
    assert 90 < good.sum() < len(ahead)
    assert not good[len(ahead) :].any()
    guess = Structure(np.eye(4), every, every, np.concatenate([ahead, between * 30]))
    found = from_essential_matrix(reference, guess, make_view(features[1], SCALE_FACTOR), CAMERA)
    np.testing.assert_array_equal(found.p_w[len(ahead) :], guess.p_w[len(ahead) :])
    assert (found.p_w[: len(ahead)] != ahead).any(1).sum() > 90
