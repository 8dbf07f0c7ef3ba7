"""What the forward and the backward blending of a tile share.

A tile works Gaussian by Gaussian, not pixel by pixel: its planes (transmittance, colour, ...) stay
in the cache while each Gaussian paints strips of 8 columns, starting at its own left edge. Rows
of a plane have 8 spare pixels so that the overhang of a strip is harmless.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from services.mapping.rasterizer.kernel_types import (
    CUT,
    E1,
    E2,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    REACH,
    RECORD,
    SHEAR,
    SLANT,
    TILE,
)
from services.mapping.rasterizer.lanes import ceil_index, floor_index
from services.mapping.rasterizer.memory import element, load, store
from services.mapping.rasterizer.scene import ALPHA_MAX, TRANSMITTANCE_MIN
from services.mapping.rasterizer.simd import inlined, minimum, ramp, select

STRIDE = TILE + 8
PLANE = TILE * STRIDE
BATCH = 64  # Gaussians copied next to each other before they are blended

ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
OPAQUE, STOP = np.float32(ALPHA_MAX), np.float32(TRANSMITTANCE_MIN)
_SEVEN = np.float32(7.0)

# exp on [-0.693, 0], least maximum error of degree 5.
_EXP = tuple(
    np.float32(c)
    for c in (0.99999994, 0.999992847, 0.499886632, 0.16599147, 0.0398034528, 0.00586577924)
)


class Tile(NamedTuple):
    """A rectangle of pixels."""

    left: int
    top: int
    width: int
    height: int


class Strip(NamedTuple):
    """Eight columns of a Gaussian inside a tile."""

    place: int  # of its first pixel in a plane
    rows: int
    dy: Any  # of the first row, from the mean
    e1: Any  # whitened offset across, one per lane
    base: Any  # ln(opacity) / 8 - e1^2
    tilt: Any  # the part of e2 that depends on the column


@inlined
def tile_at(index, camera):
    """Tile number `index`, cut at the image's edge."""
    columns = (camera.width + TILE - 1) // TILE
    left, top = (index % columns) * TILE, (index // columns) * TILE
    return Tile(left, top, min(TILE, camera.width - left), min(TILE, camera.height - top))


@inlined
def exp_of_8(x):
    """`exp(8 x)` for x in [-0.693, 0], relative error 2e-6."""
    power = x * _EXP[5] + _EXP[4]
    power = power * x + _EXP[3]
    power = power * x + _EXP[2]
    power = power * x + _EXP[1]
    power = power * x + _EXP[0]
    power = power * power
    power = power * power
    return power * power


@inlined
def load_batch(records, gaussians, first, count, batch):
    """Copy the records of `count` Gaussians of a list next to each other."""
    for k in range(count):
        source = np.int64(gaussians[first + k]) * RECORD
        store(batch, k * RECORD, load(records, source))
        store(batch, k * RECORD + 8, load(records, source + 8))


@inlined
def footprint(batch, r, tile):
    """First and last column and row of a Gaussian's box within a tile."""
    x, y = element(batch, r + MEAN_X), element(batch, r + MEAN_Y)
    half_width, half_height = element(batch, r + HALF_WIDTH), element(batch, r + HALF_HEIGHT)
    return (
        max(0, ceil_index(x - half_width - HALF) - tile.left),
        min(tile.width - 1, floor_index(x + half_width - HALF) - tile.left),
        max(0, ceil_index(y - half_height - HALF) - tile.top),
        min(tile.height - 1, floor_index(y + half_height - HALF) - tile.top),
    )


@inlined
def _rows_of_strip(batch, r, dx_first):
    """How far the ellipse reaches up and down within 8 columns, from the mean, pixels."""
    dx_last = dx_first + _SEVEN
    extreme = element(batch, r + SLANT) * element(batch, r + HALF_HEIGHT)
    e1, shear = element(batch, r + E1), element(batch, r + SHEAR)
    inverse_e2, reach = ONE / element(batch, r + E2), element(batch, r + REACH)
    low, high = min(max(-extreme, dx_first), dx_last), min(max(extreme, dx_first), dx_last)
    low_half = math.sqrt(max(reach - low * e1 * low * e1, ZERO)) * inverse_e2
    high_half = math.sqrt(max(reach - high * e1 * high * e1, ZERO)) * inverse_e2
    return low * shear - low_half, high * shear + high_half


@inlined
def strip_at(batch, r, tile, box, x):
    """The strip of a Gaussian that starts at column `x` of a tile."""
    left, right, first, last = box
    mean_y, e2 = element(batch, r + MEAN_Y), element(batch, r + E2)
    dx_first = np.float32(tile.left + x) + HALF - element(batch, r + MEAN_X)
    if right - left >= 8:
        above, below = _rows_of_strip(batch, r, dx_first)
        first = max(first, ceil_index(mean_y + above - HALF) - tile.top)
        last = min(last, floor_index(mean_y + below - HALF) - tile.top)
    dx = ramp() + dx_first
    e1 = dx * element(batch, r + E1)
    base = element(batch, r + LOG_OPACITY) - e1 * e1
    tilt = dx * (element(batch, r + SHEAR) * -e2)
    dy = np.float32(tile.top + first) + HALF - mean_y
    return Strip(first * STRIDE + x, last - first + 1, dy, e1, base, tilt)


@inlined
def falloff(strip, e2):
    """Opacity times the Gaussian, and alpha: that value within its limits."""
    exponent = strip.base - e2 * e2
    value = exp_of_8(exponent)
    return value, select(exponent >= CUT, minimum(value, OPAQUE), ZERO)
