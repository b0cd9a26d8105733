"""FastDepth's variants and the name and shape of every parameter; importing this needs no torch."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from edgeslam_torch.errors import WeightsError

MAX_WIDTH = 4096
"""Maximum channels of a layer; the published networks have up to 1024."""
MAX_PARAMETERS = 1 << 25
"""Maximum parameters of a network; the largest published one has 20.7 M."""
SKIP_INTO = {4: 1, 3: 3, 2: 5}
"""Decoder layer -> encoder layer whose output is added after upsampling."""
STRIDES = (2, 1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1)
"""Stride of conv0 ... conv13."""
MIN_DEPTH_M, MAX_DEPTH_M = 1e-3, 100.0
MAX_LOG_DEPTH = math.log(MAX_DEPTH_M)
LOG_SIGMA_RANGE = (-4.0, 1.5)
"""Output range of the uncertainty head: 2 % to a factor of 4.5."""
INPUT_MULTIPLE = 32
"""Height and width of an input must be multiples of this."""
STEP_COUNTER = "num_batches_tracked"
"""Batch norm's count of training steps, which inference does not use and old checkpoints do not have."""


class Padding(StrEnum):
    """How the 3x3 convolutions of the encoder pad their input."""

    SYMMETRIC = "symmetric"
    """One pixel on every side (torch, the official FastDepth weights)."""
    TF_SAME = "tf_same"
    """TensorFlow's SAME: at stride 2 nothing before and one pixel after (the ImageNet encoder we start
    from)."""


class Variant(StrEnum):
    """The paper's four networks."""

    NNCONV5 = "mobilenet-nnconv5"
    NNCONV5DW = "mobilenet-nnconv5dw"
    SKIPADD = "mobilenet-nnconv5dw-skipadd"
    PRUNED = "mobilenet-nnconv5dw-skipadd-pruned"

    @property
    def has_skips(self) -> bool:
        """Whether encoder features are added to the decoder's."""
        return self in (Variant.SKIPADD, Variant.PRUNED)


class Output(StrEnum):
    """Meaning of the last layer."""

    DEPTH = "depth"
    """ReLU of the last layer is depth in metres (upstream)."""
    LOG_DEPTH = "log_depth"
    """The exponential of the last layer is depth: positive everywhere, relative errors weigh the same near
    and far."""


class HasShape(Protocol):
    """A tensor of any library, in memory or on disk."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Size of every dimension."""


@dataclass(frozen=True, slots=True)
class Widths:
    """Output channels of every layer."""

    encoder: tuple[int, ...]
    """conv0 ... conv13."""
    decoder: tuple[int, ...]
    """decode_conv1 ... decode_conv5; decode_conv6 has one channel."""

    @staticmethod
    def of_state_dict(state: Mapping[str, HasShape]) -> "Widths":
        """Read the widths off a checkpoint's shapes, whichever variant it is."""

        def width(name: str) -> int:
            if name not in state:
                raise WeightsError(f"not a FastDepth checkpoint: no parameter {name!r}")
            shape = tuple(state[name].shape)
            if len(shape) != 4 or not 1 <= shape[0] <= MAX_WIDTH:
                raise WeightsError(f"not a FastDepth checkpoint: {name} has shape {shape}")
            return int(shape[0])

        encoder, decoder = ("conv", "decode_conv") if "conv0.0.weight" in state else ("mobilenet.", "decoder.conv")
        point = "1.0.weight" if f"{decoder}1.1.0.weight" in state else "0.weight"
        return Widths(
            (width(f"{encoder}0.0.weight"), *(width(f"{encoder}{i}.3.weight") for i in range(1, 14))),
            tuple(width(f"{decoder}{i}.{point}") for i in range(1, 6)),
        )


FULL = Widths((32, 64, 128, 128, 256, 256, 512, 512, 512, 512, 512, 512, 1024, 1024), (512, 256, 128, 64, 32))
PRUNED = Widths((16, 56, 88, 120, 144, 256, 408, 376, 272, 288, 296, 328, 480, 512), (200, 256, 120, 56, 16))


def variant_of(state: Mapping[str, HasShape]) -> Variant:
    """The variant of a checkpoint without a record, by its names and widths."""
    widths = Widths.of_state_dict(state)
    if "conv0.0.weight" in state:
        return Variant.SKIPADD if widths.encoder[-1] == FULL.encoder[-1] else Variant.PRUNED
    return Variant.NNCONV5DW if "decoder.conv1.1.0.weight" in state else Variant.NNCONV5


def parameter_shapes(variant: Variant, widths: Widths, uncertainty: bool) -> dict[str, tuple[int, ...]]:
    """Name and shape of every parameter and buffer, as in `FastDepth.state_dict`."""
    shapes: dict[str, tuple[int, ...]] = {}

    def layer(conv: str, norm: str, outputs: int, inputs: int, taps: int) -> None:
        shapes[f"{conv}.weight"] = (outputs, inputs, taps, taps)
        shapes.update({f"{norm}.{name}": (outputs,) for name in ("weight", "bias", "running_mean", "running_var")})
        shapes[f"{norm}.{STEP_COUNTER}"] = ()

    encoder, decoder = ("conv", "decode_conv") if variant.has_skips else ("mobilenet.", "decoder.conv")
    e, d = widths.encoder, (widths.encoder[-1], *widths.decoder)
    layer(f"{encoder}0.0", f"{encoder}0.1", e[0], 3, 3)
    for i in range(1, len(e)):
        layer(f"{encoder}{i}.0", f"{encoder}{i}.1", e[i - 1], 1, 3)
        layer(f"{encoder}{i}.3", f"{encoder}{i}.4", e[i], e[i - 1], 1)
    for i in range(1, len(d)):
        name = f"{decoder}{i}"
        if variant is Variant.NNCONV5:
            layer(f"{name}.0", f"{name}.1", d[i], d[i - 1], 5)
        else:
            layer(f"{name}.0.0", f"{name}.0.1", d[i - 1], 1, 5)
            layer(f"{name}.1.0", f"{name}.1.1", d[i], d[i - 1], 1)
    layer(f"{decoder}{len(d)}.0", f"{decoder}{len(d)}.1", 1, d[-1], 1)
    if uncertainty:
        shapes |= {"uncertainty.weight": (1, d[-1], 1, 1), "uncertainty.bias": (1,)}
    return shapes


def check_shapes(state: Mapping[str, HasShape], variant: Variant, uncertainty: bool) -> None:
    """Reject a checkpoint whose names or shapes do not match its variant.

    Raises:
        WeightsError: The first difference.
    """
    widths = Widths.of_state_dict(state)
    expected = parameter_shapes(variant, widths, uncertainty)
    missing = [n for n in expected if n not in state and not n.endswith(STEP_COUNTER)]
    if missing:
        raise WeightsError(f"does not fit {variant}: no parameter {missing[0]!r} ({len(missing)} missing)")
    for name, tensor in state.items():
        if name not in expected:
            raise WeightsError(f"does not fit {variant}: it has no parameter {name[:80]!r}")
        if tuple(tensor.shape) != expected[name]:
            raise WeightsError(f"does not fit {variant}: {name} is {tuple(tensor.shape)}, expected {expected[name]}")
    parameters = sum(math.prod(shape) for shape in expected.values())
    if parameters > MAX_PARAMETERS:
        raise WeightsError(
            f"{parameters / 1e6:.0f} M parameters, more than any FastDepth ({MAX_PARAMETERS / 1e6:.0f} M)"
        )
    for into, out_of in SKIP_INTO.items() if variant.has_skips else ():
        a, b = widths.decoder[into - 1], widths.encoder[out_of]
        if a != b:
            raise WeightsError(f"does not fit {variant}: conv{out_of} ({b}) cannot be added to decode_conv{into} ({a})")
