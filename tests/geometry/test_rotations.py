"""Rotations of angles, vectors and fits, against scipy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry.rotations import (
    angles,
    fitted_rotation,
    matrices_from_quaternions,
    matrices_from_rpy,
    matrices_from_vectors,
    matrix_from_rpy,
    quaternions_from_matrices,
    smallest_rotation,
    vectors_from_matrices,
)


def vectors_of(rng, angle, count=40):
    axis = rng.normal(size=(count, 3))
    return angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.1, 2.0, np.pi - 1e-7])
def test_rotation_vectors_there_and_back(rng, angle):
    phi = vectors_of(rng, angle)
    R = matrices_from_vectors(phi)
    np.testing.assert_allclose(R, Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(vectors_from_matrices(R), phi, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(vectors_from_matrices(R[0]), phi[0], rtol=1e-12, atol=1e-15)


def test_quaternions_there_and_back(rng):
    R = Rotation.random(50, random_state=rng)
    np.testing.assert_allclose(quaternions_from_matrices(R.as_matrix()), R.as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(matrices_from_quaternions(3.0 * R.as_quat()), R.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(angles(R.as_matrix()), R.magnitude(), atol=1e-12)


def test_half_a_turn_has_a_vector(rng):
    R = Rotation.from_rotvec(vectors_of(rng, np.pi)).as_matrix()
    phi = vectors_from_matrices(R)
    np.testing.assert_allclose(np.linalg.norm(phi, axis=1), np.pi)
    np.testing.assert_allclose(matrices_from_vectors(phi), R, atol=1e-14)


def test_roll_pitch_and_yaw(rng):
    rpy = rng.uniform(-3.0, 3.0, (20, 3))
    R = matrices_from_rpy(rpy)
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(R[3], matrix_from_rpy(rpy[3]), atol=1e-14)


def test_the_smallest_rotation_turns_about_the_normal_of_both_directions(rng):
    a, b = rng.normal(size=(2, 3))
    R = smallest_rotation(a, 3.0 * b)
    np.testing.assert_allclose(R @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-14)
    np.testing.assert_allclose(R @ np.cross(a, b), np.cross(a, b), atol=1e-12)
    np.testing.assert_allclose(smallest_rotation(a, a), np.eye(3), atol=1e-14)
    opposite = smallest_rotation(a, -a)
    np.testing.assert_allclose(opposite @ a, -a, atol=1e-14)
    assert np.linalg.det(opposite) == pytest.approx(1.0)


def test_the_fitted_rotation_is_the_best_one(rng):
    a = rng.normal(size=(30, 3))
    true = Rotation.from_rotvec([0.5, -1.0, 2.0])
    np.testing.assert_allclose(fitted_rotation(a, true.apply(a)), true.as_matrix(), atol=1e-14)
    noisy = true.apply(a) + 0.1 * rng.normal(size=a.shape)
    np.testing.assert_allclose(fitted_rotation(a, noisy), Rotation.align_vectors(noisy, a)[0].as_matrix(), atol=1e-12)
