"""Structural similarity in plain torch, for devices that `ssim` has no kernels for."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim_torch(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM of two images [H, W, 3] by the definition of `ssim.ssim`, on any device."""
    a, b = (x.permute(2, 0, 1)[:, None] for x in (image, target))
    blurred = _blur(torch.cat([a, b, a * a, b * b, a * b])).chunk(5)
    mean_a, mean_b, square_a, square_b, product = blurred
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    variances = square_a - mean_a**2 + square_b - mean_b**2
    structure = (2 * (product - mean_a * mean_b) + _C2) / (variances + _C2)
    return (luminance * structure).mean()


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes [N, 1, H, W], zeros beyond the border."""
    offsets = torch.arange(-_RADIUS, _RADIUS + 1, device=planes.device, dtype=planes.dtype)
    taps = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    taps = taps / taps.sum()
    across = conv2d(planes, taps.view(1, 1, 1, -1), padding=(0, _RADIUS))
    return conv2d(across, taps.view(1, 1, -1, 1), padding=(_RADIUS, 0))
