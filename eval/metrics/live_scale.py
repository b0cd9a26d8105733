"""Scale estimates of a run while flying, against the true scale.

The true metres per map unit follow from the live trajectory over the longest interval without a scale revision.
"""

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import match
from edgeslam_torch.eval.inputs.run_folder import RunFolder
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import umeyama

FROM_S = 12.5
"""Ten seconds after the take-off of a simulated flight, which ends after 2.5 s."""
_SURE = 3.0
"""Stated sigmas."""
_LEAST_POSES = 20
_SENSORS = frozenset({"telemetry", "height"})
"""Sources of a scale that is measured, not guessed."""


def live_figures(run: RunFolder, truth: Trajectory) -> dict[str, float]:
    """Figures of the scale while flying.

    Returns:
        ``first_scale_s`` time until the output unit is the drone's metre, ``first_scale_off`` and
        ``first_scale_sigmas`` its log error then, absolute and in stated sigmas; ``beyond_3_sigma`` share of the frames
        after `FROM_S` whose scale is further off than three stated sigmas. Empty where no revision is long enough.
    """
    if run.online is None or not run.status:
        return {}
    stamps, value, unit = (np.array([float(row[k]) for row in run.status]) for k in ("stamp_s", "scale", "unit"))
    sigma = np.array([float(row.get("scale_sigma") or "inf") for row in run.status])
    revision = np.array([int(row["revision"]) for row in run.status])
    measured = np.array([not _SENSORS.isdisjoint(row.get("scale_source", "").split("+")) for row in run.status])
    numbers, first, counts = np.unique(revision, return_index=True, return_counts=True)
    longest = sorted(zip(-counts, first, numbers, strict=True))[0][2]
    stretch = revision == longest
    true = _true_scale(stamps[stretch], run.online, truth)
    if true is None:
        return {}
    true *= unit[stretch][0]
    figures = {}
    off, sigmas = np.log(value / true), sigma / value
    known = np.flatnonzero((revision > 0) & measured)
    if len(known):
        k = known[0]
        figures["first_scale_s"] = stamps[k] - stamps[0]
        figures["first_scale_off"] = abs(off[k])
        figures["first_scale_sigmas"] = abs(off[k]) / sigmas[k]
    later = stamps - stamps[0] >= FROM_S
    if later.any():
        figures["beyond_3_sigma"] = np.mean(np.abs(off[later]) > _SURE * sigmas[later])
    return {name: float(figure) for name, figure in figures.items()}


def _true_scale(stretch_s: np.ndarray, online: Trajectory, truth: Trajectory) -> float | None:
    """True metres per published unit, by the live poses of a time without a revision."""
    used = (online.stamps_s >= stretch_s[0] - 1e-6) & (online.stamps_s <= stretch_s[-1] + 1e-6)
    there, here = match(truth.stamps_s, online.stamps_s[used])
    if len(here) < _LEAST_POSES:
        return None
    try:
        found = umeyama(online.positions[used][here], truth.positions[there]).scale
    except EvaluationError:
        return None
    return found if found > 0 else None
