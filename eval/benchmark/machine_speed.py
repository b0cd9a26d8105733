"""Current speed of this machine: fixed reference work, timed beside every measurement.

Times on a shared machine depend on other load and clock frequency. Reference work timed in the same minutes is
affected alike, and so measures how much of a difference is the machine's. It consists of what a run spends its time
on (image features, arrays, small solves, the interpreter), without code of this project.
"""

import os
import statistics
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

_REPEATS = 15
_BUSY_SHARE = 0.10
"""Share of all cores' time used by others above which times count as disturbed."""
_STOLEN_SHARE = 0.02
"""The same for time that the host took from this virtual machine."""


@dataclass(frozen=True, slots=True)
class CpuTimes:
    """Counters of ``/proc/stat`` over all cores [s], and what this process and its finished children used."""

    wall: float
    busy: float
    stolen: float
    own: float
    cores: int


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Other load during a measurement, as shares of all cores' time."""

    others: float
    stolen: float

    @property
    def busy(self) -> bool:
        """Whether times measured meanwhile are unreliable."""
        return self.others > _BUSY_SHARE or self.stolen > _STOLEN_SHARE


def read_cpu_times(stat: Path = Path("/proc/stat")) -> CpuTimes | None:
    """The counters now; None where the system has none (anything but Linux)."""
    if not stat.is_file():
        return None
    lines = stat.read_text(encoding="ascii", errors="replace").splitlines()
    fields = [int(x) for x in lines[0].split()[1:9]]
    tick = os.sysconf("SC_CLK_TCK")
    user, nice, system, _idle, _wait, irq, softirq, steal = (x / tick for x in fields)
    own = os.times()
    return CpuTimes(
        wall=time.monotonic(),
        busy=user + nice + system + irq + softirq,
        stolen=steal,
        own=own.user + own.system + own.children_user + own.children_system,
        cores=max(1, sum(line.startswith("cpu") and line[3:4].isdigit() for line in lines)),
    )


def disturbance(before: CpuTimes | None, after: CpuTimes | None) -> Disturbance | None:
    """Other load between two readings; None if unknown."""
    if before is None or after is None or after.wall <= before.wall:
        return None
    whole = (after.wall - before.wall) * after.cores
    others = (after.busy - before.busy) - (after.own - before.own)
    return Disturbance(max(0.0, others) / whole, max(0.0, after.stolen - before.stolen) / whole)


class MachineSpeed:
    """A separate process that times the reference work and other functions on request.

    Separate, so that its imports do not count as memory of the caller's runs.
    """

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn"))

    def __enter__(self) -> "MachineSpeed":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._pool.shutdown()

    def time(self, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What a function of a module returns when called in that process."""
        return self._pool.submit(measure).result()


def reference() -> dict[str, float]:
    """Milliseconds of the fixed work.

    ``one_ms`` is the CPU time of one thread alone, ``cpu_ms`` that of each of two threads at once (a run has two; on
    many machines two threads share a core), ``wall_ms`` how long the two take by the clock.
    """
    work = _fixed_work()
    work()  # warms caches
    one, cpu, wall = [], [], []
    for _ in range(_REPEATS):
        one.append(_thread_ms(work))
        both: list[float] = []
        beside = threading.Thread(target=lambda both=both: both.append(_thread_ms(work)))
        start = time.perf_counter()
        beside.start()
        both.append(_thread_ms(work))
        beside.join()
        wall.append(1e3 * (time.perf_counter() - start))
        cpu.append(statistics.mean(both))
    return {"one_ms": statistics.median(one), "cpu_ms": statistics.median(cpu), "wall_ms": statistics.median(wall)}


def _thread_ms(work: Callable[[], None]) -> float:
    start = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - start)


def orb_pass_ms() -> float:
    """CPU time of one pass of ORB (1000 features) over one 640 x 480 image: the unit that costs are stated in.

    Every system of this kind spends some such passes on a frame, and they take as much longer on a slower processor.
    """
    orb_pass = _orb_pass()
    orb_pass()  # warms caches
    return statistics.median(_thread_ms(orb_pass) for _ in range(_REPEATS))


def _orb_pass() -> Callable[[], None]:
    import cv2

    cv2.setNumThreads(1)
    noise = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    image = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    orb = cv2.ORB.create(1000)

    def orb_pass() -> None:
        orb.detectAndCompute(image, None)

    return orb_pass


def _fixed_work() -> Callable[[], None]:
    """Some 100 ms of what a run does, the same every time."""
    orb_pass = _orb_pass()
    rng = np.random.default_rng(0)
    values = rng.normal(size=200_000)
    order = rng.permutation(len(values))
    blocks = rng.normal(size=(2000, 6, 6))
    blocks = blocks @ blocks.transpose(0, 2, 1) + 6 * np.eye(6)
    vectors = rng.normal(size=(2000, 6, 1))

    def work() -> None:
        for _ in range(2):
            orb_pass()
        for _ in range(4):
            np.sort(values[order])
            np.linalg.solve(blocks, vectors)
        total = 0.0
        for k in range(150_000):
            total += k * 0.5

    return work
