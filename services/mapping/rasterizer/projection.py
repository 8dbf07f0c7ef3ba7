"""Forward projection: world Gaussians to records, tile boxes and tile counts."""

from __future__ import annotations

import math

import numpy as np

from services.mapping.rasterizer.geometry import (
    BLOCK_ROWS,
    gather_lane,
    load_block,
    project_block,
)
from services.mapping.rasterizer.kernel_types import (
    CHUNK,
    CUT,
    DEPTH,
    E1,
    E2,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    REACH,
    RECORD,
    RED,
    SHEAR,
    SLANT,
    TILE,
)
from services.mapping.rasterizer.memory import fetch_add, store
from services.mapping.rasterizer.scene import DILATION_PX2, NEAR_M
from services.mapping.rasterizer.simd import inlined, kernel, square_root
from services.mapping.rasterizer.vectors import cross, dot

_NEAR = np.float32(NEAR_M)
_DILATION = np.float32(DILATION_PX2)
_DILATION_SQUARED = np.float32(DILATION_PX2**2)
_ZERO, _HALF, _QUARTER, _EIGHTH = (np.float32(x) for x in (0.0, 0.5, 0.25, 0.125))
_SIXTEEN = np.float32(16.0)
_FAR_PX = np.float32(1e6)  # keeps positions inside the range of int32

# Rows of 8 lanes in which a block's ellipses wait for the scalar part.
_X, _Y, _Z, _A, _B, _C, _E1, _E2 = range(8)


@kernel
def project(splats, camera, projected, counter):
    """Fill `projected`, a chunk of Gaussians per count."""
    lanes, shapes = np.empty(BLOCK_ROWS * 8, np.float32), np.empty(64, np.float32)
    total = len(splats.opacities)
    while True:
        chunk = fetch_add(counter, 0, 1)
        start, stop = chunk * CHUNK, min(chunk * CHUNK + CHUNK, total)
        if start >= stop:
            return
        valid = True
        for base in range(start, stop, 8):
            count = min(8, stop - base)
            for l in range(8):  # where fewer than 8 remain, repeat the first
                gather_lane(splats, base + (l if l < count else 0), l, lanes)
            _shape_block(lanes, camera, shapes)
            for l in range(count):
                i = base + l
                valid &= _is_finite(splats, lanes, i, l)
                _write_record(projected.records, splats, shapes, i, l)
                projected.counts[i] = _write_box(projected, camera, i)
        projected.valid[chunk] = valid


@inlined
def _shape_block(lanes, camera, shapes):
    """Means, dilated covariances and whitening factors of 8 Gaussians."""
    seen = project_block(load_block(lanes), camera)
    row_x, row_y = seen.spread
    a, b, c = dot(row_x, row_x), dot(row_x, row_y), dot(row_y, row_y)
    normal = cross(row_x, row_y)
    # a c - b^2 by Lagrange's identity: exact zero cannot come out negative for a thin ellipse.
    determinant = dot(normal, normal) + (a + c) * _DILATION + _DILATION_SQUARED
    a, c = a + _DILATION, c + _DILATION
    store(shapes, _X * 8, seen.u * camera.fx + camera.cx)
    store(shapes, _Y * 8, seen.v * camera.fy + camera.cy)
    store(shapes, _Z * 8, seen.z)
    store(shapes, _A * 8, a)
    store(shapes, _B * 8, b)
    store(shapes, _C * 8, c)
    store(shapes, _E1 * 8, _QUARTER / square_root(a))
    store(shapes, _E2 * 8, square_root(a / determinant) * _QUARTER)


@inlined
def _is_finite(splats, lanes, i, l):
    """Whether all 14 numbers of a Gaussian are finite; 0 * x is NaN for the others."""
    total = _ZERO
    for row in range(BLOCK_ROWS):
        total += lanes[row * 8 + l] * _ZERO
    for k in range(3):
        total += splats.colours[i * 3 + k] * _ZERO
    return total == _ZERO


@inlined
def _write_record(records, splats, shapes, i, l):
    """One cache line with all that the tiles need."""
    r = i * RECORD
    a, b, c = shapes[_A * 8 + l], shapes[_B * 8 + l], shapes[_C * 8 + l]
    log_opacity = math.log(splats.opacities[i]) * _EIGHTH
    reach = max(_ZERO, log_opacity - CUT)
    records[r + MEAN_X], records[r + MEAN_Y] = shapes[_X * 8 + l], shapes[_Y * 8 + l]
    records[r + E1], records[r + E2] = shapes[_E1 * 8 + l], shapes[_E2 * 8 + l]
    records[r + SHEAR], records[r + SLANT] = b / a, b / c
    records[r + LOG_OPACITY], records[r + REACH] = log_opacity, reach
    for k in range(3):
        records[r + RED + k] = splats.colours[i * 3 + k]
    records[r + DEPTH] = shapes[_Z * 8 + l]
    records[r + HALF_WIDTH] = math.sqrt(_SIXTEEN * reach * a)
    records[r + HALF_HEIGHT] = math.sqrt(_SIXTEEN * reach * c)


@inlined
def _first_and_last(centre, half):
    """Pixels whose centres lie within `half` of `centre`, clamped to the range of int32."""
    first = math.ceil(max(centre - half - _HALF, -_FAR_PX))
    return first, math.floor(min(centre + half - _HALF, _FAR_PX))


@inlined
def _write_box(projected, camera, i):
    """The box of tiles that may see the Gaussian; gives how many there are."""
    r, records, boxes = i * RECORD, projected.records, projected.boxes
    # Written so that NaN fails: a projection may overflow although its inputs were finite.
    if not (records[r + DEPTH] >= _NEAR and records[r + LOG_OPACITY] > CUT):
        return 0
    left, right = _first_and_last(records[r + MEAN_X], records[r + HALF_WIDTH])
    top, bottom = _first_and_last(records[r + MEAN_Y], records[r + HALF_HEIGHT])
    if not (left <= right and top <= bottom and right >= 0 and bottom >= 0):
        return 0
    if not (left < camera.width and top < camera.height):
        return 0
    boxes[i * 4], boxes[i * 4 + 1] = _tile_range(left, right, camera.width)
    boxes[i * 4 + 2], boxes[i * 4 + 3] = _tile_range(top, bottom, camera.height)
    columns = boxes[i * 4 + 1] - boxes[i * 4] + 1
    return columns * (boxes[i * 4 + 3] - boxes[i * 4 + 2] + 1)


@inlined
def _tile_range(first, last, size):
    return max(0, int(first)) // TILE, min(size - 1, int(last)) // TILE
