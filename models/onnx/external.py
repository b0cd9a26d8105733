"""Depth networks of others as ONNX files: what goes in, and what comes out.

The description is in the file's property ``edgeslam.depth`` (JSON), otherwise in a TOML file beside it.
"""

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import onnx

from edgeslam_torch.errors import ConfigError, WeightsError
from edgeslam_torch.files.config_file import laid_over
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.models.onnx.file import OnnxFile, parse_onnx
from edgeslam_torch.models.onnx.presets import PRESETS
from edgeslam_torch.models.record import MAX_INPUT_PX, STD_RANGE

logger = logging.getLogger(__name__)

PROPERTY = "edgeslam.depth"
"""Key of the record among a file's properties."""
MAX_MULTIPLE = 256
FREE_SIDE_PX = 518
"""Side of the input of a network that takes any and states none: that of the vision transformers for depth."""
SIGMA_RANGE = (0.01, 2.0)
"""Plausible standard deviations of log depth: 1 % to a factor of 7."""


class Gives(StrEnum):
    """What the numbers of the depth output are."""

    METRES = "metres"
    LOG_METRES = "log_metres"
    INVERSE_METRES = "inverse_metres"
    RELATIVE_INVERSE = "relative_inverse"
    """Inverse depth up to scale and shift, larger where it is nearer."""


@dataclass(frozen=True, slots=True)
class ExternalNetwork:
    """How to feed a depth network and to read its output.

    Raises:
        ValueError: If a value is not plausible.
    """

    gives: str = ""
    """One of `Gives`."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """The input is ``(rgb - mean) / std`` with rgb in [0, 1]."""
    input_height: int = 0
    input_width: int = 0
    """Size of the training images [px]; 0 for the graph's own fixed size, else `FREE_SIDE_PX`. A graph of dynamic
    size gets the image's shape at about so many pixels."""
    multiple: int = 1
    """Height and width of the input must be multiples of this: 14 or 16 for vision transformers."""
    focal_px: float = 0.0
    """Focal length, in pixels of the input, for which the metres are right; 0 when the network takes any camera."""
    sigma_log: float = 0.25
    """Standard deviation of log depth where the network states none."""
    input: str = ""
    depth: str = ""
    """Names of input and depth output; empty for the only input and the first output."""
    sigma: str = ""
    """Name of the output with the standard deviation of log depth; empty for none."""
    licence: str = ""
    notes: str = ""

    def __post_init__(self) -> None:
        if self.gives not in [*Gives]:
            raise ValueError(f"gives must be one of {', '.join(Gives)}, got {self.gives!r}")
        for name, low, high in (
            ("input_height", 0, MAX_INPUT_PX),
            ("input_width", 0, MAX_INPUT_PX),
            ("multiple", 1, MAX_MULTIPLE),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be from {low} to {high}, got {getattr(self, name)}")
        if self.input_height % self.multiple or self.input_width % self.multiple:
            raise ValueError(f"input_height and input_width must be multiples of {self.multiple}")
        if not all(abs(x) <= 10.0 for x in self.mean) or not all(STD_RANGE[0] <= x <= STD_RANGE[1] for x in self.std):
            raise ValueError(f"mean must lie within 10 and std from {STD_RANGE[0]:g} to {STD_RANGE[1]:g}")
        if not 0.0 <= self.focal_px <= 20.0 * MAX_INPUT_PX:
            raise ValueError(f"focal_px must be positive, or 0 for any camera, got {self.focal_px}")
        if not SIGMA_RANGE[0] <= self.sigma_log <= SIGMA_RANGE[1]:
            raise ValueError(f"sigma_log must be from {SIGMA_RANGE[0]:g} to {SIGMA_RANGE[1]:g}, got {self.sigma_log}")

    @property
    def is_relative(self) -> bool:
        """Whether its depth has neither unit nor origin."""
        return self.gives == Gives.RELATIVE_INVERSE


def channels_last(sides: Sequence[int]) -> bool:
    """Whether an input of these four sizes, 0 where one is free, is ``(1, H, W, 3)`` rather than ``(1, 3, H, W)``."""
    return sides[3] == 3 and sides[1] != 3


def read_external(file: OnnxFile | Path) -> tuple[bytes, ExternalNetwork]:
    """An ONNX depth network of others and its description.

    The description is the file's own, else that of the TOML file beside it (``depth.toml`` of ``depth.onnx``), whose
    ``preset`` may name one of `PRESETS` to start from.

    Raises:
        WeightsError: If the file is missing, damaged, refers to other files, or is not described.
    """
    file = file if isinstance(file, OnnxFile) else parse_onnx(file)
    path, model = file.path, file.model
    return file.content, _with_fixed_size(_description(model, path), model, path)


def _description(model: onnx.ModelProto, path: Path) -> ExternalNetwork:
    beside = path.with_suffix(".toml")
    own = next((p.value for p in model.metadata_props if p.key == PROPERTY), None)
    if own is None and not beside.is_file():
        raise WeightsError(
            f"{path}: this network has no description; write one in {beside.name} beside it "
            f"(gives = {' | '.join(repr(str(g)) for g in Gives)}, or preset = {' | '.join(map(repr, PRESETS))})"
        )
    try:
        record = _json(own) if own is not None else read_mapping(beside, "TOML", ConfigError)
        preset = record.pop("preset", None)
        if preset is not None and str(preset) not in PRESETS:
            raise ConfigError(f"no preset {preset!r}; there are {', '.join(PRESETS)}")
        known = {} if preset is None else PRESETS[preset].description
        origin = f"{path}: {PROPERTY}" if own is not None else str(beside)
        return laid_over(_start(known, record, origin), {**known, **record}, origin)
    except (ConfigError, ValueError, TypeError, OverflowError) as error:
        said = str(error)
        raise WeightsError(said if said.startswith((str(path), str(beside))) else f"{path}: {said}") from None


def _json(text: str) -> dict[str, Any]:
    try:
        record = json.loads(text)
    except (ValueError, RecursionError):
        raise ConfigError(f"its property {PROPERTY} is not JSON") from None
    if not isinstance(record, dict):
        raise ConfigError(f"its property {PROPERTY} is not a JSON object")
    return record


def _start(known: dict[str, Any], record: dict[str, Any], origin: str) -> ExternalNetwork:
    """Neutral values; ``gives`` has none and must be said."""
    gives = record.get("gives", known.get("gives"))
    if gives not in [*Gives]:
        raise ConfigError(f"{origin}: gives must be one of {', '.join(Gives)}, got {gives!r}")
    return ExternalNetwork(gives=str(gives))


def _with_fixed_size(network: ExternalNetwork, model: onnx.ModelProto, path: Path) -> ExternalNetwork:
    """The description with names and size of the graph's ends, checked against each other."""
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in constants]
    outputs = [value.name for value in model.graph.output]
    chosen = [v for v in inputs if v.name == (network.input or v.name)]
    if len(chosen) != 1:
        names = ", ".join(v.name for v in inputs)
        raise WeightsError(
            f"{path}: it must take one image; its inputs are {names or 'none'}, input is {network.input!r}"
        )
    shape = chosen[0].type.tensor_type.shape.dim
    sides = [d.dim_value for d in shape]
    if len(sides) != 4 or not (sides[1] in (0, 3) or channels_last(sides)):
        raise WeightsError(f"{path}: its input is {sides}, expected [1, 3, H, W] or [1, H, W, 3]")
    depths = [name for name in outputs if name != network.sigma]
    if not depths:
        raise WeightsError(f"{path}: it has no output for depth")
    if not network.depth and len(depths) > 1:
        logger.warning(
            f"{path}: takes the first of its outputs {', '.join(depths)} as depth; for another, say depth = NAME"
        )
    for name in (network.depth or depths[0], network.sigma):
        if name and name not in outputs:
            raise WeightsError(f"{path}: no output {name!r}; there are {', '.join(outputs)}")
    rows = sides[1:3] if channels_last(sides) else sides[2:]
    size = dict(zip(("input_height", "input_width"), rows, strict=True))
    fixed = {name: side for name, side in size.items() if side}
    if any(getattr(network, name) not in (0, side) for name, side in fixed.items()):
        raise WeightsError(
            f"{path}: it takes images of {rows[0]}x{rows[1]} (height x width), not of the described size"
        )
    free = [name for name in size if not (size[name] or getattr(network, name))]
    if free:
        side = FREE_SIDE_PX // network.multiple * network.multiple
        fixed |= dict.fromkeys(free, side)
        logger.warning(f"{path}: it takes images of any size, and gets {side} px; say {' and '.join(free)} for another")
    try:
        return replace(network, input=chosen[0].name, depth=network.depth or depths[0], **fixed)
    except ValueError as error:
        raise WeightsError(f"{path}: {error}") from None
