"""The shipped weights' recipes: read from their files, run to the end, resumed, and the mean of two weights."""

from dataclasses import replace

import pytest
import torch
from depth_folder import write_folder
from small_depth import narrow_fastdepth

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.recipes import weights
from edgeslam_torch.train.recipes.weights import make, mean_of, read_job
from edgeslam_torch.train.views.datasets import load_depth_folder

METADATA = Metadata(input_height=32, input_width=64, focal_px=60.0)


@pytest.mark.slow
def test_a_job_ends_with_the_mean_of_the_weights_before_and_after(tmp_path, monkeypatch):
    views = load_depth_folder(write_folder(tmp_path / "hall", 4)).views
    monkeypatch.setattr(weights, "render_files", lambda *_: ["first", "second"])
    monkeypatch.setattr(weights, "stored_views", lambda file: views * 40)
    start = narrow_fastdepth(METADATA)
    save_checkpoint(start, METADATA, tmp_path / "start.safetensors")
    (phase,) = read_job("near").phase
    config = replace(phase.config, steps=3, batch=2, validate_every=3, checkpoint_every=3)
    job = replace(
        read_job("near"), width=64, phase=(replace(phase, config=config, shares={"hall": 0.5, "rendered": 0.5}),)
    )
    network, metadata = make(job, tmp_path, tmp_path / "out", tmp_path / "start.safetensors", "cpu")
    after = load_checkpoint(tmp_path / "out" / "near" / "final.safetensors")[0].state_dict()
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(value, 0.5 * (start.state_dict()[name] + after[name]))
    assert metadata.data == ("hall", "rendered")
    again, _ = make(job, tmp_path, tmp_path / "out", tmp_path / "start.safetensors", "cpu")
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), again.parameters(), strict=True))


def test_every_source_of_the_default_has_a_share_in_both_phases():
    broad, settle = read_job("default").phase
    assert set(broad.shares) == set(settle.shares)


def test_only_weights_of_one_network_have_a_mean():
    first = {"w": torch.zeros(2), "count": torch.tensor(3)}
    mean = mean_of(first, {"w": torch.ones(2), "count": torch.tensor(9)}, 0.25)
    torch.testing.assert_close(mean, {"w": torch.full((2,), 0.25), "count": torch.tensor(3)})
    with pytest.raises(WeightsError, match="one network"):
        mean_of(first, {"w": torch.ones(3)}, 0.5)
