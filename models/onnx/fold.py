"""The deployed network: batch norm folded into the convolutions, calibrated sigma."""

import copy

import torch
from torch import Tensor, nn

from edgeslam_torch.models.fastdepth import LOG_SIGMA_RANGE, FastDepth
from edgeslam_torch.models.layout import MAX_LOG_DEPTH
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule


class _Deployed(nn.Module):
    """Computation of an exported file: log depth and its calibrated sigma at half the input's size.

    Both heads are one convolution of two channels: quantised features are then read once.
    """

    def __init__(self, network: FastDepth, metadata: Metadata) -> None:
        super().__init__()
        self.network = network
        self.scale, self.floor = metadata.sigma_scale, metadata.sigma_floor
        self.heads: nn.Conv2d | None = None
        if network.uncertainty is not None:
            head = network.decoder_layers()[-1][0]  # type: ignore[index]
            self.heads = nn.Conv2d(head.in_channels, 2, 1)
            with torch.no_grad():
                self.heads.weight.copy_(torch.cat((head.weight, network.uncertainty.weight)))
                self.heads.bias.copy_(torch.cat((head.bias, network.uncertainty.bias)))  # type: ignore[union-attr, arg-type]

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        if self.heads is None:
            log_depth = self.network.predict_half(image).log_depth
            return log_depth, torch.full_like(log_depth, self.floor)
        # Slices instead of a split: ONNX's converter cannot convert Split to older opsets.
        both = self.heads(self.network.features(image))
        last, raw = both[:, :1], both[:, 1:]
        return self.network.log_depth_of(last), _calibrated(raw, self.scale, self.floor)


class _DeployedOther(nn.Module):
    """The same of any network, as it is."""

    def __init__(self, network: DepthModule, metadata: Metadata) -> None:
        super().__init__()
        self.network = network
        self.scale, self.floor = metadata.sigma_scale, metadata.sigma_floor

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        log_depth, log_sigma = self.network.predict_half(image)
        log_depth = log_depth.clamp(-MAX_LOG_DEPTH, MAX_LOG_DEPTH)
        if log_sigma is None:
            return log_depth, torch.full_like(log_depth, self.floor)
        return log_depth, _calibrated(log_sigma, self.scale, self.floor)


def _calibrated(log_sigma: Tensor, scale: float, floor: float) -> Tensor:
    sigma = log_sigma.clamp(*LOG_SIGMA_RANGE).exp() * scale
    return (sigma * sigma + floor**2).sqrt()


def deployed(network: DepthModule, metadata: Metadata) -> nn.Module:
    """The network as exported: sigma calibrated, FastDepth's batch norm folded; torch reference for parity checks."""
    if isinstance(network, FastDepth):
        return _Deployed(fold_batch_norm(network), metadata).eval()
    return _DeployedOther(copy.deepcopy(network), metadata).eval()


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
