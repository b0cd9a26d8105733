"""Figures of runs: how they are printed, and which difference of two sets of runs is more than noise.

Two medians differ by chance by ``2 sqrt(s_a^2/n_a + s_b^2/n_b)``, with ``s`` the sample standard deviation over the
seeds, and never by less than a figure's floor, for what one record cannot see of itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SIGMAS = 2.0


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a run."""

    name: str
    """Among the run's figures."""
    title: str
    text: str = "{:.4f}"
    factor: float = 1.0
    """On the value, before it is printed."""
    spread: bool = False
    """Of several runs, print the lowest and the highest too."""
    floor: float | None = None
    """Difference below which two medians count as equal; None is not compared."""
    one_seed: float | None = None
    """The same for a single run, whose scatter is not known; `floor` when None."""
    relative: bool = True
    """Whether the floors are shares of the first median."""
    lower_is_better: bool = True
    clock: str = ""
    """Which time of the reference work it follows (`machine_speed.reference`); empty when it is no time."""

    def cell(self, values: Sequence[float | None], none: str = "-") -> str:
        """Median of several runs' values."""
        known = self.factor * np.array([v for v in values if v is not None and np.isfinite(v)])
        if len(known) == 0:
            return none
        text = self.text.format(float(np.median(known)))
        if self.spread and len(known) > 1:
            text += f" [{self.text.format(known.min())} {self.text.format(known.max())}]"
        return text


@dataclass(frozen=True, slots=True)
class Difference:
    """Two sets of runs, by their medians."""

    before: float
    after: float
    noise: float
    """Difference that means nothing."""
    verdict: str
    """``better``, ``worse`` or ``same``."""


def scatter(values: Sequence[float]) -> float:
    """Sample standard deviation; 0 of a single value."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def chance(sides: Sequence[Sequence[float]], scatters: Sequence[float] | None = None, sigmas: float = SIGMAS) -> float:
    """Difference of two medians by chance; ``scatters`` are the values' own standard deviations unless given."""
    scatters = [scatter(values) for values in sides] if scatters is None else scatters
    return sigmas * float(np.sqrt(sum(s**2 / len(values) for s, values in zip(scatters, sides, strict=True))))


def difference(figure: Figure, before: Sequence[float], after: Sequence[float], by_chance: float) -> Difference:
    """Compare two sets of values, which differ by chance by ``by_chance``."""
    first, second = float(np.median(before)), float(np.median(after))
    floor = figure.one_seed if figure.one_seed is not None and min(len(before), len(after)) == 1 else figure.floor
    noise = max(by_chance, (floor or 0.0) * (abs(first) if figure.relative else 1.0))
    change = second - first
    better = (change < 0) == figure.lower_is_better
    return Difference(first, second, noise, "same" if abs(change) <= noise else "better" if better else "worse")
