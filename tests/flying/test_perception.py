"""Views and states of the SLAM perception."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.flying.perception.home import Home
from edgeslam_torch.flying.perception.slam_perception import SlamPerception, _contradicted
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD, camera_on_body
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.types import DepthMap, ScaleEstimate

CAMERA = PRESETS["tello"].scaled(480, 360)
DISTANCE_M = 1.5
"""Of a wall across the camera's axis."""


def a_map(points, edges=None, fresh=None):
    """A SLAM with points ``(N, 3)`` and edges, and given pixels and depths of the newest frame's edges."""
    none = np.zeros((0, 2)), np.zeros(0)
    return SimpleNamespace(
        surroundings=lambda: (points, np.zeros((0, 3)) if edges is None else edges),
        fresh_edges=fresh or (lambda image, nearest, farthest: none),
    )


@pytest.fixture
def perception():
    """Eyes whose network says twice the distance of everything, and whose map has points of the wall."""
    made = SlamPerception(CAMERA)
    told = DepthMap(np.full((360, 480), 2.0 * DISTANCE_M, np.float32), np.full((360, 480), 0.2, np.float32))
    across = np.linspace(-0.4, 0.4, 10)
    points = np.array([[x, y, DISTANCE_M] for x in across for y in across])
    made._network = lambda image, camera: told
    made._slam = a_map(points)
    return made


def bare_wall():
    """A grey picture ``(360, 480, 3)``, brighter towards one side."""
    return np.broadcast_to(np.linspace(120, 140, 480)[None, :, None], (360, 480, 3)).astype(np.uint8)


def told(perception, stamp_s, state, revision=3, image=None):
    output = SimpleNamespace(
        health=SimpleNamespace(state=state),
        stamp_s=stamp_s,
        revision=revision,
        T_w_c=np.eye(4),
        unit=1.0,
        metric=True,
        scale=ScaleEstimate(1.0, 0.02, "telemetry"),
    )
    return perception._depth(bare_wall() if image is None else image, output)


def test_a_bare_wall_is_as_far_as_the_network_says_by_the_last_fit_and_less_sure(perception):
    fitted = told(perception, 1.0, "tracking")
    np.testing.assert_allclose(fitted.depth_m, DISTANCE_M, rtol=0.02)
    carried = told(perception, 2.0, "lost")
    np.testing.assert_allclose(carried.depth_m, DISTANCE_M, rtol=0.02)
    assert carried.sigma_log.min() >= 0.29 > np.median(fitted.sigma_log)


def test_a_picture_with_too_few_points_goes_by_the_last_fit(perception):
    told(perception, 1.0, "tracking")
    perception._slam = a_map(np.zeros((0, 3)))
    np.testing.assert_allclose(told(perception, 2.0, "tracking").depth_m, DISTANCE_M, rtol=0.02)
    assert told(perception, 5.1, "tracking") is None


def test_points_in_another_unit_do_not_change_the_depth_bias(perception):
    """After a turn on the spot a new piece of map is 3 times as large as it says."""
    perception._unit = 3, 1.0
    for k in range(20):
        told(perception, 1.0 + 0.2 * k, "tracking")
    points, _ = perception._slam.surroundings()
    perception._slam = a_map(3.0 * points)
    for k in range(6):
        depth = told(perception, 5.0 + 0.2 * k, "tracking")
    np.testing.assert_allclose(depth.depth_m, DISTANCE_M, rtol=0.02)
    assert depth.sigma_log.min() >= 0.29


def test_depth_bias_bridges_pictures_without_points_until_the_unit_changes(perception):
    perception._unit = 3, 1.0
    for k in range(20):
        told(perception, 1.0 + 0.2 * k, "tracking")
    perception._slam = a_map(np.zeros((0, 3)))
    np.testing.assert_allclose(told(perception, 60.0, "tracking").depth_m, DISTANCE_M, rtol=0.02)
    assert told(perception, 60.0, "tracking", revision=4) is None


def test_edges_of_the_map_stand_before_what_the_network_sees(perception):
    points, _ = perception._slam.surroundings()
    rim = np.array([[0.1, y, 0.8] for y in np.linspace(-0.02, 0.02, 9)])
    perception._slam = a_map(points, rim)
    depth = told(perception, 1.0, "tracking").depth_m
    assert np.nanmin(depth) == pytest.approx(0.8, rel=0.01)
    assert np.median(depth) == pytest.approx(DISTANCE_M, rel=0.02), "they do not take part in the fit"


def test_edges_of_the_newest_picture_stand_before_what_the_network_sees(perception):
    """Before a keyframe confirms them; requested in output units, here of half a metre."""
    asked = []

    def fresh(image, nearest, farthest):
        asked.append((nearest, farthest))
        return np.array([[240.0, 180.0], [241.0, 183.0], [242.0, 186.0], [60.0, 60.0]]), np.array([0.8, 0.8, 0.8, 0.5])

    points, _ = perception._slam.surroundings()
    perception._slam = a_map(points, fresh=fresh)
    perception._home = Home(np.eye(3), 0.5, np.zeros(3))
    depth = told(perception, 1.0, "tracking").depth_m
    assert asked == [(0.6, 12.0)]
    v, u = np.nonzero(depth < 1.0)
    assert depth[v, u] == pytest.approx(0.8)
    assert set(u) == {60} and set(v) <= {45, 46}, "and the one that no other agrees with does not"
    told(perception, 2.0, "lost")
    assert len(asked) == 1, "a picture without a place in the map tells none"


def test_depth_is_that_of_the_picture_without_the_lens(perception):
    bent = replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
    seen = []
    perception._network, network = (
        lambda image, camera: (seen.append(image), network(image, camera))[1],
        perception._network,
    )
    perception._camera = bent
    told(perception, 1.0, "tracking")
    np.testing.assert_array_equal(seen[0], bent.undistort_image(bare_wall()))
    assert (seen[0] != bare_wall()).any()


def test_a_fit_that_is_old_or_in_another_unit_is_ignored(perception):
    assert told(perception, 0.5, "lost") is None  # none yet
    told(perception, 1.0, "tracking")
    assert told(perception, 2.0, "lost", revision=4) is None
    assert told(perception, 4.9, "lost") is not None
    assert told(perception, 5.1, "lost") is None


def test_the_dark_is_no_wall(perception):
    told(perception, 1.0, "tracking")
    dark = np.random.default_rng(0).integers(0, 12, (360, 480, 3)).astype(np.uint8)
    assert told(perception, 2.0, "lost", image=dark) is None
    assert told(perception, 2.0, "lost", image=np.full((360, 480, 3), 200, np.uint8)) is None
    assert told(perception, 2.0, "lost") is not None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_depth_behind_a_door_is_separate_from_the_wall(seed):
    """The default weights predict a wall there, at 0.53 to 0.61 of the distance."""
    site = named_site("corridor", seed)
    door, camera = site.exits[0], CAMERA.scaled(240, 180)
    T_w_b = np.eye(4)
    T_w_b[:3, :3] = np.column_stack([door.normal_w, np.cross([0, 0, 1], door.normal_w), [0, 0, 1]])
    T_w_b[:3, 3] = [*(door.centre_w - 2.5 * door.normal_w)[:2], 1.1]
    rendered = render(site.world, camera, site.T_site_w @ T_w_b @ camera_on_body(TELLO_TILT_RAD))
    told = SlamPerception(CAMERA)._network(rendered.image, camera).depth_m
    told *= np.median(rendered.depth_m) / np.median(told)
    behind = rendered.depth_m > 3.2
    behind[100:] = False  # the floor
    assert behind.sum() > 2000
    assert abs(np.median(np.log(told / rendered.depth_m)[behind])) < 0.3


@pytest.mark.parametrize(
    ("used", "telemetry", "network", "contradicted"),
    [
        ("telemetry+height", 2.6, 0.7, False),
        ("telemetry+height", 2.0, 2.5, True),
        ("height", 2.6, 0.7, True),
        ("telemetry+height+depth", 2.6, 2.5, False),
    ],
)
def test_a_network_contradicts_nothing_that_velocities_and_heights_confirm(used, telemetry, network, contradicted):
    sources = [ScaleEstimate(telemetry, 0.05, "telemetry"), ScaleEstimate(2.55, 0.05, "height")]
    sources = sources if "telemetry" in used else sources[1:]
    health = SimpleNamespace(
        scale=ScaleEstimate(2.55, 0.05, used), sources=(*sources, ScaleEstimate(network, 0.2 * network, "depth"))
    )
    assert _contradicted(health) == contradicted


def test_corrections_include_thinned_views(perception):
    """Of those that it keeps no longer one in two seconds."""
    poses = np.repeat(np.eye(4)[None], 2000, axis=0)
    for k in range(600):
        perception._shown = poses, 1.0, 0
        assert perception._map_update(SimpleNamespace(picture=3 * k, T_w_c=np.eye(4), stamp_s=0.2 * k)) is None
    poses[:100, 0, 3] = 1.0
    perception._shown = poses, 1.0, 1
    update = perception._map_update(SimpleNamespace(picture=1800, T_w_c=np.eye(4), stamp_s=120.0))
    assert len(update.pictures) == pytest.approx(240 + 36, abs=1)
    assert (np.diff(update.pictures) > 0).all()
    assert update.T_w_c[np.isin(update.pictures, [30, 1500]), 0, 3] == pytest.approx([1.0, 0.0])
    assert perception._map_update(SimpleNamespace(picture=1803, T_w_c=np.eye(4), stamp_s=120.2)) is None


def test_the_sigma_of_the_scale_is_relative(perception):
    sure = ScaleEstimate(0.5, 0.01, "telemetry")
    health = SimpleNamespace(state="tracking", scale=sure, sources=(), submap_sigma=0.0, drift_sigma=0.0, metric=True)
    pose = SimpleNamespace(T_w_c=np.eye(4), covariance=1e-4 * np.eye(6), velocity_w=np.zeros(3), revision=0)
    perception._slam = SimpleNamespace(pose_now=lambda now_s, samples: pose)
    perception._output = SimpleNamespace(health=health, piece=0)
    assert perception.state(1.0).scale_sigma == pytest.approx(0.02)
