"""MobileNetV1 blocks under upstream FastDepth's names: the encoder is conv0 ... conv13."""

import torch.nn.functional as F
from torch import Tensor, nn

from edgeslam_torch.models.layout import STRIDES, Padding


class SameConv2d(nn.Conv2d):
    """A 3x3 convolution of stride 2 padded as TensorFlow does for even sizes: right and bottom only.

    With symmetric padding output ``i`` is centred on input ``2i``, here on ``2i + 1``: weights trained with one and
    run with the other see the image shifted by up to 31 pixels at the end of the encoder.
    """

    def forward(self, x: Tensor) -> Tensor:
        """``(B, C, H, W)`` with even H, W -> ``(B, C', H/2, W/2)``."""
        return self._conv_forward(F.pad(x, (0, 1, 0, 1)), self.weight, self.bias)


def _conv3x3(inputs: int, outputs: int, stride: int, groups: int, padding: Padding) -> nn.Conv2d:
    if stride == 2 and padding is Padding.TF_SAME:
        return SameConv2d(inputs, outputs, 3, 2, 0, groups=groups, bias=False)
    return nn.Conv2d(inputs, outputs, 3, stride, 1, groups=groups, bias=False)


def stem(outputs: int, padding: Padding) -> nn.Sequential:
    """First layer: 3x3 convolution of stride 2."""
    return nn.Sequential(_conv3x3(3, outputs, 2, 1, padding), nn.BatchNorm2d(outputs), nn.ReLU6(inplace=True))


def separable(inputs: int, outputs: int, stride: int, padding: Padding) -> nn.Sequential:
    """Depthwise 3x3 and pointwise convolution, each with batch norm and ReLU6."""
    return nn.Sequential(
        _conv3x3(inputs, inputs, stride, inputs, padding),
        nn.BatchNorm2d(inputs),
        nn.ReLU6(inplace=True),
        nn.Conv2d(inputs, outputs, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU6(inplace=True),
    )


def encoder_layers(widths: tuple[int, ...], padding: Padding) -> list[nn.Sequential]:
    """The 14 layers for output widths ``(14,)``."""
    layers = [stem(widths[0], padding)]
    for inputs, outputs, stride in zip(widths, widths[1:], STRIDES[1:], strict=False):
        layers.append(separable(inputs, outputs, stride, padding))
    return layers
