"""What a network is shown: images, and depth as the training camera would have measured it."""

import numpy as np
import pytest
import torch

from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.signals import Slot, Source, Supervised
from edgeslam_torch.train.views.augment import AugmentConfig, View

METADATA = Metadata(input_height=32, input_width=64, focal_px=50.0)
STILL = AugmentConfig(0, (1, 1), 0, 0, 0, 0, 0, 0, 0, 0, (1, 1), 0, 0, 0)


@pytest.mark.parametrize("focal_px", [25.0, 50.0, 100.0])
def test_depth_of_another_lens_is_that_of_the_training_camera(focal_px):
    """Twice the focal length shows an object twice as large: to the training camera it is at half the distance."""
    K = np.array([[focal_px, 0, 31.5], [0, focal_px, 15.5], [0, 0, 1]])
    depth = np.linspace(1, 4, 64, dtype=np.float32)[None].repeat(32, 0)
    view = View(np.full((32, 64, 3), 90, np.uint8), depth, K)
    batch = Supervised([Source("made", [view], 1.0)], METADATA, STILL).draw([Slot(0, 0, 0)])[0]
    expected = torch.from_numpy(depth) * (50.0 / focal_px)
    known = batch["mask"][0, 0] > 0
    assert known.float().mean() > 0.9
    torch.testing.assert_close(batch["log_depth"][0, 0].exp()[known], expected[known], rtol=1e-4, atol=0)
