"""Scale measurements from image to metres: sources, signs and sigmas."""

from dataclasses import replace

import numpy as np
import pytest
import rendered
from rendered import CAMERA, film, stairs_world

from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale_estimator import ScaleEstimator
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.geometry import se3
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.types import DepthMap, Units

NO_NETWORK = SlamConfig(depth=DepthConfig(weights="none"))


def panels():
    return rendered.panels().first(30)


def length(T_w_c):
    return np.linalg.norm(np.diff(T_w_c[:, :3, 3], axis=0), axis=1).sum()


@pytest.mark.parametrize("factor", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_later_depth_maps_correct_a_wrong_first_one(factor):
    """The first depth map sets the map's scale; a dozen later ones measure it in metres."""
    known, calls = panels().depth_function(), []

    def depth(image, camera):
        right = known(image, camera)
        calls.append(image)
        return DepthMap(right.depth_m * factor, right.sigma_log) if len(calls) == 1 else right

    slam = EdgeSlam(CAMERA, NO_NETWORK, depth=depth)
    for frame in panels().frames:
        slam.step(frame)
    assert slam.scale.value == pytest.approx(1.0 / factor, rel=0.1)
    live = length(slam.trajectory()[1])
    slam.finish()
    assert length(slam.trajectory()[1]) == pytest.approx(length(panels().T_w_c), rel=0.1)
    assert live == pytest.approx(factor * length(panels().T_w_c), rel=0.1), (
        "the live scale does not follow one depth map"
    )


def test_depths_from_the_network_do_not_confirm_the_network(monkeypatch):
    """A camera that only rotates: every anchor has the network's depth."""
    turn = np.linspace(0.0, 0.5, 30)
    poses = np.stack([se3.exp(np.array([0.0, 0.0, 0.0, 0.0, a, 0.0])) for a in turn])
    turning = film(stairs_world(), CAMERA, poses)
    slam = EdgeSlam(CAMERA, NO_NETWORK, depth=turning.depth_function())
    told = spied(monkeypatch, "add_depth_ratio", of=ScaleEstimator)
    for frame in turning.frames:
        slam.step(frame)
    assert len(slam.map.anchors) > 300
    assert slam.map.anchors.from_depth[slam.map.anchors.alive].mean() > 0.95
    assert told == []


def spied(monkeypatch, name, of=MotionFusion):
    """Arguments of all later calls of one of fusion's methods."""
    calls, inner = [], getattr(of, name)

    def method(fusion, *arguments, **named):
        calls.append((*arguments, *named.values()))
        return inner(fusion, *arguments, **named)

    monkeypatch.setattr(of, name, method)
    return calls


def test_visual_sigma_is_that_of_the_visual_errors(monkeypatch):
    """Between consecutive frames, in map units: within a factor of three."""
    slam = EdgeSlam(CAMERA, NO_NETWORK)
    told = spied(monkeypatch, "add_visual")
    for frame in panels().frames:
        slam.step(frame)
    T = np.stack([call[1] for call in told])
    index = [int(np.abs(panels().stamps_s - call[0]).argmin()) for call in told]
    truth = panels().T_w_c[index]
    aligned = umeyama(T[:, :3, 3], truth[:, :3, 3])
    error = (aligned.points(T[:, :3, 3]) - truth[:, :3, 3]) / aligned.scale
    jitter = np.diff(error, axis=0)
    off = np.sqrt(np.median(jitter**2) / 2.0) / 0.6745
    sigma = np.median([call[2] for call in told])
    assert off / 3.0 < sigma < 3.0 * off + 0.002


def test_the_final_scale_is_computed_from_refined_poses(monkeypatch):
    slam = EdgeSlam(CAMERA, NO_NETWORK, depth=panels().depth_function())
    for frame in panels().frames:
        slam.step(frame)
    before = slam.log.poses()[1].copy()
    told = spied(monkeypatch, "revise")
    slam.finish()
    ((stamps, T_w_c),) = told
    np.testing.assert_array_equal(stamps, panels().stamps_s)
    np.testing.assert_array_equal(T_w_c, slam.log.poses()[1])
    assert np.abs(T_w_c - before).max() > 1e-6, "refinement changed them"
    assert slam.scale.units is Units.METRES


def test_a_frozen_video_gives_one_measurement(monkeypatch):
    """A frozen video gives its last new image once, and nothing until it moves again."""
    frames = list(panels().frames[:24])
    frozen = [replace(frames[-1], index=24 + k, stamp_s=frames[-1].stamp_s + (k + 1) / 30) for k in range(5)]
    later = [replace(f, stamp_s=f.stamp_s + 5 / 30, index=f.index + 5) for f in panels().frames[24:]]
    slam = EdgeSlam(CAMERA, NO_NETWORK)
    told = spied(monkeypatch, "add_visual")
    for frame in [*frames, *frozen, *later]:
        slam.step(frame)
    stamps = [call[0] for call in told]
    assert frames[-1].stamp_s in stamps
    assert not set(stamps) & {f.stamp_s for f in frozen}
    assert later[-1].stamp_s in stamps
