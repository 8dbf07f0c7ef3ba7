"""`losses.mapping_loss` for CPUs: composition, L1 and depth error in two fused passes.

Plain torch makes some thirty passes over images that leave the cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from services.mapping.config import LossConfig
from services.mapping.losses import MIN_DEPTH_ALPHA, Appearance, Loss, Target
from services.mapping.rasterizer import Rendered
from services.mapping.workers import in_pieces

Array = NDArray[np.float32]
_PIECE = 16384  # pixels
_MIN_ALPHA = np.float32(MIN_DEPTH_ALPHA)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


def mapping_loss_cpu(
    rendered: Rendered, target: Target, appearance: Appearance, config: LossConfig
) -> Loss:
    """The same as `losses.mapping_loss`."""
    comparison = target, appearance.background.numpy(), config.max_depth_error_m
    image, colour, squared, depth = _Compare.apply(
        rendered.colour, rendered.depth, rendered.alpha, appearance.exposure, comparison
    )  # pyright: ignore[reportGeneralTypeIssues]
    total = (1.0 - config.ssim) * colour + config.depth * depth
    if config.ssim > 0:
        total = total + config.ssim * (1.0 - target.similarity(image))
    return Loss(total, squared.detach())


class _Images(NamedTuple):
    """Flat images of one comparison."""

    colour: Array  # rendered, [P, 3]
    depth: Array  # rendered sum of w z, [P]
    alpha: Array  # [P]
    true_colour: Array  # [P, 3]
    true_depth: Array  # [P]

    def part(self, start: int, stop: int) -> _Images:
        return _Images(*(image[start:stop] for image in self))


class _Look(NamedTuple):
    """How colours come about, and which depth errors count."""

    background: Array  # [3]
    gain: Array  # [3]
    bias: Array  # [3]
    max_depth_error: np.float32


class _Compare(torch.autograd.Function):
    """(colour, depth, alpha, exposure) -> (image, mean L1, mean squared error, mean depth L1)."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        colour, depth, alpha, exposure, (target, background, max_error) = inputs
        count = alpha.numel()
        images = _Images(
            _flat(colour, 3),
            _flat(depth),
            _flat(alpha),
            _flat(target.colour, 3),
            _flat(target.depth),
        )
        gain, bias = exposure.detach().numpy()
        look = _Look(background, gain, bias, np.float32(max_error))
        image = np.empty((count, 3), np.float32)

        def work(start: int, stop: int) -> NDArray[np.float64]:
            return _compare(images.part(start, stop), look, image[start:stop])

        sums = np.sum(in_pieces(work, count, _PIECE), axis=0) / (3 * count, 3 * count, count)
        ctx.images, ctx.look, ctx.shape = images, look, alpha.shape
        means = torch.from_numpy(sums.astype(np.float32))
        return torch.from_numpy(image).view(*alpha.shape, 3), means[0], means[1], means[2]

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        by_image, by_colour, _, by_depth = gradients
        images, look = ctx.images, ctx.look
        count = len(images.alpha)
        upstream = _flat(by_image, 3)
        weights = np.float32(by_colour / (3 * count)), np.float32(by_depth / count)
        down = (
            np.empty((count, 3), np.float32),
            np.empty(count, np.float32),
            np.empty(count, np.float32),
        )

        def work(start: int, stop: int) -> NDArray[np.float64]:
            part = tuple(array[start:stop] for array in down)
            return _compare_back(
                images.part(start, stop), look, upstream[start:stop], weights, part
            )

        by_exposure = np.sum(in_pieces(work, count, _PIECE), axis=0).astype(np.float32)
        colour, depth, alpha = (torch.from_numpy(array) for array in down)
        return (
            colour.view(*ctx.shape, 3),
            depth.view(ctx.shape),
            alpha.view(ctx.shape),
            torch.from_numpy(by_exposure),
            None,
        )


def _flat(image: Tensor, channels: int = 0) -> Array:
    shape = (-1, channels) if channels else (-1,)
    return image.detach().contiguous().view(shape).numpy()


@numba.njit(inline="always")
def _depth_error(images, look, i):  # pragma: no cover - compiled
    """Error of a pixel's depth, metres; 0 where it says nothing."""
    alpha, truth = images.alpha[i], images.true_depth[i]
    if not (truth > _ZERO and alpha > _MIN_ALPHA):
        return _ZERO
    error = images.depth[i] / alpha - truth
    return error if abs(error) < look.max_depth_error else _ZERO


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _compare(images, look, image):  # pragma: no cover - compiled
    """Fill `image`; sums of |colour error|, its square, and |depth error|."""
    colour_sum = squared_sum = depth_sum = 0.0
    for i in range(len(images.alpha)):
        rest = _ONE - images.alpha[i]
        for c in range(3):
            composite = images.colour[i, c] + rest * look.background[c]
            value = composite * look.gain[c] + look.bias[c]
            image[i, c] = value
            error = value - images.true_colour[i, c]
            colour_sum += abs(error)
            squared_sum += error * error
        depth_sum += abs(_depth_error(images, look, i))
    return np.array([colour_sum, squared_sum, depth_sum])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _compare_back(images, look, upstream, weights, down):  # pragma: no cover - compiled
    """Fill the gradients at colour, depth and alpha; sums of those at gain and bias, [2, 3]."""
    by_colour, by_depth, by_alpha = down
    colour_weight, depth_weight = weights
    exposure = np.zeros((2, 3))
    for i in range(len(images.alpha)):
        alpha_gradient = _ZERO
        for c in range(3):
            composite = images.colour[i, c] + (_ONE - images.alpha[i]) * look.background[c]
            error = composite * look.gain[c] + look.bias[c] - images.true_colour[i, c]
            gradient = upstream[i, c] + np.float32(np.sign(error)) * colour_weight
            exposure[0, c] += gradient * composite
            exposure[1, c] += gradient
            gradient *= look.gain[c]
            by_colour[i, c] = gradient
            alpha_gradient -= gradient * look.background[c]
        slope = np.float32(np.sign(_depth_error(images, look, i))) * depth_weight
        share = slope / max(images.alpha[i], _MIN_ALPHA)
        by_depth[i] = share
        by_alpha[i] = alpha_gradient - share * images.depth[i] / max(images.alpha[i], _MIN_ALPHA)
    return exposure
