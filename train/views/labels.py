"""Labels of depth that are no metres, before anything is learnt from them."""

import logging
from collections.abc import Callable, Sequence

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)

LABELS_LOOKED_AT, MIN_LABELS = 8, 50
"""Images of a folder, and labels of one, that are compared with the network's depth."""
OTHER_UNIT = 6.0
"""Ratio of median depths beyond which a unit is doubted: rooms never seen are misjudged by up to 3, units differ by 10
and more."""
INSIDE_OUT = -0.3
"""Rank correlation below which labels are no depth."""


def check_labels(folders: Sequence[DepthFolder], metres_of: Callable[[View], FloatArray]) -> None:
    """Warn of labels that a trained network sees as no metres: of another unit, or larger where it is nearer.

    Args:
        folders: Labelled images.
        metres_of: The network's depth of a view [m].

    Raises:
        SourceError: If a folder has no label at all.
    """
    for folder in folders:
        ratios, orders = [], []
        for i in np.linspace(0, len(folder.views) - 1, min(LABELS_LOOKED_AT, len(folder.views))).astype(int):
            view = folder.views[int(i)]
            known = np.isfinite(view.depth_m) & (view.depth_m > 0)
            if np.count_nonzero(known) < MIN_LABELS:
                continue
            seen, label = metres_of(view)[known], view.depth_m[known]
            ratios.append(float(np.median(label) / np.median(seen)))
            one, two = seen.argsort().argsort(), label.argsort().argsort()
            orders.append(float(np.asarray(np.corrcoef(one, two))[0, 1]) if np.ptp(label) > 0 else 0.0)
        if not ratios:
            if not any((view.depth_m > 0).any() for view in folder.views):
                raise SourceError(f"{folder.name}: no image has any depth: there is nothing to learn from")
            continue
        ratio = float(np.median(ratios))
        if np.median(orders) < INSIDE_OUT:
            logger.warning("%s: its depth grows where it is nearer: is it disparity, or inverse depth?", folder.name)
        elif not 1 / OTHER_UNIT < ratio < OTHER_UNIT:
            logger.warning(
                "%s: its depth is %.3g times what the shipped network sees: is it in metres? "
                "(depth maps: what one metre is stored as)",
                folder.name,
                ratio,
            )
