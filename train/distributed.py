"""Several processes under ``torchrun``; a single one needs nothing of this."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch.distributed as dist


@contextmanager
def process_group() -> Iterator[int]:
    """Join the group that ``torchrun`` describes in the environment (gloo); yields the rank, 0 when alone."""
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        yield 0
        return
    dist.init_process_group("gloo")
    try:
        yield dist.get_rank()
    finally:
        dist.destroy_process_group()


@contextmanager
def wait_for_first(rank: int) -> Iterator[None]:
    """Let process 0 do the block before the others (which then find its results)."""
    together = dist.is_available() and dist.is_initialized()
    if together and rank != 0:
        dist.barrier()
    yield
    if together and rank == 0:
        dist.barrier()


def rank() -> int:
    """This process's number, 0 when alone."""
    return dist.get_rank() if dist.is_available() and dist.is_initialized() else 0


def world() -> int:
    """Number of processes."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1
