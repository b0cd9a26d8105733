"""The published world: z up, metres when known, right at once when the scale changes."""

from dataclasses import replace

import numpy as np
import pytest
from point_map import small_motion

from edgeslam_torch.estimation.output_frame import T_LEVEL, OutputFrame, first_pose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.types import PointCloud, ScaleEstimate

TILT = np.deg2rad(12.0)


def test_after_a_revision_the_way_back_to_the_start_is_right(rng):
    """Not only the steps after it: a drone that flies home by its live position would miss by what it flew before."""
    T_w_c = np.stack([small_motion(rng, 1.0, 0.5) for _ in range(5)])
    old = OutputFrame(1.5, small_motion(rng, 0, 1.0)[:3, :3])
    new = old.revised(ScaleEstimate(2.1, 0.05, "telemetry+height"))
    assert (new.revision, old.revision) == (1, 0)
    np.testing.assert_allclose(new.pose(T_w_c)[:, :3, 3], 2.1 * T_w_c[:, :3, 3] @ old.R.T)
    np.testing.assert_array_equal(new.pose(T_w_c)[:, :3, :3], old.pose(T_w_c)[:, :3, :3])


@pytest.mark.parametrize(
    ("value", "sigma", "source", "published_sigma", "revised"),
    [
        (1.5, 0.05, "depth", np.inf, False),  # the network guessed already, and has nothing new to say
        (1.5, 0.7, "telemetry", np.inf, False),  # hardly known, and within that
        (1.01, 0.025, "height+depth", np.inf, False),  # within its own uncertainty
        (0.5, np.inf, "none", np.inf, False),
        (1.1, 0.08, "height+depth", np.inf, True),  # more than a sigma off an initial guess: probably nearer
        (1.1, 0.109, "height+depth", np.inf, False),  # not surer than it is off
        (1.1, 0.08, "height+depth", 0.17, True),
        (1.1, 0.08, "height+depth", 0.14, False),  # hardly better than what was measured before
        (1.1, 0.04, "height+depth", 0.05, True),  # contradicts it
    ],
)
@pytest.mark.parametrize("unit", [1.0, 2.0])
def test_a_scale_is_revised_by_a_much_better_or_a_contradicting_one(
    value, sigma, source, published_sigma, revised, unit
):
    old = OutputFrame(unit, revision=1, sigma=published_sigma)
    assert old.revised(ScaleEstimate(unit * value, unit * sigma, source)).revision == 1 + revised


def test_a_map_is_turned_upright_once(rng):
    old = OutputFrame(1.5, small_motion(rng, 0, 1.0)[:3, :3], revision=2)
    R_w_m = small_motion(rng, 0, 1.0)[:3, :3]
    new = old.turned_upright(R_w_m, False)
    assert (new.revision, new.scale, new.upright) == (3, 1.5, True)
    up_m = R_w_m.T @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(new.R @ up_m, [0.0, 0.0, 1.0], atol=1e-12)
    turn = new.R @ old.R.T
    assert np.arccos((np.trace(turn) - 1.0) / 2.0) == pytest.approx(np.arccos((old.R @ up_m)[2])), (
        "by no more than that"
    )
    assert new.turned_upright(small_motion(rng, 0, 1.0)[:3, :3], False) is new
    assert old.turned_upright(None, True) is old


@pytest.mark.parametrize(("leans_deg", "revised"), [(1.0, False), (4.0, True), (-4.0, True)])
def test_a_validated_attitude_levels_a_map_again_where_it_leans_clearly(leans_deg, revised):
    old = OutputFrame(0.7, upright=True, revision=3)
    R_w_m = se3.exp(np.array([0, 0, 0, 0, np.deg2rad(leans_deg), 0]))[:3, :3]
    assert old.turned_upright(R_w_m, False) is old, "not validated"
    assert replace(old, is_earlier=True).turned_upright(R_w_m, True).revision == 3, "an earlier flight's axes stay"
    new = old.turned_upright(R_w_m, True)
    assert new.revision == 3 + revised
    if revised:
        np.testing.assert_allclose(new.R @ R_w_m[2], [0.0, 0.0, 1.0], atol=1e-9)


def test_a_world_that_is_exactly_upside_down_is_turned(rng):
    """The cosine of its lean is -1, or by rounding a little less."""
    for _ in range(20):
        R = small_motion(rng, 0, 1.0)[:3, :3]
        turned = OutputFrame(1.0, R, upright=True).turned_upright(np.diag([1.0, -1.0, -1.0]) @ R, True)
        np.testing.assert_allclose(turned.R[2], -R[2], atol=1e-9)


def test_map_and_trajectory_pass_through_the_same_similarity(rng):
    """A point one unit before a camera is published one scale before the published camera."""
    published = OutputFrame(0.7, small_motion(rng, 0, 1.0)[:3, :3])
    T_w_c = small_motion(rng, 1.0, 0.5)
    p_c = rng.normal(size=(6, 3))
    p_w = se3.transform(T_w_c, p_c).astype(np.float32)
    cloud = PointCloud(p_w, np.zeros((6, 3), np.uint8), np.full(6, 0.1, np.float32), np.ones(6, int))
    out = published.cloud(cloud)
    np.testing.assert_allclose(out.p_w, se3.transform(published.pose(T_w_c), 0.7 * p_c), atol=1e-5)
    np.testing.assert_allclose(out.sigma_m, 0.07, rtol=1e-6)


def test_first_camera_looks_level_along_x_when_nothing_is_known():
    np.testing.assert_array_equal(first_pose(np.full(3, np.nan), camera_on_body(TILT, 0.03)), T_LEVEL)
    np.testing.assert_array_equal(T_LEVEL[:3, 2], [1, 0, 0])
    np.testing.assert_array_equal(T_LEVEL[:3, 1], [0, 0, -1])  # image down is world down


@pytest.mark.parametrize(
    ("rpy", "forward"),
    [
        ([0.0, 0.0, np.pi / 2], [0.0, np.cos(TILT), -np.sin(TILT)]),
        ([0.0, 0.1, 0.0], [np.cos(TILT + 0.1), 0.0, -np.sin(TILT + 0.1)]),  # about body y, left: the nose goes down
    ],
)
def test_first_camera_looks_where_the_drone_faces(rpy, forward):
    T = first_pose(np.array(rpy), camera_on_body(TILT, 0.03))
    np.testing.assert_allclose(T[:3, 2], forward, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], 0.0, atol=1e-12)
