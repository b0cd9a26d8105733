"""Every public loss with a batch of two that it fits, for tests of what all of them promise."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from edgeslam_torch import losses
from edgeslam_torch.geometry import se3_torch as lie

Arguments = dict[str, Tensor]
B, N, C, M, H, W = 2, 9, 4, 5, 12, 16
K = torch.tensor([[20.0, 0.0, 7.5], [0.0, 18.0, 5.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
TWIST = torch.tensor([[0.10, -0.05, 0.08, 0.01, -0.03, 0.02], [-0.12, 0.04, 0.05, 0.02, 0.02, -0.01]]).double()


@dataclass(frozen=True)
class Case:
    """A loss, what it is given (float64), and what is predicted there."""

    loss: nn.Module
    given: Callable[[], Arguments]
    predicted: str
    """Argument that a network makes."""
    out: str = ""
    """Observation, or mask, whose first entry takes the first item's first element out, by NaN or False."""
    with_it: dict[str, int] = field(default_factory=dict)
    """How many leading numbers of the other arguments belong to that element: they may be NaN then."""
    batch_only: bool = False
    """Takes no single item."""


def uniform(low, high, *shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def pixels(*shape, seed):
    return torch.stack((uniform(3, W - 4, *shape, seed=seed), uniform(3, H - 4, *shape, seed=seed + 100)), -1)


def pair():
    return {"T_j_i": lie.exp(TWIST), "uv": pixels(B, N, seed=1), "depth_i": uniform(2, 3, B, N, seed=2)}


def cycle():
    return {**pair(), "depth_j": uniform(2.3, 2.7, B, H, W, seed=3), "K": K.expand(B, 3, 3)}


def aligned():
    normal = nn.functional.normalize(uniform(-1, 1, B, N, 2, seed=4), dim=-1)
    return {**pair(), "uv_j": pixels(B, N, seed=5), "normal_j": normal, "K": K.expand(B, 3, 3)}


def corners():
    depth, cos_j = uniform(2, 3, B, C, 3, seed=7), uniform(-0.9, 0.9, B, C, seed=8)
    T_j_i, uv = lie.exp(TWIST), pixels(B, C, 3, seed=6)
    return {"T_j_i": T_j_i, "uv": uv, "depth_i": depth, "cos_j": cos_j, "K": K.expand(B, 3, 3)}


def arms():
    return {"p": uniform(-1, 1, B, C, 2, M, 3, seed=9), "mask": torch.ones(B, C, 2, M, dtype=torch.bool)}


def window():
    T_c_w = torch.stack((torch.eye(4).double().expand(B, 4, 4), lie.exp(TWIST)), 1)
    p_w = losses.back_project(pixels(B, N, seed=10), uniform(2, 3, B, N, seed=11), K)
    mask = torch.ones(B, 2, N, dtype=torch.bool)
    return {"T_c_w": T_c_w, "p_w": p_w, "uv": pixels(B, 2, N, seed=12), "K": K.expand(B, 3, 3), "mask": mask}


def dense():
    mask = uniform(0, 1, B, 1, H, W, seed=15) > 0.2
    mask[0, 0, 0, 0] = True
    return {
        "log_depth": uniform(-1, 1, B, 1, H, W, seed=13),
        "log_target": uniform(-1, 1, B, 1, H, W, seed=14),
        "mask": mask,
    }


def images():
    v, u = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
    waves = [
        torch.stack((torch.sin(0.5 * (u - s)), torch.cos(0.4 * (u - s) + 0.3 * v), torch.sin(0.3 * (u - s) - 0.5 * v)))
        for s in (0, 1, 2)
    ]
    rgb = (torch.stack(waves) + 1.0) / 2.0
    T = torch.eye(4).double().repeat(B, 2, 1, 1)
    T[:, 0, 0, 3], T[:, 1, 0, 3] = 0.1, 0.2
    return {
        "image_i": rgb[:1].expand(B, -1, -1, -1),
        "images_j": rgb[1:].expand(B, -1, -1, -1, -1),
        "depth_i": uniform(1.8, 2.2, B, 1, H, W, seed=16),
        "T_j_i": T,
        "K": K.expand(B, 3, 3),
    }


def smooth():
    return {"log_depth": uniform(0, 1, B, 1, H, W, seed=17), "image": uniform(0, 1, B, 3, H, W, seed=18)}


def uncertain():
    return {"log_sigma": uniform(-1, 0, B, 1, H, W, seed=19), **dense()}


def lshape():
    return {**corners(), "arms": arms()["p"], "arms_mask": arms()["mask"]}


WIDE = {"max_relative": 9.0}
EDGE = {"uv": 2, "depth_i": 1}
PIXEL = {"log_depth": 1, "log_target": 1}
CASES = {
    "reprojection": Case(losses.ReprojectionLoss(), window, "p_w", "uv", {"uv": 2}),
    "reprojection, masked": Case(losses.ReprojectionLoss(), window, "p_w", "mask", {"uv": 2}),
    "alignment": Case(losses.EdgeAlignmentLoss(), aligned, "depth_i", "uv_j", EDGE | {"uv_j": 2, "normal_j": 2}),
    "cycle": Case(losses.CycleLoss(**WIDE), cycle, "depth_i", "uv", EDGE),
    "cycle, pixel": Case(losses.CycleLoss(losses.CycleForm.PIXEL, **WIDE), cycle, "depth_i", "uv", EDGE),
    "cycle, parallax": Case(losses.CycleLoss(losses.CycleForm.PARALLAX, **WIDE), cycle, "depth_i", "uv", EDGE),
    "angle": Case(losses.AngleLoss(), corners, "depth_i", "cos_j", {"uv": 6, "depth_i": 3}),
    "angle, right": Case(
        losses.AngleLoss(losses.AngleForm.RIGHT_ANGLE, gate_cos=2.0),
        corners,
        "depth_i",
        "uv",
        {"depth_i": 3, "cos_j": 1},
    ),
    "collinearity": Case(losses.CollinearityLoss(), arms, "p", "mask", {"p": 3}),
    "collinearity, literal": Case(losses.CollinearityLoss(literal=True), arms, "p", "mask", {"p": 3}),
    "lshape": Case(
        losses.LShapeLoss(losses.AngleLoss(), losses.CollinearityLoss()), lshape, "depth_i", "arms_mask", {"arms": 3}
    ),
    "l1": Case(losses.MaskedL1(), dense, "log_depth", "mask", PIXEL, batch_only=True),
    "berhu": Case(losses.BerHu(), dense, "log_depth", "mask", PIXEL, batch_only=True),
    "silog": Case(losses.SILog(), dense, "log_depth", "mask", PIXEL, batch_only=True),
    "slope": Case(losses.LogSlope(), dense, "log_depth", "mask", PIXEL, batch_only=True),
    "gradient": Case(losses.GradientMatching(scales=2), dense, "log_depth", "mask", PIXEL, batch_only=True),
    "laplace": Case(losses.LaplaceNll(), uncertain, "log_sigma", "mask", PIXEL | {"log_sigma": 1}, batch_only=True),
    "photometric": Case(losses.PhotometricLoss(), images, "depth_i", batch_only=True),
    "smoothness": Case(losses.SmoothnessLoss(), smooth, "log_depth", batch_only=True),
}
"""By name; every loss that `edgeslam_torch.losses` exports is there."""
