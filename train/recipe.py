"""The training recipe, read from top to bottom; `Hooks` is where others join in.

A step is a function of (seed, step): nothing random is carried from one to the next, so a run killed
anywhere goes on
from its last checkpoint exactly as if it had never stopped, and a batch split over processes is the same
batch.
"""

import copy
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.models.checkpoint import save_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.distributed import rank, world
from edgeslam_torch.train.signals import Signal, Slot


class NonFiniteLossError(EdgeSlamError):
    """A loss was NaN or infinite; the message names the batch."""


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """What the recipe needs to know."""

    steps: int = 2000
    batch: int = 8
    """Images per step over all processes."""
    seed: int = 0
    lr: float = 1e-3
    """Peak learning rate of the decoder."""
    encoder_lr: float = 1e-4
    """Small: with batch norm folded in, pretrained weights are about 0.05, and Adam moves each by this per step."""
    frozen_stages: int = 4
    """conv0 ... conv(n-1) are not trained; 14 freezes the encoder."""
    freeze_norm: bool = False
    """Keep all batch-norm statistics (right for fine-tuning on little data); the encoder's are always
    kept."""
    weight_decay: float = 1e-2
    warmup_steps: int = 100
    lr_end: float = 0.01
    """Part of the peak rate left at the last step; 1 keeps it constant."""
    clip_norm: float = 1.0
    ema_decay: float = 0.998
    """Of the averaged weights that are validated and saved."""
    validate_every: int = 250
    checkpoint_every: int = 250
    patience: int = 0
    """Validations without improvement before stopping; 0 never stops early."""
    amp: bool = False
    """bfloat16 autocast."""
    channels_last: bool = True


@dataclass
class TrainState:
    """Everything that changes during a run; a checkpoint holds all of it."""

    network: FastDepth
    averaged: FastDepth
    optimiser: torch.optim.Optimizer
    step: int = 0
    best: float = math.inf
    stale: int = 0
    history: list[dict[str, float]] = field(default_factory=list)


class Hooks:
    """Called by the recipe; every method does nothing here."""

    def on_start(self, state: TrainState, config: TrainConfig) -> None:
        """Before the first step of this process (also after a resume)."""

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """After each optimiser step, with the mean losses of this process's images."""

    def on_validation(self, state: TrainState, metrics: dict[str, float]) -> None:
        """After each validation of the averaged weights."""

    def on_end(self, state: TrainState, reason: str) -> None:
        """Once, however the run ends normally."""


Validation = Callable[[FastDepth], dict[str, float]]
"""Metrics of a network; the key ``score`` (smaller is better) decides which weights are best."""


def train(
    network: FastDepth,
    metadata: Metadata,
    signals: Sequence[Signal],
    config: TrainConfig,
    out: Path,
    validate: Validation | None = None,
    hooks: Sequence[Hooks] = (),
) -> TrainState:
    """Train until ``config.steps``, early stopping or an error; resumes when ``out/last.pt`` exists.

    Writes ``out/last.pt`` (everything), ``out/best.safetensors`` and ``out/final.safetensors`` (averaged
    weights) and
    ``out/curve.jsonl``.

    Raises:
        NonFiniteLossError: If a loss is not finite; names the images of the batch.
    """
    out.mkdir(parents=True, exist_ok=True)
    if config.channels_last:
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    state = TrainState(network, copy.deepcopy(network).eval(), build_optimiser(network, config))
    resume(state, out / "last.pt")
    this, of = rank(), world()
    for hook in hooks:
        hook.on_start(state, config)
    reason = "all steps done"
    while state.step < config.steps:
        losses = _step(state, signals, config, this, of)
        for hook in hooks:
            hook.on_step(state, losses)
        last = state.step == config.steps
        if validate is not None and (state.step % config.validate_every == 0 or last):
            metrics = validate(state.averaged)
            _note(state, metrics, metadata, out)
            for hook in hooks:
                hook.on_validation(state, metrics)
            if config.patience and state.stale >= config.patience:
                reason = f"no improvement in {config.patience} validations"
                break
        if this == 0 and (state.step % config.checkpoint_every == 0 or last):
            save_state(state, out / "last.pt")
    if this == 0:
        save_state(state, out / "last.pt")
        save_checkpoint(state.averaged, metadata, out / "final.safetensors", half=True)
    for hook in hooks:
        hook.on_end(state, reason)
    return state


def build_optimiser(network: FastDepth, config: TrainConfig) -> torch.optim.Optimizer:
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


def _step(state: TrainState, signals: Sequence[Signal], config: TrainConfig, this: int, of: int) -> dict[str, float]:
    network = state.network
    _set_modes(network, config)
    factor = learning_rate_factor(state.step, config)
    for group in state.optimiser.param_groups:
        group["lr"] = group["peak"] * factor
    state.optimiser.zero_grad(set_to_none=True)
    named: dict[str, Tensor] = {}
    for offset, signal in enumerate(signals):
        slots = [Slot(config.seed + 7919 * offset, state.step, i) for i in range(this, config.batch, of)]
        batch = signal.draw(slots)
        if config.channels_last:
            batch["image"] = batch["image"].contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=config.amp):
            losses = signal.losses(network, batch)
        for name, value in losses.items():
            if not torch.isfinite(value).all():
                bad = [d for d, v in zip(signal.describe(slots), value, strict=True) if not torch.isfinite(v)]
                raise NonFiniteLossError(
                    f"step {state.step}: loss {signal.name}/{name} is not finite for {', '.join(bad)}; "
                    "the last checkpoint is intact"
                )
            # Sum over this process's images, divided by the whole batch: processes add up to the global mean.
            named[f"{signal.name}/{name}"] = value.sum() / config.batch
    torch.stack(list(named.values())).sum().backward()
    if of > 1:
        _add_gradients(network)
    nn.utils.clip_grad_norm_([p for p in network.parameters() if p.grad is not None], config.clip_norm)
    state.optimiser.step()
    _average(state, config.ema_decay)
    state.step += 1
    return {k: float(v.detach()) for k, v in named.items()}


def _set_modes(network: FastDepth, config: TrainConfig) -> None:
    network.train()
    fixed: list[nn.Module] = [*network.encoder(), network.decoder_layers()[-1]]
    # The head's batch norm works on one channel, the depth itself: batch statistics would erase its scale.
    for part in [network] if config.freeze_norm else fixed:
        for module in part.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def _average(state: TrainState, decay: float) -> None:
    # A short memory at first, so that the start does not linger.
    decay = min(decay, (1 + state.step) / (10 + state.step))
    with torch.no_grad():
        for kept, new in zip(state.averaged.state_dict().values(), state.network.state_dict().values(), strict=True):
            if kept.is_floating_point():
                kept.lerp_(new, 1 - decay)
            else:
                kept.copy_(new)


def _add_gradients(network: nn.Module) -> None:
    """Sum gradients over processes as one message."""
    grads = [p.grad for p in network.parameters() if p.grad is not None]
    flat = torch.cat([g.flatten() for g in grads])
    dist.all_reduce(flat)
    start = 0
    for g in grads:
        g.copy_(flat[start : start + g.numel()].view_as(g))
        start += g.numel()


def _note(state: TrainState, metrics: dict[str, float], metadata: Metadata, out: Path) -> None:
    state.history.append({"step": float(state.step), **metrics})
    better = metrics["score"] < state.best
    state.best, state.stale = (metrics["score"], 0) if better else (state.best, state.stale + 1)
    if rank() != 0:
        return
    if better:
        save_checkpoint(state.averaged, metadata, out / "best.safetensors", half=True)
    (out / "curve.jsonl").write_text("".join(json.dumps(row) + "\n" for row in state.history))


def save_state(state: TrainState, path: Path) -> None:
    """Write all of a run's state, atomically: a kill during writing leaves the previous file."""
    content = {
        "network": state.network.state_dict(),
        "averaged": state.averaged.state_dict(),
        "optimiser": state.optimiser.state_dict(),
        "step": state.step,
        "best": state.best,
        "stale": state.stale,
        "history": state.history,
    }
    temporary = path.with_suffix(".part")
    torch.save(content, temporary)
    temporary.replace(path)


def resume(state: TrainState, path: Path) -> bool:
    """Load a run's state if there is one."""
    if not path.is_file():
        return False
    content = torch.load(path, map_location="cpu", weights_only=True)
    state.network.load_state_dict(content["network"])
    state.averaged.load_state_dict(content["averaged"])
    state.optimiser.load_state_dict(content["optimiser"])
    state.step, state.best, state.stale = content["step"], content["best"], content["stale"]
    state.history = content["history"]
    return True
