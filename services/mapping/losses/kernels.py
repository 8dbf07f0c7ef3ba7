"""Kernels of `losses_cpu`: composition, colour and depth error, a vector of pixels at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapping.losses.mapping_loss import MIN_DEPTH_ALPHA
from services.mapping.rasterizer.memory import fetch_add, load, store
from services.mapping.rasterizer.places import ramp
from services.mapping.rasterizer.shuffles import lane_sums, load_three, store_three
from services.mapping.rasterizer.simd import (
    LANES,
    inlined,
    kernel,
    maximum,
    negative_magnitude,
    select,
    splat,
)

Array = NDArray[np.float32]
PIECE = 2048  # pixels whose sums are added in float32
_MIN_ALPHA = np.float32(MIN_DEPTH_ALPHA)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


class Images(NamedTuple):
    """Flat images of one comparison, with room for whole vectors behind the last pixel."""

    colour: Array  # rendered, P * 3
    depth: Array  # rendered sum of w z, P
    alpha: Array  # P
    true_colour: Array  # P * 3
    true_depth: Array  # P
    pixels: int


class Look(NamedTuple):
    """How colours come about, and which depth errors count."""

    background: Array  # [3]
    gain: Array  # [3]
    bias: Array  # [3]
    max_depth_error: np.float32


@kernel
def compare(images, look, image, sums, counter):
    """Fill `image`; sums [pieces, LANES] of -|colour error|, its square, and -|depth error|."""
    while True:
        piece = fetch_add(counter, 0, 1)
        start, stop = piece * PIECE, min(piece * PIECE + PIECE, images.pixels)
        if start >= stop:
            return
        zero = splat(_ZERO)
        colour_sum, squares, depth_sum = zero, zero, zero
        for i in range(start, stop, LANES):
            is_inside = ramp() < np.float32(stop - i)
            values, errors, _ = _colours(images, look, i, is_inside)
            store_three(image, 3 * i, values)
            for error in errors:
                colour_sum = colour_sum + negative_magnitude(error)
                squares = squares + error * error
            error, _ = _depth_error(images, look, i, is_inside)
            depth_sum = depth_sum + negative_magnitude(error)
        total = lane_sums((colour_sum, squares, depth_sum, zero, zero, zero, zero, zero))
        store(sums[piece], 0, total)


@kernel
def compare_back(images, look, slopes, down, counter):
    """Fill the gradients at colour, depth and alpha; sums [pieces, LANES] of gain's and bias's.

    `slopes` is (gradient at the image, weights of a colour error, of half its square, and of a
    depth error).
    """
    upstream, colour_weight, square_weight, depth_weight = slopes
    by_colour, by_depth, by_alpha, sums = down
    while True:
        piece = fetch_add(counter, 0, 1)
        start, stop = piece * PIECE, min(piece * PIECE + PIECE, images.pixels)
        if start >= stop:
            return
        zero = splat(_ZERO)
        gains, biases = (zero, zero, zero), (zero, zero, zero)
        for i in range(start, stop, LANES):
            is_inside = ramp() < np.float32(stop - i)
            _, errors, composites = _colours(images, look, i, is_inside)
            u = load_three(upstream, 3 * i)
            r, g, b = (
                select(is_inside, u[0] + _slope(errors[0], colour_weight, square_weight), zero),
                select(is_inside, u[1] + _slope(errors[1], colour_weight, square_weight), zero),
                select(is_inside, u[2] + _slope(errors[2], colour_weight, square_weight), zero),
            )
            biases = biases[0] + r, biases[1] + g, biases[2] + b
            gains = (
                gains[0] + r * composites[0],
                gains[1] + g * composites[1],
                gains[2] + b * composites[2],
            )
            r, g, b = r * look.gain[0], g * look.gain[1], b * look.gain[2]
            store_three(by_colour, 3 * i, (r, g, b))
            background = look.background
            behind = r * background[0] + g * background[1] + b * background[2]
            error, alpha = _depth_error(images, look, i, is_inside)
            share = _sign(error) * depth_weight / alpha
            store(by_depth, i, share)
            store(by_alpha, i, behind * -_ONE - share * load(images.depth, i) / alpha)
        total = lane_sums((*gains, *biases, zero, zero))
        store(sums[piece], 0, total)


@inlined
def _slope(error, colour_weight, square_weight):
    return _sign(error) * colour_weight + error * square_weight


@inlined
def _sign(x):
    return select(x > _ZERO, _ONE, select(x < _ZERO, -_ONE, _ZERO))


@inlined
def _colours(images, look, i, is_inside):
    """Values, errors (zero outside) and composites of LANES pixels, by channel."""
    rest = _ONE - load(images.alpha, i)
    r, g, b = load_three(images.colour, 3 * i)
    truth = load_three(images.true_colour, 3 * i)
    r = r + rest * look.background[0]
    g = g + rest * look.background[1]
    b = b + rest * look.background[2]
    x = r * look.gain[0] + look.bias[0]
    y = g * look.gain[1] + look.bias[1]
    z = b * look.gain[2] + look.bias[2]
    errors = (
        select(is_inside, x - truth[0], _ZERO),
        select(is_inside, y - truth[1], _ZERO),
        select(is_inside, z - truth[2], _ZERO),
    )
    return (x, y, z), errors, (r, g, b)


@inlined
def _depth_error(images, look, i, is_inside):
    """Errors of LANES pixels' depth, metres, 0 where they say nothing; and alpha, floored."""
    alpha, truth = load(images.alpha, i), load(images.true_depth, i)
    floored = maximum(alpha, _MIN_ALPHA)
    error = load(images.depth, i) / floored - truth
    is_known = (truth > _ZERO) & (alpha > _MIN_ALPHA) & is_inside
    is_close = negative_magnitude(error) > -look.max_depth_error
    return select(is_known & is_close, error, _ZERO), floored
