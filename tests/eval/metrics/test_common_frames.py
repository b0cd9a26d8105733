"""Trajectories compared on the frames that all of them have."""

from dataclasses import replace

import numpy as np
import pytest
from markdown_rows import rows

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.metrics.common_frames import score_common
from edgeslam_torch.eval.report.tables import common_report


@pytest.fixture
def early_mistake(loop, rng):
    """Good, but for its first fifty poses."""
    T = loop.T_w_c.copy()
    T[:, :3, 3] += rng.normal(0.0, 0.003, (len(T), 3))
    T[:50, :3, 3] += rng.normal(0.0, 0.2, (50, 3))
    return replace(loop, T_w_c=T)


def test_frames_that_one_lacks_do_not_count_against_the_other(loop, early_mistake):
    late = loop.take(np.arange(60, 200))
    late.T_w_c[:, :3, 3] *= 0.5  # monocular: of any size
    ours, theirs = score_common(loop, [("ours", early_mistake), ("late", late)])
    assert (ours.frames, theirs.frames) == (200, 140)
    assert ours.sim3.matched == theirs.sim3.matched == 140
    assert ours.sim3.ate_m.rmse < 0.01 and theirs.sim3.ate_m.rmse < 1e-9
    assert theirs.sim3.scale == pytest.approx(2.0)
    assert ["late", "140", "0.0000"] in [row[:3] for row in rows(common_report([ours, theirs], markdown=True))]


def test_keyframes_and_other_clocks_are_compared_too(loop, early_mistake):
    keyframes = loop.take(slice(61, None, 7))
    keyframes = replace(keyframes, stamps_s=1e3 * (keyframes.stamps_s + 0.004))  # milliseconds, 4 ms late
    found = score_common(loop, [("ours", early_mistake), ("keyframes", keyframes)])
    assert [s.sim3.matched for s in found] == [20, 20]
    assert found[0].sim3.ate_m.rmse < 0.01


def test_runs_with_nothing_in_common_are_named(loop):
    with pytest.raises(EvaluationError, match="a, b: 0 frame"):
        score_common(loop, [("a", loop.take(slice(0, 50))), ("b", loop.take(slice(100, 150)))])
