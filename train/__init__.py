"""Depth training: data, recipe and hooks; docs/guides/your-own-loop.md says how to use them.

The names below load on first use.
"""

if __name__ == "train":
    raise ImportError("import edgeslam_torch.train, not train")

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgeslam_torch.train.callbacks import ProgressBar, TensorBoard
    from edgeslam_torch.train.finetuning import Data, FromRuns, finetune
    from edgeslam_torch.train.folder import Existing, OutFolder, out_folder
    from edgeslam_torch.train.hook_names import named_hooks
    from edgeslam_torch.train.processes.distributed import process_group, rank, world
    from edgeslam_torch.train.recipe import (
        DivergedError,
        Drawn,
        Hooks,
        NonFiniteLossError,
        TrainConfig,
        TrainState,
        Validation,
        train,
    )
    from edgeslam_torch.train.result import TrainingResult
    from edgeslam_torch.train.self_supervised import SelfSupervised, SelfSupervisedWeights
    from edgeslam_torch.train.signals import Signal, Slot, Source, Supervised, SupervisedWeights
    from edgeslam_torch.train.validate import DepthScores, image_tensor, predict_metres, score
    from edgeslam_torch.train.views.augment import AugmentConfig, View, fitted_view, random_view
    from edgeslam_torch.train.views.datasets import DepthFolder, load_depth_folder
    from edgeslam_torch.train.views.edge_pixels import edge_pixels
    from edgeslam_torch.train.views.junctions import junction_points, seen_cosines
    from edgeslam_torch.train.views.posed import PosedSequence, PosedView, load_run, relative_motion
    from edgeslam_torch.train.views.shards import load_shards, write_shards
    from edgeslam_torch.train.views.straight import straight_edges

_HOMES = {
    "finetuning": "Data FromRuns finetune",
    "hook_names": "named_hooks",
    "folder": "Existing OutFolder out_folder",
    "result": "TrainingResult",
    "processes.distributed": "process_group rank world",
    "recipe": "DivergedError Drawn Hooks NonFiniteLossError TrainConfig TrainState Validation train",
    "self_supervised": "SelfSupervised SelfSupervisedWeights",
    "signals": "Signal Slot Source Supervised SupervisedWeights",
    "validate": "DepthScores image_tensor predict_metres score",
    "views.augment": "AugmentConfig View fitted_view random_view",
    "views.datasets": "DepthFolder load_depth_folder",
    "views.edge_pixels": "edge_pixels",
    "views.junctions": "junction_points seen_cosines",
    "views.posed": "PosedSequence PosedView load_run relative_motion",
    "views.shards": "load_shards write_shards",
    "views.straight": "straight_edges",
    "callbacks": "ProgressBar TensorBoard",
}
_LAZY = {name: f"edgeslam_torch.train.{home}" for home, names in _HOMES.items() for name in names.split()}

__all__ = [
    "AugmentConfig",
    "Data",
    "DepthFolder",
    "DepthScores",
    "DivergedError",
    "Drawn",
    "Existing",
    "FromRuns",
    "Hooks",
    "NonFiniteLossError",
    "OutFolder",
    "TrainingResult",
    "PosedSequence",
    "PosedView",
    "ProgressBar",
    "SelfSupervised",
    "SelfSupervisedWeights",
    "Signal",
    "Slot",
    "Source",
    "Supervised",
    "SupervisedWeights",
    "TensorBoard",
    "TrainConfig",
    "TrainState",
    "Validation",
    "View",
    "edge_pixels",
    "finetune",
    "fitted_view",
    "image_tensor",
    "junction_points",
    "load_depth_folder",
    "load_run",
    "load_shards",
    "named_hooks",
    "out_folder",
    "predict_metres",
    "process_group",
    "random_view",
    "rank",
    "relative_motion",
    "score",
    "seen_cosines",
    "straight_edges",
    "train",
    "world",
    "write_shards",
]


if not TYPE_CHECKING:  # a type checker takes the imports above

    def __getattr__(name):
        if name in _LAZY:
            globals()[name] = getattr(importlib.import_module(_LAZY[name]), name)
            return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *__all__})
