"""Depth training: data, recipes and hooks; see docs/guides/your-own-loop.md.

The names below load on first use; type checkers see them in ``__init__.pyi``.
"""

if __name__ == "train":
    raise ImportError("import edgeslam_torch.train, not train")

import importlib

_HOMES = {
    "recipes.finetune": "Data FromRuns finetune",
    "hooks": "Drawn Hooks named_hooks",
    "state": "TrainConfig TrainState",
    "folder": "Existing OutFolder TrainingResult out_folder",
    "processes.distributed": "process_group rank world",
    "loop": "DivergedError NonFiniteLossError Validation train",
    "self_supervised": "SelfSupervised SelfSupervisedWeights",
    "signals": "Signal Slot Source Supervised SupervisedWeights",
    "validate": "DepthScores image_tensor predict_metres score",
    "views.augment": "AugmentConfig View fitted_view random_view",
    "views.datasets": "DepthFolder load_depth_folder",
    "views.edges": "edge_pixels junction_points seen_cosines straight_edges",
    "views.posed": "PosedSequence PosedView load_run relative_motion",
    "views.shards": "load_shards write_shards",
    "callbacks": "ProgressBar TensorBoard",
}
_LAZY = {name: f"edgeslam_torch.train.{home}" for home, names in _HOMES.items() for name in names.split()}
__all__ = sorted(_LAZY)  # noqa: PLE0605 - the stub has the names


def __getattr__(name: str) -> object:
    if name in _LAZY:
        globals()[name] = getattr(importlib.import_module(_LAZY[name]), name)
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
