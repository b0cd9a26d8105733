"""Residuals of every kind, compiled; `losses` defines them."""

from edgeslam_torch.optim.kernels.edges import edges
from edgeslam_torch.optim.kernels.junctions import junctions
from edgeslam_torch.optim.kernels.reprojection import inverse_depth, reprojection

__all__ = ["edges", "inverse_depth", "junctions", "reprojection"]
