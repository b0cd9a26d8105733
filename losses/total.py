"""The total loss, paper eq. (28)."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

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

    def weighted(self, terms: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Each term times its weight, those of weight 0 left out.

        Raises:
            ValueError: For a term without a weight, or no term.
        """
        unknown = terms.keys() - self.weights.keys()
        if unknown or not terms:
            raise ValueError(f"terms {sorted(terms)} must be some of {sorted(self.weights)}")
        return {name: self.weights[name] * term for name, term in terms.items() if self.weights[name]}

    def forward(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Weighted sum of terms, shaped as each of them: ``()``, or ``(B,)`` one value an item.

        Raises:
            ValueError: For a term without a weight, no term, or terms of several shapes.
        """
        shapes = {name: tuple(term.shape) for name, term in terms.items()}
        if any(shape != next(iter(shapes.values())) for shape in shapes.values()):
            raise ValueError(f"terms must have one shape, got {shapes}")
        weighted = self.weighted(terms)
        if not weighted:
            return torch.zeros_like(next(iter(terms.values())))
        return torch.stack(list(weighted.values())).sum(0)

    if TYPE_CHECKING:
        __call__ = forward
