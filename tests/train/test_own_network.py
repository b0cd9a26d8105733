"""A network that is not FastDepth learns from labels, and what it learnt flies as an ONNX file."""

import cv2
import numpy as np
import pytest
import torch
from depth_folder import write_folder
from torch import nn

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend.depth_network import open_depth
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.checkpoint import restored, save_checkpoint
from edgeslam_torch.models.onnx.export import ExportOptions, export_onnx
from edgeslam_torch.models.record import OTHER_NETWORK, Metadata
from edgeslam_torch.models.trainable import DepthModule, Prediction
from edgeslam_torch.train import Data, TrainConfig, finetune, load_depth_folder, out_folder
from edgeslam_torch.train.validate import score

METADATA = Metadata(
    variant=OTHER_NETWORK, input_height=32, input_width=64, focal_px=60.0, uncertainty=False, sigma_floor=0.2
)
CONFIG = TrainConfig(
    steps=40, batch=4, lr=0.02, encoder_lr=0.01, warmup_steps=2, validate_every=20, checkpoint_every=20, ema_decay=0.9
)


class Rows(DepthModule):
    """Depth by row of the image, plus what a convolution of its pixels says: no encoder, no batch norm."""

    def __init__(self):
        super().__init__()
        self.line = nn.Parameter(torch.linspace(-1.5, 1.5, 8).view(1, 1, 8, 1))
        self.layer = nn.Conv2d(3, 1, 3, padding=1)
        nn.init.zeros_(self.layer.weight)

    def predict(self, x):
        line = nn.functional.interpolate(self.line, size=x.shape[-2:], mode="bilinear", align_corners=True)
        return Prediction(line + self.layer(x), None)


def test_another_network_learns_from_labels_and_is_restored_from_the_best_file(tmp_path):
    labelled = load_depth_folder(write_folder(tmp_path / "hall"))
    torch.manual_seed(0)
    network = Rows()
    with out_folder(tmp_path / "out") as out:
        outcome = finetune(network, METADATA, Data(labelled=[labelled]), CONFIG, out)
    assert outcome.before is not None and outcome.kept is not None
    # A ramp from left to right has the same depth in all rows, and images are mirrored: the best rows are flat.
    assert outcome.kept.abs_rel_scaled < 0.6 * outcome.before.abs_rel_scaled
    kept = restored(network, tmp_path / "out" / "weights.safetensors")
    again = score(kept, METADATA, labelled.views[::10])
    assert (again.abs_rel, again.abs_rel_scaled) == pytest.approx(
        (outcome.kept.abs_rel, outcome.kept.abs_rel_scaled), rel=1e-5
    )


@pytest.mark.slow
def test_another_network_is_exported_and_flies(tmp_path):
    torch.manual_seed(0)
    network = Rows()
    nn.init.normal_(network.layer.weight, std=0.05)
    export_onnx(network, METADATA, tmp_path / "mine.onnx", ExportOptions(height=32, width=64))
    image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    predict = open_depth(tmp_path / "mine.onnx")
    depth = predict(image, Camera(64, 32, 90.0, 90.0, 31.5, 15.5))  # 1.5 times as long as in training
    half = network.predict(torch.from_numpy(_normalised(image))).log_depth.detach().numpy()[0, 0]
    metres = np.exp(half.reshape(16, 2, 32, 2).mean((1, 3))) * 1.5
    np.testing.assert_allclose(depth.depth_m, cv2.resize(metres, (64, 32)), rtol=1e-4)
    np.testing.assert_allclose(depth.sigma_log, 0.2, rtol=1e-5)


def _normalised(image):
    rgb = image[..., ::-1].astype(np.float32) / 255.0
    return np.ascontiguousarray(((rgb - 0.5) / 0.5).transpose(2, 0, 1))[None]


def test_tensors_of_another_network_are_refused(tmp_path):
    save_checkpoint(Rows(), METADATA, tmp_path / "w.safetensors")
    with pytest.raises(WeightsError, match="of another network"):
        restored(nn.Conv2d(3, 1, 3), tmp_path / "w.safetensors")
    with pytest.raises(WeightsError, match="cannot read"):
        restored(Rows(), tmp_path / "none.safetensors")
