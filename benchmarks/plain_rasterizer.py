"""Yardsticks of the rasterizer: the textbook kernel, torch's SSIM, and the processor's peak."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from services.mapping.rasterizer.kernel_types import TILE, Tiles
from services.mapping.rasterizer.lanes import any_lane
from services.mapping.rasterizer.simd import LANES, kernel, splat

_CHAINS, _STEPS = 10, 2_000_000


def milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Median wall time; the first call, which compiles, does not count."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _blend_pixels(records, lists, width, height, image):
    """Blend pixel by pixel; gives how many (Gaussian, pixel) pairs it blended."""
    columns, pairs = (width + TILE - 1) // TILE, 0
    for y in range(height):
        for x in range(width):
            tile = (y // TILE) * columns + x // TILE
            light = np.float32(1.0)
            for place in range(lists.tile_starts[tile], lists.tile_starts[tile + 1]):
                slot = np.int64(lists.keys[place] & np.uint64(0xFFFFFFFF))
                record = records[lists.owners[slot]]
                dx, dy = np.float32(x) + 0.5 - record[0], np.float32(y) + 0.5 - record[1]
                e1, e2 = dx * record[2], (dy - record[3] * dx) * record[4]
                alpha = min(math.exp(8.0 * (record[5] - e1 * e1 - e2 * e2)), 0.999)
                if alpha < 1.0 / 255.0:
                    continue
                weight = alpha * light
                if light - weight <= 1e-4:
                    break
                pairs += 1
                light -= weight
                for channel in range(4):
                    image[y, x, channel] += weight * record[6 + channel]
    return pairs


def blend_pixels(tiles: Tiles) -> int:
    """Blend sorted tile lists by the textbook, one thread; gives the number of blended pairs."""
    camera = tiles.camera
    image = np.zeros((camera.height, camera.width, 4), np.float32)
    records = tiles.records.reshape(-1, 16)
    return _blend_pixels(records, tiles.lists, camera.width, camera.height, image)


def torch_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM of images [H, W, 3] by 11x11 convolutions."""
    taps = torch.exp(-(torch.arange(-5.0, 6.0) ** 2) / (2 * 1.5**2))
    taps = taps / taps.sum()
    window = (taps[:, None] * taps[None, :]).expand(3, 1, 11, 11)
    x, y = (each.permute(2, 0, 1)[None] for each in (image, target))

    def blurred(planes: Tensor) -> Tensor:
        return functional.conv2d(planes, window, padding=5, groups=3)

    mean_x, mean_y = blurred(x), blurred(y)
    variances = blurred(x * x) - mean_x**2 + blurred(y * y) - mean_y**2 + 0.03**2
    covariance = 2 * (blurred(x * y) - mean_x * mean_y) + 0.03**2
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    return (luminance * covariance / variances).mean()


@kernel
def _multiply_add(steps, factor):
    """Ten chains of dependent fused multiply-adds, enough to fill the pipelines."""
    a, b, c, d, e = splat(0.1), splat(0.2), splat(0.3), splat(0.4), splat(0.5)
    f, g, h, i, j = splat(0.6), splat(0.7), splat(0.8), splat(0.9), splat(1.1)
    x, y = splat(factor), splat(factor + 0.5)
    for _ in range(steps):
        a, b, c, d, e = a * x + y, b * x + y, c * x + y, d * x + y, e * x + y
        f, g, h, i, j = f * x + y, g * x + y, h * x + y, i * x + y, j * x + y
    return any_lane(a + b + c + d + e + f + g + h + i + j > factor)


def peak_gflops() -> float:
    """Measured billions of operations per second of one core, a fused multiply-add being two."""
    times = []
    for _ in range(6):
        start = time.perf_counter()
        _multiply_add(_STEPS, np.float32(0.5))
        times.append(time.perf_counter() - start)
    return 2e-9 * LANES * _CHAINS * _STEPS / min(times)
