"""Yardsticks of the rasterizer: the textbook kernel, torch's SSIM, and the processor's peak."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from services.mapping.rasterizer.kernel_types import (
    CUT,
    DEPTH,
    HALF_HEIGHT,
    HALF_WIDTH,
    MEAN_X,
    MEAN_Y,
    RECORD,
    Camera,
    Projected,
)
from services.mapping.rasterizer.lanes import any_lane
from services.mapping.rasterizer.scene import ALPHA_MAX, TRANSMITTANCE_MIN
from services.mapping.rasterizer.simd import LANES, kernel, splat

_CHAINS, _STEPS = 10, 2_000_000
_TILE = 16  # the textbook's tile, pixels
_ONE, _HALF, _EIGHT = np.float32(1.0), np.float32(0.5), np.float32(8.0)
_OPAQUE, _STOP = np.float32(ALPHA_MAX), np.float32(TRANSMITTANCE_MIN)


def milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Median wall time; the first call, which compiles, does not count."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


@dataclass(frozen=True)
class PlainScene:
    """Projected Gaussians in lists of 16x16 tiles, by depth: what the textbook starts with."""

    records: NDArray[np.float32]  # [N, 16]
    starts: NDArray[np.int64]  # bounds of each tile in `members`
    members: NDArray[np.int32]
    size: tuple[int, int]  # width and height

    @staticmethod
    def of(projected: Projected, camera: Camera) -> PlainScene:
        """List every visible Gaussian in the tiles of the box around its ellipse."""
        records = projected.records.reshape(-1, RECORD)[: projected.num_gaussians]
        order = np.nonzero(projected.visible())[0]
        order = order[np.argsort(records[order, DEPTH], kind="stable")]
        size = camera.width, camera.height
        tiles = -(-size[0] // _TILE) * -(-size[1] // _TILE)
        counts = np.zeros(tiles + 1, np.int64)
        _list_members(records, order, size, counts[1:], np.empty(0, np.int32))
        starts = np.cumsum(counts)
        members = np.empty(starts[-1], np.int32)
        _list_members(records, order, size, starts[:-1].copy(), members)
        return PlainScene(records, starts, members, size)

    def blend(self) -> int:
        """Render on one thread; gives the number of blended (Gaussian, pixel) pairs."""
        image = np.empty((self.size[1], self.size[0], 5), np.float32)
        return _blend_pixels(self.records, self.starts, self.members, image)


@numba.njit(cache=True)
def _list_members(records, order, size, places, members):
    """Count the Gaussians of each tile in `places`, or write them there if `members` has room."""
    width, height = size
    columns, rows = (width + _TILE - 1) // _TILE, (height + _TILE - 1) // _TILE
    for i in order:
        x, y = records[i, MEAN_X], records[i, MEAN_Y]
        half_width, half_height = records[i, HALF_WIDTH], records[i, HALF_HEIGHT]
        left = max(int((x - half_width) / _TILE), 0)
        right = min(int((x + half_width) / _TILE), columns - 1)
        top = max(int((y - half_height) / _TILE), 0)
        bottom = min(int((y + half_height) / _TILE), rows - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                tile = row * columns + column
                if len(members):
                    members[places[tile]] = i
                places[tile] += 1


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _blend_pixels(records, starts, members, image):
    """The textbook: for every pixel, every Gaussian of its tile from front to back."""
    height, width, _ = image.shape
    columns, pairs = (width + _TILE - 1) // _TILE, 0
    for y in range(height):
        for x in range(width):
            tile = (y // _TILE) * columns + x // _TILE
            light = _ONE
            red = green = blue = depth = np.float32(0.0)
            for place in range(starts[tile], starts[tile + 1]):
                i = members[place]
                dx, dy = (
                    np.float32(x) + _HALF - records[i, 0],
                    np.float32(y) + _HALF - records[i, 1],
                )
                e1, e2 = dx * records[i, 2], (dy - records[i, 3] * dx) * records[i, 4]
                exponent = records[i, 5] - e1 * e1 - e2 * e2
                if exponent < CUT:
                    continue
                weight = min(math.exp(_EIGHT * exponent), _OPAQUE) * light
                if light - weight <= _STOP:
                    break
                pairs += 1
                light -= weight
                red += weight * records[i, 6]
                green += weight * records[i, 7]
                blue += weight * records[i, 8]
                depth += weight * records[i, 9]
            image[y, x, 0], image[y, x, 1], image[y, x, 2] = red, green, blue
            image[y, x, 3], image[y, x, 4] = depth, _ONE - light
    return pairs


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
