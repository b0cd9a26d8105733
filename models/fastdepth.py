"""FastDepth (Wofk et al., ICRA 2019) in its four published variants, under upstream's parameter names."""

import math
from typing import TYPE_CHECKING

import torch.nn.functional as F
from torch import Tensor, nn

from edgeslam_torch.models.layout import (
    FULL,
    INPUT_MULTIPLE,
    LOG_SIGMA_RANGE,
    MAX_DEPTH_M,
    MAX_LOG_DEPTH,
    MIN_DEPTH_M,
    PRUNED,
    SKIP_INTO,
    Output,
    Padding,
    Variant,
    Widths,
)
from edgeslam_torch.models.mobilenet import encoder_layers
from edgeslam_torch.models.trainable import DepthModule, Prediction

__all__ = ["FULL", "PRUNED", "FastDepth", "Output", "Padding", "Prediction", "Variant", "Widths"]


class FastDepth(DepthModule):
    """Encoder MobileNetV1, decoder of five 5x5 nearest-neighbour upsampling convolutions.

    Args:
        variant: One of the four networks.
        widths: Channels; by default those published for the variant.
        padding: Padding of the encoder's strided convolutions, see `Padding`.
        output: Meaning of the last layer.
        uncertainty: Adds a 1x1 head (``uncertainty``) on the last features; upstream has none.
    """

    def __init__(
        self,
        variant: Variant | str = Variant.SKIPADD,
        widths: Widths | None = None,
        padding: Padding | str = Padding.SYMMETRIC,
        output: Output | str = Output.DEPTH,
        uncertainty: bool = False,
    ) -> None:
        super().__init__()
        self.variant, self.padding, self.output = Variant(variant), Padding(padding), Output(output)
        self.widths = widths or (PRUNED if self.variant is Variant.PRUNED else FULL)
        layers = encoder_layers(self.widths.encoder, self.padding)
        channels = (self.widths.encoder[-1], *self.widths.decoder)
        block = _dense5 if self.variant is Variant.NNCONV5 else _separable5
        decoder = [block(a, b) for a, b in zip(channels, channels[1:], strict=False)]
        decoder.append(_pointwise(channels[-1], 1))
        if self.variant.has_skips:
            for i, layer in enumerate(layers):
                self.add_module(f"conv{i}", layer)
            for i, layer in enumerate(decoder, start=1):
                self.add_module(f"decode_conv{i}", layer)
        else:
            self.mobilenet = nn.Sequential(*layers)
            self.decoder = nn.ModuleDict({f"conv{i}": layer for i, layer in enumerate(decoder, start=1)})
        self.uncertainty = nn.Conv2d(channels[-1], 1, 1) if uncertainty else None
        self.apply(_initialise)
        if self.uncertainty is not None:
            nn.init.zeros_(self.uncertainty.weight)
            nn.init.constant_(self.uncertainty.bias, math.log(0.2))  # type: ignore[arg-type]

    def encoder(self) -> list[nn.Module]:
        """conv0 ... conv13 in order."""
        if self.variant.has_skips:
            return [self.get_submodule(f"conv{i}") for i in range(14)]
        return list(self.mobilenet)

    def decoder_layers(self) -> list[nn.Module]:
        """decode_conv1 ... decode_conv6 in order."""
        prefix = "decode_conv" if self.variant.has_skips else "decoder.conv"
        return [self.get_submodule(f"{prefix}{i}") for i in range(1, 7)]

    def heads(self) -> list[nn.Module]:
        """The last layer: its batch norm works on one channel, the depth itself."""
        return self.decoder_layers()[-1:]

    def predict_half(self, x: Tensor) -> Prediction:
        """Log depth and its uncertainty for normalised RGB ``(B, 3, H, W)``, at half its size.

        Upstream upsamples its last features and then applies a 1x1 convolution; the two commute, and convolving first
        saves about a tenth of the time (onnxruntime, 160x224). `predict` doubles the result as upstream does.
        """
        features = self.features(x)
        head = self.decoder_layers()[-1]
        log_sigma = None if self.uncertainty is None else self.uncertainty(features).clamp(*LOG_SIGMA_RANGE)
        return Prediction(self.log_depth_of(head[1](head[0](features))), log_sigma)  # type: ignore[index]

    def log_depth_of(self, last: Tensor) -> Tensor:
        """Log depth from the last convolution's output."""
        if self.output is Output.LOG_DEPTH:
            return last.clamp(-MAX_LOG_DEPTH, MAX_LOG_DEPTH)
        return F.relu(last).clamp(MIN_DEPTH_M, MAX_DEPTH_M).log()

    def predict(self, x: Tensor) -> Prediction:
        """Log depth and its uncertainty for normalised RGB ``(B, 3, H, W)``, H and W multiples of 32."""
        log_depth, log_sigma = self.predict_half(x)
        return Prediction(_doubled(log_depth), None if log_sigma is None else _doubled(log_sigma))

    def forward(self, x: Tensor) -> Tensor:
        """Depth at the training focal length [m], ``(B, 1, H, W)``, for normalised RGB ``(B, 3, H, W)``."""
        head = self.decoder_layers()[-1]
        last = _doubled(head[1](head[0](self.features(x))))  # type: ignore[index]
        if self.output is Output.LOG_DEPTH:
            return last.clamp(-MAX_LOG_DEPTH, MAX_LOG_DEPTH).exp()
        return F.relu(last)

    if TYPE_CHECKING:
        __call__ = forward

    def features(self, x: Tensor) -> Tensor:
        """Input of the last 1x1 convolution, ``(B, C, H/2, W/2)``."""
        if x.shape[-1] % INPUT_MULTIPLE or x.shape[-2] % INPUT_MULTIPLE:
            size = tuple(x.shape[-2:])
            raise ValueError(f"height and width must be multiples of {INPUT_MULTIPLE}, got {size}")
        kept: dict[int, Tensor] = {}
        for i, layer in enumerate(self.encoder()):
            x = layer(x)
            if self.variant.has_skips and i in SKIP_INTO.values():
                kept[i] = x
        stages = self.decoder_layers()[:-1]
        for i, layer in enumerate(stages, start=1):
            x = layer(x)
            if i < len(stages):
                x = _doubled(x)
            if self.variant.has_skips and i in SKIP_INTO:
                x = x + kept[SKIP_INTO[i]]
        return x


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


def _pointwise(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def _dense5(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 5, padding=2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


def _separable5(inputs: int, outputs: int) -> nn.Sequential:
    depthwise = nn.Sequential(
        nn.Conv2d(inputs, inputs, 5, padding=2, groups=inputs, bias=False),
        nn.BatchNorm2d(inputs),
        nn.ReLU(inplace=True),
    )
    return nn.Sequential(depthwise, _pointwise(inputs, outputs))


def _initialise(module: nn.Module) -> None:
    """He initialisation (fan out), which preserves activations through 13 ReLUs."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out")
