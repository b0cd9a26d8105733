"""A batch on a Ray cluster: Ray decides where and when, the flight's process is the same as on one machine.

Recordings and the batch's folder must lie at the same paths on every node, on a shared file system, and every node must
have this version of EdgeSLAM-Torch installed.
"""

import importlib
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.eval.experiment.runner import Local
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.jobs.watched import Ended, How, Limits, run_each

T = TypeVar("T")
_QUEUED_PER_CPU = 2
"""Tasks handed to the cluster, those that wait included: enough to keep it busy, few enough to interrupt."""


@dataclass(frozen=True, slots=True)
class OnRay:
    """Runs tasks on a cluster, one CPU each."""

    address: str
    """``auto`` for the cluster that runs on this machine, ``local`` to start one, or as ``ray.init`` takes it."""
    limits: Limits
    retries: int = 1
    """For a process or a Ray worker that was killed."""

    def __call__(self, cases: Iterable[T], prepare: Callable[[T], Path]) -> Generator[tuple[T, Ended]]:
        """See `edgeslam_torch.eval.experiment.runner.Runner`."""
        ray = _connected(self.address)
        try:  # an interrupted batch disconnects: Ray ends its workers, and flights end with them (ray.cancel crashed)
            yield from self._run(ray, cases, prepare)
        finally:
            ray.shutdown()

    def _run(self, ray: Any, cases: Iterable[T], prepare: Callable[[T], Path]) -> Generator[tuple[T, Ended]]:
        remote = ray.remote(num_cpus=1, max_retries=self.retries)(_attempt)
        waiting = deque(cases)
        running: dict[Any, T] = {}
        while waiting or running:
            most = _QUEUED_PER_CPU * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and len(running) < most:
                task = waiting.popleft()
                running[remote.remote(str(prepare(task)), self.limits, self.retries)] = task
            for reference in ray.wait(list(running))[0]:
                yield running.pop(reference), _ended(ray, reference)


def _attempt(folder: str, limits: Limits, retries: int) -> Ended:
    """On a node: the flight's process, watched as on one machine; ends with the Ray worker."""
    here = Local(1, limits, retries)
    with closing(run_each([Path(folder)], here.job, 1, retries)) as ends:
        return next(ends)[1]


def _ended(ray: Any, reference: Any) -> Ended:
    try:
        ended: Ended = ray.get(reference)
    except ray.exceptions.RayError as error:
        return Ended(How.KILLED, f"lost by Ray: {' '.join(str(error).split())[:200]}")
    return ended


def _connected(address: str) -> Any:
    with needs_extra("fleet", f"--ray {address}"):
        ray = importlib.import_module("ray")
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"--ray {address}: no cluster there ({reason}); start one with 'ray start --head'") from error
    return ray
