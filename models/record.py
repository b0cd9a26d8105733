"""What a weights file says about itself; importing this needs no torch."""

import dataclasses
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import WeightsError

HEADER_KEY = "edgeslam"
DEFAULT_WEIGHTS = Path(__file__).parent / "weights" / "default.safetensors"


@dataclass(frozen=True, slots=True)
class Metadata:
    """Everything needed to run the weights correctly, and what they are worth."""

    variant: str = "mobilenet-nnconv5dw-skipadd"
    input_height: int = 192
    input_width: int = 256
    """Size of the training images [px]."""
    focal_px: float = 210.0
    """Focal length at ``input_width`` for which the network's metres hold; other cameras are corrected by
    the ratio."""
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
    """Data sets it was trained on."""
    licence: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    notes: str = ""


def metadata_from_json(text: str) -> Metadata:
    """Parse the header's record; unknown keys are ignored so that newer files still load."""
    record: dict[str, Any] = json.loads(text)
    known = {f.name for f in dataclasses.fields(Metadata)}
    kept: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in record.items() if k in known}
    return Metadata(**kept)


def read_header(path: Path) -> Metadata:
    """The record in a safetensors file's header, without reading the weights.

    Raises:
        WeightsError: If the file is missing, no safetensors file, or holds no record.
    """
    try:
        with Path(path).open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(length)) if length < 100_000_000 else {}
        return metadata_from_json(header["__metadata__"][HEADER_KEY])
    except OSError as error:
        raise WeightsError(f"{path}: cannot read the weights ({error.strerror})") from error
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"{path}: not an EdgeSLAM weights file ({type(error).__name__})") from error
