"""The total loss, paper eq. (28)."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn


class TotalLoss(nn.Module):
    """``lambda_reproj L_reproj + lambda_cycle L_cycle + lambda_shape L_Lshape`` and any further terms by name.

    Example:
        >>> total = TotalLoss({"reproj": 1.0, "cycle": 0.5, "shape": 0.0})
        >>> total({"reproj": torch.tensor(2.0), "cycle": torch.tensor(4.0)})
        tensor(4.)
    """

    def __init__(self, weights: Mapping[str, float]) -> None:
        """Weights by name of term; each ``>= 0``."""
        super().__init__()
        negative = {k: w for k, w in weights.items() if w < 0}
        if negative:
            raise ValueError(f"weights must not be negative, got {negative}")
        self.weights = dict(weights)

    def forward(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Weighted sum ``()`` of scalar terms.

        Raises:
            ValueError: For a term without a weight, or no term.
        """
        unknown = terms.keys() - self.weights.keys()
        if unknown or not terms:
            raise ValueError(f"terms {sorted(terms)} must be some of {sorted(self.weights)}")
        return torch.stack([self.weights[k] * v for k, v in terms.items()]).sum()
