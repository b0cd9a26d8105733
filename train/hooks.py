"""Hooks: what happens around the recipe's steps, written by users or by name on the command line."""

import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from torch import Tensor

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.models.trainable import Prediction
from edgeslam_torch.train.state import TrainConfig, TrainState


@dataclass
class Drawn:
    """What one signal drew for this process, between the network and the gradient."""

    signal: str
    """Its name: ``supervised`` (labels), ``teacher`` (measured depth) or ``self`` (pairs)."""
    batch: dict[str, Tensor]
    """What the signal drew, with ``image`` the network's normalised input ``(B, 3, H, W)``; of ``self``, first images
    and then their partners ``(2 B, 3, H, W)``. To be read."""
    predicted: Prediction
    """The network's output for ``image``, with its gradient. To be read."""
    losses: dict[str, Tensor]
    """By name, one value an image ``(B,)``, weighted: change them, add others, remove some. Their sum is minimised,
    averaged over the images of all processes."""


class Hooks:
    """What happens around the recipe's steps; every method does nothing here. Write a subclass with those you need.

    In order: ``on_start``; for every step ``on_losses`` (once a signal) and ``on_step``; at times ``on_validation``;
    ``on_end``; ``close``. Under ``torchrun`` each process calls its own hooks, for its own images: what only reports
    does so where `edgeslam_torch.train.rank` gives 0. A step depends on the seed, its number and the weights alone, so
    that a resume repeats it; a hook that draws random numbers or keeps state has to restore them itself. An
    exception ends training, with the last whole step saved.
    """

    def on_start(self, state: TrainState, config: TrainConfig) -> None:
        """Before the first step of this process (also after a resume, at ``state.step``).

        May change the peak learning rates, ``state.optimiser.param_groups[i]["peak"]``. All else is to be read.
        """

    def on_losses(self, state: TrainState, drawn: Drawn) -> None:
        """Before each gradient, once for every signal; may change ``drawn.losses``.

        Called in every process, and must do the same in each. ``finetune.json`` keeps the names of hooks that
        have this method: a training is not resumed with other ones.
        """

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """After each optimiser step, with the mean losses ``signal/name`` of this process's images.

        ``state.shown`` has some of the images ``(B, 3, H, W)``, as the network sees them. May write ``state.stop``: the
        averaged weights are validated, and training ends.
        """

    def on_validation(self, state: TrainState, metrics: dict[str, float]) -> None:
        """After each validation of the averaged weights, ``state.averaged``; may write ``state.stop``.

        Args:
            state: With ``best``, ``best_step`` and ``stale`` brought up to date.
            metrics: Of `edgeslam_torch.train.DepthScores`, and ``score``, which decides what is best; the same in every
                process.
        """

    def on_end(self, state: TrainState, reason: str) -> None:
        """Once, when the run ends normally; the files are written."""

    def close(self) -> None:
        """Called last in any case: release files and the terminal."""


def changes_losses(hook: Hooks) -> bool:
    """Whether a hook takes part in what is minimised."""
    return type(hook).on_losses is not Hooks.on_losses


def named_hooks(names: Sequence[str]) -> list[Hooks]:
    """The hooks that users name: subclasses of `Hooks`, made without arguments, or instances.

    Modules are looked for in the current folder, too. They are run: name only code that you trust.

    Raises:
        ConfigError: If it does not exist, or is not a hook.
    """
    return [_made(name) for name in names]


def _made(name: str) -> Hooks:
    where, _, what = name.rpartition(":")
    try:
        found = getattr(_loaded(where), what)
        hook = found() if isinstance(found, type) and issubclass(found, Hooks) else found
    except Exception as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
        raise ConfigError(
            f"--hook {name}: {why}; write MODULE:NAME or FILE.py:NAME of an instance, or of a class without arguments"
        ) from error
    if not isinstance(hook, Hooks):
        raise ConfigError(f"--hook {name}: is not an edgeslam_torch.train.Hooks")
    return hook


def _loaded(where: str) -> ModuleType:
    if not where.endswith(".py"):
        if os.getcwd() not in sys.path:
            sys.path.insert(0, os.getcwd())  # as python -m does
        return importlib.import_module(where)
    spec = importlib.util.spec_from_file_location(Path(where).stem, where)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(module.__name__, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
