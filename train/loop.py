"""The loop that every recipe runs; hooks (`train.hooks`) are its extension points.

A step is a function of (seed, step): no random state persists, so a killed run resumes exactly from its last
checkpoint, and a batch split over processes is the same batch.
"""

import copy
import json
import logging
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from edgeslam_torch.errors import ConfigError, EdgeSlamError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.models.checkpoint import save_checkpoint
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.hooks import Drawn, Hooks
from edgeslam_torch.train.processes.device import arithmetic
from edgeslam_torch.train.processes.distributed import add_up, by_first, everyones, rank, share_norms, world
from edgeslam_torch.train.processes.loading import drawn
from edgeslam_torch.train.signals import Signal, Slot
from edgeslam_torch.train.state import TrainConfig, TrainState, resume, save_state, saved_step

logger = logging.getLogger(__name__)

LAST, BEST, FINAL, CURVE = "last.pt", "best.safetensors", "final.safetensors", "curve.jsonl"
"""Files of `train`: its whole state, the best validated and the last averaged weights, the validations."""
NO_ROOM_M = (0.02, 90.0)
"""Plausible median depth; a network mostly outside of it has diverged."""


class DivergedError(EdgeSlamError):
    """Training has diverged; the message names the files that are kept."""


class NonFiniteLossError(DivergedError):
    """A loss was NaN or infinite; the message names the batch."""


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
    if world() * config.accumulate > config.batch:
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
    scaler = torch.amp.GradScaler(numbers.device.type, enabled=numbers.dtype is torch.float16)
    state = TrainState(network, averaged, optimiser, numbers, scaler)
    if not resume(state, out / LAST) and before is not None:
        state.best, state.history = before["score"], [{"step": 0.0, **before}]
    if state.step > config.steps:
        raise ConfigError(f"{out / LAST}: has {state.step} steps already, so it cannot end after {config.steps}")
    run = _Run(state, signals, config, metadata, out, validate, hooks)
    with ExitStack() as closing:
        for hook in hooks:
            closing.callback(hook.close)
        try:
            for hook in hooks:
                hook.on_start(state, config)
            reason = run.all_steps()
        except DivergedError as error:
            raise type(error)(f"{error}; {_kept(out)}") from None
        except BaseException:
            run.rescue()
            raise
        by_first(run.finish)
        for hook in hooks:
            hook.on_end(state, reason)
    return state


@dataclass(frozen=True, slots=True)
class _Part:
    """Images that one forward pass sees, for one of the signals."""

    signal: int
    batch: dict[str, Tensor]
    names: list[str]
    """What each image shows, for messages."""


def _drawn_parts(signals: Sequence[Signal], config: TrainConfig, this: int, of: int, step: int) -> list[_Part]:
    """What process ``this`` of some learns from in a step; a function of the step, so that any process may draw it."""
    mine = range(this, config.batch, of)
    found = []
    for k in range(config.accumulate):
        for number, signal in enumerate(signals):
            slots = [Slot(config.seed + 7919 * number, step, i) for i in mine[k :: config.accumulate]]
            found.append(_Part(number, *signal.draw(slots)))
    return found


@dataclass(frozen=True, slots=True)
class _Run:
    """One call of `train`."""

    state: TrainState
    signals: Sequence[Signal]
    config: TrainConfig
    metadata: Metadata
    out: Path
    validate: Validation | None
    hooks: Sequence[Hooks]

    def all_steps(self) -> str:
        """Run all steps; returns the reason for stopping."""
        state, config = self.state, self.config
        draw = partial(_drawn_parts, self.signals, config, rank(), world())
        with drawn(draw, state.step, config.steps, config.workers) as batches:
            while True:
                self.agree_to_stop()
                if self.validate is not None and self.validation_is_due():
                    metrics = by_first(partial(self.validate, state.averaged))
                    self.note(metrics)
                    for hook in self.hooks:
                        hook.on_validation(state, metrics)
                    self.agree_to_stop()
                if config.patience and state.stale >= config.patience:
                    return f"no improvement in {config.patience} validations"
                if state.step >= config.steps:
                    return "all steps done"
                if state.stop:
                    return state.stop
                losses = self.one_step(next(batches))
                for hook in self.hooks:
                    hook.on_step(state, losses)
                if state.step % config.checkpoint_every == 0 or state.step == config.steps:
                    by_first(self.save_good)

    def validation_is_due(self) -> bool:
        """Also after a resume between a step and its validation; at most once per step."""
        step, history = self.state.step, self.state.history
        last = step == self.config.steps or bool(self.state.stop)
        return step > (history[-1]["step"] if history else 0) and (step % self.config.validate_every == 0 or last)

    def agree_to_stop(self) -> None:
        """Broadcast of one process's stop request: all must end after the same step."""
        self.state.stop = next(iter(everyones([self.state.stop] if self.state.stop else [])), "")

    def note(self, metrics: dict[str, float]) -> None:
        """Write the file first: after an interrupt in between, the step is validated again."""
        state = self.state
        if metrics["score"] < state.best:
            if rank() == 0:
                save_checkpoint(state.averaged, self.metadata, self.out / BEST, half=True)
            state.best, state.best_step, state.stale = metrics["score"], state.step, 0
        else:
            state.stale += 1
        state.history.append({"step": float(state.step), **metrics})
        if rank() == 0:
            write_text(self.out / CURVE, "".join(json.dumps(row) + "\n" for row in state.history))

    def finish(self) -> None:
        save_state(self.state, self.out / LAST)
        save_checkpoint(self.state.averaged, self.metadata, self.out / FINAL, half=True)

    def save_good(self) -> None:
        """Save the state, unless the network or its average gives absurd depths for images of the last batch."""
        low, high = NO_ROOM_M
        networks = (self.state.network, self.state.averaged)
        if any(_share_between(network, self.state.shown, math.log(low), math.log(high)) < 0.5 for network in networks):
            raise DivergedError(
                f"step {self.state.step}: training has diverged, most of the depth is nearer than {low:g} m, farther "
                f"than {high:g} m or no number"
            )
        save_state(self.state, self.out / LAST)

    def rescue(self) -> None:
        """Save the last completed step during an interrupt or failure, without masking it."""
        state = self.state
        if rank() != 0 or not state.whole or state.shown is None:
            return
        for name, buffer in state.network.named_buffers():
            if name in state.statistics:
                buffer.copy_(state.statistics[name])
        try:
            self.save_good()
        except (DivergedError, OSError) as error:
            logger.info("step %d is not saved: %s", state.step, error)

    def one_step(self, parts: Sequence[_Part]) -> dict[str, float]:
        """Learn from one batch; the losses by name."""
        state, config, network = self.state, self.config, self.state.network
        _set_modes(network, config)
        if not config.freeze_norm:
            state.statistics = {name: buffer.clone() for name, buffer in network.named_buffers()}
        factor = learning_rate_factor(state.step, config)
        for group in state.optimiser.param_groups:
            group["lr"] = group["peak"] * factor
        state.optimiser.zero_grad(set_to_none=True)
        totals: dict[str, float] = {}
        bad: list[str] = []
        for start in range(0, len(parts), len(self.signals)):  # the parts of one image share a gradient
            named: dict[str, Tensor] = {}
            for part in parts[start : start + len(self.signals)]:
                named |= self.losses_of(part, bad)
            state.scaler.scale(torch.stack(list(named.values())).sum()).backward()
            for name, value in named.items():
                totals[name] = totals.get(name, 0.0) + float(value.detach())
        learnt = [p for p in network.parameters() if p.grad is not None]
        add_up([p.grad for p in learnt if p.grad is not None])
        if failures := everyones(bad):
            raise NonFiniteLossError(f"step {state.step}: {failures[0]}")
        state.scaler.unscale_(state.optimiser)
        norm = nn.utils.clip_grad_norm_(learnt, config.clip_norm)
        # The scaler leaves out a step whose float16 gradients overflow, and scales less from then on.
        if not state.scaler.is_enabled() and not torch.isfinite(norm):
            raise NonFiniteLossError(f"step {state.step}: the gradient is not finite")
        state.whole = False
        state.scaler.step(state.optimiser)
        state.scaler.update()
        _average(state, config.ema_decay)
        state.step += 1
        state.statistics = {}
        state.whole = True
        return totals

    def losses_of(self, part: _Part, bad: list[str]) -> dict[str, Tensor]:
        """Losses of one part by name, ``()`` each: sums over its images, divided by the whole batch, so that parts and
        processes add up to the mean. What is not finite is said in ``bad``.

        Raises:
            ConfigError: If a hook made something else of them than one value an image; names it.
        """
        state, signal = self.state, self.signals[part.signal]
        batch = state.arithmetic.moved(part.batch)
        if self.config.channels_last:
            batch["image"] = batch["image"].contiguous(memory_format=torch.channels_last)
        state.shown = batch["image"][:2]
        with state.arithmetic.autocast():
            predicted = state.network.predict(batch["image"])
            seen = Drawn(signal.name, batch, predicted, signal.losses(predicted, batch))
        for hook in self.hooks:
            hook.on_losses(state, seen)
            for name, value in seen.losses.items():
                _check_loss(hook, name, value, len(part.names))
        named = {}
        for name, value in seen.losses.items():
            if not torch.isfinite(value).all():
                images = [d for d, v in zip(part.names, value, strict=True) if not torch.isfinite(v)]
                bad.append(f"loss {signal.name}/{name} is not finite for {', '.join(images)}")
            named[f"{signal.name}/{name}"] = value.float().sum() / self.config.batch
        return named


def _check_loss(hook: Hooks, name: str, value: object, images: int) -> None:
    if not isinstance(value, Tensor) or value.shape != (images,):
        found = f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        who = f"hook {type(hook).__name__}"
        raise ConfigError(f"{who}: loss {name!r} must be one value an image, ({images},), and is {found}")


def _share_between(network: DepthModule, images: Tensor | None, low: float, high: float) -> float:
    """Share of log depth in a range; 1 without images."""
    if images is None:
        return 1.0
    was_training = network.training
    network.eval()
    with torch.no_grad():
        log_depth = network.predict_half(images).log_depth
    network.train(was_training)
    return float(((log_depth > low) & (log_depth < high)).float().mean())


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
