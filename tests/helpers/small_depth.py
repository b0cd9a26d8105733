"""A depth network that trains in milliseconds and has all that a recipe asks of one."""

import numpy as np
import torch
from torch import nn

from edgeslam_torch.models.checkpoint import build_network
from edgeslam_torch.models.fastdepth import FastDepth, Widths
from edgeslam_torch.models.record import OTHER_NETWORK, Metadata
from edgeslam_torch.models.trainable import DepthModule, Prediction
from edgeslam_torch.train.loop import train
from edgeslam_torch.train.signals import Source, Supervised
from edgeslam_torch.train.views.augment import View

METADATA = Metadata(variant=OTHER_NETWORK, input_height=32, input_width=64, focal_px=50.0)
RUNS = Metadata(input_height=96, input_width=128, focal_px=100.0)
"""Of the narrow FastDepth that learns from runs."""
VIEW = View(
    np.full((32, 64, 3), 90, np.uint8),
    np.full((32, 64), 2.0, np.float32),
    np.array([[50.0, 0, 31.5], [0, 50.0, 15.5], [0, 0, 1]]),
)


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


def narrow_fastdepth(metadata=RUNS, seed=0) -> FastDepth:
    """FastDepth with few channels; the same weights every time."""
    torch.manual_seed(seed)
    return build_network(metadata, Widths((4,) + (8,) * 13, (8,) * 5))


def learn(out, config, hooks):
    """Train `SmallDepth` on a grey wall."""
    signal = Supervised([Source("made", [VIEW], 1.0)], METADATA)
    return train(small_depth(), METADATA, [signal], config, out, lambda n: {"score": 1.0, "abs_rel": 0.3}, hooks)
