"""Following the last keyframe's keypoints by optical flow."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from point_map import add_anchors
from rendered import CAMERA, sideways, stairs_world

from edgeslam_torch.config import FlowConfig, MappingConfig, OrbConfig
from edgeslam_torch.frontend.image import as_grey
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import NO_ANCHOR, make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.tracking.flow import (
    LEVELS,
    MIN_SHARE,
    NEAR_LEVELS,
    FlowTracker,
    join,
    template_of_keyframe,
    template_of_track,
    with_followed,
)
from edgeslam_torch.tracking.keyframe_choice import few_matches, is_due, lost_most, lost_sight
from edgeslam_torch.tracking.tracker import Track, make_view

ORB = OrbConfig(features=500)
MIN_INLIERS = 25
POSES = sideways(4, 0.05, turn_rad=0.01)


class Scene:
    """One keyframe in front of the panels, with anchors at their rendered positions."""

    def __init__(self, camera=CAMERA):
        self.camera = camera
        seen = render(stairs_world(), CAMERA, POSES[0])
        self.grey = as_grey(seen.image)
        features = OrbExtractor(ORB, CAMERA)(self.grey)
        self.map = SlamMap(ORB.scale_factor, ORB.levels)
        self.keyframe = make_keyframe(0, 0, 0.0, se3.inverse(POSES[0]), features)
        column, row = np.rint(features.uv).astype(int).T
        p_c = CAMERA.back_project(features.uv, seen.depth_m[row, column])
        ids = add_anchors(self.map, se3.transform(POSES[0], p_c), self.keyframe.words)
        self.map.add_keyframe(self.keyframe)
        self.map.observe(self.keyframe, np.arange(len(ids)), ids)
        self.template = template_of_keyframe(self.keyframe, self.grey)

    def tracker(self, **settings):
        return FlowTracker(self.map, self.camera, ORB, FlowConfig(**settings), MIN_INLIERS)


@pytest.fixture
def scene():
    return Scene()


def grey_at(T_w_c):
    return as_grey(render(stairs_world(), CAMERA, T_w_c).image)


def error(T_c_w, T_w_c):
    xi = se3.log(T_c_w @ T_w_c)
    return np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])


@pytest.mark.parametrize("frame", [0, 1, 3])
def test_pose_is_accurate_to_half_a_pixel_from_a_prediction_error_of_ten(scene, frame):
    """Panels 1.6 to 4 m away; at frame 3 they have moved by 10 to 30 pixels."""
    off = se3.exp(np.array([0.02, -0.02, 0.02, 0.008, -0.008, 0.008]))
    followed = scene.tracker().follow(scene.template, grey_at(POSES[frame]), off @ se3.inverse(POSES[frame]))
    translation, rotation = error(followed.track.T_c_w, POSES[frame])
    assert translation < 0.01  # half a pixel at their distance
    assert rotation < 0.004
    assert followed.share > 0.6
    assert (np.sqrt(np.diag(followed.track.covariance)) < 0.02).all()


def test_the_number_of_tracked_keypoints_is_limited_and_they_are_spread(scene):
    tracker = scene.tracker(points=60)
    track = tracker.follow(scene.template, scene.grey, scene.keyframe.T_c_w).track
    assert track.matches <= 60
    uv = scene.keyframe.features.uv[track.matched_keypoint]
    assert len({(int(u // 80), int(v // 80)) for u, v in uv}) >= 11  # cells of a 4 x 3 grid


def test_keypoints_out_of_view_count_against_the_share(scene, monkeypatch):
    """Turned until a part has left the image: what is left tells the pose, and the share that it is less."""
    turned = POSES[0] @ se3.exp(np.array([0, 0, 0, 0, 0.3, 0]))
    here = scene.tracker().follow(scene.template, scene.grey, scene.keyframe.T_c_w)
    monkeypatch.setattr("edgeslam_torch.tracking.flow.MIN_SHARE", 0.2)
    followed = scene.tracker().follow(scene.template, grey_at(turned), se3.inverse(turned))
    assert followed.share < here.share - 0.2
    assert error(followed.track.T_c_w, turned)[0] < 0.01
    assert lost_sight(followed)
    assert not lost_sight(replace(followed, share=1.0))
    assert not lost_most(replace(followed, share=0.85))
    assert lost_most(replace(followed, share=0.6))


def test_a_pose_uses_the_keypoints_in_view(scene):
    """A third of the template is left, and nearly all of that is found: no reason to be lost."""
    turned = POSES[0] @ se3.exp(np.array([0, 0, 0, 0, 0.75, 0]))
    followed = scene.tracker().follow(scene.template, grey_at(turned), se3.inverse(turned))
    assert followed.share < MIN_SHARE
    assert followed.trusted
    assert error(followed.track.T_c_w, turned)[0] < 0.02


def test_few_inliers_in_view_give_a_prediction_but_no_pose(scene):
    """Most of the image is blurred: what is left agrees, and is no evidence about the other anchors."""
    grey = scene.grey.copy()
    left = grey.shape[1] // 4
    grey[:, left:] = cv2.GaussianBlur(grey[:, left:], (0, 0), 15.0)
    before = scene.map.anchors.visible.copy()
    followed = scene.tracker().follow(scene.template, grey, scene.keyframe.T_c_w)
    assert not followed.trusted
    assert followed.share < MIN_SHARE
    assert error(followed.track.T_c_w, POSES[0])[0] < 0.05
    np.testing.assert_array_equal(scene.map.anchors.visible, before)


def test_all_pyramid_levels_are_used_only_if_they_find_more(scene, monkeypatch):
    """Coarse levels lose keypoints near the border of the image."""
    tracker, tried = scene.tracker(), []
    found = FlowTracker._locate

    def locate(self, template, grey, keypoint, guess, T_c_w, levels, expected):
        tried.append(levels)
        some = keypoint[: len(keypoint) // (2 if levels == NEAR_LEVELS else 4)]
        return found(self, template, grey, some, guess[: len(some)], T_c_w, levels, expected)

    monkeypatch.setattr(FlowTracker, "_locate", locate)
    followed = tracker.follow(scene.template, scene.grey, scene.keyframe.T_c_w)
    assert tried == [NEAR_LEVELS, LEVELS]
    assert 0.4 < followed.share < 0.55


@pytest.mark.parametrize("what", ["black", "noise", "elsewhere", "behind"])
def test_an_image_that_does_not_show_the_template_has_no_pose(scene, rng, what):
    T_c_w = scene.keyframe.T_c_w
    image = {
        "black": np.zeros_like(scene.grey),
        "noise": rng.integers(0, 256, scene.grey.shape, dtype=np.uint8),
        "elsewhere": np.ascontiguousarray(scene.grey[::-1, ::-1]),
        "behind": scene.grey,
    }[what]
    if what == "behind":
        T_c_w = se3.exp(np.array([0, 0, 0, 0, np.pi, 0])) @ T_c_w
    before = scene.map.anchors.visible.copy()
    followed = scene.tracker().follow(scene.template, image, T_c_w)
    assert followed is None or not followed.trusted
    np.testing.assert_array_equal(
        scene.map.anchors.visible, before
    )  # a frame without texture is no evidence about an anchor


def test_anchors_that_are_seen_and_found_are_counted(scene):
    anchors = scene.map.anchors
    visible, found = anchors.visible.copy(), anchors.found.copy()
    track = scene.tracker().follow(scene.template, grey_at(POSES[1]), se3.inverse(POSES[1])).track
    assert (anchors.found - found)[track.anchor].tolist() == [1] * track.inliers
    assert ((anchors.visible - visible) >= (anchors.found - found)).all()
    assert (anchors.found - found).sum() == track.inliers


def test_a_lens_changes_nothing_but_the_pixels(scene):
    """The same view through a lens with the distortion of a cheap camera."""
    lens = replace(CAMERA, distortion=(0.12, -0.2, 0.001, -0.001, 0.0))

    def through(grey):
        """Every pixel of the distorted image shows what the pinhole camera sees along its ray."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        at = lens.undistort_points(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32))
        x, y = at.T.reshape(2, CAMERA.height, CAMERA.width)
        return cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    tracker = FlowTracker(scene.map, lens, ORB, FlowConfig(), MIN_INLIERS)
    template = template_of_keyframe(scene.keyframe, through(scene.grey))
    followed = tracker.follow(template, through(grey_at(POSES[1])), se3.inverse(POSES[1]))
    translation, rotation = error(followed.track.T_c_w, POSES[1])
    assert translation < 0.01  # half a pixel at their distance
    assert rotation < 0.004


def test_a_matched_frame_can_be_followed_without_being_a_keyframe(scene):
    """Only its matched keypoints are tracked, from their own pixels."""
    view = make_view(scene.keyframe.features, ORB.scale_factor)
    keypoint = np.arange(0, len(view.features.uv), 2)
    anchor = scene.keyframe.anchor[keypoint]
    track = Track(scene.keyframe.T_c_w, keypoint, anchor, keypoint, anchor, np.eye(6))
    template = template_of_track(track, view, scene.keyframe, scene.grey)
    assert (np.flatnonzero(template.anchor != NO_ANCHOR) == keypoint).all()
    assert template.keyframe_id == scene.keyframe.id
    followed = scene.tracker().follow(template, grey_at(POSES[1]), se3.inverse(POSES[1]))
    assert error(followed.track.T_c_w, POSES[1])[0] < 0.01


def test_pixels_of_flow_become_keypoints_with_their_anchors_descriptors(scene):
    grey = grey_at(POSES[1])
    followed = scene.tracker().follow(scene.template, grey, se3.inverse(POSES[1]))
    view = make_view(OrbExtractor(ORB, CAMERA)(grey), ORB.scale_factor)
    features, track = with_followed(view, followed, scene.map.anchors.words)
    count = len(view.features.uv)
    assert len(features.uv) == len(features.angle_rad) == count + followed.track.inliers
    np.testing.assert_array_equal(features.uv[:count], view.features.uv)
    np.testing.assert_array_equal(features.uv[track.keypoint], followed.uv)
    np.testing.assert_array_equal(features.octave[track.keypoint], followed.octave)
    np.testing.assert_array_equal(words(features.descriptors)[track.keypoint], scene.map.anchors.words[track.anchor])
    np.testing.assert_array_equal(track.anchor, followed.track.anchor)


# -- when a keyframe is due -----------------------------------------------------------------------------------------


def test_keyframe_by_view_change_parallax_or_time_but_not_at_once():
    config = MappingConfig(keyframe_min_gap_s=0.15, keyframe_max_gap_s=1.0, keyframe_parallax_deg=4.0)
    little, some, much = np.deg2rad([0.5, 2.0, 5.0])
    assert not is_due(True, much, 0.13, config)
    assert is_due(True, little, 0.17, config)
    assert is_due(False, much, 0.17, config)
    assert not is_due(False, some, 0.97, config)
    assert is_due(False, some, 1.0, config)
    assert is_due(True, little, 0.067, config, at_once=True)
    assert not is_due(True, little, 0.033, config, at_once=True)
    assert not is_due(False, little, 33.0, config)  # a drone that hovers makes no keyframes
    assert is_due(False, little, 1.0, config, leans=True)
    assert not is_due(False, little, 0.97, config, leans=True)  # at most one a second


def test_few_matches_is_decided_by_stable_anchors(scene):
    """With three keyframes, none of 500 anchors seen by a single keyframe counts."""
    ids = scene.keyframe.anchor
    track = Track(scene.keyframe.T_c_w, np.arange(30), ids[:30], np.arange(30), ids[:30], np.eye(6))
    assert few_matches(track, scene.keyframe, scene.map)
    for id in (1, 2):
        other = make_keyframe(id, id, float(id), se3.inverse(POSES[id]), scene.keyframe.features)
        scene.map.add_keyframe(other)
    assert not few_matches(track, scene.keyframe, scene.map)


def test_keypoints_are_selected_again_when_the_map_changes(scene):
    tracker, at = scene.tracker(points=1000), se3.inverse(POSES[0])
    before = tracker.follow(scene.template, scene.grey, at).track.anchor
    scene.map.remove_anchors(before[:50])
    after = tracker.follow(scene.template, scene.grey, at).track.anchor
    assert not np.isin(before[:50], after).any()
    free = np.flatnonzero(scene.keyframe.anchor == NO_ANCHOR)[:50]
    p_w = scene.map.anchors.p_w[before[:50]]  # a removed anchor's row still says where it was
    ids = add_anchors(scene.map, p_w, scene.keyframe.words[free])
    scene.map.observe(scene.keyframe, free, ids)
    assert np.isin(ids, tracker.follow(scene.template, scene.grey, at).track.matched_anchor).sum() > 40


def test_dissimilar_patches_are_rejected(scene, rng, monkeypatch):
    """The left half of the frame is noise: flow ends somewhere there too, but nothing of it counts as found."""
    image = scene.grey.copy()
    image[:, :160] = rng.integers(0, 256, (240, 160), dtype=np.uint8)
    monkeypatch.setattr("edgeslam_torch.tracking.flow.MIN_SHARE", 0.2)
    followed = scene.tracker(points=1000).follow(scene.template, image, scene.keyframe.T_c_w)
    looked_for = scene.keyframe.features.uv[scene.keyframe.keypoints_with_anchor()]
    found = scene.keyframe.features.uv[followed.track.matched_keypoint]
    assert (found[:, 0] > 170).sum() > 0.9 * (looked_for[:, 0] > 170).sum()
    assert (found[:, 0] < 150).sum() < 0.1 * (looked_for[:, 0] < 150).sum()


def test_flow_weighs_keypoints_by_their_level(scene):
    """The same image again: every pixel fits, and keypoints of level 3 tell the pose 1.728 times less precisely."""
    covariances = []
    for octave in (0, 3):
        template = replace(scene.template, octave=np.full_like(scene.template.octave, octave))
        followed = scene.tracker().follow(template, scene.grey, scene.keyframe.T_c_w)
        assert followed.track.inliers == followed.track.matches
        covariances.append(followed.track.covariance)
    np.testing.assert_allclose(covariances[1], 1.2**6 * covariances[0], rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize(("off_px", "shows_it"), [(1.0, True), (3.0, False)])
def test_a_free_keypoint_is_assigned_only_near_the_flow_result(scene, off_px, shows_it):
    """At level 0 the tolerance is 1.5 px."""
    all_found = scene.tracker().follow(scene.template, scene.grey, scene.keyframe.T_c_w)
    one, none = np.array([5]), np.zeros(0, np.int64)
    anchor = all_found.track.anchor[one]
    found = replace(all_found, track=replace(all_found.track, anchor=anchor), uv=all_found.uv[one], octave=0 * one)
    features = OrbExtractor(ORB, CAMERA)(scene.grey)
    uv = np.full_like(features.uv, -1000.0)
    uv[7] = found.uv[0] + np.float32([off_px, 0.0])
    view = make_view(replace(features, uv=uv, octave=np.zeros_like(features.octave)), ORB.scale_factor)
    joined = join(Track(np.eye(4), none, none, none, none, np.eye(6)), found, view, ORB.scale_factor)
    assert joined.keypoint.tolist() == ([7] if shows_it else [])
    assert joined.anchor.tolist() == (anchor.tolist() if shows_it else [])
