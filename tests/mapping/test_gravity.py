import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry.level import Up
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.mapping.level.gravity import best_known, up_by_gravity

UP_M = np.array([0.6, 0.0, 0.8])


def flight(rng, g=9.81, seconds=4.0, noise=0.5):
    """Poses that turn about, and what an accelerometer on the camera feels."""
    stamps_s = np.arange(0.0, seconds, 0.05)
    T_m_c = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    T_m_c[:, :3, :3] = Rotation.from_rotvec(np.outer(np.sin(stamps_s), [0.3, 0.5, -0.2])).as_matrix()
    felt_c = np.einsum("nji,j->ni", T_m_c[:, :3, :3], g * UP_M) + noise * rng.normal(size=(len(stamps_s), 3))
    felt = ImuReadings(stamps_s, np.zeros_like(felt_c), felt_c)
    return felt, ImuModel(T_imu_cam=np.eye(4)), stamps_s, T_m_c


def test_the_mean_force_gives_the_vertical(rng):
    up = up_by_gravity(*flight(rng))
    assert math.degrees(math.acos(up.direction @ UP_M)) < 1.0
    assert math.radians(1.0) <= up.sigma_rad < math.radians(3.0)


@pytest.mark.parametrize("kwargs", [{"g": 1.0}, {"g": 0.0}, {"seconds": 0.3}])
def test_a_force_other_than_gravity_gives_nothing(rng, kwargs):
    assert up_by_gravity(*flight(rng, **kwargs)) is None


def test_readings_of_another_time_or_without_a_mount_give_nothing(rng):
    felt, model, stamps_s, T = flight(rng)
    assert up_by_gravity(felt, model, stamps_s + 1000.0, T) is None
    assert up_by_gravity(felt, ImuModel(), stamps_s, T) is None


def test_consistent_verticals_are_fused_and_gravity_wins_a_contradiction():
    gravity = Up(np.array([0.0, 0.0, 1.0]), math.radians(4.0), "accelerometer")
    near = Up(np.array([0.0, math.sin(0.04), math.cos(0.04)]), math.radians(2.0), "edges")
    both = best_known(gravity, near)
    assert both.sigma_rad < near.sigma_rad and 0.02 < both.direction[1] < 0.04
    assert best_known(gravity, Up(np.array([0.0, 1.0, 0.0]), math.radians(2.0), "edges")) is gravity
    assert best_known(None, near) is near and best_known(None, None) is None
