"""Adaptive weights: robust scales of the residuals.

The paper balances its terms by "adaptive weighting based on uncertainty" and gives no formula. Here every term is
whitened by a robust standard deviation of its own residuals, so that the weights of eq. (28) are pure numbers.
"""

from dataclasses import dataclass, field, replace

from torch import Tensor

from edgeslam_torch.geometry.robust_statistics import MAD_TO_SIGMA


def robust_sigma(residual: Tensor) -> Tensor:
    """Standard deviation ``()`` of residuals about zero by their median absolute value; NaN for none.

    Example:
        >>> import torch
        >>> robust_sigma(torch.tensor([-1.0, 1.0, 1.0, -1.0, 1000.0]))
        tensor(1.4826)
    """
    return MAD_TO_SIGMA * residual.abs().flatten().median()


@dataclass(frozen=True, slots=True)
class TermScale:
    """Running robust standard deviation of one term."""

    sigma: float
    """Current estimate, in the residual's unit."""
    low: float
    """Lower bound, so that no term dominates after a window with unusually small residuals."""
    high: float
    """Upper bound: a bad window must not silence a term."""
    smoothing: float = 0.8
    """Weight of the old value (in its logarithm) at each update."""
    min_count: int = 30
    """Minimum number of residuals for an update."""

    def __post_init__(self) -> None:
        if not 0 < self.low <= self.sigma <= self.high:
            raise ValueError(f"need 0 < low <= sigma <= high, got {self.low}, {self.sigma}, {self.high}")
        if not 0 <= self.smoothing < 1:
            raise ValueError(f"smoothing must lie in [0, 1), got {self.smoothing}")

    def updated(self, residual: Tensor) -> "TermScale":
        """The scale updated with one window's valid residuals."""
        if residual.numel() < self.min_count:
            return self
        new = float(robust_sigma(residual))
        if not new >= 0:
            return self
        new = min(max(new, self.low), self.high)
        smooth = self.sigma**self.smoothing * new ** (1.0 - self.smoothing)
        return replace(self, sigma=min(max(smooth, self.low), self.high))


@dataclass(frozen=True, slots=True)
class AdaptiveScales:
    """Scales of all terms of a window."""

    terms: dict[str, TermScale] = field(
        default_factory=lambda: {
            "reproj": TermScale(1.0, 0.5, 3.0),
            "edge": TermScale(1.0, 0.5, 3.0),
            "cycle": TermScale(0.05, 0.01, 0.3),
            "corner": TermScale(1.0, 0.5, 3.0),
            "angle": TermScale(0.05, 0.01, 0.3),
        }
    )

    def updated(self, residuals: dict[str, Tensor]) -> "AdaptiveScales":
        """Scales updated with one window; terms without residuals are unchanged."""
        new = {k: s.updated(residuals[k]) if k in residuals else s for k, s in self.terms.items()}
        return replace(self, terms=new)
