"""ORB keypoints spread over the image."""

import cv2
import numpy as np
import pytest
from rendered import CAMERA, patchwork, views

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.frontend.orb import OrbExtractor, spread
from edgeslam_torch.geometry.camera import PRESETS


def test_faint_corners_are_found_with_few_others():
    """A tenth of the contrast of a textured image: few corners pass the usual threshold, most the faint one."""
    faint = (128 + 0.1 * (views()[0][..., 1].astype(float) - 128)).astype(np.uint8)
    usual = OrbExtractor(OrbConfig(fast_faint=12), CAMERA)(faint)
    found = OrbExtractor(OrbConfig(), CAMERA)(faint)
    assert len(found.uv) > 2 * len(usual.uv) + 50
    assert found.faint


def test_keypoints_come_undistorted(rng):
    grey = patchwork(rng, 768, 900)[:480, :640, 0].copy()
    camera = PRESETS["tum_fr1"]
    bent = OrbExtractor(OrbConfig(), camera)(grey)
    straight = OrbExtractor(OrbConfig(), PRESETS["kinect"])(grey)
    np.testing.assert_allclose(bent.uv, camera.undistort_points(straight.uv), atol=1e-3)
    np.testing.assert_array_equal(bent.descriptors, straight.descriptors)


def test_corners_of_every_pyramid_level_are_unbiased(rng):
    """Squares drawn four times too large and shrunk: all four kinds of corner together are off by nothing.

    OpenCV's own positions are off by 0.5 to 1.5 px on the coarse levels, always up and to the left.
    """
    config = OrbConfig(features=5000)
    off, octave = [], []
    for _ in range(12):
        image, corners = _squares(rng)
        features = OrbExtractor(config, PRESETS["kinect"])(image)
        apart = features.uv[:, None] - corners[:, :2]
        nearest = np.linalg.norm(apart, axis=2).argmin(axis=1)
        off.append(np.c_[apart[np.arange(len(nearest)), nearest], corners[nearest, 2:]])
        octave.append(features.octave)
    off, octave = np.concatenate(off), np.concatenate(octave)
    near = np.linalg.norm(off[:, :2], axis=1) < 10.0
    for level in range(config.levels):
        here = off[near & (octave == level)]
        kinds = [here[(here[:, 2:] == (x, y)).all(axis=1), :2].mean(axis=0) for x in (-1, 1) for y in (-1, 1)]
        assert np.abs(np.mean(kinds, axis=0)).max() < 0.1 * config.scale_factor**level


def _squares(rng):
    """A 640x480 image of bright squares, and their corners ``(C, 4)``: pixel, and which side of the square."""
    finer, (height, width) = 4, (480, 640)
    large = np.full((height * finer, width * finer), 60, np.uint8)
    corners = []
    for y in range(40, height - 60, 110):
        for x in range(40, width - 60, 110):
            first = np.rint((rng.uniform(0, 30, 2) + (x, y) + 0.5) * finer).astype(int)
            last = first + rng.integers(35 * finer, 55 * finer)
            large[first[1] : last[1], first[0] : last[0]] = rng.integers(120, 250)
            sides = ((first, -1), (last, 1))
            corners += [(u[0] / finer - 0.5, v[1] / finer - 0.5, x, y) for u, x in sides for v, y in sides]
    image = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(image, (0, 0), 0.7), np.array(corners)


def test_spread_keeps_the_few_corners_of_a_weakly_textured_region(rng):
    """2000 strong corners on the left, 12 weak ones on the right: the right keeps its own."""
    left = rng.uniform([0, 0], [300, 480], (2000, 2))
    right = rng.uniform([500, 100], [640, 400], (12, 2))
    uv = np.concatenate([left, right]).astype(np.float32)
    score = np.r_[rng.uniform(50, 100, 2000), rng.uniform(1, 2, 12)]
    keep = spread(uv, score, 640, 480, 500)
    assert len(keep) == 500
    assert (np.diff(keep) > 0).all()
    assert (keep >= 2000).sum() == 12


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_constant_image_has_no_keypoints(grey):
    features = OrbExtractor(OrbConfig(), CAMERA)(np.full((240, 320), grey, np.uint8))
    assert features.uv.shape == (0, 2)
    assert features.descriptors.shape == (0, 32)
    assert len(features.octave) == len(features.angle_rad) == 0


def test_spread_takes_the_strongest_of_a_cell():
    uv = np.tile([[10.0, 10.0]], (9, 1)).astype(np.float32)
    assert spread(uv, np.arange(9.0), 640, 480, 3).tolist() == [6, 7, 8]


def _joints(rng, grey):
    """Draws the rough joints of a bare wall, which do not cross; returns points on them, away from the ends."""
    points = []
    for y in range(40, 440, 40):
        line = np.linspace([340.0, y], [620.0, y + rng.uniform(-18, 18)], 60)
        rough = line + rng.normal(0, 0.3, line.shape)
        cv2.polylines(grey, [np.rint(16 * rough).astype(np.int32)], False, 70, 3, shift=4)
        points.append(line[0] + np.linspace(0.15, 0.85, 200)[:, None] * (line[-1] - line[0]))
    return np.concatenate(points)


def test_keypoints_slide_along_edges_and_stay_on_corners_where_there_are_enough(rng):
    wall = np.full((480, 640), 190, np.uint8)
    wall[:300, :200] = patchwork(rng, 768, 900)[:300, :200, 0]
    joints = _joints(rng, wall)
    noisy = np.clip(wall + rng.normal(0, 2, wall.shape), 0, 255).astype(np.uint8)
    everything = np.array(cv2.KeyPoint.convert(cv2.ORB.create(1500, fastThreshold=7).detect(noisy)))
    kept = OrbExtractor(OrbConfig(), PRESETS["kinect"])(noisy).uv
    on_joints = [np.linalg.norm(uv[:, None] - joints, axis=2).min(1) < 3.0 for uv in (everything, kept)]
    assert on_joints[0].sum() > 100
    assert on_joints[1].sum() < 0.1 * on_joints[0].sum()
    assert (kept[:, 0] < 300).sum() > 300


def test_without_corners_keypoints_on_edges_are_better_than_none(rng):
    wall = np.full((480, 640), 190, np.uint8)
    joints = _joints(rng, wall)
    noisy = np.clip(wall + rng.normal(0, 2, wall.shape), 0, 255).astype(np.uint8)
    kept = OrbExtractor(OrbConfig(), PRESETS["kinect"])(noisy).uv
    assert (np.linalg.norm(kept[:, None] - joints, axis=2).min(1) < 3.0).sum() > 100
