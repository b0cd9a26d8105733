"""A frame's pose from anchors, with the motion model's prediction where these rest on predicted depths."""

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.mapping.prior_anchors import depth_slack_px, mostly_on_priors
from edgeslam_torch.optim.pose_only import PoseConfig, PoseResult, refine_pose
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.types import FloatArray, IntArray


def pose_on_anchors(
    anchors: Anchors,
    anchor: IntArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    T_c_w: FloatArray,
    camera: Camera,
    expected: PosePrior | None,
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
        expected: The predicted pose, used where most anchors rest on predicted depths: their errors are common to the
            whole image, and a translation may look like a rotation.
        config: Solver settings.
    """
    slack_px = depth_slack_px(anchors, anchor, T_c_w, camera)
    prior = expected if mostly_on_priors(anchors, anchor) else None
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return refine_pose(
        T_c_w, anchors.p_w[anchor], uv, inv_sigma, intrinsics, slack_px=slack_px, prior=prior, config=config
    )
