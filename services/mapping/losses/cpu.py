"""`losses.mapping_loss` for CPUs: composition, colour and depth error in two fused passes.

Plain torch makes some thirty passes over images that leave the cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from services.mapping.config import LossConfig
from services.mapping.losses.kernels import PIECE, Images, Look, compare, compare_back
from services.mapping.losses.mapping_loss import Appearance, Loss, Target, mapping_loss
from services.mapping.rasterizer import Rendered
from services.mapping.rasterizer.scratch import scratch
from services.mapping.rasterizer.simd import LANES
from services.mapping.rasterizer.threads import default_threads, workers

Array = NDArray[np.float32]


def mapping_loss_cpu(
    rendered: Rendered, target: Target, appearance: Appearance, config: LossConfig
) -> Loss:
    """The same as `losses.mapping_loss`."""
    if target.moving is not None:  # few keyframes are so: theirs may take longer
        return mapping_loss(rendered, target, appearance, config)
    comparison = target, appearance.background.numpy(), config.max_depth_error_m
    image, colour, squared, depth = _Compare.apply(
        rendered.colour, rendered.depth, rendered.alpha, appearance.exposure, comparison
    )  # pyright: ignore[reportGeneralTypeIssues]
    total = (1.0 - config.ssim) * (colour + config.square * squared) + config.depth * depth
    if config.ssim > 0:
        total = total + config.ssim * (1.0 - target.similarity(image))
    return Loss(total, squared.detach())


class _Compare(torch.autograd.Function):
    """(colour, depth, alpha, exposure) -> (image, mean L1, mean squared error, mean depth L1)."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        colour, depth, alpha, exposure, (target, background, max_error) = inputs
        count = alpha.numel()
        columns = (colour, depth, alpha, target.colour, target.depth)
        images = Images(*map(_whole_vectors, columns), pixels=count)
        gain, bias = exposure.detach().numpy()
        look = Look(background, gain, bias, np.float32(max_error))
        image, sums = scratch().borrow(_room(count) * 3), _sums(count)
        workers(default_threads()).run(compare, images, look, image, sums)
        ctx.images, ctx.look, ctx.shape = images, look, alpha.shape
        total = sums.sum(0, dtype=np.float64)[:3] / (-3 * count, 3 * count, -count)
        means = torch.from_numpy(total.astype(np.float32))
        return _image(image, (*alpha.shape, 3)), means[0], means[1], means[2]

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        by_image, by_colour, by_square, by_depth = gradients
        count, room = ctx.images.pixels, _room(ctx.images.pixels)
        shares = by_colour / (3 * count), 2.0 * by_square / (3 * count), by_depth / count
        borrow = scratch().borrow
        down = borrow(room * 3), borrow(room), borrow(room), _sums(count)
        slopes = _whole_vectors(by_image), *map(np.float32, shares)
        workers(default_threads()).run(compare_back, ctx.images, ctx.look, slopes, down)
        by_exposure = down[3].sum(0, dtype=np.float64)[:6].astype(np.float32).reshape(2, 3)
        shapes = (*ctx.shape, 3), ctx.shape, ctx.shape
        images = (_image(array, shape) for array, shape in zip(down, shapes, strict=False))
        return *images, torch.from_numpy(by_exposure), None


def _room(pixels: int) -> int:
    """Pixels in whole vectors."""
    return -(-pixels // LANES) * LANES


def _sums(pixels: int) -> Array:
    return np.empty((-(-pixels // PIECE), LANES), np.float32)


def _whole_vectors(image: Tensor) -> Array:
    """The image, flat; a copy with zeros behind it where its pixels do not fill vectors."""
    flat = image.detach().contiguous().numpy().reshape(-1)
    pixels = image.shape[0] * image.shape[1]
    spare = (_room(pixels) - pixels) * flat.size // pixels
    return np.pad(flat, (0, spare)) if spare else flat


def _image(array: Array, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(array[: int(np.prod(shape))].reshape(shape))
