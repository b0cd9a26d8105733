"""Whether telemetry and images show the same motion; telemetry that disagrees is no evidence for the scale.

The test is the correlation of what both say of the same half seconds: displacements, turns, changes of height. It needs
no scale. How much is needed was measured: displacements of six recordings and two real flights against those of another
one, or of another time, each at the best of fifteen delays, reach the limit of `Agreement.needed` in 1 % of the cases;
right telemetry, rounded or truncated like a Tello's, stays below in 1 % with 12 intervals, never with 24.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.fusion.scale.windowed_scale import Parted
from edgeslam_torch.fusion.telemetry.track import Turn
from edgeslam_torch.geometry.robust_statistics import median
from edgeslam_torch.types import FloatArray, IntArray

LEAST_COUNT = 6
_EARLY_COUNT, _EARLY = 4, 0.95
"""Velocities may agree with fewer intervals: before the delay is searched there is one delay to be lucky with. Of 1764
pairs of unrelated displacements (five recordings, twelve simulated and two real flights) 0.2 % reach this with four
intervals and 0.1 % with five; right ones, of any four intervals, in 38 %, in a take-off nearly always."""
_TO_CONTRADICT = 12
"""Moving intervals below which a low correlation may be chance."""
_DOUBTFUL = {1: 0.3, 3: 0.5}
"""Correlation below which series of one and of three dimensions contradict each other. Right ones have 0.74 (velocities
truncated) and 0.42 (barometer) in the worst 1 %."""
_EVEN = 0.8
"""Correlation with the means left in, from which on an even motion explains a low correlation without them."""
_WINSOR = 3.0
"""Times the median at which lengths are cut off."""
_SMALL_SHARE = 0.3
_KEPT = 0.9
"""Share of the intervals that must fit."""
_LEFT_OVER, _LEFT_OVER_M_S = 0.5, 0.06
"""What may be left over of one velocity (root mean square): a share of the speed along its axis, and what truncation to
steps of 0.1 m/s leaves [m/s]. Right ones of eight recordings stay below both."""
_LARGE_QUANTILE = 0.9
"""Intervals shorter than this share of the long ones (the length at this quantile) count as standing still."""


class Reading(StrEnum):
    """What telemetry tells that the images can be asked about."""

    VELOCITY = "velocities"
    ATTITUDE = "attitude"
    TOF = "tof"
    H = "h"
    BARO = "baro"


HEIGHTS = (Reading.TOF, Reading.H, Reading.BARO)
ATTITUDE = ("roll", "pitch", "yaw")
VELOCITY = ("velocity x", "velocity y", "velocity z")
"""Names of the columns."""


class Verdict(StrEnum):
    """What a comparison says."""

    OPEN = "open"
    """Too little motion, or undecided."""
    AGREES = "agrees"
    CONTRADICTS = "contradicts"


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of two series of the same motion."""

    correlation: float = 0.0
    """0 when one of them does not move."""
    count: int = 0
    """Moving intervals compared."""
    dimensions: int = 3
    steady: float = 0.0
    """The same with the means left in: near 1 for an even motion, which proves nothing and contradicts nothing."""
    early: bool = False
    """Whether few intervals may prove it."""
    broken: tuple[str, ...] = ()
    """Columns that on their own contradict the images: missing motion, frozen, jumping or of the wrong sign."""

    @property
    def share(self) -> float:
        """Share of the one's variance that the other explains."""
        return max(self.correlation, 0.0) ** 2

    @property
    def needed(self) -> float:
        """Correlation that unrelated motions hardly reach."""
        if self.early and self.count < LEAST_COUNT:
            return _EARLY
        return 0.6 + 5.4 / (self.dimensions * max(self.count, 1))

    @property
    def verdict(self) -> Verdict:
        """Agreement has to be proven, and so has contradiction; one broken column spoils the whole."""
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
    seen: FloatArray, told: FloatArray, least_seen: float, least_told: float, early: bool = False
) -> Agreement:
    """Compare what the images say with what telemetry says, interval by interval.

    Args:
        seen: ``(N, 1)`` or ``(N, 3)``, in any unit.
        told: The same shape, in any unit.
        least_seen: Length below which ``seen`` is noise; infinite if unknown.
        least_told: The same of ``told``.
        early: Whether few intervals may prove an agreement.

    Returns:
        The correlation about the mean (a bias or an even flight proves nothing) over the intervals in which one of them
        moves; lone wild readings do not count in full.
    """
    moving = _moving(seen, least_seen) | (np.linalg.norm(told, axis=1) > least_told)
    count, dimensions = int(moving.sum()), seen.shape[1]
    if count < 2:
        return Agreement(0.0, count, dimensions, early=early)
    x, y = _tamed(seen[moving]), _tamed(told[moving])
    varying = _correlation(x - x.mean(axis=0), y - y.mean(axis=0))
    return Agreement(varying, count, dimensions, _correlation(x, y), early)


def broken_columns(seen: FloatArray, told: FloatArray) -> tuple[str, ...]:
    """Velocities that contradict the images each on its own.

    Args:
        seen: By the images ``(N, 3)`` [map units/s], axes of the columns.
        told: By telemetry ``(N, 3)`` [m/s].

    Returns:
        Names of those that leave over more than right ones do, whatever a map unit is; the worst intervals are left
        out. A mean counts: a velocity that froze differs from the images by it.
    """
    if len(seen) < _TO_CONTRADICT:
        return ()
    scale = max(float(np.sum(told * seen)) / max(float(np.sum(seen**2)), 1e-30), 0.0)
    left = np.abs(told - scale * seen)
    kept = np.sort(left, axis=0)[: int(_KEPT * len(left))]
    speed = np.sqrt(np.maximum(np.mean(told**2, axis=0), scale**2 * np.mean(seen**2, axis=0)))
    apart = np.sqrt(np.mean(kept**2, axis=0)) > np.maximum(_LEFT_OVER * speed, _LEFT_OVER_M_S)
    return tuple(name for name, is_apart in zip(VELOCITY, apart.tolist(), strict=True) if is_apart)


def _moving(x: FloatArray, least: float) -> NDArray[np.bool_]:
    """Intervals longer than noise, and not small beside the long ones: in those even a right map is mostly noise."""
    length = np.linalg.norm(x, axis=1)
    large = float(np.quantile(length, _LARGE_QUANTILE)) if len(length) else 0.0
    return np.asarray(length > max(least, _SMALL_SHARE * large))


def _tamed(x: FloatArray) -> FloatArray:
    """Winsorised at three times the median, against outliers."""
    length = np.linalg.norm(x, axis=1)
    moved = length[length > 0]
    if len(moved) == 0:
        return x
    return np.asarray(x * np.minimum(1.0, _WINSOR * median(moved) / np.maximum(length, 1e-12))[:, None])


def _correlation(x: FloatArray, y: FloatArray) -> float:
    """All axes as one series; 0 when one of them is nothing."""
    power = float(np.sum(x**2)) * float(np.sum(y**2))
    return float(np.sum(x * y)) / math.sqrt(power) if power > 1e-24 else 0.0


@dataclass(frozen=True, slots=True)
class AtOdds:
    """Scales [metres per map unit] that cannot both be right."""

    by_velocity: float
    by_height: float
    kept: str | None
    """``telemetry`` (velocities) or ``height``, whichever the depth network confirms; None when it confirms neither."""

    def warning(self) -> str:
        """Warning about what is not used."""
        said = (
            f"telemetry's velocities and heights contradict each other, {self.by_velocity:.3g} and "
            f"{self.by_height:.3g} m per map unit"
        )
        if self.kept is None:
            return f"{said}, and neither is used: are the velocities in the right unit?"
        if self.kept == "height":
            return f"{said}; the depth network confirms the heights, so the velocities are not used: the wrong unit?"
        return f"{said}; the depth network confirms the velocities, so the heights are not used"


@dataclass(frozen=True, slots=True)
class Reread:
    """Velocities are read in another frame than the settings and the reader of the log say."""

    turn: Turn
    before: Agreement
    """How they went with the images as they had been read."""

    def warning(self, now: Agreement | None) -> str:
        """What is done, and why."""
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
        """Video delay at which telemetry fits the images, when that is none of the delays allowed."""
        self.at_odds: AtOdds | None = None
        """Scales by velocities and by height where these cannot both be right."""
        self.parted: Parted | None = None
        """Set while the last seconds leave no room for the scale of the flight before."""
        self.tells_scale = True
        """Whether velocities that may tell the scale could be fitted to the images."""
        self.reread: Reread | None = None
        """Set when velocities are read in another frame than they were given in."""
        self._verdicts: dict[Reading, Verdict] = {}

    def judge(self, reading: Reading, found: Agreement) -> None:
        """Take in the newest comparison of one reading."""
        self.latest[reading] = found
        if found.verdict is not Verdict.OPEN:
            self._verdicts[reading] = found.verdict

    def forget(self, reading: Reading) -> None:
        """Begin anew with a reading that is read in another way."""
        self._verdicts.pop(reading, None)

    def verdict(self, reading: Reading) -> Verdict:
        """What is known of a reading."""
        return self._verdicts.get(reading, Verdict.OPEN)

    @property
    def velocity(self) -> bool:
        """Whether velocities may tell the scale: only once they have proven to be of this flight.

        They come in one message with the attitude, which also turns the map towards them: where that contradicts the
        images their agreement is chance.
        """
        if self.elsewhere_s is not None or self.verdict(Reading.ATTITUDE) is Verdict.CONTRADICTS:
            return False
        return self.verdict(Reading.VELOCITY) is Verdict.AGREES

    @property
    def attitude(self) -> bool:
        """Whether attitude may keep the map level: from the first frame on, until the images contradict it."""
        return self.elsewhere_s is None and self.verdict(Reading.ATTITUDE) is not Verdict.CONTRADICTS

    @property
    def turns(self) -> bool:
        """Whether attitude may say that the camera has not turned: it has turned with the images before."""
        return self.elsewhere_s is None and self.verdict(Reading.ATTITUDE) is Verdict.AGREES

    @property
    def proven(self) -> bool:
        """Whether anything has proven that telemetry is of this flight, and nothing that it is not."""
        readings = (Reading.VELOCITY, Reading.ATTITUDE, *HEIGHTS)
        return self.motion and any(self.verdict(r) is Verdict.AGREES for r in readings)

    def height(self, reading: Reading) -> bool:
        """Whether a height may: it needs the vertical, and its own evidence if nothing else confirms the flight."""
        attitude, own = self.verdict(Reading.ATTITUDE), self.verdict(reading)
        if self.elsewhere_s is not None or attitude is Verdict.CONTRADICTS:
            return False
        return own is Verdict.AGREES or (own is Verdict.OPEN and (self.velocity or attitude is Verdict.AGREES))

    def supposing_heights(self) -> "SensorGate":
        """The same with heights taken for this flight's while nothing speaks for or against them."""
        supposed = SensorGate()
        supposed.latest, supposed.elsewhere_s = dict(self.latest), self.elsewhere_s
        supposed._verdicts = dict(self._verdicts)
        for reading in HEIGHTS:
            supposed._verdicts.setdefault(reading, Verdict.AGREES)
        return supposed

    @property
    def motion(self) -> bool:
        """Whether telemetry may predict the pose without images: not contradicted."""
        moved = (Reading.VELOCITY, Reading.ATTITUDE)
        return self.elsewhere_s is None and not any(self.verdict(r) is Verdict.CONTRADICTS for r in moved)

    def warnings(self) -> list[str]:
        """What is not used, and why, in sentences."""
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
            said.append(f"telemetry's velocities are not used, nor its heights and attitude: {_apart(attitude)}")
        elif velocity is not None and not self.velocity:
            said.append(f"telemetry's velocities are not used: {_why(velocity, 'motion')}")
        if velocity is not None and self.velocity and not self.tells_scale and velocity.count >= _TO_CONTRADICT:
            said.append(
                f"telemetry's velocities fit the images too badly to tell a scale ({100 * velocity.share:.0f} % of the "
                "motion explained) and are not used"
            )
        for reading in HEIGHTS:
            height = self.latest.get(reading)
            if height is not None and self.verdict(reading) is Verdict.CONTRADICTS:
                said.append(f"telemetry's height ({reading}) is not used: {_why(height, 'climbing and sinking')}")
        if self.at_odds is not None:
            said.append(self.at_odds.warning())
        if self.parted is not None:
            said.append(self.parted.warning())
        return said


def _apart(found: Agreement) -> str:
    """How far from the images attitude is."""
    if not found.broken:
        return f"roll, pitch and yaw explain {100 * found.share:.0f} % of the turns in the images"
    return f"{', '.join(found.broken)}: other turns than in the images (frozen, jumping, of the wrong sign?)"


def _why(found: Agreement, motion: str) -> str:
    if found.broken:
        return f"{', '.join(found.broken)}: another motion than in the images (frozen, jumping, of the wrong sign?)"
    if found.count < (_EARLY_COUNT if found.early else LEAST_COUNT):
        return f"too little {motion} in common with the images to compare"
    if found.steady >= _EVEN and found.correlation < _DOUBTFUL[found.dimensions]:
        return f"the {motion} is too even to compare it with the images"
    chance = f" (chance reaches {100 * found.needed**2:.0f} %)" if found.needed < 1.0 else ""
    return f"{100 * found.share:.0f} % of the {motion} in the images explained{chance}"


def changes(x: FloatArray, stamps_s: FloatArray, segment: IntArray, over_s: float) -> FloatArray:
    """Changes of means over ``over_s``, from one bin to the next but one, within a segment.

    Args:
        x: ``(N, K)``.
        stamps_s: ``(N,)`` increasing.
        segment: Number of the stretch, from `floor_segments`, ``(N,)``.
        over_s: Length of a bin.

    Returns:
        ``(M, K)``; the rows do not depend on ``x``, so that two calls give partners.
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
