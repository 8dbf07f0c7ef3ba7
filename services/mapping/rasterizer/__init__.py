"""Differentiable rasterization of Gaussians: Numba SIMD on the CPU, gsplat on CUDA."""

from __future__ import annotations

import numpy as np
import torch

from services.mapping.rasterizer.cpu import CpuRasterizer
from services.mapping.rasterizer.gsplat import GsplatRasterizer
from services.mapping.rasterizer.scene import (
    Gaussians,
    Rasterizer,
    Rendered,
    ScreenStatistics,
    View,
)
from shared.camera import Intrinsics
from shared.errors import ConfigError

__all__ = [
    "CpuRasterizer",
    "Gaussians",
    "GsplatRasterizer",
    "Rasterizer",
    "Rendered",
    "ScreenStatistics",
    "View",
    "rasterizer_for",
    "warm_up",
]


def rasterizer_for(device: str, threads: int | None = None) -> Rasterizer:
    """The backend for a device, "cpu" or "cuda"; `threads` matters to the CPU only.

    Raises:
        ConfigError: there is no such device, or it lacks gsplat.
    """
    if device == "cpu":
        return CpuRasterizer(threads)
    if device.split(":")[0] == "cuda":
        return GsplatRasterizer()
    raise ConfigError(f'device must be "cpu" or "cuda", got "{device}"')


def warm_up() -> None:
    """Compile, or load from the cache, every CPU kernel, forward and backward."""
    fields = [torch.full((1, size), 0.5, requires_grad=True) for size in (3, 3, 4, 1, 3)]
    means, scales, quats, opacities, colours = fields
    view = View(np.eye(4), Intrinsics(32.0, 32.0, 15.5, 15.5, 32, 32))
    gaussians = Gaussians(means, scales, quats, opacities[:, 0], colours)
    CpuRasterizer()(gaussians, view).colour.sum().backward()
