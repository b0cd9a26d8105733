"""A camera that changes its exposure while it moves."""

import numpy as np
import pytest

from edgeslam_torch.eval.metrics.run_score import evaluate_run
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import run
from edgeslam_torch.types import Frame


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    "gain", [lambda i: 1.0 + 0.5 * np.sin(2 * np.pi * i / 90), lambda i: 1.0 if i < 100 else 0.5], ids=["slow", "step"]
)
def test_a_change_of_exposure_costs_no_frame(tmp_path, data_dir, gain):
    folder = data_dir / "tum_fr1_xyz"
    source = open_source(folder, max_frames=250)
    decode = source.decode

    def brightened(problems):
        for frame in decode(problems):
            image = np.clip(frame.image * np.float32(gain(frame.index)), 0, 255).astype(np.uint8)
            yield Frame(frame.index, frame.stamp_s, image)

    source.decode = brightened
    result = run(source, tmp_path / "out")
    assert result.summary["tracked"] == 250 and result.summary["lost_events"] == 0
    score = evaluate_run(tmp_path / "out", folder, judge_map=False)
    assert score.ate_sim3_m < 0.02  # as recorded, and with either change: 0.010
