"""Networks: FastDepth in torch, networks of your own, their checkpoints, ONNX export and quantisation.

The names below load on first use; records and headers need no torch.
"""

if __name__ == "models":
    raise ImportError("import edgeslam_torch.models, not models")

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, restored, save_checkpoint
    from edgeslam_torch.models.fastdepth import FastDepth
    from edgeslam_torch.models.layout import Variant, Widths
    from edgeslam_torch.models.onnx.export import ExportOptions, export_onnx
    from edgeslam_torch.models.record import OTHER_NETWORK, Metadata
    from edgeslam_torch.models.trainable import DepthModule, Prediction

_HOMES = {
    "checkpoint": "build_network load_checkpoint restored save_checkpoint",
    "fastdepth": "FastDepth",
    "layout": "Variant Widths",
    "onnx.export": "ExportOptions export_onnx",
    "record": "OTHER_NETWORK Metadata",
    "trainable": "DepthModule Prediction",
}
_LAZY = {name: f"edgeslam_torch.models.{home}" for home, names in _HOMES.items() for name in names.split()}

__all__ = [
    "OTHER_NETWORK",
    "DepthModule",
    "ExportOptions",
    "FastDepth",
    "Metadata",
    "Prediction",
    "Variant",
    "Widths",
    "build_network",
    "export_onnx",
    "load_checkpoint",
    "restored",
    "save_checkpoint",
]


if not TYPE_CHECKING:  # a type checker takes the imports above

    def __getattr__(name):
        if name in _LAZY:
            globals()[name] = getattr(importlib.import_module(_LAZY[name]), name)
            return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *__all__})
