"""Where up is by straight edges of a simulated world: segments that lie along three axes and across one of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.mapping.level.straight_edges import Segments, vertical

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""``R_w_c`` of a level camera that looks along x."""


DEPTH = 2.0


def cameras(count=24, pan_deg=60.0, pitch_deg=-20.0, roll_deg=0.0, moved=2.0):
    """Poses of a camera that pans about the vertical, and moves sideways."""
    held = Rotation.from_euler("ZX", [roll_deg, pitch_deg], degrees=True).as_matrix()
    pans = Rotation.from_euler("z", np.linspace(0.0, pan_deg, count)[:, None], degrees=True).as_matrix()
    T_w_c = np.tile(np.eye(4), (count, 1, 1))
    T_w_c[:, :3, :3] = pans @ LEVEL @ held
    T_w_c[:, 1, 3] = np.linspace(0.0, moved, count)
    return T_w_c


def room(rng, count=24, per_keyframe=20, verticals=0.3, clutter=0.2, noise_rad=0.01):
    """Verticals, horizontals of two main directions and of any, and clutter."""
    n = count * per_keyframe
    yaw = np.where(rng.random(n) < 0.6, rng.integers(0, 2, n) * np.pi / 2, rng.uniform(0, np.pi, n))
    d = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], axis=1)
    kind = rng.random(n)
    d[kind < verticals] = [0.0, 0.0, 1.0]
    random = kind > 1.0 - clutter
    d[random] = rng.normal(size=(random.sum(), 3))
    d += noise_rad * rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    normal = np.cross(d, rng.normal(size=(n, 3)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    keyframe = np.repeat(np.arange(count), per_keyframe)
    return Segments(normal, d, np.full(n, 0.05), rng.uniform(0.1, 0.3, n), keyframe)


def turned(segments, R):
    return Segments(
        segments.normal @ R.T, segments.direction @ R.T, segments.sigma_rad, segments.length, segments.keyframe
    )


@pytest.mark.parametrize("pitch_deg, roll_deg", [(0.0, 0.0), (-40.0, 0.0), (-30.0, 25.0), (15.0, -25.0)])
@pytest.mark.parametrize("verticals", [0.0, 0.3])
def test_a_room_gives_the_vertical_of_a_tilted_map(rng, pitch_deg, roll_deg, verticals):
    T_m_w = np.eye(4)
    T_m_w[:3, :3] = Rotation.from_euler("xyz", [0.6, -0.3, 1.0]).as_matrix()
    T_w_c = cameras(pitch_deg=pitch_deg, roll_deg=roll_deg)
    up = vertical(turned(room(rng, verticals=verticals), T_m_w[:3, :3]), T_m_w @ T_w_c, DEPTH)
    assert up is not None
    assert np.degrees(np.arccos(up.direction @ T_m_w[:3, 2])) < 1.0
    assert np.radians(1.0) < up.sigma_rad < np.radians(4.0)


@pytest.mark.parametrize(
    ("of_room", "of_camera", "focal_sigma"),
    [
        *(({}, {"roll_deg": roll}, 0.0) for roll in (90.0, -90.0, 80.0)),  # a phone held upright
        ({"clutter": 1.0, "verticals": 0.0}, {}, 0.0),
        ({"per_keyframe": 1}, {}, 0.0),
        ({}, {}, 0.45),
    ],
)
def test_rotated_phones_clutter_few_segments_and_an_uncertain_lens_give_no_vertical(
    rng, of_room, of_camera, focal_sigma
):
    assert vertical(room(rng, **of_room), cameras(**of_camera), DEPTH, focal_sigma=focal_sigma) is None


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_on_the_spot_horizontals_whose_directions_rest_on_depth_tell_nothing_but_verticals_do(rng, unit):
    on_the_spot = cameras(pan_deg=120.0, moved=0.1 * unit)
    assert vertical(room(rng, verticals=0.0), cameras(pan_deg=120.0, moved=2.0 * unit), DEPTH * unit) is not None
    assert vertical(room(rng, verticals=0.0), on_the_spot, DEPTH * unit) is None
    assert vertical(room(rng, verticals=0.6), on_the_spot, DEPTH * unit) is not None
