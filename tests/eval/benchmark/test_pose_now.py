import numpy as np
import pytest

from edgeslam_torch.eval.benchmark.consistency import see
from edgeslam_torch.eval.benchmark.pose_now import Request, Truth, judge
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import PoseNow

DELAY_S = 0.4


@pytest.fixture
def truth():
    """A bow at half a metre a second, turning."""
    t = np.arange(0.0, 10.0, 0.05)
    T = np.stack([se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.05 * x, 0.2 * x])) for x in t])
    T[:, :3, 3] = np.stack([0.5 * t, np.sin(0.5 * t), 0.1 * np.cos(t)], axis=1)
    return Truth(t, T)


def answers(truth, T_published_world, late_s=0.0, **fields):
    """What a system would say that is right, or late, in a world of its own."""
    out = []
    for stamp in truth.stamps_s[:-12]:
        now = T_published_world @ truth.at(stamp + DELAY_S - late_s)
        step = truth.at(stamp + DELAY_S + 0.05) - truth.at(stamp + DELAY_S - 0.05)
        velocity = T_published_world[:3, :3] @ step[:3, 3] / 0.1
        told = {"source": "filter", "metric": True, "revision": 0, **fields}
        pose = PoseNow(float(stamp), now, velocity, np.eye(9) * 0.01**2, seen_s=float(stamp), **told)
        out.append(Request(pose, T_published_world @ truth.at(stamp)))
    return out


def test_right_answers_in_another_world_have_no_error(truth):
    world = se3.exp(np.array([3.0, -2.0, 1.0, 0.4, -0.2, 1.0]))
    errors = judge(answers(truth, world), truth, DELAY_S)
    for name in ("absolute_m", "since_seen_m", "velocity_m_s", "nees"):
        np.testing.assert_allclose(getattr(errors, name), 0.0, atol=1e-6)
    assert np.mean(errors.late_m) == pytest.approx(0.22, abs=0.04)


def test_late_answers_are_off_by_the_way_of_that_time(truth):
    errors = judge(answers(truth, np.eye(4), late_s=0.1), truth, DELAY_S)
    assert np.median(errors.since_seen_m) == pytest.approx(0.055, abs=0.015)
    assert np.median(errors.absolute_m) == pytest.approx(0.055, abs=0.015)
    assert np.mean(errors.nees) > 20.0


@pytest.mark.parametrize("fields", [{"source": "visual"}, {"metric": False}])
def test_only_metric_answers_of_the_filter_count(truth, fields):
    errors = judge(answers(truth, np.eye(4), **fields), truth, DELAY_S)
    assert (errors.absolute_m, errors.requests) == ([], len(truth.stamps_s) - 12)
    assert "never" in errors.line("flight")


def test_simulated_vision_drifts_with_the_way_in_a_unit_of_its_own(truth):
    seen = see(truth, 3)
    metres = seen.T_m_c[:, :3, 3] * seen.metres_per_unit
    off = np.linalg.norm(metres - truth.T_w_c[:, :3, 3], axis=1)
    assert 0.5 < seen.metres_per_unit < 2.1
    assert off[:20].mean() < 0.01
    assert off.max() < 0.1
