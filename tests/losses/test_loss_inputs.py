"""What every public loss promises to training loops that are not ours: precision, NaN, shapes, batches, tracing."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import pytest
import torch
from torch import Tensor, nn

from edgeslam_torch import losses
from edgeslam_torch.geometry import se3_torch as lie

Arguments = dict[str, Tensor]
B, N, C, M, H, W = 2, 9, 4, 5, 12, 16
K = torch.tensor([[20.0, 0.0, 7.5], [0.0, 18.0, 5.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
TWIST = torch.tensor([[0.10, -0.05, 0.08, 0.01, -0.03, 0.02], [-0.12, 0.04, 0.05, 0.02, 0.02, -0.01]]).double()


@dataclass(frozen=True)
class Case:
    """A loss, what it is given (float64), and what is predicted there."""

    loss: nn.Module
    given: Callable[[], Arguments]
    predicted: str
    """Argument that a network makes."""
    batch_only: bool = False
    """Takes no single item."""


def uniform(low, high, *shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def pixels(*shape, seed):
    return torch.stack((uniform(3, W - 4, *shape, seed=seed), uniform(3, H - 4, *shape, seed=seed + 100)), -1)


def pair():
    return {"T_j_i": lie.exp(TWIST), "uv": pixels(B, N, seed=1), "depth_i": uniform(2, 3, B, N, seed=2)}


def cycle():
    return {**pair(), "depth_j": uniform(2.3, 2.7, B, H, W, seed=3), "K": K.expand(B, 3, 3)}


def aligned():
    normal = nn.functional.normalize(uniform(-1, 1, B, N, 2, seed=4), dim=-1)
    return {**pair(), "uv_j": pixels(B, N, seed=5), "normal_j": normal, "K": K.expand(B, 3, 3)}


def corners():
    depth, cos_j = uniform(2, 3, B, C, 3, seed=7), uniform(-0.9, 0.9, B, C, seed=8)
    T_j_i, uv = lie.exp(TWIST), pixels(B, C, 3, seed=6)
    return {"T_j_i": T_j_i, "uv": uv, "depth_i": depth, "cos_j": cos_j, "K": K.expand(B, 3, 3)}


def arms():
    return {"p": uniform(-1, 1, B, C, 2, M, 3, seed=9), "mask": torch.ones(B, C, 2, M, dtype=torch.bool)}


def window():
    T_c_w = torch.stack((torch.eye(4).double().expand(B, 4, 4), lie.exp(TWIST)), 1)
    p_w = losses.back_project(pixels(B, N, seed=10), uniform(2, 3, B, N, seed=11), K)
    mask = torch.ones(B, 2, N, dtype=torch.bool)
    return {"T_c_w": T_c_w, "p_w": p_w, "uv": pixels(B, 2, N, seed=12), "K": K.expand(B, 3, 3), "mask": mask}


def dense():
    mask = uniform(0, 1, B, 1, H, W, seed=15) > 0.2
    mask[0, 0, 0, 0] = True
    return {
        "log_depth": uniform(-1, 1, B, 1, H, W, seed=13),
        "log_target": uniform(-1, 1, B, 1, H, W, seed=14),
        "mask": mask,
    }


def images():
    v, u = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
    waves = [
        torch.stack((torch.sin(0.5 * (u - s)), torch.cos(0.4 * (u - s) + 0.3 * v), torch.sin(0.3 * (u - s) - 0.5 * v)))
        for s in (0, 1, 2)
    ]
    rgb = (torch.stack(waves) + 1.0) / 2.0
    T = torch.eye(4).double().repeat(B, 2, 1, 1)
    T[:, 0, 0, 3], T[:, 1, 0, 3] = 0.1, 0.2
    return {
        "image_i": rgb[:1].expand(B, -1, -1, -1),
        "images_j": rgb[1:].expand(B, -1, -1, -1, -1),
        "depth_i": uniform(1.8, 2.2, B, 1, H, W, seed=16),
        "T_j_i": T,
        "K": K.expand(B, 3, 3),
    }


def smooth():
    return {"log_depth": uniform(0, 1, B, 1, H, W, seed=17), "image": uniform(0, 1, B, 3, H, W, seed=18)}


def uncertain():
    return {"log_sigma": uniform(-1, 0, B, 1, H, W, seed=19), **dense()}


def lshape():
    return {**corners(), "arms": arms()["p"], "arms_mask": arms()["mask"]}


WIDE = {"max_relative": 9.0}
CASES = {
    "reprojection": Case(losses.ReprojectionLoss(), window, "p_w"),
    "alignment": Case(losses.EdgeAlignmentLoss(), aligned, "depth_i"),
    "cycle": Case(losses.CycleLoss(**WIDE), cycle, "depth_i"),
    "cycle, pixel": Case(losses.CycleLoss(losses.CycleForm.PIXEL, **WIDE), cycle, "depth_i"),
    "cycle, parallax": Case(losses.CycleLoss(losses.CycleForm.PARALLAX, **WIDE), cycle, "depth_i"),
    "angle": Case(losses.AngleLoss(), corners, "depth_i"),
    "angle, right": Case(
        losses.AngleLoss(losses.AngleForm.RIGHT_ANGLE, gate_cos=2.0),
        corners,
        "depth_i",
    ),
    "collinearity": Case(losses.CollinearityLoss(), arms, "p"),
    "collinearity, literal": Case(losses.CollinearityLoss(literal=True), arms, "p"),
    "lshape": Case(losses.LShapeLoss(losses.AngleLoss(), losses.CollinearityLoss()), lshape, "depth_i"),
    "l1": Case(losses.MaskedL1(), dense, "log_depth", batch_only=True),
    "berhu": Case(losses.BerHu(), dense, "log_depth", batch_only=True),
    "silog": Case(losses.SILog(), dense, "log_depth", batch_only=True),
    "slope": Case(losses.LogSlope(), dense, "log_depth", batch_only=True),
    "gradient": Case(losses.GradientMatching(scales=2), dense, "log_depth", batch_only=True),
    "laplace": Case(losses.LaplaceNll(), uncertain, "log_sigma", batch_only=True),
    "photometric": Case(losses.PhotometricLoss(), images, "depth_i", batch_only=True),
    "smoothness": Case(losses.SmoothnessLoss(), smooth, "log_depth", batch_only=True),
}
"""By name; every loss that `edgeslam_torch.losses` exports is there."""


EVERY = pytest.mark.parametrize("case", [pytest.param(case, id=name) for name, case in CASES.items()])
HALVES = pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)


def cast(arguments, dtype):
    return {name: x.to(dtype) if x.is_floating_point() else x for name, x in arguments.items()}


def item(arguments, b):
    return {name: x[b] for name, x in arguments.items()}


def gradient(case, arguments):
    """Loss and its gradient by what is predicted."""
    x = arguments[case.predicted].detach().clone().requires_grad_()
    value = case.loss(**{**arguments, case.predicted: x})
    value.sum().backward()
    assert x.grad is not None
    return value.detach(), x.grad


@EVERY
def test_one_value_an_item_and_a_scalar_for_one(case):
    given = case.given()
    together = case.loss(**given)
    assert together.shape == (B,) and (together > 0).all() or isinstance(case.loss, losses.LaplaceNll)
    for b in range(B):
        if case.batch_only:
            alone = case.loss(**{name: x[b : b + 1] for name, x in given.items()})[0]
        else:
            alone = case.loss(**item(given, b))
            assert alone.shape == ()
        torch.testing.assert_close(together[b], alone)


@EVERY
def test_gradient_is_right(case):
    given = case.given()
    x = given[case.predicted].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: case.loss(**{**given, case.predicted: x}), x, fast_mode=True, eps=1e-7, atol=1e-5
    )


@EVERY
@HALVES
def test_half_is_computed_in_float32(case, dtype):
    """The inputs are rounded, the arithmetic is not: the same numbers in float32 give the same result."""
    rounded = cast(case.given(), dtype)
    value, slope = gradient(case, rounded)
    exact, exact_slope = gradient(case, cast(rounded, torch.float32))
    assert (value.dtype, slope.dtype) == (torch.float32, dtype)
    torch.testing.assert_close(value, exact)
    torch.testing.assert_close(slope, exact_slope.to(dtype))


@EVERY
def test_autocast_changes_nothing(case):
    given = cast(case.given(), torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        inside = case.loss(**given)
    assert torch.equal(inside, case.loss(**given))


@EVERY
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16], ids=str)
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA here")
def test_a_gpu_gives_the_processors_loss(case, dtype):
    given = cast(case.given(), dtype)
    value, slope = gradient(case, {name: x.cuda() for name, x in given.items()})
    exact, exact_slope = gradient(case, cast(cast(given, dtype), torch.float64))
    assert (value.device.type, value.dtype, slope.dtype) == ("cuda", torch.float32, dtype)
    torch.testing.assert_close(value.double().cpu(), exact, rtol=1e-3, atol=1e-5)
    tolerance = {torch.float32: 2e-3, torch.float16: 4e-3, torch.bfloat16: 2e-2}[dtype]
    assert float((slope.double().cpu() - exact_slope).norm() / exact_slope.norm()) < tolerance


@pytest.mark.parametrize(
    ("case", "name"),
    [pytest.param(case, name, id=f"{of} {name}") for of, case in CASES.items()
     for name in dict.fromkeys((case.predicted, "T_j_i"))
     if name in case.given() and (of, name) != ("angle, right", "T_j_i")],
)  # fmt: skip
def test_what_is_predicted_as_nan_is_seen_in_its_item_alone(case, name):
    given = {name: x.clone() for name, x in case.given().items()}
    given[name].view(B, -1)[0, 0] = torch.nan
    assert case.loss(**given).isnan().tolist() == [True, False]


@EVERY
def test_axes_that_do_not_fit_are_refused(case):
    given = case.given()
    for name, x in given.items():
        for wrong in (x[:, :-1], x[..., None], x[:1].expand(3, *x.shape[1:])):
            if name == "depth_j" and wrong.ndim == x.ndim and len(wrong) == B:
                continue  # the map of frame j may have a size of its own
            with pytest.raises(ValueError, match=f"shapes .* \\({', '.join(map(str, wrong.shape))}\\)"):
                case.loss(**{**given, name: wrong})


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=n) for n, c in CASES.items() if {"mask", "arms_mask"} & {*c.given()}]
)
def test_mask_of_numbers_is_refused_with_what_to_write(case):
    given = case.given()
    name = "mask" if "mask" in given else "arms_mask"
    with pytest.raises(TypeError, match="mask must be bool, not numbers; write mask > 0.5"):
        case.loss(**{**given, name: given[name].float()})


def test_holes_of_a_depth_map_are_not_mixed_into_its_samples():
    depth = torch.full((1, H, W), 2.0)
    depth[0, 5, 5], depth[0, 8, 8] = torch.nan, 0.0
    uv = torch.tensor([[[3.0, 3.0], [4.5, 5.0], [5.0, 5.0], [7.9, 8.0], [5.0, 4.0]]])
    d, known = losses.sample_depth(depth, uv)
    assert known.tolist() == [[True, False, False, False, True]]
    assert d[known].tolist() == [2.0, 2.0]


def larger(arguments):
    """The batch with its first item once more at its end."""
    return {name: torch.cat((x, x[:1])).contiguous() for name, x in arguments.items()}


@pytest.mark.slow
@EVERY
def test_compiled_whole_it_gives_the_same(case):
    """The graph's capture is what can fail for a loss; machine code is the compiler's business."""
    compiled = torch.compile(case.loss, fullgraph=True, backend="aot_eager")
    given = cast(case.given(), torch.float32)
    for batch in (given, larger(given)):  # another size of batch makes sizes variables
        x = batch[case.predicted].clone().requires_grad_()
        value = compiled(**{**batch, case.predicted: x})
        value.sum().backward()
        expected, slope = gradient(case, batch)
        torch.testing.assert_close(value.detach(), expected)
        torch.testing.assert_close(x.grad, slope, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@EVERY
def test_exported_for_any_batch_it_gives_the_same(case):
    given = {name: x.contiguous() for name, x in cast(case.given(), torch.float32).items()}
    batch = torch.export.Dim("batch", min=2, max=64)
    program = torch.export.export(case.loss, (), given, dynamic_shapes={name: {0: batch} for name in given})
    for some in (given, larger(given)):
        torch.testing.assert_close(program.module()(**some), case.loss(**some))


def holed(case, name, hole, everywhere):
    """Loss and every input's gradient with the first number of an input, or all of the first item's, replaced."""
    given = {key: x.clone() for key, x in cast(case.given(), torch.float32).items()}
    item = given[name].view(B, -1)[0]
    item[slice(None) if everywhere else slice(1)] = hole
    inputs = {key: x.requires_grad_() for key, x in given.items() if x.is_floating_point()}
    value = case.loss(**given)
    slopes = torch.autograd.grad(value.sum(), list(inputs.values()), allow_unused=True)
    return value.detach(), {k: s for k, s in zip(inputs, slopes, strict=True) if s is not None}


@EVERY
def test_finite_loss_has_finite_gradients_and_holes_leave_no_trace(case):
    numbers = [name for name, x in case.given().items() if x.is_floating_point()]
    holes = [(hole, False) for hole in (torch.nan, torch.inf, 0.0, 1e-30, 1e20, 1e38)]
    holes += [(hole, True) for hole in (torch.nan, torch.inf, 0.0, 1e20)]
    for name, (hole, everywhere) in product(numbers, holes):
        value, slopes = holed(case, name, hole, everywhere)
        for b in range(B):
            for by, slope in slopes.items():
                assert not value[b].isfinite() or slope[b].isfinite().all(), (name, by)
        if value[0].isfinite() and not math.isfinite(hole):  # left out: as with any other mark of a hole
            other, same = holed(case, name, -torch.inf if "depth" in name else torch.nan, everywhere)
            torch.testing.assert_close(other, value)
            torch.testing.assert_close(same, slopes)
