"""Keypoints of rendered views against the projections of true points."""

import numpy as np
import pytest
from point_map import add_anchors
from rendered import CAMERA, film, sideways, stairs_world, wall

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.frontend.image import as_grey
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.sub_pixel import SIGMA_PX, align
from edgeslam_torch.synthetic.house.world import World

SCALE = 1.2


def corners_of(flight):
    return [OrbExtractor(OrbConfig(), CAMERA)(as_grey(f.image)) for f in flight.frames]


def a_map(flight):
    """A map of all frames and its keyframes: an anchor for every corner of the first one; true poses and depths."""
    slam_map, keyframes = SlamMap(SCALE), []
    for k, (features, frame) in enumerate(zip(corners_of(flight), flight.frames, strict=True)):
        keyframe = make_keyframe(slam_map.next_keyframe_id(), k, 0.1 * k, se3.inverse(flight.T_w_c[k]), features)
        keyframe.grey = as_grey(frame.image)
        keyframes.append(keyframe)
    first = keyframes[0]
    u, v = np.rint(first.features.uv).astype(int).T
    p_w = se3.transform(flight.T_w_c[0], CAMERA.back_project(first.features.uv, flight.depth_m[0][v, u]))
    ids = add_anchors(slam_map, p_w, first.features.descriptors)
    first.anchor[:] = ids
    for other in keyframes[1:]:
        uv = CAMERA.project(se3.transform(other.T_c_w, p_w))
        away = np.linalg.norm(uv[None] - other.features.uv[:, None], axis=2)
        nearest = away.argmin(1)
        pairs = np.flatnonzero(away[np.arange(len(nearest)), nearest] < 1.2 * SCALE**other.features.octave)
        _, once = np.unique(nearest[pairs], return_index=True)
        other.anchor[pairs[once]] = ids[nearest[pairs[once]]]
    for keyframe in keyframes:
        slam_map.add_keyframe(keyframe)
    return slam_map, keyframes


@pytest.fixture
def seen():
    """Three views of panels at several depths, 10 cm and a degree apart."""
    return a_map(film(stairs_world(), CAMERA, sideways(3, 0.1, turn_rad=0.02)))


def off_px(slam_map, keyframe, keypoint):
    """Distances [px] of keypoints from where their anchors really are."""
    p_c = se3.transform(keyframe.T_c_w, slam_map.anchors.p_w[keyframe.anchor[keypoint]])
    return np.linalg.norm(CAMERA.project(p_c) - keyframe.features.uv[keypoint], axis=1)


def test_aligned_keypoints_are_several_times_nearer_to_the_truth(seen):
    slam_map, (first, second, _) = seen
    held = second.keypoints_with_anchor()
    before = np.median(off_px(slam_map, second, held))
    as_it_was = first.features.uv.copy()
    count = align(slam_map, second, CAMERA)
    aligned = np.flatnonzero(np.isfinite(second.aligned_px))
    assert count == len(aligned) > 0.7 * len(held)
    assert before > 0.3
    assert np.median(off_px(slam_map, second, aligned)) < 0.3 * before
    assert np.array_equal(first.features.uv, as_it_was), "the first view is what they are aligned with"


def test_a_third_view_is_aligned_with_the_first_one_not_with_the_second(seen):
    slam_map, (first, second, third) = seen
    shared = np.isin(third.anchor, second.anchor[second.anchor >= 0]) & (third.anchor >= 0)
    second.features.uv[:] += 0.8  # whatever it says
    align(slam_map, third, CAMERA)
    good = np.flatnonzero(shared & np.isfinite(third.aligned_px))
    assert len(good) > 30 and np.median(off_px(slam_map, third, good)) < 0.2
    assert np.isfinite(first.aligned_px).any() and np.isnan(second.aligned_px).all()


def test_a_mismatched_keypoint_is_not_aligned(seen):
    slam_map, (_, second, _) = seen
    wrong = second.keypoints_with_anchor()[::4]
    second.features.uv[wrong] += (6.0 * SCALE ** second.features.octave[wrong])[:, None].astype(np.float32)
    align(slam_map, second, CAMERA)
    as_they_were = np.isnan(second.aligned_px[wrong])
    assert as_they_were.mean() > 0.9


def test_sigmas_include_the_limit_and_the_noise(seen):
    slam_map, (first, second, _) = seen
    align(slam_map, second, CAMERA)
    aligned = np.isfinite(second.aligned_px)
    limit = SIGMA_PX * SCALE ** second.features.octave[aligned]
    assert (second.aligned_px[aligned] > limit).all() and (second.aligned_px[aligned] < np.hypot(limit, 0.5)).all()
    partners = np.isin(first.anchor, second.anchor[aligned])
    assert first.aligned_px[partners] == pytest.approx(SIGMA_PX * SCALE ** first.features.octave[partners])
    assert np.isnan(first.aligned_px[~partners]).all()


def test_a_view_from_half_as_far_is_aligned_as_well():
    """Depths of 2 m, then of 1.2: patches have grown by a half and more."""
    rng = np.random.default_rng(1)
    flight = film(World([wall(rng, 2.4, 3.0, 1024)]), CAMERA, sideways(2, 0.05, forward_m=0.9))
    slam_map, keyframes = a_map(flight)
    align(slam_map, keyframes[1], CAMERA)
    aligned = np.flatnonzero(np.isfinite(keyframes[1].aligned_px))
    assert len(aligned) > 40 and np.median(off_px(slam_map, keyframes[1], aligned)) < 0.25


def test_without_an_image_nothing_is_aligned(seen):
    slam_map, (first, second, _) = seen
    second.grey = None
    before = second.features.uv.copy()
    assert align(slam_map, second, CAMERA) == 0 and np.array_equal(second.features.uv, before)
    second.grey, first.grey = first.grey, None
    assert align(slam_map, second, CAMERA) == 0
    assert np.array_equal(second.features.uv, before) and np.isnan(second.aligned_px).all()


def test_anchors_behind_a_view_are_not_aligned(seen):
    slam_map, (first, second, third) = seen
    slam_map.anchors.p_w[first.anchor] -= 10.0 * first.T_w_c[:3, 2]
    assert align(slam_map, second, CAMERA) == align(slam_map, third, CAMERA) == 0
