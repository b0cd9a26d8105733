"""Constant velocity, and how far a prediction may be off."""

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.tracking.motion_model import MotionModel


def at(x):
    """``T_c_w`` of a camera at ``x`` on the world's first axis."""
    T = np.eye(4)
    T[0, 3] = -x
    return T


def moving():
    """At 1 at 10 s, at 1.5 at 10.5 s."""
    model = MotionModel(at(1.0))
    model.stamp_s = 10.0
    model.move(10.5, at(1.5))
    model.stamp_s = 10.5
    return model


def test_prediction_has_constant_velocity():
    assert np.allclose(se3.inverse(moving().predict(12.5))[:3, 3], [3.5, 0, 0])
    assert not moving().velocity_unknown


def test_velocity_decays_without_measurements_and_is_reset_by_a_stop():
    model = moving()
    model.drift(model.predict(11.5))
    model.stamp_s = 11.5
    x = se3.inverse(model.predict(12.5))[0, 3]
    assert 2.5 < x < 3.5
    model.stop()
    assert model.velocity_unknown
    assert np.allclose(model.predict(99.0), at(2.5))


def test_a_correction_of_the_keyframe_moves_the_pose_in_the_keyframes_frame():
    """The map turns by a quarter about its origin: the camera goes with it, whatever its pose relative to that is."""
    model = MotionModel(at(2.0))
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))
    keyframe = at(1.0)
    model.correct(se3.inverse(keyframe) @ (keyframe @ turn))
    assert np.allclose(model.T_c_w, at(2.0) @ turn)


def test_sigma_of_a_prediction_grows_with_the_square_of_time_in_map_units():
    model = moving()
    near, far = (model.information(10.5 + dt, 2.0) for dt in (0.1, 0.2))
    assert np.allclose(np.sqrt(np.diag(near) / np.diag(far)), 4.0)
    metres = model.information(10.6, 1.0)
    assert np.allclose(np.sqrt(np.diag(near)[:3] / np.diag(metres)[:3]), 2.0)  # a unit is two metres
    assert np.allclose(np.diag(near)[3:], np.diag(metres)[3:])


def test_predictions_that_become_poses_stay_rigid_motions():
    """Each pose comes from the one before: an error that doubled would be as large as the pose after fifty."""
    model = MotionModel(np.eye(4))
    model.stamp_s = 0.0
    T = se3.exp(np.array([0.02, 0.01, 0.0, 0.03, -0.02, 0.04]))
    for i in range(1, 81):
        model.move(0.1 * i, T)
        model.stamp_s = 0.1 * i
        T = model.predict(0.1 * (i + 1))
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    steady = se3.exp(81 * np.array([0.02, 0.01, 0.0, 0.03, -0.02, 0.04]))
    np.testing.assert_allclose(T, steady, atol=1e-6)


def test_unknown_velocity_increases_the_sigma():
    """Half a metre and one radian a second over a tenth, beside what accelerations add."""
    model = MotionModel(at(1.0))
    model.stamp_s = 10.0
    sigma = 1.0 / np.sqrt(np.diag(model.information(10.1, 1.0)))
    assert np.allclose(sigma, [np.hypot(0.05, 0.015)] * 3 + [np.hypot(0.1, 0.1)] * 3)
