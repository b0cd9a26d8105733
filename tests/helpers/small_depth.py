"""A depth network that trains in milliseconds and has all that a recipe asks of one."""

import torch
from torch import nn

from edgeslam_torch.models.record import OTHER_NETWORK, Metadata
from edgeslam_torch.models.trainable import DepthModule, Prediction

METADATA = Metadata(variant=OTHER_NETWORK, input_height=32, input_width=64, focal_px=50.0)


def _stage(inputs, outputs, stride):
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU())


class SmallDepth(DepthModule):
    """An encoder and a decoder of one stage, and a head for depth and sigma."""

    def __init__(self, width=8):
        super().__init__()
        self.coder, self.decoder = _stage(3, width, 2), _stage(width, width, 1)
        self.head = nn.Conv2d(width, 2, 3, padding=1)

    def predict(self, x):
        half = self.head(self.decoder(self.coder(x)))
        return Prediction(*nn.functional.interpolate(half, scale_factor=2.0, mode="bilinear").split(1, 1))

    def encoder(self):
        return (self.coder,)


def small_depth(seed=0):
    """The same weights every time."""
    torch.manual_seed(seed)
    return SmallDepth()
