"""What training and export require of a network; FastDepth is one, and your own may be another."""

from collections.abc import Sequence
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn


class Prediction(NamedTuple):
    """Prediction for a batch; all ``(B, 1, H, W)``."""

    log_depth: Tensor
    """Natural logarithm of depth at the training focal length [log m]."""
    log_sigma: Tensor | None
    """Logarithm of the standard deviation of ``log_depth``; None without an uncertainty head."""


class DepthModule(nn.Module):
    """A network that `edgeslam_torch.train` teaches and `export_onnx` writes: subclass it and define `predict`.

    Its record is a `Metadata` with ``variant=OTHER_NETWORK``, and ``uncertainty`` as `predict` gives a sigma. Height
    and width of the images are multiples of 32. Training never rebuilds the network: it copies the one that it is
    given, and loads tensors by name.

    Example:
        >>> import torch
        >>> class Grey(DepthModule):
        ...     def __init__(self) -> None:
        ...         super().__init__()
        ...         self.layer = nn.Conv2d(3, 1, 3, padding=1)
        ...
        ...     def predict(self, x: Tensor) -> Prediction:
        ...         return Prediction(self.layer(x), None)
        >>> Grey().predict_half(torch.zeros(1, 3, 32, 64)).log_depth.shape
        torch.Size([1, 1, 16, 32])
    """

    def __init__(self) -> None:
        # Torch's own accepts anything, which hides wrong arguments from type checkers.
        super().__init__()

    def predict(self, x: Tensor) -> Prediction:
        """Log depth and its uncertainty for normalised RGB ``(B, 3, H, W)``, at its size; gradients pass."""
        raise NotImplementedError(f"{type(self).__name__} must define predict")

    def predict_half(self, x: Tensor) -> Prediction:
        """The same at half the size ``(B, 1, H/2, W/2)``, which validation and exported files use.

        Means of four pixels; define it where half the size costs less.
        """
        log_depth, log_sigma = self.predict(x)
        return Prediction(F.avg_pool2d(log_depth, 2), None if log_sigma is None else F.avg_pool2d(log_sigma, 2))

    def encoder(self) -> Sequence[nn.Module]:
        """Pretrained stages, from the image on: the first are frozen, the others learn at the
        encoder's rate, and their norms keep their statistics. None by default."""
        return ()

    def heads(self) -> Sequence[nn.Module]:
        """Last layers whose norms keep their statistics, too: a norm over depth itself would remove its scale."""
        return ()
