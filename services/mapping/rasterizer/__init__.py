"""Differentiable rasterization of Gaussians: Numba SIMD on the CPU, gsplat on CUDA.

How the CPU backend gets its speed, in the order of the work:

* **Vectors** (`simd`, `memory`, `shuffles`). Kernels are written in an explicit vector type of 16
  lanes with AVX-512, else 8; the compiler legalises it to what the processor has. Interleaved
  fields and whole records become vectors by shuffles in registers. Functions inside kernels do
  not count references to arrays: that alone had doubled the time of the inner loops.
* **Projection** (`projection`) of LANES Gaussians at a time to records of one cache line each. It
  also counts, per chunk of Gaussians, the hits of every tile.
* **Binning** (`binning`, `tile_boxes`). Prefix sums over those counts tell each chunk where to
  write, without locks and in the same order for any number of threads. A Gaussian whose box is
  one row or column of tiles, as nearly all are, goes through one loop without geometry. A tile
  sorts its own list by depth. Lists too long for memory are made for ranges of tiles in turn.
* **Blending** (`tiles`, `tiles_forward`) goes Gaussian by Gaussian through a tile whose planes
  stay in the cache. The Gaussians of a batch are first cut into strips of 8 columns that start at
  the ellipse's own left edge, while the records of the next batch are on their way from memory;
  then a plain loop paints strips, one or two rows per vector. In a strip the exponent needs two
  fused multiply-adds; exp is a polynomial of degree 5 squared three times. The sign of the
  transmittance says that a pixel is full.
* **Backward** (`tiles_backward`) runs in the same order and recomputes alpha: with the light that
  is still to come kept per pixel, nothing has to be saved. Each (Gaussian, tile) pair has its own
  gradient record, so there are no atomics, and the records lie in the order of the Gaussians, so
  that the derivative of the projection (`projection_backward`) reads them as a stream.
* **Memory** (`scratch`). All large arrays, the returned images and gradients included, go back
  to a pool when their last reference is dropped; they start at cache lines.
* **Threads** (`threads`) take pieces of fixed size from a shared counter. A caller that has done
  its work alone does not wait for helpers that are busy for another.
"""

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
    WeightedSums,
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
    "WeightedSums",
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
    CpuRasterizer().with_sums(gaussians, view)[1](torch.ones(32, 32, 4))
