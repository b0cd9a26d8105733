"""Labels in a wrong unit, inside out, or none at all, against a network that sees the truth."""

import logging

import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.labels import check_labels

TRUTH = np.tile(np.linspace(1, 4, 40, dtype=np.float32), (30, 1))


def folder(depth_m):
    return DepthFolder("desk", [View(np.zeros((30, 40, 3), np.uint8), np.float32(depth_m), np.eye(3))] * 3, ())


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        (1.5 * TRUTH, ""),
        (np.where(TRUTH > 2, TRUTH, np.nan), ""),
        (256 * TRUTH, "metres"),
        (1000 * TRUTH, "metres"),
        (TRUTH / 19.5, "metres"),
        (1 / TRUTH, "disparity"),
        (80 / TRUTH, "disparity"),
    ],
)
def test_labels_that_are_no_metres_are_named(labels, words, caplog):
    with caplog.at_level(logging.WARNING):
        check_labels([folder(labels)], lambda view: TRUTH)
    assert words in caplog.text
    assert bool(caplog.text) == bool(words)


def test_no_label_at_all_is_refused():
    with pytest.raises(SourceError, match="desk"):
        check_labels([folder(0 * TRUTH)], lambda view: TRUTH)
