"""Accuracy of `EdgeSlam.pose_now` under video latency: simulated slow flights through the whole pipeline.

After every frame the program asks for the present pose, as a pilot would, and compares it with where the drone is by
then: the frame shows where it was ``--delay`` before. Flights are recorded into ``--folder`` once::

    python -m edgeslam_torch.eval.benchmark.pose_now --folder flights --seeds 2 --literal
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.eval.metrics.align import Alignment, AlignmentKind, umeyama
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.readers.source import Recording, open_source
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ, record_flight, simulated_camera
from edgeslam_torch.synthetic.flights.flight import FlightPlan
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate
from edgeslam_torch.types import FloatArray, PoseNow, TelemetrySample

_DIFFERENCE_S = 0.05
"""The true velocity is the mean over twice this time."""
_LEAST_ANSWERS = 20
"""A second of a flight; fewer cannot be aligned."""


@dataclass(frozen=True, slots=True)
class Request:
    """One answer of `pose_now`."""

    now: PoseNow
    T_w_seen: FloatArray
    """Published pose of the frame that it rests on ``(4, 4)``."""


@dataclass(slots=True)
class Errors:
    """Of all answers that rest on the filter; lists of the same length."""

    absolute_m: list[float] = field(default_factory=list)
    """In the world of the trajectory, which is aligned with the truth as a whole, without scale."""
    since_seen_m: list[float] = field(default_factory=list)
    """Of the motion since the frame that the answer rests on: what the filter does wrong, without the map."""
    late_m: list[float] = field(default_factory=list)
    """How far the drone is from where that frame was taken."""
    velocity_m_s: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    """Of position and rotation since that frame; chi-square with 6 degrees when the covariance is true."""
    requests: int = 0
    """Number of requests, with and without the filter."""

    def add(self, other: "Errors") -> None:
        """Those of another flight."""
        for name in ("absolute_m", "since_seen_m", "late_m", "velocity_m_s", "nees"):
            getattr(self, name).extend(getattr(other, name))
        self.requests += other.requests

    def line(self, name: str) -> str:
        """For the terminal."""
        if not self.absolute_m:
            return f"{name}: the filter never gave the pose ({self.requests} requests)"
        return (
            f"{name}: pose {_spread(self.absolute_m)}; motion since the last frame {_spread(self.since_seen_m)}, "
            f"uncompensated {_spread(self.late_m)}; velocity {_spread(self.velocity_m_s)} a second; "
            f"mean NEES {np.mean(self.nees):.1f} of 6; {len(self.absolute_m)} of {self.requests} by the filter"
        )


def _spread(values: list[float]) -> str:
    median, high, worst = 100.0 * np.quantile(values, [0.5, 0.95, 1.0])
    return f"{median:.1f} / {high:.1f} / {worst:.1f} cm"


class Truth:
    """Camera poses at any time between the first and the last."""

    def __init__(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        self.stamps_s, self.T_w_c = stamps_s, T_w_c
        self._turn = Slerp(stamps_s, Rotation.from_matrix(T_w_c[:, :3, :3]))

    @classmethod
    def of(cls, folder: Path) -> "Truth":
        """Ground truth of a recording."""
        truth = read_trajectory(folder / "groundtruth.txt")
        return cls(truth.stamps_s, truth.T_w_c)

    def at(self, stamp_s: float) -> FloatArray:
        """``T_w_c`` ``(4, 4)``."""
        T = np.eye(4)
        T[:3, :3] = self._turn(stamp_s).as_matrix()
        T[:3, 3] = [np.interp(stamp_s, self.stamps_s, p) for p in self.T_w_c[:, :3, 3].T]
        return T


def ask(recording: Recording, telemetry: Sequence[TelemetrySample], config: SlamConfig) -> list[Request]:
    """Run a recording and ask for the present pose after every frame."""
    slam = EdgeSlam(recording.camera, config)
    answers, published, sent = [], {}, 0
    for frame in recording.frames():
        end = sent
        while end < len(telemetry) and telemetry[end].stamp_s <= frame.stamp_s:
            end += 1
        output = slam.step(frame, telemetry[sent:end])
        sent = end
        published[frame.stamp_s] = output.T_w_c
        now = slam.pose_now(frame.stamp_s)
        if now is not None and now.seen_s in published:
            answers.append(Request(now, published[now.seen_s]))
    return answers


def judge(answers: Sequence[Request], truth: Truth, delay_s: float) -> Errors:
    """Compare metric answers of the filter with the truth at the moment that they speak of.

    Each revision of the published units is aligned by itself: it is an event, and poses across it do not compare.
    """
    errors = Errors(requests=len(answers))
    for revision in {a.now.revision for a in answers}:
        used = [a for a in answers if a.now.metric and a.now.source == "filter" and a.now.revision == revision]
        used = [a for a in used if a.now.stamp_s + delay_s + _DIFFERENCE_S <= truth.stamps_s[-1]]
        if len(used) < _LEAST_ANSWERS:
            continue
        seen = np.array([a.T_w_seen[:3, 3] for a in used])
        alignment = umeyama(seen, np.array([truth.at(a.now.seen_s)[:3, 3] for a in used]), AlignmentKind.SE3)
        for answer in used:
            _judge_one(errors, answer, truth, answer.now.stamp_s + delay_s, alignment)
    return errors


def _judge_one(errors: Errors, answer: Request, truth: Truth, at_s: float, alignment: Alignment) -> None:
    now, T_w_seen = answer.now, answer.T_w_seen
    T_true = truth.at(at_s)
    relative = se3.inverse(T_w_seen) @ now.T_w_c
    true = se3.inverse(truth.at(now.seen_s)) @ T_true
    errors.absolute_m.append(float(np.linalg.norm(alignment.points(now.T_w_c[None, :3, 3])[0] - T_true[:3, 3])))
    errors.since_seen_m.append(float(np.linalg.norm(relative[:3, 3] - true[:3, 3])))
    errors.late_m.append(float(np.linalg.norm(true[:3, 3])))
    step = truth.at(at_s + _DIFFERENCE_S)[:3, 3] - truth.at(at_s - _DIFFERENCE_S)[:3, 3]
    velocity = truth.at(now.seen_s)[:3, :3].T @ step / (2.0 * _DIFFERENCE_S)
    errors.velocity_m_s.append(float(np.linalg.norm(T_w_seen[:3, :3].T @ now.velocity_w - velocity)))
    turned = Rotation.from_matrix(relative[:3, :3] @ true[:3, :3].T).as_rotvec()
    error = np.concatenate([T_w_seen[:3, :3] @ (relative[:3, 3] - true[:3, 3]), T_w_seen[:3, :3] @ turned])
    errors.nees.append(float(error @ np.linalg.solve(now.covariance[:6, :6], error)))


def record(folder: Path, course: str, seed: int, speed_m_s: float, seconds: float) -> Path:
    """A slow flight's recording, drawn when it is not there."""
    target = folder / f"{course}-{seed}-{speed_m_s:g}"
    if not (target / "groundtruth.txt").is_file():
        rng = np.random.default_rng(seed)
        world = COURSES[course].world(rng)
        plan = FlightPlan(speed_m_s=speed_m_s)
        flight = COURSES[course].pilot(rng, world, round(seconds * RATE_HZ), rate_hz=RATE_HZ, plan=plan)
        record_flight(target, world, flight, rng, simulated_camera(), None, COURSES[course].faults, seed=seed)
    return target


def simulated_telemetry(truth: Truth, delay_s: float, seed: int, truncated: bool) -> list[TelemetrySample]:
    """A Tello's state messages along a flight."""
    faults = TelemetryFaults(video_delay_s=delay_s)
    rng = np.random.default_rng(seed)
    if not truncated:
        return simulate(rng, truth.stamps_s, truth.T_w_c, camera_on_body(), faults=faults).samples()
    exact = simulate(rng, truth.stamps_s, truth.T_w_c, camera_on_body(), faults=replace(faults, quantise=False))
    return [
        replace(
            s,
            velocity_m_s=np.trunc(10.0 * s.velocity_m_s) / 10.0,
            rpy_rad=np.deg2rad(np.rint(np.rad2deg(s.rpy_rad))),
            tof_m=round(s.tof_m, 2),
            height_m=round(s.height_m, 1),
        )
        for s in exact.samples()
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print median, 95 % and worst of every flight and of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--folder", type=Path, required=True, help="recordings are kept here")
    parser.add_argument("--course", action="append", choices=["room", "corridor"], default=[])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--speed", type=float, default=0.4, help="[m/s]")
    parser.add_argument("--seconds", type=float, default=16.0)
    parser.add_argument("--delay", type=float, default=0.4, help="of the video behind telemetry [s]")
    parser.add_argument("--truncated", action="store_true", help="velocities truncated to whole dm/s, not rounded")
    parser.add_argument("--literal", action="store_true", help="the paper's printed filter beside")
    args = parser.parse_args(arguments)
    config = SlamConfig()
    variants = {"default": config}
    if args.literal:
        variants["literal"] = replace(config, fusion=replace(config.fusion, literal=True))
    totals = {name: Errors() for name in variants}
    for course in args.course or ["room", "corridor"]:
        for seed in range(args.seeds):
            folder = record(args.folder, course, seed, args.speed, args.seconds)
            truth = Truth.of(folder)
            telemetry = simulated_telemetry(truth, args.delay, seed, args.truncated)
            for name, settings in variants.items():
                recording = open_source(folder)
                assert isinstance(recording, Recording)
                errors = judge(ask(recording, telemetry, settings), truth, args.delay)
                totals[name].add(errors)
                sys.stdout.write(errors.line(f"{course} {seed} {name}") + "\n")
                sys.stdout.flush()
    for name, errors in totals.items():
        sys.stdout.write(errors.line(f"all {name}") + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
