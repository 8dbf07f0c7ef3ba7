"""The kernels of SSIM: an image is three planes of rows with margins, a piece of work is a row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.rasterizer.lanes import lane
from services.mapping.rasterizer.memory import fetch_add, load, store
from services.mapping.rasterizer.simd import LANES, allocating, inlined, kernel, ramp, select, splat

_RADIUS = 5
_WINDOW = np.exp(-(np.arange(-_RADIUS, _RADIUS + 1) ** 2) / (2 * 1.5**2))
_TAPS = tuple(np.float32(tap) for tap in _WINDOW / _WINDOW.sum())
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ZERO, _TWO = np.float32(0.0), np.float32(2.0)
_MARGIN = LANES  # zeros left and right of each row, so that strips may read past the border


class Layout(NamedTuple):
    """An image as three planes of rows with margins."""

    height: int
    width: int
    stride: int

    @staticmethod
    def of(image: Tensor) -> Layout:
        height, width, _ = image.shape
        return Layout(height, width, -(-width // LANES) * LANES + 2 * _MARGIN)

    def planes(self) -> NDArray[np.float32]:
        return np.empty(3 * self.height * self.stride, np.float32)


class Target(NamedTuple):
    """Planes of the target, its blur, and the blur of its square."""

    pixels: NDArray[np.float32]
    means: NDArray[np.float32]
    squares: NDArray[np.float32]


class Slopes(NamedTuple):
    """Planes of dSSIM by the image's blur, by that of its square, and of its product."""

    means: NDArray[np.float32]
    squares: NDArray[np.float32]
    products: NDArray[np.float32]


@kernel
def pack(image, planes, layout, counter):
    """[H, W, 3] to three planes with zero margins, a row per count."""
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= layout.height:
            return
        for channel in range(3):
            row = (channel * layout.height + y) * layout.stride
            planes[row : row + layout.stride] = _ZERO
            for x in range(layout.width):
                planes[row + _MARGIN + x] = image[(y * layout.width + x) * 3 + channel]


@inlined
def _across(row, x):
    """Horizontal blur of LANES columns: 11 symmetric taps around column x."""
    total = load(row, x) * _TAPS[5]
    total = total + (load(row, x - 1) + load(row, x + 1)) * _TAPS[4]
    total = total + (load(row, x - 2) + load(row, x + 2)) * _TAPS[3]
    total = total + (load(row, x - 3) + load(row, x + 3)) * _TAPS[2]
    total = total + (load(row, x - 4) + load(row, x + 4)) * _TAPS[1]
    return total + (load(row, x - 5) + load(row, x + 5)) * _TAPS[0]


@inlined
def _taps_inside(y, height):
    """First and one past the last tap of the vertical blur that lie in the image."""
    return max(0, _RADIUS - y), min(2 * _RADIUS + 1, height + _RADIUS - y)


@allocating
def _rows(stride):
    """Three rows for the vertical blurs."""
    return np.zeros(stride, np.float32), np.zeros(stride, np.float32), np.zeros(stride, np.float32)


@kernel
def blur_target(target, layout, counter):
    """Fill the blurs of a target, a row per count."""
    pixels, means, squares = target
    height, width, stride = layout
    down, down_square, _ = _rows(stride)
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            return
        for channel in range(3):
            row = (channel * height + y) * stride
            _blur_down(pixels, pixels, (row, y), layout, (down, down_square, down_square))
            for x in range(_MARGIN, width + _MARGIN, LANES):
                store(means, row + x, _across(down, x))
                store(squares, row + x, _across(down_square, x))


@inlined
def _blur_down(a, b, place, layout, rows):
    """Vertical blurs of a row of a, a b, and a a, in the order (a, a a, a b)."""
    row, y = place
    down, down_square, down_product = rows
    first, last = _taps_inside(y, layout.height)
    for x in range(0, layout.stride, LANES):
        mean, square, product = splat(_ZERO), splat(_ZERO), splat(_ZERO)
        for tap in range(first, last):
            source = row + (tap - _RADIUS) * layout.stride + x
            value = load(a, source)
            weighted = value * _TAPS[tap]
            mean, square = mean + weighted, square + weighted * value
            product = product + weighted * load(b, source)
        store(down, x, mean)
        store(down_product, x, product)
        store(down_square, x, square)


@kernel
def compare(image, comparison, layout, row_sums, counter):
    """SSIM of a row summed over its pixels and channels, and its slopes, a row per count."""
    target, slopes = comparison
    rows = _rows(layout.stride)
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= layout.height:
            return
        row_sums[y] = 0.0
        for channel in range(3):
            row = (channel * layout.height + y) * layout.stride
            _blur_down(image, target.pixels, (row, y), layout, rows)
            _clear_margins(slopes, row, layout.stride)
            total = splat(_ZERO)
            for x in range(_MARGIN, layout.width + _MARGIN, LANES):
                inside = ramp() + np.float32(x - _MARGIN) < np.float32(layout.width)
                total = total + _compare_strip(rows, target, slopes, (row, x), inside)
            for i in range(LANES):
                row_sums[y] += lane(total, i)


@inlined
def _clear_margins(slopes, row, stride):
    for plane in slopes:
        store(plane, row, splat(_ZERO))
        store(plane, row + stride - _MARGIN, splat(_ZERO))


@inlined
def _compare_strip(rows, target, slopes, place, inside):
    """SSIM of LANES pixels, zero outside the image; notes the slopes."""
    row, x = place
    mean, square, product = _across(rows[0], x), _across(rows[1], x), _across(rows[2], x)
    target_mean, target_square = load(target.means, row + x), load(target.squares, row + x)
    both, mean_square = mean * target_mean, mean * mean
    target_mean_square = target_mean * target_mean
    luminance = (both * _TWO + _C1) / (mean_square + target_mean_square + _C1)
    variances = (square - mean_square) + (target_square - target_mean_square) + _C2
    structure = ((product - both) * _TWO + _C2) / variances
    similarity = luminance * structure
    by_product = luminance * _TWO / variances
    by_square = similarity / variances * np.float32(-1.0)
    pull = (target_mean * structure - mean * similarity) * _TWO
    by_mean = pull / (mean_square + target_mean_square + _C1)
    by_mean = by_mean - by_product * target_mean - by_square * mean * _TWO
    store(slopes.means, row + x, select(inside, by_mean, _ZERO))
    store(slopes.squares, row + x, select(inside, by_square, _ZERO))
    store(slopes.products, row + x, select(inside, by_product, _ZERO))
    return select(inside, similarity, _ZERO)


@kernel
def spread_back(sources, layout, scale, result, counter):
    """Gradient at the image [H, W, 3], a row per count: the blur is its own transpose."""
    images, slopes = sources
    height, width, stride = layout
    rows, line = _rows(stride), np.empty(stride, np.float32)
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            return
        for channel in range(3):
            row = (channel * height + y) * stride
            _blur_slopes_down(slopes, (row, y), layout, rows)
            for x in range(_MARGIN, width + _MARGIN, LANES):
                store(line, x, _spread_strip(rows, images, (row, x)) * scale)
            for x in range(width):
                result[(y * width + x) * 3 + channel] = line[_MARGIN + x]


@inlined
def _blur_slopes_down(slopes, place, layout, rows):
    row, y = place
    first, last = _taps_inside(y, layout.height)
    for x in range(0, layout.stride, LANES):
        mean, square, product = splat(_ZERO), splat(_ZERO), splat(_ZERO)
        for tap in range(first, last):
            source = row + (tap - _RADIUS) * layout.stride + x
            mean = mean + load(slopes.means, source) * _TAPS[tap]
            square = square + load(slopes.squares, source) * _TAPS[tap]
            product = product + load(slopes.products, source) * _TAPS[tap]
        store(rows[0], x, mean)
        store(rows[1], x, square)
        store(rows[2], x, product)


@inlined
def _spread_strip(rows, images, place):
    row, x = place
    image, target = images
    by_square = _across(rows[1], x) * load(image, row + x) * _TWO
    return _across(rows[0], x) + by_square + _across(rows[2], x) * load(target, row + x)
