"""Settings and state of a training, and the file that a killed one resumes from."""

import io
import math
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.models.device import DEVICES
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.processes.device import Arithmetic

MAX_BATCH = 1024
"""Images: tens of gigabytes."""
MAX_WORKERS = 256
COUNTED = ("step", "best", "best_step", "stale", "history")
"""Fields of a state that a file keeps as they are."""


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Settings of the recipe."""

    steps: int = 2000
    batch: int = 8
    """Images per step over all processes."""
    seed: int = 0
    lr: float = 1e-3
    """Peak learning rate of the decoder."""
    encoder_lr: float = 1e-4
    """Learning rate of the encoder; small because its weights, with batch norm folded in, are about 0.05, and Adam
    moves each by this per step."""
    frozen_stages: int = 4
    """conv0 ... conv(n-1) are not trained; 14 freezes the encoder."""
    freeze_norm: bool = False
    """Keep all batch-norm statistics (right for fine-tuning on little data); the encoder's are always
    kept. Those that learn see the images of all processes at once."""
    weight_decay: float = 1e-2
    warmup_steps: int = 100
    lr_end: float = 0.01
    """Final share of the peak rate; 1 keeps it constant."""
    clip_norm: float = 1.0
    ema_decay: float = 0.998
    """Decay of the averaged weights that are validated and saved."""
    validate_every: int = 250
    checkpoint_every: int = 250
    patience: int = 0
    """Validations without improvement before stopping; 0 never stops early."""
    amp: bool | None = None
    """Autocast: bfloat16, on GPUs without it float16 with scaled gradients; None: on CUDA alone."""
    channels_last: bool = True
    device: str = "cpu"
    """``auto``, ``cpu``, ``cuda`` or ``mps``."""
    workers: int = 0
    """Processes that draw batches ahead; 0 draws between the steps."""
    accumulate: int = 1
    """Parts that a process learns its images of a step in, one after another, which takes less memory. The step is the
    same, unless norms learn: each part has its own statistics."""

    def __post_init__(self) -> None:
        # Adam moves every weight by about its rate per step, and weights are about 0.05.
        for name in ("lr", "encoder_lr"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be above 0 and at most 1, got {getattr(self, name)}")
        for least, names in enumerate(
            (
                "seed patience warmup_steps frozen_stages workers",
                "steps batch validate_every checkpoint_every accumulate",
            )
        ):
            for name in names.split():
                if getattr(self, name) < least:
                    raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name, most in {"batch": MAX_BATCH, "workers": MAX_WORKERS}.items():
            if getattr(self, name) > most:
                raise ValueError(f"{name} must be at most {most}, got {getattr(self, name)}")
        if self.accumulate > self.batch:
            raise ValueError(f"accumulate must be at most the batch, {self.batch}, got {self.accumulate}")
        if self.device not in DEVICES:
            raise ValueError(f"device must be one of {', '.join(DEVICES)}, got {self.device}")


@dataclass
class TrainState:
    """Everything that changes during a run; a checkpoint holds what a resume needs."""

    network: DepthModule
    averaged: DepthModule
    optimiser: torch.optim.Optimizer
    arithmetic: Arithmetic
    scaler: torch.amp.GradScaler
    """Of float16 alone, whose gradients vanish below 6e-8."""
    step: int = 0
    best: float = math.inf
    best_step: int = 0
    """After which the best weights were validated; 0: none was better than the weights training began with."""
    stale: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    shown: Tensor | None = None
    """Some images of the last batch ``(B, 3, H, W)``."""
    whole: bool = True
    """False while a step changes the weights."""
    statistics: dict[str, Tensor] = field(default_factory=dict)
    """Buffers of norms that learn, as they were before the step that is under way: its forward pass changes them."""
    stop: str = ""
    """Why training is to end after this step; a hook may write it. Not empty in one process, it ends all."""


def save_state(state: TrainState, path: Path) -> None:
    """Write all of a run's state, atomically: a kill during writing leaves the previous file."""
    parts = ("network", "averaged", "optimiser", "scaler")
    content = {name: getattr(state, name).state_dict() for name in parts}
    content |= {name: getattr(state, name) for name in COUNTED}
    # Serialised in memory first: torch masks disk errors.
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_atomically(path, lambda file: file.write(buffer.getbuffer()))


def resume(state: TrainState, path: Path) -> bool:
    """Load a run's state if there is one; learning rates stay those that ``state`` was made with.

    Raises:
        WeightsError: If the file is damaged or of another network.
    """
    if not path.is_file():
        return False
    peaks = [group["peak"] for group in state.optimiser.param_groups]
    with _damage_is_named(path):
        content = torch.load(path, map_location="cpu", weights_only=True)
        state.network.load_state_dict(content["network"])
        state.averaged.load_state_dict(content["averaged"])
        state.optimiser.load_state_dict(content["optimiser"])
        if state.scaler.is_enabled() and content.get("scaler"):
            state.scaler.load_state_dict(content["scaler"])
        for name in COUNTED:
            setattr(state, name, content[name])
    for group, peak in zip(state.optimiser.param_groups, peaks, strict=True):
        group["peak"] = peak
    return True


def saved_step(path: Path) -> int:
    """Steps behind a saved state, 0 when there is none.

    Raises:
        WeightsError: If the file is damaged.
    """
    if not path.is_file():
        return 0
    with _damage_is_named(path):
        return int(torch.load(path, map_location="cpu", weights_only=True, mmap=True)["step"])


@contextmanager
def _damage_is_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, EOFError, ValueError, KeyError, TypeError, pickle.UnpicklingError) as error:
        why = " ".join(str(error).split())[:160]
        raise WeightsError(f"{path}: damaged or of another network, training cannot resume from it ({why})") from error
