"""Scale estimates of a run against the true scale.

The true metres per map unit follow from the output trajectory over the longest interval without a scale revision.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import match
from edgeslam_torch.eval.inputs.run_folder import RunFolder
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind, umeyama

FROM_S = 12.5
"""Ten seconds after the take-off of a simulated flight, which ends after 2.5 s."""
_SURE = 3.0
"""Stated sigmas."""
_LEAST_POSES = 20
_SENSORS = frozenset({"telemetry", "height"})
"""Sources of a scale that is measured, not guessed."""

Figures = dict[str, float | None]


@dataclass(frozen=True, slots=True)
class _Stated:
    """One frame's scale [metres per map unit]."""

    stamp_s: float
    value: float
    sigma: float
    revision: int
    measured: bool
    """Whether it is measured by the drone's sensors, not a guess."""
    unit: float
    """Output units per map unit."""


def live_figures(run: RunFolder, truth: Trajectory) -> Figures:
    """Figures of the scale while flying.

    Returns:
        ``first_scale_s`` time until the output unit is the drone's metre, ``first_scale_off`` and
        ``first_scale_sigmas`` its log error then, absolute and in stated sigmas; ``beyond_3_sigma`` share of the frames
        after `FROM_S` whose scale is further off than three stated sigmas. Empty where no revision is long enough.
    """
    if run.online is None or not run.status:
        return {}
    stated = [_stated(row) for row in run.status]
    true = _true_scale(stated, run.online, truth)
    if true is None:
        return {}
    begin_s = stated[0].stamp_s
    figures: Figures = {}
    first = next((s for s in stated if s.revision > 0 and s.measured), None)
    if first is not None:
        off = math.log(first.value / true)
        figures["first_scale_s"] = first.stamp_s - begin_s
        figures["first_scale_off"] = abs(off)
        figures["first_scale_sigmas"] = abs(off) * first.value / first.sigma
    later = [s for s in stated if s.stamp_s - begin_s >= FROM_S]
    if later:
        figures["beyond_3_sigma"] = float(np.mean([_beyond(s, true) for s in later]))
    return figures


def _stated(row: dict[str, str]) -> _Stated:
    sigma = float(row.get("scale_sigma") or "inf")
    measured = not _SENSORS.isdisjoint(row.get("scale_source", "").split("+"))
    return _Stated(
        float(row["stamp_s"]), float(row["scale"]), sigma, int(row["revision"]), measured, float(row["unit"])
    )


def _beyond(stated: _Stated, true: float) -> bool:
    return abs(math.log(stated.value / true)) > _SURE * stated.sigma / stated.value


def _true_scale(stated: Sequence[_Stated], online: Trajectory, truth: Trajectory) -> float | None:
    """Metres per map unit, by the poses of the longest time without a revision."""
    revision, _ = Counter(s.revision for s in stated).most_common(1)[0]
    stretch = [s.stamp_s for s in stated if s.revision == revision]
    unit = next(s.unit for s in stated if s.revision == revision)
    used = (online.stamps_s >= stretch[0] - 1e-6) & (online.stamps_s <= stretch[-1] + 1e-6)
    p = online.positions[used]
    there, here = match(truth.stamps_s, online.stamps_s[used])
    if len(here) < _LEAST_POSES:
        return None
    try:
        found = umeyama(p[here], truth.positions[there], AlignmentKind.SIM3).scale
    except EvaluationError:
        return None
    return unit * found if found > 0 else None
