"""Wind moves a drone as its gusts and its controller say, and leans it against the wind."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from edgeslam_torch.noise import GRAVITY_M_S2
from edgeslam_torch.synthetic.flights import wind
from edgeslam_torch.synthetic.flights.courses import COURSES, flown

STAMPS_S = np.arange(4000) / 20


def test_gusts_move_it_and_it_comes_back():
    moved, velocity, _ = wind.blown(np.random.default_rng(0), STAMPS_S, 0.5, 0.3)
    np.testing.assert_allclose(moved[0], 0.0)
    assert (np.abs(moved.mean(0)) < 0.02).all(), "the steady wind is held against"
    np.testing.assert_allclose(moved[:, :2].std(0), 0.08, atol=0.015)
    assert 0.3 < moved[:, 2].std() / moved[:, 0].std() < 0.5
    np.testing.assert_allclose(np.gradient(moved, STAMPS_S, axis=0)[1:-1], velocity[1:-1], atol=0.02)


def test_lean_and_gust_together_are_the_acceleration(monkeypatch):
    """A gust that never changes: a damped spring pushed by it, by an integrator that is not ours."""
    monkeypatch.setattr(wind, "GUST_S", 1e9)
    rng = np.random.default_rng(1)

    class Constant:
        def normal(self, mean, sigma, shape):
            shocks = np.zeros(shape)
            shocks[1] = 1.0
            return shocks

        uniform = rng.uniform

    stamps = np.arange(0.0, 4.0, 0.05)
    moved, velocity, lean = wind.blown(Constant(), stamps, 0.0, 0.2)

    def spring(t, state):
        pushed = 1.0 if t > wind.STEP_S else 0.0
        return [state[1], pushed - wind.STIFFNESS_S2 * state[0] - wind.DAMPING_S * state[1]]

    exact = solve_ivp(spring, (0.0, 4.0), [0.0, 0.0], t_eval=stamps, max_step=0.005).y
    np.testing.assert_allclose(moved[:, 0], exact[0], atol=2e-3)
    np.testing.assert_allclose(velocity[:, 0], exact[1], atol=5e-3)
    acceleration = np.gradient(velocity[:, 0], stamps)
    np.testing.assert_allclose((lean[:, 0] + 1.0)[2:-1], acceleration[2:-1], atol=0.03)


def test_a_drone_leans_against_a_steady_wind():
    _, _, lean = wind.blown(np.random.default_rng(2), STAMPS_S, 0.5, 0.0)
    np.testing.assert_allclose(np.linalg.norm(lean, axis=1), 0.5)
    assert (lean == lean[0]).all()


def test_a_windy_course_is_blown_aside_and_leans():
    flight, still = (flown(COURSES[name], 0)[1] for name in ("windy_blank_corridor", "blank_corridor"))
    moved = flight.T_w_b[:, :3, 3] - still.T_w_b[:, :3, 3]
    assert 0.02 < moved[:, :2].std() < 0.3
    up = flight.T_w_b[:, :3, :3].mean(0)[:2, 2] - still.T_w_b[:, :3, :3].mean(0)[:2, 2]
    assert 0.5 * 0.5 / GRAVITY_M_S2 < np.linalg.norm(up) < 1.5 * 0.5 / GRAVITY_M_S2, "three degrees, on average"
    assert np.abs(Rotation.from_matrix(flight.T_w_b[:, :3, :3]).as_euler("ZYX")[:, 1:]).max() < np.deg2rad(15)
