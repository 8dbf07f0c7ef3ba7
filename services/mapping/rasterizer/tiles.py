"""What the forward and the backward blending of a tile share.

A tile works Gaussian by Gaussian, not pixel by pixel: its planes (transmittance, colour, ...) stay
in the cache while each Gaussian paints strips of 8 columns, starting at its own left edge, as many
rows at a time as a vector covers. Rows of a plane have 8 spare pixels, and planes spare rows, so
that the overhang of a strip is harmless.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from services.mapping.rasterizer.memory import element, prefetch, strided
from services.mapping.rasterizer.places import strip_columns, strip_rows
from services.mapping.rasterizer.scene import ALPHA_MAX, TRANSMITTANCE_MIN
from services.mapping.rasterizer.simd import (
    STRIP_COLUMNS,
    STRIP_ROWS,
    allocating,
    inlined,
    minimum,
    select,
)

STRIDE = TILE + STRIP_COLUMNS
PLANE = (TILE + STRIP_ROWS - 1) * STRIDE
BATCH = 64  # Gaussians that are cut into strips before they are blended

load_rows, store_rows = strided(STRIDE)

ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
OPAQUE, STOP = np.float32(ALPHA_MAX), np.float32(TRANSMITTANCE_MIN)
_SEVEN = np.float32(7.0)

# exp on [-0.693, 0], least maximum error of degree 5.
_EXP = tuple(
    np.float32(c)
    for c in (0.99999994, 0.999992847, 0.499886632, 0.16599147, 0.0398034528, 0.00586577924)
)

_SLOT_MASK = np.uint64(0xFFFFFFFF)


class Tile(NamedTuple):
    """A rectangle of pixels."""

    left: int
    top: int
    width: int
    height: int


class Strips(NamedTuple):
    """Eight columns of a Gaussian inside a tile, one strip after the other."""

    places: NDArray[np.int32]  # of the first pixel in a plane
    steps: NDArray[np.int32]  # vectors from top to bottom
    records: NDArray[np.int32]  # the Gaussian's
    slots: NDArray[np.int32]  # the pair's, or -1 - slot where an earlier strip is the pair's too
    offsets: NDArray[np.float32]  # of the first pixel from the mean, x and y


class Strip(NamedTuple):
    """A strip in vectors."""

    place: Any  # of the first pixel in a plane
    steps: Any  # vectors from top to bottom
    dy: Any  # of the first rows, from the mean
    e1: Any  # whitened offset across
    base: Any  # ln(opacity) / 8 - e1^2
    tilt: Any  # the part of e2 that depends on the column


@inlined
def tile_at(index, camera):
    """Tile number `index`, cut at the image's edge."""
    columns = (camera.width + TILE - 1) // TILE
    left, top = (index % columns) * TILE, (index // columns) * TILE
    return Tile(left, top, min(TILE, camera.width - left), min(TILE, camera.height - top))


@allocating
def empty_strips():
    """Room for the strips of a batch."""
    most = BATCH * (TILE // STRIP_COLUMNS)
    return Strips(
        np.empty(most, np.int32),
        np.empty(most, np.int32),
        np.empty(most, np.int32),
        np.empty(most, np.int32),
        np.empty(most * 2, np.float32),
    )


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
def slot_of(key):
    """The slot in a key of a tile's list."""
    return np.int64(key & _SLOT_MASK)


@inlined
def cut_strips(tiles, tile, span, strips):
    """Cut the Gaussians at places span[0] to span[1] of the lists; gives the number of strips.

    The records of the batch behind, up to place span[2], are asked for early.
    """
    records, lists, _ = tiles
    first, last, stop = span
    count = 0
    for place in range(first, last):
        if place + BATCH < stop:
            ahead = slot_of(element(lists.keys, place + BATCH))
            prefetch(records, np.int64(element(lists.owners, ahead)) * RECORD)
        slot = slot_of(element(lists.keys, place))
        r = np.int64(element(lists.owners, slot)) * RECORD
        count = _cut_one(records, r, slot, tile, (strips, count))
    return count


@inlined
def _footprint(records, r, tile):
    """First and last column and row of a Gaussian's box within a tile."""
    x, y = element(records, r + MEAN_X), element(records, r + MEAN_Y)
    half_width, half_height = element(records, r + HALF_WIDTH), element(records, r + HALF_HEIGHT)
    return (
        max(0, ceil_index(x - half_width - HALF) - tile.left),
        min(tile.width - 1, floor_index(x + half_width - HALF) - tile.left),
        max(0, ceil_index(y - half_height - HALF) - tile.top),
        min(tile.height - 1, floor_index(y + half_height - HALF) - tile.top),
    )


@inlined
def _rows_of_strip(records, r, dx_first):
    """How far the ellipse reaches up and down within 8 columns, from the mean, pixels."""
    dx_last = dx_first + _SEVEN
    extreme = element(records, r + SLANT) * element(records, r + HALF_HEIGHT)
    e1, shear = element(records, r + E1), element(records, r + SHEAR)
    inverse_e2, reach = ONE / element(records, r + E2), element(records, r + REACH)
    low, high = min(max(-extreme, dx_first), dx_last), min(max(extreme, dx_first), dx_last)
    low_half = math.sqrt(max(reach - low * e1 * low * e1, ZERO)) * inverse_e2
    high_half = math.sqrt(max(reach - high * e1 * high * e1, ZERO)) * inverse_e2
    return low * shear - low_half, high * shear + high_half


@inlined
def _cut_one(records, r, slot, tile, target):
    """Add the strips of one Gaussian; gives the number of strips so far.

    The pair of a Gaussian that reaches no pixel's centre still gets an empty strip.
    """
    strips, count = target
    left, right, top, bottom = _footprint(records, r, tile)
    mean_x, mean_y = element(records, r + MEAN_X), element(records, r + MEAN_Y)
    x, first, last = left, top, bottom
    while True:
        dx = np.float32(tile.left + x) + HALF - mean_x
        if right - left >= STRIP_COLUMNS:
            above, below = _rows_of_strip(records, r, dx)
            first = max(top, ceil_index(mean_y + above - HALF) - tile.top)
            last = min(bottom, floor_index(mean_y + below - HALF) - tile.top)
        strips.places[count] = first * STRIDE + x
        strips.steps[count] = (last - first + STRIP_ROWS) // STRIP_ROWS if left <= right else 0
        strips.records[count] = r
        strips.slots[count] = slot if x == left else -1 - slot
        strips.offsets[count * 2] = dx
        strips.offsets[count * 2 + 1] = np.float32(tile.top + first) + HALF - mean_y
        count += 1
        x += STRIP_COLUMNS
        if x > right:
            return count


@inlined
def strip_at(records, strips, s):
    """Strip number `s` in vectors."""
    r = np.int64(element(strips.records, s))
    dx = strip_columns() + element(strips.offsets, s * 2)
    dy = strip_rows() + element(strips.offsets, s * 2 + 1)
    e1 = dx * element(records, r + E1)
    base = element(records, r + LOG_OPACITY) - e1 * e1
    tilt = dx * (element(records, r + SHEAR) * -element(records, r + E2))
    place, steps = np.int64(element(strips.places, s)), element(strips.steps, s)
    return Strip(place, steps, dy, e1, base, tilt)


@inlined
def falloff(strip, e2):
    """Opacity times the Gaussian, and alpha: that value within its limits."""
    exponent = strip.base - e2 * e2
    value = exp_of_8(exponent)
    return value, select(exponent >= CUT, minimum(value, OPAQUE), ZERO)
