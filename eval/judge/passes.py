"""Long flights with revisits: growth of the map and cost of a frame, pass by pass.

The first frames of a recording, forwards and backwards, with fresh noise on every image::

    python -m edgeslam_torch.eval.judge.passes --recording DIR --frames 300 --passes 7

Laps through a simulated building of ten rooms or around a block of corridors, rendered on the fly, each on another
path::

    python -m edgeslam_torch.eval.judge.passes --world building --seed 0 --minutes 20 --width 320

Times are of one thread, without rendering. An interrupt (Ctrl-C) ends the flight, and the part flown is evaluated.
"""

import argparse
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.inputs.dataset import interpolate, open_dataset
from edgeslam_torch.eval.judge.table import aligned
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.source import Recording, open_source
from edgeslam_torch.run import settle_camera
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.flights.courses import simulated_camera
from edgeslam_torch.synthetic.flights.degrade import CameraFaults, degraded
from edgeslam_torch.synthetic.flights.flight import FlightPlan, fly_around
from edgeslam_torch.synthetic.flights.telemetry import simulate
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.rooms import BLOCK_M, BUILDING_M, block, building
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray, Frame, TelemetrySample

NOISE = 2.0
"""Standard deviation of the noise added to a recording's images [grey levels], typical of a cheap camera."""
RATE_HZ, SPEED_M_S = 15.0, 0.8
MIN_FRAMES = 30
"""Minimum length of a pass: one second."""
LAP_S = 56.0
"""Duration of a lap: 40 m, slower at the corners."""
WORLDS: dict[str, tuple[Callable[[np.random.Generator], World], tuple[float, float]]] = {
    "building": (building, BUILDING_M),
    "block": (block, BLOCK_M),
}
"""With the sides of the rectangle that is flown [m]."""
HEADER = ("pass", "frames", "on the map %", "new keyframes", "keyframes", "anchors", "edge points", "CPU ms", "95 % ms",
          "MB", "live ATE", "final ATE")  # fmt: skip


@dataclass(frozen=True, slots=True)
class LongFlight:
    """Frames with their true poses."""

    camera: Camera
    frames: Callable[[], Iterator[Frame]]
    T_w_c: FloatArray
    """``(F, 4, 4)`` true camera poses; NaN where unknown."""
    pass_frames: int
    """Length of a pass."""
    telemetry: list[TelemetrySample]


@dataclass(frozen=True, slots=True)
class Pass:
    """State at the end of a pass."""

    frames: int
    supported: int
    new_keyframes: int
    keyframes: int
    anchors: int
    edge_points: int
    """Measured, not yet fused."""
    cpu_ms: FloatArray
    """``(F,)`` of each frame."""
    memory_mb: float

    def cells(self) -> list[str]:
        """For the table."""
        return [
            f"{self.frames}",
            f"{100 * self.supported / self.frames:.1f}",
            *(f"{n}" for n in (self.new_keyframes, self.keyframes, self.anchors, self.edge_points)),
            f"{np.mean(self.cpu_ms):.1f}",
            f"{np.percentile(self.cpu_ms, 95):.0f}",
            f"{self.memory_mb:.0f}",
        ]


def to_and_fro(folder: Path, count: int, passes: int, noise: float = NOISE, seed: int = 0) -> LongFlight:
    """The first frames of a recording, alternately forwards and backwards, at its own rate.

    Raises:
        EdgeSlamError: If it cannot be read.
    """
    source = open_source(folder)
    assert isinstance(source, Recording)
    settle_camera(source)
    originals = list(islice(source.decode([]), count))
    stamps = np.array([frame.stamp_s for frame in originals])
    order = np.concatenate([range(len(originals))[:: -1 if k % 2 else 1] for k in range(passes)])
    period_s = float(np.median(np.diff(stamps)))

    def frames() -> Iterator[Frame]:
        for i, original in enumerate(order.tolist()):
            rng = np.random.default_rng([seed, i])
            image = originals[original].image
            noisy = image + noise * rng.standard_normal(image.shape, dtype=np.float32)
            yield Frame(i, i * period_s, np.clip(np.rint(noisy), 0, 255).astype(np.uint8))

    T_w_c, known = interpolate(open_dataset(folder).truth, stamps)
    return LongFlight(source.camera, frames, np.where(known[:, None, None], T_w_c, np.nan)[order], len(originals), [])


def around(name: str, seed: int, minutes: float, width: int = 640) -> LongFlight:
    """Laps through one of `WORLDS` with a Tello's telemetry; images are ``width`` pixels wide."""
    rng = np.random.default_rng(seed)
    build, sides_m = WORLDS[name]
    world, camera, faults = build(rng), simulated_camera(width, 3 * width // 4), CameraFaults()
    plan = FlightPlan(speed_m_s=SPEED_M_S)
    flight = fly_around(rng, world, round(60 * minutes * RATE_HZ), rate_hz=RATE_HZ, plan=plan, sides_m=sides_m)
    floor = world.floor_below(flight.T_w_b[:, :3, 3])
    T_w_c = flight.T_w_c
    log = simulate(rng, flight.stamps_s, T_w_c, flight.T_b_c, floor_m=floor)

    def frames() -> Iterator[Frame]:
        for i, stamp_s in enumerate(flight.stamps_s.tolist()):
            view = render(world, camera, T_w_c[i])
            noise, twist = np.random.default_rng([seed, i]), flight.twist_c(i)
            image = degraded(noise, view.image, view.depth_m, camera, faults, stamp_s=stamp_s, twist_c=twist)
            yield Frame(i, stamp_s, image)

    return LongFlight(camera, frames, T_w_c, round(LAP_S * RATE_HZ), log.samples())


def fly(
    flight: LongFlight, say: Callable[[str], None], stopped: Callable[[], bool] = lambda: False
) -> tuple[EdgeSlam, list[Pass], FloatArray]:
    """Run the flight until stopped; returns the system, the passes, and the live poses ``(F, 4, 4)``."""
    slam = EdgeSlam(flight.camera, SlamConfig())
    passes: list[Pass] = []
    live, cpu_ms, used = [], [], 0
    for frame in flight.frames():
        first, used = used, sum(s.stamp_s <= frame.stamp_s for s in flight.telemetry[used:]) + used
        begin_s = time.process_time()
        output = slam.step(frame, flight.telemetry[first:used])
        cpu_ms.append(1e3 * (time.process_time() - begin_s))
        live.append((output.T_w_c, output.status.supported, output.keyframe))
        if len(live) % flight.pass_frames == 0:
            passes.append(_pass(slam, live[-flight.pass_frames :], cpu_ms[-flight.pass_frames :]))
            say(", ".join(f"{name} {cell}" for name, cell in zip(HEADER, _row(passes), strict=False)))
        if stopped():
            break
    begin_s = time.process_time()
    slam.finish()
    say(f"finish: {time.process_time() - begin_s:.1f} s")
    return slam, passes, np.stack([T_w_c for T_w_c, _, _ in live])


def _pass(slam: EdgeSlam, live: list[tuple[FloatArray, bool, bool]], cpu_ms: list[float]) -> Pass:
    return Pass(
        len(live),
        sum(supported for _, supported, _ in live),
        sum(keyframe for _, _, keyframe in live),
        len(slam.map.keyframes),
        len(slam.map.anchors),
        sum(len(host.uv) for host in slam.edges.hosts),
        np.array(cpu_ms),
        _memory_mb(),
    )


def _row(passes: Sequence[Pass]) -> list[str]:
    return [f"{len(passes)}", *passes[-1].cells()]


def _memory_mb() -> float:
    """Current memory of this process; its peak if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    return pages * resource.getpagesize() / 2**20


def errors_of_passes(estimate: FloatArray, truth: FloatArray, length: int) -> list[float]:
    """RMS error [m] of every pass after one Sim(3) over all frames ``(F, 4, 4)``; NaN where the truth is unknown."""
    known = np.isfinite(truth[:, 0, 3])
    aligned_to = umeyama(estimate[known, :3, 3], truth[known, :3, 3])
    squared = np.sum((aligned_to.points(estimate[:, :3, 3]) - truth[:, :3, 3]) ** 2, axis=1)
    parts = [squared[k : k + length] for k in range(0, len(squared) - length + 1, length)]
    return [float(np.sqrt(np.nanmean(part))) for part in parts]


def points_a_room(points: FloatArray, estimate: FloatArray, truth: FloatArray) -> list[int]:
    """Edge points ``(P, 3)`` in each of the building's ten rooms, in the truth's frame."""
    p = umeyama(estimate[:, :3, 3], truth[:, :3, 3]).points(points.astype(np.float64))
    side = 0.2 * (BUILDING_M[0] + BUILDING_M[1])
    column, row = np.floor(p[:, 0] / side + 2.5).astype(int), (p[:, 1] > 0).astype(int)
    inside = (column >= 0) & (column < 5)
    return np.bincount((5 * row + column)[inside], minlength=10).tolist()


def interrupted() -> Callable[[], bool]:
    """Whether an interrupt was requested; the current frame is finished first."""
    signals: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: signals.append(number))
    return lambda: bool(signals)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line when a pass ends, and the table at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--recording", type=Path, metavar="DIR", help="recording with ground truth")
    what.add_argument("--world", choices=WORLDS, help="simulated")
    parser.add_argument("--frames", type=int, default=300, help="of the recording")
    parser.add_argument("--passes", type=int, default=7, help="over the recording")
    parser.add_argument("--noise", type=float, default=NOISE, help="on the recording's pictures [grey levels]")
    parser.add_argument("--minutes", type=float, default=20.0, help="through the world")
    parser.add_argument("--width", type=int, default=640, help="of the world's pictures [px]")
    parser.add_argument("--seed", type=int, default=0, help="of noise, and of the world")
    args = parser.parse_args(argv)
    say = partial(print, file=sys.stderr, flush=True)
    if args.world and not args.minutes * 60 >= LAP_S:
        parser.error(f"--minutes must be at least {LAP_S / 60:.2f}, once around")
    if args.frames < MIN_FRAMES or args.passes < 1 or args.width < 160 or args.noise < 0:
        parser.error(f"--frames must be at least {MIN_FRAMES}, --passes 1, --width 160, --noise 0")
    try:
        if args.world:
            flight = around(args.world, args.seed, args.minutes, args.width)
        else:
            flight = to_and_fro(args.recording, args.frames, args.passes, args.noise, args.seed)
        slam, passes, live = fly(flight, say, interrupted())
    except EdgeSlamError as error:
        print(error, file=sys.stderr)
        return 1
    final = slam.trajectory()[1]
    truth = flight.T_w_c[: len(final)]
    for change in slam.closures():
        say(f"{change.stamp_s:.1f} s: {change}")
    errors = zip(*(errors_of_passes(T_w_c, truth, flight.pass_frames) for T_w_c in (live, final)), strict=True)
    rows = [
        [*_row(passes[: k + 1]), *(f"{error:.4f}" for error in pair)]
        for k, pair in enumerate(islice(errors, len(passes)))
    ]
    print(aligned(HEADER, rows))
    cloud = slam.edge_map()
    print(
        f"{len(slam.pieces())} piece(s), {len(slam.closures())} loops closed, {len(cloud.p_w)} edge points at the end"
    )
    if args.world == "building":
        print(f"edge points a room: {points_a_room(cloud.p_w, final, truth)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
