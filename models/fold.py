"""The network as it is deployed: batch norm folded into the convolutions, sigma calibrated."""

import copy

import torch
from torch import Tensor, nn

from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.record import Metadata


class _Deployed(nn.Module):
    """What the file computes: log depth and calibrated sigma of log depth from normalised RGB."""

    def __init__(self, network: FastDepth, metadata: Metadata) -> None:
        super().__init__()
        self.network = network
        self.scale, self.floor = metadata.sigma_scale, metadata.sigma_floor

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        predicted = self.network.predict(image)
        if predicted.log_sigma is None:
            return predicted.log_depth, torch.full_like(predicted.log_depth, self.floor)
        sigma = predicted.log_sigma.exp() * self.scale
        return predicted.log_depth, (sigma * sigma + self.floor**2).sqrt()


def deployed(network: FastDepth, metadata: Metadata) -> nn.Module:
    """The network as exported: batch norm folded, sigma calibrated; torch reference for parity checks."""
    return _Deployed(fold_batch_norm(network), metadata).eval()


def fold_batch_norm(network: FastDepth) -> FastDepth:
    """A copy in evaluation mode whose convolutions absorb the batch norms (same outputs, fewer
    operations)."""
    folded = copy.deepcopy(network).eval()
    for parent in list(folded.modules()):
        if not isinstance(parent, nn.Sequential):
            continue
        for name, child in list(parent.named_children()):
            follower = parent._modules.get(str(int(name) + 1)) if name.isdigit() else None
            if isinstance(child, nn.Conv2d) and isinstance(follower, nn.BatchNorm2d):
                parent._modules[name] = nn.utils.fuse_conv_bn_eval(child, follower)
                parent._modules[str(int(name) + 1)] = nn.Identity()
    return folded
