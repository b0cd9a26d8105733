"""Losses shared by Levenberg-Marquardt refinement and depth training.

Each takes tensors of one device and returns one value per item: ``(B,)`` for a batch ``(B, ...)``. What all of them
guarantee is in `edgeslam_torch.losses.base`; docs/guides/your-own-loop.md shows them in a training loop.
"""

if __name__ == "losses":
    raise ImportError("import edgeslam_torch.losses, not losses")

from edgeslam_torch.losses.base import Reduction, ResidualLoss, Residuals, back_project, move, project, reduce
from edgeslam_torch.losses.cycle import CycleForm, CycleLoss, sample_depth
from edgeslam_torch.losses.depth_terms import (
    BerHu,
    GradientMatching,
    LaplaceNll,
    LogSlope,
    MaskedL1,
    SILog,
    masked_mean,
)
from edgeslam_torch.losses.edge_alignment import EdgeAlignmentLoss
from edgeslam_torch.losses.lshape import AngleForm, AngleLoss, CollinearityLoss, LShapeLoss
from edgeslam_torch.losses.photometric import PhotometricLoss, SmoothnessLoss, dissimilarity, warp_to
from edgeslam_torch.losses.reprojection import ReprojectionLoss
from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.losses.total import TotalLoss

__all__ = [
    "AngleForm",
    "AngleLoss",
    "BerHu",
    "CollinearityLoss",
    "CycleForm",
    "CycleLoss",
    "EdgeAlignmentLoss",
    "GradientMatching",
    "Kernel",
    "LShapeLoss",
    "LaplaceNll",
    "LogSlope",
    "MaskedL1",
    "PhotometricLoss",
    "Reduction",
    "ReprojectionLoss",
    "ResidualLoss",
    "Residuals",
    "SILog",
    "SmoothnessLoss",
    "TotalLoss",
    "back_project",
    "dissimilarity",
    "masked_mean",
    "move",
    "project",
    "reduce",
    "rho",
    "sample_depth",
    "warp_to",
]
