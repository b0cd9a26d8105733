"""The mean of two weights."""

import pytest
import torch
from small_depth import narrow_fastdepth

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import build_network
from edgeslam_torch.models.layout import Widths
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.recipes.weights import mean_of


def test_the_mean_lies_between_and_is_of_one_network():
    metadata = Metadata(input_height=32, input_width=64, focal_px=60.0)
    other = Widths((4,) + (8,) * 13, (8,) * 4 + (4,))
    a, b = (narrow_fastdepth(metadata, seed) for seed in range(2))
    state = mean_of(a, b, 0.25)
    for name, x in a.state_dict().items():
        y = b.state_dict()[name]
        torch.testing.assert_close(state[name], 0.75 * x + 0.25 * y if x.is_floating_point() else x)
    with pytest.raises(WeightsError, match="one network"):
        mean_of(a, build_network(metadata, other), 0.5)
