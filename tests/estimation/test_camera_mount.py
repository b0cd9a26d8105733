"""A camera that sits otherwise on the drone than it was said to, told by the drone's turns."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swung import T_B_C, at_once, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.camera_mount import mount_by_turns
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import simulate

SIGMA_RAD = math.radians(3.0)
N = 200


def mount(R_w_b, R_b_c, rng, noise_rad=0.0):
    """What `mount_by_turns` makes of attitudes ``(N, 3, 3)`` over a minute; and the map as it lies in the world."""
    R_m_w = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    noise = Rotation.from_rotvec(rng.normal(0.0, noise_rad, (len(R_w_b), 3))).as_matrix()
    stamps_s = np.linspace(0.0, 60.0, len(R_w_b))
    return mount_by_turns(R_m_w @ R_w_b @ noise @ R_b_c, R_w_b, stamps_s, GIVEN, SIGMA_RAD), R_m_w.T


GIVEN = T_B_C[:3, :3]


def turning(yaw_deg):
    return Rotation.from_euler("z", np.linspace(0.0, yaw_deg, N)[:, None], degrees=True).as_matrix()


def off_deg(R, R_true):
    return Rotation.from_matrix(R @ R_true.T).as_rotvec(degrees=True)


@pytest.mark.parametrize("lean_deg", [(3.0, 0.0), (0.0, 4.0), (-2.0, -3.0)])
@pytest.mark.parametrize("yaw_deg", [180.0, 360.0])
def test_a_turn_tells_roll_and_pitch_of_the_camera(rng, lean_deg, yaw_deg):
    true = Rotation.from_euler("xy", lean_deg, degrees=True).as_matrix() @ GIVEN
    found, R_w_m = mount(turning(yaw_deg), true, rng, math.radians(0.5))
    assert np.abs(off_deg(found.R_b_c, true)[:2]).max() < 0.15 * max(np.abs(lean_deg))
    assert np.abs(off_deg(found.R_w_m, R_w_m)[:2]).max() < 0.15 * max(np.abs(lean_deg))


def test_what_no_turn_tells_stays_as_it_was_given(rng):
    true = Rotation.from_euler("xyz", [2.0, 4.0, 3.0], degrees=True).as_matrix() @ GIVEN
    still, turned = (mount(turning(yaw), true, rng)[0] for yaw in (0.0, 360.0))
    np.testing.assert_allclose(off_deg(still.R_b_c, GIVEN), 0.0, atol=0.01)
    assert abs(off_deg(turned.R_b_c, GIVEN)[2]) < 0.1
    assert np.degrees(still.sigma_rad).min() > 3.0
    assert np.degrees(turned.sigma_rad[:2]).max() < 1.5 < np.degrees(turned.sigma_rad[2])


def test_up_and_scale_of_a_camera_that_leans(rng):
    """Five degrees further down than was said, turning by a half circle: left out, up leans by nearly five degrees."""
    base = swinging(40.0, 10.0)
    T_w_b = base.T_w_c @ se3.inverse(T_B_C)
    turned = Rotation.from_euler("z", 90.0 * np.sin(0.15 * base.stamps_s)[:, None], degrees=True).as_matrix()
    T_w_b[:, :3, :3] = turned @ T_w_b[:, :3, :3]
    T_true = camera_on_body(math.radians(17.0))
    motion = replace(base, T_w_c=T_w_b @ T_true)
    fusion = MotionFusion(FusionConfig(), T_B_C)
    gauge = motion.in_gauge(rng)
    at_once(fusion, motion, gauge, simulate(rng, motion.stamps_s, motion.T_w_c, T_true).samples())
    fusion.revise(motion.stamps_s, gauge.T_m_c)  # with the mount that was found
    up = gauge.T_m_w[:3, :3] @ [0.0, 0.0, 1.0]
    assert math.degrees(math.acos(min(1.0, float(up @ fusion.orientation.R_w_m[2])))) < 1.0
    assert abs(math.log(fusion.scale().value / gauge.scale)) < 2.0 * fusion.scale().sigma / fusion.scale().value
    assert fusion.statistics()["camera mount turned deg"] == pytest.approx(5.0, abs=1.2)
