"""The network: names, shapes, size, padding."""

import pytest
import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.complexity import measure_complexity
from edgeslam_torch.models.fastdepth import FULL, PRUNED, FastDepth, Output, Variant, Widths
from edgeslam_torch.models.mobilenet import SameConv2d


@pytest.mark.parametrize(
    ("variant", "giga_macs", "mega_parameters"),
    [  # the paper's table II and upstream's README; parameters with batch norm
        (Variant.PRUNED, 0.37, 1.35),
        (Variant.SKIPADD, 0.74, 3.96),
        (Variant.NNCONV5DW, 0.74, 3.96),
    ],
)
def test_size_is_the_published_one(variant, giga_macs, mega_parameters):
    size = measure_complexity(FastDepth(variant), 224, 224)
    assert size.macs / 1e9 == pytest.approx(giga_macs, abs=0.005)
    assert size.parameters / 1e6 == pytest.approx(mega_parameters, abs=0.015)


def test_names_and_shapes_are_upstreams():
    skips = FastDepth(Variant.SKIPADD).state_dict()
    assert skips["conv0.0.weight"].shape == (32, 3, 3, 3)
    assert skips["conv13.3.weight"].shape == (1024, 1024, 1, 1)
    assert skips["decode_conv1.0.0.weight"].shape == (1024, 1, 5, 5)
    assert skips["decode_conv5.1.0.weight"].shape == (32, 64, 1, 1)
    assert skips["decode_conv6.0.weight"].shape == (1, 32, 1, 1)
    plain = FastDepth(Variant.NNCONV5).state_dict()
    assert plain["mobilenet.13.3.weight"].shape == (1024, 1024, 1, 1)
    assert plain["decoder.conv1.0.weight"].shape == (512, 1024, 5, 5)
    assert "decoder.conv1.1.0.weight" in FastDepth(Variant.NNCONV5DW).state_dict()
    assert not any(k.startswith("uncertainty") for k in skips)


@pytest.mark.parametrize("size", [(32, 64), (96, 32)])
@pytest.mark.parametrize("output", list(Output))
def test_any_multiple_of_32_keeps_its_size(size, output):
    network = FastDepth(Variant.PRUNED, output=output, uncertainty=True).eval()
    depth = network(torch.zeros(2, 3, *size))
    assert depth.shape == (2, 1, *size)
    assert (depth >= 0).all()
    log_depth, log_sigma = network.predict(torch.zeros(2, 3, *size))
    assert log_depth.shape == (2, 1, *size)
    assert log_sigma is not None
    if output is Output.LOG_DEPTH:
        torch.testing.assert_close(log_depth.exp(), depth)


@pytest.mark.parametrize("variant", [Variant.SKIPADD, Variant.PRUNED, Variant.NNCONV5DW])
def test_widths_come_back_from_a_state_dict(variant):
    expected = PRUNED if variant is Variant.PRUNED else FULL
    assert Widths.of_state_dict(FastDepth(variant).state_dict()) == expected


def test_widths_of_something_else_are_refused():
    with pytest.raises(WeightsError, match="not a FastDepth"):
        Widths.of_state_dict({"fc.weight": torch.zeros(3)})


def test_other_sizes_are_refused():
    with pytest.raises(ValueError, match="multiples of 32"):
        FastDepth(Variant.PRUNED)(torch.zeros(1, 3, 224, 230))


def test_same_padding_centres_on_odd_pixels():
    """TensorFlow pads an even input at stride 2 on the right only: output 0 sees inputs 0, 1, 2."""
    layer = SameConv2d(1, 1, 3, 2, 0, bias=False)
    torch.nn.init.ones_(layer.weight)
    x = torch.zeros(1, 1, 4, 4)
    x[0, 0, 0, 0] = 1.0
    assert layer(x)[0, 0].tolist() == [[1.0, 0.0], [0.0, 0.0]]
    x = torch.zeros(1, 1, 4, 4)
    x[0, 0, 2, 2] = 1.0
    assert layer(x)[0, 0].tolist() == [[1.0, 1.0], [1.0, 1.0]]
