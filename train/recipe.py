"""The training recipe; `Hooks` are its extension points.

A step is a function of (seed, step): no random state persists, so a killed run resumes exactly from its last
checkpoint, and a batch split over processes is the same batch.
"""

import copy
import io
import json
import logging
import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from edgeslam_torch.errors import ConfigError, EdgeSlamError, WeightsError
from edgeslam_torch.files.atomic import write_atomically, write_text
from edgeslam_torch.models.checkpoint import save_checkpoint
from edgeslam_torch.models.device import DEVICES
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule, Prediction
from edgeslam_torch.train.processes.device import Arithmetic, arithmetic
from edgeslam_torch.train.processes.distributed import add_up, by_first, everyones, rank, world
from edgeslam_torch.train.processes.loading import drawn
from edgeslam_torch.train.processes.shared_norm import share_norms
from edgeslam_torch.train.signals import Signal, Slot

logger = logging.getLogger(__name__)

LAST, BEST, FINAL, CURVE = "last.pt", "best.safetensors", "final.safetensors", "curve.jsonl"
"""Files of `train`: its whole state, the best validated and the last averaged weights, the validations."""
MAX_BATCH = 1024
"""Images: tens of gigabytes."""
MAX_WORKERS = 256
NO_ROOM_M = (0.02, 90.0)
"""Plausible median depth; a network mostly outside of it has diverged."""


class DivergedError(EdgeSlamError):
    """Training has diverged; the message says what is kept."""


class NonFiniteLossError(DivergedError):
    """A loss was NaN or infinite; the message names the batch."""


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
    amp: bool | None = False
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
        for name in ("steps", "batch", "validate_every", "checkpoint_every", "accumulate"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.batch > MAX_BATCH:
            raise ValueError(f"batch must be at most {MAX_BATCH}, got {self.batch}")
        for name in ("lr", "encoder_lr"):
            # Adam moves every weight by about this per step, and weights are about 0.05.
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be above 0 and at most 1, got {getattr(self, name)}")
        for name in ("seed", "patience", "warmup_steps", "frozen_stages", "workers"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.workers > MAX_WORKERS:
            raise ValueError(f"workers must be at most {MAX_WORKERS}, got {self.workers}")
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
    arithmetic: Arithmetic = field(default_factory=lambda: arithmetic("cpu", amp=False))
    scaler: torch.amp.GradScaler = field(default_factory=lambda: torch.amp.GradScaler("cpu", enabled=False))
    """Of float16 alone."""


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
    that a resume repeats it; a hook that draws random numbers or remembers steps has to see to that itself. An
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


Validation = Callable[[DepthModule], dict[str, float]]
"""Metrics of a network; the key ``score`` (smaller is better) decides which weights are best."""


def train(
    network: DepthModule,
    metadata: Metadata,
    signals: Sequence[Signal],
    config: TrainConfig,
    out: Path,
    validate: Validation | None = None,
    hooks: Sequence[Hooks] = (),
    before: dict[str, float] | None = None,
) -> TrainState:
    """Train until ``config.steps``, early stopping or an error; resumes when ``out/last.pt`` exists.

    Writes ``out/last.pt`` (everything), ``out/best.safetensors`` and ``out/final.safetensors`` (averaged weights) and
    ``out/curve.jsonl``. ``last.pt`` always holds a working network: a state is validated before it replaces the
    previous one. On an interrupt or a failing hook, the last completed step is saved.

    Args:
        network: Changed in place.
        metadata: Of the trained weights.
        signals: What to learn from.
        config: Of the recipe.
        out: Folder, made when missing.
        validate: Metrics of a network; called in process 0 only.
        hooks: Called in order.
        before: Metrics of ``network`` as given. When there are any, only better weights become the best.

    Raises:
        NonFiniteLossError: If a loss is not finite; names the images of the batch.
        DivergedError: If the network's depth has become absurd.
        ConfigError: If ``out`` holds more steps than asked for, there are more processes than images in a batch, or no
            such device.
        WorkerError: If a process that draws batches is gone.
        WeightsError: If ``out/last.pt`` is damaged or of another network.
        OSError: If the file cannot be written.
    """
    least = world() * config.accumulate
    if least > config.batch:
        parts = f" that learn in {config.accumulate} parts" if config.accumulate > 1 else ""
        raise ConfigError(f"{world()} processes{parts} for a batch of {config.batch}: every one needs an image")
    out.mkdir(parents=True, exist_ok=True)
    numbers = arithmetic(config.device, config.amp)
    network = network.to(numbers.device)
    if config.channels_last:
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = copy.deepcopy(network).eval()
    if world() > 1 and not config.freeze_norm:
        share_norms(network)
    optimiser = build_optimiser(network, config)
    state = TrainState(network, averaged, optimiser, arithmetic=numbers, scaler=numbers.scaler())
    if not resume(state, out / LAST) and before is not None:
        state.best, state.history = before["score"], [{"step": 0.0, **before}]
    if state.step > config.steps:
        raise ConfigError(f"{out / LAST}: has {state.step} steps behind it, so it cannot end after {config.steps}")
    with ExitStack() as closing:
        for hook in hooks:
            closing.callback(hook.close)
        try:
            for hook in hooks:
                hook.on_start(state, config)
            reason = _loop(state, signals, config, metadata, out, validate, hooks)
        except DivergedError as error:
            raise type(error)(f"{error}; {_kept(out)}") from None
        except BaseException:
            _rescue(state, out)
            raise
        by_first(lambda: _finish(state, metadata, out))
        for hook in hooks:
            hook.on_end(state, reason)
    return state


def _loop(
    state: TrainState,
    signals: Sequence[Signal],
    config: TrainConfig,
    metadata: Metadata,
    out: Path,
    validate: Validation | None,
    hooks: Sequence[Hooks],
) -> str:
    """Run all steps; returns the reason for stopping."""
    parts = _Parts(signals, config, rank(), world())
    with drawn(parts, state.step, config.steps, config.workers) as batches:
        return _steps(state, signals, config, metadata, out, validate, hooks, batches)


def _steps(
    state: TrainState,
    signals: Sequence[Signal],
    config: TrainConfig,
    metadata: Metadata,
    out: Path,
    validate: Validation | None,
    hooks: Sequence[Hooks],
    batches: Iterator[list["_Part"]],
) -> str:
    while True:
        _agree_to_stop(state)
        if validate is not None and _validation_is_due(state, config):
            metrics = by_first(lambda: validate(state.averaged))
            _note(state, metrics, metadata, out)
            for hook in hooks:
                hook.on_validation(state, metrics)
            _agree_to_stop(state)
        if config.patience and state.stale >= config.patience:
            return f"no improvement in {config.patience} validations"
        if state.step >= config.steps:
            return "all steps done"
        if state.stop:
            return state.stop
        losses = _step(state, signals, config, hooks, next(batches))
        for hook in hooks:
            hook.on_step(state, losses)
        if state.step % config.checkpoint_every == 0 or state.step == config.steps:
            by_first(lambda: _save_good(state, out))


def _validation_is_due(state: TrainState, config: TrainConfig) -> bool:
    """Also after a resume between a step and its validation; at most once per step."""
    noted = state.history[-1]["step"] if state.history else 0.0
    last = state.step == config.steps or bool(state.stop)
    return state.step > noted and (state.step % config.validate_every == 0 or last)


def _agree_to_stop(state: TrainState) -> None:
    """Broadcast of one process's stop request: all must end after the same step."""
    state.stop = next(iter(everyones([state.stop] if state.stop else [])), "")


def _finish(state: TrainState, metadata: Metadata, out: Path) -> None:
    save_state(state, out / LAST)
    save_checkpoint(state.averaged, metadata, out / FINAL, half=True)


def _save_good(state: TrainState, out: Path) -> None:
    if _has_diverged(state):
        low, high = NO_ROOM_M
        raise DivergedError(
            f"step {state.step}: training has diverged, most of the depth is nearer than {low:g} m, farther than "
            f"{high:g} m or no number"
        )
    save_state(state, out / LAST)


def _has_diverged(state: TrainState) -> bool:
    """Whether the network or its average gives absurd depths for images of the last batch."""
    if state.shown is None:
        return False
    low, high = (math.log(x) for x in NO_ROOM_M)
    return any(_share_between(network, state.shown, low, high) < 0.5 for network in (state.network, state.averaged))


def _share_between(network: DepthModule, images: Tensor, low: float, high: float) -> float:
    was_training = network.training
    network.eval()
    with torch.no_grad():
        log_depth = network.predict_half(images).log_depth
    network.train(was_training)
    return float(((log_depth > low) & (log_depth < high)).float().mean())


def _rescue(state: TrainState, out: Path) -> None:
    """Save the last completed step during an interrupt or failure, without masking it."""
    if rank() != 0 or not state.whole or state.shown is None:
        return
    for name, buffer in state.network.named_buffers():
        if name in state.statistics:
            buffer.copy_(state.statistics[name])
    try:
        _save_good(state, out)
    except (DivergedError, OSError) as error:
        logger.info("step %d is not saved: %s", state.step, error)


def _kept(out: Path) -> str:
    """Message about what a failed run keeps and what to do."""
    if not saved_step(out / LAST):
        return "nothing was saved before; try a smaller learning rate"
    return f"{out / LAST} holds step {saved_step(out / LAST)}, the last good one; try a smaller learning rate"


def build_optimiser(network: DepthModule, config: TrainConfig) -> torch.optim.Optimizer:
    """AdamW with a smaller rate for the encoder; frozen stages get no gradient."""
    encoder = network.encoder()
    for stage in encoder[: config.frozen_stages]:
        stage.requires_grad_(False)
    in_encoder = {id(p) for stage in encoder for p in stage.parameters()}
    parts = {True: [], False: []}  # type: dict[bool, list[nn.Parameter]]
    for p in network.parameters():
        if p.requires_grad:
            parts[id(p) in in_encoder].append(p)
    groups = [
        {"params": parts[True], "lr": config.encoder_lr, "peak": config.encoder_lr},
        {"params": parts[False], "lr": config.lr, "peak": config.lr},
    ]
    return torch.optim.AdamW([g for g in groups if g["params"]], weight_decay=config.weight_decay)


def learning_rate_factor(step: int, config: TrainConfig) -> float:
    """Linear warm-up, then half a cosine down to ``lr_end``."""
    if step < config.warmup_steps:
        return (step + 1) / config.warmup_steps
    progress = (step - config.warmup_steps) / max(config.steps - config.warmup_steps, 1)
    return config.lr_end + (1 - config.lr_end) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


@dataclass(frozen=True, slots=True)
class _Part:
    """Images that one forward pass sees, for one of the signals."""

    signal: int
    slots: list[Slot]
    batch: dict[str, Tensor]


@dataclass(frozen=True, slots=True)
class _Parts:
    """What this process learns from in a step; a function of the step's number, so that any process may draw it."""

    signals: Sequence[Signal]
    config: TrainConfig
    this: int
    of: int

    def __call__(self, step: int) -> list[_Part]:
        mine = range(self.this, self.config.batch, self.of)
        parts = self.config.accumulate
        found = []
        for k in range(parts):
            for number, signal in enumerate(self.signals):
                slots = [Slot(self.config.seed + 7919 * number, step, i) for i in mine[k::parts]]
                found.append(_Part(number, slots, signal.draw(slots)))
        return found


def _step(
    state: TrainState,
    signals: Sequence[Signal],
    config: TrainConfig,
    hooks: Sequence[Hooks],
    parts: Sequence[_Part],
) -> dict[str, float]:
    network = state.network
    _set_modes(network, config)
    if not config.freeze_norm:
        state.statistics = {name: buffer.clone() for name, buffer in network.named_buffers()}
    factor = learning_rate_factor(state.step, config)
    for group in state.optimiser.param_groups:
        group["lr"] = group["peak"] * factor
    state.optimiser.zero_grad(set_to_none=True)
    totals: dict[str, float] = {}
    bad: list[str] = []
    for start in range(0, len(parts), len(signals)):  # the parts of one image share a gradient
        named: dict[str, Tensor] = {}
        for part in parts[start : start + len(signals)]:
            named |= _losses(state, signals[part.signal], part, config, hooks, bad)
        state.scaler.scale(torch.stack(list(named.values())).sum()).backward()
        for name, value in named.items():
            totals[name] = totals.get(name, 0.0) + float(value.detach())
    add_up([p.grad for p in network.parameters() if p.grad is not None])
    if failures := everyones(bad):
        raise NonFiniteLossError(f"step {state.step}: {failures[0]}")
    state.scaler.unscale_(state.optimiser)
    norm = nn.utils.clip_grad_norm_([p for p in network.parameters() if p.grad is not None], config.clip_norm)
    # The scaler leaves out a step whose float16 gradients overflow, and scales less from then on.
    if not state.arithmetic.scales and not torch.isfinite(norm):
        raise NonFiniteLossError(f"step {state.step}: the gradient is not finite")
    state.whole = False
    state.scaler.step(state.optimiser)
    state.scaler.update()
    _average(state, config.ema_decay)
    state.step += 1
    state.statistics = {}
    state.whole = True
    return totals


def _losses(
    state: TrainState, signal: Signal, part: _Part, config: TrainConfig, hooks: Sequence[Hooks], bad: list[str]
) -> dict[str, Tensor]:
    """Losses of one part by name, ``()`` each: sums over its images, divided by the whole batch, so that parts and
    processes add up to the mean. What is not finite is said in ``bad``."""
    batch = state.arithmetic.moved(part.batch)
    if config.channels_last:
        batch["image"] = batch["image"].contiguous(memory_format=torch.channels_last)
    state.shown = batch["image"][:2]
    with state.arithmetic.autocast():
        predicted = state.network.predict(batch["image"])
        losses = signal.losses(predicted, batch)
    losses = _hooked(hooks, state, Drawn(signal.name, batch, predicted, losses), len(part.slots))
    named = {}
    for name, value in losses.items():
        if not torch.isfinite(value).all():
            images = [d for d, v in zip(signal.describe(part.slots), value, strict=True) if not torch.isfinite(v)]
            bad.append(f"loss {signal.name}/{name} is not finite for {', '.join(images)}")
        named[f"{signal.name}/{name}"] = value.float().sum() / config.batch
    return named


def _hooked(hooks: Sequence[Hooks], state: TrainState, drawn: Drawn, images: int) -> dict[str, Tensor]:
    """The losses after every hook had its say.

    Raises:
        ConfigError: If a hook made something else of them than one value an image; names it.
    """
    for hook in hooks:
        hook.on_losses(state, drawn)
        for name, value in drawn.losses.items():
            if not isinstance(value, Tensor) or value.shape != (images,):
                found = f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
                who = f"hook {type(hook).__name__}"
                raise ConfigError(f"{who}: loss {name!r} must be one value an image, ({images},), and is {found}")
    return drawn.losses


def _set_modes(network: DepthModule, config: TrainConfig) -> None:
    network.train()
    fixed: list[nn.Module] = [*network.encoder(), *network.heads()]
    for part in [network] if config.freeze_norm else fixed:
        for module in part.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def _average(state: TrainState, decay: float) -> None:
    # Short averaging window at first, so that initial weights fade quickly.
    decay = min(decay, (1 + state.step) / (10 + state.step))
    with torch.no_grad():
        for kept, new in zip(state.averaged.state_dict().values(), state.network.state_dict().values(), strict=True):
            if kept.is_floating_point():
                kept.lerp_(new, 1 - decay)
            else:
                kept.copy_(new)


def _note(state: TrainState, metrics: dict[str, float], metadata: Metadata, out: Path) -> None:
    """Write the file first: after an interrupt in between, the step is validated again."""
    if metrics["score"] < state.best:
        if rank() == 0:
            save_checkpoint(state.averaged, metadata, out / BEST, half=True)
        state.best, state.best_step, state.stale = metrics["score"], state.step, 0
    else:
        state.stale += 1
    state.history.append({"step": float(state.step), **metrics})
    if rank() == 0:
        write_text(out / CURVE, "".join(json.dumps(row) + "\n" for row in state.history))


def save_state(state: TrainState, path: Path) -> None:
    """Write all of a run's state, atomically: a kill during writing leaves the previous file.

    Raises:
        OSError: If the file cannot be written.
    """
    content = {
        "network": state.network.state_dict(),
        "averaged": state.averaged.state_dict(),
        "optimiser": state.optimiser.state_dict(),
        "scaler": state.scaler.state_dict(),
        "step": state.step,
        "best": state.best,
        "best_step": state.best_step,
        "stale": state.stale,
        "history": state.history,
    }
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
        state.step, state.best, state.stale = content["step"], content["best"], content["stale"]
        state.best_step, state.history = content["best_step"], content["history"]
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
        raise WeightsError(f"{path}: damaged or of another network, training cannot go on from it ({why})") from error
