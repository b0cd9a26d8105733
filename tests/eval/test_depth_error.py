"""Depth errors, by hand and on FastDepth's own sample."""

from pathlib import Path

import numpy as np
import pytest

from edgeslam_torch.eval.depth import compare_folders, mean_score, report_depth, score_depth
from edgeslam_torch.eval.errors import EvaluationError


def test_error_worked_out_by_hand() -> None:
    truth = np.array([[1.0, 2.0], [4.0, 0.0]])
    found = score_depth(np.array([[1.2, 2.0], [2.0, 9.0]]), truth)
    assert found.pixels == 3
    assert found.abs_rel == pytest.approx((0.2 + 0.0 + 0.5) / 3)
    assert found.rmse_m == pytest.approx(np.sqrt((0.04 + 4.0) / 3))
    assert found.log_rmse == pytest.approx(np.sqrt((np.log(1.2) ** 2 + np.log(2.0) ** 2) / 3))
    assert (found.delta1, found.delta2, found.delta3) == pytest.approx((2 / 3, 2 / 3, 2 / 3))


def test_median_scaling_removes_a_factor(rng: np.random.Generator) -> None:
    truth = rng.uniform(1.0, 5.0, (20, 30))
    found = score_depth(0.4 * truth, truth, median_scaled=True)
    assert found.scale == pytest.approx(2.5)
    assert found.abs_rel == pytest.approx(0.0, abs=1e-12)
    assert score_depth(0.4 * truth, truth).delta1 == 0.0


def test_edges_are_judged_alone() -> None:
    image = np.zeros((60, 60), np.uint8)
    image[:, 30:] = 200
    truth = np.where(image > 0, 2.0, 1.0)
    prediction = truth.copy()
    prediction[:, 27:33] = 1.5  # smeared over the step, right elsewhere
    found = report_depth(prediction, truth, image)
    assert found.edges_metric is not None
    assert found.edges_metric.pixels < 150
    assert found.edges_metric.abs_rel > 5 * found.metric.abs_rel


@pytest.mark.parametrize("what", ["shape", "nothing measured"])
def test_maps_that_cannot_be_compared_are_refused(what: str) -> None:
    prediction = np.ones((4, 4))
    truth = np.ones((4, 5)) if what == "shape" else np.zeros((4, 4))
    with pytest.raises(EvaluationError):
        score_depth(prediction, truth)


def test_folders_are_matched_by_name(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for k in range(2):
            np.save(tmp_path / name / f"{k}.npy", np.full((3, 3), 1.0 + k))
    assert compare_folders(tmp_path / "a", tmp_path / "b").metric.rmse_m == 0.0
    with pytest.raises(EvaluationError, match="share no depth map"):
        compare_folders(tmp_path / "a", tmp_path)


def test_mean_is_over_maps() -> None:
    a, b = score_depth(np.full((2, 2), 1.2), np.ones((2, 2))), score_depth(np.full((9, 9), 1.1), np.ones((9, 9)))
    assert mean_score([a, b]).abs_rel == pytest.approx(0.15)


@pytest.mark.data
def test_fastdepth_sample_scores_as_computed_directly(data_dir: Path) -> None:
    folder = data_dir / "fastdepth_sample"
    truth, prediction = np.load(folder / "depth.npy"), np.load(folder / "pred.npy")
    rgb = (255 * np.load(folder / "rgb.npy")).astype(np.uint8)
    found = report_depth(prediction, truth, rgb)
    # Straight from the arrays: np.sqrt(np.mean((d - p)**2)), np.mean(np.abs(d - p)/d), share of ratios below 1.25.
    assert found.metric.rmse_m == pytest.approx(0.6180007, abs=1e-6)
    assert found.metric.abs_rel == pytest.approx(0.14049818, abs=1e-6)
    assert found.metric.delta1 == pytest.approx(0.77726403, abs=1e-6)
    assert found.edges_metric is not None and found.edges_metric.pixels > 1000
