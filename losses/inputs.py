"""Input checks of the losses: consistent shapes, bool masks, and arithmetic of at least float32."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")


def in_full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Widen floating-point tensors among the arguments to one dtype, float32 at least, and leave autocast.

    Sums over an image pass float16's largest number (65 504), and its 11 bits place a pixel of a 640 wide image to
    half a pixel only. Gradients arrive in the inputs' own dtypes. Numbers whose fourth power the dtype cannot hold
    (float32: 4e9) become NaN: products of squares would be infinite, and their gradients NaN beside a finite loss.
    """

    def widened(*args: P.args, **kwargs: P.kwargs) -> R:
        tensors = [x for x in (*args, *kwargs.values()) if isinstance(x, Tensor)]
        dtype = torch.float32
        for x in tensors:
            dtype = torch.promote_types(dtype, x.dtype) if x.is_floating_point() else dtype
        wide = [_widened(x, dtype) for x in args]
        named = {name: _widened(x, dtype) for name, x in kwargs.items()}
        with torch.autocast(tensors[0].device.type if tensors else "cpu", enabled=False):
            return function(*wide, **named)  # type: ignore[arg-type]

    # torch.compile gives up on code that it has compiled for eight types: each loss has its own.
    widened.__code__ = widened.__code__.replace(co_name=function.__name__)
    return wraps(function)(widened)


def _widened(x: object, dtype: torch.dtype) -> object:
    if not (isinstance(x, Tensor) and x.is_floating_point()):
        return x
    x = x.to(dtype)
    return x.where(x.abs() < torch.finfo(dtype).max ** 0.25, torch.nan)


def check_mask(mask: Tensor) -> None:
    """Refuse weights where a bool mask is expected.

    Raises:
        TypeError: If the mask is not bool.
    """
    if mask.dtype is not torch.bool:
        raise TypeError("mask must be bool, not numbers; write mask > 0.5 if that is what it means")


def check_images(**images: Tensor) -> None:
    """Refuse images that broadcasting would mix up, such as ``(B, H, W)`` with ``(B, 1, H, W)``.

    Raises:
        ValueError: If shapes differ, or there is no axis beside the batch's.
    """
    shapes = {name: tuple(x.shape) for name, x in images.items()}
    first = next(iter(shapes.values()))
    if any(shape != first for shape in shapes.values()) or len(first) < 2:
        raise ValueError(f"shapes must be the same, (B, 1, H, W): {_listed(shapes)}")


def check_shapes(**given: tuple[Tensor, str]) -> None:
    """Refuse tensors whose axes do not fit.

    Args:
        given: By name, a tensor and its axes: letters for sizes that must agree wherever they stand, numbers for
            themselves. Each may have one leading axis more, the batch, which must agree as well; a tensor whose axes
            begin with ``?`` may also do without while others have it.

    Raises:
        ValueError: With the shapes and what they should be.

    Example:
        >>> check_shapes(uv=(torch.zeros(5, 2), "N 2"), depth=(torch.zeros(4), "N"))
        Traceback (most recent call last):
        ValueError: shapes do not fit: uv (5, 2) should be (N, 2), depth (4,) should be (N,)
    """
    sizes: dict[str, int] = {}
    batches: list[tuple[int, ...]] = []  # no set: sizes of a traced graph cannot be hashed
    fits = True
    for x, axes in given.values():
        names = axes.removeprefix("? ").split()
        batch, own = tuple(x.shape[: x.ndim - len(names)]), tuple(x.shape[x.ndim - len(names) :])
        fits &= len(own) == len(names) and len(batch) <= 1
        if batch or not axes.startswith("?"):
            batches.append(batch)
        for name, size in zip(names, own, strict=False):
            fits &= size == (int(name) if name.isdigit() else sizes.setdefault(name, size))
    if not fits or any(batch != batches[0] for batch in batches):
        shapes = {name: tuple(x.shape) for name, (x, _) in given.items()}
        wanted = {name: _axes(axes.removeprefix("? ")) for name, (_, axes) in given.items()}
        also = "; with a batch, (B, ...) each" if any(batches) else ""
        said = ", ".join(f"{name} {shape} should be {wanted[name]}" for name, shape in shapes.items())
        raise ValueError(f"shapes do not fit: {said}{also}")


def _axes(axes: str) -> str:
    names = axes.split()
    return f"({', '.join(names)}{',' if len(names) == 1 else ''})"


def _listed(shapes: dict[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{name} {shape}" for name, shape in shapes.items())
