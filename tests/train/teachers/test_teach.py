"""Depth by plane sweep, on a slanted textured wall seen from known places."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.train.teachers.plane_sweep import aggregate, sweep_depth
from edgeslam_torch.train.teachers.teach import densify

K = np.array([[100.0, 0.0, 59.5], [0.0, 100.0, 44.5], [0.0, 0.0, 1.0]])
NORMAL, DISTANCE = np.array([0.3, 0.1, -1.0]), -2.0
"""The wall: all points with ``normal . p = distance`` in the reference camera."""
INVERSE = np.linspace(1 / 4.0, 1 / 1.0, 40)


def texture(rng):
    """Blobs of a few pixels, grey levels 0 to 255."""
    noise = cv2.GaussianBlur(rng.normal(size=(90, 120)).astype(np.float32), (0, 0), 1.5)
    return np.asarray(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX), np.float32)


def seen_from(reference, T):
    """The wall's picture in a camera at ``T`` (reference to camera): an exact homography."""
    H = K @ (T[:3, :3] + np.outer(T[:3, 3], NORMAL) / DISTANCE) @ np.linalg.inv(K)
    return np.asarray(cv2.warpPerspective(reference, H, (120, 90), borderValue=0), np.float32)


def wall_depth():
    u, v = np.meshgrid(np.arange(120), np.arange(90))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    return DISTANCE / (rays @ NORMAL)


def moved(*t):
    T = np.eye(4)
    T[:3, 3] = t
    T[:3, :3], _ = cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))
    return T


@pytest.mark.parametrize(
    "places",
    [[(0.15, 0, 0), (-0.15, 0, 0), (0.2, 0.05, 0)], [(0, 0, -0.35), (0, 0, 0.35), (0.02, 0, -0.5)]],
    ids=["sideways", "forward"],
)
def test_slanted_wall_is_measured(places, rng):
    reference = texture(rng)
    motions = [moved(*p) for p in places]
    depth = sweep_depth(reference, [seen_from(reference, T) for T in motions], motions, K, INVERSE)
    error = np.abs(depth / wall_depth() - 1)
    # Straight ahead nothing moves when the camera goes forward.
    u, v = np.meshgrid(np.arange(120), np.arange(90))
    inside = (u > 12) & (u < 108) & (v > 10) & (v < 80) & (np.hypot(u - 59.5, v - 44.5) > 15)
    assert np.median(error[inside]) < 0.02
    assert np.mean(error[inside] < 0.06) > 0.9


def test_what_one_neighbour_does_not_see_is_taken_from_the_others(rng):
    reference = texture(rng)
    motions = [moved(0.15, 0, 0), moved(-0.15, 0, 0), moved(0.1, 0.1, 0), moved(-0.1, 0.1, 0)]
    images = [seen_from(reference, T) for T in motions]
    images[0][:] = texture(np.random.default_rng(9))
    depth = sweep_depth(reference, images, motions, K, INVERSE)
    assert np.mean((np.abs(depth / wall_depth() - 1) < 0.06)[12:78, 15:105]) > 0.85


def scene():
    """Log depth of a tilted wall, and a network's view of it: 30 % too far on the left, right on the right."""
    true = np.log(np.linspace(1.5, 3.0, 160, dtype=np.float32))[None].repeat(120, 0)
    wrong = true + np.linspace(0.3, 0.0, 160, dtype=np.float32)[None]
    return true, wrong


def test_points_correct_the_network_smoothly(rng):
    true, wrong = scene()
    uv = np.stack([rng.uniform(0, 159, 600), rng.uniform(0, 119, 600)], 1)
    log_z = true[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)]
    out = densify(wrong, uv, log_z)
    assert np.abs(out - true).mean() < 0.2 * np.abs(wrong - true).mean()
    assert np.abs(np.diff(out - wrong, axis=1)).max() < 0.02, "no steps at the points"


def test_one_outlier_changes_little(rng):
    true, _ = scene()
    uv = np.stack([rng.uniform(0, 159, 300), rng.uniform(0, 119, 300)], 1)
    log_z = true[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)].copy()
    log_z[7] += 1.5
    assert np.abs(densify(true, uv, log_z) - true).max() < 0.02


def test_bare_pixels_follow_their_neighbours():
    """Uninformative costs take the plane of their surroundings; informative ones keep their minimum."""
    cost = np.full((8, 20, 20), 1.0, np.float32)
    cost[3] = 0.2
    cost[:, 6:14, 6:14] = 0.7
    cost[6, 0, 0] = 0.0
    found = aggregate(cost, np.zeros((20, 20), np.float32)).argmin(2)
    assert (found[1:] == 3).all()


def test_far_from_points_the_median_ratio_is_used():
    uv = np.stack([np.linspace(5, 20, 40), np.linspace(5, 20, 40)], 1)
    out = densify(np.zeros((120, 160), np.float32), uv, np.full(40, 0.25))
    assert out[110, 150] == pytest.approx(0.25, abs=1e-3)
