"""Poses that the filter's prediction contradicts: on a repetitive wall, corners match the neighbouring
repetition. (Corners on whole pixels; with sub-pixel alignment such mismatches are rare.)"""

from dataclasses import replace

import numpy as np
from rendered import CAMERA, film, panels, patchwork

from edgeslam_torch.config import DepthConfig, MappingConfig, SlamConfig
from edgeslam_torch.estimation.filter.filter_feed import PoseEstimate
from edgeslam_torch.geometry import se3
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.house.world import Quad, Texture, World
from edgeslam_torch.types import FrameStatus

PERIOD_M = 0.24
"""31 px of a wall 2 m away."""
STEP_RAD = 0.09
"""Rotation from one frame to the next, for three of them: 23 px. When it ends, the neighbouring repetition is nearer to
the prediction."""


PREDICTED, TRACKED, RELOCALISED = FrameStatus.PREDICTED, FrameStatus.TRACKED, FrameStatus.RELOCALISED
STEPS = 11, 15
"""Frames around the larger steps."""
BRAKES = 0.67, 1.34, 0.67
"""Steps of a drone that brakes: at the third, constant velocity is off by one repetition."""


def wallpaper(axis=4, steps=(1, 2, 3)):
    """A camera before a papered wall: it moves slowly sideways, turns by larger steps, then stops."""
    across = 20
    paper = np.tile(patchwork(np.random.default_rng(5), 128, 40), (across, across, 1))
    side_m = across * PERIOD_M
    u, v = np.array([side_m, 0.0, 0.0]), np.array([0.0, side_m, 0.0])
    world = World([Quad(np.array([-side_m / 2, -side_m / 2, 2.0]), u, v, Texture(paper))])
    poses = [se3.exp(STEP_RAD * turn * np.eye(6)[axis]) for turn in [0.0] * 12 + [*steps] + [steps[-1]] * 8]
    for k, T in enumerate(poses):
        T[0, 3] += 0.01 * k
    return film(world, CAMERA, np.stack(poses), step_s=1 / 15)


def no_filter(fusion, stamp_s):
    return None


def no_attitude(from_s, to_s):
    return None


def flown(flight, predicted=no_filter, turned=no_attitude):
    """Outputs of a flight with a filter that predicts these poses, and an attitude that turns so between frames."""
    config = SlamConfig(depth=DepthConfig(weights="none"), mapping=MappingConfig(sub_pixel=False))
    slam = EdgeSlam(CAMERA, config, depth=flight.depth_function())
    fusion = slam._system.fusion
    fusion.predict, fusion.turned = lambda stamp_s: predicted(fusion, stamp_s), turned
    return [slam.step(frame) for frame in flight.frames]


def true_motion(flight):
    """A filter that predicts the true motion since the frame that was tracked last."""

    def predict(fusion, stamp_s):
        last = fusion.snapshot()
        if last is None:
            return None
        before, now = (flight.T_w_c[np.argmin(np.abs(flight.stamps_s - t))] for t in (last.last.stamp_s, stamp_s))
        return PoseEstimate(last.last.T @ se3.inverse(before) @ now, 0.01, 0.005)

    return predict


def errors_deg(flight, outputs):
    """Error of the rotation over the larger steps."""
    found, true = (se3.inverse(T[STEPS[0]]) @ T[STEPS[1]] for T in ([out.T_w_c for out in outputs], flight.T_w_c))
    return np.degrees(np.linalg.norm(se3.log(se3.inverse(true) @ found)[3:]))


def test_a_prediction_prevents_a_mismatch_on_a_repetitive_wall():
    flight = wallpaper()
    held, alone = (errors_deg(flight, flown(flight, how)) for how in (true_motion(flight), no_filter))
    assert held < 2.0 < 4.0 < alone


def test_attitude_prevents_a_mismatch_of_rows_when_a_drone_pitches():
    flight = wallpaper(3, BRAKES)

    def turned(from_s, to_s):
        R_w_c0, R_w_c1 = (flight.T_w_c[np.argmin(np.abs(flight.stamps_s - t)), :3, :3] for t in (from_s, to_s))
        return R_w_c1.T @ R_w_c0

    by_attitude, alone = (errors_deg(flight, flown(flight, turned=by)) for by in (turned, no_attitude))
    assert by_attitude < 1.0 < 3.0 < alone


def test_wrong_sensors_do_not_change_a_pose_that_images_confirm():
    flight = panels().first(16)
    lie = PoseEstimate(se3.exp(np.array([0.3, -0.5, 0.4, 0.1, 0.1, 0.1])), 0.01, 0.005)
    lied, alone = flown(flight, lambda fusion, stamp_s: lie), flown(flight)
    assert not alone[-1].reason
    assert [out.status for out in lied] == [out.status for out in alone]
    for a, b in zip(lied, alone, strict=True):
        np.testing.assert_allclose(a.T_w_c, b.T_w_c, atol=2e-3)
    assert "contradicted" in lied[-1].reason


def test_a_jump_that_neither_sensors_nor_the_motion_so_far_explain_is_no_pose():
    """A decoder shows an old picture once. Sensors that jump with it vouch for it."""
    flight = panels().first(16)
    flight.frames[13] = replace(flight.frames[13], image=flight.frames[5].image)
    held, alone = flown(flight, true_motion(flight)), flown(flight)
    jumped = replace(flight, T_w_c=np.array([*flight.T_w_c[:13], flight.T_w_c[5], *flight.T_w_c[14:]]))
    vouched = flown(flight, true_motion(jumped))
    assert [out[13].status for out in (held, alone, vouched)] == [PREDICTED, TRACKED, TRACKED]
    assert held[14].status in (TRACKED, RELOCALISED)
    steps = [out[13].T_w_c[:3, 3] - out[12].T_w_c[:3, 3] for out in (held, alone, vouched)]
    held_m, *jumped_m = np.linalg.norm(steps, axis=1)
    assert held_m < 0.05 < 0.15 < min(jumped_m)
