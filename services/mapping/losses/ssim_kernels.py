"""The kernels of SSIM: an image is three planes of rows with margins; work goes by bands."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from services.mapping.losses.ssim_kernels_blur import (
    blur_across,
    blur_planes_down,
    blur_products_down,
    spare_rows,
)
from services.mapping.rasterizer.lanes import lane
from services.mapping.rasterizer.memory import fetch_add, load, store
from services.mapping.rasterizer.places import ramp
from services.mapping.rasterizer.scratch import scratch
from services.mapping.rasterizer.shuffles import load_three, store_three
from services.mapping.rasterizer.simd import LANES, inlined, kernel, select, splat

_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ZERO, _TWO = np.float32(0.0), np.float32(2.0)
_BAND = 8  # rows in a piece of work: neighbours share what they read
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
        return scratch().borrow(3 * self.height * self.stride)


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
    """[H, W, 3] to three planes with zero margins, a band per count."""
    while True:
        first = fetch_add(counter, 0, _BAND)
        if first >= layout.height:
            return
        for y in range(first, min(first + _BAND, layout.height)):
            for channel in range(3):
                row = (channel * layout.height + y) * layout.stride
                planes[row : row + layout.stride] = _ZERO
            _unzip_row(image, planes, layout, y)


@inlined
def _unzip_row(image, planes, layout, y):
    """Copy a row of pixels to the three planes."""
    plane, row = layout.height * layout.stride, y * layout.stride + _MARGIN
    whole = layout.width // LANES * LANES
    for x in range(0, whole, LANES):
        red, green, blue = load_three(image, (y * layout.width + x) * 3)
        store(planes, row + x, red)
        store(planes, plane + row + x, green)
        store(planes, 2 * plane + row + x, blue)
    for x in range(whole, layout.width):
        for channel in range(3):
            planes[channel * plane + row + x] = image[(y * layout.width + x) * 3 + channel]


@kernel
def blur_target(target, layout, counter):
    """Fill the blurs of a target, a band per count."""
    pixels, means, squares = target
    height, width, stride = layout
    down, down_square, _ = spare_rows(stride)
    while True:
        first = fetch_add(counter, 0, _BAND)
        if first >= height:
            return
        for y in range(first, min(first + _BAND, height)):
            for channel in range(3):
                row = (channel * height + y) * stride
                blur_products_down(
                    pixels, pixels, (row, y), layout, (down, down_square, down_square)
                )
                for x in range(_MARGIN, width + _MARGIN, LANES):
                    store(means, row + x, blur_across(down, x))
                    store(squares, row + x, blur_across(down_square, x))


@kernel
def compare(image, comparison, layout, row_sums, counter):
    """SSIM of a row summed over its pixels and channels, and its slopes, a band per count."""
    target, slopes = comparison
    rows = spare_rows(layout.stride)
    while True:
        first = fetch_add(counter, 0, _BAND)
        if first >= layout.height:
            return
        for y in range(first, min(first + _BAND, layout.height)):
            row_sums[y] = 0.0
            for channel in range(3):
                row = (channel * layout.height + y) * layout.stride
                blur_products_down(image, target.pixels, (row, y), layout, rows)
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
    mean, square, product = (
        blur_across(rows[0], x),
        blur_across(rows[1], x),
        blur_across(rows[2], x),
    )
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
    """Gradient at the image [H, W, 3], a band per count: the blur is its own transpose."""
    images, slopes = sources
    height, width, stride = layout
    rows, lines = spare_rows(stride), np.empty(3 * stride, np.float32)
    while True:
        first = fetch_add(counter, 0, _BAND)
        if first >= height:
            return
        for y in range(first, min(first + _BAND, height)):
            for channel in range(3):
                row = (channel * height + y) * stride
                blur_planes_down(slopes, (row, y), layout, rows)
                for x in range(_MARGIN, width + _MARGIN, LANES):
                    strip = _spread_strip(rows, images, (row, x)) * scale
                    store(lines, channel * stride + x, strip)
            _zip_row(lines, result, layout, y)


@inlined
def _zip_row(lines, result, layout, y):
    """Copy a row of each plane to a row of pixels."""
    width, stride = layout.width, layout.stride
    whole = width // LANES * LANES
    for x in range(0, whole, LANES):
        place = _MARGIN + x
        red, green = load(lines, place), load(lines, stride + place)
        store_three(result, (y * width + x) * 3, (red, green, load(lines, 2 * stride + place)))
    for x in range(whole, width):
        for channel in range(3):
            result[(y * width + x) * 3 + channel] = lines[channel * stride + _MARGIN + x]


@inlined
def _spread_strip(rows, images, place):
    row, x = place
    image, target = images
    by_square = blur_across(rows[1], x) * load(image, row + x) * _TWO
    return blur_across(rows[0], x) + by_square + blur_across(rows[2], x) * load(target, row + x)
