"""Export of depth networks to a checked ONNX graph."""

import json
import logging
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import onnx
import torch

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.models.layout import INPUT_MULTIPLE
from edgeslam_torch.models.onnx.file import INPUT, LOG_DEPTH, SIGMA
from edgeslam_torch.models.onnx.fold import deployed
from edgeslam_torch.models.record import HEADER_KEY, MAX_INPUT_PX, Metadata
from edgeslam_torch.models.trainable import DepthModule

MAX_BATCH = 1024
OLDEST_OPSET = 14
"""Oldest opset that ONNX's version converter reaches for this network."""
OLD_RUNTIME_IR, OLD_RUNTIME_OPSET = 9, 17
"""onnxruntime <= 1.16 (older boards) reads IR <= 9; opset 17 is supported by it."""


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Export options."""

    height: int = 192
    width: int = 256
    opset: int = 18
    dynamic_size: bool = False
    """Leave height and width open (multiples of 32); runtimes optimise a fixed size better."""
    dynamic_batch: bool = False
    """Leave the number of images open."""


def export_onnx(network: DepthModule, metadata: Metadata, path: Path, options: ExportOptions) -> None:
    """Write ``path`` (inputs ``image`` ``(1, 3, H, W)``; outputs ``log_depth`` and ``sigma_log`` ``(1, 1,
    H/2, W/2)``, or as many as the batch has).

    Depth in metres is ``exp(log_depth) * focal / focal_px``, focal being the camera's in pixels of the
    network's input.

    Raises:
        OutputError: If the written file has another opset or fails the checker.
    """
    module = deployed(network, metadata)
    # An example of one image would be taken for a batch that can only be one.
    example = torch.zeros(2 if options.dynamic_batch else 1, 3, options.height, options.width)
    # They warn about torchvision operators, which are not used, and about the choice of version converter.
    for name in ("torch.onnx", "onnxscript"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            (example,),
            dynamo=True,
            opset_version=max(options.opset, 18),
            input_names=[INPUT],
            output_names=[LOG_DEPTH, SIGMA],
            dynamic_shapes=_open_dimensions(options),
            optimize=True,
            verbose=False,
        )
    if program is None:
        raise OutputError(f"{path}: the exporter returned nothing")
    model = set_opset(program.model_proto, options.opset)
    write_metadata(model, metadata, options)
    check_model(model, options.opset)
    write_atomically(path, lambda file: file.write(model.SerializeToString()))


def _open_dimensions(options: ExportOptions) -> "tuple[dict[int, Any]] | None":
    """What the exporter leaves open of the image's dimensions; None for nothing."""
    dimensions: dict[int, Any] = {}
    if options.dynamic_batch:
        dimensions[0] = torch.export.Dim("batch", min=1, max=MAX_BATCH)
    if options.dynamic_size:
        longest = MAX_INPUT_PX // INPUT_MULTIPLE
        for axis, name in ((2, "h32"), (3, "w32")):
            dimensions[axis] = INPUT_MULTIPLE * torch.export.Dim(name, min=1, max=longest)
    return (dimensions,) if dimensions else None


def set_opset(model: onnx.ModelProto, opset: int) -> onnx.ModelProto:
    """The exporter writes opset 18 or later; older ones come from ONNX's own version converter."""
    if opset != model.opset_import[0].version:
        try:
            model = onnx.version_converter.convert_version(model, opset)
        except RuntimeError as error:
            raise OutputError(f"onnx cannot convert to opset {opset} ({' '.join(str(error).split())[-120:]})") from None
    if opset <= OLD_RUNTIME_OPSET:
        model.ir_version = OLD_RUNTIME_IR
    return model


def write_metadata(model: onnx.ModelProto, metadata: Metadata, options: ExportOptions) -> None:
    """Store the checkpoint's metadata, with this file's input size, in the model's properties."""
    size = {} if options.dynamic_size else {"export_height": options.height, "export_width": options.width}
    record = asdict(metadata) | size
    onnx.helper.set_model_props(model, {HEADER_KEY: json.dumps(record)})


def check_model(model: onnx.ModelProto, opset: int) -> None:
    """Run ONNX's checker and verify the opset."""
    written = {o.domain: o.version for o in model.opset_import}.get("", 0)
    if written != opset:
        raise OutputError(f"requested opset {opset}, but the exporter wrote {written}")
    try:
        onnx.checker.check_model(model, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise OutputError(f"exported model fails ONNX's checker: {' '.join(str(error).split())[:200]}") from error
