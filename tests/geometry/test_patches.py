"""Patches found again in images whose motion is known exactly."""

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.patches import find, patch_warps, templates

CAMERA = Camera(320, 240, 260.0, 250.0, 155.0, 121.0)
SAME = np.tile(np.eye(2), (12, 1, 1))
PLACES = np.stack(np.meshgrid(np.linspace(60, 250, 4), np.linspace(50, 190, 3)), axis=-1).reshape(-1, 2)
NOISE = 3.0


def texture(u, v):
    """Grey values of a plane of waves, all around 120; nothing in it is longer than a patch."""
    return 120.0 + 30.0 * np.sin(0.9 * u + 0.3 * v) + 25.0 * np.sin(0.5 * u - 0.8 * v + 1.0) + 20.0 * np.sin(0.7 * v)


def image(to_texture=lambda u, v: (u, v), rng=None, brighter=0.0):
    """What a camera sees whose pixels ``(u, v)`` show the texture at ``to_texture(u, v)``."""
    v, u = np.mgrid[:240, :320].astype(float)
    grey = texture(*to_texture(u, v)) + brighter
    if rng is not None:
        grey = grey + rng.normal(0.0, NOISE, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shift", [(0.37, -0.81), (-1.3, 0.6)])
@pytest.mark.parametrize("brighter", [0.0, 25.0])
def test_a_shifted_patch_is_found_to_a_fiftieth_of_a_pixel(shift, brighter):
    seen = image(lambda u, v: (u - shift[0], v - shift[1]), brighter=brighter)
    found = find(seen, PLACES, templates(image(), PLACES, SAME))
    assert np.abs(found.uv - PLACES - shift).max() < 0.03
    assert found.sigma_px.max() < 0.1


def test_sigma_matches_the_noise(rng):
    off = []
    for _ in range(20):
        shift = rng.uniform(-0.8, 0.8, 2)
        seen = image(lambda u, v, s=shift: (u - s[0], v - s[1]), rng)
        found = find(seen, PLACES, templates(image(rng=rng), PLACES, SAME))
        off.append((found.uv - PLACES - shift) / found.sigma_px[:, None])
    assert 0.6 < np.std(off) < 1.2, "along the worst direction it is one, along the others less"
    assert abs(np.mean(off)) < 0.15


def test_nothing_is_found_on_a_bare_wall():
    bare = np.full((240, 320), 90, np.uint8)
    found = find(bare, PLACES, templates(bare, PLACES, SAME))
    assert np.isinf(found.sigma_px).all() and np.array_equal(found.uv, PLACES)


def test_a_point_in_the_other_cameras_plane_is_not_found():
    beside = np.eye(4)
    beside[2, 3] = -2.0
    warps = patch_warps(PLACES[:1], np.array([2.0]), beside, CAMERA)
    assert not np.isfinite(warps).all()
    found = find(image(), PLACES[:1], templates(image(), PLACES[:1], warps))
    assert np.isinf(found.sigma_px[0]) and np.isfinite(found.uv).all()


def test_warps_are_those_of_a_plane_that_is_parallel_to_the_image(rng):
    """Against projections of points of that plane, a tenth of a pixel apart."""
    T = se3.exp(np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.3]))
    depth = rng.uniform(1.5, 4.0, len(PLACES))
    warps = patch_warps(PLACES, depth, T, CAMERA)

    def seen(uv):
        return CAMERA.project(se3.transform(T, CAMERA.back_project(uv, depth)))

    for axis in (0, 1):
        step = np.eye(2)[axis] * 0.05
        slope = (seen(PLACES + step) - seen(PLACES - step)) / 0.1
        assert np.einsum("nij,nj->ni", warps, slope) == pytest.approx(
            np.tile(np.eye(2)[axis], (len(PLACES), 1)), abs=1e-4
        )


def test_a_distant_view_is_found_with_its_warp():
    """The camera that sees the texture twice as far away and turned by half a radian."""
    c, s = np.cos(0.5), np.sin(0.5)
    A = 1.4 * np.array([[c, -s], [s, c]])
    centre = PLACES[5]
    seen = image(
        lambda u, v: tuple(
            np.einsum("ij,jhw->ihw", A, np.stack([u, v]) - centre[:, None, None]) + centre[:, None, None]
        )
    )
    start = centre[None] + (0.7, -0.5)
    warped = find(seen, start, templates(image(), centre[None], A[None]))
    assert np.linalg.norm(warped.uv - centre) < 0.03
    straight = find(seen, start, templates(image(), centre[None], SAME[:1]))
    assert straight.sigma_px[0] > 5 * warped.sigma_px[0], "and what does not fit is not sure"


def test_a_straight_edge_is_unobservable_along_itself():
    v, u = np.mgrid[:240, :320].astype(float)
    edge = np.clip(128 + 60 * np.tanh(u - 60.0), 0, 255).astype(np.uint8)
    assert not (find(edge, PLACES, templates(edge, PLACES, SAME)).sigma_px < 0.5).any()
