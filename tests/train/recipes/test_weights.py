"""The shipped weights' recipes: run to the end, resumed, and the mean of two weights."""

from dataclasses import replace

import pytest
import torch
from depth_folder import write_folder
from small_depth import narrow_fastdepth

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.loop import train
from edgeslam_torch.train.recipes import weights
from edgeslam_torch.train.recipes.weights import default, mean_of, near
from edgeslam_torch.train.views.datasets import DepthFolder, load_depth_folder

METADATA = Metadata(input_height=32, input_width=64, focal_px=60.0)


@pytest.fixture
def small(tmp_path, monkeypatch):
    """All views are of one small recording, trainings have three steps; weights of metres and first weights by name."""
    views = load_depth_folder(write_folder(tmp_path / "hall", 4)).views
    monkeypatch.setattr(weights, "load_depth_folder", lambda path, width: DepthFolder(path.name, views, ()))
    monkeypatch.setattr(weights, "render_files", lambda *_: ["first", "second"])
    monkeypatch.setattr(weights, "stored_views", lambda file: views * 40)
    trained = {}

    def few_steps(network, metadata, signals, config, out, *more):
        assert out.name not in trained
        metric = {source.name: source.metric for source in signals[0].sources}
        trained[out.name] = metric, {name: value.clone() for name, value in network.state_dict().items()}
        config = replace(config, steps=3, batch=2, validate_every=3, checkpoint_every=3)
        return train(network, metadata, signals, config, out, *more)

    monkeypatch.setattr(weights, "train", few_steps)
    return trained


@pytest.mark.slow
def test_near_ends_with_the_mean_of_the_weights_before_and_after(tmp_path, small):
    start = narrow_fastdepth(METADATA)
    save_checkpoint(start, METADATA, tmp_path / "start.safetensors")
    given = (tmp_path, tmp_path / "out", "cpu", tmp_path / "start.safetensors")
    network, metadata = near(*given)
    after = load_checkpoint(tmp_path / "out" / "near" / "final.safetensors")[0].state_dict()
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(value, 0.5 * (start.state_dict()[name] + after[name]))
    assert metadata.data == ("tum_fr1_rpy_depth", "icl_livingroom1", "icsl_corridor", "hololens_a", "rendered")
    again, _ = near(*given)
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), again.parameters(), strict=True))
    assert small["near"][0] == {name: 0.2 if name == "rendered" else 1.0 for name in metadata.data}


@pytest.mark.slow
def test_default_goes_on_from_its_first_training_and_calibrates_sigma(tmp_path, small, monkeypatch):
    monkeypatch.setattr(weights, "build_network", narrow_fastdepth)
    monkeypatch.setattr(weights, "load_imagenet_encoder", lambda *_: None)
    network, metadata = default(tmp_path, tmp_path / "out", "cpu")
    assert list(small) == ["broad", "settle"]
    broad, settle = (load_checkpoint(tmp_path / "out" / name / "final.safetensors")[0] for name in small)
    torch.testing.assert_close(small["settle"][1], broad.state_dict())
    torch.testing.assert_close(network.state_dict(), settle.state_dict())
    assert metadata.data == ("ImageNet (encoder)", "tum_fr1_rpy_depth", "icl_livingroom1", "rendered")
    assert (metadata.sigma_scale, metadata.sigma_floor) != (1.0, 0.0)


def test_only_weights_of_one_network_have_a_mean():
    first = {"w": torch.zeros(2), "count": torch.tensor(3)}
    mean = mean_of(first, {"w": torch.ones(2), "count": torch.tensor(9)}, 0.25)
    torch.testing.assert_close(mean, {"w": torch.full((2,), 0.25), "count": torch.tensor(3)})
    with pytest.raises(WeightsError, match="one network"):
        mean_of(first, {"w": torch.ones(3)}, 0.5)
