"""L-junctions on rendered frames with known corners, and on real frames that are turned."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.frontend.corners import JunctionConfig, detect_junctions


def polygon(rng, centre, radius, sides):
    """A convex polygon ``(sides, 2)`` with corners of 60 to 140 degrees, clockwise as seen."""
    step = 2 * np.pi / sides
    angle = rng.uniform(0, 2 * np.pi) + step * (np.arange(sides) + rng.uniform(-0.12, 0.12, sides))
    return centre + radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def coverage(p):
    """Share of each pixel that a convex polygon covers, by an 8 x 8 grid in each, with rows and columns."""
    lo, hi = np.floor(p.min(0)).astype(int) - 1, np.ceil(p.max(0)).astype(int) + 2
    fine = (np.arange(8) + 0.5) / 8 - 0.5
    u = (np.arange(lo[0], hi[0])[:, None] + fine).ravel()
    v = (np.arange(lo[1], hi[1])[:, None] + fine).ravel()
    inside = np.ones((len(v), len(u)), bool)
    for a, b in zip(p, np.roll(p, -1, 0), strict=True):
        inside &= (b[0] - a[0]) * (v[:, None] - a[1]) - (b[1] - a[1]) * (u - a[0]) >= 0
    share = inside.reshape(hi[1] - lo[1], 8, hi[0] - lo[0], 8).mean((1, 3))
    return slice(lo[1], hi[1]), slice(lo[0], hi[0]), share


def frame(rng, noise=2.0):
    """A grey image of polygons, and their corners with both neighbours ``(C, 3, 2)``."""
    image = np.full((480, 640), 90.0)
    truth = []
    for row in range(3):
        for column in range(4):
            centre = np.array([80 + 160 * column, 80 + 160 * row]) + rng.uniform(-6, 6, 2)
            sides = 3 + (row + column) % 3
            p = polygon(rng, centre, rng.uniform(45, 62), sides)
            v, u, share = coverage(p)
            image[v, u] += share * (rng.choice([20, 40, 170, 220]) - 90.0)
            truth += [(p[k], p[k - 1], p[(k + 1) % sides]) for k in range(sides)]
    blurred = cv2.GaussianBlur(image, (0, 0), 0.6) + noise * rng.normal(size=image.shape)
    return np.clip(np.round(blurred), 0, 255).astype(np.uint8), np.array(truth)


def detect(grey, config=None):
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0)
    return detect_junctions(grey, cv2.Canny(smooth, 30, 80, L2gradient=True), config)


def matched(found, truth, radius=3.0):
    """Indices of found junctions and of the true ones nearest to them."""
    distance = np.linalg.norm(found.uv[:, None] - truth[None, :, 0], axis=2)
    nearest = distance.argmin(1)
    good = distance.min(1) < radius
    return np.flatnonzero(good), nearest[good]


@pytest.fixture(scope="module")
def found_and_true():
    return [(detect(image), truth) for image, truth in (frame(np.random.default_rng(seed)) for seed in range(6))]


def test_corners_are_found_and_nothing_else(found_and_true):
    hits = total = false = 0
    for found, truth in found_and_true:
        mine, theirs = matched(found, truth)
        hits += len(np.unique(theirs))
        total += len(truth)
        false += len(found) - len(mine)
        assert len(np.unique(theirs)) == len(theirs), "a corner was found twice"
    assert hits / total > 0.9
    assert false / total < 0.02


def test_position_angle_and_arms_are_accurate(found_and_true):
    position, direction, angle = [], [], []
    for found, truth in found_and_true:
        mine, theirs = matched(found, truth)
        position.append(np.linalg.norm(found.uv[mine] - truth[theirs, 0], axis=1))
        true_arms = truth[theirs, 1:] - truth[theirs, :1]
        true_arms /= np.linalg.norm(true_arms, axis=2, keepdims=True)
        # clockwise as seen with v down: the cross product of first and second arm is positive
        cross = true_arms[:, 0, 0] * true_arms[:, 1, 1] - true_arms[:, 0, 1] * true_arms[:, 1, 0]
        true_arms[cross < 0] = true_arms[cross < 0][:, ::-1]
        dots = (found.arms[mine] * true_arms).sum(2)
        direction.append(np.degrees(np.arccos(np.clip(dots, -1, 1))))
        true_angle = np.arccos(np.clip((true_arms[:, 0] * true_arms[:, 1]).sum(1), -1, 1))
        angle.append(np.degrees(np.abs(found.angle_rad[mine] - true_angle)))
    assert np.median(np.concatenate(position)) < 0.1
    assert np.quantile(np.concatenate(position), 0.95) < 0.6
    assert np.median(np.concatenate(direction)) < 0.4
    assert np.median(np.concatenate(angle)) < 0.5
    assert np.quantile(np.concatenate(angle), 0.95) < 2.5


def test_sigma_matches_the_error(found_and_true):
    z = []
    for found, truth in found_and_true:
        mine, theirs = matched(found, truth)
        z.append((found.uv[mine] - truth[theirs, 0]) / found.sigma_px[mine, None])
    spread = 1.4826 * np.median(np.abs(np.concatenate(z)))
    assert 0.4 < spread < 2.0


def test_round_and_straight_contours_are_no_corners():
    image = np.full((480, 640), 60, np.uint8)
    cv2.circle(image, (200, 240), 90, 200, -1, cv2.LINE_AA)
    cv2.ellipse(image, (450, 240), (120, 60), 30, 0, 360, 200, -1, cv2.LINE_AA)
    image[:, 600:] = 200
    assert len(detect(image)) == 0


@pytest.mark.parametrize("image", [np.zeros((480, 640), np.uint8), np.full((64, 64), 255, np.uint8)])
def test_an_image_without_edges_has_none(image):
    found = detect(image)
    assert len(found) == 0
    assert found.arms.shape == (0, 2, 2)
    assert found.arm_points(4)[0].shape == (0, 2, 4, 2)


def test_most_keeps_the_longest_arms(rng):
    image, _ = frame(rng)
    everything, few = detect(image), detect(image, JunctionConfig(most=5))
    assert len(few) == 5
    np.testing.assert_array_equal(few.uv, everything.uv[:5])


def check_turning(grey, least):
    """Turning an image by a right angle moves no pixel value, so nearly all junctions must come again."""
    found = detect(grey)
    again = detect(np.ascontiguousarray(cv2.rotate(grey, cv2.ROTATE_90_COUNTERCLOCKWISE)))
    back = np.stack([grey.shape[1] - 1 - again.uv[:, 1], again.uv[:, 0]], 1)
    assert len(found) >= least
    distance = np.linalg.norm(found.uv[:, None] - back[None], axis=2).min(1)
    assert (distance < 1.0).mean() > 0.8
    assert np.median(distance[distance < 1.0]) < 0.2


def test_turning_a_rendered_image_turns_its_junctions(rng):
    check_turning(frame(rng)[0], least=30)
