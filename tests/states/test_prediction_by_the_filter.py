"""Pose prediction between two frames."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.states.system import System
from edgeslam_torch.tracking.motion_model import MotionModel

TOLD = se3.exp(np.array([0.3, -0.1, 0.2, 0.1, 0.2, -0.3]))
"""``T_w_c`` predicted by the fusion."""


def system(R_c_c=None, filtering=True, **fusion):
    motion = MotionModel(np.eye(4))
    motion.stamp_s = 0.0
    motion.move(0.1, se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.01, 0.0])))
    motion.stamp_s = 0.1
    return SimpleNamespace(
        has_telemetry=True,
        motion=motion,
        fusion=SimpleNamespace(
            predict=lambda stamp_s: SimpleNamespace(T_w_c=TOLD) if filtering else None,
            turned=lambda from_s, to_s: R_c_c,
            **fusion,
        ),
        stage_ms={},
    )


@pytest.mark.parametrize(("lost", "stamp_s"), [(False, 0.3), (True, 0.2)])
def test_the_filter_predicts_over_gaps_and_when_lost(lost, stamp_s):
    keyframes = system()
    np.testing.assert_allclose(System.predict(keyframes, stamp_s, lost), se3.inverse(TOLD), atol=1e-12)


@pytest.mark.parametrize(
    ("has_telemetry", "filtering", "stamp_s"),
    [(True, False, 0.3), (False, True, 0.3), (True, True, 0.2)],  # not fed, no drone, too short a gap
)
def test_constant_velocity_otherwise(has_telemetry, filtering, stamp_s):
    keyframes = system(filtering=filtering)
    keyframes.has_telemetry = has_telemetry
    np.testing.assert_array_equal(System.predict(keyframes, stamp_s, False), keyframes.motion.predict(stamp_s))


def test_sensors_predict_the_rotation():
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, -0.2, 0.05]))[:3, :3]
    keyframes = system(turned, filtering=False)
    T_c_w = System.predict(keyframes, 0.2, False)
    np.testing.assert_allclose(T_c_w[:3, :3], turned @ keyframes.motion.T_c_w[:3, :3], atol=1e-12)
    even = se3.inverse(keyframes.motion.predict(0.2))
    np.testing.assert_allclose(se3.inverse(T_c_w)[:3, 3], even[:3, 3], atol=1e-12)


def test_a_correction_of_the_map_is_passed_to_the_fusion():
    """The camera has not moved: the correction maps ``T_w_c`` before to ``T_w_c`` after."""
    moved = []
    keyframes = system(filtering=True, map_moved=moved.append)
    before = se3.inverse(keyframes.motion.T_c_w)
    tracked = se3.exp(np.array([0.1, 0.0, 0.3, 0.0, 0.1, 0.0]))
    refined = se3.exp(np.array([0.12, -0.01, 0.31, 0.01, 0.1, 0.02]))
    mapped = SimpleNamespace(keyframes=[SimpleNamespace(T_c_w=refined)], T_tracked=tracked, stage_ms={})
    keyframes.compare_depth = lambda keyframe: None
    keyframes.graph = SimpleNamespace(add=lambda *_: None)
    System.absorb(keyframes, mapped)
    after = se3.inverse(keyframes.motion.T_c_w)
    assert np.linalg.norm(after - before) > 0.01
    np.testing.assert_allclose(moved[0] @ before, after, atol=1e-9)


def test_a_new_submap_begins_upright_where_the_camera_is(rng):
    """Poses before a blank wall lean by six degrees; heading and centre are what they were."""
    keyframes, T_true = system(), se3.exp(np.concatenate([rng.normal(size=3), [0.3, 1.2, -0.1]]))
    up_m = np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])
    up_c = T_true[:3, :3] @ up_m
    lean = se3.exp(np.concatenate([np.zeros(3), 0.1 * np.cross(up_c, [1.0, 0.0, 0.0])]))
    keyframes.motion.T_c_w = lean @ T_true
    before = se3.inverse(keyframes.motion.T_c_w)
    told = SimpleNamespace(frame=np.zeros(1, int), up_c=up_c[None], up_m=up_m)
    keyframes.telemetry = lambda *_: SimpleNamespace(up=lambda stamps_s: told)
    System.level(keyframes, 0.3)
    after = se3.inverse(keyframes.motion.T_c_w)
    np.testing.assert_allclose(keyframes.motion.T_c_w[:3, :3] @ up_m, up_c, atol=1e-12)
    np.testing.assert_allclose(after[:3, 3], before[:3, 3], atol=1e-12)
    keyframes.telemetry = lambda *_: None
    System.level(keyframes, 0.4)
    np.testing.assert_array_equal(se3.inverse(keyframes.motion.T_c_w), after)
