"""Batches drawn ahead by worker processes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any, TypeVar

import cv2
import torch
from torch.utils.data import DataLoader, Dataset

from edgeslam_torch.errors import EdgeSlamError

T = TypeVar("T")

AHEAD = 2
"""Batches that each worker prefetches."""


class WorkerError(EdgeSlamError):
    """A process that draws batches is gone."""


@contextmanager
def drawn(draw: Callable[[int], T], first: int, last: int, workers: int) -> Iterator[Iterator[T]]:
    """What ``draw`` gives for each step from ``first`` up to ``last``, in order.

    A batch is a function of its step, so that any number of workers gives the same ones.

    Args:
        draw: Makes one step's batch. What it raises, the iterator raises.
        workers: Processes, one thread each; 0 draws in this one.

    Raises:
        WorkerError: If a worker is gone, wherever the block is: torch's handler of its signal raises there.
    """
    if workers == 0:
        yield map(draw, range(first, last))
        return
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # its threads do not survive a fork: a child that used them would deadlock
    try:
        batches = iter(
            DataLoader(
                _Steps(draw),
                batch_size=None,
                sampler=range(first, last),
                num_workers=workers,
                prefetch_factor=AHEAD,
                worker_init_fn=_one_thread,
                generator=torch.Generator(),  # without one, it draws from torch's, and changes what others draw
            )
        )
    finally:
        cv2.setNumThreads(threads)
    try:
        yield _unpacked(batches)
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        why = " ".join(str(error).split())[:160]
        raise WorkerError(f"a process that draws batches ended ({why}); fewer --workers take less memory") from error


def _unpacked(batches: Iterator[Any]) -> Iterator[Any]:
    try:
        for found in batches:
            if isinstance(found, Exception):
                raise found
            yield found
    except (ConnectionResetError, EOFError) as error:  # a worker dies while it hands over a batch
        # Once it is joined, torch's handler of that signal has raised here, or finds nothing later. Its pipe closes
        # before it is dead.
        workers = batches._workers  # type: ignore[attr-defined]
        closed = wait([worker.sentinel for worker in workers])
        for worker in workers:
            if worker.sentinel in closed:
                worker.join()
        raise RuntimeError(f"DataLoader worker is gone: {error}") from error


class _Steps(Dataset[Any]):
    """Batches by step. An exception is an item: torch would rebuild it from the text of its traceback."""

    def __init__(self, draw: Callable[[int], Any]) -> None:
        self._draw = draw

    def __getitem__(self, step: int) -> Any:
        try:
            return self._draw(step)
        except Exception as error:
            return error


def _one_thread(_: int) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
