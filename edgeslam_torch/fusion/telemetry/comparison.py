"""Comparison of velocities and attitude with the images, at the current delay and at others."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.scale.log_scale import LogScale
from edgeslam_torch.fusion.telemetry.alignment import map_to_world, turns
from edgeslam_torch.fusion.telemetry.delay import GROWTH, Delay
from edgeslam_torch.fusion.telemetry.plausibility import Agreement, Reading, Reread, Trust, Verdict, agreement
from edgeslam_torch.fusion.telemetry.track import TelemetryTrack, Turn
from edgeslam_torch.fusion.telemetry.visual_memory import Displacements, VisualMemory
from edgeslam_torch.types import FloatArray

_WIDE_DELAYS_S = (-3.0, 3.0)
_WIDE_STEP_S = 0.1
"""Delays beyond the allowed ones are tested if telemetry fits badly: a wrong clock is reported, not used."""
_FIXED_REACH_S = 0.15
"""Tolerance of a configured delay."""
_FITS_WELL = 0.9
_TO_LOOK_ELSEWHERE = 12
"""Moving intervals before other frames and delays are tried."""
_MUCH_LIKELIER = 6.0
"""Log likelihood ratio; half the intervals count as independent."""
_LEAST_TURN_RAD_S = math.radians(2.0)
"""Whole degrees twice a second are noise below."""


@dataclass(frozen=True, slots=True)
class FlightSoFar:
    """Inputs of a comparison."""

    memory: VisualMemory
    track: TelemetryTrack
    R_b_c: FloatArray
    """Camera in the body ``(3, 3)``."""
    rough_scale: float | None
    """Metres per map unit, for what counts as motion."""
    network: LogScale | None = None
    """Scale by the depth network, a witness where velocities and heights contradict each other."""
    network_wander_log: float = 0.0
    """By how much the network's ratio to the map changes from keyframe to keyframe."""


class Comparison:
    """Updates `Trust` with verdicts on velocities and attitude; stores when other delays were last tested."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self._looked_wide_at = 0

    def judge(self, trust: Trust, present: FlightSoFar, delay: Delay, R_w_m: FloatArray, flying: bool = False) -> None:
        """Compare at the delay in use, in other frames and, if that fits badly, at other delays.

        Velocities that fit significantly better in another frame are read in that frame from now on, overriding
        settings and reader. A camera that hardly turns, but leans, goes with velocities in body axes to 80 or 90 % as
        well: a good fit is no proof of the frame. While ``flying`` this is asked as the flight grows, in the end in
        any case.
        """
        now, n = self._velocity(present, delay.value_s, R_w_m), present.memory.count
        grown = not flying or n >= GROWTH * self._looked_wide_at
        look = now.count >= _TO_LOOK_ELSEWHERE and grown
        if look:
            self._looked_wide_at = n
            turn = self._fits_turned(present, now, delay.value_s, R_w_m)
            if turn is not None:
                trust.reread = Reread(turn, now)
                present.track.read_as(turn)
                now = self._velocity(present, delay.value_s, R_w_m)
                trust.forget(Reading.VELOCITY)
        if now.correlation >= _FITS_WELL:
            trust.elsewhere_s = None
        elif look:
            trust.elsewhere_s = self._fits_elsewhere(present, now, delay.value_s)
        trust.judge(Reading.VELOCITY, now)
        attitude = self._attitude(present, delay.value_s)
        if attitude is not None:
            trust.judge(Reading.ATTITUDE, attitude)

    def _fits_turned(self, present: FlightSoFar, now: Agreement, delay_s: float, R_w_m: FloatArray) -> Turn | None:
        """The frame in which the velocities surely fit better than in the one they are read in."""
        best, best_turn = now, None
        for turn in present.track.other_turns:
            other = replace(present, track=present.track.as_if(turn))
            found = self._velocity(other, delay_s, R_w_m)
            if found.correlation > best.correlation:
                best, best_turn = found, turn
        return best_turn if _surely_better(best, now) else None

    def _fits_elsewhere(self, present: FlightSoFar, now: Agreement, used_s: float) -> float | None:
        """The delay at which telemetry surely fits better than now, if that is one which is not allowed."""
        fixed = self._config.delay_s
        low, high = self._config.delay_range_s if fixed is None else (fixed - _FIXED_REACH_S, fixed + _FIXED_REACH_S)
        best, best_s = now, used_s
        for delay_s in np.arange(_WIDE_DELAYS_S[0], _WIDE_DELAYS_S[1] + 1e-9, _WIDE_STEP_S).tolist():
            R = map_to_world(present.memory.sightings(), present.track, delay_s, present.R_b_c)
            found = None if R is None else self._velocity(present, delay_s, R)
            if found is not None and found.count >= now.count // 2 and found.correlation > best.correlation:
                best, best_s = found, delay_s
        return best_s if _surely_better(best, now) and not low <= best_s <= high else None

    def _velocity(self, present: FlightSoFar, delay_s: float, R_w_m: FloatArray) -> Agreement:
        """How velocities go with the images under one delay.

        Without the camera's lever arm: rotations must not count as evidence for velocities.
        """
        track, moved = present.track, _in_common(present, delay_s)
        if len(moved) == 0:
            return Agreement()
        duration = moved.duration_s[:, None]
        told = track.displacement(moved.to_s - delay_s) - track.displacement(moved.from_s - delay_s)
        slow = self._config.min_speed_m_s
        least_seen = math.inf if present.rough_scale is None else 2.0 * slow / present.rough_scale
        return agreement(moved.moved @ R_w_m.T / duration, told / duration, least_seen, slow, early=True)

    def _attitude(self, present: FlightSoFar, delay_s: float) -> Agreement | None:
        """How attitude goes with them; None where there is none."""
        moved = _in_common(present, delay_s)
        if len(moved) == 0 or not present.track.has_attitude:
            return None
        both = turns(moved.on_telemetry_clock(delay_s), present.track, present.R_b_c)
        seen, told = (Rotation.from_matrix(R).as_rotvec() / moved.duration_s[:, None] for R in (both.seen, both.told))
        return agreement(seen, told, _LEAST_TURN_RAD_S, 1.5 * _LEAST_TURN_RAD_S)


def _in_common(present: FlightSoFar, delay_s: float) -> Displacements:
    """Displacements over which there is telemetry; on the video's clock."""
    moved = present.memory.displacements()
    return moved.only(present.track.covered(moved.from_s - delay_s, moved.to_s - delay_s))


def _surely_better(best: Agreement, now: Agreement) -> bool:
    """Whether one reading of the same telemetry is proven, and much likelier than another."""
    left, left_now = (1.0 - max(a.correlation, 0.0) ** 2 for a in (best, now))
    return best.verdict is Verdict.AGREES and 0.25 * now.count * math.log(left_now / max(left, 1e-6)) > _MUCH_LIKELIER
