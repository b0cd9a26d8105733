"""Metadata of weights files; importing this needs no torch."""

import dataclasses
import json
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.layout import INPUT_MULTIPLE, HasShape, Output, Padding, Variant, variant_of

HEADER_KEY = "edgeslam"
OTHER_NETWORK = "other"
"""``variant`` of a network other than FastDepth; it comes as an ONNX file, which holds its own graph."""
DEFAULT_WEIGHTS = Path(__file__).parent / "weights" / "default.safetensors"
SHIPPED_WEIGHTS = {name: DEFAULT_WEIGHTS.with_name(f"{name}.safetensors") for name in ("default", "near")}
"""Weights that come with the package, by name. ``near`` has better shapes in rooms never seen, and worse metres. It is
used for obstacle avoidance, where the map provides the scale."""
MAX_INPUT_PX = 2048
"""Maximum height and width; four times the training size."""
FOCAL_RANGE = (0.05, 20.0)
"""Range of ``focal_px`` relative to ``input_width``: fields of view from 169 to 3 degrees."""
STD_RANGE = (1e-3, 1e3)
"""Range of ``std``; ImageNet's is 0.2, upstream's 1."""
_REQUIRED = ("variant", "input_height", "input_width", "focal_px", "mean", "std", "padding", "output", "uncertainty")
"""Required fields; the others have neutral defaults."""


@dataclass(frozen=True, slots=True)
class Metadata:
    """Everything needed to run the weights correctly, and their accuracy.

    Raises:
        ValueError: If a field has the wrong type or an implausible value.
    """

    variant: str = "mobilenet-nnconv5dw-skipadd"
    input_height: int = 192
    input_width: int = 256
    """Size of the training images [px]."""
    focal_px: float = 210.0
    """Focal length at ``input_width`` for which the network predicts metres; other cameras are corrected by the
    ratio."""
    mean: tuple[float, float, float] = (0.5, 0.5, 0.5)
    std: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Input is ``(rgb - mean) / std`` with rgb in [0, 1]."""
    padding: str = "tf_same"
    output: str = "log_depth"
    uncertainty: bool = True
    sigma_scale: float = 1.0
    sigma_floor: float = 0.0
    """Calibrated standard deviation of log depth: ``hypot(sigma_scale * sigma, sigma_floor)``."""
    units: str = "m"
    data: tuple[str, ...] = ()
    """Training data sets."""
    licence: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    notes: str = ""

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                self._refuse(name, f"one of {', '.join(choices)}")
        for name in ("input_height", "input_width"):
            size = getattr(self, name)
            if type(size) is not int or size % INPUT_MULTIPLE or not INPUT_MULTIPLE <= size <= MAX_INPUT_PX:
                self._refuse(name, f"a multiple of {INPUT_MULTIPLE} up to {MAX_INPUT_PX}")
        lowest, highest = (share * self.input_width for share in FOCAL_RANGE)
        if not _is_number(self.focal_px, lowest, highest):
            self._refuse(
                "focal_px", f"a number from {lowest:g} to {highest:g} for an input_width of {self.input_width}"
            )
        for name, (low, high) in {"mean": (-10.0, 10.0), "std": STD_RANGE}.items():
            values = getattr(self, name)
            if not isinstance(values, tuple) or len(values) != 3 or not all(_is_number(v, low, high) for v in values):
                self._refuse(name, f"three numbers from {low:g} to {high:g}")
        if type(self.uncertainty) is not bool:
            self._refuse("uncertainty", "true or false")
        for name, (low, high) in {"sigma_scale": (1e-3, 100.0), "sigma_floor": (0.0, 10.0)}.items():
            if not _is_number(getattr(self, name), low, high):
                self._refuse(name, f"a number from {low:g} to {high:g}")
        if not self.uncertainty and self.sigma_floor == 0:
            self._refuse("sigma_floor", "positive for a network without an uncertainty head")
        if self.units != "m":
            self._refuse("units", "'m'")
        for name in ("licence", "notes"):
            if not isinstance(getattr(self, name), str):
                self._refuse(name, "text")
        if not isinstance(self.data, tuple) or not all(isinstance(name, str) for name in self.data):
            self._refuse("data", "a list of names")
        if not isinstance(self.metrics, dict) or not all(isinstance(v, int | float) for v in self.metrics.values()):
            self._refuse("metrics", "a table of numbers")

    def _refuse(self, name: str, wanted: str) -> None:
        raise ValueError(f"{name} must be {wanted}, got {reprlib.repr(getattr(self, name))}")


_CHOICES: dict[str, list[str]] = {
    "variant": [*Variant, OTHER_NETWORK],
    "padding": [*Padding],
    "output": [*Output],
}


def _is_number(value: object, low: float, high: float) -> bool:
    """Whether it is a finite number in a range; NaN is in none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def metadata_from_json(text: str) -> Metadata:
    """Parse the metadata of a file; unknown keys are ignored so that newer files load.

    Raises:
        WeightsError: With the reason; the caller adds the file's name.
    """
    try:
        return metadata_from_record(json.loads(text))
    except ValueError:
        raise WeightsError("its metadata cannot be used: it is not JSON") from None
    except RecursionError:
        raise WeightsError("its metadata cannot be used: nested too deeply") from None


def metadata_from_record(record: object) -> Metadata:
    """The same from the parsed record."""
    try:
        if not isinstance(record, dict):
            raise ValueError(f"it is {reprlib.repr(record)}, not a table")
        missing = [name for name in _REQUIRED if name not in record]
        if missing:
            raise ValueError(f"it has no value for {', '.join(missing)}")
        known = {f.name for f in dataclasses.fields(Metadata)}
        kept: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in record.items() if k in known}
        return Metadata(**kept)
    except ValueError as error:
        raise WeightsError(f"its metadata cannot be used: {str(error)[:200]}") from None


def upstream_metadata(state: Mapping[str, HasShape]) -> Metadata:
    """Metadata of an official checkpoint: NYU Depth v2, 224x224, RGB in [0, 1], depth in metres.

    The focal length is that of NYU's Kinect (518.86 px at 640) in upstream's preprocessing: 640x480 scaled to height
    250, centre-cropped to 304x228, then squeezed to 224x224.

    Raises:
        WeightsError: If it is not a FastDepth checkpoint.
    """
    return Metadata(
        variant=variant_of(state).value,
        input_height=224,
        input_width=224,
        focal_px=518.86 * 250 / 480 * 224 / 304,
        mean=(0.0, 0.0, 0.0),
        std=(1.0, 1.0, 1.0),
        padding=Padding.SYMMETRIC.value,
        output=Output.DEPTH.value,
        uncertainty=False,
        sigma_floor=0.25,
        data=("NYU Depth v2",),
        licence="MIT (dwofk/fast-depth)",
    )


def weights_file(text: str) -> Path:
    """A weights file, or one that comes with the package by its name: the type of an option."""
    return SHIPPED_WEIGHTS.get(text, Path(text))
