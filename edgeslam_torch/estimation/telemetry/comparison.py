"""Comparison of velocities and attitude with the images, at the current delay and at others."""

import math
from dataclasses import replace

import numpy as np

from edgeslam_torch.estimation.config import MIN_SPEED_M_S
from edgeslam_torch.estimation.telemetry.alignment import (
    Attitudes,
    attitude_deviation,
    attitudes,
    camera_moved,
    in_common,
    map_to_world,
    turns,
)
from edgeslam_torch.estimation.telemetry.delay import GROWTH, Delay
from edgeslam_torch.estimation.telemetry.remembered import Remembered
from edgeslam_torch.estimation.telemetry.sensor_validation import (
    ATTITUDE,
    SURELY_WRONG,
    VELOCITY,
    Agreement,
    Reading,
    Reread,
    Verdict,
    agreement,
    wrong_columns,
)
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack, Turn
from edgeslam_torch.geometry.rotations import vectors_from_matrices
from edgeslam_torch.noise import MOUNT_RAD
from edgeslam_torch.types import FloatArray

_WIDE_DELAYS_S = (-3.0, 3.0)
_WIDE_STEP_S = 0.1
"""Delays beyond the allowed range are tested if telemetry fits badly: a wrong clock is reported, not used."""
_FIXED_REACH_S = 0.15
"""Tolerance of a configured delay."""
_FITS_WELL = 0.9
_TO_LOOK_ELSEWHERE = 12
"""Minimum number of moving intervals before other frames and delays are tested."""
_MUCH_LIKELIER = 6.0
"""Minimum log-likelihood ratio; half the intervals count as independent."""
_LEAST_TURN_RAD_S = math.radians(2.0)
"""Minimum rotation rate: whole degrees twice a second are noise below."""
_FEW_ATTITUDES = 15
"""Minimum number of frames for validating attitude: a second and a half."""
_DEVIATION_SHARE, _DEVIATION_RAD, MAX_DEVIATION_RAD = 0.5, math.radians(2.0), math.radians(6.0)
"""Maximum RMS deviation between attitude and images about an axis: a share of the rotation about it, within bounds.
Correct attitude (whole degrees, mount off by 7 degrees) deviates by 0.3 to 1 degree; a frozen column by the whole
rotation, a sign error by twice that."""
_DELAY_STEP_S = 0.1


class Comparison:
    """Updates `SensorGate` with verdicts on velocities and attitude; records when other delays were last tested."""

    def __init__(self, flight: Remembered) -> None:
        self._flight = flight
        self._looked_wide_at = 0
        self._T_b_c: FloatArray = np.eye(4)
        self._least_seen = math.inf
        """Speed [map units/s] above which the images show motion."""

    def judge(self, T_b_c: FloatArray, R_w_m: FloatArray, rough_scale: float | None, flying: bool = False) -> None:
        """Compare at the current delay, in other frames and, if the fit is poor, at other delays.

        Velocities that fit significantly better in another frame are interpreted in that frame from now on, overriding
        settings and reader. A good fit does not prove the frame: a camera that leans without turning correlates by 80
        to 90 % with velocities in body axes. While ``flying`` the tests are repeated only as data grow.

        Args:
            T_b_c: Camera in the body ``(4, 4)`` [m].
            R_w_m: Map axes to the power-on world ``(3, 3)``.
            rough_scale: Metres per map unit, for what counts as motion.
            flying: Whether the flight goes on.
        """
        self._T_b_c = T_b_c
        self._least_seen = math.inf if rough_scale is None else 2.0 * MIN_SPEED_M_S / rough_scale
        flight = self._flight
        trust, track, delay = flight.trust, flight.track, flight.delay.delay
        attitude = self._attitude(delay)
        if attitude is not None:
            trust.judge(Reading.ATTITUDE, attitude)
        now, n = self._velocity(track, delay.value_s, R_w_m), flight.memory.count
        grown = not flying or n >= GROWTH * self._looked_wide_at
        look = now.count >= _TO_LOOK_ELSEWHERE and grown
        if look:
            self._looked_wide_at = n
            turn = self._fits_turned(now, delay.value_s, R_w_m) if trust.attitude else None
            if turn is not None:
                trust.reread = Reread(turn, now)
                track.read_as(turn)
                now = self._velocity(track, delay.value_s, R_w_m)
                trust.forget(Reading.VELOCITY)
        if not math.isfinite(delay.sigma_s):  # at a wrong delay every column shows another motion
            now = replace(now, broken=())
        if now.correlation >= _FITS_WELL:
            trust.elsewhere_s = None
        elif look:
            trust.elsewhere_s = self._fits_elsewhere(now, delay.value_s)
        trust.judge(Reading.VELOCITY, now)

    def _fits_turned(self, now: Agreement, delay_s: float, R_w_m: FloatArray) -> Turn | None:
        """The velocity frame that fits significantly better than the current one, if any."""
        best, best_turn = now, None
        for turn in self._flight.track.other_turns:
            found = self._velocity(self._flight.track.as_if(turn), delay_s, R_w_m)
            if found.correlation > best.correlation:
                best, best_turn = found, turn
        return best_turn if _surely_better(best, now) else None

    def _fits_elsewhere(self, now: Agreement, used_s: float) -> float | None:
        """The best-fitting delay, if it is significantly better than the current one and not allowed."""
        config, track = self._flight.config, self._flight.track
        fixed = config.delay_s
        low, high = config.delay_range_s if fixed is None else (fixed - _FIXED_REACH_S, fixed + _FIXED_REACH_S)
        best, best_s = now, used_s
        for delay_s in np.arange(_WIDE_DELAYS_S[0], _WIDE_DELAYS_S[1] + 1e-9, _WIDE_STEP_S).tolist():
            R = map_to_world(self._flight.memory.sightings(), track, delay_s, self._T_b_c[:3, :3])
            found = None if R is None else self._velocity(track, delay_s, R)
            if found is not None and found.count >= now.count // 2 and found.correlation > best.correlation:
                best, best_s = found, delay_s
        return best_s if _surely_better(best, now) and not low <= best_s <= high else None

    def _velocity(self, track: TelemetryTrack, delay_s: float, R_w_m: FloatArray) -> Agreement:
        """Agreement of velocities with the images at one delay.

        The camera's lever arm is left out of the correlation, for which rotations must not count as evidence.
        """
        moved = in_common(self._flight.memory.displacements(), track, delay_s)
        if len(moved) == 0:
            return Agreement()
        duration = moved.duration_s[:, None]
        reported, at_camera = (camera_moved(moved, track, arm) for arm in (np.zeros(3), self._T_b_c[:3, 3]))
        seen, reported = moved.moved @ R_w_m.T / duration, reported / duration
        found = agreement(seen, reported, self._least_seen, MIN_SPEED_M_S, early=True)
        R_w = track.axes()[np.searchsorted(track.readings.stamp_s, 0.5 * (moved.from_s + moved.to_s))]
        seen_b, reported_b = (np.einsum("nwa,nw->na", R_w, v) for v in (seen, at_camera / duration))
        wrong = wrong_columns(seen_b, reported_b, self._flight.config.velocity_step_m_s)
        broken = tuple(name for name, share in zip(VELOCITY, wrong, strict=True) if share > SURELY_WRONG)
        return replace(found, broken=broken, wrong=wrong)

    def _attitude(self, delay: Delay) -> Agreement | None:
        """Agreement of attitude with the images; None without common intervals."""
        track = self._flight.track
        moved = in_common(self._flight.memory.displacements(), track, delay.value_s)
        if len(moved) == 0:
            return None
        both = turns(moved, track, self._T_b_c[:3, :3])
        seen, reported = (vectors_from_matrices(R) / moved.duration_s[:, None] for R in (both.seen, both.reported))
        found = agreement(seen, reported, _LEAST_TURN_RAD_S, 1.5 * _LEAST_TURN_RAD_S)
        return replace(found, broken=self._broken_attitude(delay))

    def _broken_attitude(self, delay: Delay) -> tuple[str, ...]:
        """Attitude columns that contradict the images at the known delay, or at all possible ones."""
        known, flight = math.isfinite(delay.sigma_s), self._flight
        low, high = flight.config.delay_range_s
        delays_s = [delay.value_s] if known else np.arange(low, high + 1e-9, _DELAY_STEP_S).tolist()
        ratios, seen = [], flight.memory.newest()
        for delay_s in delays_s:
            reported = attitudes(seen, flight.track, delay_s)
            if reported is not None and len(reported.stamp_s) >= _FEW_ATTITUDES:
                ratios.append(
                    self._relative_deviation(reported, self._T_b_c[:3, :3], delay.sigma_s if known else _DELAY_STEP_S)
                )
        if not ratios:
            return ()
        best = min(ratios, key=max)
        return tuple(name for name, ratio in zip(ATTITUDE, best.tolist(), strict=True) if ratio > 1.0)

    def _relative_deviation(self, reported: Attitudes, R_b_c: FloatArray, delay_sigma_s: float) -> FloatArray:
        """Deviation about each axis relative to the allowed one ``(3,)``."""
        found = attitude_deviation(reported, R_b_c, MOUNT_RAD)
        share = np.clip(_DEVIATION_SHARE * found.seen, _DEVIATION_RAD, MAX_DEVIATION_RAD)
        late = delay_sigma_s * found.rate
        return np.maximum(found.rms / np.hypot(share, late), found.lately / np.hypot(MAX_DEVIATION_RAD, 2.0 * late))


def _surely_better(best: Agreement, now: Agreement) -> bool:
    """Whether one interpretation of the same telemetry is validated and significantly more likely."""
    left, left_now = (1.0 - max(a.correlation, 0.0) ** 2 for a in (best, now))
    return best.verdict is Verdict.AGREES and 0.25 * now.count * math.log(left_now / max(left, 1e-6)) > _MUCH_LIKELIER
