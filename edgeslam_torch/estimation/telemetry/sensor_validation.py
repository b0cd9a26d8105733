"""Validation of telemetry against the images; telemetry that shows another motion is no evidence for the scale.

The test statistic is the correlation of both over the same half seconds: displacements, rotations, height changes. It
is independent of the scale. `Agreement.needed` has a false acceptance rate of 1 % on unrelated displacements (the best
of fifteen delays); matching telemetry, rounded or truncated like a Tello's, fails it in 1 % of the cases with 12
intervals and never with 24.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.estimation.telemetry.quantisation import Rounding, remainder
from edgeslam_torch.estimation.telemetry.track import Turn
from edgeslam_torch.geometry.robust_statistics import median
from edgeslam_torch.types import FloatArray, IntArray

LEAST_COUNT = 6
_EARLY_COUNT, _EARLY = 4, 0.95
"""Velocities may be accepted with fewer intervals, because before the delay search only one delay is tested. The false
acceptance rate is 0.2 % with four intervals and 0.1 % with five; matching velocities pass with any four intervals in 38
% of the cases, during take-off nearly always."""
_TO_CONTRADICT = 12
"""Number of moving intervals below which a low correlation may be chance."""
_DOUBTFUL = {1: 0.3, 3: 0.5}
"""Correlation below which series of one and of three dimensions contradict each other. Matching series have 0.42
(barometer) and 0.74 (truncated velocities) in the worst 1 %."""
_EVEN = 0.8
"""Uncentred correlation from which on uniform motion explains a low centred one."""
_WINSOR = 3.0
"""Winsorisation limit, in medians of the length."""
_SMALL_SHARE = 0.3
_NOISE_M_S = 0.06
"""Error of one velocity column: truncation in steps of 0.1 m/s."""
_OUTLIER_SIGMAS = 4.0
"""Residual of one interval beyond which it counts no more."""
_MAP_SHARE = 0.15
"""Error of displacements of the map over half a second, as a share of them."""
_PRIOR_LOG_ODDS = math.log(9.0)
"""Log-odds of a column to be right before any motion along its axis."""
SURELY_WRONG = 0.999
"""Probability at which a column contradicts the images: no single interval reaches it."""
_WRONG_GAIN = 10.0
"""Standard deviation of the gain of a column that is frozen or of the wrong sign: it shows nothing."""
_LARGE_QUANTILE = 0.9
"""Intervals shorter than this share of the length at this quantile count as hover."""


class Reading(StrEnum):
    """Telemetry readings that are validated by the images."""

    VELOCITY = "velocities"
    ATTITUDE = "attitude"
    TOF = "tof"
    H = "h"
    BARO = "baro"


HEIGHTS = (Reading.TOF, Reading.H, Reading.BARO)
ATTITUDE = ("roll", "pitch", "yaw")
VELOCITY = ("velocity x", "velocity y", "velocity z")
"""Column names."""


class Verdict(StrEnum):
    """Result of a comparison."""

    OPEN = "open"
    """Too little motion, or inconclusive."""
    AGREES = "agrees"
    CONTRADICTS = "contradicts"


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of two series of the same motion."""

    correlation: float = 0.0
    """0 when one of them has no motion."""
    count: int = 0
    """Moving intervals compared."""
    dimensions: int = 3
    steady: float = 0.0
    """Uncentred correlation: near 1 for uniform motion, which is inconclusive."""
    early: bool = False
    """Whether few intervals may validate it."""
    broken: tuple[str, ...] = ()
    """Columns that contradict the images individually: missing motion, frozen, jumping or of the wrong sign."""
    wrong: tuple[float, ...] = (0.1, 0.1, 0.1)
    """Probability of each velocity column to show another motion, see `wrong_columns`."""

    @property
    def share(self) -> float:
        """Explained share of the variance."""
        return max(self.correlation, 0.0) ** 2

    @property
    def needed(self) -> float:
        """Correlation that unrelated motions rarely reach."""
        if self.early and self.count < LEAST_COUNT:
            return _EARLY
        return 0.6 + 5.4 / (self.dimensions * max(self.count, 1))

    @property
    def verdict(self) -> Verdict:
        """Verdict; both acceptance and rejection need evidence, and one broken column rejects the whole reading."""
        if self.broken:
            return Verdict.CONTRADICTS
        least = _EARLY_COUNT if self.early else LEAST_COUNT
        if self.count >= least and self.correlation >= self.needed:
            return Verdict.AGREES
        doubtful = self.correlation < _DOUBTFUL[self.dimensions] and self.steady < _EVEN
        if self.count >= _TO_CONTRADICT and doubtful:
            return Verdict.CONTRADICTS
        return Verdict.OPEN


def agreement(
    seen: FloatArray, reported: FloatArray, least_seen: float, least_reported: float, early: bool = False
) -> Agreement:
    """Correlate visual and telemetry motion interval by interval.

    Args:
        seen: ``(N, 1)`` or ``(N, 3)``, in any unit.
        reported: The same shape, in any unit.
        least_seen: Length below which ``seen`` is noise; infinite if unknown.
        least_reported: The same of ``reported``.
        early: Whether few intervals may validate an agreement.

    Returns:
        The winsorised correlation about the mean over the intervals in which either moves. A common bias or uniform
        motion does not contribute.
    """
    moving = _moving(seen, least_seen) | (np.linalg.norm(reported, axis=1) > least_reported)
    count, dimensions = int(moving.sum()), seen.shape[1]
    if count < 2:
        return Agreement(0.0, count, dimensions, early=early)
    x, y = _tamed(seen[moving]), _tamed(reported[moving])
    varying = _correlation(x - x.mean(axis=0), y - y.mean(axis=0))
    return Agreement(varying, count, dimensions, _correlation(x, y), early)


def wrong_columns(seen: FloatArray, reported: FloatArray, step_m_s: float) -> tuple[float, ...]:
    """Probability of each velocity column to show another motion, as `Agreement.wrong`.

    A column is right, of the wrong sign, frozen, or a motion of the same size that is not the camera's. Motion along
    one axis validates the readings as a whole, but shows nothing about the other columns; nor does motion below the
    quantisation step, which is reported as zero.

    Args:
        seen: By the images ``(N, 3)`` [map units/s], axes of the columns.
        reported: By telemetry ``(N, 3)`` [m/s].
        step_m_s: Quantisation step of the columns.
    """
    expected = _ratio(seen, reported) * seen
    noise = _NOISE_M_S**2 + _MAP_SHARE**2 * np.sum(reported**2, axis=1, keepdims=True)
    power = np.maximum(np.mean(reported**2, axis=0), np.mean(expected**2, axis=0))

    def cost(predicted: FloatArray, variance: FloatArray) -> FloatArray:
        residual = np.minimum((reported - predicted) ** 2 / variance, _OUTLIER_SIGMAS**2)
        return np.asarray(np.sum(residual + np.log(variance), axis=0))

    lost = [step_m_s * remainder(expected / step_m_s, rounding) for rounding in Rounding]
    right = np.min([cost(expected - part, noise) for part in lost], axis=0)
    turned = np.min([cost(part - expected, noise) for part in lost], axis=0)
    others = turned, cost(reported.mean(axis=0), noise), cost(expected, noise + power)
    log_odds = _PRIOR_LOG_ODDS + 0.5 * (np.min(others, axis=0) - right)
    return tuple((0.5 - 0.5 * np.tanh(0.5 * log_odds)).tolist())


def _ratio(seen: FloatArray, reported: FloatArray) -> float:
    """Metres per map unit by velocities of both; at least 0."""
    return max(float(np.sum(reported * seen)) / max(float(np.sum(seen**2)), 1e-30), 0.0)


def _moving(x: FloatArray, least: float) -> NDArray[np.bool_]:
    """Intervals above the noise and not short compared with the long ones, where map errors dominate."""
    length = np.linalg.norm(x, axis=1)
    large = float(np.quantile(length, _LARGE_QUANTILE)) if len(length) else 0.0
    return np.asarray(length > max(least, _SMALL_SHARE * large))


def _tamed(x: FloatArray) -> FloatArray:
    """Lengths winsorised at three times the median."""
    length = np.linalg.norm(x, axis=1)
    moved = length[length > 0]
    if len(moved) == 0:
        return x
    return np.asarray(x * np.minimum(1.0, _WINSOR * median(moved) / np.maximum(length, 1e-12))[:, None])


def _correlation(x: FloatArray, y: FloatArray) -> float:
    """Correlation of all axes as one series; 0 when either is zero."""
    power = float(np.sum(x**2)) * float(np.sum(y**2))
    return float(np.sum(x * y)) / math.sqrt(power) if power > 1e-24 else 0.0


@dataclass(frozen=True, slots=True)
class Reread:
    """Velocities are interpreted in another frame than configured."""

    turn: Turn
    before: Agreement
    """Agreement in the configured frame."""

    def warning(self, now: Agreement | None) -> str:
        """The reinterpretation and its reason."""
        frame = {
            Turn.AS_READ: "as they were given",
            Turn.FROM_BODY: "in body axes",
            Turn.FROM_LEANING_BODY: "in body axes, its lean included",
            Turn.BACK: "in the world of power-on, without the turn by yaw that they were given",
        }[self.turn]
        share = "" if now is None else f" ({100 * now.share:.0f} % of the motion explained, "
        share += "" if now is None else f"{100 * self.before.share:.0f} % before)"
        return f"telemetry's velocities fit the images only {frame}{share}, and are read so"


class SensorGate:
    """Verdicts on a flight's readings, each kept until contradicted."""

    def __init__(self) -> None:
        self.latest: dict[Reading, Agreement] = {}
        self.elsewhere_s: float | None = None
        """Best-fitting video delay if it is outside the allowed range."""
        self.tells_scale = True
        """Whether velocities could be fitted to the displacements."""
        self.reread: Reread | None = None
        """Set when velocities are interpreted in another frame than configured."""
        self._verdicts: dict[Reading, Verdict] = {}

    def judge(self, reading: Reading, found: Agreement) -> None:
        """Update with the newest comparison of one reading."""
        self.latest[reading] = found
        if found.verdict is not Verdict.OPEN:
            self._verdicts[reading] = found.verdict

    def forget(self, reading: Reading) -> None:
        """Reset the verdict on a reading whose interpretation has changed."""
        self._verdicts.pop(reading, None)

    def verdict(self, reading: Reading) -> Verdict:
        """Current verdict on a reading."""
        return self._verdicts.get(reading, Verdict.OPEN)

    @property
    def velocity(self) -> bool:
        """Whether velocities may determine the scale: only after validation.

        They share a message with the attitude, which also rotates the map into their frame: if that contradicts the
        images, an agreement of velocities is chance.
        """
        if self.elsewhere_s is not None or self.verdict(Reading.ATTITUDE) is Verdict.CONTRADICTS:
            return False
        return self.verdict(Reading.VELOCITY) is Verdict.AGREES

    @property
    def gain_sigma(self) -> tuple[float, ...]:
        """Relative standard deviation of each velocity column."""
        latest = self.latest.get(Reading.VELOCITY, Agreement())
        return tuple(_WRONG_GAIN * math.sqrt(share) for share in latest.wrong)

    @property
    def attitude(self) -> bool:
        """Whether attitude may level the map: from the first frame on, until the images contradict it."""
        return self.elsewhere_s is None and self.verdict(Reading.ATTITUDE) is not Verdict.CONTRADICTS

    @property
    def turns(self) -> bool:
        """Whether attitude may constrain rotations: only after validation."""
        return self.elsewhere_s is None and self.verdict(Reading.ATTITUDE) is Verdict.AGREES

    def height(self, reading: Reading) -> bool:
        """Whether a height is usable: it needs the vertical, and its own validation if no other reading is validated.
        One that sinks while the images climb is not used, although few changes are no proof."""
        attitude, own = self.verdict(Reading.ATTITUDE), self.verdict(reading)
        if self.elsewhere_s is not None or attitude is Verdict.CONTRADICTS:
            return False
        opposite = self.latest.get(reading, Agreement()).correlation < 0.0
        vouched = self.velocity or attitude is Verdict.AGREES
        return own is Verdict.AGREES or (own is Verdict.OPEN and vouched and not opposite)

    @property
    def motion(self) -> bool:
        """Whether telemetry may predict the pose without images: not contradicted."""
        moved = (Reading.VELOCITY, Reading.ATTITUDE)
        return self.elsewhere_s is None and not any(self.verdict(r) is Verdict.CONTRADICTS for r in moved)

    def warnings(self) -> list[str]:
        """Rejected readings with reasons."""
        if self.elsewhere_s is not None:
            late = "late" if self.elsewhere_s < 0 else "early"
            return [
                f"telemetry is not used: it fits the images if its stamps are {abs(self.elsewhere_s):.1f} s {late}, "
                "which fusion.delay_range_s (or delay_s) excludes"
            ]
        velocity = self.latest.get(Reading.VELOCITY)
        said = [] if self.reread is None else [self.reread.warning(velocity)]
        attitude = self.latest.get(Reading.ATTITUDE)
        if attitude is not None and self.verdict(Reading.ATTITUDE) is Verdict.CONTRADICTS:
            said.append(f"telemetry's velocities are not used, nor its heights and attitude: {_deviation(attitude)}")
        elif velocity is not None and not self.velocity:
            said.append(f"telemetry's velocities are not used: {_why(velocity, 'motion')}")
        if velocity is not None and self.velocity and not self.tells_scale and velocity.count >= _TO_CONTRADICT:
            said.append(
                f"telemetry's velocities fit the images too badly to determine a scale ({100 * velocity.share:.0f} % "
                "of the motion explained) and are not used"
            )
        for reading in HEIGHTS:
            height = self.latest.get(reading)
            if height is not None and self.verdict(reading) is Verdict.CONTRADICTS:
                said.append(f"telemetry's height ({reading}) is not used: {_why(height, 'climbing and sinking')}")
        return said


def _deviation(found: Agreement) -> str:
    """Size of the deviation between attitude and images."""
    if not found.broken:
        return f"roll, pitch and yaw explain {100 * found.share:.0f} % of the turns in the images"
    return f"{', '.join(found.broken)}: differs from the rotation in the images (frozen, jumping, of the wrong sign?)"


def _why(found: Agreement, motion: str) -> str:
    if found.broken:
        return f"{', '.join(found.broken)}: differs from the motion in the images (frozen, jumping, of the wrong sign?)"
    if found.count < (_EARLY_COUNT if found.early else LEAST_COUNT):
        return f"too little {motion} in common with the images to compare"
    if found.steady >= _EVEN and found.correlation < _DOUBTFUL[found.dimensions]:
        return f"the {motion} is too even to compare it with the images"
    chance = f" (chance reaches {100 * found.needed**2:.0f} %)" if found.needed < 1.0 else ""
    return f"{100 * found.share:.0f} % of the {motion} in the images explained{chance}"


def changes(x: FloatArray, stamps_s: FloatArray, segment: IntArray, over_s: float) -> FloatArray:
    """Changes of bin means over ``over_s``, between every second bin, within a segment.

    Args:
        x: ``(N, K)``.
        stamps_s: ``(N,)`` increasing.
        segment: Segment number from `floor_segments`, ``(N,)``.
        over_s: Length of a bin.

    Returns:
        ``(M, K)``; the rows depend on stamps and segments only, so that the rows of two calls correspond.
    """
    slot = ((stamps_s - stamps_s[0]) // over_s).astype(np.int64) if len(stamps_s) else np.zeros(0, np.int64)
    key, group = np.unique(np.stack([segment, slot]), axis=1, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group, minlength=key.shape[1])
    mean = np.stack([np.bincount(group, column) / np.maximum(count, 1) for column in x.T], axis=1)
    place = {(int(s), int(b)): i for i, (s, b) in enumerate(key.T)}
    pairs = [(i, place[s, b + 2]) for (s, b), i in place.items() if (s, b + 2) in place]
    if not pairs:
        return np.zeros((0, x.shape[1]))
    first, last = np.array(pairs).T
    return np.asarray(mean[last] - mean[first])
