"""Depth networks that many people use: where they are published, under which licence, and how to feed them.

None is part of this package. Sizes, normalisation and meaning are their publishers'; nothing here was run against the
published files.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch.files.user_cache import cache_folder
from edgeslam_torch.models.download import Remote

IMAGENET = {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}
HUGGING_FACE = "https://huggingface.co/onnx-community"
DEPTH_ANYTHING = "https://github.com/fabio-sim/Depth-Anything-ONNX/releases/download/v2.0.0"


@dataclass(frozen=True, slots=True)
class Preset:
    """A published network."""

    remote: Remote
    description: dict[str, Any]
    """Values of `external.ExternalNetwork`."""


PRESETS = {
    preset.remote.name: preset
    for preset in (
        Preset(
            Remote(
                "depth-anything-v2-small",
                (f"{HUGGING_FACE}/depth-anything-v2-small/resolve/main/onnx/model.onnx",),
                "Apache-2.0 (DepthAnything/Depth-Anything-V2; only the small network is)",
                "relative depth, 24.8 M parameters",
            ),
            {"gives": "relative_inverse", **IMAGENET, "input_height": 518, "input_width": 518, "multiple": 14},
        ),
        Preset(
            Remote(
                "depth-anything-v2-small-indoor",
                (f"{DEPTH_ANYTHING}/depth_anything_v2_vits_indoor_dynamic.onnx",),
                "Apache-2.0 (DepthAnything/Depth-Anything-V2, trained on Hypersim: see its terms)",
                "metres up to 20, 24.8 M parameters",
            ),
            {"gives": "metres", **IMAGENET, "input_height": 518, "input_width": 518, "multiple": 14},
        ),
        Preset(
            Remote(
                "midas-small",
                ("https://github.com/isl-org/MiDaS/releases/download/v2_1/model-small.onnx",),
                "MIT (isl-org/MiDaS)",
                "relative depth, 256x256, 21 M parameters",
            ),
            # As the publisher's run_onnx.py feeds its files: they normalise by themselves.
            {"gives": "relative_inverse", "input_height": 256, "input_width": 256, "multiple": 32},
        ),
        Preset(
            Remote(
                "metric3d-v2-small",
                (f"{HUGGING_FACE}/metric3d-vit-small/resolve/main/onnx/model.onnx",),
                "BSD-2-Clause (YvanYin/Metric3D); its ONNX file is published under CC0-1.0",
                "metres for any camera, 37 M parameters",
            ),
            # Takes 0 to 255 and normalises by itself; metres for its canonical camera of 1000 px.
            {
                "gives": "metres",
                "std": (1 / 255, 1 / 255, 1 / 255),
                "input_height": 616,
                "input_width": 1064,
                "multiple": 28,
                "focal_px": 1000.0,
                "depth": "predicted_depth",
            },
        ),
    )
}
"""By the name that ``--depth`` takes."""


def preset_file(name: str) -> Path:
    """Where a preset's ONNX file is kept once it was downloaded."""
    return cache_folder() / f"{name}.onnx"
