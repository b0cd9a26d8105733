"""A frame's pose from anchors, with what motion model and attitude predict."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.rotations import smallest_rotation
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.mapping.motion_terms import ATTITUDE, EFFECTIVE_SAMPLES, GUESSED_IMAGE, Vertical
from edgeslam_torch.mapping.prior_anchors import depth_slack_px, mostly_on_priors
from edgeslam_torch.optim.pose_only import PoseConfig, PoseResult, refine_pose
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class ExpectedPose:
    """A frame's pose before its image is measured."""

    T_c_w: FloatArray
    """``(4, 4)`` as predicted."""
    motion: FloatArray
    """``(6, 6)`` information of a left perturbation, limited by accelerations; zero without a scale."""
    vertical: Vertical | None = None
    """By the drone's attitude."""

    def prior(self, on_predicted_depths: bool) -> PosePrior:
        """The prior: the predicted pose, turned about its centre so that the vertical is where attitude has it; where
        images measure tilt, attitude has its weight of windows (`mapping.motion_terms`).

        Images of few and distant points, or of one plane, hardly distinguish a climb from a pitch, so that attitude
        counts in every frame. On predicted depths, whose errors are common to the whole image, the motion counts, too.
        """
        T_c_w, information = self.T_c_w, self.motion.copy() if on_predicted_depths else np.zeros((6, 6))
        if self.vertical is not None:
            samples = GUESSED_IMAGE if on_predicted_depths or self.vertical.held else ATTITUDE * EFFECTIVE_SAMPLES
            up_c = self.vertical.up_c
            across = np.eye(3) - np.outer(up_c, up_c)
            information[3:, 3:] += across / self.vertical.sigma(samples) ** 2
            T_c_w = T_c_w.copy()
            T_c_w[:3] = smallest_rotation(self.T_c_w[:3, :3] @ self.vertical.up_w, up_c) @ self.T_c_w[:3]
        return PosePrior(0, T_c_w, information)


def pose_on_anchors(
    anchors: Anchors,
    anchor: IntArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    T_c_w: FloatArray,
    camera: Camera,
    expected: ExpectedPose | None,
    config: PoseConfig,
) -> PoseResult:
    """Robust pose of a frame from anchors ``(N,)`` at pixels ``(N, 2)``.

    Args:
        anchors: Anchors of the map.
        anchor: Their ids ``(N,)``.
        uv: Undistorted pixels ``(N, 2)``.
        inv_sigma: ``(N,)`` inverse standard deviations [1/px].
        T_c_w: Initial pose ``(4, 4)``.
        camera: Intrinsics.
        expected: The predicted pose; the images alone decide without one.
        config: Solver settings.
    """
    slack_px = depth_slack_px(anchors, anchor, T_c_w, camera)
    prior = None if expected is None else expected.prior(mostly_on_priors(anchors, anchor))
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return refine_pose(
        T_c_w, anchors.p_w[anchor], uv, inv_sigma, intrinsics, slack_px=slack_px, prior=prior, config=config
    )
