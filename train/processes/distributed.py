"""Several processes under ``torchrun``; a single process needs none of it.

They share their files: every process must see the same data and output folder. Where they wait for each other, a
process that is gone is a `ProcessError`.
"""

import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from edgeslam_torch.errors import ConfigError, EdgeSlamError

T = TypeVar("T")

PATIENCE = timedelta(hours=12)
"""Timeout for other processes: the first may run SLAM on a long recording. A dead process is noticed at once by its
closed connections."""


class ProcessError(EdgeSlamError):
    """Another process of the group failed or is gone."""


@contextmanager
def process_group() -> Iterator[int]:
    """Join the group that ``torchrun`` describes in the environment (gloo); yields the rank, 0 when alone.

    Raises:
        ConfigError: If the environment describes no group that can be joined.
    """
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        yield 0
        return
    # Imported later, as torch's optimisers do, default arguments in them would hold the group's threads till after the
    # interpreter's end, where one in thirty processes aborted (pytorch issue 190489).
    for name in ("torch._dynamo", "torch.distributed.nn.functional"):
        importlib.import_module(name)
    try:
        dist.init_process_group("gloo", timeout=PATIENCE)
    except (ValueError, RuntimeError) as error:
        why = " ".join(str(error).split())[:160]
        raise ConfigError(f"RANK and WORLD_SIZE are set, but the processes cannot be joined ({why})") from error
    try:
        yield dist.get_rank()
    finally:
        dist.destroy_process_group()


def rank() -> int:
    """This process's number, 0 when alone."""
    return dist.get_rank() if _together() else 0


def world() -> int:
    """Number of processes."""
    return dist.get_world_size() if _together() else 1


def by_first(work: Callable[[], T]) -> T:
    """Result of ``work``, executed in process 0 only; must pickle.

    Raises:
        Exception: In process 0, what ``work`` raised.
        ProcessError: In the others, when ``work`` failed in process 0 or that is gone.
    """
    if not _together():
        return work()
    answer: list[Any] = [None, None]
    failure: Exception | None = None
    if rank() == 0:
        try:
            answer[0] = work()
        except Exception as error:
            failure, answer[1] = error, f"{error}"
    with _lost_is_said():
        dist.broadcast_object_list(answer)
    if failure is not None:
        raise failure
    if answer[1] is not None:
        raise ProcessError(f"stopped with the first process: {answer[1]}")
    return answer[0]


def share_of(items: Sequence[T]) -> Sequence[T]:
    """This process's part of a list."""
    return items[rank() :: world()]


def everyones(messages: Sequence[str]) -> list[str]:
    """The messages of all processes, once each has come here."""
    if not _together():
        return list(messages)
    gathered: list[list[str]] = [[] for _ in range(world())]
    with _lost_is_said():
        dist.all_gather_object(gathered, list(messages))
    return [message for part in gathered for message in part]


def add_up(tensors: Sequence[Tensor]) -> None:
    """Replace each tensor by its sum over the processes, all as one message."""
    if not _together():
        return
    flat = torch.cat([t.flatten() for t in tensors])
    with _lost_is_said():
        dist.all_reduce(flat)
    start = 0
    for t in tensors:
        t.copy_(flat[start : start + t.numel()].view_as(t))
        start += t.numel()


def _together() -> bool:
    return dist.is_available() and dist.is_initialized()


@contextmanager
def _lost_is_said() -> Iterator[None]:
    """Gloo reports a dead peer as a closed connection."""
    try:
        yield
    except RuntimeError as error:
        why = " ".join(str(error).split())[:120]
        raise ProcessError(f"another process of this training ended ({why})") from error


class SharedBatchNorm2d(nn.BatchNorm2d):
    """`torch.nn.BatchNorm2d` whose batch is that of all processes, which may have different numbers of images."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalised ``(B, C, H, W)``; in training by mean and variance over ``B``, ``H``, ``W`` of all processes."""
        if not self.training:
            return super().forward(x)
        of_channel = (1, -1, 1, 1)
        wide = x.float()
        count = _everywhere(wide.new_tensor(float(x.numel() // x.shape[1])))
        mean = _everywhere(wide.sum((0, 2, 3))) / count
        centred = wide - mean.view(of_channel)
        variance = _everywhere(centred.square().sum((0, 2, 3))) / count
        self._remember(mean.detach(), variance.detach() * count / (count - 1.0).clamp(min=1.0))
        scaled = centred * (variance + self.eps).rsqrt().view(of_channel)
        return (scaled * self.weight.view(of_channel) + self.bias.view(of_channel)).to(x.dtype)

    def _remember(self, mean: Tensor, variance: Tensor) -> None:
        assert self.running_mean is not None and self.running_var is not None and self.num_batches_tracked is not None
        assert self.momentum is not None
        self.num_batches_tracked.add_(1)
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance, self.momentum)


def share_norms(network: nn.Module) -> None:
    """Replace every `torch.nn.BatchNorm2d` in ``network``; parameters, statistics and their names stay."""
    for name, child in network.named_children():
        if type(child) is not nn.BatchNorm2d:
            share_norms(child)
            continue
        shared = SharedBatchNorm2d(child.num_features, child.eps, child.momentum)
        shared.weight, shared.bias = child.weight, child.bias
        shared.running_mean, shared.running_var = child.running_mean, child.running_var
        shared.num_batches_tracked = child.num_batches_tracked
        shared.train(child.training)
        setattr(network, name, shared)


def _everywhere(x: Tensor) -> Tensor:
    """Sum over the processes; each process's loss depends on it, so its gradient is the sum of theirs."""
    from torch.distributed.nn.functional import all_reduce  # not in every build of torch

    with _lost_is_said():
        return all_reduce(x)
