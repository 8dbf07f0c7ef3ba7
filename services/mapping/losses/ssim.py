"""Structural similarity and its gradient in fused SIMD kernels.

SSIM as in Wang et al. 2004, with the window of 3D Gaussian Splatting: 11x11 Gaussian, sigma 1.5,
zeros beyond the border, channels on their own. A target seen more than once keeps its own blurs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from services.mapping.losses.ssim_kernels import (
    Layout,
    Slopes,
    Target,
    blur_target,
    compare,
    pack,
    spread_back,
)
from services.mapping.rasterizer.scratch import scratch
from services.mapping.rasterizer.threads import default_threads, workers
from shared.errors import InputError


@dataclass(frozen=True)
class SsimTarget:
    """A target image with what its comparisons share; build it with `of` and keep it."""

    layout: Layout
    target: Target

    @staticmethod
    def of(image: Tensor, threads: int | None = None) -> SsimTarget:
        """Prepare a target [H, W, 3], values 0 to 1.

        Raises:
            InputError: the image has another shape or type.
        """
        layout = Layout.of(_checked(image, "target"))
        pixels = _packed(image, layout, threads)
        target = Target(pixels, layout.planes(), layout.planes())
        _run(threads, blur_target, target, layout)
        return SsimTarget(layout, target)


def ssim(image: Tensor, target: Tensor | SsimTarget, threads: int | None = None) -> Tensor:
    """Mean structural similarity of two images, at most 1; differentiable in the first.

    Args:
        image: float32 on the CPU, values 0 to 1, [H, W, 3].
        target: the same, or what `SsimTarget.of` made of it.
        threads: how many to use; one per core, at most 8, by default.

    Raises:
        InputError: shapes or types do not fit.
    """
    _checked(image, "image")
    if isinstance(target, Tensor):
        target = SsimTarget.of(target, threads)
    if Layout.of(image) != target.layout:
        expected = [target.layout.height, target.layout.width, 3]
        raise InputError("image", f"must be {expected} as the target, got {list(image.shape)}")
    return _Ssim.apply(image, target, threads)  # pyright: ignore[reportReturnType]


def warm_up() -> None:
    """Compile or load every kernel of this module."""
    image = torch.full((16, 16, 3), 0.5, requires_grad=True)
    ssim(image, image.detach()).backward()


def _checked(image: Tensor, name: str) -> Tensor:
    if image.ndim != 3 or image.shape[-1] != 3 or image.dtype != torch.float32:
        found = f"{image.dtype} {list(image.shape)}"
        raise InputError(name, f"must be float32 [H, W, 3], got {found}")
    return image


def _run(threads: int | None, function: Any, *arguments: object) -> None:
    workers(threads or default_threads()).run(function, *arguments)


def _packed(image: Tensor, layout: Layout, threads: int | None) -> NDArray[np.float32]:
    """The planes of an image [H, W, 3]."""
    planes = layout.planes()
    flat = image.detach().contiguous().numpy().reshape(-1)
    _run(threads, pack, flat, planes, layout)
    return planes


class _Ssim(torch.autograd.Function):
    """(image, target, threads) -> mean SSIM."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        image, ctx.target, ctx.threads = inputs
        layout = ctx.target.layout
        ctx.pixels = _packed(image, layout, ctx.threads)
        ctx.slopes = Slopes(layout.planes(), layout.planes(), layout.planes())
        row_sums = np.empty(layout.height, np.float64)
        comparison = ctx.target.target, ctx.slopes
        _run(ctx.threads, compare, ctx.pixels, comparison, layout, row_sums)
        return torch.tensor(row_sums.sum() / (3 * layout.height * layout.width), dtype=image.dtype)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None]:
        layout = ctx.target.layout
        scale = np.float32(gradients[0].item() / (3 * layout.height * layout.width))
        result = scratch().borrow(layout.height * layout.width * 3)
        sources = (ctx.pixels, ctx.target.target.pixels), ctx.slopes
        _run(ctx.threads, spread_back, sources, layout, scale, result)
        return torch.from_numpy(result).view(layout.height, layout.width, 3), None, None
