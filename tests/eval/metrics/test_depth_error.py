"""Depth errors, by hand and on FastDepth's own sample."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.metrics.depth_error import (
    compare_folders,
    compare_with_recording,
    mean_score,
    report_depth,
    score_depth,
)
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera


def test_error_worked_out_by_hand():
    truth = np.array([[1.0, 2.0], [4.0, 0.0]])
    found = score_depth(np.array([[1.2, 2.0], [2.0, 9.0]]), truth)
    assert found.pixels == 3
    assert found.abs_rel == pytest.approx((0.2 + 0.0 + 0.5) / 3)
    assert found.rmse_m == pytest.approx(np.sqrt((0.04 + 4.0) / 3))
    assert found.log_rmse == pytest.approx(np.sqrt((np.log(1.2) ** 2 + np.log(2.0) ** 2) / 3))
    assert (found.delta1, found.delta2, found.delta3) == pytest.approx((2 / 3, 2 / 3, 2 / 3))
    scaled = score_depth(0.4 * truth, truth, median_scaled=True)
    assert scaled.scale == pytest.approx(2.5) and scaled.abs_rel == pytest.approx(0.0, abs=1e-12)
    assert score_depth(0.4 * truth, truth).delta1 == 0.0
    small, large = (score_depth(np.full((n, n), d), np.ones((n, n))) for n, d in ((2, 1.2), (9, 1.1)))
    assert mean_score([small, large]).abs_rel == pytest.approx(0.15), "over maps, not pixels"


def test_edges_are_judged_alone():
    image = np.zeros((60, 60), np.uint8)
    image[:, 30:] = 200
    truth = np.where(image > 0, 2.0, 1.0)
    prediction = truth.copy()
    prediction[:, 27:33] = 1.5  # smeared over the step, right elsewhere
    found = report_depth(prediction, truth, image)
    assert found["edges_metric"].pixels < 150
    assert found["edges_metric"].abs_rel > 5 * found["metric"].abs_rel


@pytest.mark.parametrize("what", ["shape", "nothing measured"])
def test_maps_that_cannot_be_compared_are_refused(what):
    prediction = np.ones((4, 4))
    truth = np.ones((4, 5)) if what == "shape" else np.zeros((4, 4))
    with pytest.raises(EvaluationError):
        score_depth(prediction, truth)


def test_folders_are_matched_by_name(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for k in range(2):
            np.save(tmp_path / name / f"{k}.npy", np.full((3, 3), 1.0 + k))
    assert compare_folders(tmp_path / "a", tmp_path / "b")["metric"].rmse_m == 0.0
    with pytest.raises(EvaluationError, match="share no depth map"):
        compare_folders(tmp_path / "a", tmp_path)


def test_numbers_win_over_pictures_of_the_same_name_and_images_give_the_edges(tmp_path):
    """A folder of ``edgeslam depth``: metres, millimetres and a coloured picture of each image."""
    for name in ("ours", "truth", "images"):
        (tmp_path / name).mkdir()
    image = np.zeros((60, 60), np.uint8)
    image[:, 30:] = 200
    np.save(tmp_path / "ours" / "a.npy", np.full((60, 60), 1.5, np.float32))
    cv2.imwrite(str(tmp_path / "ours" / "a.png"), np.full((60, 60), 1500, np.uint16))
    cv2.imwrite(str(tmp_path / "ours" / "a_colour.png"), image)
    cv2.imwrite(str(tmp_path / "truth" / "a.png"), np.full((60, 60), 5000, np.uint16))
    cv2.imwrite(str(tmp_path / "images" / "a.jpg"), image)
    found = compare_folders(tmp_path / "ours", tmp_path / "truth", images=tmp_path / "images")
    assert found["metric"].pixels == 3600 and found["metric"].rmse_m == pytest.approx(0.5)
    assert 0 < found["edges_metric"].pixels < 200
    assert compare_folders(tmp_path / "ours", tmp_path / "truth").get("edges_metric") is None


def test_recording_is_matched_by_its_images_and_stamps(tmp_path):
    data, ours = tmp_path / "data", tmp_path / "ours"
    for folder in (data / "rgb", data / "depth", ours):
        folder.mkdir(parents=True)
    save_camera(data / "camera.yaml", Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    image = np.zeros((48, 64), np.uint8)
    image[:, 32:] = 200
    for k in range(4):
        cv2.imwrite(str(data / "rgb" / f"{k:.6f}.png"), image)
        np.save(ours / f"{k:.6f}.npy", np.full((48, 64), 2.0 + k))
    for k in (1, 3):  # measured 10 ms later, in millimetres
        cv2.imwrite(str(data / "depth" / f"{k + 0.01:.6f}.png"), np.full((48, 64), 1000 * (2 + k), np.uint16))
    (data / "rgb.txt").write_text("".join(f"{k:.6f} rgb/{k:.6f}.png\n" for k in range(4)))
    rows = "".join(f"{k + 0.01:.6f} depth/{k + 0.01:.6f}.png\n" for k in (1, 3))
    (data / "depth.txt").write_text("# metres = value / 1000\n" + rows)
    found = compare_with_recording(ours, data)
    assert found["metric"].pixels == 2 * 48 * 64 and found["metric"].rmse_m < 1e-6
    assert found["edges_metric"].pixels > 40
    with pytest.raises(EvaluationError, match="named after an image"):
        compare_with_recording(data / "depth", data)
    with pytest.raises(EvaluationError, match=r"no depth.txt"):
        compare_with_recording(ours, ours)


@pytest.mark.data
def test_fastdepth_sample_scores_as_computed_directly(data_dir):
    folder = data_dir / "fastdepth_sample"
    truth, prediction = np.load(folder / "depth.npy"), np.load(folder / "pred.npy")
    rgb = (255 * np.load(folder / "rgb.npy")).astype(np.uint8)
    found = report_depth(prediction, truth, rgb)
    # Straight from the arrays: np.sqrt(np.mean((d - p)**2)), np.mean(np.abs(d - p)/d), share of ratios below 1.25.
    assert found["metric"].rmse_m == pytest.approx(0.6180007, abs=1e-6)
    assert found["metric"].abs_rel == pytest.approx(0.14049818, abs=1e-6)
    assert found["metric"].delta1 == pytest.approx(0.77726403, abs=1e-6)
    assert found["edges_metric"].pixels > 1000
