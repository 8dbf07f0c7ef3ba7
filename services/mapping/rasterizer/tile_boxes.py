"""Which tiles an ellipse hits: the box of tiles around it, and exactly which of a row of tiles."""

from __future__ import annotations

import math

import numpy as np

from services.mapping.rasterizer.kernel_types import (
    E2,
    HALF_HEIGHT,
    HALF_WIDTH,
    MEAN_X,
    MEAN_Y,
    REACH,
    RECORD,
    SHEAR,
    SLANT,
    TILE,
)
from services.mapping.rasterizer.simd import inlined, reproducible

_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)
_TILE, _TILE_SIDE = np.float32(TILE), np.float32(TILE - 1)  # between outer pixels' centres
_SLACK_PX = np.float32(0.01)  # rounding of the extents of a thin ellipse
_FAR_PX = np.float32(1e6)  # keeps positions inside the range of int32


@inlined
def tile_box(boxes, i):
    """First and last column, first and last row; there is none where first > last."""
    padded = len(boxes) // 4
    return (
        np.int64(boxes[i]),
        np.int64(boxes[padded + i]),
        np.int64(boxes[2 * padded + i]),
        np.int64(boxes[3 * padded + i]),
    )


@inlined
def tiles_in_line(box, columns):
    """The first tile, the step to the next, and how many there are; for a box of one row or column.

    Nearly all boxes are: one loop without geometry serves them, which a processor can foresee.
    """
    left, right, top, bottom = box
    step = columns if top < bottom else 1
    return top * columns + left, step, (right - left + 1) * (bottom - top + 1)


@reproducible
def tiles_of_row(records, i, row, left, right):
    """First and last of the tiles `left` to `right` of a row that the ellipse hits.

    Counting and listing must agree to the bit, so this does no fast mathematics.
    """
    r = i * RECORD
    half_width, half_height = records[r + HALF_WIDTH], records[r + HALF_HEIGHT]
    top = np.float32(row * TILE) + _HALF - records[r + MEAN_Y]
    bottom = top + _TILE_SIDE
    rightmost = records[r + SHEAR] * half_width  # how far below the mean the ellipse is widest
    at_right = min(max(rightmost, top), bottom)
    at_left = min(max(-rightmost, top), bottom)
    scale = half_width / (half_height * records[r + E2])
    slant, reach = records[r + SLANT], math.sqrt(records[r + REACH])
    first = records[r + MEAN_X] + slant * at_left - _half(at_left / half_height) * reach * scale
    last = records[r + MEAN_X] + slant * at_right + _half(at_right / half_height) * reach * scale
    return _first_tile(first, left), _last_tile(last, right)


@reproducible
def _half(position):
    """Half the width of the unit circle at a height."""
    return math.sqrt(max(_ONE - position * position, _ZERO))


@reproducible
def _first_tile(position, least):
    """The first tile whose last pixel lies right of a position; `least` for NaN."""
    tile = math.ceil((position - _SLACK_PX - _TILE_SIDE - _HALF) / _TILE)
    return np.int64(min(tile, _FAR_PX)) if tile > least else np.int64(least)


@reproducible
def _last_tile(position, most):
    """The last tile whose first pixel lies left of a position; `most` for NaN."""
    tile = math.floor((position + _SLACK_PX - _HALF) / _TILE)
    return np.int64(max(tile, -_FAR_PX)) if tile < most else np.int64(most)
