"""Rigid motions in numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3

component = st.floats(-1.7, 1.7, allow_nan=False)
tangents = st.lists(component, min_size=6, max_size=6).map(np.array)  # |phi| below 2.95 < pi


@pytest.mark.parametrize("angle", [1e-9, 0.99e-6, 1.01e-6, 1e-5, 0.99e-3, 1.01e-3, 0.1, 3.0])
def test_small_arcs_bend_as_the_circle_does(angle):
    """One unit along x while turning about z: it ends ``tan(angle / 2)`` of the way aside."""
    T = se3.exp(np.array([1.0, 0.0, 0.0, 0.0, 0.0, angle]))
    np.testing.assert_allclose(T[1, 3] / T[0, 3], np.tan(0.5 * angle), rtol=1e-9)
    np.testing.assert_allclose(T[:2, 0], [np.cos(angle), np.sin(angle)], rtol=1e-13)


@given(tangents)
def test_exp_is_the_matrix_exponential(xi):
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
    np.testing.assert_allclose(se3.exp(xi), expm(generator), atol=1e-12)


@given(tangents)
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 0.99e-6, 1.01e-6, 0.99e-4, 1.01e-4, 3.1])
def test_log_undoes_exp_at_small_and_large_angles(angle):
    xi = np.array([0.3, -2.0, 1.0, 0.6 * angle, 0.0, -0.8 * angle])
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


def test_inverse_of_a_batch_is_that_of_each(rng):
    T = np.stack([se3.exp(rng.normal(size=6)) for _ in range(6)]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_array_equal(se3.inverse(T)[1, 2], se3.inverse(T[1, 2]))


def test_transform_moves_points_as_the_matrix_does(rng):
    T, p = se3.exp(rng.normal(size=6)), rng.normal(size=(7, 3))
    np.testing.assert_allclose(se3.transform(T, p), (T @ np.c_[p, np.ones(7)].T).T[:, :3], atol=1e-12)


def test_orthonormalised_keeps_a_motion_and_corrects_a_drifted_one(rng):
    T = se3.exp(rng.normal(size=6))
    np.testing.assert_allclose(se3.orthonormalised(T), T, atol=1e-14)
    drifted = T.copy()
    drifted[:3, :3] += rng.normal(0.0, 1e-4, (3, 3))
    mended = se3.orthonormalised(drifted)
    np.testing.assert_allclose(mended[:3, :3] @ mended[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(mended, T, atol=1e-3)


@given(tangents)
def test_tum_rows_come_back_with_a_positive_real_part(xi):
    row = se3.pose_to_tum(se3.exp(xi))
    assert row[6] >= 0.0
    np.testing.assert_allclose(Rotation.from_quat(row[3:]).as_matrix(), se3.exp(xi)[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(row[:3], se3.exp(xi)[:3, 3])
