"""Real recordings through the whole system, default settings: the bars of a release."""

import pytest

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.run_score import evaluate_run
from edgeslam_torch.io.source import open_source
from edgeslam_torch.run import run

pytestmark = [pytest.mark.data, pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.mark.parametrize(
    ("name", "ate_m", "points"), [("tum_fr1_xyz", 0.020, 30_000), ("7scenes_redkitchen", 0.050, 1)]
)
def test_sequence_is_within_its_bar(data_dir, tmp_path, name, ate_m, points):
    result = run(open_source(data_dir / name), tmp_path / "out", SlamConfig())
    score = evaluate_run(result.folder, data_dir / name, judge_map=False)
    assert score.ate_sim3_m <= ate_m
    assert score.coverage >= 0.99
    assert result.summary["first_pose_frame"] == 0
    assert result.summary["map"]["edge_points"] >= points


def test_two_runs_of_a_recording_give_the_same_bytes(data_dir, tmp_path):
    for out in ("a", "b"):
        run(open_source(data_dir / "tum_fr1_xyz", max_frames=150), tmp_path / out, SlamConfig())
    for name in ("trajectory.txt", "edge_map.ply", "anchors.ply"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
