"""Whether stated covariances are true: NEES of the present pose and of the log scale over many simulated flights.

No images: vision is the true pose with jitter and a drift that grows with the way, in a map of unknown unit whose scale
wanders while it is young. The drone's own velocities and heights have a scale error each. All these are drawn as large
as the settings of the fusion state them. So fifty flights take minutes, and what is judged is the fusion alone::

    python -m edgeslam_torch.eval.benchmark.consistency --seeds 50
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.snapshot import Present
from edgeslam_torch.eval.benchmark.pose_now import Errors, Request, Truth, judge, simulated_telemetry
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ
from edgeslam_torch.synthetic.flights.flight import FlightPlan
from edgeslam_torch.types import FloatArray, TelemetrySample

JITTER_M, JITTER_RAD = 0.002, 0.001
DRIFT = 0.01
"""Of the way from one frame to the next, as a random walk."""
WANDER = 0.03
"""Change of the log scale while the map's age grows by a factor of e: as in `estimation.scale.joint_scale`."""
_EVERY = 5
"""Frames from one question to the next."""
_SECONDS = 24.0

Telemetry = list[TelemetrySample]


@dataclass(frozen=True, slots=True)
class Seen:
    """What vision makes of a flight; the unit is the one at its end."""

    stamps_s: FloatArray
    T_m_c: FloatArray
    """``(F, 4, 4)`` [map units]."""
    metres_per_unit: float


def see(truth: Truth, seed: int) -> Seen:
    """Jitter, drift, a unit and how it wanders."""
    rng = np.random.default_rng([seed, 1])
    T, n = truth.T_w_c.copy(), len(truth.T_w_c)
    step = np.diff(T[:, :3, 3], axis=0, prepend=T[:1, :3, 3])
    way = np.linalg.norm(step, axis=1)
    aged = np.diff(np.log(1.0 + truth.stamps_s - truth.stamps_s[0]), prepend=0.0)
    wandered = np.cumsum(WANDER * np.sqrt(aged) * rng.standard_normal(n))
    T[:, :3, 3] = T[0, :3, 3] + np.cumsum(step * np.exp(wandered - wandered[-1])[:, None], axis=0)
    T[:, :3, 3] += np.cumsum(DRIFT * way[:, None] * rng.standard_normal((n, 3)), axis=0)
    T[:, :3, 3] += JITTER_M * rng.standard_normal((n, 3))
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(JITTER_RAD * rng.standard_normal((n, 3))).as_matrix()
    unit = float(np.exp(rng.uniform(-0.7, 0.7)))
    T[:, :3, 3] /= unit
    return Seen(truth.stamps_s, T, unit)


def telemetry_with_errors(truth: Truth, config: FusionConfig, seed: int, delay_s: float, truncated: bool) -> Telemetry:
    """State messages of a drone whose velocities and heights have a scale error each."""
    rng = np.random.default_rng([seed, 2])
    velocity, height = (
        simulated_telemetry(_stretched(truth, math.exp(sigma * rng.standard_normal())), delay_s, seed, truncated)
        for sigma in (config.systematic_log, config.height_systematic_log)
    )
    return [
        replace(v, tof_m=h.tof_m, height_m=h.height_m, baro_m=h.baro_m) for v, h in zip(velocity, height, strict=True)
    ]


def _stretched(truth: Truth, factor: float) -> Truth:
    T_w_c = truth.T_w_c.copy()
    T_w_c[:, :3, 3] *= factor
    return Truth(truth.stamps_s, T_w_c)


def ask(fusion: MotionFusion, seen: Seen, telemetry: Sequence[TelemetrySample]) -> list[Request]:
    """The present pose a few times a second, in metres of the true scale."""
    published, answers, sent = OutputFrame(seen.metres_per_unit), [], 0
    for i, (stamp, T) in enumerate(zip(seen.stamps_s.tolist(), seen.T_m_c, strict=True)):
        end = sent
        while end < len(telemetry) and telemetry[end].stamp_s <= stamp:
            end += 1
        fusion.add_telemetry(telemetry[sent:end])
        sent = end
        fusion.add_visual(stamp, T, JITTER_M / seen.metres_per_unit, JITTER_RAD)
        now = Present(fusion.snapshot(), published, True).pose_at(stamp) if i % _EVERY == 0 else None
        if now is not None:
            answers.append(Request(now, published.pose(T)))
    return answers


@dataclass(slots=True)
class Consistency:
    """Of many flights."""

    pose: list[float]
    """Mean NEES of the motion since the last frame, a flight each; 6 degrees of freedom."""
    log_scale: list[float]
    """NEES of the log scale at the end, a flight each; 1 degree."""
    errors: Errors

    def lines(self, name: str) -> str:
        """For the terminal."""
        pose, log_scale = _with_band(self.pose, 6), _with_band(self.log_scale, 1)
        return f"{name}: NEES of the present pose {pose}; of log scale {log_scale}\n{self.errors.line(name)}"


def _with_band(values: list[float], degrees: int) -> str:
    n = len(values) * degrees
    low, high = chdtri(n, 0.975) / len(values), chdtri(n, 0.025) / len(values)
    return f"{np.mean(values):.2f} (95 % band {low:.2f} to {high:.2f}, {len(values)} flights)"


def consistency(config: FusionConfig, seeds: int, *, delay_s: float, speed_m_s: float, truncated: bool) -> Consistency:
    """Fly rooms and corridors in turn."""
    found = Consistency([], [], Errors())
    for seed in range(seeds):
        course = COURSES["room" if seed % 2 == 0 else "corridor"]
        rng = np.random.default_rng(seed)
        plan = FlightPlan(speed_m_s=speed_m_s)
        flight = course.pilot(rng, course.world(rng), round(_SECONDS * RATE_HZ), rate_hz=RATE_HZ, plan=plan)
        truth = Truth(flight.stamps_s, flight.T_w_c)
        telemetry, seen = telemetry_with_errors(truth, config, seed, delay_s, truncated), see(truth, seed)
        fusion = MotionFusion(config, flight.T_b_c)
        errors = judge(ask(fusion, seen, telemetry), truth, delay_s)
        scale = fusion.scale()
        if math.isfinite(scale.sigma):
            off = math.log(scale.value / seen.metres_per_unit) / (scale.sigma / scale.value)
            found.log_scale.append(off**2)
        if errors.nees:
            found.pose.append(float(np.mean(errors.nees)))
        found.errors.add(errors)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print NEES with its band, for the default filter and the printed one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--delay", type=float, default=0.4, help="of the video behind telemetry [s]")
    parser.add_argument("--speed", type=float, default=0.4, help="[m/s]")
    parser.add_argument("--truncated", action="store_true", help="velocities truncated to whole dm/s, not rounded")
    args = parser.parse_args(arguments)
    for name, config in {"default": FusionConfig(), "literal": replace(FusionConfig(), literal=True)}.items():
        found = consistency(config, args.seeds, delay_s=args.delay, speed_m_s=args.speed, truncated=args.truncated)
        sys.stdout.write(found.lines(name) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
